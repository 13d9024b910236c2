// The nodes as programs of their own: they fly a simulated vehicle in real time over DDS, on the
// loopback interface.
// CTest: real_time dds

#include "../../examples/integrations/messages.hpp"
#include "../../examples/integrations/node.hpp"
#include "../../examples/integrations/px4_topics.hpp"
#include "../../examples/integrations/real_time.hpp"
#include "support/background.hpp"
#include "support/check_table.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/full_run.hpp"
#include "support/px4_vehicle.hpp"
#include "support/ros2_vehicle.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <string>

namespace {

using Eigen::Vector3d;
using test_support::Background;

/// Root mean square of a distance.
struct Rmse {
  double sum = 0.0;
  int count = 0;
  void add(const Vector3d& error) {
    sum += error.squaredNorm();
    ++count;
  }
  [[nodiscard]] double value() const { return std::sqrt(sum / std::max(1, count)); }
};

/// The topics of ros2_node, seen from the vehicle.
class Ros2Line {
 public:
  explicit Ros2Line(const dds::Participant& participant, const std::string& pose_topic = "pose")
      : imu_(participant, "imu"),
        pose_(participant, pose_topic),
        speeds_(participant, "rotor_speeds"),
        actuators_(participant, "actuators") {}

  [[nodiscard]] bool connected() const {
    return imu_.subscribers() == 1 && pose_.subscribers() == 1 && speeds_.subscribers() == 1 &&
           actuators_.publishers() == 1;
  }
  void on_imu(const sensor_msgs::msg::Imu& m) { imu_.publish(m); }
  void on_pose(const geometry_msgs::msg::PoseStamped& m) { pose_.publish(m); }
  void on_rotor_speeds(const sensor_msgs::msg::JointState& m) { speeds_.publish(m); }
  /// Returns the number of commands.
  int take(test_support::Ros2Vehicle& vehicle) {
    return actuators_.take([&](const actuator_msgs::msg::Actuators& m) { vehicle.on_command(m); });
  }

 private:
  dds::Publisher<sensor_msgs::msg::Imu> imu_;
  dds::Publisher<geometry_msgs::msg::PoseStamped> pose_;
  dds::Publisher<sensor_msgs::msg::JointState> speeds_;
  dds::Subscriber<actuator_msgs::msg::Actuators> actuators_;
};

class DdsFlight : public testing::Test {
 protected:
  /// Calls step() once every millisecond of the clock. After a pause it catches up.
  static void every_millisecond(double seconds, const std::function<void()>& step) {
    const std::int64_t start = loops::now_ns();
    for (std::int64_t i = 0; i < std::llround(1000.0 * seconds); ++i) {
      while (!loops::sleep_until(start + i * 1000000)) continue;
      step();
    }
  }
  /// Waits until `ready` for at most 10 s.
  static bool wait_until(const std::function<bool()>& ready) {
    for (int i = 0; i < 1000 && !ready(); ++i) (void)loops::sleep_until(loops::now_ns() + 10000000);
    return ready();
  }

  const bool full_ = test_support::full_run();
  const std::uint32_t domain_ = test_support::dds_on_loopback();
  test_support::Directory directory_{"dds_flight"};
  dds::Participant participant_{domain_};
};

TEST_F(DdsFlight, Ros2NodeHoversAndShowsItsFlight) {
  Ros2Line line(participant_, "motion_capture/pose");
  dds::Subscriber<tf2_msgs::msg::TFMessage> tf(participant_, "/tf");
  dds::Subscriber<nav_msgs::msg::Path> path(participant_, "path");
  dds::Subscriber<visualization_msgs::msg::MarkerArray> markers(participant_, "markers");
  dds::Subscriber<diagnostic_msgs::msg::DiagnosticArray> diagnostics(participant_, "/diagnostics");
  Background node(ROS2_NODE_PROGRAM,
                  "--ros-args -p hover_x:=0.1 -p hover_z:=0.5 -r pose:=motion_capture/pose",
                  directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected() && diagnostics.publishers() == 1; }));

  test_support::Ros2Vehicle vehicle(loops::system_time_ns());
  const Vector3d wanted(0.1, 0.0, 0.5);
  const double duration = full_ ? 12.0 : 4.0, settled = full_ ? 5.0 : 2.5;
  Rmse rmse;
  every_millisecond(duration, [&] {
    vehicle.sense(line);
    line.take(vehicle);
    ASSERT_TRUE(vehicle.step());
    if (vehicle.plant.time() > settled) rmse.add(vehicle.plant.body().position - wanted);
  });
  const auto flown = node.stop();
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  test_support::check_at_most(29, "ros2_node over DDS: RMSE [mm]", 1e3 * rmse.value(),
                              full_ ? 6.0 : 20.0);
  EXPECT_GT(vehicle.commands, 90 * static_cast<int>(duration));
  test_support::check_at_most(29, "ros2_node over DDS: late ticks / all",
                              flown["late_ticks"] / flown["ticks"], full_ ? 0.001 : 0.05);

  int transforms = 0, arrays = 0, paths = 0;
  double height = 0.0;
  tf.take([&](const tf2_msgs::msg::TFMessage& m) {
    ++transforms;
    ASSERT_EQ(m.transforms._length, 1U);
    EXPECT_STREQ(m.transforms._buffer[0].header.frame_id, "map");
    height = m.transforms._buffer[0].transform.translation.z;
  });
  EXPECT_NEAR(height, 0.5, 0.05);
  markers.take([&](const visualization_msgs::msg::MarkerArray& m) {
    ++arrays;
    EXPECT_EQ(m.markers._length, 8U);
  });
  path.take([&](const nav_msgs::msg::Path& m) { paths = static_cast<int>(m.poses._length); });
  EXPECT_EQ(transforms, 10);  // the queue of the subscriber
  EXPECT_EQ(arrays, 10);
  EXPECT_GT(paths, 5);
  std::string message;
  diagnostics.take([&](const diagnostic_msgs::msg::DiagnosticArray& m) {
    message = m.status._buffer[0].message;
  });
  EXPECT_EQ(message, "mission, estimate good");
}

TEST_F(DdsFlight, Ros2NodeFollowsTheClockOfASimulation) {
  Ros2Line line(participant_);
  dds::Publisher<rosgraph_msgs::msg::Clock> clock(participant_, "/clock");
  Background node(ROS2_NODE_PROGRAM, "--ros-args -p use_sim_time:=true -p hover_z:=0.5",
                  directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected() && clock.subscribers() == 1; }));
  // The simulation begins long ago and waits for the command of every tick, so that its speed is
  // that of this computer.
  constexpr int milliseconds = 4000, ticks = milliseconds / 10;
  const auto simulate = [&] {
    test_support::Ros2Vehicle vehicle(1000000000LL);
    int unanswered = 0;
    for (int i = 0; i < milliseconds; ++i) {
      vehicle.sense(line);
      if (i % 10 == 0) {
        clock.publish({loops::stamp(vehicle.now())});
        const std::int64_t patience = vehicle.commands > 0 ? 500000000 : 5000000;
        const std::int64_t end = loops::now_ns() + patience;
        int commands = 0;
        while ((commands = line.take(vehicle)) == 0 && loops::now_ns() < end)
          (void)loops::sleep_until(loops::now_ns() + 100000);
        unanswered += commands == 0 ? 1 : 0;
      }
      EXPECT_TRUE(vehicle.step());
    }
    EXPECT_LE(unanswered, 10);  // before the first pose
    EXPECT_NEAR(vehicle.command_stamp, 1.0 + 1e-3 * (milliseconds - 10), 1e-6);
    return (vehicle.plant.body().position - Vector3d(0.0, 0.0, 0.5)).norm();
  };
  const std::int64_t start = loops::now_ns();
  EXPECT_LT(simulate(), 0.02);
  RecordProperty("speed", std::to_string(4e9 / static_cast<double>(loops::now_ns() - start)));
  EXPECT_LT(simulate(), 0.02);  // begins again: the clock jumps back, the vehicle to its start
  const auto flown = node.stop();
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_NEAR(flown["ticks"], 2 * ticks, 4);
}

/// A flight with the topics and messages of a firmware.
template <typename Status, typename Servos>
class Px4Line {
 public:
  Px4Line(const dds::Participant& participant, const loops::Px4Versions& versions)
      : sensors_(participant, versions.topic("SensorCombined"), dds::sensor_data),
        odometry_(participant, versions.topic("VehicleOdometry"), dds::sensor_data),
        status_(participant, versions.topic("VehicleStatus"), dds::sensor_data),
        mode_(participant, versions.topic("OffboardControlMode"), dds::sensor_data),
        motors_(participant, versions.topic("ActuatorMotors"), dds::sensor_data),
        servos_(participant, versions.topic("ActuatorServos"), dds::sensor_data) {}

  [[nodiscard]] bool connected() const {
    return sensors_.subscribers() == 1 && odometry_.subscribers() == 1 &&
           status_.subscribers() == 1 && mode_.publishers() == 1 && motors_.publishers() == 1 &&
           servos_.publishers() == 1;
  }
  void on_sensors(const px4_msgs::msg::SensorCombined& m) { sensors_.publish(m); }
  void on_odometry(const px4_msgs::msg::VehicleOdometry& m) { odometry_.publish(m); }

  /// One millisecond; PX4 repeats its status.
  [[nodiscard]] bool step(bool armed_and_offboard) {
    vehicle.sense(*this);
    const auto status = vehicle.status<Status>(armed_and_offboard, armed_and_offboard);
    if (++ticks_ % 100 == 1) status_.publish(status);
    mode_.take([&](const px4_msgs::msg::OffboardControlMode& m) { vehicle.on_mode(m); });
    motors_.take([&](const px4_msgs::msg::ActuatorMotors& m) { vehicle.on_motors(m); });
    servos_.take([&](const Servos& m) { vehicle.on_servos(m); });
    return vehicle.step();
  }

  test_support::Px4Vehicle vehicle{loops::system_time_ns()};

 private:
  dds::Publisher<px4_msgs::msg::SensorCombined> sensors_;
  dds::Publisher<px4_msgs::msg::VehicleOdometry> odometry_;
  dds::Publisher<Status> status_;
  dds::Subscriber<px4_msgs::msg::OffboardControlMode> mode_;
  dds::Subscriber<px4_msgs::msg::ActuatorMotors> motors_;
  dds::Subscriber<Servos> servos_;
  long ticks_ = 0;
};

constexpr const char* px4_parameters =
    "--ros-args -p origin_height:=0.07 -p thrust_model_factor:=0.3 -p hover_z:=0.5";

TEST_F(DdsFlight, Px4NodeHoversOnVersionedTopics) {
  Px4Line<px4_msgs::msg::VehicleStatus, px4_msgs::msg::ActuatorServos> line(participant_,
                                                                            loops::Px4Versions());
  Background node(PX4_NODE_PROGRAM, px4_parameters, directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected(); }));
  auto& vehicle = line.vehicle;
  vehicle.start = loops::system_time_ns();
  const double armed = full_ ? 2.0 : 1.4, duration = full_ ? 12.0 : 4.9;
  const double settled = armed + (full_ ? 5.0 : 2.5);
  Rmse rmse;
  every_millisecond(duration, [&] {
    ASSERT_TRUE(line.step(vehicle.plant.time() > armed));
    if (vehicle.plant.time() > settled)
      rmse.add(vehicle.plant.body().position - Vector3d(0.0, 0.0, 0.5));
  });
  const auto flown = node.stop();
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  test_support::check_at_most(29, "px4_node over DDS: RMSE [mm]", 1e3 * rmse.value(),
                              full_ ? 6.0 : 20.0);
  EXPECT_GT(vehicle.commands, 90 * static_cast<int>(duration - armed));
  EXPECT_NEAR(vehicle.commands, vehicle.servo_commands, 5);
  EXPECT_GT(vehicle.heartbeats, 90 * static_cast<int>(duration));
  EXPECT_EQ(vehicle.wrong_modes + vehicle.wrong_outputs, 0);
  test_support::check_at_most(29, "px4_node over DDS: late ticks / all",
                              flown["late_ticks"] / flown["ticks"], full_ ? 0.001 : 0.05);
}

TEST_F(DdsFlight, Px4NodeSpeaksToOlderFirmware) {
  const loops::Px4Versions versions({"VehicleStatus=1", "ActuatorServos=0"});
  Px4Line<px4_msgs::msg::VehicleStatusV1, px4_msgs::msg::ActuatorServosV0> line(participant_,
                                                                                versions);
  const std::string options =
      "--px4-message-version VehicleStatus=1 --px4-message-version ActuatorServos=0 ";
  Background node(PX4_NODE_PROGRAM, options + px4_parameters, directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected(); }));
  line.vehicle.start = loops::system_time_ns();
  every_millisecond(0.6, [&] { ASSERT_TRUE(line.step(true)); });
  EXPECT_GT(line.vehicle.commands, 20);
  EXPECT_GT(line.vehicle.servo_commands, 20);
  EXPECT_EQ(node.stop().exit_code, 0);
}

}  // namespace
