#pragma once

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>

/// Inputs and checks that the tests of the allocation share.
namespace test_support {

/// Returns `quick` in a plain run and ten times as many in a full run.
inline int runs(int quick) {
  return quick_or_full(quick, 10 * quick);
}

/// Entries uniform in [-force, force] [N] and [-torque, torque] [N m].
inline tilt_ropter::Wrenchd random_wrench(Random& random, double force, double torque) {
  tilt_ropter::Wrenchd w;
  w.force = random.vector(force);
  w.torque = random.vector(torque);
  return w;
}

/// Returns vertical arms with rotor speeds that carry the weight.
template <int Rotors>
tilt_ropter::ActuatorState<Rotors> hovering(const tilt_ropter::Vehicle<Rotors>& vehicle) {
  tilt_ropter::ActuatorState<Rotors> state;
  state.rotor_speed.setConstant(tilt_ropter::speed_from_thrust(
      vehicle.body.mass * tilt_ropter::gravity / Rotors, vehicle.rotor));
  return state;
}

/// Checks that rotor speeds and tilt angles are within the limits of the vehicle.
template <int Rotors>
void expect_within_limits(const tilt_ropter::Vehicle<Rotors>& v,
                          const tilt_ropter::ActuatorState<Rotors>& command) {
  for (int i = 0; i < Rotors; ++i) {
    ASSERT_GE(command.rotor_speed(i), tilt_ropter::speed_from_thrust(v.rotor.min_thrust, v.rotor));
    ASSERT_LE(command.rotor_speed(i), tilt_ropter::speed_from_thrust(v.rotor.max_thrust, v.rotor));
    if (v.rotors[static_cast<std::size_t>(i)].tilts) {
      ASSERT_GE(command.tilt_angle(i), v.servo.min_angle);
      ASSERT_LE(command.tilt_angle(i), v.servo.max_angle);
    } else {
      ASSERT_EQ(command.tilt_angle(i), 0.0);
    }
  }
}

/// Returns the largest absolute entry of force [N] and torque [N m].
inline double largest(const tilt_ropter::Wrenchd& w) {
  return std::max(w.force.cwiseAbs().maxCoeff(), w.torque.cwiseAbs().maxCoeff());
}

/// Returns a - b.
inline tilt_ropter::Wrenchd difference(const tilt_ropter::Wrenchd& a,
                                       const tilt_ropter::Wrenchd& b) {
  return {a.force - b.force, a.torque - b.torque};
}

}  // namespace test_support
