// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/one_processor.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

/// Functions of SO(3) for the rotation of a rigid body.
///
/// Quaternions are Hamilton and rotate from body to world. Their tangent space is the body frame:
/// q = q_bar (x) Exp(dtheta). Formulas follow J. Solà, "Quaternion kinematics for the error-state
/// Kalman filter", 2017. No function in this header throws or allocates. All functions work with
/// automatic differentiation, also at zero.
namespace tilt_ropter {

inline constexpr double pi = 3.14159265358979323846;

/// Vector of three components. The declaration of a variable states the frame.
template <typename Scalar>
using Vector3 = Eigen::Matrix<Scalar, 3, 1>;
/// Rotation matrix, inertia or Jacobian.
template <typename Scalar>
using Matrix3 = Eigen::Matrix<Scalar, 3, 3>;

/// Cross-product matrix: skew(a) * b = a x b.
template <typename Derived>
[[nodiscard]] Matrix3<typename Derived::Scalar> skew(const Eigen::MatrixBase<Derived>& a) {
  using Scalar = typename Derived::Scalar;
  Matrix3<Scalar> m;
  m << Scalar(0), -a.z(), a.y(), a.z(), Scalar(0), -a.x(), -a.y(), a.x(), Scalar(0);
  return m;
}

/// Returns the quaternion of a rotation vector `theta` [rad] (Solà, Eq. 101). Below 1e-3 rad a
/// series expansion keeps the derivative finite at zero.
template <typename Derived>
[[nodiscard]] Eigen::Quaternion<typename Derived::Scalar> quaternion_exp(
    const Eigen::MatrixBase<Derived>& theta) {
  using std::cos;
  using std::sin;
  using std::sqrt;
  using Scalar = typename Derived::Scalar;
  const Scalar square = theta.x() * theta.x() + theta.y() * theta.y() + theta.z() * theta.z();
  Scalar real, scale;
  if (square < Scalar(1e-6)) {
    real = Scalar(1) - square / Scalar(8) + square * square / Scalar(384);
    scale = Scalar(0.5) - square / Scalar(48) + square * square / Scalar(3840);
  } else {
    const Scalar angle = sqrt(square);
    const Scalar half = angle / Scalar(2);
    real = cos(half);
    scale = sin(half) / angle;
  }
  return {real, Scalar(scale * theta.x()), Scalar(scale * theta.y()), Scalar(scale * theta.z())};
}

/// Returns the rotation vector theta [rad] of a unit quaternion, by the shorter of the two
/// rotations: |theta| <= pi (Solà, Eq. 105).
template <typename Scalar>
[[nodiscard]] Vector3<Scalar> quaternion_log(const Eigen::Quaternion<Scalar>& q) {
  using std::atan2;
  using std::sqrt;
  const Scalar sign = q.w() < Scalar(0) ? Scalar(-1) : Scalar(1);
  const Scalar w = sign * q.w();
  const Scalar square = q.x() * q.x() + q.y() * q.y() + q.z() * q.z();
  Scalar scale;
  if (square < Scalar(1e-6)) {
    const Scalar ratio = square / (w * w);
    scale = Scalar(2) / w * (Scalar(1) - ratio / Scalar(3) + ratio * ratio / Scalar(5));
  } else {
    const Scalar n = sqrt(square);
    const Scalar half = atan2(n, w);
    scale = Scalar(2) * half / n;
  }
  const Scalar factor = sign * scale;
  return {Scalar(factor * q.x()), Scalar(factor * q.y()), Scalar(factor * q.z())};
}

/// Right Jacobian of SO(3): Exp(theta + e) = Exp(theta) Exp(J e) to first order in e
/// (Solà, Eq. 143).
template <typename Derived>
[[nodiscard]] Matrix3<typename Derived::Scalar> right_jacobian(
    const Eigen::MatrixBase<Derived>& theta) {
  using std::sin;
  using std::sqrt;
  using Scalar = typename Derived::Scalar;
  const Scalar square = theta.squaredNorm();
  Scalar first, second;  // (1 - cos) / angle^2 and (angle - sin) / angle^3
  if (square < Scalar(1e-6)) {
    first = Scalar(0.5) - square / Scalar(24) + square * square / Scalar(720);
    second = Scalar(1) / Scalar(6) - square / Scalar(120) + square * square / Scalar(5040);
  } else {
    const Scalar angle = sqrt(square);
    const Scalar half_sine = sin(angle / Scalar(2));
    first = Scalar(2) * half_sine * half_sine / square;
    second = (angle - sin(angle)) / (square * angle);
  }
  // I - first [theta]x + second [theta]x^2, with [theta]x^2 = theta theta' - |theta|^2 I.
  const Scalar x = theta.x(), y = theta.y(), z = theta.z(), rest = Scalar(1) - second * square;
  const Scalar x1 = first * x, y1 = first * y, z1 = first * z;
  const Scalar x2 = second * x, y2 = second * y, z2 = second * z;
  Matrix3<Scalar> jacobian;
  jacobian << Scalar(rest + x2 * x), Scalar(x2 * y + z1), Scalar(x2 * z - y1), Scalar(y2 * x - z1),
      Scalar(rest + y2 * y), Scalar(y2 * z + x1), Scalar(z2 * x + y1), Scalar(z2 * y - x1),
      Scalar(rest + z2 * z);
  return jacobian;
}

/// Returns the quaternion of a rotation by `yaw` [rad] about world z.
template <typename Scalar>
[[nodiscard]] Eigen::Quaternion<Scalar> quaternion_from_yaw(const Scalar& yaw) {
  using std::cos;
  using std::sin;
  return {cos(yaw / Scalar(2)), Scalar(0), Scalar(0), sin(yaw / Scalar(2))};
}

/// Returns the heading [rad] of the body x axis in the world's xy plane, in (-pi, pi].
template <typename Scalar>
[[nodiscard]] Scalar yaw_of(const Eigen::Quaternion<Scalar>& q) {
  using std::atan2;
  return atan2(Scalar(2) * (q.w() * q.z() + q.x() * q.y()),
               Scalar(1) - Scalar(2) * (q.y() * q.y() + q.z() * q.z()));
}

}  // namespace tilt_ropter
