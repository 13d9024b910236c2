#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// What a vehicle of any rank can do at rest and with small motions.
namespace examples {

template <int Rotors>
struct SteadyFlight {
  bool hovers = false;              ///< the thrusts of hover are within the limits
  double lean = 0.0;                ///< of hover: angle of body z to the vertical [rad]
  double lift_per_weight = 0.0;     ///< in hover, all thrusts grow by the same factor
  double least_thrust = 0.0;        ///< of a rotor in hover [N]
  std::array<bool, 3> pushes = {};  ///< along the body axes without a torque and without leaning
  std::array<bool, 3> turns = {};   ///< about the body axes while it hovers
  tilt_ropter::ActuatorState<Rotors> hover;  ///< speeds and tilt angles
};

/// A torque that is none: 1e-4 of the weight at the farthest rotor [N m].
template <int Rotors>
[[nodiscard]] double least_torque(const tilt_ropter::Vehicle<Rotors>& vehicle) {
  double size = 0.0;
  for (const tilt_ropter::RotorGeometry& rotor : vehicle.rotors)
    size = std::max(size, rotor.position.norm());
  return 1e-4 * size * vehicle.body.mass * tilt_ropter::gravity;
}

/// Computes SteadyFlight by the smallest thrusts for hover. The vehicle must be valid.
template <int Rotors>
[[nodiscard]] SteadyFlight<Rotors> steady_flight(const tilt_ropter::Vehicle<Rotors>& vehicle) {
  using namespace tilt_ropter;
  const ThrustInverse<Rotors> inverse(vehicle);
  const ActuatedBody<Rotors> body(vehicle);
  const ActuatorLimits<Rotors> limits(vehicle);
  const Eigen::Matrix3d& possible = inverse.steady_forces();
  SteadyFlight<Rotors> found;

  // Vertical force and torques by lateral and vertical thrusts; torques by the size.
  // Of a size that is known at run time only: compiled once for all numbers of rotors.
  Eigen::MatrixXd turning = Eigen::MatrixXd::Zero(4, 2 * Rotors);
  double size = 1e-9;
  for (std::size_t k = 0; k < Rotors; ++k) size = std::max(size, vehicle.rotors[k].position.norm());
  for (int i = 0; i < Rotors; ++i) {
    for (const bool vertical : {false, true}) {
      if (!vertical && !vehicle.rotors[static_cast<std::size_t>(i)].tilts) continue;
      ActuatedState<Rotors> one;
      one.thrust(i) = 1.0;
      one.tilt_angle(i) = vertical ? 0.0 : 0.5 * pi;
      const Wrenchd wrench = body.wrench(one);
      turning.col(2 * i + vertical) << wrench.force.z(), wrench.torque / size;
    }
  }
  Eigen::MatrixXd gram = turning * turning.transpose();
  gram.diagonal().array() += 1e-9;
  for (int axis = 0; axis < 3; ++axis) {
    const Eigen::VectorXd wanted = Eigen::VectorXd::Unit(4, 1 + axis),
                          given = turning * (turning.transpose() * gram.ldlt().solve(wanted));
    found.turns[static_cast<std::size_t>(axis)] = (given - wanted).norm() < 1e-3;
    found.pushes[static_cast<std::size_t>(axis)] = possible(axis, axis) > 0.5;
  }

  const Eigen::Vector3d lift = possible.col(2);
  if (!(lift.norm() > 1e-3) || !(lift.z() > 0.0)) return found;
  found.lean = std::acos(std::min(lift.z() / lift.norm(), 1.0));
  Wrenchd wanted;
  wanted.force = vehicle.body.mass * gravity * lift.normalized();
  const auto& most = limits.max_thrust;
  const auto thrusts = inverse.within(wanted, limits.min_thrust, most);
  ActuatedState<Rotors> x;
  found.least_thrust = found.lift_per_weight = std::numeric_limits<double>::infinity();
  bool within = true;
  for (int i = 0; i < Rotors; ++i) {
    const auto k = static_cast<std::size_t>(i);
    const RotorParameters& rotor = rotor_parameters(vehicle, k);
    const double lateral = thrusts(2 * i), vertical = thrusts(2 * i + 1);
    x.thrust(i) = vehicle.rotors[k].tilts ? std::hypot(lateral, vertical) : vertical;
    x.tilt_angle(i) = vehicle.rotors[k].tilts ? std::atan2(lateral, vertical) : 0.0;
    if (!(vehicle.rotors[k].effectiveness > 0.0)) continue;
    within = within && x.thrust(i) <= most(i) + 1e-9 &&
             x.tilt_angle(i) <= vehicle.servo.max_angle + 1e-9 &&
             x.tilt_angle(i) >= vehicle.servo.min_angle - 1e-9;
    found.least_thrust = std::min(found.least_thrust, x.thrust(i));
    found.lift_per_weight =
        std::min(found.lift_per_weight, most(i) / std::max(x.thrust(i), 1e-3 * most(i)));
    found.hover.rotor_speed(i) =
        speed_from_thrust(x.thrust(i) / vehicle.rotors[k].effectiveness, rotor);
    found.hover.tilt_angle(i) = x.tilt_angle(i);
  }
  const Wrenchd given = body.wrench(x);
  const double weight = wanted.force.norm();
  found.hovers = within && (given.force - wanted.force).norm() < 0.01 * weight &&
                 given.torque.norm() < 0.01 * weight * size;
  return found;
}

}  // namespace examples
