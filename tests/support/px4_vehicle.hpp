#pragma once

#include "../../examples/integrations/px4_messages.hpp"
#include "heavy_vehicle.hpp"

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <utility>

namespace test_support {

/// A simulated vehicle, heavier than believed, that speaks in messages of PX4. It converts to NED
/// and FRD by matrices, independently of the code of the node. Its plant is `start` [ns] behind the
/// clock of the stamps.
template <int Rotors>
class AnyPx4Vehicle {
 public:
  static constexpr double thrust_model_factor = 0.3, origin_height = 0.07;

  explicit AnyPx4Vehicle(std::int64_t start_time, const tilt_ropter::Vehicle<Rotors>& believed =
                                                      tilt_ropter::tilt_ropter_vehicle())
      : start(start_time), plant(heavier(believed)), vehicle_(believed) {}

  /// Status is any version of VehicleStatus.
  template <typename Status = px4_msgs::msg::VehicleStatus>
  [[nodiscard]] Status status(bool armed, bool offboard) {
    Status m{};
    m.timestamp = now_us();
    m.arming_state = armed ? loops::arming_state_armed : loops::arming_state_disarmed;
    m.nav_state = offboard ? loops::nav_state_offboard : loops::nav_state_manual;
    m.nav_state_user_intention = m.nav_state;
    obeys_ = armed && offboard;
    return m;
  }

  /// Gives the messages of this millisecond to on_sensors and on_odometry of `node`: each at
  /// 100 Hz, as PX4 sends them.
  template <typename Node>
  void sense(Node& node) {
    const long tick = std::lround(1000.0 * plant.time());
    if (tick % 10 == 5) sensors_.emplace_back(plant.time() + delay, sensors());
    if (tick % 10 == 8 && estimating) odometry_.emplace_back(plant.time() + delay, odometry());
    if (tick % 1000 == 3 && voltage > 0.0) {
      px4_msgs::msg::BatteryStatus m{};
      m.timestamp = now_us();
      m.connected = true;
      m.voltage_v = static_cast<float>(voltage);
      node.on_battery(m);
    }
    for (; !sensors_.empty() && sensors_.front().first <= plant.time(); sensors_.pop_front())
      node.on_sensors(sensors_.front().second);
    for (; !odometry_.empty() && odometry_.front().first <= plant.time(); odometry_.pop_front())
      node.on_odometry(odometry_.front().second);
  }

  void on_mode(const px4_msgs::msg::OffboardControlMode& m) {
    ++heartbeats;
    if (!m.direct_actuator || m.position || m.velocity || m.acceleration || m.attitude ||
        m.body_rate || m.thrust_and_torque)
      ++wrong_modes;
  }
  void on_motors(const px4_msgs::msg::ActuatorMotors& m) {
    ++commands;
    last_motors = m;
    for (std::size_t i = 0; i < Rotors; ++i) {
      const tilt_ropter::RotorParameters& rotor = rotor_parameters(vehicle_, i);
      const double u = double(m.control[i]);
      if (!(u >= 0.0 && u <= 1.0)) ++wrong_outputs;
      const double ratio = voltage > 0.0 ? voltage / vehicle_.battery.nominal_voltage : 1.0,
                   duty = ratio * u;
      const double share = thrust_model_factor * duty * duty + (1.0 - thrust_model_factor) * duty;
      command_.rotor_speed(static_cast<int>(i)) =
          tilt_ropter::speed_from_thrust(rotor.max_thrust * share, rotor);
    }
  }
  /// For any version of ActuatorServos.
  template <typename Servos>
  void on_servos(const Servos& m) {
    ++servo_commands;
    const double low = vehicle_.servo.min_angle, high = vehicle_.servo.max_angle;
    std::size_t servo = 0;
    for (std::size_t i = 0; i < Rotors; ++i)
      if (vehicle_.rotors[i].tilts)
        command_.tilt_angle(static_cast<int>(i)) =
            low + (high - low) * 0.5 * (1.0 + double(m.control[servo++]));
  }

  /// Whether the vehicle obeys the commands of the node; otherwise it follows `by_another`.
  void obey(bool yes) { obeys_ = yes; }

  /// One millisecond.
  [[nodiscard]] bool step() {
    constexpr double most = 5e-4;  // of change: an accelerometer is wrong by 0.5 m/s^2
    velocity_error_ += (slide - velocity_error_).cwiseMax(-most).cwiseMin(most);
    estimate_step_ += 1e-3 * velocity_error_;
    stamps_late += 1e-3 * clock_drift;
    deviation += 1e-3 * deviation_rate;
    tilt_ropter::Wrenchd wind;
    if (obeys_) wind.force << 0.3, 0.6, 0.0;  // on the ground the wind would roll it away
    tilt_ropter::ActuatorState<Rotors> command = obeys_ ? command_ : by_another;
    if (stopped_rotor >= 0) command.rotor_speed(stopped_rotor) = 0.0;
    if (stuck_servo >= 0)
      command.tilt_angle(stuck_servo) = plant.actuators().tilt_angle(stuck_servo);
    return plant.step(command, wind, 1e-3);
  }
  [[nodiscard]] std::int64_t now() const {
    return start + static_cast<std::int64_t>(std::llround(1e9 * plant.time()));
  }

  /// The odometry of now.
  [[nodiscard]] px4_msgs::msg::VehicleOdometry odometry() const {
    px4_msgs::msg::VehicleOdometry m{};
    m.timestamp = m.timestamp_sample = now_us() - static_cast<std::uint64_t>(1e6 * stamps_late);
    m.reset_counter = resets_;
    tilt_ropter::BodyStated body = plant.body();
    body.position += estimate_step_;
    body.velocity += velocity_error_;
    body.orientation = tilt_ropter::quaternion_from_yaw(estimate_turn_) * body.orientation;
    const Eigen::Matrix3d to_ned = enu_to_ned_ * body.orientation.toRotationMatrix() * flu_to_frd_;
    const Eigen::Quaterniond q(to_ned);
    const Eigen::Vector3d velocity = enu_to_ned_ * body.velocity;
    m.pose_frame = loops::pose_frame_ned;
    set(m.position, enu_to_ned_ * (body.position - Eigen::Vector3d(0, 0, origin_height)));
    m.q[0] = static_cast<float>(q.w());
    m.q[1] = static_cast<float>(q.x());
    m.q[2] = static_cast<float>(q.y());
    m.q[3] = static_cast<float>(q.z());
    m.velocity_frame =
        velocity_in_body ? loops::velocity_frame_body_frd : loops::velocity_frame_ned;
    set(m.velocity, velocity_in_body ? Eigen::Vector3d(to_ned.transpose() * velocity) : velocity);
    set(m.angular_velocity, flu_to_frd_ * body.angular_velocity);
    // Of PX4's estimator with a receiver, in hover; its quality is always zero.
    set(m.position_variance, Eigen::Vector3d::Constant(0.01 + deviation * deviation));
    set(m.velocity_variance, Eigen::Vector3d::Constant(0.01));
    set(m.orientation_variance, Eigen::Vector3d(1e-4, 1e-4, 1e-3));
    return m;
  }

  /// PX4's estimator resets: positions and headings differ by so much from now on.
  void reset_estimate(const Eigen::Vector3d& step, double turn) {
    estimate_step_ += step;
    estimate_turn_ += turn;
    ++resets_;
  }

  /// PX4's estimator finds its velocity again.
  void reset_velocity() {
    velocity_error_.setZero();
    ++resets_;
  }

  /// How far the estimated position is from the true one.
  [[nodiscard]] const Eigen::Vector3d& position_error() const { return estimate_step_; }

  std::int64_t start;
  double stamps_late = 0.0;  ///< of the odometry [s]
  double clock_step = 0.0;   ///< of all stamps [s]
  double clock_drift = 0.0;  ///< by how much they get later [s/s]
  /// PX4 believes its inertial sensors, or its barometer, alone: soon its positions slide [m/s].
  Eigen::Vector3d slide = Eigen::Vector3d::Zero();
  double deviation = 0.0;       ///< PX4 says that its positions have it [m]; without: 0.1 m
  double deviation_rate = 0.0;  ///< by how much it grows without a receiver [m/s]
  double voltage = 0.0;  ///< of a battery that PX4 reports and that drives the motors [V]; 0: none
  double delay = 0.0;    ///< until odometry and sensors arrive [s]
  tilt_ropter::Plant<Rotors> plant;
  double clipping = 0.0;   ///< the accelerometer clips and reads so much along z [m/s^2]
  double vibration = 0.0;  ///< amplitude of the accelerometer's z at 97.3 Hz [m/s^2]
  int stopped_rotor = -1, stuck_servo = -1;  ///< that have failed, from 0 on
  bool estimating = true, velocity_in_body = false;
  int commands = 0, servo_commands = 0, heartbeats = 0, wrong_modes = 0, wrong_outputs = 0;
  px4_msgs::msg::ActuatorMotors last_motors{};
  tilt_ropter::ActuatorState<Rotors> by_another;  ///< while the node does not fly

 private:
  [[nodiscard]] std::uint64_t now_us() const {
    return static_cast<std::uint64_t>(now() / 1000 + std::llround(1e6 * clock_step));
  }
  static void set(float (&field)[3], const Eigen::Vector3d& v) {
    for (std::size_t i = 0; i < 3; ++i)
      field[i] = static_cast<float>(v(static_cast<Eigen::Index>(i)));
  }

  [[nodiscard]] px4_msgs::msg::SensorCombined sensors() const {
    px4_msgs::msg::SensorCombined m{};
    m.timestamp = now_us();
    const Eigen::Vector3d bias(0.05, -0.08, 0.1);
    set(m.gyro_rad, flu_to_frd_ * plant.body().angular_velocity);
    set(m.accelerometer_m_s2, flu_to_frd_ * (plant.specific_force() + bias));
    m.accelerometer_m_s2[2] +=
        static_cast<float>(vibration * std::sin(2.0 * tilt_ropter::pi * 97.3 * plant.time()));
    if (clipping != 0.0) {
      m.accelerometer_clipping = 4;  // z
      m.accelerometer_m_s2[2] = static_cast<float>(clipping);
    }
    return m;
  }

  const Eigen::Matrix3d enu_to_ned_ = (Eigen::Matrix3d() << 0, 1, 0, 1, 0, 0, 0, 0, -1).finished();
  const Eigen::Matrix3d flu_to_frd_ = Eigen::Vector3d(1, -1, -1).asDiagonal();
  tilt_ropter::Vehicle<Rotors> vehicle_;
  tilt_ropter::ActuatorState<Rotors> command_;
  std::deque<std::pair<double, px4_msgs::msg::SensorCombined>> sensors_;  // on their way
  std::deque<std::pair<double, px4_msgs::msg::VehicleOdometry>> odometry_;
  Eigen::Vector3d estimate_step_ = Eigen::Vector3d::Zero(),
                  velocity_error_ = Eigen::Vector3d::Zero();
  double estimate_turn_ = 0.0;
  std::uint8_t resets_ = 0;
  bool obeys_ = false;
};
using Px4Vehicle = AnyPx4Vehicle<4>;

}  // namespace test_support
