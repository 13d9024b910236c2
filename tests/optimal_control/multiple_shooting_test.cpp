// Known optima, the programs inside an iteration, limits and settings.

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/audit.hpp"
#include "support/benchmark_problem.hpp"
#include "support/patient.hpp"
#include "support/random.hpp"
#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace tilt_ropter::optimal_control {
namespace multiple_shooting_test {

using test_support::air_plant;
using test_support::air_position;
using test_support::air_problem;
using test_support::air_start;
using test_support::patient;
using test_support::Random;
using test_support::set_air_reference;
using test_support::step_problem;
using test_support::step_start;

using Solver = MultipleShooting<WheeledFlightProblem<0>>;

TEST(MultipleShooting, ReachesTheKnownOptimumOfStep) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  const SolveReport report = solver.solve(step_start());
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_LE(report.kkt, 1e-6);
  // IPOPT's optimum is 2074.1813, with the homogeneous R(q) in the stages and a renormalised
  // quaternion.
  EXPECT_NEAR(report.cost, 2074.1813, 1e-6 * 2074.1813);
  EXPECT_NEAR(report.cost, 2074.17, 1e-4 * 2074.17);
}

// The first program of STEP has more active constraints than the last solution, which had none. The
// working set of NLopt may grow to twice the limit, in a real-time iteration to 1.5 times. With
// more constraints Riccati passes go on, whose number is bounded.
TEST(MultipleShooting, LimitOfConstraintsDecidesWhetherNloptSolves) {
  for (const int limit : {0, 12, 16}) {
    SolverSettings settings = patient();
    settings.max_iterations = 1;
    settings.program.max_dual_constraints = limit;
    Solver solver(step_problem(), settings);
    solver.reset(step_start());
    SolveReport report = solver.solve(step_start());
    EXPECT_LE(report.program_residual, 1e-6) << limit;
    EXPECT_GT(report.active_constraints, 10) << limit;
    EXPECT_EQ(report.solved_by == ProgramSolver::nlopt, limit >= 12) << limit;
    EXPECT_EQ(report.evaluations > 0, limit >= 12) << limit;
    solver.reset(step_start());
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    report = solver.feedback(step_start());
    EXPECT_LE(report.program_residual, 1e-6) << limit;
    EXPECT_EQ(report.solved_by == ProgramSolver::nlopt, limit == 16) << limit;
    EXPECT_EQ(report.passes > 0, limit < 16) << limit;
  }
}

TEST(MultipleShooting, FactorisesAtASolutionOnlyForTheFirstGains) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  SolverSettings settings = patient();
  settings.max_iterations = solver.report().iterations - 1;
  Solver before(step_problem(), settings);
  before.reset(step_start());
  ASSERT_EQ(before.solve(step_start()).status, SolveStatus::iteration_limit);
  EXPECT_EQ(solver.gain(0), before.gain(0));

  Stated hover;
  hover.wrench.force = test_support::benchmark_hover_force();
  hover.body.position.z() = 1.5;
  Solver there(step_problem(), patient());
  there.reset(hover);
  ASSERT_EQ(there.solve(hover).status, SolveStatus::converged);
  EXPECT_EQ(there.report().iterations, 0);
  EXPECT_GT(there.gain(0).norm(), 1.0);
}

TEST(MultipleShooting, ReachesTheKnownOptimumOfAirAtTickZero) {
  Solver solver(air_problem(), patient());
  set_air_reference(solver.problem(), 0.0);
  solver.reset(air_start());
  const SolveReport report = solver.solve(air_start());
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_NEAR(report.cost, 6.208551513, 1e-5);
  EXPECT_GT(report.active_constraints, 20);
}

TEST(MultipleShooting, RealTimeIterationTracksAirLikeTheReferenceSolvers) {
  Solver solver(air_problem(), patient());
  set_air_reference(solver.problem(), 0.0);
  Stated x = air_start();
  solver.reset(x);
  ASSERT_EQ(solver.solve(x).status, SolveStatus::converged);
  double squares = 0.0;
  for (int i = 0; i < 500; ++i) {
    set_air_reference(solver.problem(), 0.02 * i);
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    ASSERT_EQ(solver.feedback(x).status, SolveStatus::iterated);
    x = air_plant(x, solver.input(0));
    squares += (x.body.position - air_position(0.02 * (i + 1))).squaredNorm();
  }
  EXPECT_NEAR(std::sqrt(squares / 500), 0.0410, 0.0002);
}

TEST(MultipleShooting, ReportAgreesWithAnIndependentAudit) {
  Random random(11);
  for (int i = 0; i < 30; ++i) {
    Solver solver(step_problem(), patient());
    Stated x = step_start();
    x.body.position = Eigen::Vector3d(0, 0, 1.5) + random.vector(1.0);
    x.body.velocity = random.vector(0.8);
    x.body.orientation = quaternion_exp(random.vector(0.5));
    x.body.angular_velocity = random.vector(1.0);
    solver.reset(x);
    const SolveReport report = solver.solve(x);
    ASSERT_EQ(report.status, SolveStatus::converged) << "start " << i;
    const test_support::Audit a = test_support::audit(solver);
    EXPECT_NEAR(a.cost, report.cost, 1e-9 * (1.0 + a.cost));
    EXPECT_NEAR(a.defect, report.max_defect, 1e-12);
    EXPECT_NEAR(a.violation, report.max_violation, 1e-12);
    EXPECT_LT(a.violation, 1e-6);
    EXPECT_LT(a.defect, 1e-6);
  }
}

TEST(MultipleShooting, OptimumCannotBeImprovedByFeasibleChanges) {
  // A check without multipliers: no feasible input sequence near the optimum has a lower cost.
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  const SolveReport report = solver.solve(step_start());
  const WheeledFlightProblem<0>& problem = solver.problem();
  Random random(12);
  int feasible = 0;
  for (int trial = 0; trial < 2000; ++trial) {
    Stated x = step_start();
    double cost = 0.0;
    bool inside = true;
    const double size = std::pow(10.0, random.uniform(-4.0, -1.0));
    for (int k = 0; k <= problem.horizon(); ++k) {
      Eigen::Matrix<double, 6, 1> u = Eigen::Matrix<double, 6, 1>::Zero();
      if (k < problem.horizon()) {
        u = solver.input(k);
        u.head<3>() += random.vector(size);
        u.tail<3>() += random.vector(size);
        u = u.cwiseMax(problem.lower(k).tail<6>()).cwiseMin(problem.upper(k).tail<6>());
      }
      cost += problem.cost(k, x, u);
      const auto rows = problem.constraint_values(k, x, u);
      inside = inside && (rows - problem.upper(k)).maxCoeff() < 1e-9 &&
               (problem.lower(k) - rows).maxCoeff() < 1e-9;
      if (k < problem.horizon()) x = problem.step(k, x, u);
    }
    if (!inside) continue;
    ++feasible;
    EXPECT_GT(cost, report.cost - 1e-6);
  }
  EXPECT_GT(feasible, 100);
}

TEST(MultipleShooting, PenaltyIsThePriceAtWhichABoundIsRelaxed) {
  struct Priced : WheeledFlightProblem<0> {
    Constraints price;
    [[nodiscard]] const Constraints& penalty(int) const { return price; }
  };
  const auto violation_at = [](double constraint_penalty) {
    const Priced problem{step_problem(), Priced::Constraints::Constant(constraint_penalty)};
    MultipleShooting<Priced> solver(problem, patient());
    solver.reset(step_start());
    EXPECT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
    double largest = 0.0;
    for (int k = 0; k <= problem.horizon(); ++k)
      largest = std::max(largest, solver.constraint_multipliers(k).cwiseAbs().maxCoeff());
    EXPECT_LE(largest, constraint_penalty);
    return solver.report().max_violation;
  };
  EXPECT_LT(violation_at(1e4), 1e-6);
  EXPECT_GT(violation_at(1.0), 1e-2);  // cheaper to violate
}

TEST(MultipleShooting, FeedbackWithoutPrepareFails) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  EXPECT_EQ(solver.feedback(step_start()).status, SolveStatus::failed);
}

TEST(MultipleShooting, LimitsOnIterationsAndTimeAreKept) {
  SolverSettings settings = patient();
  settings.max_iterations = 2;
  Solver few(step_problem(), settings);
  few.reset(step_start());
  EXPECT_EQ(few.solve(step_start()).status, SolveStatus::iteration_limit);
  EXPECT_EQ(few.report().iterations, 2);

  settings.max_iterations = 50;
  settings.max_time = 1e-9;
  Solver hurried(step_problem(), settings);
  hurried.reset(step_start());
  EXPECT_EQ(hurried.solve(step_start()).status, SolveStatus::time_limit);
}

TEST(MultipleShooting, ToleranceDecidesWhenItStops) {
  SolverSettings loose = patient();
  loose.tolerance = 1.0;
  Solver early(step_problem(), loose), late(step_problem(), patient());
  early.reset(step_start());
  late.reset(step_start());
  EXPECT_LT(early.solve(step_start()).iterations, late.solve(step_start()).iterations);
  EXPECT_LE(early.report().kkt, 1.0);
}

TEST(MultipleShooting, MultipliersMeetGroundConditionsBetterThanWeightsAlone) {
  const auto largest_error = [](bool update_multipliers) {
    SolverSettings settings = patient();
    settings.update_multipliers = update_multipliers;
    settings.max_iterations = 25;
    settings.tolerance = 1e-9;
    WheeledFlightProblem<0> problem = step_problem();
    for (int k = 0; k <= problem.horizon(); ++k) {
      problem.node(k).on_ground = k >= 10;  // late enough to reach the ground
      problem.node(k).reference.position << 0.0, 0.0, 0.3;
    }
    Stated x;
    x.wrench.force = test_support::benchmark_hover_force();
    x.body.position << 0.1, 0.0, 0.25;
    Solver solver(problem, settings);
    solver.reset(x);
    return solver.solve(x).max_equality;
  };
  const double by_weights = largest_error(false);
  EXPECT_LT(by_weights, 0.1);
  EXPECT_LT(largest_error(true), by_weights / 10.0);
}

TEST(MultipleShooting, MemorySavesIterationsAndDoesNotChangeTheOptimum) {
  Random random(131);
  int with = 0, without = 0;
  for (int i = 0; i < 40; ++i) {
    Stated x = step_start();
    x.body.position = Eigen::Vector3d(0, 0, 1.5) + random.vector(1.0);
    x.body.velocity = random.vector(1.0);
    x.body.orientation = quaternion_exp(random.vector(0.6));
    x.body.angular_velocity = random.vector(1.0);
    SolverSettings settings = patient();
    settings.memory = 0;
    Solver forgetful(step_problem(), settings), learning(step_problem(), patient());
    forgetful.reset(x);
    learning.reset(x);
    ASSERT_EQ(forgetful.solve(x).status, SolveStatus::converged) << "start " << i;
    ASSERT_EQ(learning.solve(x).status, SolveStatus::converged) << "start " << i;
    const double cost = forgetful.report().cost;
    EXPECT_NEAR(learning.report().cost, cost, 1e-6 * cost) << "start " << i;
    without += forgetful.report().iterations;
    with += learning.report().iterations;
  }
  EXPECT_LT(with, without);  // measured: 385 and 470
}

TEST(MultipleShooting, MultipliersMoveByTheShiftSinceTheLastSolve) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  solver.shift(0.4);
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  ASSERT_TRUE(has_plan(solver.feedback(step_start()).status));
  std::vector<Solver::Constraints> solved;
  for (int k = 0; k <= solver.horizon(); ++k) solved.push_back(solver.constraint_multipliers(k));
  ASSERT_NE(solved[0], solved[1]);
  const auto expect_moved = [&](int nodes) {
    for (int k = 0; k <= solver.horizon(); ++k)
      EXPECT_EQ(solver.constraint_multipliers(k),
                solved[static_cast<std::size_t>(std::min(k + nodes, solver.horizon()))]);
  };
  solver.shift(0.3);
  expect_moved(0);
  solver.shift(0.3);
  expect_moved(1);
}

// The interior point goes on after the interruption; NLopt solves with the few that it leaves.
TEST(MultipleShooting, NloptSolvesAProgramThatWasInterrupted) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  solver.feedback(step_start(), Solver::Clock::time_point());
  ASSERT_TRUE(solver.interrupted());
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  const SolveReport& report = solver.feedback(step_start());
  EXPECT_EQ(report.status, SolveStatus::iterated);
  EXPECT_EQ(report.solved_by, ProgramSolver::nlopt);
  EXPECT_GT(report.evaluations, 0);
  EXPECT_LE(report.active_constraints, SolverSettings().program.max_dual_constraints);
}

TEST(MultipleShooting, PreparingAnInterruptedProgramIsNoWork) {
  SolverSettings settings = patient();
  settings.max_feedback_time = 1e-9;
  Solver solver(step_problem(), settings);
  solver.reset(step_start());
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  EXPECT_GT(solver.report().linearise_us, 0.0);
  solver.feedback(step_start());
  ASSERT_TRUE(solver.interrupted());
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  EXPECT_EQ(solver.report().linearise_us, 0.0);
  EXPECT_EQ(solver.report().factorise_us, 0.0);
  EXPECT_EQ(solver.report().gradients_us, 0.0);
}

TEST(MultipleShooting, ChecksItsSettings) {
  SolverSettings bad;
  bad.program.max_passes = 0;
  test_support::expect_refused("QuadraticProgramSettings.max_passes",
                               [&] { Solver(step_problem(), bad); });
}

TEST(MultipleShooting, LogHasEveryIterate) {
  Solver solver(step_problem(), patient()), other(step_problem(), patient());
  solver.reset(step_start());
  other.reset(step_start());
  std::vector<SolveReport> log;
  const SolveReport report =
      solver.solve(step_start(), [&log](const SolveReport& r) { log.push_back(r); });
  ASSERT_EQ(report.status, SolveStatus::converged);
  ASSERT_EQ(static_cast<int>(log.size()), report.iterations + 1);
  for (std::size_t i = 0; i < log.size(); ++i) EXPECT_EQ(log[i].iterations, static_cast<int>(i));
  EXPECT_GT(log.front().kkt, 1.0);
  EXPECT_GT(log.front().max_violation + log.front().max_defect, 0.1);
  EXPECT_EQ(log.back().kkt, report.kkt);
  EXPECT_EQ(log.back().cost, report.cost);
  EXPECT_EQ(log.back().max_violation, report.max_violation);
  EXPECT_EQ(other.solve(step_start()).cost, report.cost);
}

}  // namespace multiple_shooting_test
}  // namespace tilt_ropter::optimal_control
