// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/clock.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <algorithm>
#include <cmath>
#include <limits>

/// Motor with propeller. The thrust follows from the speed by the curve of RotorParameters. The
/// speed follows its command with a first-order lag.
namespace tilt_ropter {

/// Thrust [N] at `speed` [rad/s]: c Omega^2 + b Omega with the linear coefficient b. b = 0 is the
/// paper's law (paper, Sec. Control Allocation). Returns zero if the result is negative, and for a
/// speed that is negative, not finite or above 1e9 rad/s, which no valid sensor reports.
template <typename Scalar>
[[nodiscard]] Scalar thrust_from_speed(const Scalar& speed, const RotorParameters& rotor) noexcept {
  if (!(speed > Scalar(0) && speed < Scalar(1e9))) return Scalar(0);
  const Scalar per_speed =
      Scalar(rotor.thrust_coefficient) * speed + Scalar(rotor.linear_thrust_coefficient);
  return per_speed > Scalar(0) ? Scalar(per_speed * speed) : Scalar(0);
}

/// Speed [rad/s] that gives `thrust` [N]: (sqrt(b^2 + 4 c T) - b) / (2 c), or sqrt(T / c) for
/// b = 0. For a thrust that is negative, zero or not finite, returns the speed at which the thrust
/// begins: -b / c if b is negative, otherwise zero. The derivative at zero thrust is zero.
template <typename Scalar>
[[nodiscard]] Scalar speed_from_thrust(const Scalar& thrust,
                                       const RotorParameters& rotor) noexcept {
  using std::sqrt;
  const double c = rotor.thrust_coefficient, b = rotor.linear_thrust_coefficient;
  if (!(thrust > Scalar(0) && thrust < Scalar(std::numeric_limits<double>::infinity())))
    return Scalar(std::max(0.0, -b / c));
  const double root = std::sqrt(c);
  if (!(std::abs(b) > 0.0)) return sqrt(thrust) / Scalar(root);
  // Divided by sqrt(c): no product overflows. Each sign of b has a form without cancellation.
  const double half = 0.5 * b / root;
  const Scalar shifted = sqrt(Scalar(thrust + Scalar(half * half)));
  if (half < 0.0) return (shifted + Scalar(-half)) / Scalar(root);
  return thrust / ((shifted + Scalar(half)) * Scalar(root));
}

/// Slope dT / dOmega [N s] of the curve at `thrust` >= 0 [N]: sqrt(b^2 + 4 c T).
template <typename Scalar>
[[nodiscard]] Scalar thrust_slope(const Scalar& thrust, const RotorParameters& rotor) noexcept {
  using std::sqrt;
  const double square = rotor.linear_thrust_coefficient * rotor.linear_thrust_coefficient;
  return sqrt(Scalar(Scalar(square) + Scalar(4) * (Scalar(rotor.thrust_coefficient) * thrust)));
}

/// Largest thrust [N] of `rotor` at `ratio` times the nominal voltage, see voltage_ratio(). The top
/// speed is proportional to the voltage. The limit is never below min_thrust or above max_thrust.
[[nodiscard]] inline double max_thrust_at(const RotorParameters& rotor, double ratio) noexcept {
  if (!(ratio < 1.0)) return rotor.max_thrust;
  const double speed = ratio * speed_from_thrust(rotor.max_thrust, rotor);
  return std::max(rotor.min_thrust, thrust_from_speed(speed, rotor));
}

/// Speed of one rotor. Between two updates the command is held and the lag
/// d(Omega)/dt = (command - Omega) / time_constant is solved exactly. The result therefore does not
/// depend on the update rate. Does not allocate. Only the constructor throws.
template <typename Scalar>
class Rotor {
 public:
  /// Before the first update the rotor stands still, or turns at the speed of min_thrust. Throws
  /// std::invalid_argument if the parameters fail validate().
  explicit Rotor(const RotorParameters& parameters = {}) : parameters_(parameters) {
    validate(parameters);
    min_speed_ = speed_from_thrust(Scalar(parameters.min_thrust), parameters);
    max_speed_ = speed_from_thrust(Scalar(parameters.max_thrust), parameters);
    speed_ = command_ = min_speed();
  }

  /// Sets the battery voltage to `ratio` times the nominal voltage, see voltage_ratio(). Clamps the
  /// speed and the command to the new max_speed.
  void set_voltage_ratio(double ratio) noexcept {
    max_speed_ = speed_from_thrust(Scalar(max_thrust_at(parameters_, ratio)), parameters_);
    speed_ = bounded(speed_);
    command_ = bounded(command_);
  }

  /// Advances the speed to `time` [s] under the earlier command. Then accepts `command` [rad/s],
  /// clamped to [min_speed, max_speed], for the time after `time`. The first update, and one after
  /// clock_was_set_back(), starts the clock and does not change the speed. Ignores a command or
  /// time that is not finite, and a time before the last time. Returns the speed at `time`.
  Scalar update(double time, const Scalar& command) noexcept {
    using std::abs;
    const bool usable =
        std::isfinite(time) && abs(command) < Scalar(std::numeric_limits<double>::infinity());
    if (!usable) return speed_;
    if (clock_was_set_back(time, time_)) started_ = false;
    if (started_ && time < time_) return speed_;
    if (started_) {
      const Scalar passed = Scalar(-std::expm1((time_ - time) / parameters_.time_constant));
      speed_ = bounded(speed_ + passed * (command_ - speed_));
    }
    time_ = time;
    started_ = true;
    command_ = bounded(command);
    return speed_;
  }

  /// Sets speed and command [rad/s], clamped to [min_speed, max_speed], at `time` [s].
  void reset(const Scalar& speed, double time) noexcept {
    speed_ = command_ = bounded(speed);
    time_ = time;
    started_ = std::isfinite(time);
  }

  [[nodiscard]] const Scalar& speed() const noexcept { return speed_; }          ///< [rad/s]
  [[nodiscard]] const Scalar& min_speed() const noexcept { return min_speed_; }  ///< [rad/s]
  /// Speed at max_thrust, or at the thrust that the voltage allows [rad/s].
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
using Rotord = Rotor<double>;  ///< in double precision

}  // namespace tilt_ropter
