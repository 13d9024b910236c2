// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cstddef>

/// The paper's eight frames (paper, Sec. Frame Definition): the world I (ENU) in which all is
/// expressed, the body B, the rotors R1..R4 and the wheels W1, W2. A function a_in_b gives the pose
/// of frame a in frame b: it maps coordinates in a to coordinates in b.
namespace tilt_ropter {

/// B in I.
template <typename Scalar>
[[nodiscard]] Eigen::Transform<Scalar, 3, Eigen::Isometry> body_in_world(
    const BodyState<Scalar>& body) {
  Eigen::Transform<Scalar, 3, Eigen::Isometry> pose;
  pose.linear() = body.orientation.toRotationMatrix();
  pose.translation() = body.position;
  return pose;
}

/// Ri in B: origin where the propeller's axis meets the arm's, x along the arm outward. The frame
/// belongs to the base and does not tilt. `rotor` counts from 0.
template <int Rotors>
[[nodiscard]] Eigen::Isometry3d rotor_in_body(const Vehicle<Rotors>& vehicle, std::size_t rotor) {
  Eigen::Isometry3d pose;
  pose.linear() = vehicle.rotors.at(rotor).orientation;
  pose.translation() = vehicle.rotors.at(rotor).position;
  return pose;
}

/// Wi in B: origin in the wheel's centre, x along body y (the axle), z up. Even wheels are right
/// (arm 1, -y), odd ones left (arm 2, +y); of two axles the front one has 0 and 1, the rear one 2
/// and 3. Throws std::bad_optional_access for a vehicle without wheels.
template <int Rotors>
[[nodiscard]] Eigen::Isometry3d wheel_in_body(const Vehicle<Rotors>& vehicle, std::size_t wheel) {
  Eigen::Isometry3d pose;
  pose.linear() << 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0;
  const WheelParameters& wheels = vehicle.wheels.value();
  const double side = wheel % 2 == 0 ? -1.0 : 1.0, end = wheel < 2 ? 0.5 : -0.5;
  pose.translation() << end * wheels.wheel_base, side * wheels.half_track, 0.0;
  return pose;
}

/// Unit vector of a rotor's thrust at tilt angle alpha [rad], in its rotor frame: a right-handed
/// rotation about the arm, zero is up.
template <typename Scalar>
[[nodiscard]] Vector3<Scalar> thrust_direction(const Scalar& alpha) {
  using std::cos;
  using std::sin;
  return {Scalar(0), -sin(alpha), cos(alpha)};
}

}  // namespace tilt_ropter
