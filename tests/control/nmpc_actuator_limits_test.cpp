// Plans and commands keep the limits of the rotors and servos.

#include <tilt_ropter/control/nmpc.hpp>

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/hovering.hpp"
#include "support/ideal_loop.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace nmpc_actuator_limits_test {

using test_support::expect_within_bounds;
using test_support::hover;
using test_support::hovering;
using test_support::IdealLoop;
using test_support::in_simulated_time;

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const RigidBodyParameters body = vehicle.body;

// Returns the largest rotor thrust in the plan of a 3 m climb, without the first node [N]. The
// thrusts are the minimum-norm thrusts of the planned wrenches. Sets `top` to the thrust limit at
// `voltage`.
double planned_thrust(double voltage, double& top) {
  Vehicle<4> battery = vehicle;
  battery.battery.nominal_voltage = 20.0;
  Nmpc<4> nmpc(battery, in_simulated_time());
  EXPECT_FALSE(nmpc.set_voltage(0.0));
  EXPECT_TRUE(nmpc.set_voltage(voltage));
  const auto above = [](double time) {
    ReferencePoint point = hover(time);
    point.position.z() += 3.0;
    return point;
  };
  for (int i = 0; i < 40; ++i) {
    (void)nmpc.prepare(0.01 * i, above, in_the_air({}));
    EXPECT_TRUE(has_plan(nmpc.feedback(0.01 * i, hovering()).status));
  }
  const Allocation<4> allocation(battery);
  double largest = 0.0;
  for (int k = 1; k <= nmpc.solver().horizon(); ++k) {
    const Wrenchd planned = nmpc.solver().state(k).wrench;
    const Eigen::Matrix<double, 8, 1> thrusts =
        allocation.pseudoinverse().leftCols<3>() * planned.force +
        allocation.pseudoinverse().rightCols<3>() * planned.torque;
    for (int i = 0; i < 4; ++i)
      largest = std::max(largest, std::hypot(thrusts(2 * i), thrusts(2 * i + 1)));
  }
  top = max_thrust_at(vehicle.rotor, voltage / 20.0);
  return largest;
}

TEST(Nmpc, PlansKeepTheThrustLimitAtThisVoltage) {
  double full = 0.0, sagged = 0.0;
  const double with_full = planned_thrust(20.0, full), with_sagged = planned_thrust(12.0, sagged);
  EXPECT_NEAR(full, 12.0, 1e-12);
  EXPECT_NEAR(sagged, 0.36 * 12.0, 1e-12);
  EXPECT_GT(with_full, 1.2 * sagged);
  EXPECT_LE(with_sagged, sagged + 0.01);
  EXPECT_GT(with_sagged, sagged - 0.1);
}

// Result of a flight with slow servos along a fast, small circle. The bounds on the wrench rate are
// too wide to become active.
struct SlowServos {
  // RMS position error [m]; largest tilt rates, as fractions of the servo's max_rate.
  double rmse = 0.0, planned = 0.0, demanded = 0.0;
  int failures = 0;
};

SlowServos fly_with_slow_servos(bool actuator_constraints) {
  Vehicle<4> slow = vehicle;
  slow.servo.max_rate = 1.5;
  NmpcSettings settings;
  settings.problem.bounds.force_rate.setConstant(200.0);
  settings.problem.bounds.torque_rate.setConstant(40.0);
  settings.problem.weights.force_rate.setConstant(0.002);
  settings.problem.weights.torque_rate.setConstant(0.02);
  settings.actuator_constraints = actuator_constraints;
  const auto circle = [](double t) {
    const double radius = 0.2, rate = 4.0, c = std::cos(rate * t), s = std::sin(rate * t);
    ReferencePoint point = hover(t);
    point.position += radius * Eigen::Vector3d(c, s, 0.0);
    point.velocity = radius * rate * Eigen::Vector3d(-s, c, 0.0);
    point.acceleration = -radius * rate * rate * Eigen::Vector3d(c, s, 0.0);
    return point;
  };
  Plant<4> plant(slow);
  PlantState<4> start;
  start.body = hovering();  // in the centre of the circle: must catch up
  start.actuators.rotor_speed.setConstant(speed_from_thrust(body.mass * gravity / 4.0, slow.rotor));
  plant.reset(start);
  const Allocation<4> allocation(slow);
  Nmpc<4> nmpc(slow, in_simulated_time(settings));
  AllocationResult<4> sent;
  sent.command = start.actuators;
  SlowServos result;
  const int ticks = 800;
  for (int i = 0; i < ticks; ++i) {
    const double time = plant.time();
    (void)nmpc.prepare(time, circle, {});
    const NmpcResult& r = nmpc.feedback(time, plant.body());
    if (!has_plan(r.status)) ++result.failures;
    const double speed = slow.servo.max_rate;
    const Eigen::Vector4d planned = allocation.rates(r.wrench, r.rate).tilt_rate / speed;
    sent = allocation.allocate(time, r.wrench, r.rate, sent);
    const Eigen::Vector4d demanded =
        (sent.command.tilt_angle - plant.actuators().tilt_angle) / slow.servo.time_constant / speed;
    result.planned = std::max(result.planned, planned.cwiseAbs().maxCoeff());
    result.demanded = std::max(result.demanded, demanded.cwiseAbs().maxCoeff());
    EXPECT_TRUE(plant.step(sent.command, {}, 0.01));
    result.rmse += (plant.body().position - circle(plant.time()).position).squaredNorm() / ticks;
  }
  result.rmse = std::sqrt(result.rmse);
  return result;
}

TEST(Nmpc, ActuatorConstraintsKeepSlowServosBelowTheirMaxRate) {
  const SlowServos with = fly_with_slow_servos(true), without = fly_with_slow_servos(false);
  EXPECT_EQ(with.failures, 0);
  EXPECT_LE(with.planned, NmpcBounds{}.tilt_rate_fraction + 1e-6);
  EXPECT_LE(with.demanded, 1.0);
  EXPECT_GT(with.planned, 0.8);
  EXPECT_GT(without.planned, 5.0);
  EXPECT_GT(without.demanded, 5.0);
  EXPECT_LT(with.rmse, 0.08);
  EXPECT_GT(without.rmse, 2.0 * with.rmse);  // the servos saturate
}

TEST(Nmpc, CommandKeepsActuatorConstraintsFromAnyStart) {
  const Allocation<4> allocation(vehicle);
  NmpcSettings settings;
  settings.problem.bounds.tilt_rate_fraction = 0.1;
  const double limit = settings.problem.bounds.tilt_rate_fraction * vehicle.servo.max_rate;
  double fastest = 0.0;
  for (int start = 0; start < 6; ++start) {
    IdealLoop loop(settings);
    const double side = start % 2 == 0 ? 1.0 : -1.0;
    loop.state.body.position += side * start * Eigen::Vector3d(0.3, -0.2, 0.1);
    loop.state.body.velocity << 0.0, side, -0.5 * start;
    loop.state.body.orientation = quaternion_from_yaw(0.4 * side * start);
    for (int i = 0; i < 150; ++i) {
      const NmpcResult& result = loop.tick(hover);
      ASSERT_TRUE(has_plan(result.status));
      expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
      const auto rates = allocation.rates(result.wrench, result.rate);
      fastest = std::max(fastest, rates.tilt_rate.cwiseAbs().maxCoeff());
    }
  }
  EXPECT_NEAR(fastest, limit, 1e-6);
}

}  // namespace nmpc_actuator_limits_test
}  // namespace tilt_ropter
