// Functions of a quadratic program for users: methods, soft constraints, gains, limits, and reports
// about constraints that cannot be met.

#include "support/mass.hpp"
#include "support/patient.hpp"
#include "support/random.hpp"
#include "support/random_program.hpp"

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>

namespace tilt_ropter::optimal_control {
namespace quadratic_program_test {

constexpr double infinity = std::numeric_limits<double>::infinity();

using test_support::Mass;
using Problem = AutoDiffProblem<Mass>;
using Solver = MultipleShooting<Problem>;

const Eigen::Vector2d rest = Eigen::Vector2d::Zero();

Solver solved(const Mass& mass, ProgramMethod method = ProgramMethod::automatic) {
  SolverSettings settings = test_support::patient();
  settings.program.method = method;
  Solver solver(Problem(mass), settings);
  solver.reset(rest);
  solver.solve(rest);
  return solver;
}

TEST(QuadraticProgram, EveryMethodReachesTheOptimumOfSingleShooting) {
  const Mass mass;
  SingleShooting<Problem> full(Problem(mass), test_support::patient());
  full.reset(rest);
  ASSERT_EQ(full.solve(rest).status, SolveStatus::converged);
  for (const ProgramMethod method :
       {ProgramMethod::automatic, ProgramMethod::nlopt, ProgramMethod::structured}) {
    const Solver solver = solved(mass, method);
    ASSERT_EQ(solver.report().status, SolveStatus::converged) << static_cast<int>(method);
    EXPECT_NEAR(solver.report().cost, full.report().cost, 1e-6 * full.report().cost);
    EXPECT_LE(solver.report().program_residual, 1e-6);
    EXPECT_GT(solver.report().active_constraints, 5);
    EXPECT_EQ(solver.report().relaxed_constraints, 0);
  }
}

// The number of active constraints decides the method, unless the settings select a method.
TEST(QuadraticProgram, ManyActiveConstraintsUseRiccatiPasses) {
  Mass mass;
  mass.high(1) = 0.1;  // active at nearly all nodes
  const Solver automatic = solved(mass), dual = solved(mass, ProgramMethod::nlopt);
  EXPECT_GT(automatic.report().active_constraints, 16);
  EXPECT_EQ(dual.report().passes, 0);
  EXPECT_NEAR(automatic.report().cost, dual.report().cost, 1e-6);
}

TEST(QuadraticProgram, RelaxesWithLinearAndSoftensWithQuadraticPenalty) {
  Mass mass;
  mass.penalties(1) = 1.5;  // too small to hold the bound
  const Solver linear = solved(mass);
  ASSERT_EQ(linear.report().status, SolveStatus::converged);
  EXPECT_GT(linear.report().relaxed_constraints, 0);
  EXPECT_EQ(linear.report().relaxed_hard_constraints, 0);
  EXPECT_GT(linear.report().largest_relaxation, 0.01);
  double largest = 0.0;
  for (int k = 0; k <= linear.horizon(); ++k) {
    EXPECT_NEAR(linear.slack(k, 1), std::max(0.0, linear.state(k)(1) - 0.4), 1e-6);
    largest = std::max(largest, linear.slack(k, 1));
    EXPECT_LE(linear.constraint_multipliers(k)(1), 1.5 + 1e-9);
  }
  EXPECT_NEAR(linear.report().largest_relaxation, largest, 1e-6);

  mass.penalties(1) = infinity;
  mass.stiffnesses(1) = 50.0;
  const Solver quadratic = solved(mass);
  ASSERT_EQ(quadratic.report().status, SolveStatus::converged);
  int held = 0;
  for (int k = 1; k <= quadratic.horizon(); ++k) {
    const double violation = quadratic.state(k)(1) - 0.4;
    if (violation > 1e-6) {
      EXPECT_NEAR(quadratic.constraint_multipliers(k)(1), 50.0 * violation, 1e-5);
      EXPECT_NEAR(quadratic.slack(k, 1), violation, 1e-7);
      ++held;
    }
  }
  EXPECT_GT(held, 3);
  EXPECT_EQ(quadratic.report().relaxed_constraints, 0);
}

TEST(QuadraticProgram, ContradictoryHardConstraintsAreInfeasible) {
  Mass mass;
  mass.low(0) = 0.5;             // must accelerate
  mass.penalties(1) = infinity;  // must not exceed the speed bound
  const Solver solver = solved(mass);
  EXPECT_EQ(solver.report().status, SolveStatus::infeasible);
  EXPECT_GT(solver.report().relaxed_hard_constraints, 0);
  EXPECT_GT(solver.report().largest_hard_relaxation, 0.1);
}

TEST(QuadraticProgram, LowerBoundAboveUpperBoundIsReportedInfeasible) {
  Mass mass;
  mass.low(0) = 1.5;  // the upper bound is 1.0
  const Solver solver = solved(mass);
  EXPECT_EQ(solver.report().status, SolveStatus::infeasible);
  EXPECT_GT(solver.report().relaxed_hard_constraints, 0);
  EXPECT_NEAR(solver.report().largest_hard_relaxation, 0.5, 0.51);
}

// No input can change the state of node 0.
TEST(QuadraticProgram, MeasuredStateBeyondItsBoundRelaxesOnlyThisBound) {
  Mass mass;
  Solver solver(Problem(mass), test_support::patient());
  const Eigen::Vector2d fast(0.0, 0.42);
  solver.reset(fast);
  solver.solve(fast);
  EXPECT_EQ(solver.report().status, SolveStatus::converged);
  EXPECT_TRUE(solver.relaxed(0, 1));
  EXPECT_EQ(solver.report().relaxed_constraints, 1);
  EXPECT_NEAR(solver.report().largest_relaxation, 0.02, 1e-9);
}

TEST(QuadraticProgram, GainsAndFeedForwardMatchTheOptimum) {
  Mass mass;
  mass.high = {100.0, 100.0};
  mass.low = {-100.0, -100.0};
  Solver solver = solved(mass);
  ASSERT_EQ(solver.report().status, SolveStatus::converged);
  const auto gain = solver.gain(0);
  const double before = solver.input(0)(0);
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  const Eigen::Vector2d moved(0.03, -0.02);
  ASSERT_EQ(solver.feedback(moved).status, SolveStatus::iterated);
  EXPECT_NEAR(solver.input(0)(0), before + (gain * moved)(0), 1e-9);
  EXPECT_NEAR(solver.feedforward(0)(0), 0.0, 1e-9);  // the plan before was optimal
  EXPECT_LT(gain(0, 0), -1.0);
}

TEST(QuadraticProgram, FirstInputKeepsItsHardBoundsForAnyTimeLimit) {
  test_support::Random random(3);
  for (const double limit : {1e-9, 1e-6, 1e-5, 3e-5, 1e-3}) {
    Mass mass;
    mass.intervals = 100;
    SolverSettings settings;
    settings.max_feedback_time = limit;
    Solver solver(Problem(mass), settings);
    Eigen::Vector2d x = rest;
    solver.reset(x);
    for (int i = 0; i < 500; ++i) {
      ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
      const SolveReport& report = solver.feedback(x);
      ASSERT_TRUE(has_plan(report.status));
      if (report.status == SolveStatus::iterated) {
        EXPECT_LE(report.program_residual, 1e-6);
      }
      EXPECT_LE(std::abs(solver.input(0)(0)), 1.0 + 1e-12);
      x = mass.step<double>(0, x, solver.input(0));
      if (i == 100) x << -3.0, random.uniform(-1.0, 1.0);
    }
    EXPECT_NEAR(x(0), 1.0, 0.3) << limit;
  }
}

TEST(QuadraticProgram, InterruptedSolveContinuesInTheNextIteration) {
  Mass mass;
  mass.intervals = 200;
  mass.high(1) = 0.1;
  Solver solver{Problem(mass)};
  solver.reset(rest);
  int calls = 0;
  SolveStatus status = SolveStatus::time_limit;
  for (; status != SolveStatus::iterated && calls < 100; ++calls) {
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    status = solver.feedback(rest, SolverClock::now() + std::chrono::microseconds(150)).status;
    ASSERT_TRUE(status == SolveStatus::iterated || status == SolveStatus::time_limit);
    EXPECT_LE(std::abs(solver.input(0)(0)), 1.0 + 1e-12);
  }
  EXPECT_LT(calls, 100);
  for (int i = 0; i < 5; ++i) {
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    status = solver.feedback(rest).status;
  }
  EXPECT_EQ(status, SolveStatus::iterated);
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  EXPECT_LT(solver.report().kkt, 1e-6);
}

TEST(QuadraticProgram, GuessResetOrShiftAfterPrepareNeedsAnotherPrepare) {
  Solver solver = solved(Mass{});
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  solver.reset(rest);
  EXPECT_EQ(solver.feedback(rest).status, SolveStatus::failed);
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  solver.set_guess(3, rest, Eigen::Matrix<double, 1, 1>(0.1));
  EXPECT_EQ(solver.feedback(rest).status, SolveStatus::failed);
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  solver.shift(0.3);
  EXPECT_EQ(solver.feedback(rest).status, SolveStatus::failed);
}

// Multipliers move to the nearest nodes, for shifts by any fraction of an interval.
TEST(QuadraticProgram, FractionsOfAShiftAddUp) {
  Solver once = solved(Mass{}), parts = solved(Mass{});
  ASSERT_GT(once.constraint_multipliers(3)(0), 0.0);
  const double third = once.constraint_multipliers(3)(0);
  once.shift(2.0);
  for (int i = 0; i < 5; ++i) parts.shift(0.4);
  EXPECT_EQ(once.constraint_multipliers(1)(0), third);
  for (int k = 0; k <= once.horizon(); ++k)
    EXPECT_EQ(once.constraint_multipliers(k), parts.constraint_multipliers(k)) << k;
  Solver halves = solved(Mass{});
  halves.shift(0.5);
  halves.shift(0.5);
  EXPECT_EQ(halves.constraint_multipliers(2)(0), third);
}

TEST(QuadraticProgram, InputBoundsThatExcludeZeroDoNotCountAtTheLastNode) {
  Mass mass;
  mass.low(0) = 0.05;  // at every node; the last node has no input
  mass.high(1) = 100.0;
  const Solver solver = solved(mass);
  EXPECT_EQ(solver.report().status, SolveStatus::converged);
  EXPECT_LE(solver.report().max_violation, 1e-9);
  SingleShooting<Problem> full(Problem(mass), test_support::patient());
  full.reset(rest);
  ASSERT_EQ(full.solve(rest).status, SolveStatus::converged);
  EXPECT_NEAR(full.report().cost, solver.report().cost, 1e-6);
}

TEST(SingleShooting, PaysThePriceOfAContradiction) {
  Mass mass;
  mass.intervals = 10;
  mass.low(0) = 0.5;  // must accelerate, also beyond the largest speed
  mass.high(1) = 0.2;
  mass.penalties << 2.0, 3.0;
  SingleShooting<Problem> solver(Problem(mass), test_support::patient());
  Solver other(Problem(mass), test_support::patient());
  solver.reset(rest);
  other.reset(rest);
  EXPECT_EQ(solver.solve(rest).status, SolveStatus::converged);
  EXPECT_EQ(other.solve(rest).status, SolveStatus::converged);
  EXPECT_NEAR(solver.report().cost, other.report().cost, 1e-6);
  EXPECT_NEAR(solver.report().max_violation, other.report().max_violation, 1e-6);
  EXPECT_GE(solver.report().max_violation, 0.1);
}

TEST(SingleShooting, SoftBoundsAreRelaxedAboveTheirPrice) {
  for (const double penalty : {0.01, 1e3})
    for (const double stiffness : {infinity, 5.0}) {
      Mass mass;
      mass.high(1) = 0.2;
      mass.penalties(1) = penalty;
      mass.stiffnesses(1) = stiffness;
      SingleShooting<Problem> solver(Problem(mass), test_support::patient());
      Solver other(Problem(mass), test_support::patient());
      solver.reset(rest);
      other.reset(rest);
      EXPECT_EQ(solver.solve(rest).status, SolveStatus::converged) << penalty << ' ' << stiffness;
      EXPECT_EQ(other.solve(rest).status, SolveStatus::converged);
      EXPECT_NEAR(solver.report().cost, other.report().cost, 1e-6 * other.report().cost);
      EXPECT_EQ(solver.report().max_violation > 1e-3, penalty < 1.0 || stiffness < 10.0);
    }
}

TEST(SingleShooting, StallsWhereHardConstraintsContradict) {
  Mass mass;
  mass.low(0) = 0.5;  // must accelerate
  mass.penalties(1) = infinity;
  SingleShooting<Problem> solver(Problem(mass), test_support::patient());
  solver.reset(rest);
  EXPECT_EQ(solver.solve(rest).status, SolveStatus::stalled);
  EXPECT_GT(solver.report().max_violation, 0.1);
}

// The sign of the target. To +1 m the upper bounds are active at first, to -1 m the lower bounds.
class KktResidual : public testing::TestWithParam<double> {
 protected:
  // At the solution for a stiffness of the bound on the speed.
  Solver solved(double stiffness) const {
    Mass mass;
    mass.intervals = 20;
    mass.target = GetParam();
    mass.low = -mass.high;
    mass.stiffnesses(1) = stiffness;
    Solver solver(Problem(mass), test_support::patient());
    solver.reset(Eigen::Vector2d::Zero());
    EXPECT_EQ(solver.solve(Eigen::Vector2d::Zero()).status, SolveStatus::converged);
    EXPECT_GT(GetParam() * solver.constraint_multipliers(0)(0), 0.1);
    EXPECT_GT(GetParam() * solver.constraint_multipliers(10)(1), 0.01);
    return solver;
  }

  // KKT residual of the same plan and multipliers if the bounds of constraint i move outward by
  // `by`.
  static double residual(Solver& solver, int i, double by) {
    Mass& mass = solver.problem().user();
    mass.low(i) -= by;
    mass.high(i) += by;
    EXPECT_EQ(solver.prepare(), PrepareStatus::prepared);
    mass.low(i) += by;
    mass.high(i) -= by;
    return solver.report().kkt;
  }
};

double largest_multiplier(const Solver& solver) {
  double largest = 0.0;
  for (int k = 0; k <= solver.horizon(); ++k)
    largest = std::max(largest, solver.constraint_multipliers(k).cwiseAbs().maxCoeff());
  return largest;
}

// Error of the cost, relative to the cost, if the bounds of constraint i move by `by`.
double gap(const Solver& solver, int i, double by) {
  double sum = 0.0;
  for (int k = 0; k <= solver.horizon(); ++k) sum += std::abs(solver.constraint_multipliers(k)(i));
  return by * sum / (1.0 + solver.report().cost);
}

TEST_P(KktResidual, IsZeroAtTheSolution) {
  for (const double stiffness : {infinity, 5.0}) {
    Solver solver = solved(stiffness);
    EXPECT_LT(residual(solver, 0, 0.0), 1e-6);
  }
}

// Bounds that are `by` further away than the solution found them: complementarity is the smaller of
// the multiplier, relative to the largest, and of the distance, relative to the bound. The distance
// includes the violation that the multiplier accounts for. The cost is wrong by the gap.
TEST_P(KktResidual, IsComplementarityAndGapOfBoundsThatMovedAway) {
  for (const double stiffness : {infinity, 5.0}) {
    Solver solver = solved(stiffness);
    for (const int i : {0, 1})
      for (const double by : {0.001, 0.01, 0.1, 10.0}) {
        const double most = largest_multiplier(solver),
                     bound = solver.problem().user().high(i) + by;
        double complementarity = 0.0;
        for (int k = 0; k <= solver.horizon(); ++k)
          complementarity =
              std::max(complementarity,
                       std::min(std::abs(solver.constraint_multipliers(k)(i)) / (1.0 + most),
                                by / (1.0 + bound)));
        EXPECT_NEAR(residual(solver, i, by), std::max(complementarity, gap(solver, i, by)), 1e-6)
            << stiffness << ' ' << i << ' ' << by;
      }
  }
}

TEST_P(KktResidual, IsViolationOrGapOfBoundsThatMovedCloser) {
  for (const double stiffness : {infinity, 5.0}) {
    Solver solver = solved(stiffness);
    for (const int i : {0, 1})
      for (const double by : {0.001, 0.1}) {
        EXPECT_NEAR(residual(solver, i, -by), std::max(by, gap(solver, i, by)), 1e-6)
            << stiffness << ' ' << i << ' ' << by;
      }
  }
}

INSTANTIATE_TEST_SUITE_P(UpperAndLower, KktResidual, testing::Values(1.0, -1.0));

}  // namespace quadratic_program_test
}  // namespace tilt_ropter::optimal_control
