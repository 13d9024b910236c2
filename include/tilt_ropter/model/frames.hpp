// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cstddef>

/// The eight frames of the paper (paper, Sec. Frame Definition): the world I (ENU, the reference
/// frame), the body B, the rotors R1..R4 and the wheels W1, W2. A function a_in_b returns the pose
/// of frame a in frame b. The pose maps coordinates in a to coordinates in b.
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

}  // namespace tilt_ropter
