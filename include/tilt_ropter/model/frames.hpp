// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

/// The frames of the paper; the axes of an autopilot (NED and FRD); distances of the propellers
/// from wheels, ground and one another.
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

/// Converts an angular velocity, a specific force or another body-frame vector from FLU to FRD
/// axes.
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
  // (ENU -> NED) (x) q (x) (FRD -> FLU). The outer factors are half turns: (0, 1, 1, 0) / sqrt(2)
  // and (0, 1, 0, 0).
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

/// Smallest distances of a propeller, over all tilt angles in the servo range. Zero: they touch.
/// Infinity: there is no such part, or no propeller has a known radius.
struct PropellerClearance {
  static constexpr double none = std::numeric_limits<double>::infinity();
  double wheel = none;      ///< from a wheel [m]
  double ground = none;     ///< from level ground, with the vehicle level on wheels or legs [m]
  double propeller = none;  ///< from another propeller [m]
};

namespace detail {

/// A propeller at one tilt angle: a flat disc, body frame [m].
struct PropellerDisc {
  Eigen::Vector3d centre, axis, across;  ///< `across` is a unit vector in the disc
  double radius;

  /// Returns the point at the fraction `part` of the radius and at `angle` [rad].
  [[nodiscard]] Eigen::Vector3d point(double part, double angle) const {
    return centre +
           part * radius * (std::cos(angle) * across + std::sin(angle) * axis.cross(across));
  }

  /// Returns the distance of `p` from the disc [m].
  [[nodiscard]] double distance(const Eigen::Vector3d& p) const {
    const Eigen::Vector3d off = p - centre;
    const double along = axis.dot(off), out = (off - along * axis).norm();
    return std::hypot(along, std::max(out - radius, 0.0));
  }
};

/// Returns the discs of `rotor` (from 0) at tilt angles in steps of at most `step` [rad].
template <int Rotors>
[[nodiscard]] std::vector<PropellerDisc> propeller_discs(const Vehicle<Rotors>& vehicle,
                                                         std::size_t rotor, double step) {
  const RotorGeometry& mount = vehicle.rotors[rotor];
  const RotorParameters& p = rotor_parameters(vehicle, rotor);
  std::vector<PropellerDisc> discs;
  if (!(p.propeller_radius > 0.0)) return discs;
  // More than one revolution repeats the same places.
  const double from = mount.tilts ? std::max(vehicle.servo.min_angle, -pi) : 0.0,
               to = mount.tilts ? std::min(vehicle.servo.max_angle, pi) : 0.0;
  const int steps = static_cast<int>(std::ceil((to - from) / step));
  for (int i = 0; i <= steps; ++i) {
    const double tilt = steps > 0 ? from + (to - from) * i / steps : 0.0;
    PropellerDisc disc;
    disc.axis =
        std::cos(tilt) * mount.orientation.col(2) - std::sin(tilt) * mount.orientation.col(1);
    disc.centre = mount.position + p.propeller_height * disc.axis;
    disc.across = mount.orientation.col(0);
    disc.radius = p.propeller_radius;
    discs.push_back(disc);
  }
  return discs;
}

}  // namespace detail

/// Returns the smallest distances of the propellers, which are flat discs. Samples tilt angles
/// every 6 degrees and points of a disc every 10 degrees at five radii, so a result can be too
/// large by 0.5 % of the radius of a propeller. Allocates. The vehicle must be valid.
template <int Rotors>
[[nodiscard]] PropellerClearance propeller_clearance(const Vehicle<Rotors>& vehicle) {
  constexpr double step = 6.0 * pi / 180.0;
  constexpr int angles = 36, radii = 4;
  PropellerClearance least;
  std::vector<std::vector<detail::PropellerDisc>> discs;
  for (std::size_t i = 0; i < Rotors; ++i)
    discs.push_back(detail::propeller_discs(vehicle, i, step));
  const auto for_points = [&](const detail::PropellerDisc& disc, const auto& action) {
    for (int r = 0; r <= radii; ++r)
      for (int a = 0; a < angles; ++a)
        action(disc.point(static_cast<double>(r) / radii, 2.0 * pi * a / angles));
  };

  std::vector<Eigen::Vector3d> wheels;
  if (vehicle.wheels)
    for (const double side : {-1.0, 1.0})
      for (const double end : {-0.5, 0.5})
        wheels.emplace_back(end * vehicle.wheels->wheel_base, side * vehicle.wheels->half_track,
                            0.0);
  const auto stands = undercarriage(vehicle);
  for (const auto& tilts : discs)
    for (const detail::PropellerDisc& disc : tilts)
      for_points(disc, [&](const Eigen::Vector3d& p) {
        if (stands) least.ground = std::min(least.ground, p.z() + stands->height);
        for (const Eigen::Vector3d& wheel : wheels) {
          const Eigen::Vector3d off = p - wheel;
          const double aside = std::max(std::abs(off.y()) - vehicle.wheels->half_width, 0.0),
                       out = std::max(std::hypot(off.x(), off.z()) - vehicle.wheels->radius, 0.0);
          least.wheel = std::min(least.wheel, std::hypot(aside, out));
        }
      });

  for (std::size_t i = 0; i < Rotors; ++i)
    for (std::size_t j = 0; j < Rotors; ++j) {
      if (i == j || discs[i].empty() || discs[j].empty()) continue;
      // No two discs of these rotors are closer than this.
      const auto reach = [&](std::size_t k) {
        return std::hypot(discs[k][0].radius,
                          (discs[k][0].centre - vehicle.rotors[k].position).norm());
      };
      const double apart = (vehicle.rotors[i].position - vehicle.rotors[j].position).norm();
      if (apart - reach(i) - reach(j) >= least.propeller) continue;
      for (const detail::PropellerDisc& one : discs[i])
        for_points(one, [&](const Eigen::Vector3d& p) {
          for (const detail::PropellerDisc& other : discs[j])
            least.propeller = std::min(least.propeller, other.distance(p));
        });
    }
  least.ground = std::max(least.ground, 0.0);
  return least;
}

}  // namespace tilt_ropter
