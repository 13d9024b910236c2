// The PX4 node in flight, connected by messages to a simulated vehicle.

#include "../../examples/integrations/px4_node.hpp"
#include "support/heavy_vehicle.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/wrench.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

namespace loops {
namespace {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;
using test_support::heavy_vehicle;
using tilt_ropter::pi;
using tilt_ropter::Plant;

constexpr float nan_f = std::numeric_limits<float>::quiet_NaN();
constexpr double thrust_model_factor = 0.3;
constexpr double origin_height = 0.07;

/// A vehicle with the PX4 messages that the node uses. It converts to NED and FRD by matrices,
/// independently of the code of the node.
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
      tilt_ropter::Wrenchd wind;
      if (obeys_) wind.force << 0.3, 0.6, 0.0;  // on the ground the wind would roll it away
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
    const tilt_ropter::BodyStated& body = plant.body();
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

TEST(Px4Node, HoversInNedAndFrdAxes) {
  for (const bool velocity_in_body : {false, true}) {
    Px4Vehicle vehicle;
    vehicle.velocity_in_body = velocity_in_body;
    const Px4Node node(px4_options());
    vehicle.say(false, false);
    vehicle.fly(2.0);
    EXPECT_EQ(vehicle.commands, 0);
    EXPECT_GE(vehicle.heartbeats, 195);  // PX4 requires these for offboard mode
    vehicle.say(true, true);
    vehicle.fly(6.0);
    for (int i = 0; i < 20; ++i) {
      vehicle.fly(0.1);
      EXPECT_LT((vehicle.plant.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.02);
      EXPECT_NEAR(tilt_ropter::yaw_of(vehicle.plant.body().orientation), -0.5, 0.02);
    }
    EXPECT_NEAR(vehicle.commands, 800, 2);
    // In hover, the external force is the wind and the weight that the node does not know. The
    // accelerometer bias has been calibrated.
    EXPECT_LT((node.external().force - Vector3d(0.3, 0.6, -0.03 * 1.5 * 9.81)).norm(), 0.1);
  }
}

TEST(Px4Node, SpareChannelsAreNanAndStampsAreThoseOfPx4) {
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

TEST(Px4Node, SendsNoCommandsUnlessArmedAndOffboard) {
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

TEST(Px4Node, StopsSendingOneSecondAfterOdometryIsLost) {
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

TEST(Px4Messages, RejectsInvalidOdometry) {
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

}  // namespace
}  // namespace loops
