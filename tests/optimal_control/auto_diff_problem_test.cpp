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

#include <cmath>
#include <limits>
#include <string>
#include <type_traits>

namespace tilt_ropter {
namespace {

using test_support::heap_use;
using test_support::HeapUse;
using test_support::HeapUser;
using test_support::patient;
using test_support::Random;

template <typename S, int Size>
using Vector = Eigen::Matrix<S, Size, 1>;
using Number = Eigen::Matrix<double, 1, 1>;

constexpr double infinity = std::numeric_limits<double>::infinity();

// The functions of a test problem, without the derivatives that it has by hand.
template <typename Model>
struct Functions {
  static constexpr int states = Model::states, inputs = Model::inputs, rows = Model::rows,
                       residuals = Model::residuals;
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
  Vector<S, rows> constraints(int k, const Vector<S, states>& x, const Vector<S, inputs>& u) const {
    return model.template rows_of<S>(k, x, u);
  }
  Vector<double, rows> lower(int k) const { return bounds(k).lower; }
  Vector<double, rows> upper(int k) const { return bounds(k).upper; }
  Vector<double, rows> penalty(int k) const { return bounds(k).penalty; }

  struct Bounds {
    Vector<double, rows> lower, upper, penalty;
  };
  Bounds bounds(int k) const {
    Bounds b;
    model.row_bounds(k, b.lower, b.upper, b.penalty);
    return b;
  }
};

template <typename Derived, typename Truth>
void expect_equal(const Eigen::MatrixBase<Derived>& value, const Truth& truth) {
  EXPECT_LT((value - truth).cwiseAbs().maxCoeff(), 1e-12 * (1.0 + truth.cwiseAbs().maxCoeff()));
}

// All that the two problems return at node k.
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
  typename D::RowsX C, true_C = D::RowsX::Zero();
  typename D::RowsU E, true_E = D::RowsU::Zero();
  problem.row_derivatives(k, x, u, C, E);
  by_hand.row_derivatives(k, x, u, true_C, true_E);
  expect_equal(C, true_C);
  expect_equal(E, true_E);
  if (k < by_hand.horizon()) expect_equal(problem.row_values(k, x, u), by_hand.row_values(k, x, u));
  EXPECT_EQ(problem.lower(k), by_hand.lower(k));
  EXPECT_EQ(problem.upper(k), by_hand.upper(k));
  EXPECT_EQ(problem.penalty(k), by_hand.penalty(k));
}

TEST(AutoDiffProblem, HasTheDerivativesThatOneWouldWriteByHand) {
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

TEST(AutoDiffProblem, HasTheSameSolutionAsTheProblemByHand) {
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
  EXPECT_GT(by_hand.report().active_rows, 0);
  EXPECT_NEAR(solver.report().cost, by_hand.report().cost, 1e-9 * by_hand.report().cost);
  for (int k = 0; k < model.intervals; ++k)
    EXPECT_NEAR(solver.input(k)(0), by_hand.input(k)(0), 1e-6) << "node " << k;
}

// A mass of 1 kg on a line, in steps of one second: position and velocity, pushed by a force.
struct Cart {
  static constexpr int states = 2, inputs = 1, residuals = 3;
  int intervals = 10;
  Eigen::Vector2d target{0.0, 0.0};

  int horizon() const { return intervals; }
  template <typename S>
  static Vector<S, 2> step(int, const Vector<S, 2>& x, const Vector<S, 1>& u) {
    return {x(0) + x(1) + S(0.5) * u(0), x(1) + u(0)};
  }
  template <typename S>
  Vector<S, 3> residual(int, const Vector<S, 2>& x, const Vector<S, 1>& u) const {
    return {x(0) - S(target(0)), x(1) - S(target(1)), S(2.0) * u(0)};
  }
};

const Eigen::Vector2d away(5.0, 1.0);

template <typename User>
MultipleShooting<AutoDiffProblem<User>> solved(const User& user,
                                               SolveStatus status = SolveStatus::converged) {
  MultipleShooting<AutoDiffProblem<User>> solver(AutoDiffProblem<User>(user), patient());
  solver.reset(away);
  EXPECT_EQ(solver.solve(away).status, status);
  for (int k = 0; k <= solver.horizon(); ++k) {
    const auto errors = check_derivatives(solver.problem(), solver.state(k), solver.input(k));
    EXPECT_TRUE(errors.empty()) << to_string(errors.front());
  }
  return solver;
}

TEST(AutoDiffProblem, NeedsNoConstraints) {
  using Problem = AutoDiffProblem<Cart>;
  EXPECT_EQ(Problem::rows, 0);
  EXPECT_EQ(ProblemRows<Problem>::count, 0);
  const auto solver = solved(Cart());
  EXPECT_EQ(solver.report().active_rows, 0);
  EXPECT_LT(solver.state(10).norm(), 0.3);
  EXPECT_LT(solver.input(0)(0), -1.0);
}

struct BoundedCart : Cart {
  static constexpr int rows = 1;
  double limit = 0.8;
  template <typename S>
  static Vector<S, 1> constraints(int, const Vector<S, 2>&, const Vector<S, 1>& u) {
    return u;
  }
  Number lower(int) const { return Number(-limit); }
  Number upper(int) const { return Number(limit); }
};

TEST(AutoDiffProblem, ConstraintsWithoutAPenaltyAreHard) {
  const auto solver = solved(BoundedCart());
  EXPECT_EQ(solver.problem().penalty(0)(0), infinity);
  EXPECT_NEAR(solver.input(0)(0), -0.8, 1e-9);
  EXPECT_LT(solver.row_multipliers(0)(0), -0.1);
}

struct Soft : BoundedCart {
  double price = 0.0;
  Number penalty(int k) const { return Number(k == 0 ? price : infinity); }
};

TEST(AutoDiffProblem, APenaltyIsThePriceOfAViolation) {
  const double multiplier = -solved(BoundedCart()).row_multipliers(0)(0);
  Soft soft;
  soft.price = 0.5 * multiplier;
  const auto solver = solved(soft);
  EXPECT_LT(solver.input(0)(0), -0.85);
  EXPECT_TRUE(solver.given_up(0, 0));
  EXPECT_NEAR(solver.row_multipliers(0)(0), -soft.price, 1e-6);
  soft.price = 2.0 * multiplier;
  EXPECT_NEAR(solved(soft).input(0)(0), -0.8, 1e-9);
}

struct Springy : BoundedCart {
  Number quadratic_penalty(int) const { return Number(3.0); }
};

TEST(AutoDiffProblem, AQuadraticPenaltyIsPassedOn) {
  const auto solver = solved(Springy());
  const double violation = -solver.input(0)(0) - 0.8;
  EXPECT_GT(violation, 0.01);
  EXPECT_NEAR(solver.row_multipliers(0)(0), -3.0 * violation, 1e-5);
}

struct Arriving : BoundedCart {
  static constexpr int terminal_rows = 2;
  template <typename S>
  Vector<S, 2> terminal_constraints(const Vector<S, 2>& x) const {
    return {x(0) * x(0) + x(1), x(1)};
  }
  Eigen::Vector2d terminal_lower() const { return {4.0, 0.5}; }
  Eigen::Vector2d terminal_upper() const { return {4.0, 0.5}; }
};

TEST(AutoDiffProblem, TerminalConstraintsWithEqualBoundsAreEqualities) {
  const auto solver = solved(Arriving());
  EXPECT_EQ(solver.problem().terminal_penalty(), Eigen::Vector2d::Constant(infinity));
  EXPECT_NEAR(solver.state(10)(0) * solver.state(10)(0), 3.5, 1e-6);
  EXPECT_NEAR(solver.state(10)(1), 0.5, 1e-6);
  for (int k = 0; k < 10; ++k) EXPECT_LT(std::abs(solver.input(k)(0)), 0.8 + 1e-6);
  Eigen::Matrix2d C;
  solver.problem().terminal_row_derivatives({3.0, 2.0}, C);
  EXPECT_EQ(C, (Eigen::Matrix2d() << 6.0, 1.0, 0.0, 1.0).finished());
}

struct Tempted : Cart {
  static constexpr int terminal_rows = 1;
  double price = infinity, stiffness = infinity;
  template <typename S>
  Vector<S, 1> terminal_constraints(const Vector<S, 2>& x) const {
    return x.template head<1>();
  }
  Number terminal_lower() const { return Number(3.0); }
  Number terminal_upper() const { return Number(infinity); }
  Number terminal_penalty() const { return Number(price); }
  Number terminal_quadratic_penalty() const { return Number(stiffness); }
};

TEST(AutoDiffProblem, TerminalPenaltiesArePassedOn) {
  Tempted cart;
  const auto hard = solved(cart);
  EXPECT_NEAR(hard.state(10)(0), 3.0, 1e-6);
  const double multiplier = -hard.row_multipliers(10)(0);
  cart.price = 0.5 * multiplier;
  EXPECT_LT(solved(cart).state(10)(0), 2.9);
  cart.price = infinity;
  cart.stiffness = multiplier;
  const auto springy = solved(cart);
  EXPECT_LT(springy.state(10)(0), 2.9);
  EXPECT_NEAR(-springy.row_multipliers(10)(0), multiplier * (3.0 - springy.state(10)(0)), 1e-5);
}

// |u| >= 0.1, squared: as a function of the input it has no derivative where that is zero.
struct RestlessCart : Cart {
  static constexpr int rows = 2;
  template <typename S>
  Vector<S, 2> constraints(int, const Vector<S, 2>& x, const Vector<S, 1>& u) const {
    return {u(0) * u(0), x(0)};
  }
  Eigen::Vector2d lower(int) const { return {0.01, 0.5}; }
  Eigen::Vector2d upper(int) const { return {infinity, infinity}; }
};

TEST(AutoDiffProblem, OfTheConstraintsThoseOnTheStateAloneHoldAtTheLastNode) {
  const AutoDiffProblem problem{RestlessCart()};
  Eigen::Matrix2d C;
  Eigen::Vector2d E;
  problem.row_derivatives(10, away, Number(0.0), C, E);
  EXPECT_NE(E(0), 0.0);
  EXPECT_EQ(E(1), 0.0);
  EXPECT_EQ(C, (Eigen::Matrix2d() << 0.0, 0.0, 1.0, 0.0).finished());
  const Eigen::Vector2d values = problem.row_values(10, away, Number(0.0));
  EXPECT_EQ(values(1), 5.0);
  EXPECT_EQ(values, problem.row_values(10, away, Number(7.0)));

  MultipleShooting solver(problem, patient());
  for (int k = 0; k <= 10; ++k) solver.set_guess(k, away, Number(-0.3));
  EXPECT_EQ(solver.solve(away).status, SolveStatus::converged);
  EXPECT_NEAR(solver.state(10)(0), 0.5, 1e-6);
  EXPECT_GT(solver.row_multipliers(10).cwiseAbs()(1), 1e-3);
  for (int k = 0; k < 10; ++k) EXPECT_GT(std::abs(solver.input(k)(0)), 0.1 - 1e-6);
}

struct FreeEnd : RestlessCart {
  static constexpr int terminal_rows = 0;
};

TEST(AutoDiffProblem, NoTerminalRowsFreeTheLastNode) {
  MultipleShooting solver(AutoDiffProblem{FreeEnd()}, patient());
  for (int k = 0; k <= 10; ++k) solver.set_guess(k, away, Number(-0.3));
  EXPECT_EQ(solver.solve(away).status, SolveStatus::converged);
  EXPECT_NEAR(solver.state(9)(0), 0.5, 1e-6);
  EXPECT_LT(solver.state(10)(0), 0.5 - 1e-3);
  EXPECT_TRUE(check_derivatives(solver.problem(), solver.state(5), solver.input(5)).empty());
}

struct Ending : BoundedCart {
  static constexpr int terminal_residuals = 2;
  double weight = 1.0;
  template <typename S>
  Vector<S, 2> terminal_residual(const Vector<S, 2>& x) const {
    return S(weight) * x;
  }
};

TEST(AutoDiffProblem, ATerminalResidualTakesThePlaceOfTheOther) {
  Ending ending;
  const auto same = solved(ending);
  const auto plain = solved(BoundedCart());
  EXPECT_NE(same.report().cost, 0.0);
  // No derivative by the input is left at the end, nor any part of the cost.
  for (int k = 0; k < 10; ++k) EXPECT_NEAR(same.input(k)(0), plain.input(k)(0), 1e-9);
  EXPECT_NEAR(same.report().cost, plain.report().cost, 1e-9);
  ending.weight = 30.0;
  EXPECT_LT(solved(ending).state(10).norm(), 0.1 * plain.state(10).norm());

  const AutoDiffProblem problem(ending);
  EXPECT_DOUBLE_EQ(problem.cost(10, away, Number(7.0)), 900.0 * away.squaredNorm());
  QuadraticModel<2, 1> model;
  problem.cost_model(10, away, Number(7.0), model);
  EXPECT_EQ(model.lx(), Eigen::Vector2d(1800.0 * away));
  EXPECT_EQ(model.lxx(), Eigen::Matrix2d(1800.0 * Eigen::Matrix2d::Identity()));
  EXPECT_EQ(model.lu()(0), 0.0);
  EXPECT_EQ(model.luu()(0, 0), 0.0);
}

struct CoupledCart : Cart {
  template <typename S>
  static Vector<S, 3> residual(int, const Vector<S, 2>& x, const Vector<S, 1>& u) {
    return {x(0) + u(0) * x(1), x(1), S(2.0) * u(0)};
  }
};

TEST(AutoDiffProblem, WithoutATerminalResidualTheInputOfTheLastNodeIsZero) {
  const AutoDiffProblem problem{CoupledCart()};
  EXPECT_DOUBLE_EQ(problem.cost(9, away, Number(7.0)), 144.0 + 1.0 + 196.0);
  EXPECT_DOUBLE_EQ(problem.cost(10, away, Number(7.0)), away.squaredNorm());
  QuadraticModel<2, 1> model;
  problem.cost_model(10, away, Number(7.0), model);
  EXPECT_EQ(model.lx(), Eigen::Vector2d(2.0 * away));
  EXPECT_EQ(model.lxx(), Eigen::Matrix2d(2.0 * Eigen::Matrix2d::Identity()));
  EXPECT_EQ(model.lu()(0), 0.0);
  EXPECT_EQ(model.luu()(0, 0), 0.0);
  EXPECT_TRUE(model.lux().isZero(0.0));
}

struct Endless : BoundedCart {
  static constexpr int terminal_residuals = 0;
};

TEST(AutoDiffProblem, NoTerminalResidualsMakeTheLastNodeFree) {
  const AutoDiffProblem problem{Endless()};
  EXPECT_EQ(problem.cost(10, away, Number(7.0)), 0.0);
  QuadraticModel<2, 1> model;
  problem.cost_model(10, away, Number(7.0), model);
  EXPECT_TRUE(model.gradient.isZero(0.0));
  EXPECT_TRUE(model.hessian.isZero(0.0));
  EXPECT_EQ(solved(Endless()).input(9)(0), 0.0);
}

TEST(AutoDiffProblem, TheUsersStructCanBeChangedBetweenSolves) {
  auto solver = solved(BoundedCart());
  solver.problem().user().target << 8.0, 0.0;
  EXPECT_EQ(solver.solve(away).status, SolveStatus::converged);
  EXPECT_LT(std::abs(solver.state(10)(0) - 8.0), 0.3);
  const auto& constant = solver;
  EXPECT_EQ(constant.problem().user().target(0), 8.0);
}

TEST(AutoDiffProblem, OffersWhatTheStructHasAndNoMore) {
  using Plain = ProblemRows<AutoDiffProblem<BoundedCart>>;
  EXPECT_EQ(Plain::of_end, -1);
  EXPECT_EQ(Plain::of_nodes, 1);
  EXPECT_EQ(ProblemRows<AutoDiffProblem<FreeEnd>>::of_end, 0);
  EXPECT_EQ(ProblemRows<AutoDiffProblem<Cart>>::count, 0);
}

// Large enough for Eigen to cut products into blocks.
struct Large {
  static constexpr int states = 18, inputs = 6, residuals = 40, rows = 20, terminal_rows = 18,
                       terminal_residuals = 30;
  using Penalty = Vector<double, rows>;
  using TerminalPenalty = Vector<double, terminal_rows>;

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
  Vector<S, 20> constraints(int, const Vector<S, 18>& x, const Vector<S, 6>& u) const {
    Vector<S, 20> c;
    for (int i = 0; i < 20; ++i) c(i) = i % 2 == 0 ? S(x(i % 18) * x(1)) : u(i % 6);
    return c;
  }
  Penalty lower(int) const { return Penalty::Constant(-0.2); }
  Penalty upper(int) const { return Penalty::Constant(3.0); }
  Penalty penalty(int) const { return Penalty::Constant(10.0); }
  Penalty quadratic_penalty(int) const { return Penalty::Constant(100.0); }
  template <typename S>
  Vector<S, 18> terminal_constraints(const Vector<S, 18>& x) const {
    return S(2.0) * x;
  }
  TerminalPenalty terminal_lower() const { return TerminalPenalty::Constant(-1.0); }
  TerminalPenalty terminal_upper() const { return TerminalPenalty::Constant(1.0); }
  TerminalPenalty terminal_penalty() const { return TerminalPenalty::Constant(1.0); }
  TerminalPenalty terminal_quadratic_penalty() const { return TerminalPenalty::Constant(9.0); }
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
  using Rows = ProblemRows<Problem>;
  const Problem problem;
  const Problem::State x = Problem::State::LinSpaced(-1.0, 1.0);
  const Problem::Input u = Problem::Input::LinSpaced(-0.5, 0.5);
  Problem::D::A A;
  Problem::D::B B;
  Problem::Model model;
  Rows::ByState C = Rows::ByState::Zero();
  Rows::ByInput E = Rows::ByInput::Zero();
  Rows::Values lower, upper, price, stiffness;
  double sum = 0.0;
  const HeapUse before = heap_use(HeapUser::other);
  for (int k = 0; k <= problem.horizon(); ++k) {
    sum += problem.step(k, problem.retract(x, problem.difference(x, x)), u).sum();
    sum += problem.step(k, x, u, A, B).sum() + A.sum() + B.sum();
    problem.cost_model(k, x, u, model);
    Rows::derivatives(problem, k, x, u, C, E);
    Rows::bounds(problem, k, lower, upper, price, stiffness);
    sum += problem.cost(k, x, u) + model.hessian.sum() + C.sum() + E.sum() + lower(0) +
           Rows::values(problem, k, x, u).sum();
  }
  EXPECT_TRUE((heap_use(HeapUser::other) - before).none());
  EXPECT_TRUE(std::isfinite(sum));
  const auto errors = check_derivatives(problem, x, u);
  EXPECT_TRUE(errors.empty()) << to_string(errors.front());
}

TEST(AutoDiffProblem, TheLoopDoesNotAllocate) {
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

}  // namespace
}  // namespace tilt_ropter
