// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/measurement_model.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

/// Measurement models of position, height, range, heading and pose for Ekf::on_measurement. The
/// derivatives follow from q = q_bar (x) Exp(dtheta). Nothing here throws or allocates.
namespace tilt_ropter {

/// Standard deviation of white noise that has the same effect on a slow estimate as an error of
/// `stddev` with this correlation time [s], sampled at `rate` [Hz]: stddev * sqrt(2 time rate).
/// Example: the drift of a barometer.
template <typename Scalar>
[[nodiscard]] Scalar white_stddev(const Scalar& stddev, const Scalar& correlation_time,
                                  const Scalar& rate) noexcept {
  using std::sqrt;
  const Scalar samples = Scalar(2) * correlation_time * rate;
  return samples > Scalar(1) ? Scalar(stddev * sqrt(samples)) : stddev;
}

/// Position of an antenna, three rows.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 3> linearise(const PositionMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  const BodyPoint<Scalar> point(at, m.antenna);
  Linearised<Scalar, 3> h;
  h.residual = m.position - point.position;
  h.by(I::position).setIdentity();
  h.by(I::orientation) = point.position_by_turn;
  h.noise = m.covariance;
  return h;
}

/// Height of a sensor, one row.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 1> linearise(const HeightMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  const BodyPoint<Scalar> point(at, m.sensor);
  Linearised<Scalar, 1> h;
  h.residual(0) = m.height - point.position.z();
  h.jacobian(0, I::position + 2) = Scalar(1);
  h.by(I::orientation) = point.position_by_turn.row(2);
  h.noise(0) = m.stddev * m.stddev;
  return h;
}

/// Distance to a plane along a beam, one row: r = (c - n'x) / (n'R d), with the sensor at x and the
/// beam d in the body frame. Over level ground a tilt has an effect of second order only, r a^2
/// / 2. At 10 m and 45 mrad this is 1 cm: its mean and variance are part of the residual and the
/// noise. Not valid if the beam does not meet the ground within 80 degrees of its normal.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 1> linearise(const RangeMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  const BodyPoint<Scalar> point(at, m.sensor);
  const Vector3<Scalar>& n = m.ground.normal;
  const Scalar descent = -n.dot(point.rotation * m.direction);
  const Scalar height = n.dot(point.position) - m.ground.offset;
  Linearised<Scalar, 1> h;
  h.valid = descent > Scalar(0.17) && height > Scalar(0);
  if (!h.valid) return h;
  const Scalar range = height / descent;
  h.residual(0) = m.range - range;
  h.by(I::position) = n.transpose() / descent;
  // d descent / d turn = n' R skew(d)
  h.by(I::orientation) = (n.transpose() * point.position_by_turn -
                          range * n.transpose() * point.rotation * skew(m.direction)) /
                         descent;
  // Second derivatives of the sensor's height, of the descent and of their quotient by the turn.
  const Vector3<Scalar> up = point.rotation.transpose() * n;
  const auto bend = [&up](const Vector3<Scalar>& arm) -> Matrix3<Scalar> {
    const Matrix3<Scalar> product = up * arm.transpose();
    return (product + product.transpose()) / Scalar(2) - up.dot(arm) * Matrix3<Scalar>::Identity();
  };
  const Vector3<Scalar> rise = point.arm.cross(up), fall = up.cross(m.direction);
  const Matrix3<Scalar> product = (rise - range * fall) * fall.transpose() / (descent * descent);
  const Matrix3<Scalar> curvature =
      (bend(point.arm) + range * bend(m.direction)) / descent - product - product.transpose();
  const Matrix3<Scalar> spread = curvature * at.orientation_covariance;
  h.residual(0) -= spread.trace() / Scalar(2);
  h.noise(0) = m.stddev * m.stddev + (spread * spread).trace() / Scalar(2);
  return h;
}

/// Heading, one row. Not valid if body x is within 6 degrees of the vertical.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 1> linearise(const HeadingMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using std::cos;
  using std::sin;
  using I = InertialIndex;
  const Matrix3<Scalar> rotation = at.state.orientation.toRotationMatrix();
  const Scalar &x = rotation(0, 0), &y = rotation(1, 0);
  const Scalar square = x * x + y * y;
  Linearised<Scalar, 1> h;
  h.valid = square > Scalar(0.01);
  if (!h.valid) return h;
  // The difference of two headings, without wrapping: angle of (cos, sin) relative to (x, y).
  using std::atan2;
  const Scalar c = cos(m.heading), s = sin(m.heading);
  h.residual(0) = atan2(x * s - y * c, x * c + y * s);
  const Matrix3<Scalar> turned = -rotation * skew(Vector3<Scalar>::UnitX());
  h.by(I::orientation) = (x * turned.row(1) - y * turned.row(0)) / square;
  h.noise(0) = m.stddev * m.stddev;
  return h;
}

/// Pose of a sensor, six rows: position in the world frame, orientation in the sensor frame.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 6> linearise(const PoseMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  const BodyPoint<Scalar> point(at, m.sensor);
  Linearised<Scalar, 6> h;
  h.residual.template head<3>() = m.position - point.position;
  h.residual.template tail<3>() = quaternion_log(Eigen::Quaternion<Scalar>(
      (at.state.orientation * m.sensor_orientation).conjugate() * m.orientation.normalized()));
  h.by(I::position).template topRows<3>().setIdentity();
  h.by(I::orientation).template topRows<3>() = point.position_by_turn;
  h.by(I::orientation).template bottomRows<3>() =
      m.sensor_orientation.conjugate().toRotationMatrix();
  h.noise = m.covariance;
  return h;
}

}  // namespace tilt_ropter
