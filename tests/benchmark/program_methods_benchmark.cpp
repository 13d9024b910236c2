// What solves the quadratic program: NLopt up to n active constraints, for several n and for each
// of NLopt's algorithms, beside the structured methods. Each run flies 2000 ticks of 20 ms (STEP:
// 50 solves from cold) and prints percentiles of its ticks, in processor time.

#include "scenarios.hpp"

#include "../../examples/support/statistics.hpp"

#include <benchmark/benchmark.h>

#include <cstddef>
#include <string>
#include <vector>

namespace {

using benchmarks::Scenario;
using benchmarks::Solver;
using benchmarks::thread_us;
using tilt_ropter::Stated;
using tilt_ropter::optimal_control::DualAlgorithm;
using tilt_ropter::optimal_control::ProgramMethod;
using tilt_ropter::optimal_control::ProgramSolver;
using tilt_ropter::optimal_control::SolveReport;
using tilt_ropter::optimal_control::SolverSettings;
using tilt_ropter::optimal_control::SolveStatus;

Scenario flight(const std::string& name) {
  if (name == "AIR") return benchmarks::air(20, tilt_ropter::paper_bounds());
  if (name == "GROUND") return benchmarks::ground();
  // "steps": with wide bounds; "paper": with those of the paper
  return benchmarks::steps<3>(name == "paper" ? tilt_ropter::paper_bounds()
                                              : tilt_ropter::NmpcBounds{});
}

struct Choice {
  ProgramMethod method = ProgramMethod::automatic;
  int most = 16;  ///< active constraints for NLopt
  DualAlgorithm algorithm = DualAlgorithm::truncated_newton;
};

SolverSettings settings_of(const Choice& choice) {
  SolverSettings settings;
  settings.update_multipliers = false;
  settings.max_time = 60.0;
  settings.program.method = choice.method;
  settings.program.max_dual_constraints = choice.most;
  settings.program.algorithm = choice.algorithm;
  return settings;
}

void report(benchmark::State& state, const std::vector<double>& times, double by_nlopt,
            double evaluations, double unsolved) {
  const auto ticks = static_cast<double>(times.size());
  state.counters["median_us"] = examples::percentile(times, 0.5);
  state.counters["p99_us"] = examples::percentile(times, 0.99);
  state.counters["p99.9_us"] = examples::percentile(times, 0.999);
  state.counters["by_nlopt_%"] = 100.0 * by_nlopt / ticks;
  state.counters["evaluations"] = by_nlopt > 0.0 ? evaluations / by_nlopt : 0.0;
  state.counters["unsolved"] = unsolved;
}

void fly(benchmark::State& state, const std::string& name, const Choice& choice) {
  const Scenario scenario = flight(name);
  for (auto unused : state) {
    (void)unused;
    Solver solver(scenario.problem, settings_of(choice));
    const tilt_ropter::RigidBody<double> plant(test_support::benchmark_body());
    Stated x = scenario.start;
    scenario.set_reference(solver.problem(), 0.0);
    solver.reset(x);
    (void)solver.solve(x);
    std::vector<double> times;
    double by_nlopt = 0.0, evaluations = 0.0, unsolved = 0.0;
    for (int tick = 0; tick < 2000; ++tick) {
      scenario.set_reference(solver.problem(), 0.02 * tick);
      const double start = thread_us();
      (void)solver.prepare();
      const SolveReport& r = solver.feedback(x);
      times.push_back(thread_us() - start);
      by_nlopt += r.solved_by == ProgramSolver::nlopt;
      evaluations += r.solved_by == ProgramSolver::nlopt ? r.evaluations : 0;
      unsolved += r.status != SolveStatus::iterated;
      x = plant.step(x, solver.input(0), scenario.plant_wrench, 0.02);
      solver.shift(0.2);
    }
    report(state, times, by_nlopt, evaluations, unsolved);
  }
}

void solve_step(benchmark::State& state, const Choice& choice) {
  for (auto unused : state) {
    (void)unused;
    std::vector<double> times;
    double by_nlopt = 0.0, evaluations = 0.0, unsolved = 0.0;
    for (int i = 0; i < 50; ++i) {
      Solver solver(test_support::step_problem(), settings_of(choice));
      const Stated x = test_support::step_start();
      solver.reset(x);
      const double start = thread_us();
      const SolveReport& r = solver.solve(x);
      times.push_back(thread_us() - start);
      by_nlopt += r.solved_by == ProgramSolver::nlopt;
      evaluations += r.evaluations;
      unsolved += r.status != SolveStatus::converged;
    }
    report(state, times, by_nlopt, evaluations, unsolved);
  }
}

void add(const std::string& what, const Choice& choice) {
  for (const char* name : {"AIR", "GROUND", "steps", "paper"})
    benchmark::RegisterBenchmark((std::string(name) + '/' + what).c_str(),
                                 [name, choice](benchmark::State& s) { fly(s, name, choice); })
        ->Iterations(1)
        ->Unit(benchmark::kMillisecond);
  benchmark::RegisterBenchmark(("STEP/" + what).c_str(),
                               [choice](benchmark::State& s) { solve_step(s, choice); })
      ->Iterations(1)
      ->Unit(benchmark::kMillisecond);
}

const bool registered = [] {
  add("structured", {ProgramMethod::structured});
  for (const int most : {8, 12, 16, 24, 32, 48})
    add("up_to_" + std::to_string(most), {ProgramMethod::automatic, most});
  add("nlopt", {ProgramMethod::nlopt});
  const std::vector<const char*> algorithms = {"truncated_newton", "lbfgs", "variable_metric",
                                               "ccsa", "slsqp"};
  for (std::size_t i = 0; i < algorithms.size(); ++i)
    add(algorithms[i], {ProgramMethod::automatic, 16, static_cast<DualAlgorithm>(i)});
  return true;
}();

}  // namespace
