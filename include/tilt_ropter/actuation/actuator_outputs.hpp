// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <array>
#include <cmath>
#include <cstddef>
#include <optional>

/// Conversion between rotor speeds and tilt angles and the normalised outputs of an autopilot, such
/// as PX4's actuator_motors and actuator_servos.
namespace tilt_ropter {

namespace detail {

/// Returns the u >= 0 that solves f u^2 + (1 - f) u = fraction, for `fraction` >= 0. This form of
/// the solution is also valid for f = 0.
template <typename Scalar>
[[nodiscard]] Scalar undo_thrust_model(const Scalar& fraction, double f) noexcept {
  using std::sqrt;
  const double linear = 1.0 - f;
  return Scalar(2) * fraction /
         (Scalar(linear) + sqrt(Scalar(Scalar(linear * linear) + Scalar(4.0 * f) * fraction)));
}

}  // namespace detail

/// Output u in [0, 1] of a motor whose rotor must turn at `speed` [rad/s]. The thrust, as a
/// fraction of max_thrust, is f u^2 + (1 - f) u, where f in [0, 1] is `thrust_model_factor`.
/// Returns at most 1, and zero where thrust_from_speed() is zero.
///
/// If PX4's THR_MDL_FAC is the motors' own factor, PX4 finds u itself. Its actuator_motors are then
/// fractions of the thrust, so use f = 0. If THR_MDL_FAC = 0, pass the motors' factor here.
/// OutputScaling takes both factors and the battery's voltage.
template <typename Scalar>
[[nodiscard]] Scalar motor_output(const Scalar& speed, const RotorParameters& rotor,
                                  double thrust_model_factor) noexcept {
  const Scalar fraction = thrust_from_speed(speed, rotor) / Scalar(rotor.max_thrust);
  if (!(fraction > Scalar(0))) return Scalar(0);
  if (fraction >= Scalar(1)) return Scalar(1);
  return detail::undo_thrust_model(fraction, thrust_model_factor);
}

/// Inverse of motor_output(). Returns the speed [rad/s] at `output`, which is clamped to [0, 1].
/// NaN gives zero speed, because PX4 uses NaN for a disarmed motor.
template <typename Scalar>
[[nodiscard]] Scalar speed_from_motor_output(const Scalar& output, const RotorParameters& rotor,
                                             double thrust_model_factor) noexcept {
  if (!(output > Scalar(0))) return Scalar(0);
  const Scalar u = output < Scalar(1) ? output : Scalar(1);
  const Scalar fraction = u * (Scalar(thrust_model_factor) * u + Scalar(1.0 - thrust_model_factor));
  return speed_from_thrust(Scalar(Scalar(rotor.max_thrust) * fraction), rotor);
}

/// Mounting of a servo in its arm.
struct ServoOutputParameters {
  double trim = 0.0;      ///< output in the middle of the servo's range, in [-1, 1]
  bool reversed = false;  ///< true: the output decreases as the angle increases
};

/// Output in [-1, 1] of a servo that must stand at `angle` [rad]. The output is linear in the
/// angle: -1 at min_angle and 1 at max_angle, or the opposite if reversed. The trim is then added
/// and the result is clamped. NaN gives NaN.
template <typename Scalar>
[[nodiscard]] Scalar servo_output(const Scalar& angle, const ServoParameters& servo,
                                  const ServoOutputParameters& parameters) noexcept {
  const double middle = 0.5 * (servo.min_angle + servo.max_angle),
               half = 0.5 * (servo.max_angle - servo.min_angle);
  const Scalar fraction = (angle - Scalar(middle)) / Scalar(parameters.reversed ? -half : half);
  const Scalar output = fraction + Scalar(parameters.trim);
  if (output > Scalar(1)) return Scalar(1);
  if (output < Scalar(-1)) return Scalar(-1);
  return output;
}

/// Inverse of servo_output(). Returns the angle [rad] at `output`, which is clamped to [-1, 1]. The
/// angle is clamped to the servo's range. NaN gives NaN.
template <typename Scalar>
[[nodiscard]] Scalar angle_from_servo_output(const Scalar& output, const ServoParameters& servo,
                                             const ServoOutputParameters& parameters) noexcept {
  const double middle = 0.5 * (servo.min_angle + servo.max_angle),
               half = 0.5 * (servo.max_angle - servo.min_angle);
  Scalar u = output;
  if (output > Scalar(1)) u = Scalar(1);
  if (output < Scalar(-1)) u = Scalar(-1);
  const Scalar angle =
      Scalar(middle) + Scalar(parameters.reversed ? -half : half) * (u - Scalar(parameters.trim));
  if (angle > Scalar(servo.max_angle)) return Scalar(servo.max_angle);
  if (angle < Scalar(servo.min_angle)) return Scalar(servo.min_angle);
  return angle;
}

/// Normalised outputs of all actuators.
template <int Rotors, typename Scalar = double>
struct ActuatorOutputs {
  Eigen::Matrix<Scalar, Rotors, 1> motor = Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [0, 1]
  Eigen::Matrix<Scalar, Rotors, 1> servo = Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [-1, 1]
};

/// Response of motors and servos to their outputs. By default the thrust is proportional to the
/// output and the servos have no trim.
template <int Rotors>
struct ActuatorOutputSettings {
  /// Factor f of motor_output(), in [0, 1]. Zero: the thrust is proportional to the output.
  double thrust_model_factor = 0.0;
  /// Factor that the autopilot itself compensates, PX4's THR_MDL_FAC, in [0, 1]. If it is not zero,
  /// set thrust_model_factor to the motors' own factor. Both factors may be equal.
  double autopilot_factor = 0.0;
  /// Trim and direction of each servo.
  std::array<ServoOutputParameters, static_cast<std::size_t>(Rotors)> servos{};
};

template <int Rotors>
void validate(const ActuatorOutputSettings<Rotors>& s) {
  require_in("ActuatorOutputSettings.thrust_model_factor", s.thrust_model_factor, 0.0, 1.0);
  require_in("ActuatorOutputSettings.autopilot_factor", s.autopilot_factor, 0.0, 1.0);
  for (const ServoOutputParameters& servo : s.servos)
    require_in("ServoOutputParameters.trim", servo.trim, -1.0, 1.0);
}

/// Converts between commands and normalised outputs of a vehicle, with the parameters of each
/// rotor.
///
/// A motor's speed is determined by its duty cycle d times the battery's voltage. At r times the
/// nominal voltage the required duty cycle is therefore motor_output() / r, at most 1. The output
/// is p d^2 + (1 - p) d, where p is the autopilot_factor. The autopilot must then not compensate
/// the voltage itself.
///
/// No output is NaN. PX4 interprets NaN as "disarmed" and stops the motor. Only the caller decides
/// when to send NaN. Does not allocate. Only the constructor throws.
template <int Rotors>
class OutputScaling {
 public:
  /// Throws std::invalid_argument if the rotor, servo or battery parameters or the settings fail
  /// validate().
  explicit OutputScaling(const Vehicle<Rotors>& vehicle,
                         const ActuatorOutputSettings<Rotors>& settings = {})
      : servo_(validated(vehicle.servo)),
        battery_(validated(vehicle.battery)),
        settings_(validated(settings)) {
    for (std::size_t i = 0; i < Rotors; ++i) {
      rotors_[i] = rotor_parameters(vehicle, i);
      validate(rotors_[i]);
    }
  }

  /// Sets the measured battery `voltage` [V]. Returns true if voltage_ratio() accepts the voltage.
  /// Otherwise the last accepted voltage remains in effect.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(battery_, voltage);
    if (ratio) voltage_ratio_ = *ratio;
    return ratio.has_value();
  }

  /// Outputs for `command` (speeds [rad/s], angles [rad]). Returns std::nullopt if a speed or an
  /// angle is not finite. The caller should then keep the last outputs.
  template <typename Scalar>
  [[nodiscard]] std::optional<ActuatorOutputs<Rotors, Scalar>> outputs(
      const ActuatorState<Rotors, Scalar>& command) const noexcept {
    if (!all_finite(command.rotor_speed) || !all_finite(command.tilt_angle)) return std::nullopt;
    ActuatorOutputs<Rotors, Scalar> result;
    for (int i = 0; i < Rotors; ++i) {
      result.motor(i) = motor(i, command.rotor_speed(i));
      result.servo(i) = servo_output(command.tilt_angle(i), servo_, servo(i));
    }
    return result;
  }

  /// Inverse of outputs(): returns the command that `outputs` give to the actuators. A motor output
  /// of NaN means a disarmed motor and gives zero speed. Returns std::nullopt if a servo output is
  /// not finite, because the angle of a disarmed servo is unknown.
  template <typename Scalar>
  [[nodiscard]] std::optional<ActuatorState<Rotors, Scalar>> command(
      const ActuatorOutputs<Rotors, Scalar>& outputs) const noexcept {
    if (!all_finite(outputs.servo)) return std::nullopt;
    ActuatorState<Rotors, Scalar> result;
    for (int i = 0; i < Rotors; ++i) {
      result.rotor_speed(i) = speed(i, outputs.motor(i));
      result.tilt_angle(i) = angle_from_servo_output(outputs.servo(i), servo_, servo(i));
    }
    return result;
  }

 private:
  [[nodiscard]] const ServoOutputParameters& servo(int i) const noexcept {
    return settings_.servos[static_cast<std::size_t>(i)];
  }

  template <typename Scalar>
  [[nodiscard]] Scalar motor(int i, const Scalar& speed) const noexcept {
    const RotorParameters& rotor = rotors_[static_cast<std::size_t>(i)];
    const double p = settings_.autopilot_factor;
    const Scalar duty =
        motor_output(speed, rotor, settings_.thrust_model_factor) / Scalar(voltage_ratio_);
    return duty < Scalar(1) ? Scalar((Scalar(p) * duty + Scalar(1.0 - p)) * duty) : Scalar(1);
  }

  template <typename Scalar>
  [[nodiscard]] Scalar speed(int i, const Scalar& output) const noexcept {
    const RotorParameters& rotor = rotors_[static_cast<std::size_t>(i)];
    if (!(output > Scalar(0))) return Scalar(0);
    const Scalar duty = detail::undo_thrust_model(output < Scalar(1) ? output : Scalar(1),
                                                  settings_.autopilot_factor);
    return speed_from_motor_output(Scalar(duty * Scalar(voltage_ratio_)), rotor,
                                   settings_.thrust_model_factor);
  }

  std::array<RotorParameters, static_cast<std::size_t>(Rotors)> rotors_;
  ServoParameters servo_;
  BatteryParameters battery_;
  double voltage_ratio_ = 1.0;  ///< measured voltage / nominal voltage
  ActuatorOutputSettings<Rotors> settings_;
};

}  // namespace tilt_ropter
