#pragma once

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/model/state.hpp>

#include <gtest/gtest.h>

/// The hover task of the controller, and checks that hold for every result of the controller.
namespace test_support {

inline tilt_ropter::ReferencePoint hover(double) {
  tilt_ropter::ReferencePoint point;
  point.position << 0.0, 0.0, 1.5;
  return point;
}

inline tilt_ropter::BodyStated hovering() {
  tilt_ropter::BodyStated state;
  state.position << 0.0, 0.0, 1.5;
  return state;
}

/// Returns the command for level hover.
template <int Rotors>
tilt_ropter::AllocationResult<Rotors> level_hover(const tilt_ropter::Allocation<Rotors>& allocation,
                                                  const tilt_ropter::Vehicle<Rotors>& vehicle) {
  tilt_ropter::Wrenchd weight;
  weight.force.z() = vehicle.body.mass * tilt_ropter::gravity;
  return allocation.allocate(weight, {});
}

[[nodiscard]] inline bool is_within_bounds(const tilt_ropter::Wrenchd& wrench,
                                           const tilt_ropter::NmpcBounds& bounds) {
  return (wrench.force.array() <= bounds.force_max.array()).all() &&
         (wrench.force.array() >= bounds.force_min.array()).all() &&
         (wrench.torque.array() <= bounds.torque_max.array()).all() &&
         (wrench.torque.array() >= bounds.torque_min.array()).all();
}

inline void expect_within_bounds(const tilt_ropter::NmpcResult& result,
                                 const tilt_ropter::NmpcBounds& bounds) {
  EXPECT_TRUE(is_finite(result.wrench));
  EXPECT_TRUE(is_finite(result.rate));
  EXPECT_TRUE(is_within_bounds(result.wrench, bounds));
}

}  // namespace test_support
