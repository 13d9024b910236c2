// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cstddef>

/// Electrical power from rotor speeds.
namespace tilt_ropter {

/// Electrical power P = electronics + c sum Omega^3. The second term is the aerodynamic power of
/// propellers that do not move through the air. c is such that hover takes PowerParameters.hover
/// (paper, Sec. Energy Efficiency). All rotors have the same c, also rotors with their own
/// parameters. If the propellers differ much, the power of each rotor is inaccurate, but the sum in
/// hover is right. Does not allocate. Only constructors throw.
class PowerModel {
 public:
  /// For a vehicle whose rotors carry equal parts of m g in hover. Each rotor's speed follows from
  /// its own curve. Throws std::invalid_argument if the parameters fail validate(), or if the hover
  /// speed is so low that the power would overflow.
  template <int Rotors>
  explicit PowerModel(const Vehicle<Rotors>& vehicle)
      : PowerModel(vehicle.power, speeds_in_hover(vehicle)) {}

  /// For a vehicle whose rotors carry different parts of m g, such as a vehicle whose rotors push
  /// against each other. `hover` are the rotor speeds in hover [rad/s], a vector of any length.
  /// Throws like the constructor above.
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
  /// finite or above 1e9 rad/s counts as zero.
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

  double electronics_;
  double coefficient_ = 0.0;
};

}  // namespace tilt_ropter
