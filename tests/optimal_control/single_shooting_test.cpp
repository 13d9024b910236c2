#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "benchmark/scenarios.hpp"
#include "support/audit.hpp"
#include "support/benchmark_problem.hpp"
#include "support/patient.hpp"
#include "support/refusals.hpp"
#include "support/same_optimum.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

// Problems from other fields, and short problems of the Tilt-Ropter: two solvers that share only
// the problem must agree.
namespace tilt_ropter::optimal_control {
namespace single_shooting_test {

using test_support::Audit;
using test_support::audit;
using test_support::expect_same_optimum;
using test_support::is_active;
using test_support::patient;
using test_support::Unicycle;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

WheeledFlightProblem<0> short_flight(const NmpcBounds& bounds = {}) {
  WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.intervals = 4;
  settings.bounds = bounds;
  WheeledFlightProblem<0> problem(test_support::benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.node(k).reference.position << 0.0, 0.0, 1.0;
    problem.node(k).wrench_reference.force = test_support::benchmark_hover_force();
  }
  return problem;
}

Stated displaced_flight() {
  Stated x;
  x.wrench.force = test_support::benchmark_hover_force();
  x.body.position << 0.1, -0.2, 0.9;
  x.body.velocity << 0.1, 0.0, 0.2;
  x.body.orientation = quaternion_exp(Eigen::Vector3d(0.2, -0.1, 0.4));
  x.body.angular_velocity << 0.3, -0.2, 0.1;
  return x;
}

// The wheels touch the ground at `touch_down` and stay there.
WheeledFlightProblem<0> short_landing(int touch_down, double ground_weight) {
  WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.intervals = 4;
  settings.weights.ground.setConstant(ground_weight);
  WheeledFlightProblem<0> problem(test_support::benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    WheeledFlightNode& node = problem.node(k);
    node.wrench_reference.force = test_support::benchmark_hover_force();
    node.on_ground = k >= touch_down;
    node.com_plane.height = 0.1;
    node.reference.position << 0.05 * k, 0.02, 0.11;
    node.reference.orientation = quaternion_from_yaw(0.4);
  }
  return problem;
}

Stated above_the_ground() {
  Stated x;
  x.wrench.force = test_support::benchmark_hover_force();
  x.body.position << 0.0, 0.0, 0.115;
  x.body.velocity << 0.3, 0.05, -0.02;
  x.body.orientation = quaternion_exp(Eigen::Vector3d(0.05, -0.1, 0.3));
  return x;
}

TEST(SingleShooting, AgreesWithMultipleShootingOnTheUnicycle) {
  const auto around = expect_same_optimum(Unicycle({6}), Eigen::Vector3d(-2.0, 0.0, 0.3));
  EXPECT_TRUE(is_active(around, 0));  // at the obstacle's edge
  EXPECT_TRUE(is_active(around, 1));  // at the speed limit near the obstacle
  // Starts with a heading beyond a right angle, drives backwards and turns across the heading pi.
  expect_same_optimum(Unicycle({8}), Eigen::Vector3d(-1.5, 0.5, 3.1));
}

TEST(SingleShooting, AgreesWithMultipleShootingInFlightWithinWideBounds) {
  const auto oracle = expect_same_optimum(short_flight({}), displaced_flight());
  for (int i = 0; i < 15; ++i) EXPECT_FALSE(is_active(oracle, i));
}

TEST(SingleShooting, AgreesWithMultipleShootingInFlightAtThePapersBounds) {
  const auto oracle = expect_same_optimum(short_flight(paper_bounds()), displaced_flight());
  EXPECT_TRUE(is_active(oracle, 0) && is_active(oracle, 9));  // F_x and dF_x
}

TEST(SingleShooting, AgreesWithMultipleShootingAtTouchDown) {
  const auto oracle = expect_same_optimum(short_landing(4, 1e5), above_the_ground());
  EXPECT_LT(oracle.report().max_equality, 1e-9);
}

TEST(SingleShooting, AgreesWithMultipleShootingOnTwoGroundNodes) {
  expect_same_optimum(short_landing(3, 1e5), above_the_ground(), 1e-9);
}

TEST(SingleShooting, AgreesWithMultipleShootingOnGroundWithTheDefaultWeights) {
  expect_same_optimum(short_landing(3, NmpcWeights{}.ground.x()), above_the_ground(), 1e-9, 1e-11);
}

TEST(SingleShooting, ReportAgreesWithAnIndependentAudit) {
  Unicycle problem({6});
  const Eigen::Vector3d x0(-2.0, 0.0, 0.3);
  for (const int calls : {1, 2, 200}) {
    SolverSettings settings = patient();
    settings.max_iterations = calls;
    SingleShooting<Unicycle> solver(problem, settings);
    solver.reset(x0);
    const SolveReport report = solver.solve(x0);
    EXPECT_EQ(report.status, calls == 200 ? SolveStatus::converged : SolveStatus::iteration_limit);
    const Audit a = audit(solver);
    EXPECT_DOUBLE_EQ(report.cost, a.cost);
    EXPECT_LT(a.defect, 1e-12);
    EXPECT_DOUBLE_EQ(report.max_violation, a.violation);
  }
}

TEST(SingleShooting, FindsTheOptimumFromAnyGuess) {
  const WheeledFlightProblem<0> problem = short_flight();
  const Stated x0 = displaced_flight();
  SingleShooting<WheeledFlightProblem<0>> cold(problem), warm(problem);
  cold.reset(x0);
  const SolveReport from_cold = cold.solve(x0);
  // A guess with an orientation that differs by 1.5 rad.
  Stated turned = x0;
  turned.body.orientation = x0.body.orientation * quaternion_exp(Eigen::Vector3d(0.9, -1.2, 0.0));
  for (int k = 0; k <= problem.horizon(); ++k)
    warm.set_guess(k, turned, WheeledFlightProblem<0>::Input::Zero());
  const SolveReport from_turned = warm.solve(x0);
  EXPECT_EQ(from_turned.status, SolveStatus::converged);
  EXPECT_NEAR(from_turned.cost, from_cold.cost, 1e-12 * from_cold.cost);
  // A start at the optimum needs one call of NLopt, which evaluates the optimum and one step.
  const SolveReport again = warm.solve(x0);
  EXPECT_EQ(again.status, SolveStatus::converged);
  EXPECT_EQ(again.iterations, 1);
  EXPECT_LE(again.evaluations, 2);
}

TEST(SingleShooting, ConvergesAtOnceFromAnExactOptimum) {
  SingleShooting<WheeledFlightProblem<0>> solver(short_flight());
  Stated hovering;
  hovering.body.position.z() = 1.0;
  hovering.wrench.force = test_support::benchmark_hover_force();
  for (int k = 0; k <= solver.horizon(); ++k)
    solver.set_guess(k, hovering, WheeledFlightProblem<0>::Input::Zero());
  const SolveReport report = solver.solve(hovering);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_LT(report.cost, 1e-15);
}

TEST(SingleShooting, SolvesAgainAsTheFirstTime) {
  WheeledFlightProblem<0> problem = short_flight();
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.node(k).on_ground = true;
    problem.node(k).com_plane.height = 0.1;
    problem.node(k).reference.position << 0.1, 0.0, 0.1;
  }
  SingleShooting<WheeledFlightProblem<0>> solver(problem);
  Stated x = displaced_flight();
  x.body = {};
  x.body.position.z() = 0.1;
  solver.reset(x);
  const SolveReport first = solver.solve(x);
  EXPECT_EQ(first.status, SolveStatus::converged);
  solver.reset(x);
  const SolveReport second = solver.solve(x);
  EXPECT_EQ(second.status, first.status);
  EXPECT_EQ(second.evaluations, first.evaluations);
  EXPECT_EQ(second.cost, first.cost);
}

TEST(SingleShooting, NonFiniteStartIsRejectedAndChangesNothing) {
  SingleShooting<WheeledFlightProblem<0>> solver(short_flight());
  solver.reset(displaced_flight());
  solver.solve(displaced_flight());
  const auto plan = solver.input(0);
  for (const double bad : {nan, std::numeric_limits<double>::infinity()}) {
    Stated x = displaced_flight();
    x.body.velocity.y() = bad;
    EXPECT_EQ(solver.solve(x).status, SolveStatus::rejected);
    EXPECT_EQ(solver.input(0), plan);
  }
  EXPECT_EQ(solver.solve(displaced_flight()).status, SolveStatus::converged);
}

TEST(SingleShooting, NonFiniteProblemFailsAtOnceAndKeepsThePlan) {
  SingleShooting<WheeledFlightProblem<0>> solver(short_flight());
  solver.reset(displaced_flight());
  solver.solve(displaced_flight());
  const auto plan = solver.input(0);
  solver.problem().node(2).reference.position.x() = nan;
  const SolveReport in_cost = solver.solve(displaced_flight());
  EXPECT_EQ(in_cost.status, SolveStatus::failed);
  EXPECT_LE(in_cost.evaluations, 1);
  EXPECT_EQ(solver.input(0), plan);
  solver.problem().node(2).reference.position.x() = 0.0;
  solver.problem().node(1).external.force.x() = nan;
  const SolveReport in_step = solver.solve(displaced_flight());
  EXPECT_EQ(in_step.status, SolveStatus::failed);
  EXPECT_LE(in_step.evaluations, 1);
  EXPECT_EQ(solver.input(0), plan);
}

TEST(SingleShooting, LimitsAreKept) {
  const Eigen::Vector3d x0(-2.0, 0.0, 0.3);
  const auto solve = [&](const SolverSettings& settings) {
    SingleShooting<Unicycle> solver(Unicycle({6}), settings);
    solver.reset(x0);
    return solver.solve(x0);
  };
  SolverSettings s = patient();
  s.max_iterations = 1;
  EXPECT_EQ(solve(s).status, SolveStatus::iteration_limit);
  EXPECT_EQ(solve(s).iterations, 1);
  EXPECT_EQ(solve(s).solved_by, ProgramSolver::nlopt);
  s.max_iterations = 200;
  s.max_time = 1e-9;
  EXPECT_EQ(solve(s).status, SolveStatus::time_limit);
  EXPECT_LE(solve(s).evaluations, 2);
  s = patient();
  s.tolerance = 1.0;
  EXPECT_LT(solve(s).evaluations, solve(patient()).evaluations);
}

TEST(SingleShooting, FeedbackSolvesFromTheLastPlanWithinItsLimit) {
  const Eigen::Vector3d x0(-2.0, 0.0, 0.3);
  SingleShooting<Unicycle> solver(Unicycle({6}), patient());
  solver.reset(x0);
  const SolveReport cold = solver.feedback(x0);
  EXPECT_EQ(cold.status, SolveStatus::converged);
  const Eigen::Vector2d plan = solver.input(0);
  const SolveReport warm = solver.feedback(x0 + Eigen::Vector3d(0.01, 0.0, 0.0));
  EXPECT_EQ(warm.status, SolveStatus::converged);
  EXPECT_LT((solver.input(0) - plan).norm(), 0.1);
  EXPECT_NE(solver.input(0), plan);
  solver.restore_previous();
  EXPECT_EQ(solver.input(0), plan);
  EXPECT_EQ(solver.feedback(x0, SolverClock::now()).status, SolveStatus::time_limit);
}

TEST(SingleShooting, ChecksSettingsAndHorizon) {
  SolverSettings bad;
  bad.max_iterations = 0;
  test_support::expect_refused("SolverSettings.max_iterations",
                               [&] { SingleShooting<Unicycle>(Unicycle({6}), bad); });
  test_support::expect_range(
      "Problem.horizon()", {{1.0, 6.0}, {0.0, -1.0}}, true,
      [](double horizon) { SingleShooting<Unicycle>(Unicycle({static_cast<int>(horizon)})); });
}

using NloptAlone = SingleShooting<WheeledFlightProblem<0>>;

template <typename Solver>
Solver at_the_start(const benchmarks::Scenario& scenario, const SolverSettings& settings) {
  Solver solver(scenario.problem, settings);
  scenario.set_reference(solver.problem(), 0.0);
  solver.reset(scenario.start);
  return solver;
}

// On the ground of the benchmark, whose conditions have a weight of 1000.
TEST(EqualitiesByWeight, HoldByTheirWeightWithoutUpdates) {
  const benchmarks::Scenario ground = benchmarks::ground();
  SolverSettings settings;
  settings.max_time = 60.0;
  auto exact = at_the_start<NloptAlone>(ground, settings);
  ASSERT_EQ(exact.solve(ground.start).status, SolveStatus::converged);
  EXPECT_LT(exact.report().max_equality, 1e-6);

  // In a control loop, whatever the setting.
  auto in_the_loop = at_the_start<NloptAlone>(ground, settings);
  ASSERT_EQ(in_the_loop.feedback(ground.start).status, SolveStatus::converged);
  settings.update_multipliers = false;
  auto by_weight = at_the_start<NloptAlone>(ground, settings);
  ASSERT_EQ(by_weight.solve(ground.start).status, SolveStatus::converged);
  auto truth = at_the_start<benchmarks::Solver>(ground, settings);
  ASSERT_EQ(truth.solve(ground.start).status, SolveStatus::converged);

  EXPECT_GT(truth.report().max_equality, 1e-5);
  EXPECT_LT(truth.report().cost, exact.report().cost - 1e-3);
  for (const NloptAlone* solver : {&by_weight, &in_the_loop}) {
    EXPECT_NEAR(solver->report().cost, truth.report().cost, 1e-6);
    EXPECT_LT((solver->input(0) - truth.input(0)).norm(), 1e-4);
  }
}

}  // namespace single_shooting_test
}  // namespace tilt_ropter::optimal_control
