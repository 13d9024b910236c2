// After construction and a few ticks no function of the solver uses the heap, except NLopt. NLopt's
// heap use stays within the bounds in DualSolver's documentation.
// CTest: alone

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/detail/multipliers.hpp>

#include "support/allocation_counter.hpp"
#include "support/benchmark_problem.hpp"
#include "support/loop_watch.hpp"
#include "support/patient.hpp"
#include "support/quadrotor.hpp"
#include "support/random.hpp"
#include "support/states.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <set>

namespace tilt_ropter {
namespace heap_in_the_loop_solver_test {

using test_support::expect_nlopt_within_documented_bounds;
using test_support::heap_use;
using test_support::HeapInTheLoop;
using test_support::HeapUse;
using test_support::HeapUser;
using test_support::nlopt_calls;
using test_support::NloptInTicks;
using test_support::Random;
using test_support::ticks;
using test_support::warm_up;

// The bounds in DualSolver's documentation. creation_*: added by the first call of nlopt_optimize
// with a new number of constraints. solve_calls: number of calls in one solve.
constexpr long creation_allocations = 3;
constexpr long creation_bytes(long rows) {
  return 32 * rows + 512;
}
constexpr long solve_calls = 20;

TEST_F(HeapInTheLoop, NloptKeepsDocumentedBoundsForEveryNumberOfConstraints) {
  constexpr int capacity = 150;
  Random random(81);
  optimal_control::DualSolver solver(capacity);
  const Eigen::MatrixXd G = Eigen::MatrixXd::NullaryExpr(capacity, capacity + 3,
                                                         [&random] { return random.normal(1.0); });
  const Eigen::MatrixXd H = G * G.transpose();
  const Eigen::VectorXd rho = Eigen::VectorXd::Constant(capacity, 0.1);
  const Eigen::VectorXd b = Eigen::VectorXd::NullaryExpr(
      capacity, [&random] { return std::sqrt(1.0 * capacity) * random.normal(1.0); });
  Eigen::VectorXd lambda = Eigen::VectorXd::Zero(capacity);
  for (int i = 0; i <= warm_up; ++i) watch.next_tick();
  for (int rows = 1; rows <= capacity; ++rows) {
    const HeapUse before = heap_use(HeapUser::nlopt), sum_before = nlopt_calls.sum;
    const long count_before = nlopt_calls.count;
    EXPECT_TRUE(watch("DualSolver::solve", [&] { return solver.solve(rows, H, b, rho, lambda); }));
    const HeapUse created = heap_use(HeapUser::nlopt) - before - (nlopt_calls.sum - sum_before);
    EXPECT_GT(created.allocations, 0) << rows << " rows";
    EXPECT_LE(created.allocations, creation_allocations) << rows << " rows";
    EXPECT_LE(created.bytes, creation_bytes(rows)) << rows << " rows";
    EXPECT_GT(nlopt_calls.largest[static_cast<std::size_t>(rows)].bytes, 8 * rows);
    EXPECT_LE(nlopt_calls.count - count_before, solve_calls) << rows << " rows";
  }
  expect_nlopt_within_documented_bounds();
}

TEST_F(HeapInTheLoop, RealTimeIterationsWithChangingActiveConstraints) {
  using Solver = optimal_control::MultipleShooting<WheeledFlightProblem<0>>;
  optimal_control::SolverSettings settings;
  settings.program.max_dual_constraints = 60;  // above the default, for NLopt
  Solver solver(test_support::air_problem(), settings);
  Stated x = test_support::air_start();
  solver.reset(x);
  NloptInTicks warm, cold;
  std::set<int> active_constraints;
  bool good = true;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    test_support::set_air_reference(solver.problem(), 0.02 * i);
    const bool reset = i % 50 == 49;
    if (reset) {
      watch("reset", [&] { solver.reset(x); });
      for (int k = 0; k <= solver.horizon(); ++k)
        watch("set_guess", [&] { solver.set_guess(k, x, Eigen::Matrix<double, 6, 1>::Zero()); });
    }
    (reset || i == 0 ? cold : warm)([&] {
      good = watch("prepare",
                   [&] { return solver.prepare() == optimal_control::PrepareStatus::prepared; }) &&
             good;
      good = watch("feedback", [&] { return solver.feedback(x).status; }) ==
                 optimal_control::SolveStatus::iterated &&
             good;
    });
    active_constraints.insert(solver.report().active_constraints);
    x = test_support::air_plant(x, solver.input(0));
  }
  EXPECT_TRUE(good);
  EXPECT_GT(active_constraints.size(), 10U);
  EXPECT_GT(warm.calls, 0);
  // Measured: 3 calls and 18 kB; after a cold start 20 calls and 158 kB.
  EXPECT_LE(warm.calls, 6);
  EXPECT_LE(warm.bytes, 40000);
  EXPECT_LE(cold.calls, 60);
  EXPECT_LE(cold.bytes, 500000);
  expect_nlopt_within_documented_bounds();
}

// Eigen allocates the blocks of large matrix products on the heap.
TEST_F(HeapInTheLoop, ActiveConstraintsCloseToCapacity) {
  for (const int intervals : {20, 60}) {
    WheeledFlightSettings settings = test_support::benchmark_settings();
    settings.intervals = intervals;
    settings.bounds.force_rate.setConstant(0.5);
    settings.bounds.torque_rate.setConstant(0.05);
    optimal_control::MultipleShooting<WheeledFlightProblem<0>> solver(
        WheeledFlightProblem<0>(test_support::benchmark_body(), settings));
    for (int k = 0; k <= solver.horizon(); ++k)
      solver.problem().node(k).wrench_reference.force = test_support::benchmark_hover_force();
    Random random(82);
    int most = 0;
    for (int i = 0; i < 30; ++i) {
      watch.next_tick();
      Stated x = test_support::step_start();
      x.body.position += random.vector(3.0);
      x.body.velocity += random.vector(3.0);
      if (i % 5 == 0) watch("reset", [&] { solver.reset(x); });
      watch("prepare", [&] { return solver.prepare(); });
      watch("feedback", [&] { return solver.feedback(x).status; });
      most = std::max(most, solver.report().active_constraints);
    }
    EXPECT_GT(most, 100) << intervals << " intervals";
  }
  expect_nlopt_within_documented_bounds();
}

TEST_F(HeapInTheLoop, SolvesFromAColdStart) {
  for (const TerminalCost terminal : {TerminalCost::weights, TerminalCost::riccati}) {
    WheeledFlightSettings settings = test_support::benchmark_settings();
    settings.terminal_cost = terminal;
    optimal_control::MultipleShooting<WheeledFlightProblem<0>> solver(
        test_support::step_problem(settings), test_support::patient());
    Random random(83);
    int converged = 0;
    for (int i = 0; i < ticks() / 10; ++i) {
      watch.next_tick();
      Stated x = test_support::step_start();
      x.body.position += random.vector(0.3);
      for (int k = 0; k <= solver.horizon(); ++k)
        solver.problem().node(k).on_ground = i % 4 == 3 && k > 15;  // with equalities
      watch("reset", [&] { solver.reset(x); });
      const optimal_control::SolveStatus status =
          watch("solve", [&] { return solver.solve(x).status; });
      if (status == optimal_control::SolveStatus::converged) ++converged;
    }
    EXPECT_GT(converged, ticks() / 20);
  }
  expect_nlopt_within_documented_bounds();
}

TEST_F(HeapInTheLoop, QuadrotorProblem) {
  test_support::QuadrotorModel model;
  model.max_thrust = 3.0;
  optimal_control::MultipleShooting<test_support::Quadrotor> solver{test_support::Quadrotor(model)};
  Random random(84);
  int most = 0;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    const BodyStated x = test_support::random_state(random).body;
    if (i % 10 == 0) watch("reset", [&] { solver.reset(x); });
    watch("prepare", [&] { return solver.prepare(); });
    watch("feedback", [&] { return solver.feedback(x).status; });
    most = std::max(most, solver.report().active_constraints);
  }
  EXPECT_GT(most, 5);
  expect_nlopt_within_documented_bounds();
}

}  // namespace heap_in_the_loop_solver_test
}  // namespace tilt_ropter
