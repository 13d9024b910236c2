// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

/// The wrench that a reference needs, in the air and on the ground.
namespace tilt_ropter {

/// The wrench that a reference needs, by inverse dynamics.
template <int Rotors>
class ReferenceWrench {
 public:
  /// Throws std::invalid_argument if the geometry cannot give every wrench.
  ReferenceWrench(const Vehicle<Rotors>& vehicle, const GroundContactSettings& settings)
      : ReferenceWrench(vehicle, settings, AllocationMatrix<Rotors>(vehicle).pseudoinverse) {}

  /// For a geometry of any rank. `inverse` is ThrustInverse::matrix().
  ReferenceWrench(const Vehicle<Rotors>& vehicle, const GroundContactSettings& settings,
                  const Eigen::Matrix<double, 2 * Rotors, 6>& inverse)
      : body_(vehicle.body),
        ground_(vehicle.body, undercarriage(vehicle), settings),
        inverse_(inverse) {
    const double least = std::min(-vehicle.servo.min_angle, vehicle.servo.max_angle);
    if (least < 0.5 * pi) vertical_per_lateral_ = 2.0 / std::tan(std::max(least, 0.1));
  }

  /// Replaces the settings. The new settings must be valid.
  void set_settings(const GroundContactSettings& settings) noexcept {
    ground_.set_settings(settings);
  }

  /// Returns the wrench (body frame) for `point` that also balances `external` (body frame). On the
  /// ground it excludes the components that the ground provides, except with
  /// GroundModel::external_wrench, and carries `lifted` (0 to 1) of half the weight.
  [[nodiscard]] Wrenchd operator()(const ReferencePoint& point, const Wrenchd& external,
                                   bool on_ground, double lifted = 0.0) const noexcept {
    const Eigen::Vector3d& w = point.angular_velocity;
    Wrenchd wrench;
    wrench.force = body_.mass * (point.orientation.conjugate() *
                                 (point.acceleration + Eigen::Vector3d(0.0, 0.0, gravity))) -
                   external.force;
    wrench.torque =
        body_.inertia * point.angular_acceleration + w.cross(body_.inertia * w) - external.torque;
    if (on_ground && ground_.holds()) {
      ground_.release(wrench);
      wrench.force.z() = ground_thrust(wrench, lifted);
    }
    return wrench;
  }

  /// Returns the vertical thrust [N] to command on the ground for `wrench` (body frame), whose own
  /// vertical force is ignored: at least down_force and `lifted` (0 to 1) of half the weight, and
  /// more where a torque reduces the thrust of a rotor, so that every rotor pushes upward. A CoM
  /// off the axle pitches the vehicle all the time. With little total thrust, the front or the rear
  /// rotor would have to push downward. Its servo would then be at one end of its range. From one
  /// end to the other is a whole turn. During this turn the rotor pushes in every direction, and
  /// the vehicle tips.
  ///
  /// If the torque reduces a rotor's thrust by t, the rotor keeps at least min(2 t, rotor_thrust).
  /// If a servo does not reach 90 degrees to one side, the vertical thrust of its rotor is at least
  /// twice the thrust at which the lateral thrust is at the end of the servo's range. The total is
  /// limited to half the weight, so that the other half stays on the wheels.
  [[nodiscard]] double ground_thrust(const Wrenchd& wrench, double lifted = 0.0) const noexcept {
    const GroundContactSettings& settings = ground_.settings();
    const double most = 0.5 * body_.mass * gravity;
    const Eigen::Vector3d &f = wrench.force, &t = wrench.torque;
    const auto for_level = [&](int i) {
      return inverse_(i, 0) * f.x() + inverse_(i, 1) * f.y() +
             (inverse_(i, 3) * t.x() + (inverse_(i, 4) * t.y() + inverse_(i, 5) * t.z()));
    };
    double force = settings.down_force;
    for (int i = 0; i < Rotors; ++i) {
      const double fraction = inverse_(2 * i + 1, 2), taken = -for_level(2 * i + 1);
      if (!(fraction > 1e-6)) continue;
      const double lateral = std::abs(for_level(2 * i)),
                   kept = std::max(std::min(2.0 * taken, settings.rotor_thrust),
                                   vertical_per_lateral_ * lateral);
      force = std::max(force, (taken + kept) / fraction);
    }
    return std::max({settings.down_force, std::min(force, most), lifted * most});
  }

  /// Returns the wrench (body frame) to command without a plan. In the air it carries the weight
  /// and the known disturbance without turning a level vehicle; on the ground it is almost no
  /// thrust.
  [[nodiscard]] Wrenchd without_plan(const ContactEstimate& contact) const noexcept {
    Wrenchd wrench;
    if (contact.on_ground) {
      wrench.force.z() = ground_.settings().down_force;
    } else {
      wrench = {-contact.disturbance.force, -contact.disturbance.torque};
      wrench.force.z() += body_.mass * gravity;
    }
    return wrench;
  }

  [[nodiscard]] const RigidBodyParameters& body() const noexcept { return body_; }
  [[nodiscard]] const GroundContact& ground() const noexcept { return ground_; }

 private:
  RigidBodyParameters body_;
  GroundContact ground_;
  Eigen::Matrix<double, 2 * Rotors, 6> inverse_;  // thrusts by the wrench
  double vertical_per_lateral_ = 0.0;
};

}  // namespace tilt_ropter
