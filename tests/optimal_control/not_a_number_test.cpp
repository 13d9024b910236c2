// Non-finite values from every function of a problem, at any node (check 22).

#include "support/patient.hpp"

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <limits>
#include <string>

namespace tilt_ropter::optimal_control {
namespace not_a_number_test {

enum class Output {
  none,
  step,
  A,
  B,
  cost,
  lx,
  lu,
  lxx,
  lux,
  luu,
  value,
  C,
  E,
  lower,
  upper,
  penalty,
  stiffness,
  equality,
  H,
  weight,
  terminal_value,
  terminal_C,
  terminal_lower,
  terminal_upper,
  terminal_penalty,
  difference,
  count
};

/// A mass on a line, with all functions that a problem can have. One output at one node can be
/// replaced by `number`.
struct Spoilt {
  static constexpr int states = 2, inputs = 1, constraints = 2, equalities = 1,
                       terminal_constraints = 1;
  using State = Eigen::Vector2d;
  using D = ProblemDimensions<Spoilt>;
  using TerminalConstraint = Eigen::Matrix<double, 1, 1>;

  Output output = Output::none;
  int node = 0;
  double number = 0.0;

  template <typename Value>
  void spoil(Output which, int k, Value&& value) const {
    if (output == which && k == node) value(0) = number;
  }
  template <typename Value>
  Value spoilt(Output which, int k, Value value) const {
    spoil(which, k, value);
    return value;
  }

  int horizon() const { return 10; }
  State retract(const State& x, const State& dx) const { return x + dx; }
  State difference(const State& y, const State& x) const {
    return spoilt(Output::difference, node, State(y - x));
  }
  State step(int k, const State& x, const D::Input& u) const {
    return spoilt(Output::step, k, State(x(0) + 0.1 * x(1), x(1) + 0.1 * u(0)));
  }
  State step(int k, const State& x, const D::Input& u, D::A& A, D::B& B) const {
    A << 1.0, 0.1, 0.0, 1.0;
    B << 0.0, 0.1;
    if (output == Output::A && k == node) A(0, 1) = number;
    if (output == Output::B && k == node) B(1) = number;
    return step(k, x, u);
  }
  double cost(int k, const State& x, const D::Input& u) const {
    if (output == Output::cost && k == node) return number;
    return x.squaredNorm() + 0.1 * u.squaredNorm();
  }
  void cost_model(int k, const State& x, const D::Input& u, QuadraticModel<2, 1>& m) const {
    m.lx() = spoilt(Output::lx, k, State(2.0 * x));
    Eigen::Matrix2d lxx = 2.0 * Eigen::Matrix2d::Identity();
    if (output == Output::lxx && k == node) lxx(1, 1) = number;
    m.lxx() = lxx;
    m.lu() = spoilt(Output::lu, k, D::Input(0.2 * u));
    m.luu() = spoilt(Output::luu, k, D::Input(D::Input::Constant(0.2)));
    m.lux() = spoilt(Output::lux, k, Eigen::RowVector2d(0.0, 0.0));
  }
  D::Constraints constraint_values(int k, const State& x, const D::Input& u) const {
    return spoilt(Output::value, k, D::Constraints(u(0), x(1)));
  }
  void constraint_derivatives(int k, const State&, const D::Input&, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    C << 0.0, 0.0, 0.0, 1.0;
    E << 1.0, 0.0;
    if (output == Output::C && k == node) C(1, 1) = number;
    if (output == Output::E && k == node) E(0, 0) = number;
  }
  D::Constraints lower(int k) const { return spoilt(Output::lower, k, D::Constraints(-2.0, -0.5)); }
  D::Constraints upper(int k) const { return spoilt(Output::upper, k, D::Constraints(2.0, 0.5)); }
  D::Constraints penalty(int k) const {
    return spoilt(Output::penalty, k, D::Constraints(1e9, 1e3));
  }
  D::Constraints stiffness(int k) const {
    return spoilt(Output::stiffness, k, D::Constraints(1e5, 1e5));
  }
  D::Equalities equality_values(int k, const State& x) const {
    return spoilt(Output::equality, k, D::Equalities(x(1)));
  }
  void equality_derivatives(int k, const State&, D::EqualitiesX& H) const {
    H << 0.0, 1.0;
    if (output == Output::H && k == node) H(0, 1) = number;
  }
  D::Equalities equality_weights(int k) const {
    return spoilt(Output::weight, k, D::Equalities(k == horizon() ? 10.0 : 0.0));
  }
  TerminalConstraint terminal_constraint_values(const State& x) const {
    return spoilt(Output::terminal_value, horizon(), TerminalConstraint(x(0)));
  }
  void terminal_constraint_derivatives(const State&, Eigen::Matrix<double, 1, 2>& C) const {
    C << 1.0, 0.0;
    spoil(Output::terminal_C, horizon(), C);
  }
  TerminalConstraint terminal_lower() const {
    return spoilt(Output::terminal_lower, horizon(), TerminalConstraint(-0.6));
  }
  TerminalConstraint terminal_upper() const {
    return spoilt(Output::terminal_upper, horizon(), TerminalConstraint(0.6));
  }
  TerminalConstraint terminal_penalty() const {
    return spoilt(Output::terminal_penalty, horizon(), TerminalConstraint(1e3));
  }
};

using Solver = MultipleShooting<Spoilt>;

bool finite_plan(const Solver& solver) {
  bool finite = true;
  for (int k = 0; k <= solver.horizon(); ++k) {
    finite = finite && all_finite(solver.state(k));
    if (k < solver.horizon()) finite = finite && all_finite(solver.input(k));
  }
  return finite;
}

// Returns true if the value is not used at this node, or if the infinity is valid: no bound, or a
// hard constraint.
bool means_something(Output output, int node, double number) {
  const int horizon = Spoilt().horizon();
  switch (output) {
    case Output::step:
    case Output::A:
    case Output::B:
    case Output::value:
    case Output::C:
    case Output::E:
    case Output::lu:
    case Output::lux:
    case Output::luu:
      return node == horizon;
    case Output::lower:
      return node == horizon || number == -std::numeric_limits<double>::infinity();
    case Output::upper:
    case Output::penalty:
    case Output::stiffness:
      return node == horizon || number == std::numeric_limits<double>::infinity();
    case Output::terminal_lower:
      return node != horizon || number == -std::numeric_limits<double>::infinity();
    case Output::terminal_upper:
    case Output::terminal_penalty:
      return node != horizon || number == std::numeric_limits<double>::infinity();
    case Output::terminal_value:
    case Output::terminal_C:
    case Output::equality:
    case Output::H:
      return node != horizon;
    case Output::weight:  // not used at node 0 or if negative
      return node == 0 || number < 0.0;
    default:
      return false;
  }
}

TEST(NotANumber, NeverConvergesNorEntersThePlanAndRecovers) {
  const Eigen::Vector2d x(1.0, 0.3);
  const double infinity = std::numeric_limits<double>::infinity();
  SolverSettings settings = test_support::patient();
  settings.tolerance = 1e-9;
  Solver reference(Spoilt{}, settings);
  reference.reset(x);
  ASSERT_EQ(reference.solve(x).status, SolveStatus::converged);
  for (int output = 1; output < static_cast<int>(Output::count); ++output)
    for (const int node : {0, 1, 5, 9, 10})
      for (const double number : {std::numeric_limits<double>::quiet_NaN(), infinity, -infinity}) {
        if (means_something(static_cast<Output>(output), node, number)) continue;
        SCOPED_TRACE("output " + std::to_string(output) + " at node " + std::to_string(node) +
                     " is " + std::to_string(number));
        for (const bool warm : {false, true}) {
          Solver solver(Spoilt{}, settings);
          solver.reset(x);
          if (warm) solver.solve(x);
          const auto spoil = [&](bool bad) {
            solver.problem().output = bad ? static_cast<Output>(output) : Output::none;
            solver.problem().node = node;
            solver.problem().number = number;
          };
          spoil(true);
          const SolveReport bad = solver.solve(x);
          EXPECT_NE(bad.status, SolveStatus::converged);
          EXPECT_NE(bad.status, SolveStatus::infeasible);
          if (bad.status != SolveStatus::rejected) {
            EXPECT_FALSE(bad.kkt < 1.0) << bad.kkt;
          }
          EXPECT_TRUE(finite_plan(solver));
          const bool prepared = solver.prepare() == PrepareStatus::prepared;
          const SolveStatus iterated = solver.feedback(x).status;
          EXPECT_TRUE(finite_plan(solver));
          if (static_cast<Output>(output) != Output::cost) {
            EXPECT_FALSE(prepared && iterated == SolveStatus::iterated);
          }
          spoil(false);
          ASSERT_EQ(solver.solve(x).status, SolveStatus::converged);
          EXPECT_NEAR(solver.report().cost, reference.report().cost, 1e-9);
        }
      }
}

TEST(NotANumber, AppearsInTheReportFromAnyNode) {
  const Eigen::Vector2d x(1.0, 0.3);
  const auto report = [&](Output output, int node) {
    Solver solver(Spoilt{}, test_support::patient());
    solver.reset(x);
    solver.problem().output = output;
    solver.problem().node = node;
    solver.problem().number = std::numeric_limits<double>::quiet_NaN();
    EXPECT_EQ(solver.prepare(), PrepareStatus::failed);
    return solver.report();
  };
  for (const int node : {1, 5, 9}) {
    EXPECT_FALSE(std::isfinite(report(Output::value, node).max_violation)) << node;
    EXPECT_FALSE(std::isfinite(report(Output::step, node).max_defect)) << node;
    EXPECT_FALSE(std::isfinite(report(Output::cost, node).cost)) << node;
  }
  EXPECT_FALSE(std::isfinite(report(Output::equality, 10).max_equality));
}

TEST(NotANumber, RecoversInTheNextIteration) {
  const Eigen::Vector2d x(1.0, 0.3);
  Solver solver(Spoilt{}, test_support::patient());
  solver.reset(x);
  ASSERT_EQ(solver.solve(x).status, SolveStatus::converged);
  solver.problem().output = Output::lx;
  solver.problem().node = 10;
  solver.problem().number = std::numeric_limits<double>::quiet_NaN();
  EXPECT_EQ(solver.prepare(), PrepareStatus::failed);
  EXPECT_EQ(solver.feedback(x).status, SolveStatus::failed);
  solver.problem().output = Output::none;
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  EXPECT_EQ(solver.feedback(x).status, SolveStatus::iterated);
  EXPECT_TRUE(finite_plan(solver));
}

}  // namespace not_a_number_test
}  // namespace tilt_ropter::optimal_control
