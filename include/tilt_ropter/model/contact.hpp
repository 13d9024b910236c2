// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <cmath>
#include <limits>

/// What is known of the ground under the vehicle: made by ContactEstimator or by a user who has a
/// bumper switch or a load cell, taken by the controller.
namespace tilt_ropter {

/// A plane in the world frame, nowhere vertical.
struct GroundPlane {
  double height = 0.0;                              ///< of the point where x = y = 0 [m]
  Eigen::Vector2d slope = Eigen::Vector2d::Zero();  ///< dz/dx, dz/dy

  /// Above or below `position` (world frame) [m].
  [[nodiscard]] double height_at(const Eigen::Vector3d& position) const noexcept {
    return height + slope.x() * position.x() + slope.y() * position.y();
  }
  /// Unit vector upward.
  [[nodiscard]] Eigen::Vector3d normal() const noexcept {
    return Eigen::Vector3d(-slope.x(), -slope.y(), 1.0) / std::sqrt(1.0 + slope.squaredNorm());
  }
};

/// Wrenches act at the CoM and are given in the body frame, as what the wrench observer finds is.
struct ContactEstimate {
  bool on_ground = false;     ///< the ground carries a part of the weight, or has just done so
  bool ground_known = false;  ///< `ground` was seen or told; false: only assumed, or nothing known
  GroundPlane ground;         ///< without any, at height -infinity
  /// What acts in the air; on the ground, what would act if the vehicle left it.
  Wrench<> disturbance;
  /// On the ground: what acts along it and turns the vehicle on it, such as wind, rolling and
  /// turning resistance.
  Wrench<> rolling;
  /// On the ground: its force along its normal, its roll torque, and what else the Undercarriage
  /// holds; in the air zero.
  Wrench<> ground_reaction;
};

/// Of a vehicle that is nowhere near the ground.
[[nodiscard]] inline ContactEstimate in_the_air(const Wrench<>& disturbance) noexcept {
  ContactEstimate estimate;
  estimate.disturbance = disturbance;
  estimate.ground.height = -std::numeric_limits<double>::infinity();
  return estimate;
}

/// True if all numbers are finite; the ground's height may be -infinity.
[[nodiscard]] inline bool is_finite(const ContactEstimate& e) noexcept {
  return is_finite(e.disturbance) && is_finite(e.rolling) && is_finite(e.ground_reaction) &&
         std::isfinite(e.ground.slope.x()) && std::isfinite(e.ground.slope.y()) &&
         e.ground.height < std::numeric_limits<double>::infinity();
}

}  // namespace tilt_ropter
