// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// State of the error-state filter, its error, and its motion under an IMU sample, after J. Solà,
/// "Quaternion kinematics for the error-state Kalman filter", 2017, Secs. 5-7 (local orientation
/// errors). Nothing here throws or allocates.
namespace tilt_ropter {

/// Estimated state.
template <typename Scalar>
struct InertialState {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< of the IMU in the world [m]
  Vector3<Scalar> velocity = Vector3<Scalar>::Zero();  ///< of the IMU in the world [m/s]
  Eigen::Quaternion<Scalar> orientation = Eigen::Quaternion<Scalar>::Identity();  ///< body -> world
  Vector3<Scalar> gyro_bias = Vector3<Scalar>::Zero();                            ///< [rad/s]
  Vector3<Scalar> accelerometer_bias = Vector3<Scalar>::Zero();                   ///< [m/s^2]
  Eigen::Quaternion<Scalar> marker_orientation =
      Eigen::Quaternion<Scalar>::Identity();                  ///< marker frame M -> body
  Vector3<Scalar> marker_position = Vector3<Scalar>::Zero();  ///< origin of M in the body frame [m]
};
using InertialStated = InertialState<double>;  ///< in double precision

/// Error of an InertialState, in the order of its members. Orientation errors are rotation vectors
/// in the frame from which the orientation rotates: body, and M for the marker's orientation.
template <typename Scalar>
using InertialTangent = Eigen::Matrix<Scalar, 21, 1>;
using InertialTangentd = InertialTangent<double>;  ///< in double precision

/// Start of each part of an InertialTangent and of its covariance. Each part has three entries.
struct InertialIndex {
  static constexpr int position = 0, velocity = 3, orientation = 6, gyro_bias = 9,
                       accelerometer_bias = 12, marker_orientation = 15, marker_position = 18,
                       size = 21;
};

/// Returns x (+) dx.
template <typename Scalar>
[[nodiscard]] InertialState<Scalar> retract(const InertialState<Scalar>& x,
                                            const InertialTangent<Scalar>& dx) {
  using I = InertialIndex;
  const auto part = [&dx](int start) { return dx.template segment<3>(start); };
  InertialState<Scalar> y;
  y.position = x.position + part(I::position);
  y.velocity = x.velocity + part(I::velocity);
  y.orientation = (x.orientation * quaternion_exp(part(I::orientation))).normalized();
  y.gyro_bias = x.gyro_bias + part(I::gyro_bias);
  y.accelerometer_bias = x.accelerometer_bias + part(I::accelerometer_bias);
  y.marker_orientation =
      (x.marker_orientation * quaternion_exp(part(I::marker_orientation))).normalized();
  y.marker_position = x.marker_position + part(I::marker_position);
  return y;
}

/// Returns y (-) x, so that retract(x, difference(y, x)) = y. With y the true state and P the
/// covariance, the result is the error e of the NEES e' P^-1 e.
template <typename Scalar>
[[nodiscard]] InertialTangent<Scalar> difference(const InertialState<Scalar>& y,
                                                 const InertialState<Scalar>& x) {
  const auto turn = [](const Eigen::Quaternion<Scalar>& to, const Eigen::Quaternion<Scalar>& from) {
    return quaternion_log(Eigen::Quaternion<Scalar>(from.conjugate() * to));
  };
  InertialTangent<Scalar> dx;
  dx << y.position - x.position, y.velocity - x.velocity, turn(y.orientation, x.orientation),
      y.gyro_bias - x.gyro_bias, y.accelerometer_bias - x.accelerometer_bias,
      turn(y.marker_orientation, x.marker_orientation), y.marker_position - x.marker_position;
  return dx;
}

/// Returns the state `dt` [s] later, for a constant sample. The mean of the samples at both ends
/// makes the step second order. The rotation is exact, the acceleration is that in the middle.
template <typename Scalar>
[[nodiscard]] InertialState<Scalar> propagate(const InertialState<Scalar>& x,
                                              const InertialSample<Scalar>& sample,
                                              const Scalar& dt) {
  const Vector3<Scalar> half_turn =
      (sample.angular_velocity - x.gyro_bias) * Scalar(dt / Scalar(2));
  const Eigen::Quaternion<Scalar> half = quaternion_exp(half_turn);
  const Eigen::Quaternion<Scalar> middle = x.orientation * half;
  Vector3<Scalar> acceleration = middle * (sample.specific_force - x.accelerometer_bias);
  acceleration.z() -= Scalar(gravity);
  InertialState<Scalar> y = x;
  y.position += dt * (x.velocity + acceleration * Scalar(dt / Scalar(2)));
  y.velocity += dt * acceleration;
  y.orientation = (middle * half).normalized();
  return y;
}

/// Derivative of propagate() by the first 15 entries of the error; position, velocity and
/// orientation of the result. The other parts do not change.
template <typename Scalar>
[[nodiscard]] Eigen::Matrix<Scalar, 9, 15> transition(const InertialState<Scalar>& x,
                                                      const InertialSample<Scalar>& sample,
                                                      const Scalar& dt) {
  using I = InertialIndex;
  const Vector3<Scalar> turn = (sample.angular_velocity - x.gyro_bias) * dt;
  const Vector3<Scalar> force = sample.specific_force - x.accelerometer_bias;
  const Scalar half = dt / Scalar(2);
  const Matrix3<Scalar> rotation =
      (x.orientation * quaternion_exp(turn / Scalar(2))).toRotationMatrix();
  const Matrix3<Scalar> half_rotation =
      quaternion_exp(turn / Scalar(2)).conjugate().toRotationMatrix();
  // Derivatives of the acceleration by orientation, gyro bias and accelerometer bias. In the middle
  // of the step, an orientation error from the start is rotated by half the turn.
  const Matrix3<Scalar> by_middle = -rotation * skew(force);
  Eigen::Matrix<Scalar, 9, 15> f = Eigen::Matrix<Scalar, 9, 15>::Zero();
  auto acceleration = f.template block<3, 9>(I::velocity, I::orientation);
  acceleration.template leftCols<3>().noalias() = dt * by_middle * half_rotation;
  acceleration.template middleCols<3>(I::gyro_bias - I::orientation).noalias() =
      (-dt * half) * by_middle * right_jacobian(turn / Scalar(2));
  acceleration.template rightCols<3>() = -dt * rotation;
  f.template block<3, 9>(I::position, I::orientation) = half * acceleration;
  f.template block<3, 3>(I::position, I::velocity).diagonal().setConstant(dt);
  f.template topLeftCorner<6, 6>().diagonal().setOnes();
  f.template block<3, 3>(I::orientation, I::orientation) = half_rotation * half_rotation;
  f.template block<3, 3>(I::orientation, I::gyro_bias) = -dt * right_jacobian(turn);
  return f;
}

}  // namespace tilt_ropter
