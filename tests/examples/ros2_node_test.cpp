// The ROS 2 node in flight, connected by messages to a simulated vehicle.

#include "../../examples/integrations/ros2_node.hpp"
#include "../../examples/integrations/px4_node.hpp"
#include "../../examples/integrations/run_node.hpp"
#include "../../examples/support/mission_sensors.hpp"
#include "support/heavy_vehicle.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

namespace loops {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;
using test_support::heavy_vehicle;
using tilt_ropter::Plant;

/// A vehicle with the sensors of the mission. Its clock starts at a Unix time, like the ROS clock.
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

  // Called by MissionSensors.
  void on_imu(double time, const tilt_ropter::InertialSampled& sample) {
    sensor_msgs::msg::Imu m;
    m.header = header(time);
    const Vector3d &w = sample.angular_velocity, &f = sample.specific_force;
    m.angular_velocity = {w.x(), w.y(), w.z()};
    m.linear_acceleration = {f.x(), f.y(), f.z()};
    imu_->publish(m);
  }
  void on_pose(double time, const tilt_ropter::MarkerPosed& pose) {
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

TEST(Ros2Node, HoversAtThePointOfItsParameters) {
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

TEST(Ros2Node, SendsNothingBeforeFirstPoseOrWithoutImu) {
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
  EXPECT_NEAR(before, 58, 3);  // commands continued for 0.1 s
  vehicle.sensing = true;
  vehicle.fly(0.1);
  EXPECT_GE(vehicle.commands, before + 8);
}

TEST(Ros2Node, RejectsParametersOutOfRange) {
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

TEST(RunNode, PrintsHelpAndRejectsOptionsThatRosDoesNotKnow) {
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

}  // namespace
}  // namespace loops
