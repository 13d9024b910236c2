#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include "../../examples/support/hybrid_experiment.hpp"
#include "support/actuator_loop.hpp"
#include "support/hovering.hpp"
#include "support/random.hpp"
#include "support/refusals.hpp"
#include "support/states.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>

namespace tilt_ropter {
namespace actuator_nmpc_test {

using test_support::ActuatorLoop;
using test_support::hover;
using test_support::Random;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

template <int Rotors>
[[nodiscard]] bool is_within_limits(const ActuatorState<Rotors>& command,
                                    const Vehicle<Rotors>& vehicle) {
  bool within = true;
  for (int i = 0; i < Rotors; ++i) {
    const auto& rotor = rotor_parameters(vehicle, static_cast<std::size_t>(i));
    const bool tilts = vehicle.rotors[static_cast<std::size_t>(i)].tilts;
    const double slack = 1e-9, speed = command.rotor_speed(i), angle = command.tilt_angle(i);
    within = within && speed >= speed_from_thrust(rotor.min_thrust, rotor) - slack &&
             speed <= speed_from_thrust(rotor.max_thrust, rotor) + slack &&
             angle >= (tilts ? vehicle.servo.min_angle : 0.0) - slack &&
             angle <= (tilts ? vehicle.servo.max_angle : 0.0) + slack;
  }
  return within;
}

// The true vehicle is heavier than the controller assumes.
template <int Rotors>
Vehicle<Rotors> heavier(Vehicle<Rotors> vehicle) {
  vehicle.body.mass *= 1.03;
  vehicle.body.inertia *= 1.1;
  return vehicle;
}

TEST(ActuatorNmpc, HoversWithoutOffsetInWind) {
  for (const Vehicle<4>& vehicle : {tilt_ropter_vehicle(), test_support::flat_quadrotor(),
                                    test_support::with_tilt_range(-pi / 3.0, pi / 3.0)}) {
    ActuatorLoop<4> loop(heavier(vehicle), vehicle);
    loop.start({0.0, 0.0, 1.5});
    loop.disturbance.force << 0.8, -1.2, 0.3;
    loop.disturbance.torque << 0.02, 0.01, -0.01;
    loop.run(4.0, hover);
    loop.restart_statistics();
    loop.run(2.0, hover);
    EXPECT_LT(loop.rmse(), 0.006);
    EXPECT_TRUE(loop.all_planned() && loop.sound());
    // Only the vehicle with fixed rotors leans.
    const Eigen::Vector3d up = loop.plant().body().orientation * Eigen::Vector3d::UnitZ();
    const double leaning = std::acos(std::min(up.z(), 1.0));
    if (vehicle.rotors[0].tilts) {
      EXPECT_LT(leaning, 0.02);
    } else {
      EXPECT_NEAR(std::tan(leaning), std::hypot(0.8, 1.2) / (1.03 * 1.5 * gravity), 0.02);
    }
  }
}

TEST(ActuatorNmpc, FollowsAStepWithinTheLimitsOfTheActuators) {
  for (const Vehicle<4>& vehicle : {tilt_ropter_vehicle(), test_support::flat_quadrotor(),
                                    test_support::with_tilt_range(-0.5, 0.4)}) {
    ActuatorLoop<4> loop(heavier(vehicle), vehicle);
    loop.start({3.0, -2.0, 2.5});
    for (int i = 0; i < 500; ++i) {
      const auto& result = loop.tick(hover);
      ASSERT_TRUE(is_within_limits(result.command, vehicle)) << i;
      ASSERT_LE(result.tilt_rate.cwiseAbs().maxCoeff(), vehicle.servo.max_rate + 1e-9) << i;
    }
    loop.restart_statistics();
    loop.run(1.0, hover);
    EXPECT_LT(loop.rmse(), 0.01);
    EXPECT_TRUE(loop.all_planned());
  }
}

// A quadrotor with fixed rotors pitches to drive, and steers by the difference of its rotors. 174
// mm if the model does not know that the wheels give the side force when the vehicle steers, 72 mm
// if it holds the rotation about body x also of the pitched body.
TEST(ActuatorNmpc, DrivesAFigureEightByLeaning) {
  const Vehicle<4> vehicle = test_support::flat_quadrotor();
  const Mission mission = examples::ground_experiment(*undercarriage(vehicle));
  ActuatorLoop<4> loop(heavier(vehicle), vehicle);
  loop.run(mission.duration(), mission);
  EXPECT_LT(loop.rmse(), 0.03);
  EXPECT_LT(loop.largest_error(), 0.06);
  EXPECT_EQ(loop.contact().mode_changes(), 0);
  EXPECT_TRUE(loop.all_planned() && loop.sound());
}

// Moves sideways with up to 1 m/s and 2.5 m/s^2.
ReferencePoint swinging(double time) {
  constexpr double size = 0.4, rate = 2.5;  // [m], [rad/s]
  ReferencePoint point = hover(time);
  const double s = std::sin(rate * time), c = std::cos(rate * time);
  point.position.y() = size * s;
  point.velocity.y() = size * rate * c;
  point.acceleration.y() = -size * rate * rate * s;
  return point;
}

TEST(ActuatorNmpc, CompensatesTheDeadTimeOfServos) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.servo.dead_time = 0.04;
  Vehicle<4> ignorant = vehicle;
  ignorant.servo.dead_time = 0.0;
  const auto error = [&](const Vehicle<4>& believed) {
    ActuatorLoop<4> loop(vehicle, believed);
    loop.start({0.0, 0.0, 1.5});
    loop.run(3.0, swinging);
    loop.restart_statistics();
    loop.run(4.0, swinging);
    return loop.rmse();
  };
  EXPECT_LT(error(vehicle), 0.01);
  EXPECT_LT(error(vehicle), 0.6 * error(ignorant));
}

// The failure happens in hover; the controller learns of it after 0.1 s.
void expect_hovers_on(const Vehicle<4>& damaged, const std::string& failure) {
  ActuatorLoop<4> loop(tilt_ropter_vehicle(), tilt_ropter_vehicle());
  loop.start({0.0, 0.0, 1.5});
  loop.run(0.5, hover);
  loop.fail(damaged);
  loop.run(0.1, hover);
  loop.tell(damaged);
  loop.run(3.5, hover);
  EXPECT_LT(loop.largest_error(), 0.5) << failure;
  loop.restart_statistics();
  loop.run(0.5, hover);
  EXPECT_LT(loop.rmse(), 0.01) << failure;
  const Eigen::Vector3d up = loop.plant().body().orientation * Eigen::Vector3d::UnitZ();
  EXPECT_GT(up.z(), std::cos(0.05)) << failure;
}

TEST(ActuatorNmpc, HoversOnWithAServoStuckAtAnyAngle) {
  for (const double degrees : {30.0, -60.0, 90.0, -90.0})
    expect_hovers_on(with_stuck_servo(tilt_ropter_vehicle(), 2, degrees * pi / 180.0),
                     std::to_string(degrees) + " degrees");
}

TEST(ActuatorNmpc, HoversOnWithALostOrWeakRotor) {
  for (const double effectiveness : {0.0, 0.5})
    for (const std::size_t rotor : {0U, 3U})
      expect_hovers_on(
          with_weak_rotor(tilt_ropter_vehicle(), rotor, effectiveness),
          "rotor " + std::to_string(rotor) + ", effectiveness " + std::to_string(effectiveness));
}

// Two rotors that tilt and lean the vehicle sideways: rank 4.
TEST(ActuatorNmpc, FliesABicopter) {
  Vehicle<2> vehicle;
  vehicle.body.mass = 1.2;
  vehicle.body.inertia = Eigen::Vector3d(0.014, 0.008, 0.02).asDiagonal();
  vehicle.rotors = {rotor_on_arm(-pi / 2.0, 0.2, Spin::counter_clockwise),
                    rotor_on_arm(pi / 2.0, 0.2, Spin::clockwise)};
  for (RotorGeometry& rotor : vehicle.rotors) rotor.position.z() = 0.06;
  vehicle.rotor.thrust_coefficient = 2.8e-6;
  vehicle.rotor.max_thrust = 18.0;
  ActuatorLoop<2> loop(heavier(vehicle), vehicle);
  loop.start({1.0, -0.5, 1.5});
  loop.disturbance.force << 0.5, -0.5, 0.0;
  loop.run(5.0, hover);
  loop.restart_statistics();
  loop.run(1.0, hover);
  EXPECT_LT(loop.rmse(), 0.01);
  EXPECT_TRUE(loop.all_planned() && loop.sound());
}

class ActuatorNmpcInput : public testing::Test {
 protected:
  ActuatorNmpcInput() { state.rotor_speed.setConstant(1620.0); }

  const ActuatorNmpcResult<4>& tick(const BodyStated& measured, const ActuatorState<4>& actuators) {
    time += 0.01;
    (void)nmpc.prepare(time, hover, in_the_air({}));
    return nmpc.feedback(time, measured, actuators);
  }

  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  ActuatorNmpc<4> nmpc{vehicle, test_support::in_simulated_time(actuator_nmpc_settings(vehicle))};
  BodyStated body = test_support::hovering();
  ActuatorState<4> state;
  double time = 0.0;
};

TEST_F(ActuatorNmpcInput, NanIsRejectedAndTheLastPlanContinues) {
  ASSERT_EQ(tick(body, state).status, NmpcStatus::solved);
  const ActuatorState<4> good = nmpc.result().command;
  BodyStated bad = body;
  bad.velocity.y() = nan;
  EXPECT_EQ(tick(bad, state).status, NmpcStatus::bad_state);
  EXPECT_LT((nmpc.result().command.rotor_speed - good.rotor_speed).norm(), 50.0);
  ActuatorState<4> off = state;
  off.rotor_speed(2) = nan;
  EXPECT_EQ(tick(body, off).status, NmpcStatus::bad_state);
  off = state;
  off.tilt_angle(0) = std::numeric_limits<double>::infinity();
  EXPECT_EQ(tick(body, off).status, NmpcStatus::bad_state);
  EXPECT_TRUE(is_within_limits(nmpc.result().command, vehicle));
  EXPECT_EQ(tick(body, state).status, NmpcStatus::solved);
}

TEST_F(ActuatorNmpcInput, LengthAndSignOfTheQuaternionDoNotMatter) {
  body.orientation = quaternion_exp(Eigen::Vector3d(0.01, -0.02, 0.015));
  const auto command = [this](double factor) {
    nmpc = ActuatorNmpc<4>(vehicle, nmpc.settings());  // starts at this state
    BodyStated measured = body;
    measured.orientation.coeffs() *= factor;
    EXPECT_EQ(tick(measured, state).status, NmpcStatus::solved);
    return nmpc.result().command;
  };
  const ActuatorState<4> unit = command(1.0);
  for (const double factor : {1.1, 0.9, 2.0, -1.0}) {
    EXPECT_LT((command(factor).rotor_speed - unit.rotor_speed).norm(), 1e-3) << factor;
    EXPECT_LT((command(factor).tilt_angle - unit.tilt_angle).norm(), 1e-6) << factor;
  }
}

TEST_F(ActuatorNmpcInput, SafeCommandFollowsWhenThePlanIsTooOld) {
  (void)tick(body, state);
  for (int i = 0; i < 25; ++i) {
    time += 0.01;
    (void)nmpc.hold(time);
  }
  EXPECT_EQ(nmpc.result().status, NmpcStatus::no_plan);
  const ActuatedBody<4> model(vehicle);
  const Wrenchd given = model.wrench(nmpc.result().command);
  EXPECT_LT((given.force - Eigen::Vector3d(0.0, 0.0, 1.5 * gravity)).norm(), 1e-3);
  EXPECT_LT(given.torque.norm(), 1e-4);
  EXPECT_TRUE(has_plan(tick(body, state).status));
}

TEST_F(ActuatorNmpcInput, CommandsAreFiniteAndWithinLimitsForAnyState) {
  Random random(9);
  for (int i = 0; i < 200; ++i) {
    BodyStated any = test_support::random_state(random).body;
    any.position *= random.uniform(0.0, 100.0);
    for (int n = 0; n < 4; ++n) {
      state.rotor_speed(n) = random.uniform(-1e4, 1e4);
      state.tilt_angle(n) = random.uniform(-10.0, 10.0);
    }
    const auto& result = tick(any, state);
    ASSERT_TRUE(all_finite(result.command.rotor_speed) && all_finite(result.command.tilt_angle));
    ASSERT_TRUE(is_within_limits(result.command, vehicle)) << i;
  }
}

TEST_F(ActuatorNmpcInput, PreparesNothingForATimeThatIsNotFinite) {
  EXPECT_EQ(nmpc.prepare(nan, hover, in_the_air({})), optimal_control::PrepareStatus::rejected);
  EXPECT_EQ(nmpc.feedback(0.0, body, state).status, NmpcStatus::no_plan);
}

TEST_F(ActuatorNmpcInput, VoltageLimitsTheThrust) {
  Vehicle<4> with_battery = vehicle;
  with_battery.battery.nominal_voltage = 22.0;
  ActuatorNmpc<4> controller(with_battery);
  EXPECT_FALSE(controller.set_voltage(1.0));
  EXPECT_TRUE(controller.set_voltage(16.0));
  const double most = max_thrust_at(vehicle.rotor, 16.0 / 22.0);
  Wrenchd strong;
  strong.force.z() = 1000.0;
  EXPECT_NEAR(controller.command_for(strong).rotor_speed(1), speed_from_thrust(most, vehicle.rotor),
              1e-9);
}

TEST(ActuatorNmpcSettings, DefaultsEqualTheSettingsOfTheReferenceVehicle) {
  const ActuatorNmpcSettings computed = actuator_nmpc_settings(tilt_ropter_vehicle()), given;
  const ActuatorLevelWeights &a = computed.problem.weights, &b = given.problem.weights;
  const auto close = [](double x, double y) { return std::abs(x / y - 1.0) < 1e-3; };
  EXPECT_TRUE(close(a.thrust, b.thrust) && close(a.thrust_rate, b.thrust_rate) &&
              close(a.tilt_rate, b.tilt_rate) && close(a.thrust_on_ground, b.thrust_on_ground));
  for (int i = 0; i < 3; ++i)
    EXPECT_TRUE(close(a.position(i), b.position(i)) && close(a.velocity(i), b.velocity(i)) &&
                close(a.orientation(i), b.orientation(i)) &&
                close(a.angular_velocity(i), b.angular_velocity(i)));
}

TEST(ActuatorNmpcSettings, TwiceTheAllowedErrorHasAQuarterOfTheWeight) {
  AllowedErrors errors;
  errors.position *= 2.0;
  errors.velocity *= 2.0;
  errors.orientation *= 2.0;
  errors.angular_velocity *= 2.0;
  errors.thrust *= 2.0;
  errors.thrust_on_ground *= 2.0;
  errors.thrust_rate *= 2.0;
  errors.tilt_rate *= 2.0;
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ActuatorLevelWeights a = actuator_nmpc_settings(vehicle).problem.weights,
                             b = actuator_nmpc_settings(vehicle, errors).problem.weights;
  EXPECT_TRUE(a.position.isApprox(4.0 * b.position));
  EXPECT_TRUE(a.velocity.isApprox(4.0 * b.velocity));
  EXPECT_TRUE(a.orientation.isApprox(4.0 * b.orientation));
  EXPECT_TRUE(a.angular_velocity.isApprox(4.0 * b.angular_velocity));
  EXPECT_DOUBLE_EQ(a.thrust, 4.0 * b.thrust);
  EXPECT_DOUBLE_EQ(a.thrust_on_ground, 4.0 * b.thrust_on_ground);
  EXPECT_DOUBLE_EQ(a.thrust_rate, 4.0 * b.thrust_rate);
  EXPECT_DOUBLE_EQ(a.tilt_rate, 4.0 * b.tilt_rate);
}

TEST(ActuatorNmpcSettings, AreCheckedAtConstructionAndWhenReplaced) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ActuatorNmpcSettings valid = actuator_nmpc_settings(vehicle);
  ActuatorNmpc<4> controller(vehicle, valid);
  ActuatorNmpcSettings settings = valid;
  settings.period = 0.0;
  const char* period = "ControllerSettings.period [s]";
  test_support::expect_refused(period, [&] { ActuatorNmpc<4>(vehicle, settings); });
  test_support::expect_refused(period, [&] { controller.set_settings(settings); });
  settings = valid;
  settings.solver.program.max_passes = 3;
  test_support::expect_refused("ControllerSettings.solver",
                               [&] { controller.set_settings(settings); });
  settings = valid;
  settings.problem.intervals = 10;
  test_support::expect_refused("HorizonSettings.intervals",
                               [&] { controller.set_settings(settings); });
  test_support::expect_accepted([&] { controller.set_settings(valid); });
}

}  // namespace actuator_nmpc_test
}  // namespace tilt_ropter
