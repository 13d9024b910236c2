#include <tilt_ropter/actuation/actuator_outputs.hpp>

#include "support/autodiff.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>
#include <Eigen/Core>

#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace actuator_outputs_test {

using Eigen::Vector4d;
using test_support::Random;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();

ActuatorOutputSettings<4> settings() {
  ActuatorOutputSettings<4> s;
  s.thrust_model_factor = 0.3;
  s.servos[1] = {0.05, false};
  s.servos[2] = {0.0, true};
  s.servos[3] = {-0.1, true};
  return s;
}

Vehicle<4> vehicle() {
  Vehicle<4> v = tilt_ropter_vehicle();
  v.servo.min_angle = -1.0;  // not centred
  v.servo.max_angle = 2.0;
  return v;
}

TEST(MotorOutput, SatisfiesPx4ThrustModel) {
  Random random(91);
  const RotorParameters rotor = tilt_ropter_vehicle().rotor;
  for (int i = 0; i < 10000; ++i) {
    const double f = i % 3 == 0 ? 0.0 : i % 3 == 1 ? 1.0 : random.uniform(0.0, 1.0);
    const double fraction = random.uniform(0.0, 1.0);
    const double speed = std::sqrt(fraction * rotor.max_thrust / rotor.thrust_coefficient);
    const double u = motor_output(speed, rotor, f);
    EXPECT_GE(u, 0.0);
    EXPECT_LE(u, 1.0);
    EXPECT_NEAR(f * u * u + (1.0 - f) * u, fraction, 1e-14);
    EXPECT_NEAR(speed_from_motor_output(u, rotor, f), speed, 1e-10 * speed);
  }
}

TEST(MotorOutput, FactorZeroGivesThrustAndFactorOneGivesSpeed) {
  const RotorParameters rotor = tilt_ropter_vehicle().rotor;
  const double full = std::sqrt(rotor.max_thrust / rotor.thrust_coefficient);
  EXPECT_NEAR(motor_output(full / 2, rotor, 0.0), 0.25, 1e-15);
  EXPECT_NEAR(motor_output(full / 2, rotor, 1.0), 0.5, 1e-15);
  EXPECT_EQ(motor_output(1.01 * full, rotor, 0.3), 1.0);
  EXPECT_NEAR(speed_from_motor_output(1.0, rotor, 0.3), full, 1e-10);
  EXPECT_NEAR(speed_from_motor_output(7.0, rotor, 0.3), full, 1e-10);
}

TEST(MotorOutput, InvalidSpeedOrOutputGivesZero) {
  const RotorParameters rotor = tilt_ropter_vehicle().rotor;
  for (const double f : {0.0, 0.5, 1.0})
    for (const double bad : {nan, inf, -inf, -1.0, -0.0, 0.0, 1e300}) {
      EXPECT_EQ(motor_output(bad, rotor, f), 0.0);
      if (!(bad >= 1.0)) {
        EXPECT_EQ(speed_from_motor_output(bad, rotor, f), 0.0);
      }
    }
}

TEST(ServoOutput, IsLinearOverServoRange) {
  const ServoParameters servo = vehicle().servo;
  for (const bool reversed : {false, true}) {
    const double sign = reversed ? -1.0 : 1.0;
    EXPECT_NEAR(servo_output(-1.0, servo, {0.0, reversed}), -sign, 1e-15);
    EXPECT_NEAR(servo_output(2.0, servo, {0.0, reversed}), sign, 1e-15);
    EXPECT_NEAR(servo_output(0.5, servo, {0.0, reversed}), 0.0, 1e-15);
    EXPECT_NEAR(servo_output(0.5, servo, {0.2, reversed}), 0.2, 1e-15);
    EXPECT_NEAR(servo_output(1.1, servo, {0.2, reversed}), 0.2 + sign * 0.4, 1e-15);
  }
  EXPECT_EQ(servo_output(2.0, servo, {0.1, false}), 1.0);  // clamped
  EXPECT_EQ(servo_output(-inf, servo, {}), -1.0);
  EXPECT_EQ(servo_output(inf, servo, {0.0, true}), -1.0);
  EXPECT_TRUE(std::isnan(servo_output(nan, servo, {})));
  EXPECT_TRUE(std::isnan(angle_from_servo_output(nan, servo, {})));
  // With a trim, one end of the output range lies beyond the servo range, and the angle is clamped.
  EXPECT_EQ(angle_from_servo_output(-1.0, servo, {0.1, false}), servo.min_angle);
  EXPECT_EQ(angle_from_servo_output(-1.0, servo, {0.1, true}), servo.max_angle);
  EXPECT_NEAR(angle_from_servo_output(1.0, servo, {0.1, false}), 2.0 - 0.15, 1e-15);
  EXPECT_EQ(angle_from_servo_output(inf, servo, {}), servo.max_angle);
}

// A trim moves the range of angles, so that the end of the output is not the end of the angle.
TEST(ServoOutput, OutputBeyondItsRangeGivesTheAngleAtItsEnd) {
  const ServoParameters servo = vehicle().servo;  // from -1 to 2 rad
  for (const double far : {1.0001, 1.1, 5.0, inf})
    for (const bool reversed : {false, true}) {
      const double sign = reversed ? -1.0 : 1.0;
      EXPECT_NEAR(angle_from_servo_output(-far, servo, {-0.2, reversed}), 0.5 - sign * 1.2, 1e-15);
      EXPECT_NEAR(angle_from_servo_output(far, servo, {0.2, reversed}), 0.5 + sign * 1.2, 1e-15);
    }
  EXPECT_EQ(servo_output(-1.0, servo, {-0.2, false}), -1.0);
  EXPECT_EQ(servo_output(2.0, servo, {-0.2, true}), -1.0);
  EXPECT_EQ(servo_output(-1.0, servo, {0.2, true}), 1.0);
}

TEST(OutputScaling, RoundTripIsIdentity) {
  Random random(92);
  const OutputScaling<4> scaling(vehicle(), settings());
  const double full = std::sqrt(vehicle().rotor.max_thrust / vehicle().rotor.thrust_coefficient);
  for (int i = 0; i < 1000; ++i) {
    ActuatorState<4> command;
    for (int k = 0; k < 4; ++k) {
      command.rotor_speed(k) = random.uniform(0.0, full);
      command.tilt_angle(k) = random.uniform(-0.8, 1.8);  // where no trim causes clamping
    }
    const auto outputs = scaling.outputs(command);
    ASSERT_TRUE(outputs.has_value());
    const auto back = scaling.command(*outputs);
    ASSERT_TRUE(back.has_value());
    EXPECT_LT((back->rotor_speed - command.rotor_speed).norm(), 1e-9);
    EXPECT_LT((back->tilt_angle - command.tilt_angle).norm(), 1e-14);
  }
}

TEST(OutputScaling, EachServoHasItsOwnTrimAndDirection) {
  ActuatorState<4> command;
  command.tilt_angle.setConstant(1.1);
  const auto outputs = OutputScaling<4>(vehicle(), settings()).outputs(command);
  ASSERT_TRUE(outputs.has_value());
  EXPECT_LT((outputs->servo - Vector4d(0.4, 0.45, -0.4, -0.5)).norm(), 1e-15);
}

TEST(OutputScaling, KeepsRangeForRandomCommandsAndRejectsNonFinite) {
  Random random(93);
  const OutputScaling<4> scaling(vehicle(), settings());
  const double extremes[] = {nan, inf, -inf, 0.0, -0.0, 1e-310, 1e300, -1e300, 1.0, -5.0};
  int refused = 0;
  const int calls = test_support::quick_or_full(100000, 1000000);
  for (int i = 0; i < calls; ++i) {
    const auto number = [&] {
      return random.uniform(0.0, 1.0) < 0.2 ? extremes[static_cast<int>(random.uniform(0.0, 10.0))]
                                            : random.uniform(-1e4, 1e4);
    };
    ActuatorState<4> command;
    ActuatorOutputs<4> outputs;
    for (int k = 0; k < 4; ++k) {
      command.rotor_speed(k) = number();
      command.tilt_angle(k) = number();
      outputs.motor(k) = number();
      outputs.servo(k) = number();
    }
    const auto out = scaling.outputs(command);
    EXPECT_EQ(out.has_value(), all_finite(command.rotor_speed) && all_finite(command.tilt_angle));
    if (out) {
      EXPECT_TRUE((out->motor.array() >= 0.0).all() && (out->motor.array() <= 1.0).all());
      EXPECT_TRUE((out->servo.array().abs() <= 1.0).all());
    } else {
      ++refused;
    }
    const auto back = scaling.command(outputs);
    EXPECT_EQ(back.has_value(), all_finite(outputs.servo));
    if (!back) continue;
    EXPECT_TRUE(all_finite(back->rotor_speed));
    EXPECT_GE(back->rotor_speed.minCoeff(), 0.0);
    EXPECT_GE(back->tilt_angle.minCoeff(), -1.0);
    EXPECT_LE(back->tilt_angle.maxCoeff(), 2.0);
  }
  EXPECT_GT(refused, 1000);
}

TEST(OutputScaling, DisarmedMotorHasZeroSpeed) {
  ActuatorOutputs<4> outputs;
  outputs.motor << nan, 0.5, nan, 1.0;
  const auto command = OutputScaling<4>(vehicle()).command(outputs);
  ASSERT_TRUE(command.has_value());
  EXPECT_EQ(command->rotor_speed(0), 0.0);
  EXPECT_EQ(command->rotor_speed(2), 0.0);
  EXPECT_GT(command->rotor_speed(1), 0.0);
}

// Thrust of the motor at duty cycle `duty`, as a fraction of the thrust at full duty cycle and
// nominal voltage. `m` is the motors' thrust model factor. The motor sees `duty` times the
// battery's voltage.
double thrust_fraction(double duty, double ratio, double m) {
  const double seen = duty * ratio;
  return m * seen * seen + (1.0 - m) * seen;
}

TEST(OutputScaling, RaisesOutputsIfVoltageSags) {
  Random random(94);
  Vehicle<4> v = vehicle();
  v.battery.nominal_voltage = 22.2;
  const double full = std::sqrt(v.rotor.max_thrust / v.rotor.thrust_coefficient);
  for (int i = 0; i < 1000; ++i) {
    ActuatorOutputSettings<4> s;
    const double m = s.thrust_model_factor = random.uniform(0.0, 1.0);
    const double p = s.autopilot_factor = random.uniform(0.0, 1.0);
    OutputScaling<4> scaling(v, s);
    const double ratio = random.uniform(0.6, 1.3);
    ASSERT_TRUE(scaling.set_voltage(22.2 * ratio));
    ActuatorState<4> command;
    for (int k = 0; k < 4; ++k) command.rotor_speed(k) = random.uniform(0.05, 1.0) * full;
    const auto outputs = scaling.outputs(command);
    ASSERT_TRUE(outputs.has_value());
    const auto back = scaling.command(*outputs);
    ASSERT_TRUE(back.has_value());
    for (int k = 0; k < 4; ++k) {
      const double wanted = std::pow(command.rotor_speed(k) / full, 2);
      // The autopilot computes the duty cycle from its own thrust model, here by bisection.
      double duty = 0.0, most = 1.0;
      for (int step = 0; step < 60; ++step) {
        const double middle = 0.5 * (duty + most);
        (p * middle * middle + (1.0 - p) * middle < outputs->motor(k) ? duty : most) = middle;
      }
      if (wanted < thrust_fraction(1.0, ratio, m)) {
        EXPECT_NEAR(thrust_fraction(duty, ratio, m), wanted, 1e-12);
        EXPECT_NEAR(back->rotor_speed(k), command.rotor_speed(k), 1e-8 * full);
      } else {
        EXPECT_EQ(outputs->motor(k), 1.0);
        EXPECT_LT(back->rotor_speed(k), command.rotor_speed(k));
      }
    }
  }
}

TEST(OutputScaling, IgnoresVoltagesOutOfRange) {
  Vehicle<4> v = vehicle();
  ActuatorState<4> command;
  command.rotor_speed.setConstant(1000.0);
  EXPECT_FALSE(OutputScaling<4>(v, settings()).set_voltage(20.0));  // nominal voltage unknown
  v.battery.nominal_voltage = 20.0;
  OutputScaling<4> scaling(v, settings());
  EXPECT_EQ(scaling.outputs(command)->motor,
            OutputScaling<4>(vehicle(), settings()).outputs(command)->motor);
  ASSERT_TRUE(scaling.set_voltage(16.0));
  const Vector4d sagged = scaling.outputs(command)->motor;
  for (const double bad : {nan, inf, 0.0, -16.0, 9.9, 30.1})
    EXPECT_FALSE(scaling.set_voltage(bad)) << bad;
  EXPECT_EQ(scaling.outputs(command)->motor, sagged);
  EXPECT_GT(sagged(0), OutputScaling<4>(v, settings()).outputs(command)->motor(0));
}

TEST(OutputScaling, WorksInSinglePrecisionAndWithDerivatives) {
  const RotorParameters rotor = vehicle().rotor;
  EXPECT_NEAR(motor_output(1500.0F, rotor, 0.3), motor_output(1500.0, rotor, 0.3), 1e-6);
  const auto slope = test_support::jacobian_at_zero<2, 2>([&](const auto& step) {
    using Dual = test_support::Dual<2>;
    return Eigen::Matrix<Dual, 2, 1>(
        motor_output(Dual(1500.0 + step(0)), rotor, 0.3),
        servo_output(Dual(0.2 + step(1)), vehicle().servo, {0.1, true}));
  });
  const double h = 1e-3;
  EXPECT_NEAR(
      slope(0, 0),
      (motor_output(1500.0 + h, rotor, 0.3) - motor_output(1500.0 - h, rotor, 0.3)) / (2 * h),
      1e-10);
  EXPECT_NEAR(slope(1, 1), -1.0 / 1.5, 1e-15);
}

}  // namespace actuator_outputs_test
}  // namespace tilt_ropter
