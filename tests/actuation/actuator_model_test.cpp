#include <tilt_ropter/actuation/actuator_model.hpp>

#include <gtest/gtest.h>

#include "support/random.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace actuator_model_test {

using namespace tilt_ropter;

/// Motors that turn at a ratio of the speed that is sent to them, and the model that learns it from
/// readings at 500 Hz with the noise of the simulated sensor.
struct SlowMotors {
  explicit SlowMotors(const Vehicle<4>& vehicle = tilt_ropter_vehicle(), bool divides = true)
      : model(vehicle), motor(vehicle.rotor), divides_(divides) {
    command.rotor_speed.setConstant(1500.0);
    model.reset(command, 0.0);
    motor.reset(1500.0, 0.0);
  }

  /// Flies for `duration` [s]; `change(time)` alters the command, `fault(reading)` the reading of
  /// the first rotor.
  template <typename Change, typename Fault>
  void fly(double duration, const Change& change, const Fault& fault) {
    for (const double end = time + duration; time < end - 1e-9; time += 0.002) {
      change(time);
      const double sent = (divides_ ? model.to_send(command) : command).rotor_speed(0) * ratio;
      Eigen::Vector4d reading = Eigen::Vector4d::Constant(motor.update(time, sent));
      for (double& speed : reading) speed = std::max(0.0, speed + random_.normal(5.0));
      fault(reading(0));
      applied = model.update(time, command, reading);
    }
  }
  void fly(double duration) {
    fly(
        duration, [](double) {}, [](double&) {});
  }

  ActuatorModel<4> model;
  Rotord motor;
  ActuatorState<4> command, applied;
  double ratio = 1.0, time = 0.0;

 private:
  test_support::Random random_{3};
  bool divides_;
};

constexpr auto no_change = [](double) {};

TEST(ActuatorModel, DividesTheRatioOfMeasuredToCommandedSpeedOut) {
  for (const double ratio : {0.80, 0.9, 0.98, 1.0, 1.05, 1.15}) {
    SlowMotors motors;
    motors.ratio = ratio;
    motors.fly(3.0);
    EXPECT_NEAR(motors.model.speed_ratio()(0), ratio, 2e-3);
    EXPECT_NEAR(motors.motor.speed(), 1500.0, 4.0) << ratio;
    EXPECT_NEAR(motors.applied.rotor_speed(0), 1500.0, 20.0);
  }
}

TEST(ActuatorModel, FollowsABatteryThatEmpties) {
  SlowMotors motors;
  motors.fly(
      60.0, [&](double time) { motors.ratio = 1.0 - 0.2 * time / 60.0; }, [](double&) {});
  EXPECT_NEAR(motors.motor.speed(), 1500.0, 8.0);
}

TEST(ActuatorModel, DoesNotLearnFromWrongReadings) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (const double wrong : {0.0, nan, 1e6, -5.0, 1e300, 2000.0, 1000.0}) {
    SlowMotors motors;
    motors.ratio = 0.9;
    motors.fly(3.0);
    int i = 0;
    motors.fly(1.0, no_change,
               [&](double& reading) { reading = i++ % 100 == 0 ? wrong : reading; });
    EXPECT_NEAR(motors.model.speed_ratio()(0), 0.9, 3e-3) << wrong;
    motors.fly(0.004, no_change, [&](double& reading) { reading = wrong; });
    EXPECT_TRUE(all_finite(motors.applied.rotor_speed)) << wrong;
    EXPECT_LE(motors.applied.rotor_speed(0), 4500.0);
    EXPECT_NEAR(motors.model.speed_ratio()(0), 0.9, 3e-3) << wrong;
  }
}

TEST(ActuatorModel, DoesNotLearnALostRotorOrFrozenReadings) {
  SlowMotors motors;
  motors.fly(2.0);
  motors.fly(
      0.5, [&](double) { motors.ratio = 0.0; }, [](double&) {});  // stops
  EXPECT_NEAR(motors.model.speed_ratio()(0), 1.0, 0.01);
  EXPECT_NEAR(motors.applied.rotor_speed(0), 1500.0, 1.0);  // the lost thrust is an external force

  SlowMotors frozen;
  frozen.fly(2.0);
  frozen.command.rotor_speed.setConstant(1300.0);
  frozen.fly(1.0, no_change, [](double& reading) { reading = 1500.0; });
  EXPECT_NEAR(frozen.model.speed_ratio()(0), 1.0, 3e-3);
  EXPECT_NEAR(frozen.applied.rotor_speed(0), 1300.0, 1.0);  // the modelled speed
}

TEST(ActuatorModel, DoesNotLearnInTransients) {
  Vehicle<4> slow = tilt_ropter_vehicle();
  slow.rotor.time_constant *= 3.0;  // the motor's; the model has another time constant
  SlowMotors motors;
  motors.motor = Rotord(slow.rotor);
  motors.fly(
      5.0,
      [&](double time) {
        motors.command.rotor_speed.setConstant(std::fmod(time, 0.2) < 0.1 ? 1300.0 : 1700.0);
      },
      [](double&) {});
  EXPECT_NEAR(motors.model.speed_ratio()(0), 1.0, 0.02);
}

// The lag of rotors that are slower than believed must not turn the oscillation of a loop into a
// ratio: dividing it out would feed the oscillation.
TEST(ActuatorModel, DoesNotLearnTheLagInAnOscillation) {
  Vehicle<4> slow = tilt_ropter_vehicle();
  slow.rotor.time_constant *= 2.0;
  SlowMotors motors;
  motors.motor = Rotord(slow.rotor);
  motors.motor.reset(1500.0, 0.0);
  double largest = 0.0;
  motors.fly(
      5.0,
      [&](double time) {
        motors.command.rotor_speed.setConstant(1500.0 * (1.0 + 0.06 * std::sin(7.2 * time)));
        largest = std::max(largest, std::abs(motors.model.speed_ratio()(0) - 1.0));
      },
      [](double&) {});
  EXPECT_LT(largest, 4e-3);  // 7e-3 if it were learnt
}

TEST(ActuatorModel, BoundsTheRatioAndCommandsNoMoreThanTheTopSpeed) {
  SlowMotors motors;
  motors.ratio = 0.65;
  motors.fly(5.0);
  EXPECT_EQ(motors.model.speed_ratio()(0), 0.7);
  // What is left of the difference reaches the observer: it is told the commanded speed.
  EXPECT_NEAR(motors.applied.rotor_speed(0), 1500.0, 20.0);
  motors.command.rotor_speed.setConstant(1e4);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const double top = speed_from_thrust(vehicle.rotor.max_thrust, vehicle.rotor);
  EXPECT_DOUBLE_EQ(motors.model.to_send(motors.command).rotor_speed(0), top);
}

TEST(ActuatorModel, StartsFromKnownRatios) {
  ActuatorModel<4> model(tilt_ropter_vehicle());
  model.set_speed_ratio({0.8, 0.5, 2.0, 1.0});
  EXPECT_EQ(model.speed_ratio(), Eigen::Vector4d(0.8, 0.7, 1.2, 1.0));
  model.set_speed_ratio({std::nan(""), 1.0, 1.0, 1.0});
  EXPECT_EQ(model.speed_ratio(), Eigen::Vector4d(0.8, 0.7, 1.2, 1.0));
  ActuatorState<4> command;
  command.rotor_speed.setConstant(800.0);
  EXPECT_DOUBLE_EQ(model.to_send(command).rotor_speed(0), 1000.0);
}

TEST(ActuatorModel, IsRightWithoutToSend) {
  SlowMotors motors(tilt_ropter_vehicle(), false);
  motors.ratio = 0.9;
  motors.fly(3.0);
  EXPECT_NEAR(motors.motor.speed(), 1350.0, 1.0);
  EXPECT_NEAR(motors.applied.rotor_speed(0), 1500.0, 20.0);
}

TEST(ActuatorModel, SaturationIsNotLearntAsASlowRotor) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const double top = speed_from_thrust(vehicle.rotor.max_thrust, vehicle.rotor);
  SlowMotors motors;
  motors.ratio = 0.85;
  motors.fly(3.0);
  motors.command.rotor_speed.setConstant(0.95 * top);
  motors.fly(3.0);
  EXPECT_NEAR(motors.model.speed_ratio()(0), 0.85, 3e-3);
}

TEST(ActuatorModel, SlowRotorsLowerTheUsableVoltage) {
  const double nominal = tilt_ropter_vehicle().battery.nominal_voltage;
  SlowMotors motors;
  EXPECT_DOUBLE_EQ(motors.model.usable_voltage(), nominal);
  EXPECT_TRUE(motors.model.set_voltage(0.95 * nominal));
  EXPECT_DOUBLE_EQ(motors.model.usable_voltage(), 0.95 * nominal);
  motors.ratio = 0.8;
  motors.fly(4.0);
  EXPECT_NEAR(motors.model.usable_voltage(), 0.8 * nominal, 0.01 * nominal);
}

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

}  // namespace actuator_model_test
