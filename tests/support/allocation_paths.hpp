#pragma once

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "support/random.hpp"

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace test_support {

/// Returns the thrust vectors (T_1l, T_1v, ..., T_nl, T_nv) of a command [N], computed only from
/// its rotor speeds and tilt angles.
template <int Rotors>
Eigen::Matrix<double, 2 * Rotors, 1> thrusts_of(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                                const tilt_ropter::ActuatorState<Rotors>& command) {
  Eigen::Matrix<double, 2 * Rotors, 1> thrusts;
  for (int k = 0; k < Rotors; ++k) {
    const double angle = command.tilt_angle(k),
                 thrust = vehicle.rotors[static_cast<std::size_t>(k)].effectiveness *
                          tilt_ropter::thrust_from_speed(command.rotor_speed(k), vehicle.rotor);
    thrusts.template segment<2>(2 * k) << thrust * std::sin(angle), thrust * std::cos(angle);
  }
  return thrusts;
}

/// Returns the largest change of the commanded thrust vectors [N] per unit of path, along `runs`
/// straight paths between wrenches from draw(random). Only parts of a path where the wanted wrench
/// is reached count. A jump shows as a slope that grows with the number of steps.
template <int Rotors, typename Draw>
double steepest(const tilt_ropter::Vehicle<Rotors>& vehicle, int runs, int steps,
                const Draw& draw) {
  using namespace tilt_ropter;
  const Allocation<Rotors> allocation(vehicle);
  Random random(3);
  double slope = 0.0;
  for (int run = 0; run < runs; ++run) {
    const Wrenchd from = draw(random), to = draw(random);
    ActuatorState<Rotors> last;
    Eigen::Matrix<double, 2 * Rotors, 1> before = Eigen::Matrix<double, 2 * Rotors, 1>::Zero();
    bool reached = false;
    for (int i = 0; i <= steps; ++i) {
      const double s = static_cast<double>(i) / steps;
      const auto result = allocation.allocate(
          {(1.0 - s) * from.force + s * to.force, (1.0 - s) * from.torque + s * to.torque}, last);
      const auto thrusts = thrusts_of(vehicle, result.command);
      const bool reached_before = reached;
      reached = result.status == AllocationStatus::ok ||
                result.status == AllocationStatus::null_space_used;
      if (reached && reached_before) slope = std::max(slope, (thrusts - before).norm() * steps);
      before = thrusts;
      last = result.command;
    }
  }
  return slope;
}

}  // namespace test_support
