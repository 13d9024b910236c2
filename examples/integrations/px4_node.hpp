#pragma once

#include "hover_point.hpp"
#include "px4_messages.hpp"
#include "vehicle_parameter.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/ned.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/model/wrench.hpp>

#include <px4_msgs/msg/actuator_motors.hpp>
#include <px4_msgs/msg/actuator_servos.hpp>
#include <px4_msgs/msg/offboard_control_mode.hpp>
#include <px4_msgs/msg/sensor_combined.hpp>
#include <px4_msgs/msg/vehicle_odometry.hpp>
#include <px4_msgs/msg/vehicle_status.hpp>
#include <rclcpp/rclcpp.hpp>

#include <cstdint>
#include <optional>

namespace loops {

inline constexpr const char* px4_help =
    R"(PX4 offboard node: wrench observer, NMPC and allocation at 100 Hz, from PX4's own estimate to
its motors and servos.

Subscribes to  /fmu/out/vehicle_odometry, /fmu/out/sensor_combined, /fmu/out/vehicle_status
Publishes      /fmu/in/offboard_control_mode, /fmu/in/actuator_motors, /fmu/in/actuator_servos

Parameters (--ros-args -p NAME:=VALUE): vehicle, the path of its JSON file; origin_height [m] of
PX4's origin, which is where its estimator started, above the ground; thrust_model_factor, 0 if
PX4's THR_MDL_FAC is set for the motors; hover_x, hover_y, hover_z [m], hover_yaw [rad]; max_silence
[s].

Place the vehicle level and disarmed: the observer is calibrated until the vehicle is armed. Then arm
and switch to offboard mode. PX4 and the computer must share one clock (UXRCE_DDS_SYNCT). Without
odometry for max_silence the node follows its last plan; after ten times this time it publishes
nothing, and PX4 leaves offboard mode.)";

/// PX4 estimates the state; this node estimates the external wrench. PX4 does not report the rotor
/// speeds, so speeds and angles come from the actuator model.
class Px4Node : public rclcpp::Node {
 public:
  /// Throws std::invalid_argument for parameters out of range.
  explicit Px4Node(const rclcpp::NodeOptions& options = rclcpp::NodeOptions())
      : Node("tilt_ropter_px4", options),
        file_(vehicle_parameter(*this)),
        vehicle_(examples::quadrotor(file_)),
        scaling_(vehicle_, {declare_parameter("thrust_model_factor", 0.0), {}}),
        allocation_(vehicle_),
        actuators_(vehicle_),
        observer_(vehicle_.body),
        contact_(vehicle_),
        nmpc_(vehicle_, file_.settings()),
        reference_(*this),
        origin_height_(declare_parameter(
            "origin_height",
            undercarriage(vehicle_).value_or(tilt_ropter::Undercarriage{0.0}).height)),
        max_silence_(declare_parameter("max_silence", 0.1)) {
    using namespace px4_msgs::msg;
    const rclcpp::SensorDataQoS qos;
    odometry_subscription_ = create_subscription<VehicleOdometry>(
        "/fmu/out/vehicle_odometry", qos, [this](const VehicleOdometry& m) { on_odometry(m); });
    sensor_subscription_ = create_subscription<SensorCombined>(
        "/fmu/out/sensor_combined", qos, [this](const SensorCombined& m) { on_sensors(m); });
    status_subscription_ = create_subscription<VehicleStatus>(
        "/fmu/out/vehicle_status", qos, [this](const VehicleStatus& m) { on_status(m); });
    mode_publisher_ = create_publisher<OffboardControlMode>("/fmu/in/offboard_control_mode", 1);
    motor_publisher_ = create_publisher<ActuatorMotors>("/fmu/in/actuator_motors", 1);
    servo_publisher_ = create_publisher<ActuatorServos>("/fmu/in/actuator_servos", 1);
    timer_ = rclcpp::create_timer(this, get_clock(), rclcpp::Duration::from_seconds(0.01),
                                  [this] { tick(); });
  }

  [[nodiscard]] const tilt_ropter::Wrenchd& external() const { return observer_.external(); }

 private:
  enum class Pilot { somebody_else, nobody, this_node };

  void on_odometry(const px4_msgs::msg::VehicleOdometry& m) {
    const auto body = body_state(m, origin_height_);
    if (!body) return;
    body_ = body;
    sample_ = m.timestamp_sample;
  }

  void on_sensors(const px4_msgs::msg::SensorCombined& m) {
    if (pilot_ == Pilot::somebody_else) return;  // the state of the actuators is unknown
    const double time = seconds(m.timestamp);
    observer_.update(time,
                     {tilt_ropter::flu_from_frd(vector(m.gyro_rad)),
                      tilt_ropter::flu_from_frd(vector(m.accelerometer_m_s2))},
                     allocation_.wrench(actuators_.update(time, sent_.command)));
  }

  void on_status(const px4_msgs::msg::VehicleStatus& m) {
    using Status = px4_msgs::msg::VehicleStatus;
    const Pilot before = pilot_;
    const bool armed = m.arming_state == Status::ARMING_STATE_ARMED;
    const bool offboard = m.nav_state == Status::NAVIGATION_STATE_OFFBOARD;
    pilot_ = !armed ? Pilot::nobody : offboard ? Pilot::this_node : Pilot::somebody_else;
    if (pilot_ == before) return;
    if (pilot_ != Pilot::this_node) sent_ = {};
    if (pilot_ == Pilot::nobody) observer_.begin_calibration();
    if (before == Pilot::nobody && body_) {
      // The vehicle stands on the ground, which carries its weight.
      tilt_ropter::Wrenchd ground;
      ground.force.z() = vehicle_.body.mass * tilt_ropter::gravity;
      const auto status =
          observer_.end_calibration(tilt_ropter::wrench_in_body(ground, body_->orientation));
      if (status != tilt_ropter::CalibrationStatus::calibrated)
        RCLCPP_WARN(get_logger(), "the observer is not calibrated: moved, or armed too soon");
    }
  }

  void tick() {
    const auto now_us = static_cast<std::uint64_t>(now().nanoseconds() / 1000);
    const double time = seconds(now_us), silence = time - seconds(sample_);
    if (!body_ || silence > 10.0 * max_silence_) return;
    px4_msgs::msg::OffboardControlMode mode;
    mode.timestamp = now_us;
    mode.direct_actuator = true;
    // PX4 requires this message for some time before it accepts offboard control.
    mode_publisher_->publish(mode);
    if (pilot_ != Pilot::this_node) return;

    if (silence <= max_silence_) contact_.update(time, *body_, observer_);
    (void)nmpc_.prepare(time, reference_, contact_.estimate());
    const tilt_ropter::NmpcResult& result =
        silence <= max_silence_ ? nmpc_.feedback(time, *body_) : nmpc_.hold(time);
    sent_ = allocation_.allocate(time, result.wrench, result.rate, sent_);
    actuators_.update(time, sent_.command);  // takes effect now
    const auto outputs = scaling_.outputs(sent_.command);
    if (!outputs) return;
    const Px4Actuators m = px4_actuators(*outputs, now_us, sample_);
    motor_publisher_->publish(m.motors);
    servo_publisher_->publish(m.servos);
  }

  examples::VehicleFile file_;
  tilt_ropter::Vehicle<4> vehicle_;
  tilt_ropter::OutputScaling<4> scaling_;
  tilt_ropter::Allocation<4> allocation_;
  tilt_ropter::ActuatorModel<4> actuators_;
  tilt_ropter::WrenchObserverd observer_;
  tilt_ropter::ContactEstimator contact_;
  tilt_ropter::Nmpc<4> nmpc_;
  HoverPoint reference_;
  double origin_height_, max_silence_;
  std::optional<tilt_ropter::BodyStated> body_;  // last known state
  std::uint64_t sample_ = 0;                     // time of this state [us]
  tilt_ropter::AllocationResult<4> sent_;
  Pilot pilot_ = Pilot::somebody_else;
  rclcpp::Subscription<px4_msgs::msg::VehicleOdometry>::SharedPtr odometry_subscription_;
  rclcpp::Subscription<px4_msgs::msg::SensorCombined>::SharedPtr sensor_subscription_;
  rclcpp::Subscription<px4_msgs::msg::VehicleStatus>::SharedPtr status_subscription_;
  rclcpp::Publisher<px4_msgs::msg::OffboardControlMode>::SharedPtr mode_publisher_;
  rclcpp::Publisher<px4_msgs::msg::ActuatorMotors>::SharedPtr motor_publisher_;
  rclcpp::Publisher<px4_msgs::msg::ActuatorServos>::SharedPtr servo_publisher_;
  rclcpp::TimerBase::SharedPtr timer_;
};

}  // namespace loops
