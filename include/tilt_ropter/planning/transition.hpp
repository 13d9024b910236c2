// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <string>

/// From rest at one place to rest at another: changes of place and heading, take-off and landing.
namespace tilt_ropter {

/// A place to be at rest: level, heading along `yaw`.
struct Waypoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< CoM, world frame [m]
  double yaw = 0.0;                                    ///< about world z [rad]
};

/// From where to where, and how fast at most.
struct TransitionParameters {
  Waypoint from;
  Waypoint to;
  double start_time = 0.0;  ///< [s]
  double duration = 0.0;    ///< 0: the shortest within the limits; else no shorter than that [s]
  double max_speed = 1.0;   ///< [m/s]
  double max_acceleration = 1.0;      ///< [m/s^2]
  double max_yaw_rate = 1.0;          ///< [rad/s]
  double max_yaw_acceleration = 1.5;  ///< [rad/s^2]
};

inline void validate(const Waypoint& p, const std::string& field = "Waypoint") {
  require_finite(field + ".position [m]", p.position);
  require_finite(field + ".yaw [rad]", p.yaw);
}

/// Throws std::invalid_argument naming the field, its value and what is allowed.
inline void validate(const TransitionParameters& p) {
  validate(p.from, "TransitionParameters.from");
  validate(p.to, "TransitionParameters.to");
  require_time("TransitionParameters.start_time [s]", p.start_time);
  require_in("TransitionParameters.duration [s]", p.duration, 0.0, 1e10);
  require_positive("TransitionParameters.max_speed [m/s]", p.max_speed);
  require_positive("TransitionParameters.max_acceleration [m/s^2]", p.max_acceleration);
  require_positive("TransitionParameters.max_yaw_rate [rad/s]", p.max_yaw_rate);
  require_positive("TransitionParameters.max_yaw_acceleration [rad/s^2]", p.max_yaw_acceleration);
}

/// A straight line from rest to rest, along s(x) = 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7 with
/// x = elapsed / duration: velocity, acceleration and jerk are zero at both ends. The yaw goes the
/// shorter way, along the same s. It lasts at least 1 ms, even between equal places.
class Transition {
 public:
  /// Throws std::invalid_argument on bad parameters, and if the given duration breaks a limit.
  explicit Transition(const TransitionParameters& parameters = {})
      : parameters_(parameters), duration_(parameters.duration) {
    validate(parameters);
    const Waypoint &from = parameters.from, &to = parameters.to;
    displacement_ = to.position - from.position;
    turn_ = yaw_of(quaternion_from_yaw(from.yaw).conjugate() * quaternion_from_yaw(to.yaw));

    // The peaks of s' and |s''|, at x = 1/2 and x = 1/2 +- 1/sqrt(20).
    const double peak_1 = 35.0 / 16.0, peak_2 = 84.0 / (5.0 * std::sqrt(5.0));
    const double distance = std::hypot(displacement_.x(), displacement_.y(), displacement_.z());
    const double shortest =
        std::max({1e-3, peak_1 * distance / parameters.max_speed,
                  std::sqrt(peak_2 * distance / parameters.max_acceleration),
                  peak_1 * std::abs(turn_) / parameters.max_yaw_rate,
                  std::sqrt(peak_2 * std::abs(turn_) / parameters.max_yaw_acceleration)});
    require_in("Transition's shortest duration within its limits [s]", shortest, 0.0, 1e10);
    if (!(duration_ > 0.0)) duration_ = shortest;
    require(duration_ >= shortest * (1.0 - 1e-9), "TransitionParameters.duration [s]", duration_,
            "0 or >= " + std::to_string(shortest) + ", which the limits need");
  }

  /// Defined for every time [s]; at rest before the start and after the end, a NaN counts as
  /// before. The sign of the quaternion does not jump on the way. Does not throw or allocate.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept {
    const double elapsed = time - parameters_.start_time;
    const double x = elapsed > 0.0 ? std::min(elapsed / duration_, 1.0) : 0.0;
    const double hump = x * (1.0 - x);
    const double s = x * x * x * x * (35.0 - x * (84.0 - x * (70.0 - x * 20.0)));
    const double s_1 = 140.0 * hump * hump * hump / duration_;
    const double s_2 = 420.0 * hump * hump * (1.0 - 2.0 * x) / (duration_ * duration_);

    ReferencePoint point;
    point.position = parameters_.from.position + s * displacement_;
    point.velocity = s_1 * displacement_;
    point.acceleration = s_2 * displacement_;
    point.orientation = quaternion_from_yaw(parameters_.from.yaw + s * turn_);
    point.angular_velocity.z() = s_1 * turn_;
    point.angular_acceleration.z() = s_2 * turn_;
    return point;
  }

  [[nodiscard]] double start_time() const noexcept { return parameters_.start_time; }
  [[nodiscard]] double end_time() const noexcept { return parameters_.start_time + duration_; }
  [[nodiscard]] double duration() const noexcept { return duration_; }
  [[nodiscard]] const TransitionParameters& parameters() const noexcept { return parameters_; }

  /// Moves the whole motion in time. Throws std::invalid_argument for a time out of range.
  void set_start_time(double time) {
    require_time("Transition.start_time [s]", time);
    parameters_.start_time = time;
  }

 private:
  TransitionParameters parameters_;
  Eigen::Vector3d displacement_;
  double turn_ = 0.0;  // the shorter way from one yaw to the other [rad]
  double duration_ = 0.0;
};

/// Straight up from `from` until the CoM is at the world height `height` [m]. Throws
/// std::invalid_argument unless that is higher, and on bad limits ([m/s], [m/s^2]).
[[nodiscard]] inline Transition take_off(const Waypoint& from, double height,
                                         double max_speed = 0.8, double max_acceleration = 1.0) {
  validate(from, "take_off from");
  require(std::isfinite(height) && height > from.position.z(), "take_off height [m]", height,
          "finite and above from.position.z");
  TransitionParameters p;
  p.from = p.to = from;
  p.to.position.z() = height;
  p.max_speed = max_speed;
  p.max_acceleration = max_acceleration;
  return Transition(p);
}

/// Straight down from `from` until the CoM is at the world height `height` [m]: on the ground, the
/// wheel radius above it. The last metres are slow: with the defaults and from 1.5 m, the last
/// 5 cm begin at 0.14 m/s. Throws std::invalid_argument unless `height` is lower, and on bad limits
/// ([m/s], [m/s^2]).
[[nodiscard]] inline Transition landing(const Waypoint& from, double height, double max_speed = 0.5,
                                        double max_acceleration = 0.5) {
  validate(from, "landing from");
  require(std::isfinite(height) && height < from.position.z(), "landing height [m]", height,
          "finite and below from.position.z");
  TransitionParameters p;
  p.from = p.to = from;
  p.to.position.z() = height;
  p.max_speed = max_speed;
  p.max_acceleration = max_acceleration;
  return Transition(p);
}

}  // namespace tilt_ropter
