// The loops of examples/loops: both nodes in flight, with a simulated vehicle on the other side of
// their messages, and the real-time loop as a user runs it.

#include "../../examples/loops/px4_node.hpp"
#include "../../examples/loops/ros2_node.hpp"
#include "../../examples/loops/run_node.hpp"
#include "../../examples/support/mission_sensors.hpp"
#include "support/program.hpp"
#include "support/sanitizer.hpp"

#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace loops {
namespace {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;
using tilt_ropter::pi;
using tilt_ropter::Plant;

constexpr float nan_f = std::numeric_limits<float>::quiet_NaN();

/// Heavier than the nodes believe.
tilt_ropter::Vehicle<4> heavy_vehicle() {
  tilt_ropter::Vehicle<4> v = tilt_ropter::tilt_ropter_vehicle();
  v.body.mass *= 1.03;
  return v;
}

// ---- ROS 2

/// A vehicle with the sensors of the mission, whose clock starts at some time as ROS's does.
class Ros2Vehicle {
 public:
  Ros2Vehicle() {
    rclcpp::stand_in::now = 1700000000LL * 1000000000LL;
    subscription_ = node_.create_subscription<actuator_msgs::msg::Actuators>(
        "actuators", 1, [this](const actuator_msgs::msg::Actuators& m) {
          ++commands;
          command_.rotor_speed = Eigen::Map<const Eigen::Vector4d>(m.velocity.data());
          command_.tilt_angle = Eigen::Map<const Eigen::Vector4d>(m.position.data());
          stamp = m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec;
        });
  }

  void fly(double seconds) {
    for (int i = 0; i < std::lround(1000.0 * seconds); ++i) {
      if (sensing) sensors_.sense(plant, *this);
      rclcpp::stand_in::advance(1000000);
      ASSERT_TRUE(plant.step(command_, {Vector3d(0.3, 0.6, 0.0), Vector3d::Zero()}, 1e-3));
    }
  }

  // What MissionSensors tells.
  void on_imu(double time, const tilt_ropter::InertialSample<>& sample) {
    sensor_msgs::msg::Imu m;
    m.header = header(time);
    const Vector3d &w = sample.angular_velocity, &f = sample.specific_force;
    m.angular_velocity = {w.x(), w.y(), w.z()};
    m.linear_acceleration = {f.x(), f.y(), f.z()};
    imu_->publish(m);
  }
  void on_pose(double time, const tilt_ropter::MarkerPose<>& pose) {
    geometry_msgs::msg::PoseStamped m;
    m.header = header(time);
    m.pose.position = {pose.position.x(), pose.position.y(), pose.position.z()};
    const Quaterniond& q = pose.orientation;
    m.pose.orientation = {q.x(), q.y(), q.z(), q.w()};
    pose_->publish(m);
  }
  void on_rotor_speeds(const Eigen::Vector4d& speeds) {
    sensor_msgs::msg::JointState m;
    m.velocity.assign(speeds.data(), speeds.data() + 4);
    speeds_->publish(m);
  }

  Plant<4> plant{heavy_vehicle()};
  bool sensing = true;
  int commands = 0;
  double stamp = 0.0;

 private:
  static std_msgs::msg::Header header(double time) {
    std_msgs::msg::Header h;
    const auto nanoseconds = static_cast<std::int64_t>(std::llround(1e9 * time));
    h.stamp.sec = static_cast<std::int32_t>(1700000000 + nanoseconds / 1000000000);
    h.stamp.nanosec = static_cast<std::uint32_t>(nanoseconds % 1000000000);
    return h;
  }

  rclcpp::Node node_{"vehicle"};
  rclcpp::Publisher<sensor_msgs::msg::Imu>::SharedPtr imu_ =
      node_.create_publisher<sensor_msgs::msg::Imu>("imu", 1);
  rclcpp::Publisher<geometry_msgs::msg::PoseStamped>::SharedPtr pose_ =
      node_.create_publisher<geometry_msgs::msg::PoseStamped>("pose", 1);
  rclcpp::Publisher<sensor_msgs::msg::JointState>::SharedPtr speeds_ =
      node_.create_publisher<sensor_msgs::msg::JointState>("rotor_speeds", 1);
  rclcpp::Subscription<actuator_msgs::msg::Actuators>::SharedPtr subscription_;
  examples::MissionSensors<4> sensors_{5};
  tilt_ropter::ActuatorState<4> command_;
};

TEST(Ros2Node, HoversWhereItsParametersSay) {
  Ros2Vehicle vehicle;
  const Ros2Node node(rclcpp::NodeOptions().parameter_overrides(
      {{"hover_x", 0.5}, {"hover_y", -0.3}, {"hover_z", 1.2}, {"hover_yaw", 0.4}}));
  vehicle.fly(6.0);
  for (int i = 0; i < 20; ++i) {
    vehicle.fly(0.1);
    EXPECT_LT((vehicle.plant.body().position - Vector3d(0.5, -0.3, 1.2)).norm(), 0.02);
    EXPECT_NEAR(tilt_ropter::yaw_of(vehicle.plant.body().orientation), 0.4, 0.02);
  }
  EXPECT_GE(vehicle.commands, 790);  // from the first pose on, at 100 Hz
  EXPECT_NEAR(vehicle.stamp, 1700000008.0, 1e-6);
}

TEST(Ros2Node, SaysNothingBeforeTheFirstPoseAndWhereTheImuIsSilent) {
  Ros2Vehicle vehicle;
  const Ros2Node node;
  vehicle.sensing = false;
  vehicle.fly(0.5);
  EXPECT_EQ(vehicle.commands, 0);
  vehicle.sensing = true;
  vehicle.fly(0.5);
  EXPECT_GE(vehicle.commands, 45);
  vehicle.sensing = false;
  vehicle.fly(0.15);
  const int before = vehicle.commands;
  vehicle.fly(0.2);
  EXPECT_EQ(vehicle.commands, before);
  EXPECT_NEAR(before, 58, 3);  // it went on for 0.1 s
  vehicle.sensing = true;
  vehicle.fly(0.1);
  EXPECT_GE(vehicle.commands, before + 8);
}

TEST(Ros2Node, ParametersOutOfRangeAreRefused) {
  EXPECT_THROW(Ros2Node(rclcpp::NodeOptions().parameter_overrides(
                   {rclcpp::Parameter("vehicle", std::string("nowhere.json"))})),
               examples::VehicleFileError);
  EXPECT_THROW(Px4Node(rclcpp::NodeOptions().parameter_overrides(
                   {rclcpp::Parameter("vehicle", std::string("nowhere.json"))})),
               examples::VehicleFileError);
  EXPECT_THROW(Ros2Node(rclcpp::NodeOptions().parameter_overrides({{"position_noise", -1.0}})),
               std::invalid_argument);
  EXPECT_THROW(Px4Node(rclcpp::NodeOptions().parameter_overrides({{"thrust_model_factor", 2.0}})),
               std::invalid_argument);
}

// ---- PX4

constexpr double thrust_model_factor = 0.3;
constexpr double origin_height = 0.07;

/// A vehicle with PX4 as far as the node can tell. It is written in NED and FRD by matrices,
/// apart from what the node uses.
class Px4Vehicle {
 public:
  Px4Vehicle() {
    using namespace px4_msgs::msg;
    rclcpp::stand_in::now = 5000000000LL;
    motors_ = node_.create_subscription<ActuatorMotors>(
        "/fmu/in/actuator_motors", 1, [this](const ActuatorMotors& m) {
          ++commands;
          last_motors = m;
          for (std::size_t i = 0; i < 4; ++i) {
            const double u = double(m.control[i]);
            ASSERT_TRUE(u >= 0.0 && u <= 1.0);
            const double thrust =
                12.0 * (thrust_model_factor * u * u + (1.0 - thrust_model_factor) * u);
            command_.rotor_speed(static_cast<int>(i)) = std::sqrt(thrust / 1.4e-6);
          }
        });
    servos_ = node_.create_subscription<ActuatorServos>(
        "/fmu/in/actuator_servos", 1, [this](const ActuatorServos& m) {
          last_servos = m;
          for (std::size_t i = 0; i < 4; ++i)
            command_.tilt_angle(static_cast<int>(i)) = pi * double(m.control[i]);
        });
    mode_ = node_.create_subscription<OffboardControlMode>(
        "/fmu/in/offboard_control_mode", 1, [this](const OffboardControlMode& m) {
          EXPECT_TRUE(m.direct_actuator);
          EXPECT_FALSE(m.position || m.velocity || m.acceleration || m.attitude || m.body_rate ||
                       m.thrust_and_torque);
          ++heartbeats;
        });
  }

  void say(bool armed, bool offboard) {
    using Status = px4_msgs::msg::VehicleStatus;
    Status m;
    m.arming_state = armed ? Status::ARMING_STATE_ARMED : Status::ARMING_STATE_DISARMED;
    m.nav_state = offboard ? Status::NAVIGATION_STATE_OFFBOARD : Status::NAVIGATION_STATE_MANUAL;
    status_->publish(m);
    obeys_ = armed && offboard;
  }

  void fly(double seconds) {
    for (int i = 0; i < std::lround(1000.0 * seconds); ++i, ++tick_) {
      if (tick_ % 4 == 0) publish_sensors();
      if (tick_ % 5 == 0 && estimating) publish_odometry();
      rclcpp::stand_in::advance(1000000);
      tilt_ropter::Wrench<> wind;
      if (obeys_) wind.force << 0.3, 0.6, 0.0;  // it would roll away on the ground
      ASSERT_TRUE(plant.step(obeys_ ? command_ : tilt_ropter::ActuatorState<4>{}, wind, 1e-3));
    }
  }

  Plant<4> plant{heavy_vehicle()};
  bool estimating = true, velocity_in_body = false;
  int commands = 0, heartbeats = 0;
  px4_msgs::msg::ActuatorMotors last_motors;
  px4_msgs::msg::ActuatorServos last_servos;

 private:
  static std::uint64_t now_us() { return static_cast<std::uint64_t>(rclcpp::stand_in::now / 1000); }
  static std::array<float, 3> to_array(const Vector3d& v) {
    return {static_cast<float>(v.x()), static_cast<float>(v.y()), static_cast<float>(v.z())};
  }

  void publish_sensors() {
    px4_msgs::msg::SensorCombined m;
    m.timestamp = now_us();
    const Vector3d bias(0.05, -0.08, 0.1);
    m.gyro_rad = to_array(flu_to_frd_ * plant.body().angular_velocity);
    m.accelerometer_m_s2 = to_array(flu_to_frd_ * (plant.specific_force() + bias));
    sensors_->publish(m);
  }

  void publish_odometry() {
    using Odometry = px4_msgs::msg::VehicleOdometry;
    Odometry m;
    m.timestamp = m.timestamp_sample = now_us();
    const tilt_ropter::BodyState<>& body = plant.body();
    const Matrix3d to_ned = enu_to_ned_ * body.orientation.toRotationMatrix() * flu_to_frd_;
    const Quaterniond q(to_ned);
    const Vector3d velocity = enu_to_ned_ * body.velocity;
    m.pose_frame = Odometry::POSE_FRAME_NED;
    m.position = to_array(enu_to_ned_ * (body.position - Vector3d(0, 0, origin_height)));
    m.q = {static_cast<float>(q.w()), static_cast<float>(q.x()), static_cast<float>(q.y()),
           static_cast<float>(q.z())};
    m.velocity_frame =
        velocity_in_body ? Odometry::VELOCITY_FRAME_BODY_FRD : Odometry::VELOCITY_FRAME_NED;
    m.velocity = to_array(velocity_in_body ? Vector3d(to_ned.transpose() * velocity) : velocity);
    m.angular_velocity = to_array(flu_to_frd_ * body.angular_velocity);
    odometry_->publish(m);
  }

  const Matrix3d enu_to_ned_ = (Matrix3d() << 0, 1, 0, 1, 0, 0, 0, 0, -1).finished();
  const Matrix3d flu_to_frd_ = Vector3d(1, -1, -1).asDiagonal();
  rclcpp::Node node_{"px4"};
  rclcpp::Publisher<px4_msgs::msg::SensorCombined>::SharedPtr sensors_ =
      node_.create_publisher<px4_msgs::msg::SensorCombined>("/fmu/out/sensor_combined", 1);
  rclcpp::Publisher<px4_msgs::msg::VehicleOdometry>::SharedPtr odometry_ =
      node_.create_publisher<px4_msgs::msg::VehicleOdometry>("/fmu/out/vehicle_odometry", 1);
  rclcpp::Publisher<px4_msgs::msg::VehicleStatus>::SharedPtr status_ =
      node_.create_publisher<px4_msgs::msg::VehicleStatus>("/fmu/out/vehicle_status", 1);
  rclcpp::Subscription<px4_msgs::msg::ActuatorMotors>::SharedPtr motors_;
  rclcpp::Subscription<px4_msgs::msg::ActuatorServos>::SharedPtr servos_;
  rclcpp::Subscription<px4_msgs::msg::OffboardControlMode>::SharedPtr mode_;
  tilt_ropter::ActuatorState<4> command_;
  long tick_ = 0;
  bool obeys_ = false;
};

rclcpp::NodeOptions px4_options() {
  return rclcpp::NodeOptions().parameter_overrides({{"origin_height", origin_height},
                                                    {"thrust_model_factor", thrust_model_factor},
                                                    {"hover_x", 0.3},
                                                    {"hover_y", 0.6},
                                                    {"hover_yaw", -0.5}});
}

TEST(Px4Node, HoversInPx4sAxes) {
  for (const bool velocity_in_body : {false, true}) {
    Px4Vehicle vehicle;
    vehicle.velocity_in_body = velocity_in_body;
    const Px4Node node(px4_options());
    vehicle.say(false, false);
    vehicle.fly(2.0);
    EXPECT_EQ(vehicle.commands, 0);
    EXPECT_GE(vehicle.heartbeats, 195);  // PX4 lets us in for these
    vehicle.say(true, true);
    vehicle.fly(6.0);
    for (int i = 0; i < 20; ++i) {
      vehicle.fly(0.1);
      EXPECT_LT((vehicle.plant.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.02);
      EXPECT_NEAR(tilt_ropter::yaw_of(vehicle.plant.body().orientation), -0.5, 0.02);
    }
    EXPECT_NEAR(vehicle.commands, 800, 2);
    // In hover: the wind, and the weight that is not believed in. The bias has been calibrated.
    EXPECT_LT((node.external().force - Vector3d(0.3, 0.6, -0.03 * 1.5 * 9.81)).norm(), 0.1);
  }
}

TEST(Px4Node, SpareChannelsAreDisarmedAndStampsArePx4s) {
  Px4Vehicle vehicle;
  const Px4Node node(px4_options());
  vehicle.say(false, true);
  vehicle.fly(0.1);
  vehicle.say(true, true);
  vehicle.fly(0.1);
  EXPECT_EQ(vehicle.last_motors.timestamp, 5200000U);
  EXPECT_EQ(vehicle.last_motors.timestamp_sample, 5195000U);
  EXPECT_EQ(vehicle.last_servos.timestamp, 5200000U);
  for (std::size_t i = 0; i < 12; ++i)
    EXPECT_EQ(std::isnan(vehicle.last_motors.control[i]), i >= 4);
  for (std::size_t i = 0; i < 8; ++i) EXPECT_EQ(std::isnan(vehicle.last_servos.control[i]), i >= 4);
}

TEST(Px4Node, MovesNothingWhileSomebodyElseFlies) {
  Px4Vehicle vehicle;
  const Px4Node node(px4_options());
  vehicle.fly(0.2);  // no status yet
  vehicle.say(true, false);
  vehicle.fly(0.2);
  EXPECT_EQ(vehicle.commands, 0);
  vehicle.say(true, true);
  vehicle.fly(0.2);
  EXPECT_NEAR(vehicle.commands, 20, 1);
  vehicle.say(true, false);
  vehicle.fly(0.2);
  EXPECT_NEAR(vehicle.commands, 20, 1);
}

TEST(Px4Node, WithoutOdometryItGoesOnForAWhileAndThenFallsSilent) {
  Px4Vehicle vehicle;
  const Px4Node node(px4_options());
  vehicle.say(false, false);
  vehicle.fly(2.0);
  vehicle.say(true, true);
  vehicle.fly(6.0);
  vehicle.estimating = false;
  vehicle.fly(0.9);
  EXPECT_NEAR(vehicle.commands, 690, 3);
  EXPECT_LT((vehicle.plant.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.3);
  vehicle.fly(0.2);
  const int commands = vehicle.commands, heartbeats = vehicle.heartbeats;
  EXPECT_NEAR(commands, 700, 3);
  vehicle.fly(0.1);
  EXPECT_EQ(vehicle.commands, commands);
  EXPECT_EQ(vehicle.heartbeats, heartbeats);
}

TEST(Px4Messages, OdometryThatPx4DoesNotKnowIsRefused) {
  using Odometry = px4_msgs::msg::VehicleOdometry;
  Odometry good;
  good.pose_frame = Odometry::POSE_FRAME_NED;
  good.velocity_frame = Odometry::VELOCITY_FRAME_NED;
  good.position = {1.0F, 2.0F, -3.0F};
  good.q = {1.0F, 0.0F, 0.0F, 0.0F};
  const auto body = body_state(good, 0.5);
  ASSERT_TRUE(body.has_value());
  EXPECT_LT((body->position - Vector3d(2.0, 1.0, 3.5)).norm(), 1e-12);
  EXPECT_NEAR(tilt_ropter::yaw_of(body->orientation), pi / 2, 1e-12);  // north
  const auto refused = [&good](auto&& spoil) {
    Odometry m = good;
    spoil(m);
    return !body_state(m, 0.5).has_value();
  };
  EXPECT_TRUE(refused([](Odometry& m) { m.pose_frame = Odometry::POSE_FRAME_FRD; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.velocity_frame = Odometry::VELOCITY_FRAME_FRD; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.position[1] = nan_f; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.q[0] = nan_f; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.q = {}; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.velocity[2] = nan_f; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.angular_velocity[0] = nan_f; }));
}

// ---- The programs

TEST(RunNode, KnowsHelpAndRefusesOptionsThatAreNotRoss) {
  const auto run = [](std::vector<const char*> arguments) {
    arguments.insert(arguments.begin(), "node");
    testing::internal::CaptureStdout();
    testing::internal::CaptureStderr();
    const int code =
        run_node<Ros2Node>("node", ros2_help, static_cast<int>(arguments.size()), arguments.data());
    return std::to_string(code) + testing::internal::GetCapturedStdout() +
           testing::internal::GetCapturedStderr();
  };
  EXPECT_EQ(run({}), "0");
  const std::string help = run({"--help"});
  EXPECT_EQ(help[0], '0');
  EXPECT_NE(help.find("rotor_speeds"), std::string::npos);
  EXPECT_EQ(run({"--nonsense"})[0], '2');
  EXPECT_EQ(run({"nonsense"})[0], '2');
}

/// Sums of the columns of the histogram that rt_loop printed.
std::pair<long, long> histogram_counts(const std::string& output) {
  std::istringstream lines(output.substr(output.find("below_us")));
  std::pair<long, long> sums;
  std::string line;
  std::getline(lines, line);
  while (std::getline(lines, line)) {
    std::istringstream fields(line);
    std::string bound;
    long first = 0, second = 0;
    if (!(fields >> bound >> first >> second)) break;
    sums.first += first;
    sums.second += second;
  }
  return sums;
}

TEST(RtLoop, CountsEveryTick) {
  const test_support::Directory directory("loops");
  const auto flown = test_support::run(
      RT_LOOP_PROGRAM, "--rate 200 --seconds 1.5 --csv '" + directory.file("times.csv") + "'");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_EQ(flown["ticks"] + flown["skipped_ticks"], 300.0);
  EXPECT_GE(flown["missed_deadlines"], flown["skipped_ticks"]);
  const auto counts = histogram_counts(flown.output);
  EXPECT_EQ(static_cast<double>(counts.first), flown["ticks"]);
  EXPECT_EQ(static_cast<double>(counts.second), flown["ticks"]);
  for (const std::string name : {"wake_up", "computing"}) {
    double last = 0.0;
    for (const char* figure : {"_min_us", "_median_us", "_p99_us", "_p99_9_us", "_max_us"}) {
      EXPECT_GE(flown[name + figure], last) << name << figure;
      last = flown[name + figure];
    }
  }
  EXPECT_GT(flown["computing_min_us"], 1.0);
  const std::string csv = test_support::read_file(directory.file("times.csv"));
  EXPECT_EQ(csv.substr(0, csv.find('\n')), "wake_up_us,computing_us");
  EXPECT_EQ(static_cast<double>(std::count(csv.begin(), csv.end(), '\n')), flown["ticks"] + 1.0);
  if (flown.says("memory: locked") && !test_support::under_address_sanitizer()) {
    EXPECT_EQ(flown["page_faults_after_tick_10"], 0.0);
  }
}

TEST(RtLoop, HoversAndSaysWhatItCouldNotGet) {
  const auto flown =
      test_support::run(RT_LOOP_PROGRAM, "--rate 50 --seconds 4 --priority 0 --processor 1023");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_TRUE(flown.says("scheduling: as any program, no priority asked for")) << flown.output;
  EXPECT_TRUE(flown.says("processor: any, 1023 refused: ")) << flown.output;
  EXPECT_LT(flown["position_error_m"], 0.02);

  // Without permission, which root has to give up.
  const std::string without = geteuid() == 0 ? "setpriv --bounding-set -sys_nice,-ipc_lock " : "";
  const auto asked = test_support::run("/bin/sh", "-c 'ulimit -l 64; ulimit -r 0; exec " + without +
                                                      RT_LOOP_PROGRAM " --seconds 0.1'");
  EXPECT_EQ(asked.exit_code, 0) << asked.output;
  EXPECT_TRUE(asked.says("SCHED_FIFO refused: Operation not permitted")) << asked.output;
  if (!test_support::under_address_sanitizer()) {
    EXPECT_TRUE(asked.says("mlockall refused: ")) << asked.output;
  }
  EXPECT_EQ(asked["ticks"] + asked["skipped_ticks"], 10.0);
}

TEST(RtLoop, HelpAndWrongOptions) {
  const auto help = test_support::run(RT_LOOP_PROGRAM, "--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_TRUE(help.says("--processor"));
  for (const char* wrong : {"--rate 0", "--rate x", "--seconds -1", "--priority 100",
                            "--processor -1", "--nonsense", "nonsense"})
    EXPECT_GT(test_support::run(RT_LOOP_PROGRAM, wrong).exit_code, 100) << wrong;
  const auto unwritable =
      test_support::run(RT_LOOP_PROGRAM, "--seconds 0.1 --csv /nonexistent/times.csv");
  EXPECT_EQ(unwritable.exit_code, 1);
  EXPECT_TRUE(unwritable.says("rt_loop: cannot write /nonexistent/times.csv"));
}

}  // namespace
}  // namespace loops
