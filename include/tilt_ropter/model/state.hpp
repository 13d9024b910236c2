// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// What moves: wrench, body state and the NMPC's state, with their packed form.
namespace tilt_ropter {

/// Force [N] and torque [N m] that act at the CoM, both in the body frame; for other points and
/// frames see wrench.hpp.
template <typename Scalar = double>
struct Wrench {
  Vector3<Scalar> force = Vector3<Scalar>::Zero();
  Vector3<Scalar> torque = Vector3<Scalar>::Zero();
};

/// Speed and tilt angle of every rotor: as commanded, measured, modelled or true.
template <int Rotors, typename Scalar = double>
struct ActuatorState {
  Eigen::Matrix<Scalar, Rotors, 1> rotor_speed =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [rad/s], >= 0
  Eigen::Matrix<Scalar, Rotors, 1> tilt_angle =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< about the rotor frame's x [rad]
};

/// Pose and twist of the body frame: what a state estimator delivers.
template <typename Scalar = double>
struct BodyState {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< CoM in the world frame (ENU) [m]
  Vector3<Scalar> velocity = Vector3<Scalar>::Zero();  ///< CoM in the world frame [m/s]
  Eigen::Quaternion<Scalar> orientation =
      Eigen::Quaternion<Scalar>::Identity();                   ///< body -> world, unit
  Vector3<Scalar> angular_velocity = Vector3<Scalar>::Zero();  ///< body frame [rad/s]
};

/// State of the paper's NMPC, x = (F, M, p, v, q, w) (paper, Sec. States and Inputs): the body and
/// the wrench of its actuators.
template <typename Scalar = double>
struct State {
  Wrench<Scalar> wrench;
  BodyState<Scalar> body;
};

/// Tangent vector of a State: (dF, dM, dp, dv, dtheta, dw), dtheta in the body frame.
template <typename Scalar = double>
using StateTangent = Eigen::Matrix<Scalar, 18, 1>;

/// Where each part of a StateTangent starts; those of a wrench and of its rate start likewise.
struct TangentIndex {
  static constexpr int force = 0, torque = 3, position = 6, velocity = 9, orientation = 12,
                       angular_velocity = 15;
};

/// Where each part of a PackedState starts.
struct PackedIndex {
  static constexpr int force = 0, torque = 3, position = 6, velocity = 9, orientation = 12,
                       angular_velocity = 16;
};

/// Packed State in the paper's order (F, M, p, v, q, w), q as (w, x, y, z).
template <typename Scalar = double>
using PackedState = Eigen::Matrix<Scalar, 19, 1>;

/// The one place where quaternions turn from Eigen's storage order (x, y, z, w) into the paper's
/// (w, x, y, z).
template <typename Scalar>
[[nodiscard]] PackedState<Scalar> pack(const State<Scalar>& x) {
  PackedState<Scalar> packed;
  const Eigen::Quaternion<Scalar>& q = x.body.orientation;
  packed << x.wrench.force, x.wrench.torque, x.body.position, x.body.velocity, q.w(), q.x(), q.y(),
      q.z(), x.body.angular_velocity;
  return packed;
}

/// Inverse of pack(). The quaternion is taken as it comes, not normalised.
template <typename Scalar>
[[nodiscard]] State<Scalar> unpack(const PackedState<Scalar>& packed) {
  using I = PackedIndex;
  State<Scalar> x;
  x.wrench.force = packed.template segment<3>(I::force);
  x.wrench.torque = packed.template segment<3>(I::torque);
  x.body.position = packed.template segment<3>(I::position);
  x.body.velocity = packed.template segment<3>(I::velocity);
  const Eigen::Matrix<Scalar, 4, 1> q = packed.template segment<4>(I::orientation);
  x.body.orientation = Eigen::Quaternion<Scalar>(q(0), q(1), q(2), q(3));
  x.body.angular_velocity = packed.template segment<3>(I::angular_velocity);
  return x;
}

/// x (+) dx: the state reached from x along the tangent vector dx.
template <typename Scalar>
[[nodiscard]] State<Scalar> retract(const State<Scalar>& x, const StateTangent<Scalar>& dx) {
  using I = TangentIndex;
  State<Scalar> y;
  const auto add = [&dx](const Vector3<Scalar>& from, int first, Vector3<Scalar>& to) {
    for (int i = 0; i < 3; ++i) to(i) = from(i) + dx(first + i);
  };
  add(x.wrench.force, I::force, y.wrench.force);
  add(x.wrench.torque, I::torque, y.wrench.torque);
  add(x.body.position, I::position, y.body.position);
  add(x.body.velocity, I::velocity, y.body.velocity);
  constexpr int r = I::orientation;
  y.body.orientation =
      (x.body.orientation * quaternion_exp(Vector3<Scalar>(dx(r), dx(r + 1), dx(r + 2))))
          .normalized();
  add(x.body.angular_velocity, I::angular_velocity, y.body.angular_velocity);
  return y;
}

/// y (-) x: the tangent vector at x that reaches y, so retract(x, difference(y, x)) = y.
template <typename Scalar>
[[nodiscard]] StateTangent<Scalar> difference(const State<Scalar>& y, const State<Scalar>& x) {
  using I = TangentIndex;
  StateTangent<Scalar> dx;
  const auto subtract = [&dx](const Vector3<Scalar>& to, const Vector3<Scalar>& from, int first) {
    for (int i = 0; i < 3; ++i) dx(first + i) = to(i) - from(i);
  };
  subtract(y.wrench.force, x.wrench.force, I::force);
  subtract(y.wrench.torque, x.wrench.torque, I::torque);
  subtract(y.body.position, x.body.position, I::position);
  subtract(y.body.velocity, x.body.velocity, I::velocity);
  const Vector3<Scalar> turn = quaternion_log(
      Eigen::Quaternion<Scalar>(x.body.orientation.conjugate() * y.body.orientation));
  for (int i = 0; i < 3; ++i) dx(I::orientation + i) = turn(i);
  subtract(y.body.angular_velocity, x.body.angular_velocity, I::angular_velocity);
  return dx;
}

/// True if every number is finite and the quaternion can be normalised.
template <typename Scalar>
[[nodiscard]] bool is_finite(const BodyState<Scalar>& x) noexcept {
  return all_finite(x.position) && all_finite(x.velocity) && all_finite(x.orientation.coeffs()) &&
         x.orientation.squaredNorm() > Scalar(1e-6) && all_finite(x.angular_velocity);
}

/// True if every number is finite.
template <typename Scalar>
[[nodiscard]] bool is_finite(const Wrench<Scalar>& w) noexcept {
  return all_finite(w.force) && all_finite(w.torque);
}

}  // namespace tilt_ropter
