// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/ground_contact_settings.hpp>
#include <tilt_ropter/control/wheeled_flight_problem.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <optional>

/// What contact with the ground means to the controller: which references are on the ground, and
/// what holds and drives a node there (paper, Sec. Problem Formulation). Where the ground is, and
/// whether the vehicle stands on it, is a ContactEstimate.
namespace tilt_ropter {

/// Contact of an Undercarriage with the ground, once for the controller and for check_reference.
/// Without an undercarriage there is no ground: no reference means it and no node is held.
class GroundContact {
 public:
  /// Throws std::invalid_argument for parameters or settings out of range.
  GroundContact(const RigidBodyParameters& body, const std::optional<Undercarriage>& undercarriage,
                const GroundContactSettings& settings = {})
      : settings_(settings), mass_(body.mass), undercarriage_(undercarriage) {
    validate(body);
    if (undercarriage) validate(*undercarriage);
    validate(settings);
  }

  /// Takes other settings, which must be valid.
  void set_settings(const GroundContactSettings& settings) noexcept { settings_ = settings; }

  /// True if `point` means the ground of `contact` to a vehicle at `position` (world frame): the
  /// ground there or, where it falls away from a level reference, under the vehicle.
  [[nodiscard]] bool is_ground_reference(const ContactEstimate& contact,
                                         const Eigen::Vector3d& position,
                                         const ReferencePoint& point) const noexcept {
    if (!undercarriage_) return false;
    const double above = point.position.z() - undercarriage_->height -
                         std::max(expected(contact, point.position), expected(contact, position));
    const double rising =
        point.velocity.z() - std::max(0.0, contact.ground.slope.dot(point.velocity.head<2>()));
    const bool rests = rising < 2e-3 && rising > -0.05;
    return above < (rests ? settings_.reference_tolerance : 1e-3);
  }

  /// Fills all of a node but its reference wrench. Its reference is `point`, `ahead` [s] of the
  /// `measured` state. Returns the point that it follows: on the ground that of on_ground().
  ReferencePoint apply(const ContactEstimate& contact, const BodyState<>& measured, double ahead,
                       const ReferencePoint& point, WheeledFlightNode& node) const noexcept {
    const bool meant = is_ground_reference(contact, measured.position, point);
    node.reference = {point.position, point.velocity, point.orientation, point.angular_velocity};
    node.on_ground = contact.on_ground && meant;
    node.freedom = {};
    node.external = contact.disturbance;
    if (meant && !contact.on_ground) settle(contact, measured, ahead, node);
    if (!node.on_ground) return point;
    const ReferencePoint laid = on_ground(contact.ground, point);
    node.reference = {laid.position, laid.velocity, laid.orientation, laid.angular_velocity};
    node.com_plane = contact.ground;
    node.com_plane.height += undercarriage_->height;
    // The ground carries what thrust does not: a model that fell when F_z shrinks would keep the
    // thrust up. So the way along the normal and the roll are held. Along the axle it is the same:
    // any side force and the wheels' own add up to what the curve needs, so the wheels are told to
    // give all of it.
    const Eigen::Vector3d normal = contact.ground.normal();
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) node.freedom.linear(i, j) -= normal(i) * normal(j);
    node.freedom.angular.x() = 0.0;
    if (!undercarriage_->pitches) node.freedom.angular.y() = 0.0;
    if (!undercarriage_->turns) node.freedom.angular.z() = 0.0;
    if (!undercarriage_->rolls) node.freedom.linear.setZero();
    node.external = contact.rolling;
    Eigen::Vector3d missing = laid.acceleration;  // to what gravity leaves along the ground
    for (int i = 0; i < 3; ++i) missing(i) += gravity * node.freedom.linear(i, 2);
    node.external.force.y() = mass_ * (laid.orientation.conjugate() * missing).y();
    return laid;
  }

  /// The point with the vehicle standing on `ground`, whatever the reference takes it for: its
  /// heights, and its attitude, which is relative to the ground there. Without an undercarriage the
  /// point as it is.
  [[nodiscard]] ReferencePoint on_ground(const GroundPlane& ground,
                                         const ReferencePoint& point) const noexcept {
    ReferencePoint laid = point;
    if (!undercarriage_) return laid;
    const auto& slope = ground.slope;
    laid.position.z() = ground.height_at(point.position) + undercarriage_->height;
    laid.velocity.z() = slope.dot(point.velocity.head<2>());
    laid.acceleration.z() = slope.dot(point.acceleration.head<2>());
    Eigen::Vector3d ahead = point.orientation * Eigen::Vector3d::UnitX();
    ahead.z() = 0.0;
    const double level = ahead.norm();
    if (!(level > 1e-3)) return laid;  // nose up or down
    // The nose up to the ground's rise, then the axle about it down to the ground.
    ahead /= level;
    Eigen::Vector3d along = ahead;
    along.z() = slope.dot(ahead.head<2>());
    along /= along.norm();
    const Eigen::Quaterniond pitch = shortest_turn(ahead, along);
    const Eigen::Vector3d up = pitch * Eigen::Vector3d::UnitZ();
    laid.orientation = shortest_turn(up, ground.normal()) * (pitch * point.orientation);
    return laid;
  }

  /// Sets to zero what of a measured motion the ground does not let go on. With both wheels down
  /// that is the roll rate: the vehicle has one about body x while it turns with its nose up or
  /// down, and a model in which the roll went on would rather keep the nose there.
  void stop_held(BodyState<>& body) const noexcept {
    if (!undercarriage_) return;
    body.angular_velocity.x() = 0.0;
    if (!undercarriage_->pitches) body.angular_velocity.y() = 0.0;
    if (!undercarriage_->turns) body.angular_velocity.z() = 0.0;
    if (!undercarriage_->rolls) body.velocity.setZero();
  }

  /// Takes from a wrench what the ground gives; the vertical force stays.
  void release(Wrench<>& wrench) const noexcept {
    if (!undercarriage_) return;
    wrench.force.y() = wrench.torque.x() = 0.0;
    if (!undercarriage_->pitches) wrench.torque.y() = 0.0;
    if (!undercarriage_->turns) wrench.torque.z() = 0.0;
    if (!undercarriage_->rolls) wrench.force.x() = 0.0;
  }

 private:
  // From one unit vector to another, less than half a turn away.
  static Eigen::Quaterniond shortest_turn(const Eigen::Vector3d& from,
                                          const Eigen::Vector3d& to) noexcept {
    const Eigen::Vector3d axis = from.cross(to);
    Eigen::Quaterniond turn(1.0 + from.dot(to), axis.x(), axis.y(), axis.z());
    turn.normalize();
    return turn;
  }

  // Height of the ground that the reference goes by, under `position`.
  [[nodiscard]] double expected(const ContactEstimate& contact,
                                const Eigen::Vector3d& position) const noexcept {
    return std::max(settings_.planned_height, contact.ground.height_at(position));
  }

  // Down to where the ground should be, ever slower, and on with settling_speed until it is met:
  // it may be lower, and a vehicle that waits above it would hover there.
  void settle(const ContactEstimate& contact, const BodyState<>& measured, double ahead,
              WheeledFlightNode& node) const noexcept {
    constexpr double time_constant = 1.0;  // [s]
    const double ground = contact.ground_known ? contact.ground.height_at(measured.position)
                                               : expected(contact, measured.position);
    const double standing = ground + undercarriage_->height, off = measured.position.z() - standing,
                 left = std::max(off, 0.0) * std::exp(-ahead / time_constant);
    node.reference.position.z() =
        standing + std::min(off, 0.0) + left - settings_.settling_speed * ahead;
    node.reference.velocity.z() = -settings_.settling_speed - left / time_constant;
  }

  GroundContactSettings settings_;
  double mass_;
  std::optional<Undercarriage> undercarriage_;
};

}  // namespace tilt_ropter
