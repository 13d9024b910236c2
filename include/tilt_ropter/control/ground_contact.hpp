#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/control/wheeled_flight_problem.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>

/// What contact of the wheels with the ground means to the controller: which references are on the
/// ground, what a node there is held by and told (paper, Sec. Problem Formulation), and the thrust
/// kept there. Where the ground is, and whether the vehicle stands on it, is a ContactEstimate.
namespace tilt_ropter {

/// Which references are on the ground, how it is reached, and what thrust is kept there.
struct GroundContactSettings {
  /// A reference that neither takes off nor lands is on the ground if it is lower than this above
  /// the height at which the CoM stands; one that does, if it is lower than a millimetre [m].
  double reference_tolerance = 0.03;
  /// Height of the ground that references were planned for: what is on the ground there counts as
  /// such where the ground turns out to be lower, too. -infinity: the ground's estimate alone [m].
  double planned_height = -std::numeric_limits<double>::infinity();
  /// With which the vehicle comes down where the reference is on the ground and no ground is met
  /// [m/s].
  double settling_speed = 0.10;
  /// Vertical thrust asked for on the ground; keeps tilt angles defined [N].
  double down_force = 0.75;
  /// Vertical thrust that a rotor keeps on the ground where torques take from it, see GroundThrust
  /// [N].
  double rotor_thrust = 0.12;
};

inline void validate(const GroundContactSettings& s) {
  require_positive("GroundContactSettings.reference_tolerance [m]", s.reference_tolerance);
  require(s.planned_height < std::numeric_limits<double>::infinity(),
          "GroundContactSettings.planned_height [m]", s.planned_height, "finite, or -infinity");
  require_in("GroundContactSettings.settling_speed [m/s]", s.settling_speed, 0.01, 10.0);
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

/// What two wheels on one axle hold: the vertical, the roll, and the way along the axle.
class AxleContact {
 public:
  /// Throws std::invalid_argument for parameters or settings out of range.
  AxleContact(const RigidBodyParameters& body, const WheelParameters& wheels,
              const GroundContactSettings& settings = {})
      : settings_(settings), mass_(body.mass), wheel_radius_(wheels.radius) {
    validate(body);
    validate(wheels);
    validate(settings);
  }

  /// True if `point` means the ground of `contact` to a vehicle at `position` (world frame): the
  /// ground there or, where it falls away from a level reference, under the vehicle.
  [[nodiscard]] bool is_ground_reference(const ContactEstimate& contact,
                                         const Eigen::Vector3d& position,
                                         const ReferencePoint& point) const noexcept {
    const double above = point.position.z() - wheel_radius_ -
                         std::max(expected(contact, point.position), expected(contact, position));
    const double rising =
        point.velocity.z() - std::max(0.0, contact.ground.slope.dot(point.velocity.head<2>()));
    const bool rests = rising < 2e-3 && rising > -0.05;
    return above < (rests ? settings_.reference_tolerance : 1e-3);
  }

  /// Fills all of a node but its reference wrench. Its reference is `point`, `ahead` [s] of the
  /// `measured` state.
  void apply(const ContactEstimate& contact, const BodyState<>& measured, double ahead,
             const ReferencePoint& point, WheeledFlightNode& node) const noexcept {
    const bool meant = is_ground_reference(contact, measured.position, point);
    node.reference = {point.position, point.velocity, point.orientation, point.angular_velocity};
    node.on_ground = contact.on_ground && meant;
    node.freedom = {};
    node.external = contact.disturbance;
    if (meant && !contact.on_ground) settle(contact, measured, ahead, node);
    if (!node.on_ground) return;
    // Along the ground that there is, whatever the reference takes it for.
    node.ground = contact.ground;
    node.reference.position.z() = contact.ground.height_at(point.position) + wheel_radius_;
    node.reference.velocity.z() = contact.ground.slope.dot(point.velocity.head<2>());
    // The ground carries what thrust does not: a model that fell when F_z shrinks would keep the
    // thrust up. So the vertical and the roll are held. Along the axle it is the same: any side
    // force and the wheels' own add up to what the curve needs, so the wheels are told to give all
    // of it.
    node.freedom.linear.z() = 0.0;
    node.freedom.angular.x() = 0.0;
    node.external = contact.rolling;
    // Downhill is the same way all along the horizon, wherever the vehicle turns.
    const Eigen::Vector2d downhill =
        -(mass_ * gravity - settings_.down_force) * contact.ground.slope;
    node.external.force +=
        point.orientation.conjugate() * Eigen::Vector3d(downhill.x(), downhill.y(), 0.0);
    node.external.force.y() = mass_ * (point.orientation.conjugate() * point.acceleration).y();
  }

  /// Takes from a wrench what the ground gives: the side force and the roll torque.
  static void release(Wrench<>& wrench) noexcept { wrench.force.y() = wrench.torque.x() = 0.0; }

 private:
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
    const double standing = ground + wheel_radius_, off = measured.position.z() - standing,
                 left = std::max(off, 0.0) * std::exp(-ahead / time_constant);
    node.reference.position.z() =
        standing + std::min(off, 0.0) + left - settings_.settling_speed * ahead;
    node.reference.velocity.z() = -settings_.settling_speed - left / time_constant;
  }

  GroundContactSettings settings_;
  double mass_, wheel_radius_;
};

/// The wrench that a reference needs, by inverse dynamics.
template <int Rotors>
class ReferenceWrench {
 public:
  /// Throws std::invalid_argument for a geometry that cannot give every wrench.
  ReferenceWrench(const Vehicle<Rotors>& vehicle, const GroundContactSettings& settings)
      : body_(vehicle.body), ground_thrust_(vehicle, settings) {}

  /// Against `external` (body frame); on the ground the wheels give the side force, the ground the
  /// vertical one and the roll torque.
  [[nodiscard]] Wrench<> operator()(const ReferencePoint& point, const Wrench<>& external,
                                    bool on_ground) const noexcept {
    const Eigen::Vector3d& w = point.angular_velocity;
    Wrench<> wrench;
    wrench.force = body_.mass * (point.orientation.conjugate() *
                                 (point.acceleration + Eigen::Vector3d(0.0, 0.0, gravity))) -
                   external.force;
    wrench.torque =
        body_.inertia * point.angular_acceleration + w.cross(body_.inertia * w) - external.torque;
    if (on_ground) {
      AxleContact::release(wrench);
      wrench.force.z() = ground_thrust_(wrench);
    }
    return wrench;
  }

 private:
  RigidBodyParameters body_;
  GroundThrust<Rotors> ground_thrust_;
};

}  // namespace tilt_ropter
