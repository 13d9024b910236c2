// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/detail/clock.hpp>
#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>

/// Electrical power, and a battery under load: current, voltage and endurance.
namespace tilt_ropter {

/// Result of a battery under load.
enum class BatteryStatus {
  ok,
  overloaded,  ///< the power is more than the battery can give: current and voltage are those of
               ///< the largest power, at half of the open-circuit voltage
  empty,       ///< the state of charge is zero
  rejected     ///< an argument is invalid; nothing changed
};

[[nodiscard]] constexpr const char* to_string(BatteryStatus status) noexcept {
  return detail::name_in({"ok", "overloaded", "empty", "rejected"}, status);
}

/// Current and voltage of a battery under load.
struct BatteryLoad {
  double current = 0.0;  ///< [A]
  double voltage = 0.0;  ///< at the terminals [V]
  BatteryStatus status = BatteryStatus::ok;
};

/// A battery with a state of charge between 0 (empty) and 1 (full). It is a voltage source with an
/// internal resistance R. The source has the open-circuit voltage U, which falls linearly with the
/// state of charge. A power P loads it with the current I at the terminal voltage V
/// (paper, Sec. Energy Efficiency: P = V I):
///
///     V = U - R I,    P = V I    =>    V = U / 2 + sqrt(U^2 / 4 - R P),
///
/// as long as P <= U^2 / (4 R), the largest power. At constant power, endurance() and update() use
/// a closed relation: with U = V + R P / V, the time from V_a down to V_b is proportional to
/// (V_a^2 - V_b^2) / (2 P) - R ln(V_a / V_b). Does not allocate. Only the constructor throws.
class Battery {
 public:
  /// Throws std::invalid_argument if the parameters fail validate() or are unknown, or if
  /// `state_of_charge` is not in [0, 1].
  explicit Battery(const BatteryParameters& parameters, double state_of_charge = 1.0)
      : parameters_(validated(parameters)), state_of_charge_(state_of_charge) {
    require(is_known(parameters), "BatteryParameters.capacity [A h]", parameters.capacity,
            "known, > 0");
    require_in("Battery: state of charge", state_of_charge, 0.0, 1.0);
  }

  /// Lets `power` [W] flow from the last update until `time` [s], at constant power. The first
  /// update only starts the clock. While the battery cannot give the power (`overloaded`), it gives
  /// its largest power. The charge stops at zero (`empty`). Rejects a time that is not finite or
  /// before the last time, and a power that is negative or above 1e12 W. If clock_was_set_back(),
  /// the clock starts again and the charge does not change.
  BatteryStatus update(double time, double power) noexcept {
    if (!std::isfinite(time) || !usable(power)) return BatteryStatus::rejected;
    if (clock_was_set_back(time, time_)) started_ = false;
    if (started_ && time < time_) return BatteryStatus::rejected;
    const double passed = started_ ? time - time_ : 0.0;
    time_ = time;
    started_ = true;
    discharge(power, passed);
    return load(power).status;
  }

  /// Current and voltage at `power` [W] and the present state of charge.
  [[nodiscard]] BatteryLoad load(double power) const noexcept {
    if (!usable(power)) return {0.0, open_circuit_voltage(), BatteryStatus::rejected};
    BatteryLoad load = load_at(state_of_charge_, power);
    if (load.status == BatteryStatus::ok && !(state_of_charge_ > 0.0))
      load.status = BatteryStatus::empty;
    return load;
  }

  /// Time [s] for which the battery gives the constant `power` [W] from now on, until the state of
  /// charge is `until`. It ends earlier if the battery cannot give the power. Infinite without
  /// power. Zero for an invalid power or an `until` that is not below the state of charge.
  [[nodiscard]] double endurance(double power, double until = 0.0) const noexcept {
    if (!usable(power) || !(until < state_of_charge_)) return 0.0;
    if (!(power > 0.0)) return std::numeric_limits<double>::infinity();
    const double end = std::max(std::max(until, 0.0), least_charge(power));
    return end < state_of_charge_ ? time_between(state_of_charge_, end, power) : 0.0;
  }

  /// Energy [J] that the source still gives: the upper limit of what the terminals give.
  [[nodiscard]] double energy() const noexcept {
    return 3600.0 * parameters_.capacity * state_of_charge_ * 0.5 *
           (open_circuit_voltage() + parameters_.empty_voltage);
  }

  /// Largest power at the present state of charge [W], infinite without resistance.
  [[nodiscard]] double max_power() const noexcept {
    const double voltage = open_circuit_voltage();
    return parameters_.resistance > 0.0 ? voltage * voltage / (4.0 * parameters_.resistance)
                                        : std::numeric_limits<double>::infinity();
  }

  [[nodiscard]] double open_circuit_voltage() const noexcept {  ///< [V]
    return source(state_of_charge_);
  }
  [[nodiscard]] double state_of_charge() const noexcept { return state_of_charge_; }
  [[nodiscard]] const BatteryParameters& parameters() const noexcept { return parameters_; }

 private:
  [[nodiscard]] static bool usable(double power) noexcept { return power >= 0.0 && power <= 1e12; }

  [[nodiscard]] double source(double charge) const noexcept {
    return parameters_.empty_voltage +
           charge * (parameters_.full_voltage - parameters_.empty_voltage);
  }

  [[nodiscard]] BatteryLoad load_at(double charge, double power) const noexcept {
    const double half = 0.5 * source(charge), rest = half * half - parameters_.resistance * power;
    if (rest < 0.0) return {half / parameters_.resistance, half, BatteryStatus::overloaded};
    const double voltage = half + std::sqrt(rest);
    return {power / voltage, voltage, BatteryStatus::ok};
  }

  /// Lowest state of charge at which the battery gives `power`. Above 1: the power is too large.
  [[nodiscard]] double least_charge(double power) const noexcept {
    const double least = 2.0 * std::sqrt(parameters_.resistance * power),
                 range = parameters_.full_voltage - parameters_.empty_voltage;
    if (least <= parameters_.empty_voltage) return 0.0;
    return range > 0.0 ? (least - parameters_.empty_voltage) / range
                       : std::numeric_limits<double>::infinity();
  }

  /// Time [s] from one state of charge to a lower one at constant power > 0, which the battery can
  /// give at both. The factor of the charge is the mean of 1 / current; it is written without a
  /// difference of almost equal numbers.
  [[nodiscard]] double time_between(double from, double to, double power) const noexcept {
    const double a = load_at(to, power).voltage, b = load_at(from, power).voltage,
                 r = parameters_.resistance;
    const double rise = (b - a) / a, log_rise = rise > 1e-12 ? std::log1p(rise) / rise : 1.0;
    const double slope =
        1.0 - r * power / (a * b);  // of the open-circuit over the terminal voltage
    const double mean =
        slope > 1e-9 ? (0.5 * (a + b) / power - r / a * log_rise) / slope : 0.5 * (a + b) / power;
    return 3600.0 * parameters_.capacity * (from - to) * mean;
  }

  void discharge(double power, double passed) noexcept {
    if (!(passed > 0.0) || !(power > 0.0)) return;
    const double start = state_of_charge_, end = least_charge(power);
    const double whole = start > end ? time_between(start, end, power) : 0.0;
    if (passed < whole) {
      discharge_within(power, passed, end);
    } else {
      state_of_charge_ = std::min(start, end);
      if (end > 0.0) discharge_overloaded(passed - whole);
    }
  }

  /// Newton's method for the state of charge after `passed` [s], above `end`. The time is a concave
  /// function of it, so the iterates fall towards the solution and never pass it.
  void discharge_within(double power, double passed, double end) noexcept {
    const double start = state_of_charge_;
    double charge = start;
    for (int i = 0; i < 50; ++i) {
      const double missing = passed - (charge < start ? time_between(start, charge, power) : 0.0);
      const double change =
          missing * load_at(charge, power).current / (3600.0 * parameters_.capacity);
      charge = std::max(charge - change, end);
      if (!(std::abs(change) > 1e-15)) break;
    }
    state_of_charge_ = charge;
  }

  /// The current U / (2 R) lets the open-circuit voltage decay exponentially.
  void discharge_overloaded(double passed) noexcept {
    const double range = parameters_.full_voltage - parameters_.empty_voltage;
    const double rate = 1.0 / (2.0 * parameters_.resistance * 3600.0 * parameters_.capacity);
    const double decay = -std::expm1(-rate * range * passed);
    const double fall = range > 0.0 ? open_circuit_voltage() * decay / range
                                    : open_circuit_voltage() * rate * passed;
    state_of_charge_ = std::max(state_of_charge_ - fall, 0.0);
  }

  BatteryParameters parameters_;
  double state_of_charge_;
  double time_ = 0.0;
  bool started_ = false;
};

/// Electrical power of a vehicle:
///
///     P = electronics + sum over servos (servo_hold + servo_move |angle rate|) + c sum Omega^3.
///
/// The last term is the aerodynamic power of propellers that do not move through the air. c is such
/// that hover takes PowerParameters.hover (paper, Sec. Energy Efficiency). All rotors have the same
/// c, also rotors with their own parameters. If the propellers differ much, the power of each rotor
/// is inaccurate, but the sum in hover is right. Does not allocate. Only constructors throw.
class PowerModel {
 public:
  /// For a vehicle whose rotors carry equal parts of m g in hover. Each rotor's speed follows from
  /// its own curve. Throws std::invalid_argument if the parameters fail validate(), if hover takes
  /// less power than electronics and servos, or if the hover speed is next to zero.
  template <int Rotors>
  explicit PowerModel(const Vehicle<Rotors>& vehicle)
      : PowerModel(vehicle, speeds_in_hover(vehicle)) {}

  /// For rotors that carry different parts of m g, such as rotors that push against each other.
  /// `hover` are the rotor speeds in hover [rad/s]. Throws like the constructor above.
  template <int Rotors>
  PowerModel(const Vehicle<Rotors>& vehicle, const Eigen::Matrix<double, Rotors, 1>& hover)
      : at_rest_(vehicle.power.electronics + servo_count(vehicle) * vehicle.power.servo_hold),
        servo_move_(vehicle.power.servo_move) {
    const PowerParameters& parameters = vehicle.power;
    validate(parameters);
    require(parameters.hover > at_rest_, "PowerParameters.hover [W]", parameters.hover,
            "> electronics and servos at rest, " + std::to_string(at_rest_));
    require_non_negative("PowerModel: speeds in hover [rad/s]", hover);
    double cubes = 0.0;
    for (Eigen::Index i = 0; i < hover.size(); ++i) cubes += hover(i) * hover(i) * hover(i);
    coefficient_ = (parameters.hover - at_rest_) / cubes;
    require(coefficient_ < 1e200, "PowerModel's coefficient [W s^3]", coefficient_,
            "below 1e200; the hover speed is next to zero");
  }

  /// Power [W] at rotor speeds [rad/s], a vector of any length, with servos at rest. A speed that
  /// is negative, not finite or above 1e9 rad/s counts as zero.
  template <typename Derived>
  [[nodiscard]] typename Derived::Scalar power(
      const Eigen::MatrixBase<Derived>& rotor_speed) const noexcept {
    using Scalar = typename Derived::Scalar;
    Scalar sum(0);
    for (Eigen::Index i = 0; i < rotor_speed.size(); ++i) {
      const Scalar& speed = rotor_speed(i);
      if (speed > Scalar(0) && speed < Scalar(1e9)) sum += speed * speed * speed;
    }
    return Scalar(at_rest_) + Scalar(coefficient_) * sum;
  }

  /// The same with servos that turn at `tilt_rate` [rad/s], a vector of any length. A rate that is
  /// not finite or above 1e9 rad/s counts as zero.
  template <typename Derived, typename Rates>
  [[nodiscard]] typename Derived::Scalar power(
      const Eigen::MatrixBase<Derived>& rotor_speed,
      const Eigen::MatrixBase<Rates>& tilt_rate) const noexcept {
    using Scalar = typename Derived::Scalar;
    Scalar sum(0);
    for (Eigen::Index i = 0; i < tilt_rate.size(); ++i) {
      const Scalar rate = tilt_rate(i) < Scalar(0) ? Scalar(-tilt_rate(i)) : Scalar(tilt_rate(i));
      if (rate < Scalar(1e9)) sum += rate;
    }
    return power(rotor_speed) + Scalar(servo_move_) * sum;
  }

 private:
  template <int Rotors>
  static Eigen::Matrix<double, Rotors, 1> speeds_in_hover(const Vehicle<Rotors>& vehicle) {
    validate(vehicle.body);
    Eigen::Matrix<double, Rotors, 1> speeds;
    for (int i = 0; i < Rotors; ++i) {
      const RotorParameters& rotor = rotor_parameters(vehicle, static_cast<std::size_t>(i));
      validate(rotor);
      speeds(i) = speed_from_thrust(vehicle.body.mass * gravity / Rotors, rotor);
    }
    return speeds;
  }

  double at_rest_;            // electronics and servos [W]
  double servo_move_;         // [J/rad]
  double coefficient_ = 0.0;  // c [W s^3]
};

}  // namespace tilt_ropter
