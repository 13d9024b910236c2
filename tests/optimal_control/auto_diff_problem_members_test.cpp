// Members that the struct may have or omit: constraints, penalties, terminal constraints and
// terminal residuals.

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>

#include <tilt_ropter/optimal_control/derivative_check.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/patient.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <limits>

namespace tilt_ropter::optimal_control {
namespace auto_diff_problem_members_test {

using test_support::patient;

template <typename S, int Size>
using Vector = Eigen::Matrix<S, Size, 1>;
using Number = Eigen::Matrix<double, 1, 1>;

constexpr double infinity = std::numeric_limits<double>::infinity();

// A mass of 1 kg on a line, in steps of one second. State: position and velocity. Input: force.
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

TEST(AutoDiffProblem, WorksWithoutConstraints) {
  using Problem = AutoDiffProblem<Cart>;
  EXPECT_EQ(Problem::constraints, 0);
  EXPECT_EQ(ProblemConstraints<Problem>::count, 0);
  const auto solver = solved(Cart());
  EXPECT_EQ(solver.report().active_constraints, 0);
  EXPECT_LT(solver.state(10).norm(), 0.3);
  EXPECT_LT(solver.input(0)(0), -1.0);
}

struct BoundedCart : Cart {
  static constexpr int constraints = 1;
  double limit = 0.8;
  template <typename S>
  static Vector<S, 1> constraint_values(int, const Vector<S, 2>&, const Vector<S, 1>& u) {
    return u;
  }
  Number lower(int) const { return Number(-limit); }
  Number upper(int) const { return Number(limit); }
};

TEST(AutoDiffProblem, ConstraintsWithoutAPenaltyAreHard) {
  const auto solver = solved(BoundedCart());
  EXPECT_EQ(solver.problem().penalty(0)(0), infinity);
  EXPECT_NEAR(solver.input(0)(0), -0.8, 1e-9);
  EXPECT_LT(solver.constraint_multipliers(0)(0), -0.1);
}

struct Soft : BoundedCart {
  double first_penalty = 0.0;
  Number penalty(int k) const { return Number(k == 0 ? first_penalty : infinity); }
};

TEST(AutoDiffProblem, PenaltyIsThePriceOfAViolation) {
  const double multiplier = -solved(BoundedCart()).constraint_multipliers(0)(0);
  Soft soft;
  soft.first_penalty = 0.5 * multiplier;
  const auto solver = solved(soft);
  EXPECT_LT(solver.input(0)(0), -0.85);
  EXPECT_TRUE(solver.relaxed(0, 0));
  EXPECT_NEAR(solver.constraint_multipliers(0)(0), -soft.first_penalty, 1e-6);
  soft.first_penalty = 2.0 * multiplier;
  EXPECT_NEAR(solved(soft).input(0)(0), -0.8, 1e-9);
}

struct Springy : BoundedCart {
  Number stiffness(int) const { return Number(3.0); }
};

TEST(AutoDiffProblem, QuadraticPenaltyReachesTheSolver) {
  const auto solver = solved(Springy());
  const double violation = -solver.input(0)(0) - 0.8;
  EXPECT_GT(violation, 0.01);
  EXPECT_NEAR(solver.constraint_multipliers(0)(0), -3.0 * violation, 1e-5);
}

struct Arriving : BoundedCart {
  static constexpr int terminal_constraints = 2;
  template <typename S>
  Vector<S, 2> terminal_constraint_values(const Vector<S, 2>& x) const {
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
  solver.problem().terminal_constraint_derivatives({3.0, 2.0}, C);
  EXPECT_EQ(C, (Eigen::Matrix2d() << 6.0, 1.0, 0.0, 1.0).finished());
}

struct Tempted : Cart {
  static constexpr int terminal_constraints = 1;
  double most = infinity, per_unit = infinity;
  template <typename S>
  Vector<S, 1> terminal_constraint_values(const Vector<S, 2>& x) const {
    return x.template head<1>();
  }
  Number terminal_lower() const { return Number(3.0); }
  Number terminal_upper() const { return Number(infinity); }
  Number terminal_penalty() const { return Number(most); }
  Number terminal_stiffness() const { return Number(per_unit); }
};

TEST(AutoDiffProblem, TerminalPenaltiesReachTheSolver) {
  Tempted cart;
  const auto hard = solved(cart);
  EXPECT_NEAR(hard.state(10)(0), 3.0, 1e-6);
  const double multiplier = -hard.constraint_multipliers(10)(0);
  cart.most = 0.5 * multiplier;
  EXPECT_LT(solved(cart).state(10)(0), 2.9);
  cart.most = infinity;
  cart.per_unit = multiplier;
  const auto springy = solved(cart);
  EXPECT_LT(springy.state(10)(0), 2.9);
  EXPECT_NEAR(-springy.constraint_multipliers(10)(0), multiplier * (3.0 - springy.state(10)(0)),
              1e-5);
}

// Constraint |u| >= 0.1 in squared form. Its derivative with respect to u is zero at u = 0.
struct RestlessCart : Cart {
  static constexpr int constraints = 2;
  template <typename S>
  Vector<S, 2> constraint_values(int, const Vector<S, 2>& x, const Vector<S, 1>& u) const {
    return {u(0) * u(0), x(0)};
  }
  Eigen::Vector2d lower(int) const { return {0.01, 0.5}; }
  Eigen::Vector2d upper(int) const { return {infinity, infinity}; }
};

TEST(AutoDiffProblem, LastNodeHasOnlyConstraintsOnTheState) {
  const AutoDiffProblem problem{RestlessCart()};
  Eigen::Matrix2d C;
  Eigen::Vector2d E;
  problem.constraint_derivatives(10, away, Number(0.0), C, E);
  EXPECT_NE(E(0), 0.0);
  EXPECT_EQ(E(1), 0.0);
  EXPECT_EQ(C, (Eigen::Matrix2d() << 0.0, 0.0, 1.0, 0.0).finished());
  const Eigen::Vector2d values = problem.constraint_values(10, away, Number(0.0));
  EXPECT_EQ(values(1), 5.0);
  EXPECT_EQ(values, problem.constraint_values(10, away, Number(7.0)));

  MultipleShooting solver(problem, patient());
  for (int k = 0; k <= 10; ++k) solver.set_guess(k, away, Number(-0.3));
  EXPECT_EQ(solver.solve(away).status, SolveStatus::converged);
  EXPECT_NEAR(solver.state(10)(0), 0.5, 1e-6);
  EXPECT_GT(solver.constraint_multipliers(10).cwiseAbs()(1), 1e-3);
  for (int k = 0; k < 10; ++k) EXPECT_GT(std::abs(solver.input(k)(0)), 0.1 - 1e-6);
}

struct FreeEnd : RestlessCart {
  static constexpr int terminal_constraints = 0;
};

TEST(AutoDiffProblem, NoTerminalConstraintsFreeTheLastNode) {
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

TEST(AutoDiffProblem, TerminalResidualReplacesTheResidualAtTheLastNode) {
  Ending ending;
  const auto same = solved(ending);
  const auto plain = solved(BoundedCart());
  EXPECT_NE(same.report().cost, 0.0);
  // The input at the last node has no derivative and no part of the cost.
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

TEST(AutoDiffProblem, WithoutTerminalResidualTheLastInputCountsAsZero) {
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

TEST(AutoDiffProblem, NoTerminalResidualsGiveNoTerminalCost) {
  const AutoDiffProblem problem{Endless()};
  EXPECT_EQ(problem.cost(10, away, Number(7.0)), 0.0);
  QuadraticModel<2, 1> model;
  problem.cost_model(10, away, Number(7.0), model);
  EXPECT_TRUE(model.gradient.isZero(0.0));
  EXPECT_TRUE(model.hessian.isZero(0.0));
  EXPECT_EQ(solved(Endless()).input(9)(0), 0.0);
}

TEST(AutoDiffProblem, UserStructCanChangeBetweenSolves) {
  auto solver = solved(BoundedCart());
  solver.problem().user().target << 8.0, 0.0;
  EXPECT_EQ(solver.solve(away).status, SolveStatus::converged);
  EXPECT_LT(std::abs(solver.state(10)(0) - 8.0), 0.3);
  const auto& constant = solver;
  EXPECT_EQ(constant.problem().user().target(0), 8.0);
}

TEST(AutoDiffProblem, OffersOnlyTheConstraintsOfTheStruct) {
  using Plain = ProblemConstraints<AutoDiffProblem<BoundedCart>>;
  EXPECT_EQ(Plain::of_end, -1);
  EXPECT_EQ(Plain::of_nodes, 1);
  EXPECT_EQ(ProblemConstraints<AutoDiffProblem<FreeEnd>>::of_end, 0);
  EXPECT_EQ(ProblemConstraints<AutoDiffProblem<Cart>>::count, 0);
}

}  // namespace auto_diff_problem_members_test
}  // namespace tilt_ropter::optimal_control
