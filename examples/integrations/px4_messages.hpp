#pragma once

#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/model/ned.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <px4_msgs/msg/actuator_motors.hpp>
#include <px4_msgs/msg/actuator_servos.hpp>
#include <px4_msgs/msg/vehicle_odometry.hpp>

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>

/// Conversion between messages of PX4 and types of the library.
namespace loops {

[[nodiscard]] inline Eigen::Vector3d vector(const std::array<float, 3>& v) {
  return {double(v[0]), double(v[1]), double(v[2])};
}

/// Converts microseconds of PX4 to seconds.
[[nodiscard]] inline double seconds(std::uint64_t timestamp) {
  return 1e-6 * static_cast<double>(timestamp);
}

/// Returns the state of the body; `origin_height` [m] is the height of the PX4 origin above the
/// ground. Returns nothing if the pose is not in NED, or if the velocity is neither in NED nor in
/// the body frame. Returns nothing also if a number is NaN, which means that PX4 does not know it.
[[nodiscard]] inline std::optional<tilt_ropter::BodyStated> body_state(
    const px4_msgs::msg::VehicleOdometry& m, double origin_height) {
  using Odometry = px4_msgs::msg::VehicleOdometry;
  if (m.pose_frame != Odometry::POSE_FRAME_NED) return std::nullopt;
  tilt_ropter::NedBodyStated ned;
  ned.position = vector(m.position);
  ned.orientation = {double(m.q[0]), double(m.q[1]), double(m.q[2]), double(m.q[3])};
  ned.angular_velocity = vector(m.angular_velocity);
  if (m.velocity_frame == Odometry::VELOCITY_FRAME_NED)
    ned.velocity = vector(m.velocity);
  else if (m.velocity_frame == Odometry::VELOCITY_FRAME_BODY_FRD)
    ned.velocity = ned.orientation * vector(m.velocity);
  else
    return std::nullopt;
  tilt_ropter::BodyStated body = tilt_ropter::enu_from_ned(ned);
  body.position.z() += origin_height;
  if (!is_finite(body)) return std::nullopt;
  return body;
}

struct Px4Actuators {
  px4_msgs::msg::ActuatorMotors motors;
  px4_msgs::msg::ActuatorServos servos;
};

/// Sets motors 1 to 4 and servos 1 to 4; all others are NaN (disarmed). Times are in microseconds
/// of PX4: `now`, and `sample` for the measurement on which the outputs are based.
[[nodiscard]] inline Px4Actuators px4_actuators(const tilt_ropter::ActuatorOutputs<4>& outputs,
                                                std::uint64_t now, std::uint64_t sample) {
  Px4Actuators m;
  m.motors.timestamp = m.servos.timestamp = now;
  m.motors.timestamp_sample = m.servos.timestamp_sample = sample;
  m.motors.control.fill(std::numeric_limits<float>::quiet_NaN());
  m.servos.control.fill(std::numeric_limits<float>::quiet_NaN());
  for (std::size_t i = 0; i < 4; ++i) {
    m.motors.control[i] = static_cast<float>(outputs.motor(static_cast<Eigen::Index>(i)));
    m.servos.control[i] = static_cast<float>(outputs.servo(static_cast<Eigen::Index>(i)));
  }
  return m;
}

}  // namespace loops
