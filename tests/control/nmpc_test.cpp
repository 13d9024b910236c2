// Hover, references, the ground, feedback between ticks, and settings.

#include <tilt_ropter/control/nmpc.hpp>

#include "support/hovering.hpp"
#include "support/ideal_loop.hpp"
#include "support/patient.hpp"
#include "support/refusals.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace nmpc_test {

using test_support::expect_within_bounds;
using test_support::hover;
using test_support::hovering;
using test_support::IdealLoop;
using test_support::in_simulated_time;

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const RigidBodyParameters body = vehicle.body;

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

// The start is very close to hover: the plan is linear and no bound is active. The optimal plan is
// then the infinite-horizon optimal feedback. With the cost-to-go as terminal cost, a horizon of
// any length must give this feedback.
TEST(Nmpc, ShortHorizonWithRiccatiCostMatchesInfiniteHorizon) {
  using Solver = optimal_control::MultipleShooting<WheeledFlightProblem<4>>;
  const double yaw = 0.7, small = 1e-5;
  const auto first_input = [&](TerminalCost terminal, int intervals, int coordinate) {
    Vehicle<4> slim = vehicle;
    slim.body.inertia.diagonal() << 0.010, 0.018, 0.025;
    Solver solver(WheeledFlightProblem<4>(slim.body, settings_with(terminal, intervals).problem),
                  test_support::patient());
    Stated x;
    x.body = hovering();
    x.body.orientation = quaternion_from_yaw(yaw);
    x.wrench.force.z() = body.mass * gravity;
    for (int k = 0; k <= intervals; ++k) {
      solver.problem().node(k).reference = x.body;
      solver.problem().node(k).wrench_reference = x.wrench;
    }
    solver.reset(x);
    const StateTangentd off = small * StateTangentd::Unit(coordinate);
    EXPECT_EQ(solver.prepare(), optimal_control::PrepareStatus::prepared);
    EXPECT_EQ(solver.feedback(retract(x, off)).status, optimal_control::SolveStatus::iterated);
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

TEST(Nmpc, WrenchReferenceIsZeroHoverOrInverseDynamics) {
  const auto reference = [](WrenchReference kind) {
    NmpcSettings settings;
    settings.wrench_reference = kind;
    IdealLoop loop(settings);
    for (int i = 0; i < 2; ++i)
      (void)loop.tick(hover, {Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d::Zero()});
    const Wrenchd wrench = loop.nmpc.solver().problem().node(3).wrench_reference;
    EXPECT_EQ(wrench.torque.norm(), 0.0);
    return wrench.force;
  };
  const double weight = body.mass * gravity;
  EXPECT_EQ(reference(WrenchReference::zero), Eigen::Vector3d::Zero());
  EXPECT_EQ(reference(WrenchReference::hover), Eigen::Vector3d(0.0, 0.0, weight));
  EXPECT_LT(
      (reference(WrenchReference::inverse_dynamics) - Eigen::Vector3d(-1, -2, weight - 3.0)).norm(),
      1e-12);
}

TEST(Nmpc, PaperPresetMatchesThePapersTable) {
  const NmpcSettings s = paper_nmpc_settings();
  EXPECT_EQ(s.problem.intervals, 20);
  EXPECT_DOUBLE_EQ(s.problem.interval, 0.1);
  EXPECT_EQ(s.problem.bounds.force_max, Eigen::Vector3d(0.2, 0.2, 20.0));
  EXPECT_EQ(s.problem.bounds.force_min, Eigen::Vector3d(-0.2, -0.2, 0.0));
  EXPECT_EQ(s.problem.bounds.torque_max, Eigen::Vector3d(20.0, 20.0, 20.0));
  EXPECT_EQ(s.problem.bounds.force_rate, Eigen::Vector3d(2.0, 2.0, 2.0));
  EXPECT_EQ(s.problem.bounds.torque_rate, Eigen::Vector3d(2.0, 2.0, 2.0));
  EXPECT_EQ(s.problem.bounds.angular_velocity, Eigen::Vector3d(2.0, 2.0, 1.5));
  EXPECT_EQ(s.wrench_reference, WrenchReference::zero);
  EXPECT_TRUE(s.ground.contact_by_height);
  EXPECT_EQ(s.ground.model, GroundModel::external_wrench);
  EXPECT_EQ(s.ground.settling_speed, 0.0);
  EXPECT_EQ(s.problem.weights.ground_thrust, 0.0);
  EXPECT_FALSE(s.actuator_constraints);
  EXPECT_TRUE((Nmpc(vehicle, s).solver().problem().upper(1).tail<12>().array() ==
               std::numeric_limits<double>::infinity())
                  .all());
}

// Hovers with ticks at 10 Hz. Every 0.5 s, 20 ms after a tick, a disturbance changes the body rate.
// Returns the RMS angle to the reference attitude [rad].
double turned(bool between_ticks) {
  NmpcSettings settings;
  settings.period = 0.1;
  Nmpc<4> nmpc(vehicle, in_simulated_time(settings));
  const RigidBodyd plant(body);
  Stated state;
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

TEST(Nmpc, FeedbackBetweenTicksReducesTheAttitudeError) {
  const double with = turned(true), without = turned(false);
  EXPECT_LT(with, 0.8 * without);
  EXPECT_GT(without, 0.02);
}

TEST(Nmpc, BetweenTicksCommandEqualsThePlanWithoutDisturbance) {
  IdealLoop loop, other;
  for (IdealLoop* l : {&loop, &other}) {
    l->state.body.position.x() -= 0.2;
    for (int i = 0; i < 10; ++i) l->tick(hover);
  }
  // Half a period later, in exactly the planned state.
  (void)loop.nmpc.prepare(loop.time, hover, {});
  const NmpcResult first = loop.nmpc.feedback(loop.time, loop.state.body);
  Stated x = loop.state;
  x.wrench = first.wrench;
  Eigen::Matrix<double, 6, 1> rate;
  rate << first.rate.force, first.rate.torque;
  x = loop.plant.step(x, rate, {}, 0.005);
  const NmpcResult between = loop.nmpc.between_ticks(loop.time + 0.005, x.body);
  EXPECT_EQ(between.status, NmpcStatus::solved);
  EXPECT_LT((between.wrench.force - x.wrench.force).norm(), 1e-9);
  EXPECT_LT((between.rate.force - first.rate.force).norm(), 1e-6);
  EXPECT_LT((between.rate.torque - first.rate.torque).norm(), 1e-6);
  // A state that is not finite is rejected. Without a plan the result is the safe wrench.
  x.body.position.x() = std::nan("");
  EXPECT_EQ(loop.nmpc.between_ticks(loop.time + 0.006, x.body).status, NmpcStatus::bad_state);
  Nmpc<4> fresh(vehicle);
  EXPECT_EQ(fresh.between_ticks(0.0, hovering()).status, NmpcStatus::no_plan);
}

ContactEstimate standing_on_the_ground() {
  ContactEstimate contact;
  contact.on_ground = contact.ground_known = true;
  return contact;
}

// Returns the command after six seconds at rest on the ground of `contact`.
Wrenchd after_resting(Nmpc<4>& nmpc, const ContactEstimate& contact,
                      const Eigen::Quaterniond& orientation = Eigen::Quaterniond::Identity()) {
  BodyStated standing;
  standing.position.z() = vehicle.wheels->radius;
  standing.orientation = orientation;
  const auto rest = [&](double) {
    ReferencePoint point;
    point.position = standing.position;
    return point;
  };
  Wrenchd wrench;
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

TEST(Nmpc, OnTheGroundThrustFallsToDownForce) {
  // On the ground the estimated external force is the normal force, at any thrust.
  NmpcSettings settings;
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  const Wrenchd wrench = after_resting(nmpc, standing_on_the_ground());
  EXPECT_NEAR(wrench.force.z(), settings.ground.down_force, 0.1);
}

TEST(Nmpc, HoldsTheVehicleOnASlopeAgainstGravity) {
  NmpcSettings settings;
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  ContactEstimate contact = standing_on_the_ground();
  const double slope = 0.1;  // [rad], up along x
  contact.ground.slope.x() = std::tan(slope);
  const Wrenchd wrench = after_resting(
      nmpc, contact, Eigen::Quaterniond(Eigen::AngleAxisd(-slope, Eigen::Vector3d::UnitY())));
  const double pull = vehicle.body.mass * gravity * std::sin(slope);
  EXPECT_NEAR(wrench.force.x(), pull, 1e-3);
  EXPECT_NEAR(nmpc.solver().problem().node(3).wrench_reference.force.x(), pull, 1e-12);
}

// A pitched vehicle in a curve has a roll rate in body axes although it does not roll. If the plan
// continued this roll rate, the controller would hold the pitch angle.
TEST(Nmpc, OnTheGroundThePlanDoesNotContinueTheMeasuredRollRate) {
  const auto parked = [](double) {
    ReferencePoint point;
    point.position.z() = vehicle.wheels->radius;
    return point;
  };
  const double ground = vehicle.wheels->radius;
  const auto torque = [&](double height, double roll_rate) {
    Nmpc<4> nmpc(vehicle, in_simulated_time());
    BodyStated state;
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

TEST(Nmpc, CommandWithoutThrustOnTheGroundStaysWithinBounds) {
  NmpcSettings settings;
  settings.ground.down_force = 0.0;
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  BodyStated standing;
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

TEST(Nmpc, ChecksItsSettings) {
  NmpcSettings settings;
  settings.max_plan_age = 0.0;
  test_support::expect_refused("ControllerSettings.max_plan_age [s]",
                               [&] { Nmpc(vehicle, settings); });
}

}  // namespace nmpc_test
}  // namespace tilt_ropter
