// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/detail/wheel_contact.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

/// A wall that wheels, propellers and hull of a simulated vehicle touch. Its normal force is that
/// of the ground (Hunt and Crossley, 1975). Friction is viscous below Coulomb's limit.
namespace tilt_ropter {

/// A half-space. It may have any direction.
struct Wall {
  Eigen::Vector3d point = Eigen::Vector3d::Zero();     ///< on the surface, world frame [m]
  Eigen::Vector3d normal = -Eigen::Vector3d::UnitX();  ///< outward unit vector, world frame
  double friction = 0.5;                               ///< Coulomb coefficient
  double stiffness = 1.0e4;                            ///< at each point that touches [N/m]
  /// A sphere touches, too: a hull about the CoM, or with radius 0 the tip of a tool. [m]
  double hull_radius = 0.0;
  Eigen::Vector3d hull_centre = Eigen::Vector3d::Zero();  ///< of the sphere, body frame [m]

  static constexpr double dissipation = 2.0;  ///< damping force / (spring force x speed) [s/m]
  static constexpr double creep = 200.0;  ///< friction / speed along the surface, if small [N s/m]
};

inline void validate(const Wall& wall) {
  require_finite("Wall.point [m]", wall.point);
  require(std::abs(wall.normal.norm() - 1.0) < 1e-6, "Wall.normal", wall.normal.transpose(),
          "a unit vector");
  require_non_negative("Wall.friction", wall.friction);
  require_in("Wall.stiffness [N/m]", wall.stiffness, 1.0, 1e5);
  require_non_negative("Wall.hull_radius [m]", wall.hull_radius);
  require_finite("Wall.hull_centre [m]", wall.hull_centre);
}

namespace detail {

/// A part that touches walls with its rim; a sphere if `axis` is zero. Body frame.
struct HullDisc {
  Eigen::Vector3d centre, axis;  ///< [m], unit vector or zero
  double radius;                 ///< [m]
  bool rolls = false;            ///< no friction along the rim
};

/// Returns wheels or feet, the propellers of `vehicle`, untilted, and the sphere of `wall`.
template <int Rotors>
[[nodiscard]] std::vector<HullDisc> hull_of(const Vehicle<Rotors>& vehicle,
                                            const std::vector<WheelMount>& wheels,
                                            const Wall& wall) {
  std::vector<HullDisc> hull{{wall.hull_centre, Eigen::Vector3d::Zero(), wall.hull_radius}};
  for (const WheelMount& wheel : wheels)
    hull.push_back({wheel.centre, Eigen::Vector3d::UnitY(), wheel.radius, !wheel.locked});
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i) {
    const RotorParameters& p = rotor_parameters(vehicle, i);
    const Eigen::Vector3d axis = vehicle.rotors[i].orientation.col(2);
    hull.push_back(
        {vehicle.rotors[i].position + p.propeller_height * axis, axis, p.propeller_radius});
  }
  return hull;
}

/// Normal force [N], and wrench of the wall on the body at the CoM, body frame.
struct WallForce {
  double normal_force = 0.0;
  Wrenchd wrench;
};

/// Returns the force of `wall` on `disc`. Finite for every finite state. Does not allocate.
[[nodiscard]] inline WallForce wall_force(const Wall& wall, const HullDisc& disc,
                                          const BodyStated& body,
                                          const Eigen::Matrix3d& rotation) noexcept {
  using Vector = Triple<double>;
  const auto to_body = transposed(square(rotation));
  const Vector normal_axis = triple(wall.normal), axis = triple(disc.axis);
  const Vector into = to_body * (-1.0 * normal_axis), across = into - dot(axis, into) * axis;
  const auto length = [](const Vector& a) { return std::sqrt(dot(a, a)); };
  // The foremost point of the rim, or the centre where the disc is parallel to the wall.
  const Vector at = triple(disc.centre) + (disc.radius / std::max(length(across), 0.01)) * across;
  const double depth = dot(normal_axis, triple(wall.point) - triple(body.position)) + dot(into, at);
  if (!(depth > 0.0)) return {};
  const Vector velocity =
      to_body * triple(body.velocity) + cross(triple(body.angular_velocity), at);
  const double closing = dot(into, velocity);
  const double normal = wall.stiffness * depth * std::max(0.0, 1.0 + Wall::dissipation * closing);
  Vector slip = velocity - closing * into;
  if (disc.rolls) slip = dot(axis, slip) * axis;
  const double rubbing =
      std::min(Wall::creep, wall.friction * normal / std::max(length(slip), 1e-9));
  const Vector force = -normal * into - rubbing * slip;
  WallForce result{normal, {}};
  put(force, result.wrench.force);
  put(cross(at, force), result.wrench.torque);
  return result;
}

}  // namespace detail

}  // namespace tilt_ropter
