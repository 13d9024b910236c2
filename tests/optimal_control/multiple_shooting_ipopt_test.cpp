// solve() from 1000 random guesses of problems that are not convex, and IPOPT from every fourth of
// them. Each finds a local optimum; which one is chance.
// CTest: long ipopt one_process

#include "support/guessed_problems.hpp"
#include "support/ipopt.hpp"
#include "support/patient.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <iostream>
#include <string>

namespace tilt_ropter::optimal_control {
namespace multiple_shooting_ipopt_test {

using test_support::PlanValue;

struct Totals {
  int solves = 0, converged = 0, worse_than_guess = 0, lies = 0;
  int compared = 0, only_by_ipopt = 0;  // guesses from which IPOPT starts, too
  int better = 0, equal = 0;            // where both converge: our cost against its
};

template <typename User>
void compare(const char* name, const User& user, int count, Totals& all) {
  Totals totals;
  for (int seed = 0; seed < count; ++seed) {
    const double noise = 0.3 * (seed % 31) / 30.0;
    const auto guess = test_support::random_guess(user, noise, 7000 + static_cast<unsigned>(seed));
    SolverSettings settings = test_support::patient();
    settings.max_iterations = 1000;
    MultipleShooting<AutoDiffProblem<User>> solver(AutoDiffProblem<User>(user), settings);
    test_support::set_guess(solver, guess);
    const SolveReport report = solver.solve(User::start());
    const PlanValue before = test_support::value_of(user, guess),
                    after = test_support::value_of(user, test_support::plan_of<User>(solver));
    const bool converged = report.status == SolveStatus::converged;
    ++totals.solves;
    totals.converged += converged;
    totals.worse_than_guess += !(after.merit() <= before.merit() * (1.0 + 1e-6));
    totals.lies += converged && !(after.largest < 1e-4);
    if (seed % 4 != 0) continue;  // IPOPT takes most of the time
    const auto ipopt = test_support::solve_by_ipopt(user, guess);
    const PlanValue other = test_support::value_of(user, ipopt.plan);
    ++totals.compared;
    totals.only_by_ipopt += ipopt.converged && !converged;
    if (!converged || !ipopt.converged) continue;
    totals.equal += std::abs(after.cost - other.cost) <= 1e-3 * other.cost;
    totals.better += after.cost < other.cost * (1.0 - 1e-3);
  }
  std::cout << name << ": of " << totals.solves << " guesses converged " << totals.converged
            << "; of " << totals.compared << " by IPOPT too: only there " << totals.only_by_ipopt
            << ", same cost " << totals.equal << ", lower " << totals.better << '\n';
  EXPECT_GE(totals.converged, 0.99 * totals.solves) << name;
  EXPECT_LE(totals.only_by_ipopt, 1) << name;
  all.worse_than_guess += totals.worse_than_guess;
  all.lies += totals.lies;
  all.solves += totals.solves;
}

TEST(SolveAgainstIpopt, ConvergesFromTheGuessesFromWhichIpoptDoes) {
  Totals all;
  compare("swing up", test_support::SwingUp<true>{60}, 400, all);
  compare("two circles", test_support::TwoCircles{50}, 300, all);
  compare("shortest time", test_support::ShortestTime{20}, 300, all);
  EXPECT_EQ(all.solves, 1000);
  EXPECT_EQ(all.worse_than_guess, 0);
  EXPECT_EQ(all.lies, 0);
}

}  // namespace multiple_shooting_ipopt_test
}  // namespace tilt_ropter::optimal_control
