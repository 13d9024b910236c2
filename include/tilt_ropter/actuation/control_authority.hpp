// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>

/// What a vehicle can do, whole or with actuators that failed.
namespace tilt_ropter {

/// Largest s in [0, most] up to which `allocation` gives the wrench from + s along with nothing
/// lost, by bisection to 1e-12 of `most`; zero if it does not give `from`. Where what a vehicle can
/// give is not convex, as with servos of a short range, there may be a gap before it.
template <int Rotors>
[[nodiscard]] double reach(const Allocation<Rotors>& allocation, const Wrench<>& from,
                           const Wrench<>& along, double most) {
  double within = 0.0, beyond = most;
  for (int i = 0; i < 40; ++i) {
    const double middle = 0.5 * (within + beyond);
    const Wrench<> wrench{from.force + middle * along.force, from.torque + middle * along.torque};
    const bool reached = allocation.allocate(wrench, {}).status != AllocationStatus::limited;
    (reached ? within : beyond) = middle;
  }
  return within;
}

/// Level hover and what is left beyond it, at rest: how fast servos and rotors get there is not
/// asked.
struct ControlAuthority {
  int rank = 0;  ///< of A, see AllocationMatrix; below 6 Allocation and Nmpc refuse the vehicle
  /// Largest singular value of A / the smallest, torques in units of the vehicle's size: how much
  /// dearer in thrust the dearest wrench is than the cheapest. Infinite below rank 6.
  double condition = std::numeric_limits<double>::infinity();
  bool hovers = false;  ///< the weight is carried without torque, all thrusts within limits
  /// Smallest thrust of a rotor that is not lost, at hover by the command of Allocation [N]. Near
  /// zero a push the other way takes half a turn of its servo.
  double least_thrust = 0.0;
  /// Largest force [N] and torque [N m] along each body axis, F then M, up to which Allocation
  /// gives it on top of hover with nothing lost, forward and backward; zero where it does not
  /// hover.
  Eigen::Matrix<double, 6, 1> forward = Eigen::Matrix<double, 6, 1>::Zero();
  Eigen::Matrix<double, 6, 1> backward = Eigen::Matrix<double, 6, 1>::Zero();
};

/// Of a vehicle of any rank; below 6 all but the rank stays as it is by default, although some such
/// vehicles, a flat quadrotor for one, do hover. Bisection, about a millisecond; allocates. Throws
/// std::invalid_argument on a vehicle that validate() refuses.
template <int Rotors>
[[nodiscard]] ControlAuthority control_authority(const Vehicle<Rotors>& vehicle) {
  validate(vehicle);
  ControlAuthority authority;
  const auto singular = AllocationMatrix<Rotors>::singular_values(vehicle);
  authority.rank = static_cast<int>((singular.array() > 1e-6 * singular(0)).count());
  if (authority.rank < 6) return authority;
  authority.condition = singular(0) / singular(5);

  const Allocation<Rotors> allocation(vehicle);
  Wrench<> hover;
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

  const double most =
      2.0 * Rotors * largest_max_thrust(vehicle);  // the weight carried, and as much
  for (int axis = 0; axis < 6; ++axis) {
    const double end = axis < 3 ? most : most * lever;
    Wrench<> along;
    double& component = axis < 3 ? along.force(axis) : along.torque(axis - 3);
    component = 1.0;
    authority.forward(axis) = reach(allocation, hover, along, end);
    component = -1.0;
    authority.backward(axis) = reach(allocation, hover, along, end);
  }
  return authority;
}

}  // namespace tilt_ropter
