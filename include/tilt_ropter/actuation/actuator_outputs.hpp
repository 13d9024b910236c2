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

/// Rotor speeds and tilt angles as an autopilot's normalised outputs, such as PX4's
/// actuator_motors and actuator_servos, and back.
namespace tilt_ropter {

namespace detail {

/// The u >= 0 with f u^2 + (1 - f) u = share, for a share >= 0, in a form that holds for f = 0,
/// too.
template <typename Scalar>
[[nodiscard]] Scalar undo_thrust_model(const Scalar& share, double f) noexcept {
  using std::sqrt;
  const double linear = 1.0 - f;
  return Scalar(2) * share /
         (Scalar(linear) + sqrt(Scalar(Scalar(linear * linear) + Scalar(4.0 * f) * share)));
}

}  // namespace detail

/// Output u in [0, 1] of the motor whose rotor is to turn at `speed` [rad/s]: where the thrust, as
/// a share of max_thrust, is f u^2 + (1 - f) u, with f in [0, 1] the thrust model factor; cut to
/// 1. Zero where thrust_from_speed() is.
///
/// PX4's actuator_motors are shares of the thrust, f = 0, if its THR_MDL_FAC is the motors' own
/// factor: it then finds u itself. With THR_MDL_FAC = 0, give that factor here. OutputScaling takes
/// both factors and the battery's voltage.
template <typename Scalar>
[[nodiscard]] Scalar motor_output(const Scalar& speed, const RotorParameters& rotor,
                                  double thrust_model_factor) noexcept {
  const Scalar share = thrust_from_speed(speed, rotor) / Scalar(rotor.max_thrust);
  if (!(share > Scalar(0))) return Scalar(0);
  if (share >= Scalar(1)) return Scalar(1);
  return detail::undo_thrust_model(share, thrust_model_factor);
}

/// Inverse of motor_output(): speed [rad/s] at `output`, which is cut to [0, 1]. NaN, by which PX4
/// means a motor that is disarmed, stands still.
template <typename Scalar>
[[nodiscard]] Scalar speed_from_motor_output(const Scalar& output, const RotorParameters& rotor,
                                             double thrust_model_factor) noexcept {
  if (!(output > Scalar(0))) return Scalar(0);
  const Scalar u = output < Scalar(1) ? output : Scalar(1);
  const Scalar share = u * (Scalar(thrust_model_factor) * u + Scalar(1.0 - thrust_model_factor));
  return speed_from_thrust(Scalar(Scalar(rotor.max_thrust) * share), rotor);
}

/// How a servo sits in its arm.
struct ServoOutputParameters {
  double trim = 0.0;      ///< output in the middle of the range, in [-1, 1]
  bool reversed = false;  ///< true: the output falls where the angle grows
};

/// Output in [-1, 1] of the servo that is to stand at `angle` [rad]: linear, -1 at min_angle and 1
/// at max_angle, the other way round if reversed, then shifted by the trim and cut. NaN stays NaN.
template <typename Scalar>
[[nodiscard]] Scalar servo_output(const Scalar& angle, const ServoParameters& servo,
                                  const ServoOutputParameters& parameters) noexcept {
  const double middle = 0.5 * (servo.min_angle + servo.max_angle),
               half = 0.5 * (servo.max_angle - servo.min_angle);
  const Scalar share = (angle - Scalar(middle)) / Scalar(parameters.reversed ? -half : half);
  const Scalar output = share + Scalar(parameters.trim);
  if (output > Scalar(1)) return Scalar(1);
  if (output < Scalar(-1)) return Scalar(-1);
  return output;
}

/// Inverse of servo_output(): angle [rad], cut to the servo's range, at `output`, which is cut to
/// [-1, 1]. NaN stays NaN.
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

/// How motors and servos answer; by default thrust is proportional, servos without trim.
template <int Rotors>
struct ActuatorOutputSettings {
  double thrust_model_factor = 0.0;  ///< f of motor_output(), in [0, 1]
  /// The factor that the autopilot itself undoes, PX4's THR_MDL_FAC, in [0, 1]. If it is not zero,
  /// thrust_model_factor is the motors' own factor, and both may be the same.
  double autopilot_factor = 0.0;
  std::array<ServoOutputParameters, static_cast<std::size_t>(Rotors)> servos{};
};

/// Throws std::invalid_argument naming the field, its value and what is allowed.
template <int Rotors>
void validate(const ActuatorOutputSettings<Rotors>& s) {
  require_in("ActuatorOutputSettings.thrust_model_factor", s.thrust_model_factor, 0.0, 1.0);
  require_in("ActuatorOutputSettings.autopilot_factor", s.autopilot_factor, 0.0, 1.0);
  for (const ServoOutputParameters& servo : s.servos)
    require_in("ServoOutputParameters.trim", servo.trim, -1.0, 1.0);
}

/// Between commands and normalised outputs of a vehicle, with each rotor's own parameters.
///
/// A motor turns with its duty cycle d times the battery's voltage. So at r times the nominal
/// voltage the duty cycle is motor_output() / r, at most 1, and the output is p d^2 + (1 - p) d
/// with the autopilot_factor p. The autopilot must not compensate the voltage itself then.
///
/// No output is ever NaN: what PX4 takes for
/// "disarmed", and stops the motor for, is the caller's to say. Nothing allocates; only the
/// constructor throws.
template <int Rotors>
class OutputScaling {
 public:
  /// Throws std::invalid_argument on rotor, servo or battery parameters or settings that validate()
  /// refuses.
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

  /// Takes the measured `voltage` of the battery [V]. Returns whether voltage_ratio() accepts it;
  /// if not, the last one holds.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(battery_, voltage);
    if (ratio) voltage_ratio_ = *ratio;
    return ratio.has_value();
  }

  /// Nothing if a speed or an angle is not finite: the last outputs had better stay.
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

  /// What the actuators are told by `outputs`. NaN is a motor that is disarmed, and stands still;
  /// where a disarmed servo stands nobody knows: nothing if a servo's output is not finite.
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
  double voltage_ratio_ = 1.0;  ///< measured over nominal
  ActuatorOutputSettings<Rotors> settings_;
};

}  // namespace tilt_ropter
