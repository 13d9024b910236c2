// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

/// One passive wheel on flat ground, z = 0 in the world frame.
///
/// The wheel is a thin disc that turns freely about body y. Its lowest point touches the ground:
///
///         body y (axle, n)
///           |
///       ----o----   disc       normal force     N = k depth max(0, 1 + c d(depth)/dt)
///        \  |r /               tangential force f = -(k_t z + d_t slip), |f| <= mu N
///     ____\_|_/____ z = 0      bristle          dz/dt = slip, |z| <= mu N / k_t
///
/// The normal force is Hunt and Crossley's (1975): it never pulls, starts from zero and only
/// dissipates energy. The bristle z is the elastic displacement of the contact patch along rolling
/// direction and axle. The patch sticks without creep inside the friction circle, and slides on it.
namespace tilt_ropter {

/// Mounting of a wheel or a foot. A foot is modelled as a small locked wheel.
struct WheelMount {
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();  ///< from the CoM, body frame [m]
  double radius = 0.1;                               ///< [m]
  double inertia = 4.0e-4;                           ///< about the axle [kg m^2]
  bool locked = false;                               ///< true: does not turn relative to the body
};

/// Parameters of the ground, tyres and bearings. All wheels are equal.
struct WheelContactParameters {
  double stiffness = 3000.0;             ///< k: normal to the ground, one wheel [N/m]
  double dissipation = 4.0;              ///< c: damping force / (spring force x speed) [s/m]
  double friction = 0.8;                 ///< mu: Coulomb coefficient, static and sliding
  double bristle_stiffness = 1.0e4;      ///< k_t: contact patch along the ground, one wheel [N/m]
  double bristle_damping = 20.0;         ///< d_t: contact patch along the ground [N s/m]
  double rolling_resistance = 0.018;     ///< resisting torque / (normal force x radius)
  double rolling_regularisation = 0.01;  ///< rim speed below which this torque fades to 0 [m/s]
  double bearing_friction = 1.0e-4;      ///< torque / (wheel spin - rate of the axle) [N m s]
  /// Middle of the axles or of the legs, from the CoM, body frame [m].
  Eigen::Vector3d axle_position = Eigen::Vector3d::Zero();
};

inline void validate(const WheelContactParameters& p) {
  require_positive("WheelContactParameters.stiffness [N/m]", p.stiffness);
  require_non_negative("WheelContactParameters.dissipation [s/m]", p.dissipation);
  require_non_negative("WheelContactParameters.friction", p.friction);
  require_positive("WheelContactParameters.bristle_stiffness [N/m]", p.bristle_stiffness);
  require_non_negative("WheelContactParameters.bristle_damping [N s/m]", p.bristle_damping);
  require_non_negative("WheelContactParameters.rolling_resistance", p.rolling_resistance);
  require_positive("WheelContactParameters.rolling_regularisation [m/s]", p.rolling_regularisation);
  require_non_negative("WheelContactParameters.bearing_friction [N m s]", p.bearing_friction);
  require_finite("WheelContactParameters.axle_position [m]", p.axle_position);
}

/// Returns an upper estimate of the fastest rate [1/s] of the coupled contact, wheel spin and body,
/// for three weights on the wheel. No step of an explicit integration may exceed its inverse.
[[nodiscard]] inline double fastest_contact_rate(const WheelContactParameters& p,
                                                 const WheelMount& mount,
                                                 const RigidBodyParameters& body) {
  const double lever =
      std::hypot(mount.centre.y(), std::hypot(mount.centre.x(), mount.centre.z()) + mount.radius);
  const double load = 3.0 * body.mass * gravity;
  // Velocity of the rim or of the contact point per impulse [1/kg].
  const double of_body = 1.0 / body.mass + lever * lever * detail::inverse(body.inertia).norm();
  const double of_spin = mount.locked ? 0.0 : mount.radius * mount.radius / mount.inertia;
  return std::max({p.bearing_friction / mount.inertia, p.bristle_damping * (of_spin + of_body),
                   p.rolling_resistance * load * of_spin / p.rolling_regularisation,
                   p.dissipation * load * of_body,
                   std::sqrt(p.bristle_stiffness * (of_spin + of_body)),
                   std::sqrt(2.0 * p.stiffness * of_body)});
}

/// Rotation of a wheel and elastic displacement of its contact patch.
struct WheelState {
  double angle = 0.0;  ///< about body y, relative to the world, not wrapped [rad]
  double spin = 0.0;   ///< rate of the angle; positive rolls along body x [rad/s]
  Eigen::Vector2d bristle = Eigen::Vector2d::Zero();  ///< along rolling direction and axle [m]
};

/// Forces and torques of one wheel on the body and on the wheel itself.
struct WheelForces {
  double normal_force = 0.0;    ///< normal force of the ground, >= 0 [N]
  double axle_torque = 0.0;     ///< on the wheel about body y: friction, rolling, bearing [N m]
  double bearing_torque = 0.0;  ///< on the axle about body y [N m]
  Wrenchd ground;  ///< on the body at the CoM, body frame; the axle transmits no torque
                   ///< about body y, that torque is part of axle_torque
  /// Bristle of the wheel's state, clamped to the friction circle [m].
  Eigen::Vector2d bristle = Eigen::Vector2d::Zero();
  Eigen::Vector2d slip = Eigen::Vector2d::Zero();  ///< slip of the rim, in the bristle's axes [m/s]
};

/// Returns the forces of the wheel at `mount`. `rotation` is the rotation matrix of
/// body.orientation. `axle_rate` is the rate of the axle relative to the body, about body y
/// [rad/s]: zero for an axle on the base, the tilt rate for an axle that tilts. The forces are
/// finite for every finite state, also for a wheel that lies flat. Does not throw or allocate.
[[nodiscard]] inline WheelForces wheel_contact(const WheelContactParameters& p,
                                               const WheelMount& mount, const BodyStated& body,
                                               const Eigen::Matrix3d& rotation,
                                               const WheelState& state,
                                               double axle_rate = 0.0) noexcept {
  using Vector = detail::Triple<double>;
  WheelForces result;
  const double relative_spin = mount.locked ? 0.0 : state.spin - body.angular_velocity.y();
  if (!mount.locked) result.bearing_torque = p.bearing_friction * (relative_spin - axle_rate);
  result.axle_torque = -result.bearing_torque;

  // All vectors below are in the world frame. Within 1e-3 rad of a flat wheel the direction to the
  // lowest point is ill-conditioned. The contact point then moves to the centre instead. The depth
  // changes accordingly, so that the spring conserves energy: the derivative of the depth with
  // respect to the axle is the lever of the spoke.
  const auto to_world = detail::square(rotation);
  const Vector axle = to_world.y, centre = to_world * detail::triple(mount.centre);
  const double sine = std::sqrt(axle.x * axle.x + axle.y * axle.y), upright = std::max(sine, 1e-3);
  const double depth =
      0.5 * mount.radius * (sine * sine / upright + upright) - body.position.z() - centre.z;
  if (!(depth > 0.0)) return result;

  const Vector spoke = (mount.radius / upright) * (axle.z * axle - Vector{0.0, 0.0, 1.0});
  const Vector spin_rate = to_world * detail::triple(body.angular_velocity);
  const Vector rim_velocity = detail::triple(body.velocity) + cross(spin_rate, centre) +
                              cross(spin_rate + relative_spin * axle, spoke);
  const double normal = p.stiffness * depth * std::max(0.0, 1.0 - p.dissipation * rim_velocity.z);

  const Vector rolling{axle.y / upright, -axle.x / upright, 0.0};
  const Vector sideways{-rolling.y, rolling.x, 0.0};
  const auto cut = [](Eigen::Vector2d a, double limit) {
    const double length = std::sqrt(a.x() * a.x() + a.y() * a.y());
    if (length > limit) a *= limit / length;
    return a;
  };
  const double circle = p.friction * normal;
  result.normal_force = normal;
  result.slip = {dot(rolling, rim_velocity), dot(sideways, rim_velocity)};
  result.bristle = cut(state.bristle, circle / p.bristle_stiffness);
  const auto resistance = [&](int i) {
    return -p.bristle_stiffness * result.bristle(i) - p.bristle_damping * result.slip(i);
  };
  const Eigen::Vector2d friction = cut({resistance(0), resistance(1)}, circle);

  const Vector force = Vector{0.0, 0.0, normal} + friction.x() * rolling + friction.y() * sideways;
  const double drive = mount.locked ? 0.0 : dot(axle, cross(spoke, force));
  const auto to_body = transposed(to_world);
  put(to_body * force, result.ground.force);
  put(to_body * (cross(centre + spoke, force) - drive * axle), result.ground.torque);

  if (mount.locked) return result;
  const double slow = p.rolling_regularisation / mount.radius;
  result.axle_torque += drive - p.rolling_resistance * normal * mount.radius * state.spin /
                                    std::hypot(state.spin, slow);
  return result;
}

}  // namespace tilt_ropter
