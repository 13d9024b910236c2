#include <tilt_ropter/actuation/actuator_model.hpp>

#include <gtest/gtest.h>

#include "support/random.hpp"

namespace {

using namespace tilt_ropter;

TEST(ActuatorModel, MatchesSeparateRotorsAndServos) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.servo.dead_time = 0.015;
  ActuatorModel<4> model(vehicle);
  Rotord rotor(vehicle.rotor);
  Servod servo(vehicle.servo);
  test_support::Random random(1);
  ActuatorState<4> command;
  for (int i = 0; i < 200; ++i) {
    const double time = 0.004 * i;
    for (int k = 0; k < 4; ++k) {
      command.rotor_speed(k) = random.uniform(0.0, 3000.0);
      command.tilt_angle(k) = random.uniform(-4.0, 4.0);
    }
    const ActuatorState<4>& state = model.update(time, command);
    EXPECT_EQ(state.rotor_speed(2), rotor.update(time, command.rotor_speed(2)));
    EXPECT_EQ(state.tilt_angle(2), servo.update(time, command.tilt_angle(2)));
  }
  EXPECT_GT(model.state().rotor_speed.minCoeff(), 0.0);
}

TEST(ActuatorModel, ResetSetsEveryActuator) {
  ActuatorModel<4, float> model(tilt_ropter_vehicle());
  ActuatorState<4, float> state;
  state.rotor_speed << 100.0F, 200.0F, 300.0F, 1e9F;
  state.tilt_angle << 0.1F, -0.2F, 0.3F, 9.0F;
  model.reset(state, 5.0);
  EXPECT_EQ(model.state().rotor_speed.head<3>(), state.rotor_speed.head<3>());
  EXPECT_EQ(model.state().tilt_angle.head<3>(), state.tilt_angle.head<3>());
  EXPECT_LT(model.state().rotor_speed(3), 1e4F);
  EXPECT_LT(model.state().tilt_angle(3), 3.2F);
  EXPECT_EQ(model.update(6.0, state).tilt_angle.head<3>(), state.tilt_angle.head<3>());
}

TEST(ActuatorModel, ResetWithoutATimeHoldsUntilTheNextUpdate) {
  ActuatorModel<4> model(tilt_ropter_vehicle());
  ActuatorState<4> state, command;
  state.rotor_speed.setConstant(500.0);
  state.tilt_angle.setConstant(0.3);
  model.update(1e6, command);
  model.reset(state);
  EXPECT_EQ(model.update(5.0, command).rotor_speed, state.rotor_speed);
  EXPECT_EQ(model.state().tilt_angle, state.tilt_angle);
  EXPECT_LT(model.update(5.1, command).rotor_speed.maxCoeff(), 100.0);
  EXPECT_LT(model.state().tilt_angle.maxCoeff(), 0.2);
}

TEST(ActuatorModel, FixedRotorsKeepAngleZero) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.rotors[1].tilts = false;
  ActuatorModel<4> model(vehicle);
  ActuatorState<4> command;
  command.tilt_angle.setConstant(1.0);
  model.update(0.0, command);
  model.update(1.0, command);
  EXPECT_EQ(model.state().tilt_angle(1), 0.0);
  EXPECT_GT(model.state().tilt_angle(0), 0.9);
}

}  // namespace
