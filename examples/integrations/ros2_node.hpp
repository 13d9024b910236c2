#pragma once

#include "../support/flight_controller.hpp"
#include "hover_point.hpp"
#include "vehicle_parameter.hpp"

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <actuator_msgs/msg/actuators.hpp>
#include <geometry_msgs/msg/pose_stamped.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/imu.hpp>
#include <sensor_msgs/msg/joint_state.hpp>

namespace loops {

inline constexpr const char* ros2_help =
    R"(ROS 2 node: state estimator, wrench observer, NMPC and allocation at 100 Hz.

Subscribes to  imu           sensor_msgs/Imu, in the body frame (FLU), any rate
               pose          geometry_msgs/PoseStamped, of the vehicle in the world (ENU)
               rotor_speeds  sensor_msgs/JointState, velocity [rad/s] of rotors 1 to 4
Publishes      actuators     actuator_msgs/Actuators, velocity [rad/s] and position [rad] of
                             rotors 1 to 4 and their servos

Parameters (--ros-args -p NAME:=VALUE): vehicle, the path of its JSON file; position_noise [m],
orientation_noise [rad], pose_clock_offset [s], hover_x, hover_y, hover_z [m], hover_yaw [rad],
max_silence [s].

The node flies as soon as it has a pose. If the IMU is silent for max_silence, the node publishes
nothing, and the time-out of the motors ends the flight.)";

/// The onboard control loop as a ROS 2 node. All times are from the stamps of messages. The stamps
/// and the clock of the node must be the same clock (use_sim_time in a simulator).
class Ros2Node : public rclcpp::Node {
 public:
  /// Throws std::invalid_argument for parameters out of range.
  explicit Ros2Node(const rclcpp::NodeOptions& options = rclcpp::NodeOptions())
      : Node("tilt_ropter", options),
        vehicle_(vehicle_parameter(*this)),
        controller_(examples::quadrotor(vehicle_), vehicle_.settings(), estimation(*this)),
        reference_(*this),
        max_silence_(declare_parameter("max_silence", 0.1)) {
    const rclcpp::SensorDataQoS qos;
    imu_subscription_ = create_subscription<sensor_msgs::msg::Imu>(
        "imu", qos, [this](const sensor_msgs::msg::Imu& m) { on_imu(m); });
    pose_subscription_ = create_subscription<geometry_msgs::msg::PoseStamped>(
        "pose", qos, [this](const geometry_msgs::msg::PoseStamped& m) { on_pose(m); });
    speed_subscription_ = create_subscription<sensor_msgs::msg::JointState>(
        "rotor_speeds", qos, [this](const sensor_msgs::msg::JointState& m) {
          if (m.velocity.size() == 4)
            controller_.on_rotor_speeds(Eigen::Map<const Eigen::Vector4d>(m.velocity.data()));
        });
    publisher_ = create_publisher<actuator_msgs::msg::Actuators>("actuators", 1);
    timer_ = rclcpp::create_timer(this, get_clock(), rclcpp::Duration::from_seconds(0.01),
                                  [this] { tick(); });
  }

 private:
  template <typename Header>
  static double seconds(const Header& header) {
    return header.stamp.sec + 1e-9 * header.stamp.nanosec;
  }

  static tilt_ropter::EkfSettings estimation(Node& node) {
    tilt_ropter::EkfSettings s;
    s.pose_noise = {node.declare_parameter("position_noise", 1e-3),
                    node.declare_parameter("orientation_noise", 3e-3)};
    s.clock_offset = node.declare_parameter("pose_clock_offset", 0.0);
    return s;
  }

  void on_imu(const sensor_msgs::msg::Imu& m) {
    const auto& w = m.angular_velocity;
    const auto& f = m.linear_acceleration;  // ROS reports the specific force: 9.81 upward at rest
    controller_.on_imu(seconds(m.header), {{w.x, w.y, w.z}, {f.x, f.y, f.z}});
  }

  void on_pose(const geometry_msgs::msg::PoseStamped& m) {
    const auto& p = m.pose.position;
    const auto& q = m.pose.orientation;
    controller_.on_pose(seconds(m.header), {{p.x, p.y, p.z}, {q.w, q.x, q.y, q.z}});
  }

  void tick() {
    const rclcpp::Time now = this->now();
    if (!controller_.started()) return;
    const bool was_silent = silent_;
    silent_ = !(now.seconds() - controller_.ekf().time() <= max_silence_);
    if (silent_ && !was_silent) RCLCPP_WARN(get_logger(), "the IMU is silent");
    if (silent_) return;
    controller_.prepare(now.seconds(), [this](double time) { return reference_(time); });
    const tilt_ropter::ActuatorState<4>& command = controller_.control(now.seconds());
    actuator_msgs::msg::Actuators m;
    m.header.stamp.sec = static_cast<int>(now.nanoseconds() / 1000000000);
    m.header.stamp.nanosec = static_cast<unsigned>(now.nanoseconds() % 1000000000);
    m.velocity.assign(command.rotor_speed.data(), command.rotor_speed.data() + 4);
    m.position.assign(command.tilt_angle.data(), command.tilt_angle.data() + 4);
    publisher_->publish(m);
  }

  examples::VehicleFile vehicle_;
  examples::FlightController<4> controller_;
  HoverPoint reference_;
  double max_silence_;
  bool silent_ = false;
  rclcpp::Subscription<sensor_msgs::msg::Imu>::SharedPtr imu_subscription_;
  rclcpp::Subscription<geometry_msgs::msg::PoseStamped>::SharedPtr pose_subscription_;
  rclcpp::Subscription<sensor_msgs::msg::JointState>::SharedPtr speed_subscription_;
  rclcpp::Publisher<actuator_msgs::msg::Actuators>::SharedPtr publisher_;
  rclcpp::TimerBase::SharedPtr timer_;
};

}  // namespace loops
