// The solver and its parts. AIR flies its whole figure eight, with about 30 active constraints. The
// counters are means over the flight, except the medians.

#include "../../examples/support/statistics.hpp"
#include "scenarios.hpp"

#include <tilt_ropter/optimal_control/detail/multipliers.hpp>

#include "support/random.hpp"

#include <benchmark/benchmark.h>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <vector>

namespace {

using benchmarks::ClosedLoop;
using benchmarks::Scenario;
using benchmarks::Solver;
using tilt_ropter::optimal_control::DualAlgorithm;
using tilt_ropter::optimal_control::DualSolver;
using tilt_ropter::optimal_control::SolveReport;
using tilt_ropter::optimal_control::SolveStatus;

/// Flies the loop. `part_us` returns the time of the measured part of a tick [us], from the tick's
/// wall time and report. The median over all ticks is robust against other load on the machine.
template <typename Part>
void fly(benchmark::State& state, const Scenario& scenario, double (ClosedLoop::*control)(),
         const Part& part_us) {
  ClosedLoop loop(scenario);
  std::vector<double> times_us;
  double active = 0.0, iterations = 0.0;
  for (auto _ : state) {
    const double all_us = (loop.*control)();
    const SolveReport& report = loop.report();
    times_us.push_back(part_us(all_us, report));
    state.SetIterationTime(1e-6 * times_us.back());
    active += report.active_constraints;
    iterations += report.iterations;
  }
  if (!loop.sound()) state.SkipWithError("a solve did not do as asked");
  const double median_us = examples::percentile(times_us, 0.5);
  using benchmark::Counter;
  state.counters["active_rows"] = Counter(active, Counter::kAvgIterations);
  state.counters["iterations"] = Counter(iterations, Counter::kAvgIterations);
  state.counters["median_us"] = median_us;
  state.counters["median_us_per_node"] = median_us / scenario.problem.horizon();
}

double all(double us, const SolveReport&) {
  return us;
}
double in_prepare(double, const SolveReport& report) {
  return report.prepare_us;
}
double in_linearise(double, const SolveReport& report) {
  return report.linearise_us;
}
double in_factorise(double, const SolveReport& report) {
  return report.factorise_us;
}
double with_constraints(double, const SolveReport& report) {
  return report.gradients_us;
}
double in_feedback(double, const SolveReport& report) {
  return report.feedback_us;
}

template <typename Part>
void air(benchmark::State& state, const Part& part_us) {
  fly(state, benchmarks::air(static_cast<int>(state.range(0))), &ClosedLoop::iterate, part_us);
}

void air_to_convergence(benchmark::State& state) {
  fly(state, benchmarks::air(), &ClosedLoop::converge, all);
}

/// AIR within wide bounds, where few constraints are ever active: shows the growth with the horizon
/// alone.
void free_iteration(benchmark::State& state) {
  fly(state, benchmarks::air(static_cast<int>(state.range(0)), tilt_ropter::NmpcBounds{}),
      &ClosedLoop::iterate, all);
}

void ground_iteration(benchmark::State& state) {
  fly(state, benchmarks::ground(), &ClosedLoop::iterate, all);
}

void step_from_cold(benchmark::State& state) {
  Solver solver(test_support::step_problem());
  for (auto _ : state) {
    solver.reset(test_support::step_start());
    if (solver.solve(test_support::step_start()).status != SolveStatus::converged)
      state.SkipWithError("did not converge");
  }
  state.counters["iterations"] = solver.report().iterations;
}

/// A dual of 40 constraints. As in AIR, the gradients of neighbours are similar, and about half of
/// the constraints have a multiplier at the solution.
struct Dual {
  static constexpr int rows = 40;
  Eigen::MatrixXd hessian{rows, rows};
  Eigen::VectorXd offsets{rows}, bounds = Eigen::VectorXd::Constant(rows, 1e4);

  Dual() {
    test_support::Random random(1);
    Eigen::MatrixXd gradients(120, rows);
    for (int j = 0; j < rows; ++j) {
      for (int i = 0; i < 120; ++i) gradients(i, j) = random.normal(0.1);
      if (j > 0) gradients.col(j) += 0.7 * gradients.col(j - 1);
      offsets(j) = random.uniform(0.3, 1.0);
    }
    hessian.noalias() = gradients.transpose() * gradients;
    hessian.diagonal().array() += 1e-9;
  }
};

void solve_dual(benchmark::State& state, DualAlgorithm algorithm, bool warm) {
  const Dual dual;
  DualSolver solver(Dual::rows, algorithm);
  Eigen::VectorXd lambda = Eigen::VectorXd::Zero(Dual::rows);
  // A warm start is the solution of a slightly different problem, as in a control loop.
  Eigen::VectorXd start = Eigen::VectorXd::Zero(Dual::rows);
  if (warm && !solver.solve(Dual::rows, dual.hessian, 1.02 * dual.offsets, dual.bounds, start))
    state.SkipWithError("no solution");
  const long before = solver.evaluations();
  for (auto _ : state) {
    lambda = start;
    if (!solver.solve(Dual::rows, dual.hessian, dual.offsets, dual.bounds, lambda))
      state.SkipWithError("no solution");
    benchmark::DoNotOptimize(lambda.data());
  }
  state.counters["active_rows"] = static_cast<double>((lambda.array() > 1e-9).count());
  state.counters["evaluations"] = benchmark::Counter(
      static_cast<double>(solver.evaluations() - before), benchmark::Counter::kAvgIterations);
}

BENCHMARK_CAPTURE(air, iteration, all)
    ->Arg(10)
    ->Arg(20)
    ->Arg(50)
    ->Arg(100)
    ->Arg(200)
    ->UseManualTime();
BENCHMARK_CAPTURE(air, prepare, in_prepare)->Arg(20)->UseManualTime();
BENCHMARK_CAPTURE(air, linearise, in_linearise)->Arg(20)->UseManualTime();
BENCHMARK_CAPTURE(air, factorise, in_factorise)->Arg(20)->UseManualTime();
// Some 30 ns per tick: without a number of ticks this would run for 20 minutes.
BENCHMARK_CAPTURE(air, rows, with_constraints)->Arg(20)->Iterations(20000)->UseManualTime();
BENCHMARK_CAPTURE(air, feedback, in_feedback)->Arg(20)->UseManualTime();
BENCHMARK(air_to_convergence)->UseManualTime();
BENCHMARK(free_iteration)->Arg(10)->Arg(20)->Arg(50)->Arg(100)->Arg(200)->UseManualTime();
BENCHMARK(ground_iteration)->UseManualTime();
BENCHMARK(step_from_cold);
BENCHMARK_CAPTURE(solve_dual, truncated_newton_warm, DualAlgorithm::truncated_newton, true);
BENCHMARK_CAPTURE(solve_dual, truncated_newton, DualAlgorithm::truncated_newton, false);
BENCHMARK_CAPTURE(solve_dual, lbfgs, DualAlgorithm::lbfgs, false);
BENCHMARK_CAPTURE(solve_dual, variable_metric, DualAlgorithm::variable_metric, false);
BENCHMARK_CAPTURE(solve_dual, ccsa, DualAlgorithm::ccsa, false);
BENCHMARK_CAPTURE(solve_dual, slsqp, DualAlgorithm::slsqp, false);

}  // namespace
