// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Geometry>

/// One wrench seen from other points and in other frames. Its power is the same in all of them.
/// Nothing here throws or allocates.
namespace tilt_ropter {

/// The wrench about another point, in the same frame: M + lever x F. `lever` [m] points from the
/// point that the result is about to the one that `wrench` is about. So a force at point p of the
/// body frame is transport({force, zero}, p) about the CoM, and an estimate about the CoM is
/// transport(estimate, -p) about p.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> transport(const Wrench<Scalar>& wrench,
                                       const Vector3<Scalar>& lever) noexcept {
  return {wrench.force, wrench.torque + lever.cross(wrench.force)};
}

/// The wrench about the same point, in another frame: `rotation`, unit, maps coordinates in the
/// frame that `wrench` is in to coordinates in the result's.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> rotate(const Wrench<Scalar>& wrench,
                                    const Eigen::Quaternion<Scalar>& rotation) noexcept {
  return {rotation * wrench.force, rotation * wrench.torque};
}

/// A body-frame wrench in the world's axes, still about the CoM; `orientation` is body -> world.
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
