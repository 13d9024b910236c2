// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/inertial_state.hpp>
#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>

/// What a measurement model gives to the error-state filter: residual, Jacobian and noise at the
/// predicted motion. Nothing here throws or allocates.
namespace tilt_ropter {

/// Predicted motion at the time of a measurement.
template <typename Scalar>
struct InertialMotion {
  InertialState<Scalar> state;                                 ///< of the filter, at the IMU
  Vector3<Scalar> angular_velocity = Vector3<Scalar>::Zero();  ///< gyro minus bias, body [rad/s]
  Vector3<Scalar> imu_position = Vector3<Scalar>::Zero();      ///< of the IMU, body frame [m]
  /// Covariance of the orientation error, body frame [rad^2], for models that are far from linear.
  Matrix3<Scalar> orientation_covariance = Matrix3<Scalar>::Zero();
};
using InertialMotiond = InertialMotion<double>;  ///< in double precision

/// A measurement linearised at the predicted motion. `residual` = measured - predicted is
/// jacobian * error + noise to first order. The error is an InertialTangent (true (-) predicted).
template <typename Scalar, int Rows>
struct Linearised {
  static_assert(Rows >= 1 && Rows <= 6, "a measurement has 1 to 6 rows");
  static constexpr int rows = Rows;
  using Square = Eigen::Matrix<Scalar, Rows, Rows>;
  using Columns = Eigen::Matrix<Scalar, InertialIndex::size, Rows>;

  Eigen::Matrix<Scalar, Rows, 1> residual = Eigen::Matrix<Scalar, Rows, 1>::Zero();
  /// H, the derivative of the predicted measurement by the error.
  Eigen::Matrix<Scalar, Rows, InertialIndex::size> jacobian =
      Eigen::Matrix<Scalar, Rows, InertialIndex::size>::Zero();
  Square noise = Square::Identity();  ///< R, covariance of the noise
  /// Derivative of the measurement by time [1/s], if its stamp may be wrong.
  Eigen::Matrix<Scalar, Rows, 1> by_time = Eigen::Matrix<Scalar, Rows, 1>::Zero();
  bool valid = true;  ///< false: the model has no prediction here

  /// Three columns of H from `start` (see InertialIndex).
  [[nodiscard]] auto by(int start) noexcept { return jacobian.template middleCols<3>(start); }

  /// Returns m H'. Skips what the measurement does not depend on.
  [[nodiscard]] Columns times_transpose(
      const Eigen::Matrix<Scalar, InertialIndex::size, InertialIndex::size>& m) const noexcept {
    Columns product = Columns::Zero();
    for (int k = 0; k < InertialIndex::size; ++k)
      for (int r = 0; r < Rows; ++r) {
        const Scalar& by = jacobian(r, k);
        if (by == Scalar(0)) continue;
        for (int i = 0; i < InertialIndex::size; ++i) product(i, r) += m(i, k) * by;
      }
    return product;
  }
  /// Returns H c.
  template <int N>
  [[nodiscard]] Eigen::Matrix<Scalar, Rows, N> times(
      const Eigen::Matrix<Scalar, InertialIndex::size, N>& c) const noexcept {
    Eigen::Matrix<Scalar, Rows, N> product = Eigen::Matrix<Scalar, Rows, N>::Zero();
    detail::add_product<Rows, InertialIndex::size, N>(jacobian.data(), detail::entries(c),
                                                      product.data());
    return product;
  }
  /// Returns g R.
  [[nodiscard]] Columns times_noise(const Columns& g) const noexcept {
    Columns product = Columns::Zero();
    detail::add_product<InertialIndex::size, Rows, Rows>(g.data(), detail::entries(noise),
                                                         product.data());
    return product;
  }
  void add_noise(Square& s) const noexcept { s += noise; }
  /// True if every number is finite, and the noise positive definite without stddev above 1e5.
  [[nodiscard]] bool is_usable() const noexcept {
    return all_finite(residual) && all_finite(jacobian) && all_finite(noise) &&
           noise.diagonal().maxCoeff() <= Scalar(1e10) && detail::Cholesky(noise).is_definite;
  }
};

/// Position and velocity of a point that is fixed to the body, with their derivatives by the error.
template <typename Scalar>
struct BodyPoint {
  /// The point is at `place` in the body frame [m].
  BodyPoint(const InertialMotion<Scalar>& at, const Vector3<Scalar>& place) noexcept
      : arm(place - at.imu_position),
        rotation(at.state.orientation.toRotationMatrix()),
        position(at.state.position + rotation * arm),
        imu_velocity(rotation.transpose() * at.state.velocity),
        velocity(imu_velocity + at.angular_velocity.cross(arm)),
        position_by_turn(-rotation * skew(arm)) {}

  Vector3<Scalar> arm;               ///< from the IMU, body frame [m]
  Matrix3<Scalar> rotation;          ///< body -> world
  Vector3<Scalar> position;          ///< world frame [m]
  Vector3<Scalar> imu_velocity;      ///< of the IMU, body frame [m/s]
  Vector3<Scalar> velocity;          ///< of the point, body frame [m/s]
  Matrix3<Scalar> position_by_turn;  ///< d position / d orientation error

  /// Adds d (axes * velocity) / d error to the rows of `h`, with axes constant in the body frame.
  template <int Rows>
  void add_velocity(const Eigen::Matrix<Scalar, Rows, 3>& axes,
                    Linearised<Scalar, Rows>& h) const noexcept {
    using I = InertialIndex;
    h.by(I::velocity) += axes * rotation.transpose();
    h.by(I::orientation) += axes * skew(imu_velocity);
    h.by(I::gyro_bias) += axes * skew(arm);
  }
};

}  // namespace tilt_ropter
