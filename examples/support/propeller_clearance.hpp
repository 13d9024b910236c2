#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

/// Distances of the propellers from wheels, ground and one another.
namespace examples {

using tilt_ropter::pi;
using tilt_ropter::RotorGeometry;
using tilt_ropter::RotorParameters;
using tilt_ropter::Vehicle;

/// Smallest distances of a propeller, over all tilt angles in the servo range. Zero: they touch.
/// Infinity: there is no such part, or no propeller has a known radius.
struct PropellerClearance {
  static constexpr double none = std::numeric_limits<double>::infinity();
  double wheel = none;      ///< from a wheel [m]
  double ground = none;     ///< from level ground, with the vehicle level on wheels or legs [m]
  double propeller = none;  ///< from another propeller [m]
};

/// A propeller at one tilt angle: a flat disc, body frame [m].
struct PropellerDisc {
  Eigen::Vector3d centre, axis, across;  ///< `across` is a unit vector in the disc
  double radius;

  /// Returns the point at the fraction `part` of the radius and at `angle` [rad].
  [[nodiscard]] Eigen::Vector3d point(double part, double angle) const {
    return centre +
           part * radius * (std::cos(angle) * across + std::sin(angle) * axis.cross(across));
  }

  /// Returns the distance of `p` from the disc [m].
  [[nodiscard]] double distance(const Eigen::Vector3d& p) const {
    const Eigen::Vector3d off = p - centre;
    const double along = axis.dot(off), out = (off - along * axis).norm();
    return std::hypot(along, std::max(out - radius, 0.0));
  }
};

/// Returns the discs of `rotor` (from 0) at tilt angles in steps of at most `step` [rad].
template <int Rotors>
[[nodiscard]] std::vector<PropellerDisc> propeller_discs(const Vehicle<Rotors>& vehicle,
                                                         std::size_t rotor, double step) {
  const RotorGeometry& mount = vehicle.rotors[rotor];
  const RotorParameters& p = rotor_parameters(vehicle, rotor);
  std::vector<PropellerDisc> discs;
  if (!(p.propeller_radius > 0.0)) return discs;
  // More than one revolution repeats the same places.
  const double from = mount.tilts ? std::max(vehicle.servo.min_angle, -pi) : 0.0,
               to = mount.tilts ? std::min(vehicle.servo.max_angle, pi) : 0.0;
  const int steps = static_cast<int>(std::ceil((to - from) / step));
  for (int i = 0; i <= steps; ++i) {
    const double tilt = steps > 0 ? from + (to - from) * i / steps : 0.0;
    PropellerDisc disc;
    disc.axis =
        std::cos(tilt) * mount.orientation.col(2) - std::sin(tilt) * mount.orientation.col(1);
    disc.centre = mount.position + p.propeller_height * disc.axis;
    disc.across = mount.orientation.col(0);
    disc.radius = p.propeller_radius;
    discs.push_back(disc);
  }
  return discs;
}

/// Returns the smallest distances of the propellers, which are flat discs. Samples tilt angles
/// every 6 degrees and points of a disc every 10 degrees at five radii, so a result can be too
/// large by 0.5 % of the radius of a propeller. Allocates. The vehicle must be valid.
template <int Rotors>
[[nodiscard]] PropellerClearance propeller_clearance(const Vehicle<Rotors>& vehicle) {
  constexpr double step = 6.0 * pi / 180.0;
  constexpr int angles = 36, radii = 4;
  PropellerClearance least;
  std::vector<std::vector<PropellerDisc>> discs;
  for (std::size_t i = 0; i < Rotors; ++i) discs.push_back(propeller_discs(vehicle, i, step));
  const auto for_points = [&](const PropellerDisc& disc, const auto& action) {
    for (int r = 0; r <= radii; ++r)
      for (int a = 0; a < angles; ++a)
        action(disc.point(static_cast<double>(r) / radii, 2.0 * pi * a / angles));
  };

  std::vector<Eigen::Vector3d> wheels;
  if (vehicle.wheels)
    for (const double side : {-1.0, 1.0})
      for (const double end : {-0.5, 0.5})
        wheels.emplace_back(end * vehicle.wheels->wheel_base, side * vehicle.wheels->half_track,
                            0.0);
  const auto stands = undercarriage(vehicle);
  for (const auto& tilts : discs)
    for (const PropellerDisc& disc : tilts)
      for_points(disc, [&](const Eigen::Vector3d& p) {
        if (stands) least.ground = std::min(least.ground, p.z() + stands->height);
        for (const Eigen::Vector3d& wheel : wheels) {
          const Eigen::Vector3d off = p - wheel;
          const double aside = std::max(std::abs(off.y()) - vehicle.wheels->half_width, 0.0),
                       out = std::max(std::hypot(off.x(), off.z()) - vehicle.wheels->radius, 0.0);
          least.wheel = std::min(least.wheel, std::hypot(aside, out));
        }
      });

  for (std::size_t i = 0; i < Rotors; ++i)
    for (std::size_t j = 0; j < Rotors; ++j) {
      if (i == j || discs[i].empty() || discs[j].empty()) continue;
      // No two discs of these rotors are closer than this.
      const auto reach = [&](std::size_t k) {
        return std::hypot(discs[k][0].radius,
                          (discs[k][0].centre - vehicle.rotors[k].position).norm());
      };
      const double apart = (vehicle.rotors[i].position - vehicle.rotors[j].position).norm();
      if (apart - reach(i) - reach(j) >= least.propeller) continue;
      for (const PropellerDisc& one : discs[i])
        for_points(one, [&](const Eigen::Vector3d& p) {
          for (const PropellerDisc& other : discs[j])
            least.propeller = std::min(least.propeller, other.distance(p));
        });
    }
  least.ground = std::max(least.ground, 0.0);
  return least;
}

}  // namespace examples
