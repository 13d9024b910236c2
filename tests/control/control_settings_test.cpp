// Every limit of the controllers' settings, by the name in the message.

#include <tilt_ropter/control/detail/actuator_constraints.hpp>
#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/control/reference_check.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace tilt_ropter {
namespace {

using namespace test_support;

const Range penalty{{1e-300, infinite}, {0.0, -1.0, not_a_number}};

TEST(ControlSettings, NmpcWeightsNameEachField) {
  using S = NmpcWeights;
  const Fields<S> check;
  check("NmpcWeights.force [1/N^2]", &S::force, not_negative());
  check("NmpcWeights.torque [1/(N m)^2]", &S::torque, not_negative());
  check("NmpcWeights.position [1/m^2]", &S::position, not_negative());
  check("NmpcWeights.velocity [s^2/m^2]", &S::velocity, not_negative());
  check("NmpcWeights.orientation [1/rad^2]", &S::orientation, not_negative());
  check("NmpcWeights.angular_velocity [s^2/rad^2]", &S::angular_velocity, not_negative());
  check("NmpcWeights.force_rate [s^2/N^2]", &S::force_rate, positive());
  check("NmpcWeights.torque_rate [s^2/(N m)^2]", &S::torque_rate, positive());
  check("NmpcWeights.terminal", &S::terminal, positive());
  check("NmpcWeights.ground", &S::ground, not_negative());
  check("NmpcWeights.ground_thrust [1/N^2]", &S::ground_thrust, not_negative());
}

TEST(ControlSettings, NmpcBoundsAndPenaltiesNameEachField) {
  using B = NmpcBounds;
  B valid;
  valid.force_min.setConstant(-1.0);
  valid.force_max.setConstant(2.0);
  valid.torque_min.setConstant(-3.0);
  valid.torque_max.setConstant(4.0);
  const Fields<B> bounds{valid};
  bounds("NmpcBounds.force_rate [N/s]", &B::force_rate, positive_or_infinite());
  bounds("NmpcBounds.torque_rate [N m/s]", &B::torque_rate, positive_or_infinite());
  bounds("NmpcBounds.angular_velocity [rad/s]", &B::angular_velocity, positive_or_infinite());
  const auto lower = [](double limit) {
    return Range{{-infinite, limit}, {above(limit), not_a_number}};
  };
  const auto upper = [](double limit) {
    return Range{{infinite, limit}, {below(limit), not_a_number}};
  };
  bounds("NmpcBounds.force [N] lower bound", &B::force_min, lower(2.0));
  bounds("NmpcBounds.force [N] lower bound", &B::force_max, upper(-1.0));
  bounds("NmpcBounds.torque [N m] lower bound", &B::torque_min, lower(4.0));
  bounds("NmpcBounds.torque [N m] lower bound", &B::torque_max, upper(-3.0));
  using P = NmpcPenalties;
  const Fields<P> penalties;
  penalties("NmpcPenalties.rate [s/N, s/(N m)]", &P::rate, penalty);
  penalties("NmpcPenalties.wrench [1/N, 1/(N m)]", &P::wrench, penalty);
  penalties("NmpcPenalties.angular_velocity [s/rad]", &P::angular_velocity, penalty);
  penalties("NmpcPenalties.actuators", &P::actuators, penalty);
}

TEST(ControlSettings, WheeledFlightNamesEachField) {
  using S = WheeledFlightSettings;
  S valid;
  const Fields<S> check;
  check("WheeledFlightSettings.intervals", &S::intervals, whole_numbers(1, 1000));
  check("WheeledFlightSettings.interval [s]", &S::interval, positive());
  check.refuse("NmpcWeights.terminal", [](S& s) { s.weights.terminal = 0.0; });
  check.refuse("NmpcBounds.force_rate [N/s]", [](S& s) { s.bounds.force_rate.setZero(); });
  check.refuse("NmpcPenalties.wrench [1/N, 1/(N m)]", [](S& s) { s.penalties.wrench = 0.0; });
  // The cost after the horizon turns with the heading: x and y are the same.
  for (Eigen::Vector3d* weight :
       {&valid.weights.position, &valid.weights.velocity, &valid.weights.orientation})
    weight->setConstant(5.0);
  Fields<S> riccati{valid};
  riccati.valid.terminal_cost = TerminalCost::riccati;
  const auto position = [](S& s, double v) { s.weights.position.x() = v; };
  const auto velocity = [](S& s, double v) { s.weights.velocity.y() = v; };
  const auto orientation = [](S& s, double v) { s.weights.orientation.x() = v; };
  const Range same{{5.0}, {6.0, 4.0}}, any{{5.0, 6.0, 4.0}, {}};
  riccati("NmpcWeights.position [1/m^2]", position, same);
  riccati("NmpcWeights.velocity [s^2/m^2]", velocity, same);
  riccati("NmpcWeights.orientation [1/rad^2]", orientation, same);
  check("NmpcWeights.position [1/m^2]", position, any);
  check("NmpcWeights.velocity [s^2/m^2]", velocity, any);
  check("NmpcWeights.orientation [1/rad^2]", orientation, any);
}

TEST(ControlSettings, GroundContactNamesEachField) {
  using S = GroundContactSettings;
  const Fields<S> check;
  check("GroundContactSettings.planned_height [m]", &S::planned_height,
        {{-infinite, -1.0, 1e300}, {infinite, not_a_number}});
  check("GroundContactSettings.settling_speed [m/s]", &S::settling_speed,
        {{0.0, 0.01, 10.0}, {below(0.0), above(0.0), below(0.01), above(10.0), not_a_number}});
  check("GroundContactSettings.down_force [N]", &S::down_force, any_finite());
  check("GroundContactSettings.rotor_thrust [N]", &S::rotor_thrust, not_negative());
  const Undercarriage wheels, sunk{0.0, true, true, true};
  const RigidBodyParameters body, massless{0.0, body.inertia};
  S bad;
  bad.rotor_thrust = -1.0;
  expect_refused("GroundContactSettings.rotor_thrust [N]",
                 [&] { GroundContact(body, wheels, bad); });
  expect_refused("Undercarriage.height [m]", [&] { GroundContact(body, sunk); });
  expect_refused("RigidBodyParameters.mass [kg]", [&] { GroundContact(massless, wheels); });
  expect_accepted([&] { GroundContact(body, std::nullopt); });
}

TEST(ControlSettings, ActuatorConstraintsNameEachField) {
  using S = ActuatorConstraintSettings;
  const Fields<S> check;
  check("ActuatorConstraintSettings.tilt_rate_fraction", &S::tilt_rate_fraction,
        above_up_to(0.0, 1.0));
  check("ActuatorConstraintSettings.hold_thrust [N]", &S::hold_thrust, positive());
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ActuatorConstraints<4> valid(vehicle);
  S bad;
  bad.hold_thrust = 0.0;
  const char* name = "ActuatorConstraintSettings.hold_thrust [N]";
  expect_refused(name, [&] { ActuatorConstraints<4>(vehicle, bad); });
  expect_refused(name, [&] { (void)valid.with(bad); });
  vehicle.servo.max_rate = 0.0;
  expect_refused("ServoParameters.max_rate [rad/s]", [&] { ActuatorConstraints<4>{vehicle}; });
}

TEST(ControlSettings, NmpcNamesEachField) {
  using S = NmpcSettings;
  const Fields<S> check;
  check.refuse("NmpcWeights.terminal", [](S& s) { s.problem.weights.terminal = 0.0; });
  check.refuse("SolverSettings.memory", [](S& s) { s.solver.memory = -1; });
  check.refuse("GroundContactSettings.down_force [N]",
               [](S& s) { s.ground.down_force = infinite; });
  check.refuse("ActuatorConstraintSettings.hold_thrust [N]",
               [](S& s) { s.actuators.hold_thrust = 0.0; });
  check("NmpcSettings.period [s]", &S::period, positive());
  check("NmpcSettings.time_limit [s]", &S::time_limit,
        {{0.0, 1e300, infinite}, {below(0.0), -infinite, not_a_number}});
  check("NmpcSettings.max_plan_age [s]", &S::max_plan_age, positive());
  check("NmpcSettings.failures_before_reset", &S::failures_before_reset, at_least(1));
}

TEST(ControlSettings, AllowedErrorsNameEachField) {
  using S = AllowedErrors;
  const Fields<S> check;
  check("AllowedErrors.position [m]", &S::position, positive());
  check("AllowedErrors.velocity [m/s]", &S::velocity, positive());
  check("AllowedErrors.orientation [rad]", &S::orientation, positive());
  check("AllowedErrors.angular_velocity [rad/s]", &S::angular_velocity, positive());
  check("AllowedErrors.force [m g]", &S::force, positive());
  check("AllowedErrors.torque [m g size]", &S::torque, positive());
  check("AllowedErrors.force_rate [m g / s]", &S::force_rate, positive());
  check("AllowedErrors.torque_rate [m g size / s]", &S::torque_rate, positive());
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  S bad;
  bad.torque.z() = 0.0;
  expect_refused("AllowedErrors.torque [m g size]", [&] { (void)nmpc_settings(vehicle, bad); });
  Vehicle<4> point = vehicle;
  for (RotorGeometry& rotor : point.rotors) rotor.position.setZero();
  expect_refused(
      "nmpc_settings: weight times mean distance of the rotors [N m]",
      [&] { (void)nmpc_settings(point); }, "0:");
  vehicle.body.mass = -1.0;
  expect_refused("RigidBodyParameters.mass [kg]", [&] { (void)nmpc_settings(vehicle); });
}

TEST(ControlSettings, ActuatorLevelNamesEachField) {
  using W = ActuatorLevelWeights;
  const Fields<W> weights;
  weights("ActuatorLevelWeights.position [1/m^2]", &W::position, not_negative());
  weights("ActuatorLevelWeights.velocity [s^2/m^2]", &W::velocity, not_negative());
  weights("ActuatorLevelWeights.orientation [1/rad^2]", &W::orientation, not_negative());
  weights("ActuatorLevelWeights.angular_velocity [s^2/rad^2]", &W::angular_velocity,
          not_negative());
  weights("ActuatorLevelWeights.thrust [1/N^2]", &W::thrust, not_negative());
  weights("ActuatorLevelWeights.thrust_on_ground [1/N^2]", &W::thrust_on_ground, not_negative());
  weights("ActuatorLevelWeights.thrust_rate [s^2/N^2]", &W::thrust_rate, positive());
  weights("ActuatorLevelWeights.tilt_rate [s^2/rad^2]", &W::tilt_rate, positive());
  weights("ActuatorLevelWeights.terminal", &W::terminal, positive());
  weights("ActuatorLevelWeights.ground", &W::ground, not_negative());
  using B = ActuatorLevelBounds;
  const Fields<B> bounds;
  bounds("ActuatorLevelBounds.angular_velocity [rad/s]", &B::angular_velocity,
         positive_or_infinite());
  bounds("ActuatorLevelBounds.tilt_rate_fraction", &B::tilt_rate_fraction, above_up_to(0.0, 1.0));
  using P = ActuatorLevelPenalties;
  const Fields<P> penalties;
  penalties("ActuatorLevelPenalties.thrust [1/N]", &P::thrust, penalty);
  penalties("ActuatorLevelPenalties.tilt_angle [1/rad]", &P::tilt_angle, penalty);
  penalties("ActuatorLevelPenalties.angular_velocity [s/rad]", &P::angular_velocity, penalty);
  using S = ActuatorLevelSettings;
  const Fields<S> check;
  check("ActuatorLevelSettings.intervals", &S::intervals, whole_numbers(1, 1000));
  check("ActuatorLevelSettings.interval [s]", &S::interval, positive());
  check.refuse("ActuatorLevelWeights.terminal", [](S& s) { s.weights.terminal = 0.0; });
  check.refuse("ActuatorLevelBounds.tilt_rate_fraction",
               [](S& s) { s.bounds.tilt_rate_fraction = 0.0; });
  check.refuse("ActuatorLevelPenalties.thrust [1/N]", [](S& s) { s.penalties.thrust = 0.0; });
}

TEST(ControlSettings, ActuatorNmpcNamesEachField) {
  using S = ActuatorNmpcSettings;
  const Fields<S> check;
  check.refuse("ActuatorLevelSettings.intervals", [](S& s) { s.problem.intervals = 0; });
  check.refuse("SolverSettings.memory", [](S& s) { s.solver.memory = -1; });
  check.refuse("GroundContactSettings.down_force [N]",
               [](S& s) { s.ground.down_force = infinite; });
  check("ActuatorNmpcSettings.period [s]", &S::period, positive());
  check("ActuatorNmpcSettings.time_limit [s]", &S::time_limit,
        {{0.0, 1e300, infinite}, {below(0.0), -infinite, not_a_number}});
  check("ActuatorNmpcSettings.max_plan_age [s]", &S::max_plan_age, positive());
  check("ActuatorNmpcSettings.failures_before_reset", &S::failures_before_reset, at_least(1));
}

TEST(ControlSettings, AllowedActuatorErrorsNameEachField) {
  using S = AllowedActuatorErrors;
  const Fields<S> check;
  check("AllowedActuatorErrors.position [m]", &S::position, positive());
  check("AllowedActuatorErrors.velocity [m/s]", &S::velocity, positive());
  check("AllowedActuatorErrors.orientation [rad]", &S::orientation, positive());
  check("AllowedActuatorErrors.angular_velocity [rad/s]", &S::angular_velocity, positive());
  check("AllowedActuatorErrors.thrust [thrust in hover]", &S::thrust, positive());
  check("AllowedActuatorErrors.thrust_on_ground [thrust in hover]", &S::thrust_on_ground,
        positive());
  check("AllowedActuatorErrors.thrust_rate [thrust in hover / s]", &S::thrust_rate, positive());
  check("AllowedActuatorErrors.tilt_rate [rad/s]", &S::tilt_rate, positive());
  S bad;
  bad.tilt_rate = 0.0;
  expect_refused("AllowedActuatorErrors.tilt_rate [rad/s]",
                 [&] { (void)actuator_nmpc_settings(tilt_ropter_vehicle(), bad); });
}

TEST(ControlSettings, ReferenceCheckNamesItsArguments) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  NmpcSettings settings;
  double start = 0.0, end = 0.1, step = 0.05;
  GroundPlane plane;
  const auto check = [&] {
    const auto reference = [](double) { return ReferencePoint{}; };
    (void)check_reference(reference, start, end, vehicle, settings, step, plane);
  };
  expect_range("check_reference.step [s]", {{0.05}, {0.0, -1.0, not_a_number, infinite}}, true,
               [&](double value) {
                 step = value;
                 check();
               });
  step = 0.05;
  const char* name = "check_reference.end [s]";
  expect_range(name, {{0.1}, {0.0, -1.0, not_a_number, infinite}}, true, [&](double value) {
    end = value;
    check();
  });
  end = 0.1;
  expect_range(name, {{0.0}, {0.1, 1.0, not_a_number, -infinite}}, false, [&](double value) {
    start = value;
    check();
  });
  start = 0.0;
  expect_range("check_reference.plane.height [m]", {{0.0}, {not_a_number, infinite, -infinite}},
               true, [&](double value) {
                 plane.height = value;
                 check();
               });
  plane.height = 0.0;
  expect_range("check_reference.plane.slope", {{0.0}, {not_a_number, infinite}}, false,
               [&](double value) {
                 plane.slope.y() = value;
                 check();
               });
  plane = {};
  settings.max_plan_age = 0.0;
  expect_refused("NmpcSettings.max_plan_age [s]", check);
  settings = {};
  vehicle.power.servo_move = -1.0;
  expect_refused("PowerParameters.servo_move [J/rad]", check);
}

}  // namespace
}  // namespace tilt_ropter
