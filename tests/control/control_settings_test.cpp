// Every limit of the controllers' settings, by the name in the message.

#include <tilt_ropter/control/detail/actuator_constraints.hpp>
#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/control/reference_check.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace tilt_ropter {
namespace control_settings_test {

using namespace test_support;

// The weights and bounds that both levels have.
template <typename S>
void check_flight_weights() {
  const Fields<S> check;
  check("FlightWeights.position [1/m^2]", &S::position, not_negative());
  check("FlightWeights.velocity [s^2/m^2]", &S::velocity, not_negative());
  check("FlightWeights.orientation [1/rad^2]", &S::orientation, not_negative());
  check("FlightWeights.angular_velocity [s^2/rad^2]", &S::angular_velocity, not_negative());
  check("FlightWeights.terminal", &S::terminal, positive());
  check("FlightWeights.ground", &S::ground, not_negative());
}

template <typename S>
void check_flight_bounds() {
  const Fields<S> check;
  check("FlightBounds.angular_velocity [rad/s]", &S::angular_velocity, positive_or_infinite());
  check("FlightBounds.tilt_rate_fraction", &S::tilt_rate_fraction, above_up_to(0.0, 1.0));
}

TEST(ControlSettings, NmpcWeightsNameEachField) {
  using S = NmpcWeights;
  const Fields<S> check;
  check_flight_weights<S>();
  check("NmpcWeights.force [1/N^2]", &S::force, not_negative());
  check("NmpcWeights.torque [1/(N m)^2]", &S::torque, not_negative());
  check("NmpcWeights.force_rate [s^2/N^2]", &S::force_rate, positive());
  check("NmpcWeights.torque_rate [s^2/(N m)^2]", &S::torque_rate, positive());
  check("NmpcWeights.ground_thrust [1/N^2]", &S::ground_thrust, not_negative());
}

TEST(ControlSettings, NmpcBoundsNameEachField) {
  using B = NmpcBounds;
  B valid;
  valid.force_min.setConstant(-1.0);
  valid.force_max.setConstant(2.0);
  valid.torque_min.setConstant(-3.0);
  valid.torque_max.setConstant(4.0);
  const Fields<B> bounds{valid};
  bounds("NmpcBounds.force_rate [N/s]", &B::force_rate, positive_or_infinite());
  bounds("NmpcBounds.torque_rate [N m/s]", &B::torque_rate, positive_or_infinite());
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
  check_flight_bounds<B>();
}

TEST(ControlSettings, WheeledFlightNamesEachField) {
  using S = WheeledFlightSettings;
  S valid;
  const Fields<S> check;
  check("HorizonSettings.intervals", &S::intervals, whole_numbers(1, 1000));
  check("HorizonSettings.interval [s]", &S::interval, positive());
  check.refuse("FlightWeights.terminal", [](S& s) { s.weights.terminal = 0.0; });
  check.refuse("NmpcBounds.force_rate [N/s]", [](S& s) { s.bounds.force_rate.setZero(); });
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
  riccati("FlightWeights.position [1/m^2]", position, same);
  riccati("FlightWeights.velocity [s^2/m^2]", velocity, same);
  riccati("FlightWeights.orientation [1/rad^2]", orientation, same);
  check("FlightWeights.position [1/m^2]", position, any);
  check("FlightWeights.velocity [s^2/m^2]", velocity, any);
  check("FlightWeights.orientation [1/rad^2]", orientation, any);
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

// The fields that the settings of both levels have.
template <typename S>
void check_controller() {
  const Fields<S> check;
  check.refuse("HorizonSettings.intervals", [](S& s) { s.problem.intervals = 0; });
  check.refuse("FlightWeights.terminal", [](S& s) { s.problem.weights.terminal = 0.0; });
  check.refuse("SolverSettings.memory", [](S& s) { s.solver.memory = -1; });
  check.refuse("GroundContactSettings.down_force [N]",
               [](S& s) { s.ground.down_force = infinite; });
  check("ControllerSettings.period [s]", &S::period, positive());
  check("ControllerSettings.time_limit [s]", &S::time_limit,
        {{0.0, 1e300, infinite}, {below(0.0), -infinite, not_a_number}});
  check("ControllerSettings.max_plan_age [s]", &S::max_plan_age, positive());
  check("ControllerSettings.failures_before_reset", &S::failures_before_reset, at_least(1));
}

TEST(ControlSettings, BothLevelsNameEachField) {
  check_controller<NmpcSettings>();
  check_controller<ActuatorNmpcSettings>();
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.servo.max_rate = 0.0;
  expect_refused("ServoParameters.max_rate [rad/s]", [&] { ActuatorConstraints<4>{vehicle}; });
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
  check("AllowedErrors.thrust [thrust in hover]", &S::thrust, positive());
  check("AllowedErrors.thrust_on_ground [thrust in hover]", &S::thrust_on_ground, positive());
  check("AllowedErrors.thrust_rate [thrust in hover / s]", &S::thrust_rate, positive());
  check("AllowedErrors.tilt_rate [rad/s]", &S::tilt_rate, positive());
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  S bad;
  bad.torque.z() = 0.0;
  const char* name = "AllowedErrors.torque [m g size]";
  expect_refused(name, [&] { (void)nmpc_settings(vehicle, bad); });
  expect_refused(name, [&] { (void)actuator_nmpc_settings(vehicle, bad); });
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
  check_flight_weights<W>();
  weights("ActuatorLevelWeights.thrust [1/N^2]", &W::thrust, not_negative());
  weights("ActuatorLevelWeights.thrust_on_ground [1/N^2]", &W::thrust_on_ground, not_negative());
  weights("ActuatorLevelWeights.thrust_rate [s^2/N^2]", &W::thrust_rate, positive());
  weights("ActuatorLevelWeights.tilt_rate [s^2/rad^2]", &W::tilt_rate, positive());
  check_flight_bounds<FlightBounds>();
  using S = ActuatorLevelSettings;
  const Fields<S> check;
  check("HorizonSettings.intervals", &S::intervals, whole_numbers(1, 1000));
  check("HorizonSettings.interval [s]", &S::interval, positive());
  check.refuse("FlightWeights.terminal", [](S& s) { s.weights.terminal = 0.0; });
  check.refuse("FlightBounds.tilt_rate_fraction", [](S& s) { s.bounds.tilt_rate_fraction = 0.0; });
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
  expect_refused("ControllerSettings.max_plan_age [s]", check);
  settings = {};
  vehicle.power.servo_move = -1.0;
  expect_refused("PowerParameters.servo_move [J/rad]", check);
}

}  // namespace control_settings_test
}  // namespace tilt_ropter
