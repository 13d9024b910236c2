#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/benchmark_problem.hpp"
#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/patient.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

// Numbers that are not finite for a while, and bounds that are removed: the solver must recover.
namespace tilt_ropter::optimal_control {
namespace solver_recovery_test {

using test_support::air_problem;
using test_support::air_start;
using test_support::Contradiction;
using test_support::DoubleIntegrator;
using test_support::patient;
using test_support::set_air_reference;
using test_support::step_problem;
using test_support::step_start;

using Solver = MultipleShooting<WheeledFlightProblem<0>>;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

// The shift moves a multiplier to a constraint without a bound: a constraint on the measured state.
TEST(SolverRecovery, ClosedLoopConvergesWithShiftByAWholeInterval) {
  Solver solver(air_problem(), patient());
  Stated x = air_start();
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

struct Bounded : DoubleIntegrator {
  Bounded() : DoubleIntegrator({7, 30.0, 1.0}) {}
  const Constraints& upper(int k) const {
    return bounded ? DoubleIntegrator::upper(k) : none_above;
  }
  const Constraints& lower(int k) const {
    return bounded ? DoubleIntegrator::lower(k) : none_below;
  }
  bool bounded = true;

 private:
  Constraints none_above{test_support::infinity}, none_below{-test_support::infinity};
};

TEST(SolverRecovery, ConvergesAfterAnActiveBoundIsRemoved) {
  MultipleShooting<Bounded> solver(Bounded(), patient());
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  solver.reset(rest);
  ASSERT_EQ(solver.solve(rest).status, SolveStatus::converged);
  ASSERT_GT(solver.report().active_constraints, 0);
  solver.problem().bounded = false;
  EXPECT_EQ(solver.solve(rest).status, SolveStatus::converged);
}

TEST(SolverRecovery, NoConstraintIsRelaxedBeforeTheFirstProgram) {
  MultipleShooting<Contradiction> solver(Contradiction({4, 2.0}), patient());
  EXPECT_FALSE(solver.relaxed(0, 0));
  solver.reset(Contradiction::State(0.3));
  EXPECT_FALSE(solver.relaxed(0, 0));
}

struct Forgetful : DoubleIntegrator {
  Forgetful() : DoubleIntegrator({7, 30.0, 1.0}) {}
  void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 1>& model) const {
    DoubleIntegrator::cost_model(k, x, u, model);
    if (forgets) model.lxx().setConstant(nan);
  }
  bool forgets = false;
};

TEST(SolverRecovery, NonFiniteHessianLeavesNoDamping) {
  MultipleShooting<Forgetful> solver(Forgetful(), patient());
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  solver.reset(rest);
  solver.problem().forgets = true;
  EXPECT_EQ(solver.prepare(), PrepareStatus::failed);
  solver.problem().forgets = false;
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  EXPECT_LT(solver.report().damping, 1.0);
}

struct Fenced : DoubleIntegrator {
  Fenced() : DoubleIntegrator({7, 30.0, 1.0}) {}
  Constraints constraint_values(int k, const State& x, const Input& u) const {
    return std::abs(x(1)) > 2.0 ? Constraints(nan) : DoubleIntegrator::constraint_values(k, x, u);
  }
};

TEST(SolverRecovery, NonFiniteConstraintsKeepThePreviousIterate) {
  MultipleShooting<Fenced> solver(Fenced(), patient());
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  solver.reset(rest);
  solver.solve(rest);
  for (int k = 0; k <= 7; ++k) {
    const auto rows = solver.problem().constraint_values(k, solver.state(k), solver.input(k));
    EXPECT_TRUE(all_finite(rows)) << "node " << k;
  }
}

TEST(SolverRecovery, ConvergesAfterAShiftThroughANonFiniteProblem) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  auto& external = solver.problem().node(solver.horizon() - 1).external.force.x();
  external = nan;
  solver.shift(0.2);
  external = 0.0;
  EXPECT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
}

// A bare solver, without a controller around it that would refuse the state.
TEST(SolverRecovery, AStateOutOfRangeCostsThreeTicks) {
  for (const double wild : {1e3, 1e6, 1e20, 1e150}) {
    SCOPED_TRACE(wild);
    WheeledFlightProblem<0> problem = air_problem();
    SolverSettings settings = patient();
    settings.program.max_passes = 10;
    Solver solver(problem, settings);
    Stated x = air_start();
    set_air_reference(solver.problem(), 0.0);
    solver.reset(x);
    (void)solver.solve(x);
    int unsolved = 0;
    for (int tick = 0; tick < 30; ++tick) {
      set_air_reference(solver.problem(), 0.02 * tick);
      Stated measured = x;
      if (tick == 5) measured.body.velocity.x() = wild;
      (void)solver.prepare();
      const SolveReport& report = solver.feedback(measured);
      if (tick > 5 && report.status != SolveStatus::iterated) ++unsolved;
      if (tick != 5 && has_plan(report.status))
        x = RigidBodyd(test_support::benchmark_body()).step(x, solver.input(0), {}, 0.02);
      solver.shift(0.2);
    }
    EXPECT_LE(unsolved, 3);
    EXPECT_EQ(solver.report().status, SolveStatus::iterated);
  }
}

}  // namespace solver_recovery_test
}  // namespace tilt_ropter::optimal_control
