// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/flight_node.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/detail/body_step.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <optional>

/// Ground contact in the controller: which references are on the ground, and which constraints and
/// forces act on a node there (paper, Sec. Problem Formulation). ContactEstimate tells where the
/// ground is and whether the vehicle stands on it.
namespace tilt_ropter {

/// Contact of an Undercarriage with the ground, used by the controller and by check_reference.
/// Without an undercarriage there is no ground: no reference is on the ground and no node is held.
class GroundContact {
 public:
  /// Throws std::invalid_argument if parameters or settings are out of range.
  GroundContact(const RigidBodyParameters& body, const std::optional<Undercarriage>& undercarriage,
                const GroundContactSettings& settings = {})
      : settings_(settings), mass_(body.mass), undercarriage_(undercarriage) {
    validate(body);
    inverse_inertia_ = detail::inverse(body.inertia);
    if (undercarriage) validate(*undercarriage);
    validate(settings);
  }

  /// Replaces the settings. The new settings must be valid.
  void set_settings(const GroundContactSettings& settings) noexcept { settings_ = settings; }

  [[nodiscard]] const GroundContactSettings& settings() const noexcept { return settings_; }

  /// Returns true if the reference `point` is on the ground of `contact`. `position` is the
  /// vehicle's position (world frame). The ground height is the larger of the heights at `point`
  /// and at `position`, because the ground may fall away under a level reference.
  [[nodiscard]] bool is_ground_reference(const ContactEstimate& contact,
                                         const Eigen::Vector3d& position,
                                         const ReferencePoint& point) const noexcept {
    if (!undercarriage_) return false;
    const double above = point.position.z() - undercarriage_->height -
                         std::max(expected(contact, point.position), expected(contact, position));
    if (settings_.contact_by_height) return std::abs(above) <= settings_.height_tolerance;
    const double rising = point.velocity.z() - std::max(0.0, contact.ground.rise(point.velocity));
    const bool rests = rising < 2e-3 && rising > -0.05;
    return above < (rests ? settings_.reference_tolerance : 1e-3);
  }

  /// Fills all of a node except its reference wrench. `point` is the reference, `ahead` [s] after
  /// the `measured` state, and `now` is the reference at that state. Returns the point that the
  /// node follows: on the ground the result of on_ground(), else `point`.
  ReferencePoint apply(const ContactEstimate& contact, const BodyStated& measured, double ahead,
                       const ReferencePoint& now, const ReferencePoint& point,
                       FlightNode& node) const noexcept {
    const bool meant = is_ground_reference(contact, measured.position, point);
    node.reference = {point.position, point.velocity, point.orientation, point.angular_velocity};
    const bool stands = is_on_ground(contact, measured.position);
    node.inside = point.inside;
    node.on_ground = stands && meant;
    node.touches = false;
    node.freedom = {};
    node.roll_axis = Eigen::Vector3d::UnitX();
    node.external = holds() ? contact.disturbance : contact.external;
    if (meant && !stands && settings_.settling_speed > 0.0) settle(contact, measured, ahead, node);
    if (!node.on_ground) {
      if (point.push && holds() && is_usable(*point.push))
        push(*point.push, contact, measured, ahead, now.push.has_value(), node);
      return point;
    }
    ReferencePoint laid = on_ground(contact.ground, point);
    node.reference = {laid.position, laid.velocity, laid.orientation, laid.angular_velocity};
    node.com_plane = contact.ground;
    node.com_plane.height += undercarriage_->height;
    if (!holds()) return laid;
    // The ground carries the part of the weight that the thrust does not carry. If the model fell
    // when F_z shrinks, the controller would keep the thrust high. The model therefore holds the
    // motion along the normal and the roll. Along the axle, the side force of the rotors and the
    // side force of the wheels add up to the force that the curve needs. The external force
    // therefore contains all of it.
    const Eigen::Vector3d normal = contact.ground.normal();
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) node.freedom.linear(i, j) -= normal(i) * normal(j);
    hold_rotation(laid.orientation, node);
    if (!undercarriage_->rolls) node.freedom.linear.setZero();
    node.external = contact.rolling;
    // contact.rolling contains the inertia of the rolling wheels at the present acceleration. At
    // this node they have the acceleration of the reference there.
    node.external.force.x() -= undercarriage_->rolling_mass * (ahead_of(point) - ahead_of(now));
    node.external.torque.z() -= undercarriage_->turning_inertia *
                                (point.angular_acceleration.z() - now.angular_acceleration.z());
    Eigen::Vector3d missing = laid.acceleration;  // minus gravity along the ground
    for (int i = 0; i < 3; ++i) missing(i) += gravity * node.freedom.linear(i, 2);
    node.external.force.y() = mass_ * (laid.orientation.conjugate() * missing).y();
    return laid;
  }

  /// Sets the rotations that the ground holds at a node on the ground whose body has the attitude
  /// `orientation`. With both wheels of one axle down, the body turns about the axle (body y) and
  /// about the ground's normal. It does not turn about the direction at right angles to both, in
  /// which the wheels roll. This direction is body x only while the body is not pitched.
  void hold_rotation(const Eigen::Quaterniond& orientation, FlightNode& node) const noexcept {
    if (!undercarriage_ || !node.on_ground || !holds()) return;
    node.roll_axis = roll_axis(orientation.conjugate() * node.com_plane.normal());
    Eigen::Matrix3d& kept = node.freedom.angular;
    kept = held_about(node.roll_axis, inverse_inertia_);
    for (int i = 0; i < 3; ++i) {
      if (!undercarriage_->pitches) kept(1, i) = 0.0;
      if (!undercarriage_->turns) kept(2, i) = 0.0;
      if (!undercarriage_->pitches && !undercarriage_->turns) kept(0, i) = 0.0;
    }
  }

  /// Returns the point with the vehicle standing on `ground`. Height, vertical velocity and
  /// vertical acceleration follow the ground. The attitude of `point` is taken as relative to the
  /// ground. Without an undercarriage the point is returned unchanged.
  [[nodiscard]] ReferencePoint on_ground(const GroundPlane& ground,
                                         const ReferencePoint& point) const noexcept {
    ReferencePoint laid = point;
    if (!undercarriage_) return laid;
    laid.position.z() = ground.height_at(point.position) + undercarriage_->height;
    laid.velocity.z() = ground.rise(point.velocity);
    laid.acceleration.z() = ground.rise(point.acceleration);
    Eigen::Vector3d ahead = point.orientation * Eigen::Vector3d::UnitX();
    ahead.z() = 0.0;
    const double level = ahead.norm();
    if (!(level > 1e-3)) return laid;  // nose points straight up or down
    // First pitch the nose to the slope of the ground, then roll the axle about it down to the
    // ground.
    ahead /= level;
    Eigen::Vector3d along = ahead;
    along.z() = ground.rise(ahead);
    along /= along.norm();
    const Eigen::Quaterniond pitch = detail::shortest_turn(ahead, along);
    const Eigen::Vector3d up = pitch * Eigen::Vector3d::UnitZ();
    laid.orientation = detail::shortest_turn(up, ground.normal()) * (pitch * point.orientation);
    return laid;
  }

  /// Returns `body` without the velocities that the ground or a surface holds at `node`. With both
  /// wheels down this is the angular velocity about the roll axis of the node. A vehicle that is
  /// pitched more or less than the node has an angular velocity about this axis while it turns. If
  /// the model let this rotation continue, the plan would tend to keep the nose there.
  [[nodiscard]] BodyStated stopped(const FlightNode& node, BodyStated body) const noexcept {
    if (node.touches)
      detail::put(detail::square(node.freedom.linear) * detail::triple(body.velocity),
                  body.velocity);
    if (!undercarriage_ || !node.on_ground || !holds()) return body;
    Eigen::Vector3d& w = body.angular_velocity;
    const double along = node.roll_axis.dot(w);
    for (int i = 0; i < 3; ++i) w(i) -= along * node.roll_axis(i);
    if (!undercarriage_->pitches) w.y() = 0.0;
    if (!undercarriage_->turns) w.z() = 0.0;
    if (!undercarriage_->rolls) body.velocity.setZero();
    return body;
  }

  /// Returns how much of half the weight the rotors carry, 0 to 1, while the vehicle drives beside
  /// its reference or points elsewhere, such as after a bump. Its wheels then lead it where it
  /// should not be, and the next edge turns it further: with less load they do both less.
  [[nodiscard]] double lifted(const BodyStated& measured,
                              const ReferencePoint& reference) const noexcept {
    using Triple = detail::Triple<double>;
    const auto to_reference = transposed(detail::square(reference.orientation.toRotationMatrix()));
    const Triple velocity = detail::triple(measured.velocity);
    const Triple ahead = to_reference * (detail::square(measured.orientation.toRotationMatrix()) *
                                         Triple{1.0, 0.0, 0.0});
    const double aside = (to_reference *
                          (detail::triple(measured.position) - detail::triple(reference.position)))
                             .y,
                 turned = ahead.x > 0.0 ? ahead.y : 1.0,
                 drives = std::min(1.0, std::sqrt(dot(velocity, velocity)) / 0.2);  // [m/s]
    constexpr double near = 0.015, far = 0.05;                                      // [m]
    constexpr double along = 0.05, across = 0.15;                                   // [rad]
    return drives * std::clamp(std::max((std::abs(aside) - near) / (far - near),
                                        (std::abs(turned) - along) / (across - along)),
                               0.0, 1.0);
  }

  [[nodiscard]] const std::optional<Undercarriage>& undercarriage() const noexcept {
    return undercarriage_;
  }

  /// True with GroundModel::held.
  [[nodiscard]] bool holds() const noexcept { return settings_.model == GroundModel::held; }

  /// Sets the components of a wrench to zero that the ground provides. The vertical force stays.
  void release(Wrenchd& wrench) const noexcept {
    if (!undercarriage_) return;
    wrench.force.y() = wrench.torque.x() = 0.0;
    if (!undercarriage_->pitches) wrench.torque.y() = 0.0;
    if (!undercarriage_->turns) wrench.torque.z() = 0.0;
    if (!undercarriage_->rolls) wrench.force.x() = 0.0;
  }

 private:
  [[nodiscard]] bool is_on_ground(const ContactEstimate& contact,
                                  const Eigen::Vector3d& position) const noexcept {
    if (!settings_.contact_by_height || !undercarriage_) return contact.on_ground;
    const double above = position.z() - undercarriage_->height - expected(contact, position);
    return std::abs(above) <= settings_.height_tolerance;
  }

  // Acceleration of the reference along its own body x [m/s^2].
  static double ahead_of(const ReferencePoint& point) noexcept {
    return (point.orientation.conjugate() * point.acceleration).x();
  }

  // Height of the ground that the reference was planned for or that was estimated, under
  // `position`.
  [[nodiscard]] double expected(const ContactEstimate& contact,
                                const Eigen::Vector3d& position) const noexcept {
    return std::max(
        {settings_.planned_height, contact.planned_height, contact.ground.height_at(position)});
  }

  // A node that pushes on a surface. Without a touch the vehicle approaches it. With a touch the
  // surface holds the motion along the normal, as the ground does, and gives the force of the
  // reference. The wrench of the reference balances it, and nothing else in the model depends on
  // the force. Friction is balanced where the reference slides, or is some millimetres away. At
  // rest it holds the vehicle, and balancing it would make the tool slip.
  void push(const SurfacePush& push, const ContactEstimate& contact, const BodyStated& measured,
            double ahead, bool pushes_now, FlightNode& node) const noexcept {
    // Slower for a small force, which would not stop the bounces of a fast touch.
    constexpr double fastest = 0.1, enough = 0.3;  // [m/s], with this force / weight
    const double approach = fastest * std::min(1.0, push.force / (enough * mass_ * gravity));
    constexpr double beyond = 0.05;         // behind the surface [m]
    constexpr double ramp = 0.5;            // from the touch to the whole force [s]
    constexpr double still = 0.005;         // [m]
    constexpr double full_friction = 0.02;  // speed of the slide from which it has its length [m/s]
    using Triple = detail::Triple<double>;
    const Surface& surface = push.surface;
    const Triple outward = detail::triple(surface.normal), none{0.0, 0.0, 0.0},
                 position = detail::triple(measured.position);
    const detail::Square<double> to_world = detail::square(measured.orientation.toRotationMatrix());
    const double here = dot(outward, position);
    double along = here, closing = 0.0;  // position and velocity along the normal
    if (contact.touches_for > 0.0) {
      node.touches = true;
      detail::put(detail::square(node.freedom.linear) + outer(0.0, -1.0 * outward, outward, none),
                  node.freedom.linear, 0, 0);
      const detail::Square<double> to_body = transposed(to_world);
      const Triple normal = to_body * outward,
                   felt = detail::triple(contact.surface_reaction.force),
                   slide = detail::triple(slide_along(surface, node.reference.velocity));
      detail::put(normal, node.normal);
      const double given = dot(normal, felt), speed = std::sqrt(dot(slide, slide));
      const bool rests = speed == 0.0;
      const Triple rubbing =
          rests ? felt - given * normal
                : (-given * contact.friction / std::max(full_friction, speed)) * (to_body * slide);
      // The torque of the force that there is, but the force of the reference.
      const Triple torque = cross(detail::triple(surface.tool), given * normal + rubbing);
      Triple force = (std::min(1.0, (contact.touches_for + ahead) / ramp) *
                      (push.force + contact.push_correction)) *
                     normal;
      Triple off = position - detail::triple(node.reference.position);
      off += -dot(outward, off) * outward;
      if (!rests || dot(off, off) > still * still) force += rubbing;
      detail::put(detail::triple(node.external.force) + force, node.external.force);
      detail::put(detail::triple(node.external.torque) + torque, node.external.torque);
    } else if (!pushes_now) {
      return;
    } else {
      const double end =
          dot(outward, detail::triple(surface.point) - to_world * detail::triple(surface.tool)) -
          beyond;
      along = std::max(here - approach * ahead, std::min(here, end));
      if (here - approach * ahead > end) closing = -approach;
    }
    const auto set_along = [&outward](double value, Eigen::Vector3d& of) {
      const Triple now = detail::triple(of);
      detail::put(now + (value - dot(outward, now)) * outward, of);
    };
    set_along(along, node.reference.position);
    set_along(closing, node.reference.velocity);
  }

  // The reference descends to the expected ground with decreasing speed, then continues with
  // settling_speed until the vehicle touches the ground. The ground may be lower than expected, and
  // a vehicle that waits above it would hover there.
  void settle(const ContactEstimate& contact, const BodyStated& measured, double ahead,
              FlightNode& node) const noexcept {
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
  Eigen::Matrix3d inverse_inertia_ = Eigen::Matrix3d::Identity();
  std::optional<Undercarriage> undercarriage_;
};

}  // namespace tilt_ropter
