// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/vehicle.hpp>

#include <algorithm>
#include <cmath>
#include <limits>

/// Motor with propeller: thrust follows from the speed by the curve of RotorParameters, speed
/// follows its command with a first-order lag.
namespace tilt_ropter {

/// Thrust [N] at `speed` [rad/s], c Omega^2 + b Omega with the linear coefficient b; b = 0 is the
/// paper's law (paper, Sec. Control Allocation). Zero where that is negative, and for a speed that
/// is negative, not finite, or beyond 1e9 rad/s, which no sensor means.
template <typename Scalar>
[[nodiscard]] Scalar thrust_from_speed(const Scalar& speed, double thrust_coefficient,
                                       double linear_thrust_coefficient = 0.0) noexcept {
  if (!(speed > Scalar(0) && speed < Scalar(1e9))) return Scalar(0);
  const Scalar per_speed = Scalar(thrust_coefficient) * speed + Scalar(linear_thrust_coefficient);
  return per_speed > Scalar(0) ? Scalar(per_speed * speed) : Scalar(0);
}

/// Speed [rad/s] that gives `thrust` [N], (sqrt(b^2 + 4 c T) - b) / (2 c): sqrt(T / c) where b = 0.
/// For a thrust that is negative, zero (with derivative zero) or not finite: the speed at which the
/// thrust begins, -b / c where b is negative, else zero.
template <typename Scalar>
[[nodiscard]] Scalar speed_from_thrust(const Scalar& thrust, double thrust_coefficient,
                                       double linear_thrust_coefficient = 0.0) noexcept {
  using std::sqrt;
  if (!(thrust > Scalar(0) && thrust < Scalar(std::numeric_limits<double>::infinity())))
    return Scalar(std::max(0.0, -linear_thrust_coefficient / thrust_coefficient));
  const double root = std::sqrt(thrust_coefficient);
  if (!(std::abs(linear_thrust_coefficient) > 0.0)) return sqrt(thrust) / Scalar(root);
  // Divided by sqrt(c), so that no product overflows; each sign in the form without cancellation.
  const double half = 0.5 * linear_thrust_coefficient / root;
  const Scalar shifted = sqrt(Scalar(thrust + Scalar(half * half)));
  if (half < 0.0) return (shifted + Scalar(-half)) / Scalar(root);
  return thrust / ((shifted + Scalar(half)) * Scalar(root));
}

/// Slope dT / dOmega [N s] of the curve where the thrust is `thrust` >= 0 [N], sqrt(b^2 + 4 c T).
template <typename Scalar>
[[nodiscard]] Scalar thrust_slope(const Scalar& thrust, double thrust_coefficient,
                                  double linear_thrust_coefficient = 0.0) noexcept {
  using std::sqrt;
  const double square = linear_thrust_coefficient * linear_thrust_coefficient;
  return sqrt(Scalar(Scalar(square) + Scalar(4) * (Scalar(thrust_coefficient) * thrust)));
}

/// The same three for the curve of `rotor`.
template <typename Scalar>
[[nodiscard]] Scalar thrust_from_speed(const Scalar& speed, const RotorParameters& rotor) noexcept {
  return thrust_from_speed(speed, rotor.thrust_coefficient, rotor.linear_thrust_coefficient);
}
template <typename Scalar>
[[nodiscard]] Scalar speed_from_thrust(const Scalar& thrust,
                                       const RotorParameters& rotor) noexcept {
  return speed_from_thrust(thrust, rotor.thrust_coefficient, rotor.linear_thrust_coefficient);
}
template <typename Scalar>
[[nodiscard]] Scalar thrust_slope(const Scalar& thrust, const RotorParameters& rotor) noexcept {
  return thrust_slope(thrust, rotor.thrust_coefficient, rotor.linear_thrust_coefficient);
}

/// Largest thrust [N] of `rotor` at `ratio` times the nominal voltage, see voltage_ratio(). The top
/// speed falls in proportion to the voltage. Above the nominal voltage max_thrust stays the limit,
/// and the limit is never below min_thrust.
[[nodiscard]] inline double max_thrust_at(const RotorParameters& rotor, double ratio) noexcept {
  if (!(ratio < 1.0)) return rotor.max_thrust;
  const double speed = ratio * speed_from_thrust(rotor.max_thrust, rotor);
  return std::max(rotor.min_thrust, thrust_from_speed(speed, rotor));
}

/// Speed of one rotor. Between two updates the command is held, and the lag
/// d(Omega)/dt = (command - Omega) / time_constant is solved exactly, so the result does not depend
/// on how often update() is called. Nothing allocates; only the constructor throws.
template <typename Scalar = double>
class Rotor {
 public:
  /// Stands still, or turns at the speed of min_thrust, until the first update. Throws
  /// std::invalid_argument on parameters that validate() refuses.
  explicit Rotor(const RotorParameters& parameters = {}) : parameters_(parameters) {
    validate(parameters);
    min_speed_ = speed_from_thrust(Scalar(parameters.min_thrust), parameters);
    max_speed_ = speed_from_thrust(Scalar(parameters.max_thrust), parameters);
    speed_ = command_ = min_speed();
  }

  /// From now on the battery has `ratio` times its nominal voltage, see voltage_ratio(). The speed
  /// and the command are cut to the new max_speed.
  void set_voltage_ratio(double ratio) noexcept {
    max_speed_ = speed_from_thrust(Scalar(max_thrust_at(parameters_, ratio)), parameters_);
    speed_ = bounded(speed_);
    command_ = bounded(command_);
  }

  /// Brings the speed to `time` [s] under the earlier command, then takes `command` [rad/s], cut
  /// to [min_speed, max_speed], for the time after it. The first update only starts the clock.
  /// A command or time that is not finite, or a time before the last one, changes nothing.
  /// Returns the speed at `time`.
  Scalar update(double time, const Scalar& command) noexcept {
    using std::abs;
    const bool usable = std::isfinite(time) && (!started_ || time >= time_) &&
                        abs(command) < Scalar(std::numeric_limits<double>::infinity());
    if (!usable) return speed_;
    if (started_) {
      const Scalar passed = Scalar(-std::expm1((time_ - time) / parameters_.time_constant));
      speed_ = bounded(speed_ + passed * (command_ - speed_));
    }
    time_ = time;
    started_ = true;
    command_ = bounded(command);
    return speed_;
  }

  /// Sets speed and command [rad/s], cut to [min_speed, max_speed], at `time` [s].
  void reset(const Scalar& speed, double time) noexcept {
    speed_ = command_ = bounded(speed);
    time_ = time;
    started_ = std::isfinite(time);
  }

  [[nodiscard]] const Scalar& speed() const noexcept { return speed_; }  ///< [rad/s]
  [[nodiscard]] Scalar thrust() const noexcept {                         ///< [N]
    return thrust_from_speed(speed_, parameters_);
  }
  [[nodiscard]] const Scalar& min_speed() const noexcept { return min_speed_; }  ///< [rad/s]
  /// Of max_thrust, or of what the voltage leaves of it [rad/s].
  [[nodiscard]] const Scalar& max_speed() const noexcept { return max_speed_; }

 private:
  [[nodiscard]] Scalar bounded(const Scalar& speed) const noexcept {
    if (!(speed > min_speed())) return min_speed();
    return speed < max_speed() ? speed : max_speed();
  }

  RotorParameters parameters_;
  Scalar min_speed_{};
  Scalar max_speed_{};
  Scalar speed_{};
  Scalar command_{};
  double time_ = 0.0;
  bool started_ = false;
};

}  // namespace tilt_ropter
