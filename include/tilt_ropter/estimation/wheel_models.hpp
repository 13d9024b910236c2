// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/measurement_model.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Measurement models of wheels on the ground for Ekf::on_measurement: no sideways slip, height
/// over the ground, wheel speed. Together they let the vehicle drive for a while without position.
/// Use them only while the vehicle is on the ground (ContactEstimate). Nothing here throws or
/// allocates.
namespace tilt_ropter {

/// The velocity of the axle along itself is zero, one row.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 1> linearise(const NoSlipMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  const BodyPoint<Scalar> point(at, m.axle);
  Linearised<Scalar, 1> h;
  h.residual(0) = -m.along.dot(point.velocity);
  point.template add_velocity<1>(m.along.transpose(), h);
  h.noise(0) = m.stddev * m.stddev;
  return h;
}

/// The centre of the wheel is one radius above the ground, one row. The lowest point of a wheel
/// that leans by a is at radius * cos(a) below its centre; the difference is below 1 % up to 8
/// degrees.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 1> linearise(const WheelHeightMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  const BodyPoint<Scalar> point(at, m.wheel);
  Linearised<Scalar, 1> h;
  h.residual(0) = m.radius - (m.ground.normal.dot(point.position) - m.ground.offset);
  h.by(I::position) = m.ground.normal.transpose();
  h.by(I::orientation) = m.ground.normal.transpose() * point.position_by_turn;
  h.noise(0) = m.stddev * m.stddev;
  return h;
}

/// The forward velocity of the wheel's centre is radius * (speed + w_y), one row, in [m/s]. Forward
/// is f = y x n / |y x n|, with the ground's normal n in the body frame. Not valid if the axle is
/// within 6 degrees of the normal.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 1> linearise(const WheelSpeedMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  using std::sqrt;
  const BodyPoint<Scalar> point(at, m.wheel);
  const Vector3<Scalar> up = point.rotation.transpose() * m.ground_normal;
  const Vector3<Scalar> across = Vector3<Scalar>::UnitY().cross(up);
  const Scalar square = across.squaredNorm();
  Linearised<Scalar, 1> h;
  h.valid = square > Scalar(0.01);
  if (!h.valid) return h;
  const Scalar length = sqrt(square);
  const Vector3<Scalar> forward = across / length;
  h.residual(0) = m.radius * (m.speed + at.angular_velocity.y()) - forward.dot(point.velocity);
  point.template add_velocity<1>(forward.transpose(), h);
  h.jacobian(0, I::gyro_bias + 1) += m.radius;
  // d forward / d turn = (I - f f') skew(y) skew(up) / |y x n|
  const Vector3<Scalar> rest = point.velocity - forward * forward.dot(point.velocity);
  h.by(I::orientation) += rest.transpose() * skew(Vector3<Scalar>::UnitY()) * skew(up) / length;
  h.noise(0) = m.stddev * m.stddev * m.radius * m.radius;
  return h;
}

}  // namespace tilt_ropter
