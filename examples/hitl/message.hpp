#pragma once

#include "../integrations/messages.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

/// What the three programs of the hardware-in-the-loop simulation exchange: topics, and the
/// contents of their messages. Stamps are the time of the simulation, which begins at zero; the
/// mission begins `head_start` later.
namespace hitl {

inline constexpr double head_start = 3.0;  ///< on the ground, for all programs to connect [s]

struct Topic {
  const char* name;
  std::int64_t deadline;  ///< after this time without a message its sender is silent [ns]
  int depth;              ///< number of messages that a receiver keeps until it takes them
  double period = 0.0;    ///< between the stamps of all messages; 0 if they have none [s]

  [[nodiscard]] dds::Quality offered() const { return quality(true); }
  /// In lock step DDS watches no time.
  [[nodiscard]] dds::Quality requested(bool lock_step) const {
    return lock_step ? dds::Quality{false, depth} : quality(false);
  }

 private:
  [[nodiscard]] dds::Quality quality(bool reliable) const {
    constexpr std::int64_t lease = 500000000;
    return {reliable, depth, deadline, lease};
  }
};

inline constexpr std::int64_t millisecond = 1000000;  // [ns]
// From hitl_simulator, at 1 kHz; the pose at 100 Hz.
inline constexpr Topic imu_topic{"hitl/imu", 100 * millisecond, 200, 1e-3};
inline constexpr Topic rotor_speeds_topic{"hitl/rotor_speeds", 100 * millisecond, 200, 1e-3};
inline constexpr Topic pose_topic{"hitl/pose", 1000 * millisecond, 50, 1e-2};
// From hitl_onboard, at 100 Hz: what it controls at the wrench level, and at the actuator level.
inline constexpr Topic wrench_command_topic{"hitl/wrench_command", 50 * millisecond, 10};
inline constexpr Topic actuator_command_topic{"hitl/actuator_command", 50 * millisecond, 10};
// From hitl_flight_controller, at 500 Hz.
inline constexpr Topic actuators_topic{"hitl/actuators", 1000 * millisecond, 50};
// From hitl_simulator, true at the end of a flight; reliable.
inline constexpr const char* flight_over_topic = "hitl/flight_over";
// From hitl_onboard, the commanded wrench again, for rviz2.
inline constexpr const char* shown_wrench_topic = "hitl/wrench";

// Contents of the messages. `time` is the stamp [s].
struct Inertial {
  double time = 0.0;
  tilt_ropter::InertialSampled sample;
};
template <int Rotors>
struct RotorSpeeds {
  double time = 0.0;
  Eigen::Matrix<double, Rotors, 1> speed = Eigen::Matrix<double, Rotors, 1>::Zero();  ///< [rad/s]
};
struct Pose {
  double time = 0.0;
  tilt_ropter::MarkerPosed pose;
};
/// `time` is that of the IMU sample that led to the command.
struct WrenchCommand {
  double time = 0.0;
  tilt_ropter::Wrenchd wrench, rate;  ///< body frame
  bool on_ground = false;
};
/// The same for rotor speeds and tilt angles.
template <int Rotors>
struct ActuatorCommand {
  double time = 0.0;
  tilt_ropter::ActuatorState<Rotors> command;
};

namespace detail {

inline Eigen::Vector3d vector(const geometry_msgs::msg::Vector3& v) {
  return {v.x, v.y, v.z};
}
inline geometry_msgs::msg::Vector3 message(const Eigen::Vector3d& v) {
  return {v.x(), v.y(), v.z()};
}
inline tilt_ropter::Wrenchd wrench(const geometry_msgs::msg::Wrench& m) {
  return {vector(m.force), vector(m.torque)};
}
inline geometry_msgs::msg::Wrench message(const tilt_ropter::Wrenchd& w) {
  return {message(w.force), message(w.torque)};
}
template <int Rotors, typename Sequence>
std::optional<Eigen::Matrix<double, Rotors, 1>> of_rotors(const Sequence& sequence) {
  if (sequence._length != Rotors) return std::nullopt;
  const Eigen::Matrix<double, Rotors, 1> values =
      Eigen::Map<const Eigen::Matrix<double, Rotors, 1>>(sequence._buffer);
  return tilt_ropter::all_finite(values) ? std::optional(values) : std::nullopt;
}

}  // namespace detail

// decode() returns nothing for a message with a number that is not finite or for another number of
// rotors.

[[nodiscard]] inline std::optional<Inertial> decode(const sensor_msgs::msg::Imu& m) {
  const Inertial i{loops::seconds(m.header.stamp),
                   {detail::vector(m.angular_velocity), detail::vector(m.linear_acceleration)}};
  if (!i.sample.angular_velocity.allFinite() || !i.sample.specific_force.allFinite())
    return std::nullopt;
  return i;
}

template <int Rotors>
[[nodiscard]] std::optional<RotorSpeeds<Rotors>> decode(const sensor_msgs::msg::JointState& m) {
  const auto speed = detail::of_rotors<Rotors>(m.velocity);
  if (!speed) return std::nullopt;
  return RotorSpeeds<Rotors>{loops::seconds(m.header.stamp), *speed};
}

[[nodiscard]] inline std::optional<Pose> decode(const geometry_msgs::msg::PoseStamped& m) {
  const auto& p = m.pose.position;
  const auto& q = m.pose.orientation;
  const Pose pose{loops::seconds(m.header.stamp), {{p.x, p.y, p.z}, {q.w, q.x, q.y, q.z}}};
  if (!pose.pose.position.allFinite() || !pose.pose.orientation.coeffs().allFinite())
    return std::nullopt;
  return pose;
}

[[nodiscard]] inline std::optional<WrenchCommand> decode(
    const tilt_ropter_msgs::msg::WrenchCommand& m) {
  const WrenchCommand c{loops::seconds(m.header.stamp), detail::wrench(m.wrench),
                        detail::wrench(m.rate), m.on_ground};
  if (!tilt_ropter::is_finite(c.wrench) || !tilt_ropter::is_finite(c.rate)) return std::nullopt;
  return c;
}

template <int Rotors>
[[nodiscard]] std::optional<ActuatorCommand<Rotors>> decode(
    const actuator_msgs::msg::Actuators& m) {
  const auto speed = detail::of_rotors<Rotors>(m.velocity),
             angle = detail::of_rotors<Rotors>(m.position);
  if (!speed || !angle) return std::nullopt;
  return ActuatorCommand<Rotors>{loops::seconds(m.header.stamp), {*speed, *angle}};
}

/// The decode() of a message with or without a number of rotors, which is then above 0.
template <int Rotors, typename Message>
[[nodiscard]] auto content_of(const Message& m) {
  if constexpr (Rotors > 0)
    return decode<Rotors>(m);
  else
    return decode(m);
}

/// Makes messages. They refer to memory of this object and stay valid until the next call of the
/// same function.
class Encoder {
 public:
  [[nodiscard]] const sensor_msgs::msg::Imu& encode(const Inertial& i) {
    imu_.header = header(i.time, base_link_);
    imu_.orientation_covariance[0] = -1.0;  // not measured
    imu_.angular_velocity = detail::message(i.sample.angular_velocity);
    imu_.linear_acceleration = detail::message(i.sample.specific_force);
    return imu_;
  }
  template <int Rotors>
  [[nodiscard]] const sensor_msgs::msg::JointState& encode(const RotorSpeeds<Rotors>& r) {
    joints_.header = header(r.time, base_link_);
    while (names_.size() < Rotors) names_.push_back(loops::in_message(rotors_[names_.size()]));
    loops::refer_to(joints_.name, names_);
    fill(joints_.velocity, speeds_, r.speed);
    return joints_;
  }
  [[nodiscard]] const geometry_msgs::msg::PoseStamped& encode(const Pose& p) {
    const Eigen::Vector3d& r = p.pose.position;
    const Eigen::Quaterniond& q = p.pose.orientation;
    pose_.header = header(p.time, map_);
    pose_.pose = {{r.x(), r.y(), r.z()}, {q.x(), q.y(), q.z(), q.w()}};
    return pose_;
  }
  [[nodiscard]] const tilt_ropter_msgs::msg::WrenchCommand& encode(const WrenchCommand& c) {
    command_ = {header(c.time, base_link_), detail::message(c.wrench), detail::message(c.rate),
                c.on_ground};
    return command_;
  }
  [[nodiscard]] const geometry_msgs::msg::WrenchStamped& shown(const WrenchCommand& c) {
    shown_ = {header(c.time, base_link_), detail::message(c.wrench)};
    return shown_;
  }
  template <int Rotors>
  [[nodiscard]] const actuator_msgs::msg::Actuators& encode(const ActuatorCommand<Rotors>& c) {
    actuators_.header = header(c.time, base_link_);
    fill(actuators_.velocity, speeds_, c.command.rotor_speed);
    fill(actuators_.position, angles_, c.command.tilt_angle);
    return actuators_;
  }

 private:
  [[nodiscard]] static std_msgs::msg::Header header(double time, const std::string& frame) {
    return {loops::stamp(std::llround(1e9 * time)), loops::in_message(frame)};
  }
  template <typename Sequence, int Rotors>
  static void fill(Sequence& sequence, std::vector<double>& memory,
                   const Eigen::Matrix<double, Rotors, 1>& values) {
    memory.assign(values.data(), values.data() + values.size());
    loops::refer_to(sequence, memory);
  }

  const std::string base_link_ = "base_link", map_ = "map";
  const std::array<std::string, 8> rotors_{"rotor_1", "rotor_2", "rotor_3", "rotor_4",
                                           "rotor_5", "rotor_6", "rotor_7", "rotor_8"};
  std::vector<char*> names_;  // of the rotors of the vehicle
  std::vector<double> speeds_, angles_;
  sensor_msgs::msg::Imu imu_{};
  sensor_msgs::msg::JointState joints_{};
  geometry_msgs::msg::PoseStamped pose_{};
  tilt_ropter_msgs::msg::WrenchCommand command_{};
  geometry_msgs::msg::WrenchStamped shown_{};
  actuator_msgs::msg::Actuators actuators_{};
};

}  // namespace hitl
