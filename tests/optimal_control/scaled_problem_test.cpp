// solve() does not depend on the units of the problem.

#include "support/patient.hpp"

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/detail/scaled_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <string>

namespace tilt_ropter::optimal_control {
namespace scaled_problem_test {

/// A mass on a line, with a force of at most 1 N and a prescribed end, in any units.
struct Mass {
  static constexpr int states = 2, inputs = 1, residuals = 3, constraints = 1,
                       terminal_constraints = 1, terminal_residuals = 0;
  template <typename S, int Size>
  using V = Eigen::Matrix<S, Size, 1>;

  double target = 0.0;       // position at the end [m]
  double per_metre = 1.0;    // units of length in a metre
  double cost_factor = 1.0;  // of the cost
  double row_factor = 1.0;   // of the condition at the end

  int horizon() const { return 20; }
  template <typename S>
  V<S, 2> step(int, const V<S, 2>& x, const V<S, 1>& u) const {
    const double h = 0.1;
    V<S, 2> end;
    end << x(0) + S(h) * x(1) + S(per_metre * h * h / 2.0) * u(0), x(1) + S(per_metre * h) * u(0);
    return end;
  }
  template <typename S>
  V<S, 3> residual(int, const V<S, 2>& x, const V<S, 1>& u) const {
    const double c = std::sqrt(cost_factor);
    V<S, 3> r;
    r << S(c / per_metre) * x(0), S(0.3 * c / per_metre) * x(1), S(0.5 * c) * u(0);
    return r;
  }
  template <typename S>
  V<S, 1> constraint_values(int, const V<S, 2>&, const V<S, 1>& u) const {
    return u;
  }
  V<double, 1> lower(int) const { return V<double, 1>(-1.0); }
  V<double, 1> upper(int) const { return V<double, 1>(1.0); }
  template <typename S>
  V<S, 1> terminal_constraint_values(const V<S, 2>& x) const {
    V<S, 1> r;
    r << S(row_factor / per_metre) * x(0);
    return r;
  }
  V<double, 1> terminal_lower() const { return V<double, 1>(row_factor * target); }
  V<double, 1> terminal_upper() const { return terminal_lower(); }
};
using Problem = AutoDiffProblem<Mass>;

struct Solved {
  SolveReport report;
  Eigen::VectorXd inputs = Eigen::VectorXd::Zero(20);
};

Solved solve(const Mass& mass, double start) {
  MultipleShooting<Problem> solver(Problem(mass), test_support::patient());
  const Eigen::Vector2d x0(start * mass.per_metre, 0.0);
  solver.reset(x0);
  Solved solved;
  solved.report = solver.solve(x0);
  for (int k = 0; k < 20; ++k) solved.inputs(k) = solver.input(k)(0);
  return solved;
}

TEST(ScaledProblem, AnyUnitOfTheCostGivesTheSamePlan) {
  const Solved usual = solve({}, 2.0);
  ASSERT_EQ(usual.report.status, SolveStatus::converged);
  for (const double factor : {1e-9, 1e-7, 1e-3, 1e3, 1e6, 1e9}) {
    SCOPED_TRACE("cost times " + std::to_string(factor));
    Mass mass;
    mass.cost_factor = factor;
    const Solved scaled = solve(mass, 2.0);
    EXPECT_EQ(scaled.report.status, SolveStatus::converged);
    EXPECT_NEAR(scaled.report.cost, factor * usual.report.cost, 1e-6 * factor * usual.report.cost);
    EXPECT_LT((scaled.inputs - usual.inputs).cwiseAbs().maxCoeff(), 5e-5);
  }
}

TEST(ScaledProblem, AnyUnitOfLengthGivesTheSamePlan) {
  const Solved usual = solve({}, 2.0);
  for (const double per_metre : {1e-6, 1e-3, 1e3}) {  // Mm to mm
    SCOPED_TRACE(std::to_string(per_metre) + " units in a metre");
    Mass mass;
    mass.per_metre = per_metre;
    const Solved scaled = solve(mass, 2.0);
    EXPECT_EQ(scaled.report.status, SolveStatus::converged);
    EXPECT_LT((scaled.inputs - usual.inputs).cwiseAbs().maxCoeff(), 5e-5);
  }
}

// An actuator cannot give more than its bound; a place can be missed.
TEST(ScaledProblem, TheBoundOfAnInputIsRelaxedLastInAnyUnits) {
  for (const double target : {100.0, 3.0})  // far beyond reach, and just beyond
    for (const double factor : {1e-6, 1e-3, 1.0, 100.0, 1e4, 1e6}) {
      SCOPED_TRACE("target " + std::to_string(target) + " m, row times " + std::to_string(factor));
      Mass mass;
      mass.target = target;
      mass.row_factor = factor;
      const Solved solved = solve(mass, 0.0);
      EXPECT_EQ(solved.report.status, SolveStatus::infeasible);
      EXPECT_GT(solved.report.relaxed_hard_constraints, 0);
      EXPECT_LE(solved.inputs.cwiseAbs().maxCoeff(), 1.0 + 1e-6);
      EXPECT_GT(solved.inputs.minCoeff(), 0.99);  // as near as it can
      // A real-time iteration says the same.
      MultipleShooting<Problem> solver(Problem(mass), test_support::patient());
      const Eigen::Vector2d x0(0.0, 0.0);
      solver.reset(x0);
      ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
      EXPECT_EQ(solver.feedback(x0).status, SolveStatus::infeasible);
      EXPECT_LE(std::abs(solver.input(0)(0)), 1.0 + 1e-6);
    }
}

// Units by a guess at rest, 2 m from the target.
bool choose_units(ScaledProblem<Problem>& scaled, const Mass& mass) {
  const Problem problem(mass);
  const Eigen::Vector2d x(2.0, 0.0);
  const Eigen::Matrix<double, 1, 1> u(0.0);
  using Constraints = ProblemConstraints<Problem>;
  struct Node {
    Constraints::Values value, lower, upper;
  };
  double cost = 0.0;
  for (int k = 0; k <= 20; ++k) cost += problem.cost(k, x, u);
  return scaled.choose_units(cost, [&](int k) {
    Node node;
    Constraints::Values penalty, stiffness;
    node.value = Constraints::values(problem, k, x, u);
    Constraints::bounds(problem, k, node.lower, node.upper, penalty, stiffness);
    return node;
  });
}

TEST(ScaledProblem, ScalesCostAndConstraintsByPowersOfTwoAndBack) {
  Mass mass;
  mass.cost_factor = 1e5;
  mass.row_factor = 3e4;
  mass.target = 1.0;
  ScaledProblem<Problem> problem{Problem(mass)};
  EXPECT_TRUE(problem.natural());
  EXPECT_TRUE(choose_units(problem, mass));
  EXPECT_FALSE(problem.natural());
  const Eigen::Matrix<double, 1, 1> u(0.5);
  const Eigen::Vector2d x(2.0, 0.0);
  EXPECT_EQ(problem.cost(0, x, u) * problem.cost_unit(), Problem(mass).cost(0, x, u));
  double sum = 0.0;
  for (int k = 0; k <= 20; ++k) sum += problem.cost(k, x, Eigen::Matrix<double, 1, 1>(0.0));
  EXPECT_NEAR(std::log2(sum), std::log2(64.0), 1.0);
  EXPECT_EQ(std::exp2(std::round(std::log2(problem.row_units(20)(0)))), problem.row_units(20)(0));
  EXPECT_NEAR(problem.row_units(20)(0), 3e4, 1e4);
  problem.forget_units();
  EXPECT_TRUE(problem.natural());
  EXPECT_EQ(problem.cost(0, x, u), Problem(mass).cost(0, x, u));
}

TEST(ScaledProblem, LeavesUsualUnitsAsTheyAre) {
  Mass mass;
  mass.row_factor = 300.0;
  mass.target = 1.0;
  ScaledProblem<Problem> problem{Problem(mass)};
  EXPECT_FALSE(choose_units(problem, mass));
  EXPECT_TRUE(problem.natural());
}

}  // namespace scaled_problem_test
}  // namespace tilt_ropter::optimal_control
