// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <array>
#include <cstddef>
#include <limits>
#include <optional>

/// Model of all rotors and tilt servos of a vehicle.
namespace tilt_ropter {

/// Model of the rotor speeds and tilt angles, computed from the commands. Servos report no angle.
/// For the wrench that is really applied, take tilt_angle from this model. Take rotor_speed from
/// the speed controllers if they measure the speed (paper, Sec. External Wrench Estimation). Does
/// not allocate. Only the constructor throws.
template <int Rotors, typename Scalar = double>
class ActuatorModel {
 public:
  /// Throws std::invalid_argument if the rotor, servo or battery parameters fail validate().
  explicit ActuatorModel(const Vehicle<Rotors>& vehicle);

  /// Advances every actuator to `time` [s] under the earlier commands, then accepts `command`
  /// (speeds [rad/s], angles [rad]). Rotor::update() and Servo::update() define which inputs are
  /// ignored. Returns the state at `time`.
  const ActuatorState<Rotors, Scalar>& update(
      double time, const ActuatorState<Rotors, Scalar>& command) noexcept;

  /// Sets the measured battery `voltage` [V]. The top speeds of the rotors fall with the voltage.
  /// Returns true if voltage_ratio() accepts the voltage. Otherwise the last accepted voltage
  /// remains in effect.
  bool set_voltage(double voltage) noexcept;

  /// Sets speeds [rad/s] and angles [rad], clamped to their limits, at `time` [s]. Without a time,
  /// at that of the next update.
  void reset(const ActuatorState<Rotors, Scalar>& state,
             double time = std::numeric_limits<double>::quiet_NaN()) noexcept;

  /// Speeds [rad/s] and angles [rad] at the last update. The angle of a rotor that does not tilt is
  /// zero.
  [[nodiscard]] const ActuatorState<Rotors, Scalar>& state() const noexcept { return state_; }

 private:
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
  ActuatorState<Rotors, Scalar> state_;
};

template <int Rotors, typename Scalar>
ActuatorModel<Rotors, Scalar>::ActuatorModel(const Vehicle<Rotors>& vehicle) {
  validate(vehicle.battery);
  battery_ = vehicle.battery;
  servos_.fill(Servo<Scalar>(vehicle.servo));
  for (std::size_t i = 0; i < Rotors; ++i) {
    rotors_[i] = Rotor<Scalar>(rotor_parameters(vehicle, i));
    tilts_[i] = vehicle.rotors[i].tilts;
  }
  read();
}

template <int Rotors, typename Scalar>
const ActuatorState<Rotors, Scalar>& ActuatorModel<Rotors, Scalar>::update(
    double time, const ActuatorState<Rotors, Scalar>& command) noexcept {
  for (std::size_t i = 0; i < Rotors; ++i) {
    const auto row = static_cast<Eigen::Index>(i);
    rotors_[i].update(time, command.rotor_speed(row));
    servos_[i].update(time, command.tilt_angle(row));
  }
  read();
  return state_;
}

template <int Rotors, typename Scalar>
bool ActuatorModel<Rotors, Scalar>::set_voltage(double voltage) noexcept {
  const std::optional<double> ratio = voltage_ratio(battery_, voltage);
  if (!ratio) return false;
  for (Rotor<Scalar>& rotor : rotors_) rotor.set_voltage_ratio(*ratio);
  read();
  return true;
}

template <int Rotors, typename Scalar>
void ActuatorModel<Rotors, Scalar>::reset(const ActuatorState<Rotors, Scalar>& state,
                                          double time) noexcept {
  for (std::size_t i = 0; i < Rotors; ++i) {
    const auto row = static_cast<Eigen::Index>(i);
    rotors_[i].reset(state.rotor_speed(row), time);
    servos_[i].reset(state.tilt_angle(row), time);
  }
  read();
}

}  // namespace tilt_ropter
