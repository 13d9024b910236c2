// The nodes as programs of their own, over DDS on the loopback interface. They follow the clock of
// the simulated vehicle, which stands still until the command of each tick has arrived, so that the
// flights are the same on a busy machine. A full run also flies in real time.
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
#include "support/wait_until.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <functional>
#include <string>

namespace dds_flights_test {

using Eigen::Vector3d;
using test_support::Background;
using test_support::wait_until;

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
  explicit Ros2Line(const dds::Participant& participant)
      : imu_(participant, "imu"),
        pose_(participant, "motion_capture/pose"),
        speeds_(participant, "rotor_speeds"),
        actuators_(participant, "actuators") {}

  [[nodiscard]] bool connected() const {
    return imu_.subscribers() == 1 && pose_.subscribers() == 1 && speeds_.subscribers() == 1 &&
           actuators_.publishers() == 1;
  }
  void on_imu(const sensor_msgs::msg::Imu& m) { imu_.publish(m); }
  void on_pose(const geometry_msgs::msg::PoseStamped& m) { pose_.publish(m); }
  void on_rotor_speeds(const sensor_msgs::msg::JointState& m) { speeds_.publish(m); }

  /// Publishes the measurements of this millisecond.
  void sense() { vehicle.sense(*this); }
  void take() {
    actuators_.take([&](const actuator_msgs::msg::Actuators& m) { vehicle.on_command(m); });
  }
  [[nodiscard]] bool heard() const { return vehicle.commands > 0; }
  /// Whether the command of this tick has arrived.
  [[nodiscard]] bool answered() const {
    return heard() && vehicle.command_stamp == loops::seconds(loops::stamp(vehicle.now()));
  }

  test_support::Ros2Vehicle vehicle{1000000000LL};

 private:
  dds::Publisher<sensor_msgs::msg::Imu> imu_;
  dds::Publisher<geometry_msgs::msg::PoseStamped> pose_;
  dds::Publisher<sensor_msgs::msg::JointState> speeds_;
  dds::Subscriber<actuator_msgs::msg::Actuators> actuators_;
};

/// What a node shows of its flight.
class Shown {
 public:
  explicit Shown(const dds::Participant& participant)
      : tf_(participant, "/tf"),
        path_(participant, "path"),
        markers_(participant, "markers"),
        diagnostics_(participant, "/diagnostics") {}

  [[nodiscard]] bool connected() const {
    return tf_.publishers() == 1 && path_.publishers() == 1 && markers_.publishers() == 1 &&
           diagnostics_.publishers() == 1;
  }
  void take() {
    tf_.take([&](const tf2_msgs::msg::TFMessage& m) {
      ++transforms;
      ASSERT_EQ(m.transforms._length, 1U);
      EXPECT_STREQ(m.transforms._buffer[0].header.frame_id, "map");
      height = m.transforms._buffer[0].transform.translation.z;
    });
    markers_.take([&](const visualization_msgs::msg::MarkerArray& m) {
      ++arrays;
      EXPECT_EQ(m.markers._length, 8U);
    });
    path_.take([&](const nav_msgs::msg::Path& m) { poses = static_cast<int>(m.poses._length); });
    diagnostics_.take([&](const diagnostic_msgs::msg::DiagnosticArray& m) {
      message = m.status._buffer[0].message;
    });
  }

  int transforms = 0, arrays = 0, poses = 0;
  double height = 0.0;
  std::string message;

 private:
  dds::Subscriber<tf2_msgs::msg::TFMessage> tf_;
  dds::Subscriber<nav_msgs::msg::Path> path_;
  dds::Subscriber<visualization_msgs::msg::MarkerArray> markers_;
  dds::Subscriber<diagnostic_msgs::msg::DiagnosticArray> diagnostics_;
};

class DdsFlight : public testing::Test {
 protected:
  /// Flies on in simulated time until `enough()`, which is asked in every tick. Time stands still
  /// until the tick is answered. Before its first measurement a node does not answer; then the
  /// vehicle waits for 20 ms, and nothing is counted. Once a second the clock skips a tick.
  template <typename Line>
  void lock_step(Line& line, const std::function<bool()>& enough) {
    const long end = std::lround(1000.0 * line.vehicle.plant.time()) + 60000;
    for (long i = end - 60000;; ++i) {
      ASSERT_LT(i, end) << "the flight does not end";
      line.sense();
      if (i % 1000 == 500) {
        ++skipped_;
      } else if (i % 10 == 0) {
        clock_.publish({loops::stamp(line.vehicle.now())});
        ++published_;
        const auto answered = [&] {
          line.take();
          return line.answered();
        };
        if (line.heard()) {
          ASSERT_TRUE(wait_until(answered)) << "no answer at " << line.vehicle.plant.time() << " s";
          ++answered_;
        } else {
          answered_ += wait_until(answered, std::chrono::milliseconds(20)) ? 1 : 0;
        }
        if (enough()) return;
      }
      ASSERT_TRUE(line.vehicle.step());
    }
  }
  /// A node ran every tick that was answered, and no other tick than those of the clock. Before its
  /// first measurement it may have missed some.
  void expect_ticks_of_the_clock(const test_support::Outcome& flown) const {
    EXPECT_EQ(flown.exit_code, 0) << flown.output;
    EXPECT_GE(flown["ticks"], answered_);
    EXPECT_LE(flown["ticks"] + flown["late_ticks"], published_ + skipped_);
  }

  /// Flies in real time: one step every millisecond. After a pause it catches up.
  template <typename Line>
  static void in_real_time(Line& line, double seconds, const std::function<void()>& each) {
    line.vehicle.start = loops::system_time_ns();
    const std::int64_t start = loops::now_ns();
    for (std::int64_t i = 0; i < std::llround(1000.0 * seconds); ++i) {
      while (!loops::sleep_until(start + i * 1000000)) continue;
      line.sense();
      line.take();
      ASSERT_TRUE(line.vehicle.step());
      each();
    }
  }
  /// Sends measurements with stamps of the system clock until `enough()`.
  template <typename Line>
  static bool on_the_system_clock(Line& line, const std::function<bool()>& enough) {
    return wait_until([&] {
      line.vehicle.start += loops::system_time_ns() - line.vehicle.now();
      line.sense();
      line.take();
      return !line.vehicle.step() || enough();
    });
  }

  const bool full_ = test_support::full_run();
  const std::uint32_t domain_ = test_support::dds_on_loopback();
  test_support::Directory directory_{"dds_flight"};
  dds::Participant participant_{domain_};
  dds::Publisher<rosgraph_msgs::msg::Clock> clock_{participant_, "/clock"};
  int published_ = 0, skipped_ = 0, answered_ = 0;  // ticks
};

constexpr const char* ros2_parameters =
    "--ros-args -r pose:=motion_capture/pose -p hover_x:=0.1 -p hover_z:=0.5 ";
const Vector3d ros2_hover(0.1, 0.0, 0.5);

TEST_F(DdsFlight, Ros2NodeFollowsTheClockOfASimulationAndShowsItsFlight) {
  Ros2Line line(participant_);
  Shown shown(participant_);
  Background node(ROS2_NODE_PROGRAM,
                  ros2_parameters + std::string("-p use_sim_time:=true -p telemetry_rate:=100"),
                  directory_.file("node"));
  ASSERT_TRUE(wait_until(
      [&] { return line.connected() && shown.connected() && clock_.subscribers() == 1; }));
  auto& vehicle = line.vehicle;
  for (const bool again : {false, true}) {
    vehicle = test_support::Ros2Vehicle(vehicle.start);  // the clock jumps back, too
    Rmse rmse;
    ASSERT_NO_FATAL_FAILURE(lock_step(line, [&] {
      if (vehicle.plant.time() > 2.5) rmse.add(vehicle.plant.body().position - ros2_hover);
      // The node shows its flight in real time: from time to time the vehicle waits for it.
      const int before = shown.transforms;
      if (!again && std::lround(100.0 * vehicle.plant.time()) % 10 == 0)
        (void)wait_until([&] { return shown.take(), shown.transforms > before; },
                         std::chrono::milliseconds(100));
      return vehicle.plant.time() > 4.0 &&
             (again || (shown.transforms > 10 && shown.arrays > 10 && shown.poses > 5 &&
                        shown.message == "mission, estimate good"));
    }));
    test_support::check_at_most(29, "ros2_node over DDS, simulated time: RMSE [mm]",
                                1e3 * rmse.value(), 6.0);
  }
  EXPECT_NEAR(shown.height, 0.5, 0.05);
  expect_ticks_of_the_clock(node.stop());
}

TEST_F(DdsFlight, Ros2NodeHoversOnTheSystemClock) {
  Ros2Line line(participant_);
  Shown shown(participant_);
  Background node(ROS2_NODE_PROGRAM, ros2_parameters, directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected() && shown.connected(); }));
  const auto& vehicle = line.vehicle;
  const double begin = 1e-9 * static_cast<double>(loops::system_time_ns());
  EXPECT_TRUE(on_the_system_clock(line, [&] { return vehicle.commands > 20; }));
  EXPECT_GT(vehicle.command_stamp, begin);
  EXPECT_LT(vehicle.command_stamp, 1e-9 * static_cast<double>(loops::system_time_ns()));
  const auto flown = node.stop();
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_GE(flown["ticks"], vehicle.commands);
}

TEST_F(DdsFlight, Ros2NodeHoversInRealTime) {
  if (!full_) GTEST_SKIP() << "depends on other work of the machine: --full";
  Ros2Line line(participant_);
  Shown shown(participant_);
  Background node(ROS2_NODE_PROGRAM, ros2_parameters, directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected() && shown.connected(); }));
  const auto& vehicle = line.vehicle;
  Rmse rmse;
  in_real_time(line, 12.0, [&] {
    if (vehicle.plant.time() > 5.0) rmse.add(vehicle.plant.body().position - ros2_hover);
  });
  const auto flown = node.stop();
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  test_support::check_at_most(29, "ros2_node over DDS: RMSE [mm]", 1e3 * rmse.value(), 6.0);
  EXPECT_GT(vehicle.commands, 90 * 12);
  test_support::check_at_most(29, "ros2_node over DDS: late ticks / all",
                              flown["late_ticks"] / flown["ticks"], 0.001);
  shown.take();
  EXPECT_EQ(shown.transforms, 10);  // the queue of the subscriber
  EXPECT_EQ(shown.arrays, 10);
  EXPECT_GT(shown.poses, 5);
  EXPECT_NEAR(shown.height, 0.5, 0.05);
  EXPECT_EQ(shown.message, "mission, estimate good");
}

/// The topics of px4_node with the messages of a firmware, seen from the vehicle.
template <typename Status, typename Servos>
class Px4Line {
 public:
  Px4Line(const dds::Participant& participant, const loops::Px4Versions& versions,
          const std::string& space = "")
      : sensors_(participant, space + versions.topic("SensorCombined"), dds::sensor_data),
        odometry_(participant, space + versions.topic("VehicleOdometry"), dds::sensor_data),
        status_(participant, space + versions.topic("VehicleStatus"), dds::sensor_data),
        mode_(participant, space + versions.topic("OffboardControlMode"), dds::sensor_data),
        motors_(participant, space + versions.topic("ActuatorMotors"), dds::sensor_data),
        servos_(participant, space + versions.topic("ActuatorServos"), dds::sensor_data) {}

  [[nodiscard]] bool connected() const {
    return sensors_.subscribers() == 1 && odometry_.subscribers() == 1 &&
           status_.subscribers() == 1 && mode_.publishers() == 1 && motors_.publishers() == 1 &&
           servos_.publishers() == 1;
  }
  void on_sensors(const px4_msgs::msg::SensorCombined& m) { sensors_.publish(m); }
  void on_odometry(const px4_msgs::msg::VehicleOdometry& m) { odometry_.publish(m); }

  /// Publishes the measurements of this millisecond; PX4 repeats its status.
  void sense() {
    vehicle.sense(*this);
    if (++ticks_ % 100 != 1) return;
    offboard_ = vehicle.plant.time() > armed_from;
    status_.publish(vehicle.template status<Status>(offboard_, offboard_));
  }
  void take() {
    mode_.take([&](const px4_msgs::msg::OffboardControlMode& m) {
      vehicle.on_mode(m);
      mode_stamp_ = m.timestamp;
    });
    motors_.take([&](const px4_msgs::msg::ActuatorMotors& m) { vehicle.on_motors(m); });
    servos_.take([&](const Servos& m) {
      vehicle.on_servos(m);
      servos_stamp_ = m.timestamp;
    });
  }
  [[nodiscard]] bool heard() const { return vehicle.heartbeats > 0; }
  /// Whether all messages of this tick have arrived.
  [[nodiscard]] bool answered() const {
    const auto now = static_cast<std::uint64_t>(vehicle.now() / 1000);
    return mode_stamp_ == now &&
           (!offboard_ || (vehicle.last_motors.timestamp == now && servos_stamp_ == now));
  }

  test_support::Px4Vehicle vehicle{1000000000LL};
  double armed_from = -1.0;  ///< time of the vehicle [s]

 private:
  dds::Publisher<px4_msgs::msg::SensorCombined> sensors_;
  dds::Publisher<px4_msgs::msg::VehicleOdometry> odometry_;
  dds::Publisher<Status> status_;
  dds::Subscriber<px4_msgs::msg::OffboardControlMode> mode_;
  dds::Subscriber<px4_msgs::msg::ActuatorMotors> motors_;
  dds::Subscriber<Servos> servos_;
  long ticks_ = 0;
  bool offboard_ = false;
  std::uint64_t mode_stamp_ = 0, servos_stamp_ = 0;
};
using CurrentPx4Line = Px4Line<px4_msgs::msg::VehicleStatus, px4_msgs::msg::ActuatorServos>;

const std::string px4_parameters =
    "--ros-args -p origin_height:=0.07 -p thrust_model_factor:=0.3 -p hover_z:=0.5 ";
const Vector3d px4_hover(0.0, 0.0, 0.5);

TEST_F(DdsFlight, Px4NodeHoversOnVersionedTopics) {
  CurrentPx4Line line(participant_, loops::Px4Versions());
  Background node(PX4_NODE_PROGRAM, px4_parameters + "-p use_sim_time:=true",
                  directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected() && clock_.subscribers() == 1; }));
  auto& vehicle = line.vehicle;
  line.armed_from = 1.4;
  Rmse rmse;
  ASSERT_NO_FATAL_FAILURE(lock_step(line, [&] {
    if (vehicle.plant.time() > 3.9) rmse.add(vehicle.plant.body().position - px4_hover);
    return vehicle.plant.time() > 4.9;
  }));
  test_support::check_at_most(29, "px4_node over DDS, simulated time: RMSE [mm]",
                              1e3 * rmse.value(), 6.0);
  EXPECT_EQ(vehicle.commands, vehicle.servo_commands);
  EXPECT_GE(vehicle.heartbeats, answered_);
  EXPECT_EQ(vehicle.wrong_modes + vehicle.wrong_outputs, 0);
  expect_ticks_of_the_clock(node.stop());
}

TEST_F(DdsFlight, Px4NodeHoversInRealTime) {
  if (!full_) GTEST_SKIP() << "depends on other work of the machine: --full";
  CurrentPx4Line line(participant_, loops::Px4Versions());
  Background node(PX4_NODE_PROGRAM, px4_parameters, directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected(); }));
  auto& vehicle = line.vehicle;
  line.armed_from = 2.0;
  Rmse rmse;
  in_real_time(line, 12.0, [&] {
    if (vehicle.plant.time() > 7.0) rmse.add(vehicle.plant.body().position - px4_hover);
  });
  const auto flown = node.stop();
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  test_support::check_at_most(29, "px4_node over DDS: RMSE [mm]", 1e3 * rmse.value(), 6.0);
  EXPECT_GT(vehicle.commands, 90 * 10);
  EXPECT_NEAR(vehicle.commands, vehicle.servo_commands, 5);
  EXPECT_GT(vehicle.heartbeats, 90 * 12);
  EXPECT_EQ(vehicle.wrong_modes + vehicle.wrong_outputs, 0);
  test_support::check_at_most(29, "px4_node over DDS: late ticks / all",
                              flown["late_ticks"] / flown["ticks"], 0.001);
}

TEST_F(DdsFlight, Px4NodeSpeaksToOlderFirmwareOnTheSystemClock) {
  const loops::Px4Versions versions({"VehicleStatus=1", "ActuatorServos=0"});
  Px4Line<px4_msgs::msg::VehicleStatusV1, px4_msgs::msg::ActuatorServosV0> line(participant_,
                                                                                versions, "px4_1/");
  // As a launch file starts it.
  const std::string file = directory_.file("parameters.yaml");
  std::ofstream(file) << "/px4_1/pilot:\n  ros__parameters:\n    hover_z: 0.5\n";
  const std::string options =
      "--px4-message-version VehicleStatus=1 --px4-message-version ActuatorServos=0 --ros-args "
      "--log-level info -r __node:=pilot -r __ns:=/px4_1 -p use_sim_time:=False --params-file '" +
      file + "'";
  Background node(PX4_NODE_PROGRAM, options, directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected(); }));
  const auto& vehicle = line.vehicle;
  EXPECT_TRUE(on_the_system_clock(
      line, [&] { return vehicle.commands > 20 && vehicle.servo_commands > 20; }));
  EXPECT_EQ(node.stop().exit_code, 0);
}

}  // namespace dds_flights_test
