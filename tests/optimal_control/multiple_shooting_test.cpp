#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/audit.hpp"
#include "support/benchmark_problem.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace {

using test_support::air_plant;
using test_support::air_position;
using test_support::air_problem;
using test_support::air_start;
using test_support::Random;
using test_support::set_air_reference;
using test_support::step_problem;
using test_support::step_start;

using Solver = MultipleShooting<WheeledFlightProblem<>>;

TEST(MultipleShooting, ReachesTheKnownOptimumOfStep) {
  Solver solver(step_problem());
  solver.reset(step_start());
  const SolveReport report = solver.solve(step_start());
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_LE(report.kkt, 1e-6);
  // With the homogeneous R(q) of the stages and the quaternion renormalised: 2074.1813 by IPOPT.
  EXPECT_NEAR(report.cost, 2074.1813, 1e-6 * 2074.1813);
  EXPECT_NEAR(report.cost, 2074.17, 1e-4 * 2074.17);
}

TEST(MultipleShooting, ReachesTheKnownOptimumOfAirAtTickZero) {
  Solver solver(air_problem());
  set_air_reference(solver.problem(), 0.0);
  solver.reset(air_start());
  const SolveReport report = solver.solve(air_start());
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_NEAR(report.cost, 6.208551513, 1e-5);
  EXPECT_GT(report.active_rows, 20);
}

TEST(MultipleShooting, RealTimeIterationTracksAirLikeTheReferenceSolvers) {
  Solver solver(air_problem());
  set_air_reference(solver.problem(), 0.0);
  State<> x = air_start();
  solver.reset(x);
  ASSERT_EQ(solver.solve(x).status, SolveStatus::converged);
  double squares = 0.0;
  for (int i = 0; i < 500; ++i) {
    set_air_reference(solver.problem(), 0.02 * i);
    ASSERT_TRUE(solver.prepare());
    ASSERT_EQ(solver.feedback(x).status, SolveStatus::iterated);
    x = air_plant(x, solver.input(0));
    squares += (x.body.position - air_position(0.02 * (i + 1))).squaredNorm();
  }
  EXPECT_NEAR(std::sqrt(squares / 500), 0.0410, 0.0002);
}

TEST(MultipleShooting, ReportAgreesWithAnIndependentAudit) {
  Random random(11);
  for (int i = 0; i < 30; ++i) {
    Solver solver(step_problem());
    State<> x = step_start();
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
  // Multipliers or not: no feasible input sequence near the optimum costs less.
  Solver solver(step_problem());
  solver.reset(step_start());
  const SolveReport report = solver.solve(step_start());
  const WheeledFlightProblem<>& problem = solver.problem();
  Random random(12);
  int feasible = 0;
  for (int trial = 0; trial < 2000; ++trial) {
    State<> x = step_start();
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
      const auto rows = problem.row_values(k, x, u);
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

TEST(MultipleShooting, InfeasibleStartIsSolvedAndSaysWhatWasGivenUp) {
  Solver solver(step_problem());
  State<> x;
  x.body.position << 0.0, 0.0, 1.5;
  x.body.angular_velocity << 5.0, 0.0, 0.0;  // the bound is 4, and M takes time to build up
  x.wrench.force << 9.0, 0.0, 14.7;          // the box ends at 6, and F_x falls by 2 an interval
  solver.reset(x);
  const SolveReport report = solver.solve(x);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_GT(report.given_up_rows, 0);
  EXPECT_GT(report.max_violation, 0.1);
}

TEST(MultipleShooting, ThePenaltyIsThePriceAtWhichABoundIsGivenUp) {
  const auto violation_at = [](double row_penalty) {
    WheeledFlightSettings settings;
    settings.row_penalty = row_penalty;
    WheeledFlightProblem<> problem(test_support::benchmark_body(), {}, settings);
    for (int k = 0; k <= problem.horizon(); ++k) problem.node(k) = step_problem().node(k);
    Solver solver(problem);
    solver.reset(step_start());
    EXPECT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
    double largest = 0.0;
    for (int k = 0; k <= problem.horizon(); ++k)
      largest = std::max(largest, solver.row_multipliers(k).cwiseAbs().maxCoeff());
    EXPECT_LE(largest, row_penalty);
    return solver.report().max_violation;
  };
  EXPECT_LT(violation_at(1e4), 1e-6);
  EXPECT_GT(violation_at(1.0), 1e-2);  // cheaper than keeping it
}

TEST(MultipleShooting, NonFiniteStartIsRejectedAndChangesNothing) {
  Solver solver(step_problem());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  const auto plan = solver.input(0);
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    State<> x = step_start();
    x.body.velocity.y() = bad;
    EXPECT_EQ(solver.solve(x).status, SolveStatus::rejected);
    ASSERT_TRUE(solver.prepare());
    EXPECT_EQ(solver.feedback(x).status, SolveStatus::rejected);
    EXPECT_EQ(solver.input(0), plan);
  }
}

TEST(MultipleShooting, NonFiniteProblemFailsAndKeepsThePlan) {
  Solver solver(step_problem());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  const auto plan = solver.input(0);
  solver.problem().node(5).reference.position.x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(solver.prepare());
  EXPECT_EQ(solver.feedback(step_start()).status, SolveStatus::failed);
  EXPECT_EQ(solver.input(0), plan);
}

TEST(MultipleShooting, FeedbackWithoutPrepareFails) {
  Solver solver(step_problem());
  solver.reset(step_start());
  EXPECT_EQ(solver.feedback(step_start()).status, SolveStatus::failed);
}

TEST(MultipleShooting, LimitsOnIterationsAndTimeAreKept) {
  SolverSettings settings;
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
  SolverSettings loose;
  loose.tolerance = 1.0;
  Solver early(step_problem(), loose), late(step_problem());
  early.reset(step_start());
  late.reset(step_start());
  EXPECT_LT(early.solve(step_start()).iterations, late.solve(step_start()).iterations);
  EXPECT_LE(early.report().kkt, 1.0);
}

TEST(MultipleShooting, MultipliersMeetTheGroundConditionsCloserThanWeights) {
  const auto largest_error = [](bool update_multipliers) {
    SolverSettings settings;
    settings.update_multipliers = update_multipliers;
    settings.max_iterations = 25;
    settings.tolerance = 1e-9;
    WheeledFlightProblem<> problem = step_problem();
    for (int k = 0; k <= problem.horizon(); ++k) {
      problem.node(k).on_ground = k >= 10;  // late enough for the vehicle to get there
      problem.node(k).reference.position << 0.0, 0.0, 0.3;
    }
    State<> x;
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

TEST(MultipleShooting, SettingsOutOfRangeAreRefusedByName) {
  const auto message = [](const SolverSettings& settings) -> std::string {
    try {
      Solver solver(step_problem(), settings);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "accepted";
  };
  SolverSettings s;
  s.max_iterations = 0;
  EXPECT_NE(message(s).find("SolverSettings.max_iterations = 0: must be > 0"), std::string::npos);
  s = {};
  s.tolerance = std::numeric_limits<double>::quiet_NaN();
  EXPECT_NE(message(s).find("SolverSettings.tolerance"), std::string::npos);
  s = {};
  s.program.max_active_rows = -1;
  EXPECT_NE(message(s).find("QuadraticProgramSettings.max_active_rows = -1"), std::string::npos);
  s = {};
  s.program.dual.max_evaluations = 0;
  EXPECT_NE(message(s).find("DualSettings.max_evaluations"), std::string::npos);
}

}  // namespace
}  // namespace tilt_ropter
