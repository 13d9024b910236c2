// Free initial states and parameters, against closed forms.

#include "support/patient.hpp"

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/free_start.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/LU>

#include <array>

namespace tilt_ropter::optimal_control {
namespace free_start_test {

template <typename S, int Size>
using V = Eigen::Matrix<S, Size, 1>;

/// A mass of 1 kg from rest to rest, one metre further, in the shortest time with at most 1 N. The
/// time is a parameter: a state that never changes. It has to be 2 s.
struct ShortestPhase {
  static constexpr int states = 3, inputs = 1, residuals = 1, constraints = 2,
                       terminal_constraints = 2;
  static constexpr std::array<int, 1> free_states{2};

  int horizon() const { return 20; }
  template <typename S>
  V<S, 3> step(int, const V<S, 3>& x, const V<S, 1>& u) const {
    const S h = x(2) / S(20.0);
    V<S, 3> end;
    end << x(0) + h * x(1) + S(0.5) * h * h * u(0), x(1) + h * u(0), x(2);
    return end;
  }
  template <typename S>
  V<S, 1> residual(int, const V<S, 3>&, const V<S, 1>& u) const {
    return S(1e-3) * u;
  }
  template <typename S>
  S cost(int k, const V<S, 3>& x, const V<S, 1>&) const {
    return S(k == 20 ? 1.0 : 0.0) * x(2);
  }
  template <typename S>
  V<S, 2> constraint_values(int, const V<S, 3>& x, const V<S, 1>& u) const {
    V<S, 2> r;
    r << u(0), x(2);  // no time is negative
    return r;
  }
  V<double, 2> lower(int) const { return V<double, 2>(-1.0, 0.1); }
  V<double, 2> upper(int) const { return V<double, 2>(1.0, 10.0); }
  template <typename S>
  V<S, 2> terminal_constraint_values(const V<S, 3>& x) const {
    V<S, 2> r;
    r << x(0) - S(1.0), x(1);
    return r;
  }
  V<double, 2> terminal_lower() const { return V<double, 2>::Zero(); }
  V<double, 2> terminal_upper() const { return V<double, 2>::Zero(); }
};

TEST(FreeStart, TheTimeOfAPhaseIsAParameter) {
  using Problem = AutoDiffProblem<FreeStart<ShortestPhase>>;
  const Problem problem{FreeStart<ShortestPhase>()};
  ASSERT_EQ(problem.horizon(), 21);
  MultipleShooting<Problem> solver(problem, test_support::patient());
  const Eigen::Vector3d guess(0.0, 0.0, 3.0);
  solver.reset(guess);
  EXPECT_EQ(solver.solve(guess).status, SolveStatus::converged);
  EXPECT_NEAR(solver.state(21)(2), 2.0, 1e-3);
  EXPECT_EQ(solver.state(0), guess);
  EXPECT_NEAR(solver.state(1)(0), 0.0, 1e-9);  // what is not free stays
}

/// A position and a speed that are both unknown, measured at every node. With one input there are
/// two intervals in front.
struct Fit {
  static constexpr int states = 2, inputs = 1, residuals = 2;
  static constexpr std::array<int, 2> free_states{0, 1};
  static double measured(int k) { return 3.0 - 0.5 * k + (k % 2 == 0 ? 0.1 : -0.1); }

  int horizon() const { return 9; }
  template <typename S>
  V<S, 2> step(int, const V<S, 2>& x, const V<S, 1>& u) const {
    V<S, 2> end;
    end << x(0) + x(1), x(1) + u(0);
    return end;
  }
  template <typename S>
  V<S, 2> residual(int k, const V<S, 2>& x, const V<S, 1>& u) const {
    V<S, 2> r;
    r << x(0) - S(measured(k)), S(1e3) * u(0);
    return r;
  }
};

TEST(FreeStart, FitsALineAsLeastSquaresDo) {
  Eigen::Matrix<double, 10, 2> rows;
  Eigen::Matrix<double, 10, 1> values;
  for (int k = 0; k < 10; ++k) {
    rows.row(k) << 1.0, k;
    values(k) = Fit::measured(k);
  }
  const Eigen::Vector2d line =
      Eigen::Matrix2d(rows.transpose() * rows).inverse() * (rows.transpose() * values);
  using Problem = AutoDiffProblem<FreeStart<Fit>>;
  const int in_front = FreeStart<Fit>::in_front;
  EXPECT_EQ(in_front, 2);
  const Eigen::Vector2d guess(0.0, 0.0);
  MultipleShooting<Problem> solver(Problem(), test_support::patient());
  solver.reset(guess);
  EXPECT_EQ(solver.solve(guess).status, SolveStatus::converged);
  EXPECT_LT((solver.state(in_front) - line).norm(), 1e-3);
  SingleShooting<Problem> alone(Problem(), test_support::patient());
  alone.reset(guess);
  EXPECT_EQ(alone.solve(guess).status, SolveStatus::converged);
  EXPECT_LT((alone.state(in_front) - line).norm(), 1e-3);
}

}  // namespace free_start_test
}  // namespace tilt_ropter::optimal_control
