#pragma once

#include <tilt_ropter/compiled.hpp>
#include <tilt_ropter/tilt_ropter.hpp>

#include <gtest/gtest.h>

/// What the tests' precompiled header holds, see TILT_ROPTER_BUILD_QUICKLY. The function is never
/// called: with it, what a dozen tests instantiate is instantiated once, which takes a third off
/// the time of compiling each.
namespace test_support {

inline void instantiate(const tilt_ropter::Mission& mission) {
  using namespace tilt_ropter;
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserver<> observer(vehicle.body);
  Plant<4> plant(vehicle);
  Nmpc<4> nmpc(vehicle);
  Ekf<> ekf;
  ekf.on_imu(0.0, {});
  ekf.on_pose(0.0, {});
  ContactEstimator contact(vehicle);
  (void)nmpc.prepare(0.0, mission, contact.update(0.0, plant.body(), observer));
  const NmpcResult& result = nmpc.feedback(0.0, plant.body());
  const auto command = allocation.allocate(0.0, result.wrench, result.rate, {}).command;
  observer.update(0.0, plant.inertial_sample(),
                  allocation.wrench(ActuatorState<4>{command.rotor_speed,
                                                     actuators.update(0.0, command).tilt_angle}));
  plant.step(command, {}, 0.01);
}

}  // namespace test_support
