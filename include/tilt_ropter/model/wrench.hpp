// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Geometry>

/// Conversions of a wrench to other points and other frames. The power of the wrench does not
/// change. No function in this header throws or allocates.
namespace tilt_ropter {

/// Returns the wrench about another point, in the same frame, with torque M + lever x F. `lever`
/// [m] points from the reference point of the result to the reference point of `wrench`. Examples:
/// A force at point p of the body frame is transport({force, zero}, p) about the CoM. An estimate
/// about the CoM is transport(estimate, -p) about p.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> transport(const Wrench<Scalar>& wrench,
                                       const Vector3<Scalar>& lever) noexcept {
  return {wrench.force, wrench.torque + lever.cross(wrench.force)};
}

/// Returns the wrench about the same point, in another frame. `rotation` is a unit quaternion that
/// maps coordinates in the frame of `wrench` to coordinates in the frame of the result.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> rotate(const Wrench<Scalar>& wrench,
                                    const Eigen::Quaternion<Scalar>& rotation) noexcept {
  return {rotation * wrench.force, rotation * wrench.torque};
}

/// Returns a body-frame wrench in world axes, still about the CoM. `orientation` is body -> world.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> wrench_in_world(
    const Wrench<Scalar>& in_body, const Eigen::Quaternion<Scalar>& orientation) noexcept {
  return rotate(in_body, orientation);
}

/// Inverse of wrench_in_world().
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> wrench_in_body(const Wrench<Scalar>& in_world,
                                            const Eigen::Quaternion<Scalar>& orientation) noexcept {
  return rotate(in_world, orientation.conjugate());
}

}  // namespace tilt_ropter
