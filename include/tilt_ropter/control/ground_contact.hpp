#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/control/wheeled_flight_problem.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

/// Contact of the wheels with flat ground as the controller sees it: the paper's indicator delta
/// (paper, Sec. Problem Formulation) with tolerance and hysteresis, and what a node on the ground
/// is told about the forces there.
namespace tilt_ropter {

/// When the vehicle counts as on the ground, and what thrust it keeps there.
struct GroundContactSettings {
  double enter_height = 0.005;  ///< lower than this above the radius: on the ground [m]
  double leave_height = 0.030;  ///< higher, and not carried: in the air [m]
  /// Share of the weight that only the ground can carry: with more than that on it the vehicle has
  /// not left the ground, however high the ground is, and below leave_height it has reached it.
  double carried_share = 0.4;
  /// Share of the weight that thrust holds back while the reference is on the ground and the wheels
  /// are not yet, so that no gust or error of the estimate leaves the vehicle hanging over it.
  double settling_share = 0.07;
  double reference_tolerance = 1e-3;  ///< a reference this close to the radius is a ground one [m]
  double down_force =
      0.75;  ///< vertical thrust asked for on the ground; keeps tilt angles defined [N]
  /// Vertical thrust that a rotor keeps on the ground where torques take from it, see GroundThrust
  /// [N].
  double rotor_thrust = 0.25;
};

inline void validate(const GroundContactSettings& s) {
  require_positive("GroundContactSettings.enter_height [m]", s.enter_height);
  require(std::isfinite(s.leave_height) && s.leave_height > s.enter_height,
          "GroundContactSettings.leave_height [m]", s.leave_height, "finite and > enter_height");
  require_positive("GroundContactSettings.carried_share", s.carried_share);
  require_non_negative("GroundContactSettings.settling_share", s.settling_share);
  require_positive("GroundContactSettings.reference_tolerance [m]", s.reference_tolerance);
  require_finite("GroundContactSettings.down_force [N]", s.down_force);
  require_non_negative("GroundContactSettings.rotor_thrust [N]", s.rotor_thrust);
}

/// The vertical thrust to ask for on the ground: down_force, and more where a torque takes thrust
/// from a rotor, so that each keeps pushing upward. A CoM off the axle pitches the vehicle all the
/// time, and with little thrust to share the front rotor or the rear one would have to push
/// downward, at the end of its servo's range: from one end to the other is a whole turn, on the way
/// of which it pushes anywhere, and the vehicle tips.
///
/// A rotor from which the torque takes t keeps min(2 t, rotor_thrust) at least, unless that takes
/// more than half the weight off the wheels.
template <int Rotors>
class GroundThrust {
 public:
  /// Throws std::invalid_argument for a geometry that cannot give every wrench.
  GroundThrust(const Vehicle<Rotors>& vehicle, const GroundContactSettings& settings)
      : settings_(settings), most_(0.5 * vehicle.body.mass * gravity) {
    const auto inverse = AllocationMatrix<Rotors>(vehicle).pseudoinverse;
    for (int i = 0; i < Rotors; ++i) vertical_.row(i) = inverse.row(2 * i + 1);
  }

  /// The force [N] for a wrench (body frame) whose own vertical force is left out of account.
  [[nodiscard]] double operator()(const Wrench<>& wrench) const noexcept {
    Eigen::Matrix<double, 6, 1> level;
    level << wrench.force.x(), wrench.force.y(), 0.0, wrench.torque;
    double force = settings_.down_force;
    for (int i = 0; i < Rotors; ++i) {
      const double share = vertical_(i, 2), taken = -vertical_.row(i).dot(level);
      if (share > 1e-6)
        force = std::max(force, (taken + std::min(2.0 * taken, settings_.rotor_thrust)) / share);
    }
    return std::max(settings_.down_force, std::min(force, most_));
  }

 private:
  GroundContactSettings settings_;
  Eigen::Matrix<double, Rotors, 6> vertical_;
  double most_;
};

/// Mode of contact and the external wrench that belongs to each mode. The normal force estimated on
/// the ground must not be carried into nodes whose reference is in the air (it would look like lift
/// at take-off), so the wrench last seen well above it is kept for them until the ground has let
/// go.
class GroundContact {
 public:
  /// The wheels' radius is the height of the CoM on the ground. Throws std::invalid_argument for
  /// parameters or settings out of range.
  GroundContact(const RigidBodyParameters& body, const WheelParameters& wheels,
                const GroundContactSettings& settings = {})
      : settings_(settings), mass_(body.mass), wheel_radius_(wheels.radius) {
    validate(body);
    validate(wheels);
    validate(settings);
  }

  /// Takes the measured state (position of the CoM and orientation count) and the estimated
  /// external wrench (body frame).
  /// True if the vehicle has just left the ground: the estimate still holds the ground's force then
  /// and is better replaced by air_wrench(). Numbers that are not finite change nothing.
  bool update(const BodyState<>& body, const Wrench<>& external) noexcept {
    if (!is_finite(body) || !is_finite(external)) return false;
    orientation_ = body.orientation;
    const double clearance = body.position.z() - wheel_radius_;
    const double lift = (orientation_ * external.force).z(),
                 enough = settings_.carried_share * mass_ * gravity;
    // Lift that there was in the air already is not the ground's; no more than there could be, or
    // an estimate gone wrong would hide or feign the ground for good.
    const bool was_on_ground = on_ground_,
               carried = lift - std::clamp(air_lift_, 0.0, enough) > enough;
    on_ground_ = on_ground_
                     ? clearance < settings_.leave_height || carried
                     : clearance < (carried ? settings_.leave_height : settings_.enter_height);
    if (on_ground_ != was_on_ground && started_) ++mode_changes_;
    const bool lifted_off = was_on_ground && !on_ground_;
    started_ = true;
    external_ = lifted_off ? air_wrench_ : external;
    if (!on_ground_ && clearance > settings_.leave_height && !lifted_off) {
      air_wrench_ = external;
      air_lift_ = lift;
    }
    return lifted_off;
  }

  [[nodiscard]] bool on_ground() const { return on_ground_; }
  /// Changes of mode after the first update.
  [[nodiscard]] int mode_changes() const { return mode_changes_; }

  /// External wrench last seen higher than leave_height in the air, body frame.
  [[nodiscard]] const Wrench<>& air_wrench() const { return air_wrench_; }

  /// Fills delta, freedom and external wrench of a node whose reference is `point`; `now` is that
  /// of this moment.
  void apply(const ReferencePoint& now, const ReferencePoint& point,
             WheeledFlightNode& node) const {
    node.on_ground = on_ground_ && is_ground_reference(point.position.z());
    node.freedom = {};
    node.external = on_ground_ ? air_wrench_ : external_;
    if (!on_ground_ && is_ground_reference(now.position.z()))
      node.external.force += orientation_.conjugate() *
                             Eigen::Vector3d(0.0, 0.0, settings_.settling_share * mass_ * gravity);
    if (!node.on_ground) return;
    // The ground carries what thrust does not: a model that fell when F_z shrinks would keep the
    // thrust up. So the vertical and the roll are held, and their share of the estimate is left
    // out. Along the axle it is the same: any side force and the wheels' own add up to what the
    // curve needs, so the wheels are told to give all of it.
    node.freedom.linear.z() = 0.0;
    node.freedom.angular.x() = 0.0;
    Eigen::Vector3d horizontal = orientation_ * external_.force;
    horizontal.z() = 0.0;
    node.external.force = orientation_.conjugate() * horizontal;
    node.external.force.y() = mass_ * (point.orientation.conjugate() * point.acceleration).y();
    node.external.torque = external_.torque;
    node.external.torque.x() = 0.0;
  }

  /// True if a reference at `height` [m] is one on the ground.
  [[nodiscard]] bool is_ground_reference(double height) const {
    return std::abs(height - wheel_radius_) < settings_.reference_tolerance;
  }

 private:
  GroundContactSettings settings_;
  double mass_, wheel_radius_;
  bool on_ground_ = false, started_ = false;
  int mode_changes_ = 0;
  Eigen::Quaterniond orientation_ = Eigen::Quaterniond::Identity();
  Wrench<> external_, air_wrench_;
  double air_lift_ = 0.0;  // of air_wrench_, upward in the world when it was seen [N]
};

}  // namespace tilt_ropter
