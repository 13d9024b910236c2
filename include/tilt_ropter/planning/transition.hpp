// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/detail/timing.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <string>

/// Motions from rest at one place to rest at another, in position and heading; take-off, landing.
namespace tilt_ropter {

/// Place at which the vehicle is at rest. The body is level with heading `yaw`.
struct Waypoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< CoM, world frame [m]
  double yaw = 0.0;                                    ///< heading about world z [rad]
};

/// Start, end and limits of a Transition.
struct TransitionSettings {
  Waypoint from;
  Waypoint to;
  /// Zero: the shortest duration within the limits. A given duration must not be shorter [s].
  double duration = 0.0;
  double max_speed = 1.0;             ///< limit [m/s]
  double max_acceleration = 1.0;      ///< limit [m/s^2]
  double max_yaw_rate = 1.0;          ///< limit [rad/s]
  double max_yaw_acceleration = 1.5;  ///< limit [rad/s^2]
};

inline void validate(const Waypoint& p, const std::string& field = "Waypoint") {
  require_finite(field + ".position [m]", p.position);
  require_finite(field + ".yaw [rad]", p.yaw);
}

inline void validate(const TransitionSettings& p) {
  validate(p.from, "TransitionSettings.from");
  validate(p.to, "TransitionSettings.to");
  require_in("TransitionSettings.duration [s]", p.duration, 0.0, 1e10);
  require_positive("TransitionSettings.max_speed [m/s]", p.max_speed);
  require_positive("TransitionSettings.max_acceleration [m/s^2]", p.max_acceleration);
  require_positive("TransitionSettings.max_yaw_rate [rad/s]", p.max_yaw_rate);
  require_positive("TransitionSettings.max_yaw_acceleration [rad/s^2]", p.max_yaw_acceleration);
}

/// Straight line from rest to rest, along s(x) = 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7 with
/// x = elapsed / duration. Velocity, acceleration and jerk are zero at both ends. The yaw follows
/// the same s along the shorter way. The duration is at least 1 ms, also between equal places.
class Transition : public detail::Timing {
 public:
  /// Throws std::invalid_argument if the settings are invalid or the duration violates a limit.
  explicit Transition(const TransitionSettings& settings = {}) : settings_(settings) {
    validate(settings);
    const Waypoint &from = settings.from, &to = settings.to;
    displacement_ = to.position - from.position;
    turn_ = yaw_of(quaternion_from_yaw(from.yaw).conjugate() * quaternion_from_yaw(to.yaw));

    // The peaks of s' and |s''|, at x = 1/2 and x = 1/2 +- 1/sqrt(20).
    const double peak_1 = 35.0 / 16.0, peak_2 = 84.0 / (5.0 * std::sqrt(5.0));
    const double distance = std::hypot(displacement_.x(), displacement_.y(), displacement_.z());
    const double shortest =
        std::max({1e-3, peak_1 * distance / settings.max_speed,
                  std::sqrt(peak_2 * distance / settings.max_acceleration),
                  peak_1 * std::abs(turn_) / settings.max_yaw_rate,
                  std::sqrt(peak_2 * std::abs(turn_) / settings.max_yaw_acceleration)});
    require_in("Transition's shortest duration within its limits [s]", shortest, 0.0, 1e10);
    const double duration = settings.duration > 0.0 ? settings.duration : shortest;
    require(duration >= shortest * (1.0 - 1e-9), "TransitionSettings.duration [s]", duration,
            "0 or >= " + std::to_string(shortest) + ", which the limits need");
    set_timing(0.0, duration);
  }

  /// Returns the reference at `time` [s], for every time, see Timing. The sign of the quaternion
  /// does not jump during the motion. Does not throw or allocate.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept {
    const double x = elapsed(time) / duration();
    const double hump = x * (1.0 - x);
    const double s = x * x * x * x * (35.0 - x * (84.0 - x * (70.0 - x * 20.0)));
    const double s_1 = 140.0 * hump * hump * hump / duration();
    const double s_2 = 420.0 * hump * hump * (1.0 - 2.0 * x) / (duration() * duration());

    ReferencePoint point;
    point.position = settings_.from.position + s * displacement_;
    point.velocity = s_1 * displacement_;
    point.acceleration = s_2 * displacement_;
    point.orientation = quaternion_from_yaw(settings_.from.yaw + s * turn_);
    point.angular_velocity.z() = s_1 * turn_;
    point.angular_acceleration.z() = s_2 * turn_;
    return point;
  }

  [[nodiscard]] const TransitionSettings& settings() const noexcept { return settings_; }

 private:
  TransitionSettings settings_;
  Eigen::Vector3d displacement_;
  double turn_ = 0.0;  // yaw change along the shorter way [rad]
};

namespace detail {

inline Transition vertical(const Waypoint& from, double height, double max_speed,
                           double max_acceleration) {
  TransitionSettings p;
  p.from = p.to = from;
  p.to.position.z() = height;
  p.max_speed = max_speed;
  p.max_acceleration = max_acceleration;
  return Transition(p);
}

}  // namespace detail

/// Returns the motion straight up from `from` until the CoM is at the world height `height` [m].
/// `max_speed` [m/s] and `max_acceleration` [m/s^2] are the limits. Throws std::invalid_argument if
/// `height` is not above `from` or if a limit is invalid.
[[nodiscard]] inline Transition take_off(const Waypoint& from, double height,
                                         double max_speed = 0.8, double max_acceleration = 1.0) {
  validate(from, "take_off from");
  require(std::isfinite(height) && height > from.position.z(), "take_off height [m]", height,
          "finite and above from.position.z");
  return detail::vertical(from, height, max_speed, max_acceleration);
}

/// The same straight down: `height` is below `from`, on wheels the wheel radius above the ground.
/// The final descent is slow: with the defaults and from 1.5 m, the last 5 cm begin at 0.14 m/s.
[[nodiscard]] inline Transition landing(const Waypoint& from, double height, double max_speed = 0.5,
                                        double max_acceleration = 0.5) {
  validate(from, "landing from");
  require(std::isfinite(height) && height < from.position.z(), "landing height [m]", height,
          "finite and below from.position.z");
  return detail::vertical(from, height, max_speed, max_acceleration);
}

}  // namespace tilt_ropter
