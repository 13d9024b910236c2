// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/measurement_model.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Measurement models of velocity and optical flow for Ekf::on_measurement. The velocity of a
/// sensor away from the IMU contains the angular velocity of one gyro sample. Nothing here throws
/// or allocates.
namespace tilt_ropter {

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
