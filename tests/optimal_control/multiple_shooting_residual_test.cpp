// The reported KKT residual if bounds move away from a solution, for lower and upper bounds alike.

#include "support/mass.hpp"
#include "support/patient.hpp"

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter::optimal_control {
namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();

using test_support::Mass;
using Solver = MultipleShooting<AutoDiffProblem<Mass>>;

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
    Solver solver(AutoDiffProblem<Mass>(mass), test_support::patient());
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

}  // namespace
}  // namespace tilt_ropter::optimal_control
