// Random convex quadratic programs of many sizes, ranks and scales, feasible or not. A program that
// is reported as solved must be solved. All other reports must give the reason (check 23).

#include "../../examples/support/program_audit.hpp"

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/patient.hpp"
#include "support/random.hpp"
#include "support/random_program.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

namespace tilt_ropter::optimal_control {
namespace random_programs_test {

using test_support::Feasibility;
using test_support::RandomProgram;

struct Tally {
  int programs = 0, solved = 0, compared = 0;
  int infeasible = 0, infeasible_told = 0, feasible_called_infeasible = 0;
  double worst_residual = 0.0, worst_difference = 0.0;
};

template <int States, int Inputs, int Constraints>
void solve_one(unsigned seed, ProgramMethod method, Tally& tally) {
  using Problem = RandomProgram<States, Inputs, Constraints>;
  test_support::Random random(seed);
  const int horizon = 5 + static_cast<int>(random.uniform(0.0, 36.0));
  const Feasibility feasibility = static_cast<Feasibility>(seed % 3);
  const Problem problem(random, horizon, feasibility, std::numeric_limits<double>::infinity());
  SolverSettings settings;
  settings.program.method = method;
  MultipleShooting<Problem> solver(problem, settings);
  solver.reset(problem.start());
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  examples::ProgramAudit<Problem> audit;
  audit.before(solver);
  const SolveReport report = solver.feedback(problem.start());
  ++tally.programs;
  const bool told_infeasible =
      report.status == SolveStatus::infeasible || report.relaxed_hard_constraints > 0;
  if (feasibility == Feasibility::infeasible) {
    ++tally.infeasible;
    tally.infeasible_told += told_infeasible;
    EXPECT_NE(report.status, SolveStatus::iterated);
  } else {
    tally.feasible_called_infeasible += report.status == SolveStatus::infeasible;
  }
  if (report.status != SolveStatus::iterated) {
    EXPECT_TRUE(told_infeasible || report.program_residual > settings.program.tolerance);
    return;
  }
  ++tally.solved;
  tally.worst_residual = std::max(tally.worst_residual, audit.after(solver));
  const int most = test_support::quick_or_full(60, 240);
  if (horizon * (States + Inputs) > most) return;
  SolverSettings exact = test_support::patient();
  exact.tolerance = 1e-8;  // a violation times a multiplier of 10 is an error of the cost
  SingleShooting<Problem> full(problem, exact);
  full.reset(problem.start());
  if (full.solve(problem.start()).status != SolveStatus::converged) return;
  double cost = 0.0;
  for (int k = 0; k <= horizon; ++k) cost += problem.cost(k, solver.state(k), solver.input(k));
  const double unit = 1.0 + std::abs(full.report().cost),
               difference = (cost - full.report().cost) / unit;
  // SLSQP may stop early, above the optimum (one program of 3000). Then the multipliers, which have
  // passed the audit, bound the distance between the cost and the optimum (weak duality).
  if (difference < -1e-6) {
    double gap = 0.0;
    for (int k = 0; k <= horizon; ++k) {
      const auto& m = solver.constraint_multipliers(k);
      const auto value = problem.constraint_values(k, solver.state(k), solver.input(k));
      for (int i = 0; i < Constraints; ++i) {
        const double bound = m(i) > 0.0 ? problem.upper(k)(i) : problem.lower(k)(i);
        if (m(i) != 0.0) gap += std::abs(m(i) * (bound - value(i)));
      }
    }
    tally.worst_difference = std::max(tally.worst_difference, gap / unit);
    return;
  }
  ++tally.compared;
  tally.worst_difference = std::max(tally.worst_difference, std::abs(difference));
}

void solve_all(ProgramMethod method, int count, Tally& tally) {
  for (int i = 0; i < count; ++i) {
    SCOPED_TRACE("program " + std::to_string(i));
    const auto seed = static_cast<unsigned>(i);
#ifdef TILT_ROPTER_FULL_TESTS  // seconds to compile
    if (i % 4 == 1) solve_one<4, 2, 6>(seed, method, tally);
    if (i % 4 == 2) solve_one<6, 2, 8>(seed, method, tally);
#else
    if (i % 4 == 1) solve_one<2, 1, 3>(seed, method, tally);
    if (i % 4 == 2) solve_one<12, 6, 9>(seed, method, tally);
#endif
    if (i % 4 == 0) solve_one<2, 1, 3>(seed, method, tally);
    if (i % 4 == 3) solve_one<12, 6, 9>(seed, method, tally);
  }
}

TEST(RandomPrograms, ReportedSolutionsAreCorrectAndFailuresGiveAReason) {
  Tally t;
  solve_all(ProgramMethod::automatic, test_support::quick_or_full(160, 1000), t);
  EXPECT_GT(t.compared, 10);
  EXPECT_GT(t.solved, 0.6 * t.programs);
  test_support::check_at_most(23, "cost of solved programs, from that of single_shooting",
                              t.worst_difference, 1e-6);
  test_support::check_at_most(23, "residual of solved programs, counted again", t.worst_residual,
                              1e-5);
  test_support::check_at_least(23, "infeasible programs that say so, fraction",
                               1.0 * t.infeasible_told / t.infeasible, 0.99);
  test_support::check_at_most(23, "others called infeasible, fraction",
                              1.0 * t.feasible_called_infeasible / t.programs, 1e-2);
}

TEST(RandomPrograms, SolvesByRiccatiPassesAlone) {
  Tally t;
  solve_all(ProgramMethod::structured, test_support::quick_or_full(60, 400), t);
  EXPECT_GT(t.solved, 0.6 * t.programs);
  EXPECT_LE(t.worst_difference, 1e-6);
  EXPECT_LE(t.worst_residual, 1e-5);
}

TEST(RandomPrograms, SolvesByTheDualAlone) {
  Tally t;
  solve_all(ProgramMethod::nlopt, test_support::quick_or_full(16, 150), t);
  EXPECT_GT(t.solved, 0.1 * t.programs);
  EXPECT_LE(t.worst_difference, 1e-6);
  EXPECT_LE(t.worst_residual, 1e-5);
}

// NLopt gets few assumed constraints only. A program that ends with many had it before the passes
// or not at all, and then its evaluations and the passes together stay within the limit.
TEST(RandomPrograms, ALongAttemptOfNloptCountsAsPasses) {
  using Problem = RandomProgram<2, 1, 3>;
  constexpr int limit = 10, evaluations_per_pass = 40;
  int long_attempts = 0;
  for (unsigned seed = 0; seed < 150; ++seed) {
    SCOPED_TRACE("program " + std::to_string(seed));
    test_support::Random random(seed);
    const Problem problem(random, 10 + static_cast<int>(seed % 30),
                          static_cast<Feasibility>(seed % 3),
                          std::numeric_limits<double>::infinity());
    SolverSettings settings;
    settings.program.max_passes = limit;
    MultipleShooting<Problem> solver(problem, settings);
    solver.reset(problem.start());
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    const SolveReport report = solver.feedback(problem.start());
    if (report.solved_by != ProgramSolver::interior_point || report.active_constraints <= 16)
      continue;
    const int of_nlopt = std::min(report.evaluations / evaluations_per_pass, limit / 2);
    EXPECT_LE(report.passes + of_nlopt, limit);
    long_attempts += of_nlopt > 0;
  }
  EXPECT_GT(long_attempts, 5);
}

}  // namespace random_programs_test
}  // namespace tilt_ropter::optimal_control
