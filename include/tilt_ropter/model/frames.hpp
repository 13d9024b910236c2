// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>

/// The frames of the paper; the axes of an autopilot (NED and FRD).
namespace tilt_ropter {

/// Returns the pose of B in I.
template <typename Scalar>
[[nodiscard]] Eigen::Transform<Scalar, 3, Eigen::Isometry> body_in_world(
    const BodyState<Scalar>& body) {
  Eigen::Transform<Scalar, 3, Eigen::Isometry> pose;
  pose.linear() = body.orientation.toRotationMatrix();
  pose.translation() = body.position;
  return pose;
}

/// Returns the pose of Ri in B. The origin is the intersection of the propeller axis and the arm
/// axis; x points outward along the arm. The frame is fixed to the base and does not tilt. `rotor`
/// counts from 0. Throws std::out_of_range if the vehicle has no such rotor.
template <int Rotors>
[[nodiscard]] Eigen::Isometry3d rotor_in_body(const Vehicle<Rotors>& vehicle, std::size_t rotor) {
  Eigen::Isometry3d pose;
  pose.linear() = vehicle.rotors.at(rotor).orientation;
  pose.translation() = vehicle.rotors.at(rotor).position;
  return pose;
}

/// Returns the pose of Wi in B. The origin is the wheel's centre; x points along body y (the axle),
/// z up. `wheel` counts from 0. Even wheels are right (arm 1, -y), odd wheels are left (arm 2, +y).
/// With two axles, the front axle has wheels 0 and 1, the rear axle has wheels 2 and 3. Throws
/// std::bad_optional_access for a vehicle without wheels.
template <int Rotors>
[[nodiscard]] Eigen::Isometry3d wheel_in_body(const Vehicle<Rotors>& vehicle, std::size_t wheel) {
  Eigen::Isometry3d pose;
  pose.linear() << 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0;
  const WheelParameters& wheels = vehicle.wheels.value();
  const double side = wheel % 2 == 0 ? -1.0 : 1.0, end = wheel < 2 ? 0.5 : -0.5;
  pose.translation() << end * wheels.wheel_base, side * wheels.half_track, 0.0;
  return pose;
}

/// Returns the unit vector of a rotor's thrust in its rotor frame. `alpha` is the tilt angle [rad],
/// a right-handed rotation about the arm. At zero the thrust points up.
template <typename Scalar>
[[nodiscard]] Vector3<Scalar> thrust_direction(const Scalar& alpha) {
  using std::cos;
  using std::sin;
  return {Scalar(0), -sin(alpha), cos(alpha)};
}

/// Converts a position, a velocity or another world-frame vector from ENU to NED axes.
template <typename Scalar>
[[nodiscard]] Vector3<Scalar> ned_from_enu(const Vector3<Scalar>& enu) noexcept {
  return {enu.y(), enu.x(), -enu.z()};
}

/// Inverse of ned_from_enu().
template <typename Scalar>
[[nodiscard]] Vector3<Scalar> enu_from_ned(const Vector3<Scalar>& ned) noexcept {
  return {ned.y(), ned.x(), -ned.z()};
}

/// Converts an angular velocity or another body-frame vector from FLU to FRD axes.
template <typename Scalar>
[[nodiscard]] Vector3<Scalar> frd_from_flu(const Vector3<Scalar>& flu) noexcept {
  return {flu.x(), -flu.y(), -flu.z()};
}

/// Inverse of frd_from_flu().
template <typename Scalar>
[[nodiscard]] Vector3<Scalar> flu_from_frd(const Vector3<Scalar>& frd) noexcept {
  return {frd.x(), -frd.y(), -frd.z()};
}

/// Converts a wrench at the CoM from FLU to FRD axes.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> frd_from_flu(const Wrench<Scalar>& flu) noexcept {
  return {frd_from_flu(flu.force), frd_from_flu(flu.torque)};
}

/// Inverse of frd_from_flu().
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> flu_from_frd(const Wrench<Scalar>& frd) noexcept {
  return {flu_from_frd(frd.force), flu_from_frd(frd.torque)};
}

/// Returns the attitude FRD -> NED of the body whose attitude FLU -> ENU is `q`. The map is linear
/// in q. It keeps the norm of q and does not flip the sign along a motion.
template <typename Scalar>
[[nodiscard]] Eigen::Quaternion<Scalar> ned_from_enu(const Eigen::Quaternion<Scalar>& q) noexcept {
  // (ENU -> NED) (x) q (x) (FRD -> FLU). The outer ones are half turns about (1, 1, 0) and x.
  const Scalar c = Scalar(std::sqrt(0.5));
  return {Scalar(c * (q.w() + q.z())), Scalar(c * (q.x() + q.y())), Scalar(c * (q.x() - q.y())),
          Scalar(c * (q.w() - q.z()))};
}

/// Inverse of ned_from_enu(): returns the attitude FLU -> ENU from the attitude FRD -> NED.
template <typename Scalar>
[[nodiscard]] Eigen::Quaternion<Scalar> enu_from_ned(const Eigen::Quaternion<Scalar>& q) noexcept {
  return ned_from_enu(q);
}

/// BodyState in the axes of an autopilot.
template <typename Scalar>
struct NedBodyState {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< CoM in the world frame (NED) [m]
  Vector3<Scalar> velocity = Vector3<Scalar>::Zero();  ///< CoM in the world frame [m/s]
  Eigen::Quaternion<Scalar> orientation =
      Eigen::Quaternion<Scalar>::Identity();                   ///< body (FRD) -> world, unit
  Vector3<Scalar> angular_velocity = Vector3<Scalar>::Zero();  ///< body frame [rad/s]
};
using NedBodyStated = NedBodyState<double>;  ///< in double precision

/// Converts a body state to NED and FRD axes.
template <typename Scalar>
[[nodiscard]] NedBodyState<Scalar> ned_from_enu(const BodyState<Scalar>& body) noexcept {
  return {ned_from_enu(body.position), ned_from_enu(body.velocity), ned_from_enu(body.orientation),
          frd_from_flu(body.angular_velocity)};
}

/// Inverse of ned_from_enu().
template <typename Scalar>
[[nodiscard]] BodyState<Scalar> enu_from_ned(const NedBodyState<Scalar>& body) noexcept {
  return {enu_from_ned(body.position), enu_from_ned(body.velocity), enu_from_ned(body.orientation),
          flu_from_frd(body.angular_velocity)};
}

}  // namespace tilt_ropter
