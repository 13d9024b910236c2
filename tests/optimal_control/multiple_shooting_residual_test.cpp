// The reported KKT residual if bounds move away from a solution, for lower and upper bounds alike.

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

/// A mass on a line that moves to `target`, with a bounded force and speed.
struct Mass {
  static constexpr int states = 2, inputs = 1, residuals = 3, constraints = 2;
  template <typename S>
  using Vector2 = Eigen::Matrix<S, 2, 1>;
  template <typename S>
  using Vector1 = Eigen::Matrix<S, 1, 1>;

  double target = 1.0;
  Eigen::Vector2d most{1.0, 0.4}, stiffness{infinity, infinity};

  int horizon() const { return 20; }
  template <typename S>
  Vector2<S> step(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {x(0) + S(0.1) * x(1) + S(0.005) * u(0), x(1) + S(0.1) * u(0)};
  }
  template <typename S>
  Eigen::Matrix<S, 3, 1> residual(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {x(0) - S(target), S(0.1) * x(1), S(0.1) * u(0)};
  }
  template <typename S>
  Vector2<S> constraint_values(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {u(0), x(1)};
  }
  Eigen::Vector2d lower(int) const { return -most; }
  Eigen::Vector2d upper(int) const { return most; }
  Eigen::Vector2d penalty(int) const { return {infinity, 1e3}; }
  Eigen::Vector2d quadratic_penalty(int) const { return stiffness; }
};
using Solver = MultipleShooting<AutoDiffProblem<Mass>>;

// The sign of the target. To +1 m the upper bounds are active at first, to -1 m the lower bounds.
class KktResidual : public testing::TestWithParam<double> {
 protected:
  // At the solution for a stiffness of the bound on the speed.
  Solver solved(double stiffness) const {
    Mass mass;
    mass.target = GetParam();
    mass.stiffness(1) = stiffness;
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
    mass.most(i) += by;
    EXPECT_EQ(solver.prepare(), PrepareStatus::prepared);
    mass.most(i) -= by;
    return solver.report().kkt;
  }
};

TEST_P(KktResidual, IsZeroAtTheSolution) {
  for (const double stiffness : {infinity, 5.0}) {
    Solver solver = solved(stiffness);
    EXPECT_LT(residual(solver, 0, 0.0), 1e-6);
  }
}

// A multiplier of a bound that is not reached: the smaller of the multiplier and the distance
// counts, and the distance includes the violation that the multiplier accounts for.
TEST_P(KktResidual, IsTheComplementarityOfBoundsThatMovedAway) {
  for (const double stiffness : {infinity, 5.0}) {
    Solver solver = solved(stiffness);
    for (const int i : {0, 1})
      for (const double by : {0.001, 0.01, 0.1, 10.0}) {
        double expected = 0.0;
        for (int k = 0; k <= solver.horizon(); ++k)
          expected =
              std::max(expected, std::min(std::abs(solver.constraint_multipliers(k)(i)), by));
        EXPECT_NEAR(residual(solver, i, by), expected, 1e-6) << stiffness << ' ' << i << ' ' << by;
      }
  }
}

TEST_P(KktResidual, IsTheViolationOfBoundsThatMovedCloser) {
  for (const double stiffness : {infinity, 5.0}) {
    Solver solver = solved(stiffness);
    for (const int i : {0, 1})
      for (const double by : {0.001, 0.1})
        EXPECT_NEAR(residual(solver, i, -by), by, 1e-6) << stiffness << ' ' << i << ' ' << by;
  }
}

INSTANTIATE_TEST_SUITE_P(UpperAndLower, KktResidual, testing::Values(1.0, -1.0));

}  // namespace
}  // namespace tilt_ropter::optimal_control
