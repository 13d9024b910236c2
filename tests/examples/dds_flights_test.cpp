// The nodes as programs of their own, over DDS on the loopback interface. They follow the clock of
// the simulated vehicle, which stands still until the command of each tick has arrived, so that the
// flights are the same on a busy machine. A full run also flies in real time.
// CTest: real_time dds

#include "../../examples/integrations/flight_plan.hpp"
#include "../../examples/integrations/px4_topics.hpp"
#include "support/check_table.hpp"
#include "support/dds_flight.hpp"
#include "support/heavy_vehicle.hpp"
#include "support/px4_vehicle.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <optional>
#include <string>

namespace dds_flights_test {

using Eigen::Vector3d;
using test_support::Background;
using test_support::DdsFlight;
using test_support::Rmse;
using test_support::Ros2Line;
using test_support::wait_until;

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

/// Flies the mission or trajectory in `file` by ros2_node, in lock step; compares the error with
/// that of hybrid_mission, which is one process and has the same vehicle and noise.
class DdsMission : public DdsFlight {
 protected:
  void fly(const std::string& parameter, const std::string& option, const std::string& file,
           const std::string& level, const tilt_ropter::Mission& mission) {
    const auto alone = test_support::run(
        HYBRID_MISSION_PROGRAM,
        option + " '" + file + "' --level " + level +
            " --mass-error 0.03 --inertia-error 0 --seed 5 --no-pictures --output '" +
            directory_.file("") + "'");
    ASSERT_EQ(alone.exit_code, 0) << alone.output;
    Ros2Line line(participant_);
    auto& vehicle = line.vehicle;
    vehicle.wind.setZero();
    Background node(ROS2_NODE_PROGRAM,
                    "--ros-args -r pose:=motion_capture/pose -p use_sim_time:=true -p level:=" +
                        level + " -p " + parameter + ":='" + file + "'",
                    directory_.file("node"));
    ASSERT_TRUE(wait_until([&] { return line.connected() && clock_.subscribers() == 1; }));
    Rmse rmse;
    ASSERT_NO_FATAL_FAILURE(lock_step(line, [&] {
      const double time = 1e-9 * static_cast<double>(vehicle.now()) - vehicle.first_stamp -
                          loops::PacedMission::ramp / 2.0 + mission.start_time();
      if (line.heard()) rmse.add(vehicle.plant.body().position - mission(time).position);
      return line.heard() && time > mission.end_time();
    }));
    EXPECT_EQ(node.stop().exit_code, 0);
    test_support::check_at_most(
        58, parameter + " of ros2_node over DDS, " + level + " level: error / that of one process",
        rmse.value() / alone["mission_rmse_m"], 1.2);
    std::printf("%s over DDS, %s level: %.4f m, one process: %.4f m\n", parameter.c_str(),
                level.c_str(), rmse.value(), alone["mission_rmse_m"]);
  }
  const std::optional<tilt_ropter::Undercarriage> wheels_ =
      tilt_ropter::undercarriage(test_support::heavy_vehicle());
};

TEST_F(DdsMission, Ros2NodeFliesAMissionAsOneProcessDoes) {
  const std::string file = directory_.write("mission.json", R"({
    "name": "short", "start": {"position_m": [0, 0]}, "segments": [
      {"type": "rest", "duration_s": 0.6},
      {"type": "take_off", "height_m": 0.6},
      {"type": "figure_eight", "amplitude_m": [0.5, 0.2, 0.1], "laps": 1, "max_speed_mps": 1},
      {"type": "land"},
      {"type": "go_to", "position_m": [0.5, 0]}]})");
  for (const char* level : {"wrench", "actuator"})
    fly("mission", "--mission-file", file, level, examples::read_mission(file, wheels_));
}

TEST_F(DdsMission, Ros2NodeFliesATrajectoryAsOneProcessDoes) {
  const std::string file = directory_.write("trajectory.csv",
                                            "time_s,x_m,y_m,z_m\n0,0,0,0.11\n1,0,0,0.11\n"
                                            "3,0,0,0.8\n5,0.8,0.2,1\n7,1,-0.5,1\n9,0.5,0,0.8\n");
  for (const char* level : {"wrench", "actuator"})
    fly("trajectory", "--trajectory", file, level, examples::read_trajectory(file, wheels_));
}

/// Two vehicles that the same clock moves.
struct TwoVehicles {
  explicit TwoVehicles(const dds::Participant& participant)
      : a(participant, "a/"),
        b(participant, "b/"),
        vehicle{a.vehicle, b.vehicle, a.vehicle.plant} {}

  [[nodiscard]] bool connected() const { return a.connected() && b.connected(); }
  void sense() {
    a.sense();
    b.sense();
  }
  void take() {
    a.take();
    b.take();
  }
  [[nodiscard]] bool heard() const { return a.heard() && b.heard(); }
  [[nodiscard]] bool answered() const { return a.answered() && b.answered(); }

  struct Both {
    test_support::Ros2Vehicle &a, &b;
    tilt_ropter::Plant<4>& plant;
    [[nodiscard]] bool step() { return a.step() && b.step(); }
    [[nodiscard]] std::int64_t now() const { return a.now(); }
  };
  Ros2Line a, b;
  Both vehicle;
};

TEST_F(DdsFlight, TwoVehiclesFlyInOneDomain) {
  TwoVehicles two(participant_);
  const auto node = [&](const std::string& name, const std::string& parameters) {
    return Background(ROS2_NODE_PROGRAM,
                      "--ros-args -r __ns:=/" + name +
                          " -r pose:=motion_capture/pose -p use_sim_time:=true " + parameters,
                      directory_.file(name));
  };
  Background a = node("a", "-p hover_x:=0.5 -p hover_z:=0.6"),
             b = node("b", "-p hover_x:=-0.5 -p hover_z:=1.2 -p level:=actuator");
  ASSERT_TRUE(wait_until([&] { return two.connected() && clock_.subscribers() == 2; }));
  ASSERT_NO_FATAL_FAILURE(lock_step(two, [&] { return two.vehicle.plant.time() > 7.0; }));
  EXPECT_LT((two.a.vehicle.plant.body().position - Vector3d(0.5, 0.0, 0.6)).norm(), 0.03);
  EXPECT_LT((two.b.vehicle.plant.body().position - Vector3d(-0.5, 0.0, 1.2)).norm(), 0.03);
  EXPECT_EQ(a.stop().exit_code, 0);
  EXPECT_EQ(b.stop().exit_code, 0);
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
template <typename Status, typename Servos, typename Battery>
class Px4Line {
 public:
  Px4Line(const dds::Participant& participant, const loops::Px4Versions& versions,
          const std::string& space = "")
      : sensors_(participant, space + versions.topic("SensorCombined"), dds::sensor_data),
        odometry_(participant, space + versions.topic("VehicleOdometry"), dds::sensor_data),
        status_(participant, space + versions.topic("VehicleStatus"), dds::sensor_data),
        battery_(participant, space + versions.topic("BatteryStatus"), dds::sensor_data),
        mode_(participant, space + versions.topic("OffboardControlMode"), dds::sensor_data),
        motors_(participant, space + versions.topic("ActuatorMotors"), dds::sensor_data),
        servos_(participant, space + versions.topic("ActuatorServos"), dds::sensor_data) {}

  [[nodiscard]] bool connected() const {
    return sensors_.subscribers() == 1 && odometry_.subscribers() == 1 &&
           status_.subscribers() == 1 && battery_.subscribers() == 1 && mode_.publishers() == 1 &&
           motors_.publishers() == 1 && servos_.publishers() == 1;
  }
  void on_sensors(const px4_msgs::msg::SensorCombined& m) { sensors_.publish(m); }
  void on_odometry(const px4_msgs::msg::VehicleOdometry& m) { odometry_.publish(m); }
  void on_battery(const px4_msgs::msg::BatteryStatus& m) {
    Battery sent{};
    sent.timestamp = m.timestamp;
    sent.connected = m.connected;
    sent.voltage_v = m.voltage_v;
    battery_.publish(sent);
  }

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
  dds::Publisher<Battery> battery_;
  dds::Subscriber<px4_msgs::msg::OffboardControlMode> mode_;
  dds::Subscriber<px4_msgs::msg::ActuatorMotors> motors_;
  dds::Subscriber<Servos> servos_;
  long ticks_ = 0;
  bool offboard_ = false;
  std::uint64_t mode_stamp_ = 0, servos_stamp_ = 0;
};
using CurrentPx4Line = Px4Line<px4_msgs::msg::VehicleStatus, px4_msgs::msg::ActuatorServos,
                               px4_msgs::msg::BatteryStatus>;

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
  const loops::Px4Versions versions({"VehicleStatus=1", "ActuatorServos=0", "BatteryStatus=0"});
  Px4Line<px4_msgs::msg::VehicleStatusV1, px4_msgs::msg::ActuatorServosV0,
          px4_msgs::msg::BatteryStatusV0>
      line(participant_, versions, "px4_1/");
  line.vehicle.voltage = 14.0;
  // As a launch file starts it.
  const std::string file = directory_.file("parameters.yaml");
  std::ofstream(file) << "/px4_1/pilot:\n  ros__parameters:\n    hover_z: 0.5\n";
  const std::string options =
      "--px4-message-version VehicleStatus=1 --px4-message-version ActuatorServos=0 "
      "--px4-message-version BatteryStatus=0 --ros-args --log-level info -r __node:=pilot -r "
      "__ns:=/px4_1 -p use_sim_time:=False --params-file '" +
      file + "'";
  Background node(PX4_NODE_PROGRAM, options, directory_.file("node"));
  ASSERT_TRUE(wait_until([&] { return line.connected(); }));
  const auto& vehicle = line.vehicle;
  EXPECT_TRUE(on_the_system_clock(
      line, [&] { return vehicle.commands > 20 && vehicle.servo_commands > 20; }));
  EXPECT_EQ(node.stop().exit_code, 0);
}

}  // namespace dds_flights_test
