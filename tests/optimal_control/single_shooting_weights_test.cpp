// Equalities by weight: SingleShooting minimises what MultipleShooting minimises.

#include "benchmark/scenarios.hpp"

#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <gtest/gtest.h>

namespace tilt_ropter::optimal_control {
namespace {

using NloptAlone = SingleShooting<WheeledFlightProblem<0>>;

template <typename Solver>
Solver at_the_start(const benchmarks::Scenario& scenario, const SolverSettings& settings) {
  Solver solver(scenario.problem, settings);
  scenario.set_reference(solver.problem(), 0.0);
  solver.reset(scenario.start);
  return solver;
}

// On the ground of the benchmark, whose conditions have a weight of 1000.
TEST(EqualitiesByWeight, HoldByTheirWeightWithoutUpdates) {
  const benchmarks::Scenario ground = benchmarks::ground();
  SolverSettings settings;
  settings.max_time = 60.0;
  auto exact = at_the_start<NloptAlone>(ground, settings);
  ASSERT_EQ(exact.solve(ground.start).status, SolveStatus::converged);
  EXPECT_LT(exact.report().max_equality, 1e-6);

  // In a control loop, whatever the setting.
  auto in_the_loop = at_the_start<NloptAlone>(ground, settings);
  ASSERT_EQ(in_the_loop.feedback(ground.start).status, SolveStatus::converged);
  settings.update_multipliers = false;
  auto by_weight = at_the_start<NloptAlone>(ground, settings);
  ASSERT_EQ(by_weight.solve(ground.start).status, SolveStatus::converged);
  auto truth = at_the_start<benchmarks::Solver>(ground, settings);
  ASSERT_EQ(truth.solve(ground.start).status, SolveStatus::converged);

  EXPECT_GT(truth.report().max_equality, 1e-5);
  EXPECT_LT(truth.report().cost, exact.report().cost - 1e-3);
  for (const NloptAlone* solver : {&by_weight, &in_the_loop}) {
    EXPECT_NEAR(solver->report().cost, truth.report().cost, 1e-6);
    EXPECT_LT((solver->input(0) - truth.input(0)).norm(), 1e-4);
  }
}

}  // namespace
}  // namespace tilt_ropter::optimal_control
