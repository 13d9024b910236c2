#pragma once

#include "messages.hpp"

#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <limits>
#include <optional>

/// Conversion between messages of PX4 and types of the library.
namespace loops {

// Values of the fields with the same names.
inline constexpr std::uint8_t pose_frame_ned = 1, pose_frame_frd = 2;
inline constexpr std::uint8_t velocity_frame_ned = 1, velocity_frame_frd = 2,
                              velocity_frame_body_frd = 3;
inline constexpr std::uint8_t arming_state_disarmed = 1, arming_state_armed = 2;
inline constexpr std::uint8_t nav_state_manual = 0, nav_state_offboard = 14;

[[nodiscard]] inline Eigen::Vector3d vector(const float (&v)[3]) {
  return {double(v[0]), double(v[1]), double(v[2])};
}

/// Converts microseconds of PX4 to seconds.
[[nodiscard]] inline double seconds(std::uint64_t timestamp) {
  return 1e-6 * static_cast<double>(timestamp);
}

/// Returns the state of the body; `origin_height` [m] is the height of the PX4 origin above the
/// ground. Returns nothing if the pose is not in NED, or if the velocity is neither in NED nor in
/// the body frame. Returns nothing also if a number is NaN, which means that PX4 does not know it,
/// or if a position has a standard deviation above 1 m.
[[nodiscard]] inline std::optional<tilt_ropter::BodyStated> body_state(
    const px4_msgs::msg::VehicleOdometry& m, double origin_height) {
  if (m.pose_frame != pose_frame_ned) return std::nullopt;
  for (const float variance : m.position_variance)
    if (variance > 1.0F) return std::nullopt;
  tilt_ropter::NedBodyStated ned;
  ned.position = vector(m.position);
  ned.orientation = {double(m.q[0]), double(m.q[1]), double(m.q[2]), double(m.q[3])};
  ned.angular_velocity = vector(m.angular_velocity);
  if (m.velocity_frame == velocity_frame_ned)
    ned.velocity = vector(m.velocity);
  else if (m.velocity_frame == velocity_frame_body_frd)
    ned.velocity = ned.orientation * vector(m.velocity);
  else
    return std::nullopt;
  tilt_ropter::BodyStated body = tilt_ropter::enu_from_ned(ned);
  body.position.z() += origin_height;
  if (!is_finite(body)) return std::nullopt;
  return body;
}

/// Returns the thrust set point for a `force` of the rotors (body frame, forward-left-up) of at
/// most `largest` [N]. PX4's land detector needs it: without a thrust it takes a hover for a
/// landing.
[[nodiscard]] inline px4_msgs::msg::VehicleThrustSetpoint px4_thrust(const Eigen::Vector3d& force,
                                                                     double largest,
                                                                     std::uint64_t now,
                                                                     std::uint64_t sample) {
  px4_msgs::msg::VehicleThrustSetpoint m{};
  m.timestamp = now;
  m.timestamp_sample = sample;
  const Eigen::Vector3d frd = tilt_ropter::frd_from_flu(force) / largest;
  for (std::size_t i = 0; i < 3; ++i)
    m.xyz[i] = static_cast<float>(std::clamp(frd(static_cast<Eigen::Index>(i)), -1.0, 1.0));
  return m;
}

/// Returns ActuatorMotors or a version of ActuatorServos whose first channels are `outputs`. All
/// other channels are NaN (disarmed). Times are in microseconds of PX4: `now`, and `sample` for the
/// measurement on which the outputs are based.
template <typename Message, int Count>
[[nodiscard]] Message px4_controls(const Eigen::Matrix<double, Count, 1>& outputs,
                                   std::uint64_t now, std::uint64_t sample) {
  Message m{};
  m.timestamp = now;
  m.timestamp_sample = sample;
  std::fill(std::begin(m.control), std::end(m.control), std::numeric_limits<float>::quiet_NaN());
  static_assert(Count <= 8);  // ActuatorServos has no more
  for (std::size_t i = 0; i < Count; ++i)
    m.control[i] = static_cast<float>(outputs(static_cast<Eigen::Index>(i)));
  return m;
}

}  // namespace loops
