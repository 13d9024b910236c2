#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/benchmark_problem.hpp"
#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

// Properties that the solver should have and does not have yet.
namespace tilt_ropter {
namespace {

using test_support::air_problem;
using test_support::air_start;
using test_support::Contradiction;
using test_support::DoubleIntegrator;
using test_support::Random;
using test_support::set_air_reference;
using test_support::step_problem;
using test_support::step_start;

using Solver = MultipleShooting<WheeledFlightProblem<>>;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

// A multiplier moves to a row without a bound (the measured state's), which makes its dual's offset
// infinite; the solver fails then and ever after.
TEST(KnownFaults, ClosedLoopWithAShiftByAWholeIntervalGoesOn) {
  Solver solver(air_problem());
  State<> x = air_start();
  set_air_reference(solver.problem(), 0.0);
  solver.reset(x);
  solver.solve(x);
  for (int i = 1; i < 50; ++i) {
    set_air_reference(solver.problem(), 0.1 * i);
    solver.shift(1.0);
    ASSERT_EQ(solver.solve(x).status, SolveStatus::converged) << "tick " << i;
    for (int j = 0; j < 5; ++j) x = test_support::air_plant(x, solver.input(0));
  }
}

// The same without a shift: a bound that is taken away while it is active.
struct Bounded : DoubleIntegrator {
  Bounded() : DoubleIntegrator({7, 30.0, 1.0}) {}
  const Rows& upper(int k) const { return bounded ? DoubleIntegrator::upper(k) : none_above; }
  const Rows& lower(int k) const { return bounded ? DoubleIntegrator::lower(k) : none_below; }
  bool bounded = true;

 private:
  Rows none_above{test_support::infinity}, none_below{-test_support::infinity};
};

TEST(KnownFaults, AnActiveBoundCanBeTakenAway) {
  MultipleShooting<Bounded> solver{Bounded()};
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  solver.reset(rest);
  ASSERT_EQ(solver.solve(rest).status, SolveStatus::converged);
  ASSERT_GT(solver.report().active_rows, 0);
  solver.problem().bounded = false;
  EXPECT_EQ(solver.solve(rest).status, SolveStatus::converged);
}

TEST(KnownFaults, NothingIsGivenUpBeforeTheFirstProgram) {
  MultipleShooting<Contradiction> solver(Contradiction({4, 2.0}));
  EXPECT_FALSE(solver.given_up(0, 0));
  solver.reset(Contradiction::State(0.3));
  EXPECT_FALSE(solver.given_up(0, 0));
}

// A Hessian that is not a number for once leaves damping that freezes the plan for many ticks.
struct Forgetful : DoubleIntegrator {
  Forgetful() : DoubleIntegrator({7, 30.0, 1.0}) {}
  void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 1>& model) const {
    DoubleIntegrator::cost_model(k, x, u, model);
    if (forgets) model.lxx.setConstant(nan);
  }
  bool forgets = false;
};

TEST(KnownFaults, AHessianThatIsNotANumberLeavesNoDamping) {
  MultipleShooting<Forgetful> solver{Forgetful()};
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  solver.reset(rest);
  solver.problem().forgets = true;
  EXPECT_FALSE(solver.prepare());
  solver.problem().forgets = false;
  ASSERT_TRUE(solver.prepare());
  EXPECT_LT(solver.report().damping, 1.0);
}

// Rows that are not numbers count as met in violation(), in the merit and in the KKT residual: the
// iterate is accepted, and the failure comes too late to keep the one before.
struct Fenced : DoubleIntegrator {
  Fenced() : DoubleIntegrator({7, 30.0, 1.0}) {}
  Rows row_values(int k, const State& x, const Input& u) const {
    return std::abs(x(1)) > 2.0 ? Rows(nan) : DoubleIntegrator::row_values(k, x, u);
  }
};

TEST(KnownFaults, FailureForRowsThatAreNotNumbersKeepsTheIterateBefore) {
  MultipleShooting<Fenced> solver{Fenced()};
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  solver.reset(rest);
  solver.solve(rest);
  for (int k = 0; k <= 7; ++k) {
    const auto rows = solver.problem().row_values(k, solver.state(k), solver.input(k));
    EXPECT_TRUE(rows.allFinite()) << "node " << k;
  }
}

TEST(KnownFaults, APlanShiftedThroughANonFiniteProblemIsGoodAgainAfterwards) {
  Solver solver(step_problem());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  auto& external = solver.problem().node(solver.horizon() - 1).external.force.x();
  external = nan;
  solver.shift(0.2);
  external = 0.0;
  EXPECT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
}

// One round solves without looking at rows.
TEST(KnownFaults, OneRoundOfTheWorkingSetKeepsToSomeRows) {
  SolverSettings settings;
  settings.program.max_rounds = 1;
  settings.max_iterations = 30;
  Solver solver(step_problem(), settings);
  solver.reset(step_start());
  solver.solve(step_start());
  EXPECT_GT(solver.report().active_rows, 0);
}

double penalised_cost(const Solver& solver, double price) {
  const WheeledFlightProblem<>& problem = solver.problem();
  double sum = 0.0;
  for (int k = 0; k <= problem.horizon(); ++k) {
    sum += problem.cost(k, solver.state(k), solver.input(k));
    const auto value = problem.row_values(k, solver.state(k), solver.input(k));
    for (int i = 0; i < Solver::nc; ++i)
      sum += price * violation(value(i), problem.lower(k)(i), problem.upper(k)(i));
    if (k < problem.horizon())
      sum +=
          price *
          problem.difference(problem.step(k, solver.state(k), solver.input(k)), solver.state(k + 1))
              .lpNorm<1>();
  }
  return sum;
}

// After 3 iterations 19 of these 60 are worse (up to 15 times), after 10 iterations 9 (7 times).
TEST(KnownFaults, AFewIterationsFromAWildStartAreBetterThanTheGuess) {
  for (const int iterations : {3, 10}) {
    Random random(132);
    int worse = 0;
    for (int i = 0; i < 60; ++i) {
      State<> x = step_start();
      x.body.position = Eigen::Vector3d(0, 0, 1.5) + random.vector(2.0);
      x.body.velocity = random.vector(2.0);
      x.body.orientation = quaternion_exp(150.0 * pi / 180.0 * random.vector(1.0).normalized());
      x.body.angular_velocity = random.vector(3.0);
      SolverSettings settings;
      settings.max_iterations = iterations;
      Solver solver(step_problem(), settings);
      solver.reset(x);
      const double before = penalised_cost(solver, 1e4);
      solver.solve(x);
      worse += penalised_cost(solver, 1e4) <= before ? 0 : 1;
    }
    EXPECT_EQ(worse, 0) << iterations << " iterations";
  }
}

}  // namespace
}  // namespace tilt_ropter
