// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
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

/// Derivative F of propagate() by the error. Only position, velocity and orientation of the result
/// differ from the error before: they depend on its first 15 entries.
template <typename Scalar>
class InertialTransition {
 public:
  InertialTransition(const InertialState<Scalar>& x, const InertialSample<Scalar>& sample,
                     const Scalar& dt)
      : dt_(dt) {
    using detail::put, detail::square;
    const Vector3<Scalar> turn = (sample.angular_velocity - x.gyro_bias) * dt;
    const Vector3<Scalar> half_turn = turn * Scalar(0.5);
    const Eigen::Quaternion<Scalar> half = quaternion_exp(half_turn);
    const auto rotation = square((x.orientation * half).toRotationMatrix()),
               back = square(half.conjugate().toRotationMatrix());
    // In the middle of the step, an orientation error from the start is rotated by half the turn.
    const Vector3<Scalar> force = sample.specific_force - x.accelerometer_bias;
    const auto by_middle = Scalar(-dt) * times_cross(rotation, detail::triple(force));
    put(by_middle * back, push_, 0, 0);
    put(Scalar(-dt / Scalar(2)) * (by_middle * square(right_jacobian(half_turn))), push_, 0, 3);
    put(Scalar(-dt) * rotation, push_, 0, 6);
    put(back * back, turn_, 0, 0);
    put(Scalar(-dt) * square(right_jacobian(turn)), turn_, 0, 3);
  }

  /// Replaces `Count` vectors by F times these. The entries of a vector are `Along` numbers apart,
  /// and the vectors `Across`.
  template <int Along, int Across, int Count>
  void apply(Scalar* data) const noexcept {
    using I = InertialIndex;
    const auto entry = [data](int k, int i) -> Scalar& { return data[Along * k + Across * i]; };
    Scalar push[3][detail::size(Count)] = {}, turn[3][detail::size(Count)] = {};
    for (int c = 0; c < 3; ++c)
      for (int k = 0; k < 9; ++k)
        for (int i = 0; i < Count; ++i) {
          push[c][i] += push_(c, k) * entry(I::orientation + k, i);
          if (k < 6) turn[c][i] += turn_(c, k) * entry(I::orientation + k, i);
        }
    for (int c = 0; c < 3; ++c)
      for (int i = 0; i < Count; ++i) {
        entry(I::position + c, i) += dt_ * (entry(I::velocity + c, i) + push[c][i] / Scalar(2));
        entry(I::velocity + c, i) += push[c][i];
        entry(I::orientation + c, i) = turn[c][i];
      }
  }

 private:
  Scalar dt_;                         // [s]
  Eigen::Matrix<Scalar, 3, 9> push_;  // change of velocity by orientation and both biases
  Eigen::Matrix<Scalar, 3, 6> turn_;  // orientation by orientation and gyro bias
};

}  // namespace tilt_ropter
