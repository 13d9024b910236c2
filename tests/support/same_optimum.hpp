#pragma once

#include "support/patient.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>

/// Two solvers that share only the problem must agree.
namespace test_support {

using tilt_ropter::optimal_control::DualAlgorithm;
using tilt_ropter::optimal_control::MultipleShooting;
using tilt_ropter::optimal_control::SingleShooting;
using tilt_ropter::optimal_control::SolveReport;
using tilt_ropter::optimal_control::SolverSettings;
using tilt_ropter::optimal_control::SolveStatus;

// Returns true if the constraint `component` is at its bound at any node of the solution.
template <typename Solver>
bool is_active(const Solver& solver, int component) {
  const auto& problem = solver.problem();
  for (int k = 0; k <= problem.horizon(); ++k) {
    const double value = problem.constraint_values(k, solver.state(k), solver.input(k))(component);
    if (std::min(std::abs(value - problem.upper(k)(component)),
                 std::abs(value - problem.lower(k)(component))) < 1e-7)
      return true;
  }
  return false;
}

// Solves with NLopt's SLSQP and with MultipleShooting for each algorithm of the dual, all from a
// cold start, and compares the optima. `oracle_tolerance` is that of SLSQP: what is left of an
// equality costs its multiplier. Returns the SLSQP solver for further checks.
template <typename Problem>
SingleShooting<Problem> expect_same_optimum(const Problem& problem,
                                            const typename Problem::State& x0,
                                            double tolerance = 1e-8,
                                            double oracle_tolerance = 1e-10) {
  SolverSettings exact = patient();
  exact.tolerance = oracle_tolerance;
  SingleShooting<Problem> oracle(problem, exact);
  oracle.reset(x0);
  const SolveReport truth = oracle.solve(x0);
  EXPECT_EQ(truth.status, SolveStatus::converged)
      << truth.max_violation << " " << truth.max_equality;
  for (const DualAlgorithm algorithm :
       {DualAlgorithm::truncated_newton, DualAlgorithm::lbfgs, DualAlgorithm::variable_metric,
        DualAlgorithm::ccsa, DualAlgorithm::slsqp}) {
    SCOPED_TRACE("algorithm " + std::to_string(static_cast<int>(algorithm)));
    SolverSettings settings = patient();
    settings.max_iterations = 200;
    settings.tolerance = tolerance;
    settings.program.algorithm = algorithm;
    MultipleShooting<Problem> solver(problem, settings);
    solver.reset(x0);
    const SolveReport report = solver.solve(x0);
    if (report.status != SolveStatus::converged) {
      ADD_FAILURE() << "status " << static_cast<int>(report.status) << ", KKT residual "
                    << report.kkt << " after " << report.iterations << " iterations";
      continue;
    }
    EXPECT_NEAR(report.cost, truth.cost, 1e-8 * truth.cost);
    for (int k = 0; k < problem.horizon(); ++k)
      EXPECT_LT((solver.input(k) - oracle.input(k)).cwiseAbs().maxCoeff(), 1e-6) << "node " << k;
  }
  return oracle;
}

}  // namespace test_support
