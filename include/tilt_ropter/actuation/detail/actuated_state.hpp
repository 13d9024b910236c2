// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

/// State of a vehicle at the level of actuators, and its tangent space.
namespace tilt_ropter {

/// Thrust and tilt angle of each rotor, and the body state.
template <int Rotors, typename Scalar = double>
struct ActuatedState {
  using Vector = Eigen::Matrix<Scalar, Rotors, 1>;
  Vector thrust = Vector::Zero();      ///< [N]
  Vector tilt_angle = Vector::Zero();  ///< about the rotor frame's x [rad]
  BodyState<Scalar> body;
};

/// First index of each part of a tangent vector of ActuatedState: (dT, dalpha, dp, dv, dtheta, dw),
/// with dtheta in the body frame. In an input, the thrust rates come first, then the tilt rates.
template <int Rotors>
struct ActuatedIndex {
  static constexpr int thrust = 0, tilt_angle = Rotors, position = 2 * Rotors,
                       velocity = position + 3, orientation = position + 6,
                       angular_velocity = position + 9;
};

/// Tangent vector of an ActuatedState.
template <int Rotors, typename Scalar = double>
using ActuatedTangent = Eigen::Matrix<Scalar, 2 * Rotors + 12, 1>;

/// Returns x (+) dx.
template <int Rotors, typename Scalar>
[[nodiscard]] ActuatedState<Rotors, Scalar> retract(const ActuatedState<Rotors, Scalar>& x,
                                                    const ActuatedTangent<Rotors, Scalar>& dx) {
  ActuatedState<Rotors, Scalar> y;
  for (int i = 0; i < Rotors; ++i) {
    y.thrust(i) = x.thrust(i) + dx(i);
    y.tilt_angle(i) = x.tilt_angle(i) + dx(Rotors + i);
  }
  y.body = detail::retract_body(x.body, dx, 2 * Rotors);
  return y;
}

/// Returns y (-) x, so that retract(x, difference(y, x)) = y.
template <int Rotors, typename Scalar>
[[nodiscard]] ActuatedTangent<Rotors, Scalar> difference(const ActuatedState<Rotors, Scalar>& y,
                                                         const ActuatedState<Rotors, Scalar>& x) {
  ActuatedTangent<Rotors, Scalar> dx;
  for (int i = 0; i < Rotors; ++i) {
    dx(i) = y.thrust(i) - x.thrust(i);
    dx(Rotors + i) = y.tilt_angle(i) - x.tilt_angle(i);
  }
  detail::subtract_body(y.body, x.body, dx, 2 * Rotors);
  return dx;
}

}  // namespace tilt_ropter
