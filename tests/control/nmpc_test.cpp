#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/hovering.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

namespace tilt_ropter {
namespace {

using test_support::expect_within_bounds;
using test_support::hover;
using test_support::hovering;
using test_support::in_simulated_time;

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const RigidBodyParameters body = vehicle.body;

// A rigid body that gets exactly the wrench that is planned, with an unknown force.
class IdealLoop {
 public:
  explicit IdealLoop(const NmpcSettings& settings = {})
      : nmpc(vehicle, in_simulated_time(settings)) {
    state.body = hovering();
  }

  template <typename Reference>
  const NmpcResult& tick(const Reference& reference, const Wrench<>& estimate = {},
                         bool blind = false) {
    (void)nmpc.prepare(time, reference, in_the_air(estimate));
    BodyState<> measured = state.body;
    if (blind) measured.velocity.x() = std::numeric_limits<double>::quiet_NaN();
    const NmpcResult& result = nmpc.feedback(time, measured);
    state.wrench = result.wrench;
    Eigen::Matrix<double, 6, 1> rate;
    rate << result.rate.force, result.rate.torque;
    state = plant.step(state, rate, unknown, 0.01);
    time += 0.01;
    return result;
  }

  RigidBody<> plant{body};
  Nmpc<4> nmpc;
  State<> state;
  Wrench<> unknown;
  double time = 0.0;
};

ContactEstimate standing_on_the_ground() {
  ContactEstimate contact;
  contact.on_ground = contact.ground_known = true;
  return contact;
}

NmpcSettings settings_with(TerminalCost terminal, int intervals) {
  NmpcSettings settings;
  settings.problem.terminal_cost = terminal;
  settings.problem.intervals = intervals;
  return settings;
}

TEST(Nmpc, HoldsHoverAndReturnsToIt) {
  for (const TerminalCost terminal : {TerminalCost::weights, TerminalCost::riccati}) {
    IdealLoop loop(settings_with(terminal, 20));
    loop.state.body.position += Eigen::Vector3d(0.3, -0.2, 0.2);
    for (int i = 0; i < 500; ++i) ASSERT_EQ(loop.tick(hover).status, NmpcStatus::solved);
    EXPECT_LT((loop.state.body.position - hovering().position).norm(), 2e-3);
  }
}

// So close to hover that the plan is linear and keeps to every bound: the infinite-horizon optimal
// feedback, which the cost to go at the end of any horizon has to give.
TEST(Nmpc, WithTheCostToGoAtItsEndAShortHorizonPlansAsAnEndlessOne) {
  using Solver = MultipleShooting<WheeledFlightProblem<4>>;
  const double yaw = 0.7, small = 1e-5;
  const auto first_input = [&](TerminalCost terminal, int intervals, int coordinate) {
    Vehicle<4> slim = vehicle;
    slim.body.inertia.diagonal() << 0.010, 0.018, 0.025;
    Solver solver(WheeledFlightProblem<4>(slim.body, settings_with(terminal, intervals).problem));
    State<> x;
    x.body = hovering();
    x.body.orientation = quaternion_from_yaw(yaw);
    x.wrench.force.z() = body.mass * gravity;
    for (int k = 0; k <= intervals; ++k) {
      solver.problem().node(k).reference = x.body;
      solver.problem().node(k).wrench_reference = x.wrench;
    }
    solver.reset(x);
    const StateTangent<> off = small * StateTangent<>::Unit(coordinate);
    EXPECT_EQ(solver.solve(retract(x, off)).status, SolveStatus::converged);
    return Eigen::Matrix<double, 6, 1>(solver.input(0) / small);
  };
  double differs = 0.0;
  for (int coordinate = 0; coordinate < 18; ++coordinate) {
    const auto endless = first_input(TerminalCost::weights, 100, coordinate);
    for (const int intervals : {2, 3, 4, 5}) {
      const auto with = first_input(TerminalCost::riccati, intervals, coordinate),
                 without = first_input(TerminalCost::weights, intervals, coordinate);
      EXPECT_LT((with - endless).norm(), 1e-8 * endless.norm()) << coordinate << ' ' << intervals;
      differs = std::max(differs, (without - endless).norm() / endless.norm());
    }
  }
  EXPECT_GT(differs, 0.5);
}

TEST(Nmpc, KnownExternalForceLeavesNoOffset) {
  IdealLoop loop;
  loop.unknown.force << 0.8, -0.5, -1.0;
  for (int i = 0; i < 500; ++i) (void)loop.tick(hover, loop.unknown);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 1e-4);

  IdealLoop without_estimate;
  without_estimate.unknown = loop.unknown;
  for (int i = 0; i < 500; ++i) (void)without_estimate.tick(hover);
  EXPECT_GT((without_estimate.state.body.position - hovering().position).norm(), 1e-3);
}

TEST(Nmpc, WithoutFeedforwardTheReferenceWrenchIsThePapers) {
  IdealLoop loop(paper_nmpc_settings());
  (void)loop.tick(hover, {Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d::Zero()});
  const WheeledFlightNode& node = loop.nmpc.solver().problem().node(3);
  EXPECT_EQ(node.wrench_reference.force, Eigen::Vector3d(0.0, 0.0, body.mass * gravity));
  EXPECT_EQ(node.wrench_reference.torque, Eigen::Vector3d::Zero());
  IdealLoop ours;
  for (int i = 0; i < 2; ++i)
    (void)ours.tick(hover, {Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d::Zero()});
  EXPECT_LT((ours.nmpc.solver().problem().node(3).wrench_reference.force -
             Eigen::Vector3d(-1.0, -2.0, body.mass * gravity - 3.0))
                .norm(),
            1e-12);
}

TEST(Nmpc, PaperPresetIsThePapersTable) {
  const NmpcSettings s = paper_nmpc_settings();
  EXPECT_EQ(s.problem.intervals, 20);
  EXPECT_DOUBLE_EQ(s.problem.interval, 0.1);
  EXPECT_EQ(s.problem.bounds.force_max, Eigen::Vector3d(0.2, 0.2, 20.0));
  EXPECT_EQ(s.problem.bounds.force_min, Eigen::Vector3d(-0.2, -0.2, 0.0));
  EXPECT_EQ(s.problem.bounds.torque_max, Eigen::Vector3d(20.0, 20.0, 20.0));
  EXPECT_EQ(s.problem.bounds.force_rate, Eigen::Vector3d(2.0, 2.0, 2.0));
  EXPECT_EQ(s.problem.bounds.torque_rate, Eigen::Vector3d(2.0, 2.0, 2.0));
  EXPECT_EQ(s.problem.bounds.angular_velocity, Eigen::Vector3d(2.0, 2.0, 1.5));
  EXPECT_FALSE(s.actuator_rows);
  EXPECT_TRUE((Nmpc(vehicle, s).solver().problem().upper(1).tail<12>().array() ==
               std::numeric_limits<double>::infinity())
                  .all());
}

TEST(Nmpc, ABadMeasurementContinuesTheLastPlanWithinBounds) {
  IdealLoop loop;
  loop.state.body.position.x() = 0.5;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  const Wrench<> before = loop.state.wrench;
  for (int i = 0; i < 10; ++i) {
    const NmpcResult& result = loop.tick(hover, {}, true);
    EXPECT_EQ(result.status, NmpcStatus::bad_state);
    expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
  }
  EXPECT_GT((loop.state.wrench.force - before.force).norm(), 1e-6);  // the plan moved on
  for (int i = 0; i < 300; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 5e-3);
}

TEST(Nmpc, APlanThatIsTooOldGivesWayToTheSafeWrench) {
  IdealLoop loop;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  NmpcStatus status = NmpcStatus::solved;
  for (int i = 0; i < 30; ++i) status = loop.tick(hover, {}, true).status;
  EXPECT_EQ(status, NmpcStatus::no_plan);
  EXPECT_NEAR(loop.state.wrench.force.z(), body.mass * gravity, 0.1);
  for (int i = 0; i < 300; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
}

TEST(Nmpc, ABadReferenceOrEstimateFailsWithAFiniteCommandAndRecovers) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  IdealLoop loop;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  const auto lost = [&](double t) {
    ReferencePoint point = hover(t);
    point.position.y() = nan;
    return point;
  };
  for (int i = 0; i < 5; ++i) {
    const NmpcResult& result = loop.tick(lost);
    EXPECT_EQ(result.status, NmpcStatus::solver_failed);
    expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
  }
  EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  // An estimate that is not finite is not used.
  EXPECT_EQ(loop.tick(hover, {Eigen::Vector3d(nan, 0, 0), Eigen::Vector3d::Zero()}).status,
            NmpcStatus::solved);
}

TEST(Nmpc, FirstMeasurementBadGivesTheSafeWrench) {
  Nmpc nmpc(vehicle, in_simulated_time());
  (void)nmpc.prepare(0.0, hover, {});
  BodyState<> bad = hovering();
  bad.orientation.coeffs().setZero();
  const NmpcResult& result = nmpc.feedback(0.0, bad);
  EXPECT_EQ(result.status, NmpcStatus::no_plan);
  expect_within_bounds(result, nmpc.settings().problem.bounds);
}

// The command after six seconds at rest on the ground of `contact`.
Wrench<> after_resting(Nmpc<4>& nmpc, const ContactEstimate& contact,
                       const Eigen::Quaterniond& orientation = Eigen::Quaterniond::Identity()) {
  BodyState<> standing;
  standing.position.z() = vehicle.wheels->radius;
  standing.orientation = orientation;
  const auto rest = [&](double) {
    ReferencePoint point;
    point.position = standing.position;
    return point;
  };
  Wrench<> wrench;
  for (int i = 0; i < 600; ++i) {
    const double time = 0.01 * i;
    (void)nmpc.prepare(time, rest, contact);
    const NmpcResult& result = nmpc.feedback(time, standing);
    EXPECT_EQ(result.status, NmpcStatus::solved);
    EXPECT_TRUE(result.on_ground);
    wrench = result.wrench;
  }
  return wrench;
}

TEST(Nmpc, OnTheGroundItTakesTheWeightOffTheRotors) {
  // Down on the ground the estimate is the normal force, whatever the thrust.
  NmpcSettings settings;
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  const Wrench<> wrench = after_resting(nmpc, standing_on_the_ground());
  EXPECT_NEAR(wrench.force.z(), settings.ground.down_force, 0.1);
}

TEST(Nmpc, OnASlopeItHoldsTheVehicleAgainstThePull) {
  NmpcSettings settings;
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  ContactEstimate contact = standing_on_the_ground();
  const double slope = 0.1;  // [rad], up along x
  contact.ground.slope.x() = std::tan(slope);
  const Wrench<> wrench = after_resting(
      nmpc, contact, Eigen::Quaterniond(Eigen::AngleAxisd(-slope, Eigen::Vector3d::UnitY())));
  const double pull = vehicle.body.mass * gravity * std::sin(slope);
  EXPECT_NEAR(wrench.force.x(), pull, 1e-3);
  EXPECT_NEAR(nmpc.solver().problem().node(3).wrench_reference.force.x(), pull, 1e-12);
}

TEST(Nmpc, TheCommandIsCutToTheBoundsWhateverThePlanSays) {
  // A plan may give up a bound (here the box of the force shrinks to what the start is out of); the
  // command may not.
  NmpcSettings settings;
  settings.problem.bounds.force_min.z() = 0.0;
  settings.problem.bounds.force_max.z() = 10.0;  // less than the weight: the safe wrench is cut
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  BodyState<> bad = hovering();
  bad.position.x() = std::nan("");
  (void)nmpc.prepare(0.0, hover, {});
  const NmpcResult cut = nmpc.feedback(0.0, bad);
  EXPECT_EQ(cut.status, NmpcStatus::no_plan);
  EXPECT_DOUBLE_EQ(cut.wrench.force.z(), 10.0);
}

// Nobody has followed it, and the vehicle is somewhere else.
TEST(Nmpc, APlanFromBeforeAnInterruptionIsNotFollowed) {
  IdealLoop loop;
  loop.state.body.position.x() -= 3.0;
  for (int i = 0; i < 40; ++i) loop.tick(hover);
  const Wrench<> before = loop.nmpc.feedback(loop.time, loop.state.body).wrench;
  EXPECT_GT(before.force.head<2>().norm() + before.torque.norm(), 0.5);  // in the middle of it
  loop.time += 0.3;
  loop.state.body = hovering();
  const NmpcResult& resumed = loop.tick(hover);
  EXPECT_EQ(resumed.status, NmpcStatus::solved);
  EXPECT_NEAR(resumed.wrench.force.z(), body.mass * gravity, 1e-9);
  EXPECT_LT(resumed.wrench.force.head<2>().norm() + resumed.wrench.torque.norm(), 1e-9);
  for (int i = 0; i < 100; ++i) loop.tick(hover);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 1e-3);
  // Between an interruption as short as that and the next tick, the last plan is still good.
  loop.time += 0.5 * loop.nmpc.settings().max_plan_age;
  EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
}

// Ticks at 10 Hz, a body rate that nobody ordered after each: how far the vehicle turns.
double turned(bool between_ticks) {
  NmpcSettings settings;
  settings.period = 0.1;
  Nmpc<4> nmpc(vehicle, in_simulated_time(settings));
  const RigidBody<> plant(body);
  State<> state;
  state.body = hovering();
  double sum = 0.0;
  const int steps = 3000;
  for (int i = 0; i < steps; ++i) {
    const double time = 1e-3 * i;
    const NmpcResult* result = nullptr;
    if (i % 100 == 0) {
      (void)nmpc.prepare(time, hover, {});
      result = &nmpc.feedback(time, state.body);
      EXPECT_TRUE(has_plan(result->status));
    } else if (between_ticks) {
      result = &nmpc.between_ticks(time, state.body);
      EXPECT_TRUE(has_plan(result->status));
    }
    if (result != nullptr) {
      expect_within_bounds(*result, settings.problem.bounds);
      EXPECT_LE((result->rate.force.cwiseAbs() - settings.problem.bounds.force_rate).maxCoeff(), 0);
      state.wrench = result->wrench;
    }
    if (i % 500 == 20) state.body.angular_velocity += Eigen::Vector3d(0.6, -0.4, 0.2);
    Eigen::Matrix<double, 6, 1> rate;
    rate << nmpc.result().rate.force, nmpc.result().rate.torque;
    state = plant.step(state, rate, {}, 1e-3);
    sum += std::pow(state.body.orientation.angularDistance(hovering().orientation), 2) / steps;
  }
  return std::sqrt(sum);
}

TEST(Nmpc, BetweenTicksTheGainsCounterWhatTheNextTickWouldSeeLate) {
  const double with = turned(true), without = turned(false);
  EXPECT_LT(with, 0.8 * without);
  EXPECT_GT(without, 0.02);
}

TEST(Nmpc, BetweenTicksOnThePlanTheCommandIsThePlans) {
  IdealLoop loop, other;
  for (IdealLoop* l : {&loop, &other}) {
    l->state.body.position.x() -= 0.2;
    for (int i = 0; i < 10; ++i) l->tick(hover);
  }
  // Half a period later, exactly where the plan leads.
  (void)loop.nmpc.prepare(loop.time, hover, {});
  const NmpcResult first = loop.nmpc.feedback(loop.time, loop.state.body);
  State<> x = loop.state;
  x.wrench = first.wrench;
  Eigen::Matrix<double, 6, 1> rate;
  rate << first.rate.force, first.rate.torque;
  x = loop.plant.step(x, rate, {}, 0.005);
  const NmpcResult between = loop.nmpc.between_ticks(loop.time + 0.005, x.body);
  EXPECT_EQ(between.status, NmpcStatus::solved);
  EXPECT_LT((between.wrench.force - x.wrench.force).norm(), 1e-9);
  EXPECT_LT((between.rate.force - first.rate.force).norm(), 1e-6);
  EXPECT_LT((between.rate.torque - first.rate.torque).norm(), 1e-6);
  // What is not finite changes nothing; without a plan it is the safe wrench.
  x.body.position.x() = std::nan("");
  EXPECT_EQ(loop.nmpc.between_ticks(loop.time + 0.006, x.body).status, NmpcStatus::bad_state);
  Nmpc<4> fresh(vehicle);
  EXPECT_EQ(fresh.between_ticks(0.0, hovering()).status, NmpcStatus::no_plan);
}

// What a vehicle with slow servos does along a fast, small circle with a box on the wrench rate
// that bounds nothing.
struct SlowServos {
  double rmse = 0.0, planned = 0.0, demanded = 0.0;  // [m], tilt rates over the servos' speed
  int failures = 0;
};

SlowServos fly_with_slow_servos(bool actuator_rows) {
  Vehicle<4> slow = vehicle;
  slow.servo.max_rate = 1.5;
  NmpcSettings settings;
  settings.problem.bounds.force_rate.setConstant(200.0);
  settings.problem.bounds.torque_rate.setConstant(40.0);
  settings.problem.weights.force_rate.setConstant(0.002);
  settings.problem.weights.torque_rate.setConstant(0.02);
  settings.actuator_rows = actuator_rows;
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
  start.body = hovering();  // in the middle: has to catch up
  start.actuators.rotor_speed.setConstant(
      speed_from_thrust(body.mass * gravity / 4.0, slow.rotor.thrust_coefficient));
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

// The largest thrust that a climb of 3 m plans behind its first node, by the least thrusts of the
// planned wrenches.
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
  for (int i = 0; i < 10; ++i) {
    (void)nmpc.prepare(0.01 * i, above, in_the_air({}));
    EXPECT_TRUE(has_plan(nmpc.feedback(0.01 * i, hovering()).status));
  }
  const Allocation<4> allocation(battery);
  double largest = 0.0;
  for (int k = 1; k <= nmpc.solver().horizon(); ++k) {
    const Wrench<> planned = nmpc.solver().state(k).wrench;
    const Eigen::Matrix<double, 8, 1> thrusts =
        allocation.pseudoinverse().leftCols<3>() * planned.force +
        allocation.pseudoinverse().rightCols<3>() * planned.torque;
    for (int i = 0; i < 4; ++i)
      largest = std::max(largest, std::hypot(thrusts(2 * i), thrusts(2 * i + 1)));
  }
  top = max_thrust_at(vehicle.rotor, voltage / 20.0);
  return largest;
}

TEST(Nmpc, PlansKeepToTheThrustThatTheVoltageLeaves) {
  double full = 0.0, sagged = 0.0;
  const double with_full = planned_thrust(20.0, full), with_sagged = planned_thrust(12.0, sagged);
  EXPECT_NEAR(full, 12.0, 1e-12);
  EXPECT_NEAR(sagged, 0.36 * 12.0, 1e-12);
  EXPECT_GT(with_full, 1.2 * sagged);
  EXPECT_LE(with_sagged, sagged + 0.01);
  EXPECT_GT(with_sagged, sagged - 0.1);
}

TEST(Nmpc, ActuatorRowsKeepSlowServosOutOfTheirSpeedLimit) {
  const SlowServos with = fly_with_slow_servos(true), without = fly_with_slow_servos(false);
  EXPECT_EQ(with.failures, 0);
  EXPECT_LE(with.planned, ActuatorRowSettings{}.tilt_rate_share + 1e-6);
  EXPECT_LE(with.demanded, 1.0);
  EXPECT_GT(with.planned, 0.8);
  EXPECT_GT(without.planned, 5.0);
  EXPECT_GT(without.demanded, 5.0);
  EXPECT_LT(with.rmse, 0.08);
  EXPECT_GT(without.rmse, 2.0 * with.rmse);  // chases its own saturation
}

TEST(Nmpc, WhatIsCommandedKeepsToTheActuatorRowsWhateverTheStart) {
  const Allocation<4> allocation(vehicle);
  NmpcSettings settings;
  settings.actuators.tilt_rate_share = 0.1;
  const double limit = settings.actuators.tilt_rate_share * vehicle.servo.max_rate;
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

TEST(Nmpc, WithoutThrustOnTheGroundTheCommandStaysFiniteAndWithinBounds) {
  NmpcSettings settings;
  settings.ground.down_force = 0.0;
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  BodyState<> standing;
  standing.position.z() = vehicle.wheels->radius;
  const auto drive = [&](double t) {
    ReferencePoint point;
    point.position << 0.1 * std::sin(t), 0.0, vehicle.wheels->radius;
    point.velocity << 0.1 * std::cos(t), 0.0, 0.0;
    point.acceleration << -0.1 * std::sin(t), 0.0, 0.0;
    return point;
  };
  double least = 1.0;
  for (int i = 0; i < 500; ++i) {
    const double time = 0.01 * i;
    (void)nmpc.prepare(time, drive, standing_on_the_ground());
    standing.position.x() = drive(time).position.x();
    standing.velocity = drive(time).velocity;
    const NmpcResult& result = nmpc.feedback(time, standing);
    ASSERT_EQ(result.status, NmpcStatus::solved);
    expect_within_bounds(result, settings.problem.bounds);
    least = std::min(least, result.wrench.force.norm());
  }
  EXPECT_LT(least, 0.05);
}

TEST(Nmpc, SoManyFailuresInARowDropTheWarmStart) {
  const auto iterate_after_failures = [](int failures_before_reset) {
    NmpcSettings settings;
    settings.failures_before_reset = failures_before_reset;
    settings.max_plan_age = 1.0;
    IdealLoop loop(settings);
    loop.state.body.position.x() = 0.5;
    for (int i = 0; i < 30; ++i) (void)loop.tick(hover);
    for (int i = 0; i < 3; ++i) (void)loop.tick(hover, {}, true);
    (void)loop.tick(hover);
    return loop.nmpc.solver().report().kkt;  // of the iterate that the tick started from
  };
  // A cold start begins with the whole horizon at the measured state, far from optimal.
  EXPECT_GT(iterate_after_failures(3), 10.0 * iterate_after_failures(4));
}

TEST(Nmpc, SettingsOutOfRangeAreRefusedByName) {
  const auto message = [](const NmpcSettings& settings) -> std::string {
    try {
      Nmpc nmpc(vehicle, in_simulated_time(settings));
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "accepted";
  };
  NmpcSettings s;
  s.max_plan_age = 0.0;
  EXPECT_NE(message(s).find("NmpcSettings.max_plan_age"), std::string::npos);
  s = {};
  s.failures_before_reset = 0;
  EXPECT_NE(message(s).find("NmpcSettings.failures_before_reset = 0"), std::string::npos);
  s = {};
  s.actuators.tilt_rate_share = 2.0;
  EXPECT_NE(message(s).find("ActuatorRowSettings.tilt_rate_share = 2"), std::string::npos);
}

// In a curve with its nose off the level the vehicle has a roll rate in its own axes although it
// does not roll. A plan that carried it on would hold the nose where it is.
TEST(Nmpc, OnTheGroundTheRollRateOfAPitchedVehicleInACurveIsNotCarriedOn) {
  const auto parked = [](double) {
    ReferencePoint point;
    point.position.z() = vehicle.wheels->radius;
    return point;
  };
  const double ground = vehicle.wheels->radius;
  const auto torque = [&](double height, double roll_rate) {
    Nmpc<4> nmpc(vehicle, in_simulated_time());
    BodyState<> state;
    state.position.z() = height;
    state.orientation = Eigen::Quaterniond(Eigen::AngleAxisd(-0.1, Eigen::Vector3d::UnitY()));
    state.angular_velocity << roll_rate, 0.0, 1.0;
    Eigen::Vector3d result;
    for (int i = 0; i < 3; ++i) {
      (void)nmpc.prepare(0.01 * i, parked,
                         height > ground ? ContactEstimate{} : standing_on_the_ground());
      result = nmpc.feedback(0.01 * i, state).wrench.torque;
    }
    return result;
  };
  const double air = ground + 0.5;
  EXPECT_EQ(torque(ground, 0.1), torque(ground, 0.0));
  EXPECT_NE(torque(air, 0.1), torque(air, 0.0));
}

}  // namespace
}  // namespace tilt_ropter
