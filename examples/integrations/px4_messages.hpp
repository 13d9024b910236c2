#pragma once

#include "messages.hpp"
#include "parameters.hpp"

#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

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
/// if a standard deviation is above 1 m, 1 m/s or 30 degrees (that of an unknown heading), or if
/// the quality is that of a failure (-1).
[[nodiscard]] inline std::optional<tilt_ropter::BodyStated> body_state(
    const px4_msgs::msg::VehicleOdometry& m, double origin_height) {
  if (m.pose_frame != pose_frame_ned) return std::nullopt;
  const auto unsure = [](const float(&variance)[3], float most) {  // NaN: it is not told
    return std::any_of(variance, variance + 3, [most](float v) { return v > most; });
  };
  if (m.quality < 0 || unsure(m.position_variance, 1.0F) || unsure(m.velocity_variance, 1.0F) ||
      unsure(m.orientation_variance, 0.27F))
    return std::nullopt;
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

/// The channels of ActuatorMotors and ActuatorServos. Those that nobody uses are NaN (disarmed).
struct Px4Controls {
  std::array<float, 12> motor;
  std::array<float, 15> servo;
};

/// Which channels (from 1) rotors and tilt servos have, and how the servos are mounted.
template <int Rotors>
struct Px4Wiring {
  std::array<int, std::size_t(Rotors)> motor{};  ///< of each rotor
  std::array<int, std::size_t(Rotors)> servo{};  ///< of each rotor that tilts, otherwise 0
  tilt_ropter::ActuatorOutputSettings<Rotors> outputs;

  [[nodiscard]] Px4Controls controls(const tilt_ropter::ActuatorOutputs<Rotors>& of) const {
    Px4Controls c{};
    c.motor.fill(std::numeric_limits<float>::quiet_NaN());
    c.servo.fill(std::numeric_limits<float>::quiet_NaN());
    for (std::size_t i = 0; i < Rotors; ++i) {
      const auto k = static_cast<Eigen::Index>(i);
      c.motor[static_cast<std::size_t>(motor[i] - 1)] = static_cast<float>(of.motor(k));
      if (servo[i] > 0)
        c.servo[static_cast<std::size_t>(servo[i] - 1)] = static_cast<float>(of.servo(k));
    }
    return c;
  }
};

/// The wiring of the parameters `motor_channels`, `servo_channels`, `servo_trims`, each one number
/// for each motor or tilt servo with commas, `reversed_servos`, their numbers, and
/// `thrust_model_factor`. Without them: in the order of the rotors. Throws std::invalid_argument.
template <int Rotors>
[[nodiscard]] Px4Wiring<Rotors> px4_wiring(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                           Parameters& parameters) {
  Px4Wiring<Rotors> wiring;
  wiring.outputs.thrust_model_factor = parameters.number("thrust_model_factor", 0.0, 0.0, 1.0);
  std::vector<std::size_t> tilting;  // rotors, in the order of the servos
  for (std::size_t i = 0; i < Rotors; ++i)
    if (vehicle.rotors[i].tilts) tilting.push_back(i);
  const auto refuse = [](const std::string& name, const std::string& what) {
    throw std::invalid_argument(name + ": must be " + what);
  };
  // Numbers for all of `count`, or none.
  const auto list = [&](const std::string& name, std::size_t count) {
    std::vector<double> values = parameters.numbers(name);
    if (!values.empty() && values.size() != count)
      refuse(name, std::to_string(count) + " numbers, with commas");
    return values;
  };
  const auto channels = [&](const std::string& name, std::size_t count, std::size_t most) {
    std::vector<double> values = list(name, count);
    for (std::size_t i = 0; values.size() < count; ++i) values.push_back(double(i + 1));
    for (std::size_t i = 0; i < count; ++i)
      if (!(values[i] >= 1.0 && values[i] <= double(most)) || values[i] != std::floor(values[i]) ||
          std::count(values.begin(), values.end(), values[i]) > 1)
        refuse(name, "different whole numbers from 1 to " + std::to_string(most));
    return values;
  };
  const std::vector<double> motors = channels("motor_channels", Rotors, 12),
                            servos = channels("servo_channels", tilting.size(), 8),
                            trims = list("servo_trims", tilting.size());
  for (std::size_t i = 0; i < Rotors; ++i) wiring.motor[i] = static_cast<int>(motors[i]);
  for (std::size_t k = 0; k < tilting.size(); ++k) {
    wiring.servo[tilting[k]] = static_cast<int>(servos[k]);
    if (!trims.empty()) wiring.outputs.servos[tilting[k]].trim = trims[k];
  }
  for (const double number : parameters.numbers("reversed_servos")) {
    if (!(number >= 1.0 && number <= double(tilting.size())) || number != std::floor(number))
      refuse("reversed_servos", "numbers from 1 to " + std::to_string(tilting.size()));
    wiring.outputs.servos[tilting[static_cast<std::size_t>(number) - 1]].reversed = true;
  }
  return wiring;
}

/// Returns ActuatorMotors or a version of ActuatorServos with these channels. Times are in
/// microseconds of PX4: `now`, and `sample` for the measurement on which they are based.
template <typename Message, std::size_t Count>
[[nodiscard]] Message px4_controls(const std::array<float, Count>& channels, std::uint64_t now,
                                   std::uint64_t sample) {
  Message m{};
  m.timestamp = now;
  m.timestamp_sample = sample;
  std::copy_n(channels.begin(), std::min(Count, std::size(m.control)), std::begin(m.control));
  return m;
}

}  // namespace loops
