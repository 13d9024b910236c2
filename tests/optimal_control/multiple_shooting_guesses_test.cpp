// solve() from textbook guesses, with and without noise, of problems that are not convex.
// CTest: optimised

#include "support/full_run.hpp"
#include "support/guessed_problems.hpp"
#include "support/patient.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <string>

namespace tilt_ropter::optimal_control {
namespace multiple_shooting_guesses_test {

using test_support::PlanValue;
using test_support::ShortestTime;
using test_support::SwingUp;
using test_support::TwoCircles;

struct Totals {
  int solves = 0, solved = 0;
  double largest_input = 0.0;
};

/// Solves from `count` guesses with this noise.
template <typename User>
Totals solve_from_guesses(const User& user, int count, double noise, int first_seed = 0) {
  Totals totals;
  for (int seed = first_seed; seed < first_seed + count; ++seed) {
    SCOPED_TRACE("N = " + std::to_string(user.intervals) + ", noise " + std::to_string(noise) +
                 ", guess " + std::to_string(seed));
    SolverSettings settings = test_support::patient();
    settings.max_iterations = 1000;
    MultipleShooting<AutoDiffProblem<User>> solver(AutoDiffProblem<User>(user), settings);
    const auto guess = test_support::random_guess(user, noise, static_cast<unsigned>(seed));
    test_support::set_guess(solver, guess);
    const SolveReport report = solver.solve(User::start());
    const auto plan = test_support::plan_of<User>(solver);
    const PlanValue before = test_support::value_of(user, guess),
                    after = test_support::value_of(user, plan);
    EXPECT_TRUE(has_plan(report.status)) << to_string(report.status);
    EXPECT_LE(after.merit(), before.merit() * (1.0 + 1e-6)) << to_string(report.status);
    // A status says no more than is so.
    if (report.status == SolveStatus::converged) {
      EXPECT_LT(after.largest, 1e-4);
      EXPECT_NEAR(report.cost, after.cost, 1e-6 * (1.0 + after.cost));
    }
    for (const auto& u : plan.inputs)
      totals.largest_input = std::max(totals.largest_input, u.cwiseAbs().maxCoeff());
    ++totals.solves;
    totals.solved += report.status == SolveStatus::converged;
  }
  return totals;
}

template <typename User>
void add_solves(const User& user, Totals& all) {
  for (const double noise : {0.0, 0.03, 0.3}) {
    const Totals totals = solve_from_guesses(user, noise == 0.0 ? 1 : 24, noise);
    all.solves += totals.solves;
    all.solved += totals.solved;
  }
}

TEST(SolveFromGuesses, NearlyAllAreSolvedAndNoneEndsWorseThanItsGuess) {
  Totals all;
  for (const int n : {40, 60, 70, 80}) add_solves(SwingUp<true>{n}, all);
  for (const int n : {20, 40, 60, 70, 80}) add_solves(SwingUp<false>{n}, all);
  for (const int n : {30, 50}) add_solves(TwoCircles{n}, all);
  for (const int n : {10, 20, 40}) add_solves(ShortestTime{n}, all);
  EXPECT_GE(all.solved, 0.99 * all.solves) << "of " << all.solves;
}

// The steps shrink by 0.4 % in an iteration here, until accelerated ones, which must not leave the
// bounds, take over: 5 of these guesses took more than 1000 iterations.
TEST(SolveFromGuesses, ShortestTimeConvergesWhereStepsShrinkSlowly) {
  const int count = 300;
  int solved = 0;
  for (int i = 0; i < count; ++i)
    solved += solve_from_guesses(ShortestTime{20}, 1, 0.01 * (i % 31), 7000 + i).solved;
  EXPECT_GE(solved, 0.99 * count);
}

// With 20 intervals there is no time to arrive. An actuator gives no more for that.
TEST(SolveFromGuesses, InputsStayWithinTheirBoundsIfTheEndIsOutOfReach) {
  const int count = test_support::quick_or_full(4, 24);
  for (const double noise : {0.03, 0.3}) {
    const Totals swing = solve_from_guesses(SwingUp<true>{20}, count, noise),
                 circles = solve_from_guesses(TwoCircles{20}, count, noise);
    EXPECT_EQ(swing.solved + circles.solved, 0);
    EXPECT_LE(swing.largest_input, 10.0 + 1e-5);
    EXPECT_LE(circles.largest_input, 2.0 + 1e-5);
  }
}

}  // namespace multiple_shooting_guesses_test
}  // namespace tilt_ropter::optimal_control
