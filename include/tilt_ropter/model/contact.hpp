// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <cmath>
#include <limits>
#include <optional>

/// Estimate of the ground contact, an input of the controller. ContactEstimator computes it. A user
/// with a bumper switch or a load cell can provide it instead.
namespace tilt_ropter {

/// Ground plane in the world frame. It cannot be vertical.
struct GroundPlane {
  double height = 0.0;                              ///< height of the plane at x = y = 0 [m]
  Eigen::Vector2d slope = Eigen::Vector2d::Zero();  ///< dz/dx, dz/dy

  /// Returns the height [m] of the plane at x and y of `position` (world frame).
  [[nodiscard]] double height_at(const Eigen::Vector3d& position) const noexcept {
    return height + rise(position);
  }
  /// Returns the change of height along `step`: the vertical component of a vector in the plane
  /// with the x and y of `step` (world frame), in its unit.
  [[nodiscard]] double rise(const Eigen::Vector3d& step) const noexcept {
    return slope.x() * step.x() + slope.y() * step.y();
  }
  /// Returns the upward unit normal, world frame.
  [[nodiscard]] Eigen::Vector3d normal() const noexcept {
    return Eigen::Vector3d(-slope.x(), -slope.y(), 1.0) / std::sqrt(1.0 + slope.squaredNorm());
  }
};

/// Returns the direction in which wheels roll whose axle is body y, as a unit vector in the body
/// frame. `up` is the ground's normal in the body frame. With both wheels on the ground, the body
/// does not turn about this direction. It is body x if the body is not pitched, and also if the
/// nose points straight up or down.
[[nodiscard]] inline Eigen::Vector3d roll_axis(const Eigen::Vector3d& up) noexcept {
  const double length = std::sqrt(up.x() * up.x() + up.z() * up.z());  // of y x up
  if (!(length > 1e-3)) return Eigen::Vector3d::UnitX();
  return {up.z() / length, 0.0, -up.x() / length};
}

/// Something that stops a vehicle in front of its reference, in the air or on wheels.
struct Obstacle {
  /// Towards the obstacle; horizontal unit vector, world frame.
  Eigen::Vector3d direction = Eigen::Vector3d::UnitX();
  double reach = 0.0;  ///< how far the CoM gets along `direction`, from the origin [m]
};

/// Returns the reference of a vehicle that does not get past `obstacle`.
[[nodiscard]] inline ReferencePoint in_front_of(const Obstacle& obstacle,
                                                const ReferencePoint& point) noexcept {
  return held_inside({-obstacle.direction, -obstacle.reach}, point);
}

/// The same for a vehicle on wheels, which cannot move along an obstacle: it stays where `body` is,
/// in its heading. A turn towards a reference on the other side would take it along the obstacle.
[[nodiscard]] inline ReferencePoint standing_at(const BodyStated& body,
                                                ReferencePoint point) noexcept {
  point.position.head<2>() = body.position.head<2>();
  point.velocity.head<2>().setZero();
  point.acceleration.head<2>().setZero();
  point.orientation = quaternion_from_yaw(yaw_of(body.orientation));
  point.angular_velocity.setZero();
  point.angular_acceleration.setZero();
  return point;
}

/// Wrenches act at the CoM, in the body frame, like the output of the wrench observer.
struct ContactEstimate {
  bool on_ground = false;     ///< the ground carries part of the weight, or did so recently
  bool ground_known = false;  ///< `ground` is measured or given; false: assumed or unknown
  GroundPlane ground;         ///< height -infinity: no ground
  /// Height of the ground for which references are planned, if the vehicle has stood somewhat lower
  /// [m]. A reference on this ground counts as on the ground.
  double planned_height = -std::numeric_limits<double>::infinity();
  bool limited = false;  ///< `disturbance` was cut to what a vehicle of this weight can carry
  /// An unknown obstacle that the vehicle touches, or has bounced off. The controller then plans to
  /// stay in front of it, and on the ground to stand.
  std::optional<Obstacle> blocked;
  /// In the air: the external wrench; along an obstacle, the one before the touch. On the ground:
  /// the external wrench that would act if the vehicle left the ground.
  Wrenchd disturbance;
  /// On the ground: the external force along the ground (zero if the vehicle does not roll) and the
  /// external torque about the free axes of the Undercarriage. Examples are wind and the resistance
  /// to rolling. The force is at most 0.3 weights, and along an obstacle the one before the touch.
  Wrenchd rolling;
  /// On the ground: the ground's normal force, its roll torque, and its torque about every other
  /// axis that is not free. If the vehicle does not roll: the whole force. In the air: zero.
  Wrenchd ground_reaction;
  /// Time for which the tool has touched the surface that the reference pushes on, or 0 [s].
  double touches_for = 0.0;
  /// Of that surface: its normal force, and its friction. Not in `disturbance`.
  Wrenchd surface_reaction;
  double friction = 0.0;         ///< coefficient of that surface: its own, or learnt in a slide
  double push_correction = 0.0;  ///< to add to the force of the reference on it [N]
  /// The whole external wrench, with everything that the ground gives. Only
  /// GroundModel::external_wrench uses it.
  Wrenchd external;
};

/// Returns the estimate for a vehicle far from the ground. `disturbance` is the external wrench.
[[nodiscard]] inline ContactEstimate in_the_air(const Wrenchd& disturbance) noexcept {
  ContactEstimate estimate;
  estimate.disturbance = estimate.external = disturbance;
  estimate.ground.height = -std::numeric_limits<double>::infinity();
  return estimate;
}

/// Returns true if all numbers are finite. The ground's height may be -infinity.
[[nodiscard]] inline bool is_finite(const ContactEstimate& e) noexcept {
  return is_finite(e.disturbance) && is_finite(e.rolling) && is_finite(e.ground_reaction) &&
         is_finite(e.external) && is_finite(e.surface_reaction) && std::isfinite(e.friction) &&
         std::isfinite(e.touches_for) && std::isfinite(e.push_correction) &&
         (!e.blocked || (all_finite(e.blocked->direction) && std::isfinite(e.blocked->reach))) &&
         std::isfinite(e.ground.slope.x()) && std::isfinite(e.ground.slope.y()) &&
         e.ground.height < std::numeric_limits<double>::infinity() &&
         e.planned_height < std::numeric_limits<double>::infinity();
}

}  // namespace tilt_ropter
