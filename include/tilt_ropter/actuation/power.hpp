// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cstddef>
#include <string>

/// Electrical power from rotor speeds.
namespace tilt_ropter {

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
  /// less power than electronics and servos, or if the hover speed is so low that the power would
  /// overflow.
  template <int Rotors>
  explicit PowerModel(const Vehicle<Rotors>& vehicle)
      : PowerModel(vehicle, speeds_in_hover(vehicle)) {}

  /// For a vehicle whose rotors carry different parts of m g, such as a vehicle whose rotors push
  /// against each other. `hover` are the rotor speeds in hover [rad/s]. Throws like the constructor
  /// above.
  template <int Rotors>
  PowerModel(const Vehicle<Rotors>& vehicle, const Eigen::Matrix<double, Rotors, 1>& hover)
      : PowerModel(vehicle.power, hover, servo_count(vehicle)) {}

  /// The same for `servos` servos and a vector `hover` of any length. By default every rotor has a
  /// servo.
  template <typename Derived>
  PowerModel(const PowerParameters& parameters, const Eigen::MatrixBase<Derived>& hover)
      : PowerModel(parameters, hover, static_cast<int>(hover.size())) {}
  template <typename Derived>
  PowerModel(const PowerParameters& parameters, const Eigen::MatrixBase<Derived>& hover, int servos)
      : at_rest_(parameters.electronics + servos * parameters.servo_hold),
        servo_move_(parameters.servo_move) {
    validate(parameters);
    require(servos >= 0, "PowerModel: number of servos", servos, ">= 0");
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

  /// Power of electronics and servos at rest [W].
  [[nodiscard]] double at_rest() const noexcept { return at_rest_; }

  /// Coefficient c [W s^3].
  [[nodiscard]] double coefficient() const noexcept { return coefficient_; }

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

  double at_rest_;     // electronics and servos [W]
  double servo_move_;  // [J/rad]
  double coefficient_ = 0.0;
};

}  // namespace tilt_ropter
