// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <array>
#include <cstddef>
#include <optional>

/// All actuators of a vehicle.
namespace tilt_ropter {

/// Where rotors and servos are, computed from what they were told. Servos report no angle, so the
/// wrench really applied takes tilt_angle from here and rotor_speed from the speed controllers
/// where those measure it (paper, Sec. External Wrench Estimation). Nothing allocates; only the
/// constructor throws.
template <int Rotors, typename Scalar = double>
class ActuatorModel {
 public:
  /// Throws std::invalid_argument on rotor, servo or battery parameters that validate()
  /// refuses.
  explicit ActuatorModel(const Vehicle<Rotors>& vehicle) {
    validate(vehicle.battery);
    battery_ = vehicle.battery;
    servos_.fill(Servo<Scalar>(vehicle.servo));
    for (std::size_t i = 0; i < Rotors; ++i) {
      rotors_[i] = Rotor<Scalar>(rotor_parameters(vehicle, i));
      tilts_[i] = vehicle.rotors[i].tilts;
    }
    read();
  }

  /// Brings every actuator to `time` [s] under the earlier commands, then takes `command`; see
  /// Rotor::update() and Servo::update(), also for what is ignored. Returns the state at `time`.
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

  /// Takes the measured `voltage` of the battery [V], with which the rotors' top speeds fall.
  /// Returns whether voltage_ratio() accepts it; if not, the last one holds.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(battery_, voltage);
    if (!ratio) return false;
    for (Rotor<Scalar>& rotor : rotors_) rotor.set_voltage_ratio(*ratio);
    read();
    return true;
  }

  /// Sets speeds and angles, cut to their limits, at `time` [s].
  void reset(const ActuatorState<Rotors, Scalar>& state, double time) noexcept {
    for (std::size_t i = 0; i < Rotors; ++i) {
      const auto row = static_cast<Eigen::Index>(i);
      rotors_[i].reset(state.rotor_speed(row), time);
      servos_[i].reset(state.tilt_angle(row), time);
    }
    read();
  }

  /// Speeds and angles at the last update. A rotor that does not tilt has angle zero.
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

}  // namespace tilt_ropter
