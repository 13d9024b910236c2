// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>

/// Model of all rotors and tilt servos of a vehicle.
namespace tilt_ropter {

/// Model of the rotor speeds and tilt angles, computed from the commands, for the wrench that is
/// really applied (paper, Sec. External Wrench Estimation). Servos report no angle.
///
/// If the speed controllers measure the rotor speeds, the model learns for each rotor the ratio of
/// measured to commanded speed in steady flight, with a time constant of 0.3 s. A low battery or a
/// wrong throttle map is such a ratio. to_send() divides it out:
///
///     const auto& applied = model.update(time, command, measured);  // for WrenchObserver
///     ...                                                           // the next command
///     motors.send(model.to_send(command));
///
/// The observer reports what is not divided out as an external wrench, so the controller
/// compensates it. Does not allocate. Only the constructor throws.
template <int Rotors, typename Scalar = double>
class ActuatorModel {
 public:
  using Speeds = Eigen::Matrix<Scalar, Rotors, 1>;  ///< one number for each rotor

  /// Throws std::invalid_argument if the rotor, servo or battery parameters fail validate().
  explicit ActuatorModel(const Vehicle<Rotors>& vehicle) {
    validate(vehicle.battery);
    battery_ = vehicle.battery;
    servos_.fill(Servo<Scalar>(vehicle.servo));
    for (std::size_t i = 0; i < Rotors; ++i) {
      rotors_[i] = Rotor<Scalar>(rotor_parameters(vehicle, i));
      tilts_[i] = vehicle.rotors[i].tilts;
      top_speed_(static_cast<Eigen::Index>(i)) = rotors_[i].max_speed();
      lag_(static_cast<Eigen::Index>(i)) = rotor_parameters(vehicle, i).time_constant;
    }
    read();
  }

  /// Advances every actuator to `time` [s] under the earlier commands, then accepts `command`
  /// (speeds [rad/s], angles [rad]). Rotor::update() and Servo::update() define which inputs are
  /// ignored. Returns the state at `time`.
  const ActuatorState<Rotors, Scalar>& update(
      double time, const ActuatorState<Rotors, Scalar>& command) noexcept {
    for (std::size_t i = 0; i < Rotors; ++i) {
      const auto row = static_cast<Eigen::Index>(i);
      rotors_[i].update(time, command.rotor_speed(row));
      servos_[i].update(time, command.tilt_angle(row));
    }
    read();
    return state_;
  }

  /// The same with the `measured` speeds [rad/s]. Returns the actuators as applied at `time`:
  /// modelled angles, and speeds with the measured changes whose steady difference from the
  /// command is removed. A rotor has its modelled speed while its reading is below 0.6 or above 1.4
  /// times the expected speed (it has failed, or its sensor), or has been the same for 0.2 s.
  const ActuatorState<Rotors, Scalar>& update(double time,
                                              const ActuatorState<Rotors, Scalar>& command,
                                              const Speeds& measured) noexcept {
    applied_ = update(time, command);
    if (!std::isfinite(time)) return applied_;
    for (Eigen::Index i = 0; i < Rotors; ++i) {
      const Scalar &speed = measured(i), &modelled = state_.rotor_speed(i);
      const Scalar part = speed * divisor_(i) / (modelled * ratio_(i));
      if (!(part > Scalar(least_part) && part < Scalar(most_part))) continue;  // also NaN
      if (speed != reading_(i) || !(time >= changed_(i))) {
        const double dt = std::clamp(time - changed_(i), 0.0, longest_step);
        learn(i, dt, command.rotor_speed(i), part);
        reading_(i) = speed;
        changed_(i) = time;
      }
      if (time - changed_(i) < most_frozen) applied_.rotor_speed(i) = speed / difference_(i);
    }
    return applied_;
  }

  /// Returns `command` with the speeds divided by speed_ratio(), at most the nominal top speeds.
  [[nodiscard]] const ActuatorState<Rotors, Scalar>& to_send(
      const ActuatorState<Rotors, Scalar>& command) noexcept {
    divisor_ = ratio_;
    sent_ = command;
    sent_.rotor_speed = command.rotor_speed.cwiseQuotient(divisor_).cwiseMin(top_speed_);
    return sent_;
  }

  /// Learnt speed / sent speed of each rotor, in [0.7, 1.2].
  [[nodiscard]] const Speeds& speed_ratio() const noexcept { return ratio_; }
  /// Starts from known ratios, such as those of the model before a failure. They are clamped to
  /// [0.7, 1.2]; ignored if not finite.
  void set_speed_ratio(const Speeds& ratio) noexcept {
    if (all_finite(ratio)) ratio_ = divisor_ = ratio.cwiseMax(Scalar(0.7)).cwiseMin(Scalar(1.2));
  }

  /// Voltage [V] that limits the rotors to the top speed that the slowest of them reaches, for
  /// set_voltage() of controller and allocation: at most the nominal voltage and that of
  /// set_voltage(). Zero if the nominal voltage is unknown.
  [[nodiscard]] double usable_voltage() const noexcept {
    const double least = static_cast<double>(ratio_.minCoeff());
    return battery_.nominal_voltage * std::min({1.0, voltage_ratio_, least});
  }

  /// Sets the measured battery `voltage` [V]. The top speeds of the rotors fall with the voltage.
  /// Returns true if voltage_ratio() accepts it. Otherwise the last accepted voltage remains.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(battery_, voltage);
    if (!ratio) return false;
    voltage_ratio_ = *ratio;
    for (Rotor<Scalar>& rotor : rotors_) rotor.set_voltage_ratio(*ratio);
    read();
    return true;
  }

  /// Sets speeds [rad/s] and angles [rad], clamped to their limits, at `time` [s]. Without a time,
  /// at that of the next update. Keeps the ratios.
  void reset(const ActuatorState<Rotors, Scalar>& state,
             double time = std::numeric_limits<double>::quiet_NaN()) noexcept {
    for (std::size_t i = 0; i < Rotors; ++i) {
      const auto row = static_cast<Eigen::Index>(i);
      rotors_[i].reset(state.rotor_speed(row), time);
      servos_[i].reset(state.tilt_angle(row), time);
    }
    read();
  }

  /// Speeds [rad/s] and angles [rad] at the last update. Zero angles for rotors that do not tilt.
  [[nodiscard]] const ActuatorState<Rotors, Scalar>& state() const noexcept { return state_; }

 private:
  // Time constant of the ratio [s]. It averages noise and transients, and follows a battery.
  static constexpr double ratio_time = 0.3;
  // The same of the difference that is left, which the observer shall see soon [s]. Faster changes
  // of the measured speed are known to the observer.
  static constexpr double difference_time = 0.15;
  static constexpr double longest_step = 0.02;  // that one reading counts for [s]
  static constexpr double most_frozen = 0.2;    // time without a change of the reading [s]
  // Largest difference of command and modelled speed in steady flight, as a fraction. Beyond it an
  // error of the motor's time constant would be learnt.
  static constexpr double steady = 0.05;
  // Lag of a rotor beyond the believed one [s]. In an oscillation it looks like a ratio, which
  // would follow the oscillation and feed it, if it were not learnt more slowly by this factor.
  static constexpr double most_lag = 0.05, slow = 0.1;
  // Below this fraction of the top speed nothing is learnt, because the noise is a large part.
  static constexpr double min_fraction = 0.1;
  // Outside these fractions of the expected speed the rotor or its sensor has failed.
  static constexpr double least_part = 0.6, most_part = 1.4;
  // Largest error of one reading that counts, as a fraction of the expected speed.
  static constexpr double largest_error = 0.2;

  // `part`: measured speed / speed expected by the ratio.
  void learn(Eigen::Index i, double dt, const Scalar& command, const Scalar& part) noexcept {
    using std::abs;
    const Scalar modelled = state_.rotor_speed(i);
    if (!(modelled > Scalar(min_fraction) * top_speed_(i)) ||
        !(abs(command - modelled) < Scalar(steady) * modelled))
      return;
    // What a rotor that is slower than believed explains is learnt slowly.
    const Scalar explained = Scalar(most_lag / lag_(i)) * abs(command - modelled) / modelled;
    const auto pace = [&explained](const Scalar& error) {
      return abs(error) > explained ? Scalar(1) : Scalar(slow);
    };
    const Scalar change = part * ratio_(i) / divisor_(i) - difference_(i);
    difference_(i) += pace(change) * Scalar(dt / difference_time) * change;
    // If the sent speed is at its limit, the rotor cannot follow.
    if (command > divisor_(i) * top_speed_(i) && part < Scalar(1)) return;
    const Scalar error =
        std::clamp(part - Scalar(1), Scalar(-largest_error), Scalar(largest_error));
    ratio_(i) *= Scalar(1) + pace(error) * Scalar(dt / ratio_time) * error;
    ratio_(i) = std::clamp(ratio_(i), Scalar(0.7), Scalar(1.2));
  }

  void read() noexcept {
    for (std::size_t i = 0; i < Rotors; ++i) {
      const auto row = static_cast<Eigen::Index>(i);
      state_.rotor_speed(row) = rotors_[i].speed();
      state_.tilt_angle(row) = tilts_[i] ? servos_[i].angle() : Scalar(0);
    }
  }

  std::array<Rotor<Scalar>, static_cast<std::size_t>(Rotors)> rotors_;
  std::array<Servo<Scalar>, static_cast<std::size_t>(Rotors)> servos_;
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};
  BatteryParameters battery_;
  double voltage_ratio_ = 1.0;
  ActuatorState<Rotors, Scalar> state_, applied_, sent_;
  // The ratio, its value in the last sent command, and measured / modelled speed.
  Speeds ratio_ = Speeds::Ones(), divisor_ = Speeds::Ones(), difference_ = Speeds::Ones();
  Speeds reading_ = Speeds::Zero(), top_speed_;  // last reading, nominal top speed [rad/s]
  Eigen::Matrix<double, Rotors, 1> lag_;         // believed time constant [s]
  Eigen::Matrix<double, Rotors, 1> changed_ = Eigen::Matrix<double, Rotors, 1>::Zero();  // then [s]
};

}  // namespace tilt_ropter
