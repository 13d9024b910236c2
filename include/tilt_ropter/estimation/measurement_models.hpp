// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/measurement_model.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

/// Measurement models for Ekf::on_measurement. Positions, velocities and directions of sensors that
/// are mounted anywhere on the body; and of wheels on the ground: no sideways slip, height over the
/// ground, wheel speed. The models of wheels let the vehicle drive for a while without position:
/// use them only while it is on the ground (ContactEstimate). Nothing here throws or allocates.
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
/// that leans by a is radius * cos(a) below its centre: a difference below 1 % up to 8 degrees.
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

/// The forward velocity of the wheel's centre is radius * (speed + w_y), one row [m/s], forward f =
/// y x n / |y x n| with the ground's normal n, body frame. Not valid if y is within 6 degrees of n.
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

/// Height of a sensor, one row: that of a wheel above level ground.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 1> linearise(const HeightMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  return linearise(WheelHeightMeasurement<Scalar>{m.height, m.stddev, m.sensor, {}}, at);
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

/// Velocity of an antenna in the world frame, three rows.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 3> linearise(const WorldVelocityMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  const BodyPoint<Scalar> point(at, m.antenna);
  Linearised<Scalar, 3> h;
  h.residual = m.velocity - point.rotation * point.velocity;
  h.by(I::velocity).setIdentity();
  h.by(I::orientation) = -point.rotation * skew(at.angular_velocity.cross(point.arm));
  h.by(I::gyro_bias) = point.rotation * skew(point.arm);
  h.noise = m.covariance;
  return h;
}

/// Velocity of a sensor in the body frame, three rows.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 3> linearise(const BodyVelocityMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  const BodyPoint<Scalar> point(at, m.sensor);
  Linearised<Scalar, 3> h;
  h.residual = m.velocity - point.velocity;
  point.add_velocity(Matrix3<Scalar>::Identity().eval(), h);
  h.noise = m.covariance;
  return h;
}

/// Optical flow over a plane, two rows. With the velocity v of the camera in the body frame and the
/// distance d of the ground along -z: (w_y - v_x / d, -w_x - v_y / d). Not valid below 2 cm or
/// above 80 degrees of tilt from the ground's normal.
template <typename Scalar>
[[nodiscard]] Linearised<Scalar, 2> linearise(const FlowMeasurement<Scalar>& m,
                                              const InertialMotion<Scalar>& at) noexcept {
  using I = InertialIndex;
  const BodyPoint<Scalar> point(at, m.camera);
  const Vector3<Scalar>& n = m.ground.normal;
  const Vector3<Scalar> up = point.rotation.transpose() * n;  // normal in the body frame
  const Scalar height = n.dot(point.position) - m.ground.offset;
  Linearised<Scalar, 2> h;
  h.valid = up.z() > Scalar(0.17) && height > Scalar(0.02);
  if (!h.valid) return h;
  const Scalar inverse = up.z() / height;  // 1 / d
  const Vector3<Scalar>& w = at.angular_velocity;
  const Eigen::Matrix<Scalar, 2, 1> v = point.velocity.template head<2>();
  h.residual << m.flow.x() - (w.y() - v.x() * inverse), m.flow.y() - (-w.x() - v.y() * inverse);
  Eigen::Matrix<Scalar, 2, 3> axes = Eigen::Matrix<Scalar, 2, 3>::Zero();
  axes(0, 0) = axes(1, 1) = -inverse;
  point.add_velocity(axes, h);
  h.jacobian(0, I::gyro_bias + 1) -= Scalar(1);
  h.jacobian(1, I::gyro_bias) += Scalar(1);
  // d (1/d): by the height, and by the tilt, d up / d turn = skew(up).
  const Scalar by_height = -inverse / height;
  h.by(I::position) -= v * (by_height * n.transpose());
  h.by(I::orientation) -=
      v * (by_height * n.transpose() * point.position_by_turn + skew(up).row(2) / height);
  h.noise = m.stddev * m.stddev * Eigen::Matrix<Scalar, 2, 2>::Identity();
  return h;
}

}  // namespace tilt_ropter
