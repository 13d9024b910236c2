// Derivatives and solutions equal those of problems derived by hand, without the heap.
// CTest: alone

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>

#include <tilt_ropter/optimal_control/derivative_check.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/allocation_counter.hpp"
#include "support/full_run.hpp"
#include "support/patient.hpp"
#include "support/pendulum.hpp"
#include "support/random.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>

namespace tilt_ropter::optimal_control {
namespace auto_diff_problem_test {

using test_support::heap_use;
using test_support::HeapUse;
using test_support::HeapUser;
using test_support::patient;
using test_support::Random;

template <typename S, int Size>
using Vector = Eigen::Matrix<S, Size, 1>;

// The functions of a test problem, without its hand-written derivatives.
template <typename Model>
struct Functions {
  static constexpr int states = Model::states, inputs = Model::inputs,
                       constraints = Model::constraints, residuals = Model::residuals;
  Model model;

  int horizon() const { return model.intervals; }
  template <typename S>
  Vector<S, states> step(int k, const Vector<S, states>& x, const Vector<S, inputs>& u) const {
    return model.template flow<S>(k, x, u);
  }
  template <typename S>
  Vector<S, residuals> residual(int k, const Vector<S, states>& x,
                                const Vector<S, inputs>& u) const {
    return model.template residual<S>(k, x, u);
  }
  template <typename S>
  Vector<S, constraints> constraint_values(int k, const Vector<S, states>& x,
                                           const Vector<S, inputs>& u) const {
    return model.template constraints_of<S>(k, x, u);
  }
  Vector<double, constraints> lower(int k) const { return bounds(k).lower; }
  Vector<double, constraints> upper(int k) const { return bounds(k).upper; }
  Vector<double, constraints> penalty(int k) const { return bounds(k).penalty; }

  struct Bounds {
    Vector<double, constraints> lower, upper, penalty;
  };
  Bounds bounds(int k) const {
    Bounds b;
    model.constraint_bounds(k, b.lower, b.upper, b.penalty);
    return b;
  }
};

template <typename Derived, typename Truth>
void expect_equal(const Eigen::MatrixBase<Derived>& value, const Truth& truth) {
  EXPECT_LT((value - truth).cwiseAbs().maxCoeff(), 1e-12 * (1.0 + truth.cwiseAbs().maxCoeff()));
}

// Compares all results of the two problems at node k.
template <typename Model>
void expect_same(const AutoDiffProblem<Functions<Model>>& problem,
                 const test_support::TestProblem<Model>& by_hand, int k,
                 const Vector<double, Model::states>& x, Vector<double, Model::inputs> u) {
  using D = ProblemDimensions<Model>;
  if (k == by_hand.horizon()) {
    u.setZero();
  } else {
    typename D::A A, true_A;
    typename D::B B, true_B;
    expect_equal(problem.step(k, x, u, A, B), by_hand.step(k, x, u, true_A, true_B));
    expect_equal(problem.step(k, x, u), by_hand.step(k, x, u));
    expect_equal(A, true_A);
    expect_equal(B, true_B);
  }
  EXPECT_DOUBLE_EQ(problem.cost(k, x, u), by_hand.cost(k, x, u));
  QuadraticModel<D::nx, D::nu> model, truth;
  problem.cost_model(k, x, u, model);
  by_hand.cost_model(k, x, u, truth);
  expect_equal(model.lx(), truth.lx());
  expect_equal(model.lxx(), truth.lxx());
  if (k < by_hand.horizon()) {
    expect_equal(model.gradient, truth.gradient);
    expect_equal(model.hessian, truth.hessian);
  }
  typename D::ConstraintsX C, true_C = D::ConstraintsX::Zero();
  typename D::ConstraintsU E, true_E = D::ConstraintsU::Zero();
  problem.constraint_derivatives(k, x, u, C, E);
  by_hand.constraint_derivatives(k, x, u, true_C, true_E);
  expect_equal(C, true_C);
  expect_equal(E, true_E);
  if (k < by_hand.horizon())
    expect_equal(problem.constraint_values(k, x, u), by_hand.constraint_values(k, x, u));
  EXPECT_EQ(problem.lower(k), by_hand.lower(k));
  EXPECT_EQ(problem.upper(k), by_hand.upper(k));
  EXPECT_EQ(problem.penalty(k), by_hand.penalty(k));
}

TEST(AutoDiffProblem, DerivativesMatchHandWrittenOnes) {
  using test_support::PendulumModel;
  using test_support::UnicycleModel;
  Random random(95);
  for (int i = 0; i < test_support::quick_or_full(200, 10000); ++i) {
    const int k = i % 2 == 0 ? 1 : 5;
    const Eigen::Vector3d x = random.vector(3.0), u = random.vector(3.0);
    expect_same(AutoDiffProblem(Functions<PendulumModel>{{5}}), test_support::Pendulum({5}), k,
                x.head<2>(), u.head<1>());
    expect_same(AutoDiffProblem(Functions<UnicycleModel>{{5}}), test_support::Unicycle({5}), k, x,
                u.head<2>());
  }
}

TEST(AutoDiffProblem, SolutionMatchesTheHandWrittenProblem) {
  test_support::PendulumModel model;
  model.intervals = 20;
  MultipleShooting by_hand(test_support::Pendulum(model), patient());
  MultipleShooting solver(AutoDiffProblem(Functions<test_support::PendulumModel>{model}),
                          patient());
  const Eigen::Vector2d hanging(3.14, 0.0);
  by_hand.reset(hanging);
  solver.reset(hanging);
  ASSERT_EQ(by_hand.solve(hanging).status, SolveStatus::converged);
  ASSERT_EQ(solver.solve(hanging).status, SolveStatus::converged);
  EXPECT_GT(by_hand.report().active_constraints, 0);
  EXPECT_NEAR(solver.report().cost, by_hand.report().cost, 1e-9 * by_hand.report().cost);
  for (int k = 0; k < model.intervals; ++k)
    EXPECT_NEAR(solver.input(k)(0), by_hand.input(k)(0), 1e-6) << "node " << k;
}

// Large enough that Eigen splits products into blocks.
struct Large {
  static constexpr int states = 18, inputs = 6, residuals = 40, constraints = 20,
                       terminal_constraints = 18, terminal_residuals = 30;
  using Penalty = Vector<double, constraints>;
  using TerminalPenalty = Vector<double, terminal_constraints>;

  int horizon() const { return 5; }
  template <typename S>
  Vector<S, 18> step(int, const Vector<S, 18>& x, const Vector<S, 6>& u) const {
    using std::sin;
    Vector<S, 18> end = x;
    for (int i = 0; i < 18; ++i) end(i) += S(0.1) * sin(x((i + 1) % 18)) + S(0.2) * u(i % 6);
    return end;
  }
  template <typename S>
  Vector<S, 40> residual(int, const Vector<S, 18>& x, const Vector<S, 6>& u) const {
    Vector<S, 40> r;
    for (int i = 0; i < 40; ++i) r(i) = x(i % 18) + u(i % 6) * u(i % 6);
    return r;
  }
  template <typename S>
  Vector<S, 20> constraint_values(int, const Vector<S, 18>& x, const Vector<S, 6>& u) const {
    Vector<S, 20> c;
    for (int i = 0; i < 20; ++i) c(i) = i % 2 == 0 ? S(x(i % 18) * x(1)) : u(i % 6);
    return c;
  }
  Penalty lower(int) const { return Penalty::Constant(-0.2); }
  Penalty upper(int) const { return Penalty::Constant(3.0); }
  Penalty penalty(int) const { return Penalty::Constant(10.0); }
  Penalty stiffness(int) const { return Penalty::Constant(100.0); }
  template <typename S>
  Vector<S, 18> terminal_constraint_values(const Vector<S, 18>& x) const {
    return S(2.0) * x;
  }
  TerminalPenalty terminal_lower() const { return TerminalPenalty::Constant(-1.0); }
  TerminalPenalty terminal_upper() const { return TerminalPenalty::Constant(1.0); }
  TerminalPenalty terminal_penalty() const { return TerminalPenalty::Constant(1.0); }
  TerminalPenalty terminal_stiffness() const { return TerminalPenalty::Constant(9.0); }
  template <typename S>
  Vector<S, 30> terminal_residual(const Vector<S, 18>& x) const {
    Vector<S, 30> r;
    for (int i = 0; i < 30; ++i) r(i) = x(i % 18) * x(i % 18);
    return r;
  }
};

TEST(AutoDiffProblem, NeverAllocates) {
  if (!test_support::heap_can_be_counted)
    GTEST_SKIP() << "a sanitizer or another C library has the heap: it cannot be counted";
  using Problem = AutoDiffProblem<Large>;
  using Constraints = ProblemConstraints<Problem>;
  const Problem problem;
  const Problem::State x = Problem::State::LinSpaced(-1.0, 1.0);
  const Problem::Input u = Problem::Input::LinSpaced(-0.5, 0.5);
  Problem::D::A A;
  Problem::D::B B;
  Problem::Model model;
  Constraints::ByState C = Constraints::ByState::Zero();
  Constraints::ByInput E = Constraints::ByInput::Zero();
  Constraints::Values lower, upper, penalty, stiffness;
  double sum = 0.0;
  const HeapUse before = heap_use(HeapUser::other);
  for (int k = 0; k <= problem.horizon(); ++k) {
    sum += problem.step(k, problem.retract(x, problem.difference(x, x)), u).sum();
    sum += problem.step(k, x, u, A, B).sum() + A.sum() + B.sum();
    problem.cost_model(k, x, u, model);
    Constraints::derivatives(problem, k, x, u, C, E);
    Constraints::bounds(problem, k, lower, upper, penalty, stiffness);
    sum += problem.cost(k, x, u) + model.hessian.sum() + C.sum() + E.sum() + lower(0) +
           Constraints::values(problem, k, x, u).sum();
  }
  EXPECT_TRUE((heap_use(HeapUser::other) - before).none());
  EXPECT_TRUE(std::isfinite(sum));
  const auto errors = check_derivatives(problem, x, u);
  EXPECT_TRUE(errors.empty()) << to_string(errors.front());
}

TEST(AutoDiffProblem, SolverLoopDoesNotAllocate) {
  if (!test_support::heap_can_be_counted)
    GTEST_SKIP() << "a sanitizer or another C library has the heap: it cannot be counted";
  MultipleShooting solver{AutoDiffProblem<Functions<test_support::PendulumModel>>()};
  const Eigen::Vector2d hanging(3.0, 0.0);
  solver.reset(hanging);
  for (int i = 0; i < 20; ++i) {
    const HeapUse before = heap_use(HeapUser::other);
    solver.shift(1.0);
    const bool prepared = solver.prepare() == PrepareStatus::prepared;
    solver.feedback(hanging);
    const HeapUse use = heap_use(HeapUser::other) - before;
    EXPECT_TRUE(prepared);
    EXPECT_TRUE(use.none() || i < 5) << "iteration " << i;
  }
}

}  // namespace auto_diff_problem_test
}  // namespace tilt_ropter::optimal_control
