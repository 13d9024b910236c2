// Rotors with individual parameters and a battery with variable voltage, in all classes that use
// rotors.

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/control/detail/actuator_constraints.hpp>
#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>
#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace unlike_rotors_test {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::Random;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

RotorParameters some_rotor(Random& random) {
  RotorParameters p;
  p.thrust_coefficient = random.uniform(0.8e-6, 3e-6);
  p.max_thrust = random.uniform(8.0, 16.0);
  p.linear_thrust_coefficient =
      random.uniform(-0.9, 2.0) * std::sqrt(0.5 * p.thrust_coefficient * p.max_thrust);
  p.torque_ratio = random.uniform(0.008, 0.03);
  p.time_constant = random.uniform(0.01, 0.08);
  return p;
}

Vehicle<4> unlike(Random& random) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.battery.nominal_voltage = 22.2;
  for (std::size_t i = 0; i < 3; ++i) vehicle.rotors[i].parameters = some_rotor(random);
  vehicle.rotors[1].effectiveness = 0.9;
  return vehicle;
}

Wrenchd some_wrench(Random& random, double size) {
  return {random.vector(size * 5.0) + Vector3d(0.0, 0.0, size * 14.0), random.vector(size * 0.8)};
}

Wrenchd upward(double force) {
  Wrenchd wrench;
  wrench.force.z() = force;
  return wrench;
}

/// Returns c Omega^2 + b Omega of rotor i times its effectiveness, computed independently [N].
double thrust_of(const Vehicle<4>& vehicle, std::size_t i, double speed) {
  const RotorParameters& p = i == 3 ? vehicle.rotor : *vehicle.rotors[i].parameters;
  return vehicle.rotors[i].effectiveness *
         std::max(0.0, p.thrust_coefficient * speed * speed + p.linear_thrust_coefficient * speed);
}

TEST(UnlikeRotors, EqualOwnParametersMatchCommonParametersBitForBit) {
  Random random(1);
  for (int run = 0; run < 20; ++run) {
    RotorParameters parameters = some_rotor(random);
    parameters.min_thrust = run % 2 == 0 ? 0.0 : 0.4;
    Vehicle<4> common = tilt_ropter_vehicle(), own = tilt_ropter_vehicle();
    common.rotor = parameters;
    for (RotorGeometry& rotor : own.rotors) rotor.parameters = parameters;
    own.rotor = {1.0, 3.0, run % 2 == 0 ? 1e5 : 0.0, 1e6, 0.7, 0.5};  // unused

    const Allocation<4> a(common), b(own);
    EXPECT_EQ(a.matrix(), b.matrix());
    for (int i = 0; i < 50; ++i) {
      const Wrenchd wanted = some_wrench(random, random.uniform(0.0, 4.0)),
                    rate = some_wrench(random, 0.2);
      const auto x = a.allocate(0.0, wanted, rate, {}), y = b.allocate(0.0, wanted, rate, {});
      EXPECT_EQ(x.status, y.status);
      EXPECT_EQ(x.command.rotor_speed, y.command.rotor_speed);
      EXPECT_EQ(x.command.tilt_angle, y.command.tilt_angle);
      EXPECT_EQ(x.lost.force, y.lost.force);
    }
    const ControlAuthority c = control_authority(common), d = control_authority(own);
    EXPECT_EQ(c.condition, d.condition);
    EXPECT_EQ(c.forward, d.forward);
    EXPECT_EQ(c.least_thrust, d.least_thrust);
    const Eigen::Vector4d fast = Eigen::Vector4d::Constant(900.0);
    EXPECT_EQ(PowerModel(common).power(fast), PowerModel(own).power(fast));
    EXPECT_EQ(ActuatorConstraints<4>(common).upper(), ActuatorConstraints<4>(own).upper());

    ActuatorModel<4> model(common), own_model(own);
    Plant<4> plant(common), own_plant(own);
    const OutputScaling<4> scaling(common), own_scaling(own);
    ActuatorState<4> command;
    for (int i = 0; i < 20; ++i) {
      for (int k = 0; k < 4; ++k) command.rotor_speed(k) = random.uniform(0.0, 4000.0);
      EXPECT_EQ(model.update(0.01 * i, command).rotor_speed,
                own_model.update(0.01 * i, command).rotor_speed);
      ASSERT_TRUE(plant.step(command, {}, 0.01) && own_plant.step(command, {}, 0.01));
      EXPECT_EQ(plant.body().velocity, own_plant.body().velocity);
      EXPECT_EQ(plant.body().angular_velocity, own_plant.body().angular_velocity);
      EXPECT_EQ(scaling.outputs(command)->motor, own_scaling.outputs(command)->motor);
    }
  }
}

TEST(UnlikeRotors, CommandsGiveWantedWrenchInSimulation) {
  Random random(2);
  int reached = 0;
  for (int run = 0; run < 300; ++run) {
    const Vehicle<4> vehicle = unlike(random);
    const Allocation<4> allocation(vehicle);
    Plant<4> plant(vehicle);
    const Wrenchd wanted = some_wrench(random, 1.0);
    const auto result = allocation.allocate(wanted, {});
    plant.reset(BodyStated{}, result.command);
    const Wrenchd& given = plant.actuator_wrench();
    EXPECT_LT((given.force - result.achieved.force).norm(), 1e-10);
    EXPECT_LT((given.torque - result.achieved.torque).norm(), 1e-10);
    if (result.status != AllocationStatus::ok) continue;
    ++reached;
    EXPECT_LT((given.force - wanted.force).norm(), 1e-10);
    EXPECT_LT((given.torque - wanted.torque).norm(), 1e-10);
  }
  EXPECT_GT(reached, 200);
}

TEST(UnlikeRotors, EachRotorKeepsItsOwnLimits) {
  Random random(3);
  std::array<int, 4> at_limit{};
  for (int run = 0; run < 300; ++run) {
    Vehicle<4> vehicle = unlike(random);
    vehicle.rotors[0].parameters->min_thrust = 0.5;
    const Allocation<4> allocation(vehicle);
    const auto result = allocation.allocate(some_wrench(random, 4.0), {});
    for (std::size_t i = 0; i < 4; ++i) {
      const double thrust =
          thrust_of(vehicle, i, result.command.rotor_speed(static_cast<Eigen::Index>(i)));
      const double most = vehicle.rotors[i].effectiveness * rotor_parameters(vehicle, i).max_thrust;
      EXPECT_LE(thrust, most * (1.0 + 1e-9));
      at_limit[i] += thrust > most * (1.0 - 1e-6);
      if (i == 0) {
        EXPECT_GE(thrust, 0.5 * (1.0 - 1e-9));
      }
    }
  }
  for (const int count : at_limit) EXPECT_GT(count, 10);
}

TEST(UnlikeRotors, LagCompensationUsesEachRotorsOwnTimeConstant) {
  Random random(4);
  for (int run = 0; run < 100; ++run) {
    Vehicle<4> vehicle = unlike(random);
    vehicle.rotors[1].effectiveness = 1.0;
    const Allocation<4> allocation(vehicle);
    const Wrenchd now{Vector3d(1.0, -1.0, 15.0), Vector3d(0.1, 0.1, 0.05)};
    const Wrenchd rate{random.vector(5.0), random.vector(0.5)};
    const double h = 1e-5;
    const Wrenchd next{now.force + h * rate.force, now.torque + h * rate.torque};
    const auto still = allocation.allocate(now, {}), later = allocation.allocate(next, {}),
               moving = allocation.allocate(0.0, now, rate, {});
    ASSERT_EQ(still.status, AllocationStatus::ok);
    for (std::size_t i = 0; i < 4; ++i) {
      const auto k = static_cast<Eigen::Index>(i);
      const double slope = (later.command.rotor_speed(k) - still.command.rotor_speed(k)) / h;
      EXPECT_NEAR(moving.command.rotor_speed(k) - still.command.rotor_speed(k),
                  rotor_parameters(vehicle, i).time_constant * slope, 1e-3);
    }
  }
}

TEST(UnlikeRotors, HoverPowerMatchesParameter) {
  Random random(5);
  const Vehicle<4> vehicle = unlike(random);
  Eigen::Vector4d speeds;
  for (std::size_t i = 0; i < 4; ++i)
    speeds(static_cast<Eigen::Index>(i)) =
        speed_from_thrust(vehicle.body.mass * gravity / 4.0, rotor_parameters(vehicle, i));
  EXPECT_NEAR(PowerModel(vehicle).power(speeds), vehicle.power.hover, 1e-9);
  EXPECT_GT(speeds.maxCoeff() - speeds.minCoeff(), 10.0);
}

// Reference: the top speeds at the nominal voltage times the voltage ratio.
TEST(Voltage, LowersSpeedAndThrustLimitsInAllClasses) {
  Random random(6);
  for (int run = 0; run < 50; ++run) {
    const Vehicle<4> vehicle = unlike(random);
    Allocation<4> allocation(vehicle);
    ActuatorModel<4> model(vehicle);
    ActuatorConstraints<4> constraints(vehicle);
    Plant<4> plant(vehicle);
    ActuatorState<4> fastest;
    fastest.rotor_speed.setConstant(1e6);
    const Wrenchd lift = upward(1000.0);
    const auto tops = [&](double time) {
      model.update(time, fastest);
      model.update(time + 10.0, fastest);
      return model.state().rotor_speed;
    };
    const Eigen::Vector4d full = tops(0.0);
    const double full_lift = allocation.allocate(lift, {}).achieved.force.z();
    double time = 100.0;
    for (const double ratio : {0.7, 0.9, 1.2, 0.8}) {
      const double left = std::min(ratio, 1.0);
      for (const bool taken :
           {allocation.set_voltage(22.2 * ratio), model.set_voltage(22.2 * ratio),
            constraints.set_voltage(22.2 * ratio), plant.set_voltage(22.2 * ratio)})
        EXPECT_TRUE(taken);
      const auto refused = [&](double voltage) {
        return !allocation.set_voltage(voltage) && !model.set_voltage(voltage) &&
               !constraints.set_voltage(voltage) && !plant.set_voltage(voltage);
      };
      for (const double bad : {nan, 0.0, -22.2, 11.0, 34.0, 1e300}) EXPECT_TRUE(refused(bad));

      EXPECT_LT((tops(time) - left * full).norm(), 1e-8 * full.norm());
      time += 100.0;
      const auto result = allocation.allocate(lift, {});
      EXPECT_EQ(result.status, AllocationStatus::limited);
      EXPECT_LE((result.command.rotor_speed - left * full).maxCoeff(), 1e-6);
      // At least one rotor is at its top speed.
      EXPECT_GT((result.command.rotor_speed - left * full).maxCoeff(), -1e-2);
      if (left < 1.0) {
        EXPECT_LT(result.achieved.force.z(), left * full_lift);
      }
      // A command with lag compensation also stays below the top speed.
      const auto ahead = allocation.allocate(0.0, lift, upward(1e4), {});
      EXPECT_LE((ahead.command.rotor_speed - left * full).maxCoeff(), 1e-6);

      ASSERT_TRUE(plant.step(fastest, {}, 1.0));
      EXPECT_LT((plant.actuators().rotor_speed - left * full).norm(), 1e-4 * full.norm());
      PlantState<4> start = plant.state();
      start.body = BodyStated{};
      plant.reset(start);
      for (std::size_t i = 0; i < 4; ++i)
        EXPECT_NEAR(constraints.upper()(8 + static_cast<Eigen::Index>(i)),
                    thrust_of(vehicle, i, left * full(static_cast<Eigen::Index>(i))), 1e-8);
    }
  }
}

TEST(Voltage, IsIgnoredIfNominalVoltageIsUnknown) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Allocation<4> allocation(vehicle);
  ActuatorModel<4> model(vehicle);
  ActuatorConstraints<4> constraints(vehicle), none;
  Plant<4> plant(vehicle);
  EXPECT_FALSE(allocation.set_voltage(20.0) || model.set_voltage(20.0) ||
               constraints.set_voltage(20.0) || none.set_voltage(20.0) || plant.set_voltage(20.0));
}

TEST(Voltage, LostRotorsStayLost) {
  Vehicle<6> vehicle = test_support::tilting_hexacopter();
  vehicle.body.mass = 2.0;
  vehicle.battery.nominal_voltage = 20.0;
  vehicle.rotors[2].effectiveness = 0.0;
  Allocation<6> allocation(vehicle);
  ActuatorConstraints<6> constraints(vehicle);
  ASSERT_TRUE(allocation.set_voltage(18.0) && constraints.set_voltage(18.0));
  EXPECT_EQ(constraints.upper()(14), std::numeric_limits<double>::infinity());
  const Wrenchd wanted = upward(25.0);
  const auto result = allocation.allocate(wanted, {});
  EXPECT_NE(result.status, AllocationStatus::limited);
  EXPECT_EQ(result.command.rotor_speed(2), 0.0);
  EXPECT_LT(result.lost.force.norm(), 1e-9);
}

TEST(Voltage, BoundsPlannedThrustsAfterFirstNode) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.battery.nominal_voltage = 20.0;
  using Problem = WheeledFlightProblem<4>;
  ActuatorConstraints<4> constraints(vehicle);
  Problem problem(vehicle.body, {}, constraints);
  const auto before = problem.upper(1);
  ASSERT_TRUE(constraints.set_voltage(16.0));
  problem.set_actuators(constraints);
  const int last = problem.horizon();
  for (const int k : {1, last})
    for (int i = 0; i < 4; ++i) EXPECT_NEAR(problem.upper(k).tail<4>()(i), 0.64 * 12.0, 1e-12);
  EXPECT_EQ(problem.upper(1).head<Problem::constraints - 4>(),
            before.head<Problem::constraints - 4>());
  EXPECT_EQ(problem.upper(0).tail<4>().minCoeff(), std::numeric_limits<double>::infinity());
}

}  // namespace unlike_rotors_test
