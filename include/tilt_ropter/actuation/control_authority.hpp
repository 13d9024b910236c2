// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>

/// Control authority of a vehicle, intact or with failed actuators.
namespace tilt_ropter {

/// Largest s in [0, most] up to which `allocation` gives the wrench from + s along with a status
/// other than limited. Computed by bisection to 1e-12 of `most`. Returns zero if `allocation` does
/// not give `from`. If the set of reachable wrenches is not convex, as with servos of a short
/// range, there may be a gap below the result.
template <int Rotors>
[[nodiscard]] double reach(const Allocation<Rotors>& allocation, const Wrenchd& from,
                           const Wrenchd& along, double most) {
  double within = 0.0, beyond = most;
  for (int i = 0; i < 40; ++i) {
    const double middle = 0.5 * (within + beyond);
    const Wrenchd wrench{from.force + middle * along.force, from.torque + middle * along.torque};
    const bool reached = allocation.allocate(wrench, {}).status != AllocationStatus::limited;
    (reached ? within : beyond) = middle;
  }
  return within;
}

/// Level hover and the wrench that remains beyond hover, at rest. The speed of servos and rotors is
/// not considered.
struct ControlAuthority {
  /// Rank of A, see AllocationMatrix; below 6 Allocation and Nmpc reject the vehicle.
  int rank = 0;
  /// Largest singular value of A / smallest singular value, with torques in units of the vehicle's
  /// size. This is the thrust cost of the most expensive wrench relative to the cheapest wrench.
  /// Infinite below rank 6.
  double condition = std::numeric_limits<double>::infinity();
  /// True if the vehicle carries its weight without torque, with all thrusts within limits.
  bool hovers = false;
  /// Smallest thrust of a rotor that is not lost, in hover by the command of Allocation [N]. If it
  /// is near zero, a thrust in the opposite direction requires half a turn of the servo.
  double least_thrust = 0.0;
  /// Largest force [N] and torque [N m] along each body axis, F then M, that Allocation adds to
  /// hover with nothing lost. One magnitude per direction, forward and backward. Zero if the
  /// vehicle does not hover.
  Eigen::Matrix<double, 6, 1> forward = Eigen::Matrix<double, 6, 1>::Zero();
  Eigen::Matrix<double, 6, 1> backward = Eigen::Matrix<double, 6, 1>::Zero();
};

/// Control authority of a vehicle of any rank. Below rank 6 all members except the rank keep their
/// defaults, although some of these vehicles do hover, for example a flat quadrotor. Uses bisection
/// and takes about a millisecond. Allocates. Throws std::invalid_argument if the vehicle fails
/// validate().
template <int Rotors>
[[nodiscard]] ControlAuthority control_authority(const Vehicle<Rotors>& vehicle) {
  validate(vehicle);
  ControlAuthority authority;
  const auto singular = AllocationMatrix<Rotors>::singular_values(vehicle);
  authority.rank = static_cast<int>((singular.array() > 1e-6 * singular(0)).count());
  if (authority.rank < 6) return authority;
  authority.condition = singular(0) / singular(5);

  const Allocation<Rotors> allocation(vehicle);
  Wrenchd hover;
  hover.force.z() = vehicle.body.mass * gravity;
  const auto level = allocation.allocate(hover, {});
  authority.hovers = level.status != AllocationStatus::limited;
  if (!authority.hovers) return authority;

  authority.least_thrust = largest_max_thrust(vehicle);
  double lever = 0.0;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[i];
    const RotorParameters& parameters = rotor_parameters(vehicle, i);
    lever = std::max(lever, rotor.position.norm() + parameters.torque_ratio);
    const double thrust =
        rotor.effectiveness *
        thrust_from_speed(level.command.rotor_speed(static_cast<Eigen::Index>(i)), parameters);
    if (rotor.effectiveness > 0.0)
      authority.least_thrust = std::min(authority.least_thrust, thrust);
  }

  const double most = 2.0 * Rotors * largest_max_thrust(vehicle);  // hover thrust plus full thrust
  for (int axis = 0; axis < 6; ++axis) {
    const double end = axis < 3 ? most : most * lever;
    Wrenchd along;
    double& component = axis < 3 ? along.force(axis) : along.torque(axis - 3);
    component = 1.0;
    authority.forward(axis) = reach(allocation, hover, along, end);
    component = -1.0;
    authority.backward(axis) = reach(allocation, hover, along, end);
  }
  return authority;
}

}  // namespace tilt_ropter
