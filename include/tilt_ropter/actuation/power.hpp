// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cstddef>

/// Electrical power from rotor speeds.
namespace tilt_ropter {

/// P = electronics + c sum Omega^3, the aerodynamic power of propellers at rest in air, with c such
/// that hover takes PowerParameters.hover (paper, Sec. Energy Efficiency). All rotors have the same
/// c, also those with parameters of their own: where propellers differ much, the shares of the
/// rotors are rough, and their sum in hover is right. Only constructors throw;
/// nothing allocates.
class PowerModel {
 public:
  /// For a vehicle whose rotors share m g equally in hover, each at the speed of its own curve.
  /// Throws std::invalid_argument on
  /// parameters that validate() refuses, and where hover takes so slow a speed that power would
  /// overflow.
  template <int Rotors>
  explicit PowerModel(const Vehicle<Rotors>& vehicle)
      : PowerModel(vehicle.power, speeds_in_hover(vehicle)) {}

  /// For one whose rotors do not, such as a vehicle whose rotors push against each other: `hover`
  /// are their speeds then [rad/s], a vector of any length. Throws likewise.
  template <typename Derived>
  PowerModel(const PowerParameters& parameters, const Eigen::MatrixBase<Derived>& hover)
      : electronics_(parameters.electronics) {
    validate(parameters);
    require_non_negative("PowerModel: speeds in hover [rad/s]", hover);
    double cubes = 0.0;
    for (Eigen::Index i = 0; i < hover.size(); ++i) cubes += hover(i) * hover(i) * hover(i);
    coefficient_ = (parameters.hover - electronics_) / cubes;
    require(coefficient_ < 1e200, "PowerModel's coefficient [W s^3]", coefficient_,
            "below 1e200; the hover speed is next to zero");
  }

  /// Power [W] at rotor speeds [rad/s], a vector of any length. A speed that is negative, not
  /// finite, or beyond 1e9 rad/s counts as zero.
  template <typename Derived>
  [[nodiscard]] typename Derived::Scalar power(
      const Eigen::MatrixBase<Derived>& rotor_speed) const noexcept {
    using Scalar = typename Derived::Scalar;
    Scalar sum(0);
    for (Eigen::Index i = 0; i < rotor_speed.size(); ++i) {
      const Scalar& speed = rotor_speed(i);
      if (speed > Scalar(0) && speed < Scalar(1e9)) sum += speed * speed * speed;
    }
    return Scalar(electronics_) + Scalar(coefficient_) * sum;
  }

  /// c [W s^3].
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

  double electronics_;
  double coefficient_ = 0.0;
};

}  // namespace tilt_ropter
