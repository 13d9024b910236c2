#pragma once

#include <tilt_ropter/model/vehicle.hpp>

#include <cmath>
#include <limits>

/// Motor with propeller: thrust goes with the square of the speed, speed follows its command with a
/// first-order lag.
namespace tilt_ropter {

/// Thrust [N] at `speed` [rad/s], c Omega^2 (paper, Sec. Control Allocation). Zero for a speed that
/// is negative, not finite, or beyond 1e9 rad/s, which no sensor means.
template <typename Scalar>
[[nodiscard]] Scalar thrust_from_speed(const Scalar& speed, double thrust_coefficient) noexcept {
  if (!(speed > Scalar(0) && speed < Scalar(1e9))) return Scalar(0);
  return Scalar(thrust_coefficient) * speed * speed;
}

/// Speed [rad/s] that gives `thrust` [N], sqrt(T / c). Zero for a thrust that is negative, zero
/// (with derivative zero) or not finite.
template <typename Scalar>
[[nodiscard]] Scalar speed_from_thrust(const Scalar& thrust, double thrust_coefficient) noexcept {
  using std::sqrt;
  if (!(thrust > Scalar(0) && thrust < Scalar(std::numeric_limits<double>::infinity())))
    return Scalar(0);
  return sqrt(thrust) / Scalar(std::sqrt(thrust_coefficient));
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
    speed_ = command_ = min_speed();
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
    return thrust_from_speed(speed_, parameters_.thrust_coefficient);
  }
  [[nodiscard]] Scalar min_speed() const noexcept {  ///< of min_thrust [rad/s]
    return speed_from_thrust(Scalar(parameters_.min_thrust), parameters_.thrust_coefficient);
  }
  [[nodiscard]] Scalar max_speed() const noexcept {  ///< of max_thrust [rad/s]
    return speed_from_thrust(Scalar(parameters_.max_thrust), parameters_.thrust_coefficient);
  }

 private:
  [[nodiscard]] Scalar bounded(const Scalar& speed) const noexcept {
    if (!(speed > min_speed())) return min_speed();
    return speed < max_speed() ? speed : max_speed();
  }

  RotorParameters parameters_;
  Scalar speed_{};
  Scalar command_{};
  double time_ = 0.0;
  bool started_ = false;
};

}  // namespace tilt_ropter
