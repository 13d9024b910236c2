// Problems on which an earlier solve() cycled forever: a prescribed terminal state, from far away.
// CTest: optimised

#include "support/patient.hpp"

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <string>

namespace tilt_ropter::optimal_control {
namespace stall_test {

/// A cart with a pole. The pole must be upright and at rest at the end.
struct CartPole {
  static constexpr int states = 4, inputs = 1, residuals = 5, constraints = 1,
                       terminal_constraints = 4;
  template <typename S>
  using Vector4 = Eigen::Matrix<S, 4, 1>;  // position, angle from upright, their rates
  template <typename S>
  using Vector1 = Eigen::Matrix<S, 1, 1>;

  int intervals = 60;

  int horizon() const { return intervals; }
  template <typename S>
  static Vector4<S> rate(const Vector4<S>& x, const S& force) {
    using std::cos;
    using std::sin;
    const S s = sin(x(1)), c = cos(x(1));
    const S push = (force + S(0.05) * x(3) * x(3) * s) / S(1.1);
    const S turn = (S(9.81) * s - c * push) / (S(0.5) * (S(4.0 / 3.0) - S(0.1 / 1.1) * c * c));
    Vector4<S> result;
    result << x(2), x(3), push - S(0.05 / 1.1) * turn * c, turn;
    return result;
  }
  template <typename S>
  Vector4<S> step(int, const Vector4<S>& x, const Vector1<S>& u) const {
    const Vector4<S> middle = x + S(0.025) * rate<S>(x, u(0));
    return x + S(0.05) * rate<S>(middle, u(0));
  }
  template <typename S>
  Eigen::Matrix<S, 5, 1> residual(int, const Vector4<S>& x, const Vector1<S>& u) const {
    Eigen::Matrix<S, 5, 1> r;
    r << S(0.3) * x, S(0.1) * u(0);
    return r;
  }
  template <typename S>
  Vector1<S> constraint_values(int, const Vector4<S>&, const Vector1<S>& u) const {
    return u;
  }
  Vector1<double> lower(int) const { return Vector1<double>(-20.0); }
  Vector1<double> upper(int) const { return Vector1<double>(20.0); }
  template <typename S>
  Vector4<S> terminal_constraint_values(const Vector4<S>& x) const {
    return x;
  }
  Eigen::Vector4d terminal_lower() const { return Eigen::Vector4d::Zero(); }
  Eigen::Vector4d terminal_upper() const { return Eigen::Vector4d::Zero(); }
};

TEST(Stall, EndsWithAStatusThatGivesTheReason) {
  int converged = 0, told = 0, limits = 0;
  for (const int intervals : {20, 40, 60, 80})
    for (const int memory : {0, 16})
      for (const double angle : {3.14159265358979, 3.0, 2.0, 1.0, -2.5, 5.0}) {
        SCOPED_TRACE(std::to_string(intervals) + " intervals, memory " + std::to_string(memory) +
                     ", from " + std::to_string(angle));
        CartPole model;
        model.intervals = intervals;
        SolverSettings settings = test_support::patient();
        settings.memory = memory;
        settings.max_iterations = 2000;
        MultipleShooting<AutoDiffProblem<CartPole>> solver(AutoDiffProblem<CartPole>(model),
                                                           settings);
        const Eigen::Vector4d start(0.0, angle, 0.0, 0.0);
        solver.reset(start);
        const SolveReport& report = solver.solve(start);
        limits += report.status == SolveStatus::iteration_limit;
        if (report.status == SolveStatus::converged) {
          ++converged;
          EXPECT_LE(solver.state(intervals).norm(), 1e-6);
          EXPECT_EQ(report.relaxed_constraints, 0);
        } else {
          ++told;
          EXPECT_TRUE(report.status == SolveStatus::infeasible ||
                      report.status == SolveStatus::stalled ||
                      report.status == SolveStatus::iteration_limit)
              << static_cast<int>(report.status);
        }
      }
  EXPECT_LE(limits, 1);  // one case decreases for thousands of iterations
  EXPECT_GE(converged, 24);
  EXPECT_GT(told, 0);  // one second is not enough to swing up
}

TEST(Stall, SwingsUpFromHanging) {
  for (const int memory : {0, 16}) {
    SolverSettings settings = test_support::patient();
    settings.memory = memory;
    settings.max_iterations = 1000;
    MultipleShooting<AutoDiffProblem<CartPole>> solver(AutoDiffProblem<CartPole>{}, settings);
    const Eigen::Vector4d hanging(0.0, 3.14159265358979, 0.0, 0.0);
    solver.reset(hanging);
    EXPECT_EQ(solver.solve(hanging).status, SolveStatus::converged) << memory;
    EXPECT_LT(solver.report().iterations, 400) << memory;
  }
}

}  // namespace stall_test
}  // namespace tilt_ropter::optimal_control
