// The three scenarios of the benchmark's optimal-control problem in one table, beside published
// results of other solvers, and a flight at the actuator level.

#include "../../examples/support/statistics.hpp"
#include "dense_riccati.hpp"
#include "scenarios.hpp"

#include <tilt_ropter/optimal_control/single_shooting.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include "support/actuator_loop.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <optional>
#include <string>
#include <vector>

namespace {

using benchmarks::ClosedLoop;
using benchmarks::Scenario;
using benchmarks::Solver;
using tilt_ropter::optimal_control::SolveReport;
using tilt_ropter::optimal_control::SolveStatus;

using NloptAlone =
    tilt_ropter::optimal_control::SingleShooting<tilt_ropter::WheeledFlightProblem<0>>;

constexpr const char* usage = R"(usage: scenarios_benchmark [--repeat R] [--lines | --nlopt-alone]

Runs STEP (one solve from cold, 100 R times), AIR (figure eight in the air, 500 ticks, R times; one
real-time iteration a tick, and to a KKT residual of 1e-6 each tick), GROUND (figure eight on the
ground, likewise one iteration a tick) and ACTUATORS (the paper's figure eight in the air, flown by
ActuatorNmpc with four tilting rotors: 20 states, 8 inputs, 20 intervals), on one thread. Prints for
each

  median, p99                processor time of a solve or an iteration [us]
  linearise, factorise,      median of the phases of one iteration [us]: `rows` are gradients of the
  rows, feedback             working set before the measurement, `feedback` is all that comes after
                             it, NLopt included; where there are several iterations, the first three
                             are those of the last one and `feedback` is their mean
  iterations, active         their median, and the median of the rows with a multiplier
  result                     optimum (STEP) or RMSE of the position [m]

and what was published for it: acados tuned by hand and as it comes, an experiment in this method.

  --repeat R      default 5
  --lines         print instead, as "key: value", times in units of a plain dense Riccati pass in
                  Eigen (`per_riccati`), and the worst tick in units of the median tick. The
                  fastest of R flights counts for each tick, and of all solves and passes. far_step:
                  a reference that steps by 20 m every two seconds, with the paper's bounds;
                  n500_per_node_over_n20: AIR with 500 intervals, median tick per interval, over
                  the same with 20
  --nlopt-alone   print instead what NLopt takes that is given the whole problems (SingleShooting):
                  STEP once, AIR and GROUND in 100 R ticks to 1e-6, which takes minutes
  --help          this text

Exit code 1 if a solve did not converge or STEP's optimum is not the known one.
)";

class Row {
 public:
  void add(double us, const SolveReport& report) {
    total_.push_back(us);
    linearise_.push_back(report.linearise_us);
    factorise_.push_back(report.factorise_us);
    rows_.push_back(report.gradients_us);
    feedback_.push_back(report.feedback_us / std::max(report.iterations, 1));
    iterations_.push_back(report.iterations);
    active_.push_back(report.active_constraints);
  }

  void print(const char* name, const std::string& result, const char* published) const {
    std::printf("%-29s %7.0f %6.0f %9.1f %9.1f %6.1f %8.1f %10.0f %6.0f  %-11s %s\n", name,
                examples::percentile(total_, 0.5), examples::percentile(total_, 0.99),
                examples::percentile(linearise_, 0.5), examples::percentile(factorise_, 0.5),
                examples::percentile(rows_, 0.5), examples::percentile(feedback_, 0.5),
                examples::percentile(iterations_, 0.5), examples::percentile(active_, 0.5),
                result.c_str(), published);
    std::fflush(stdout);
  }

 private:
  std::vector<double> total_, linearise_, factorise_, rows_, feedback_, iterations_, active_;
};

std::string text(const char* format, double value) {
  char buffer[32];
  std::snprintf(buffer, sizeof buffer, format, value);
  return buffer;
}

template <typename Solver>
bool run_step(int runs, const char* name) {
  Solver solver(test_support::step_problem());
  Row row;
  bool sound = true;
  for (int i = std::max(-2, 1 - runs); i < runs; ++i) {  // two warm-up runs: page faults
    const double start = benchmarks::thread_us();
    solver.reset(test_support::step_start());
    const SolveReport& report = solver.solve(test_support::step_start());
    const double us = benchmarks::thread_us() - start;
    sound = report.status == SolveStatus::converged && sound;
    if (i >= 0) row.add(us, report);
  }
  // Result of IPOPT with a normalised quaternion and the same R(q) as here.
  constexpr double known = 2074.1813;
  const double cost = solver.report().cost;
  row.print(name, text("%.4f", cost), "   2000-2500        5500           -  2074.1813");
  return sound && std::abs(cost - known) < 1e-4 * known;
}

template <typename Loop>
bool run_loop(const Scenario& scenario, double (Loop::*control)(), int ticks, const char* name,
              const char* published) {
  Loop loop(scenario);
  Row row;
  for (int i = 0; i < ticks; ++i) {
    const double us = (loop.*control)();
    row.add(us, loop.report());
  }
  row.print(name, text("%.5f m", loop.rmse()), published);
  return loop.sound();
}

bool run_actuator_level() {
  const tilt_ropter::Vehicle<4> vehicle = tilt_ropter::tilt_ropter_vehicle();
  const tilt_ropter::Mission mission = tilt_ropter::hybrid_mission(std::nullopt);
  test_support::ActuatorLoop<4> loop(vehicle, vehicle);
  loop.start(mission(0.0).position);
  Row row;
  while (loop.plant().time() < mission.duration()) {
    const SolveReport& report = loop.tick(mission).report;
    row.add(loop.controller_us(), report);
  }
  row.print("ACTUATORS  one tick", text("%.5f m", loop.rmse()),
            "           -           -           -  -");
  return loop.all_planned() && loop.sound();
}

bool run_nlopt_alone(int repeat) {
  using Loop = benchmarks::BasicClosedLoop<NloptAlone>;
  const bool step = run_step<NloptAlone>(1, "STEP   by NLopt alone"),
             air = run_loop(benchmarks::air(), &Loop::converge, 100 * repeat,
                            "AIR    by NLopt alone", ""),
             ground = run_loop(benchmarks::ground(), &Loop::converge, 100 * repeat,
                               "GROUND by NLopt alone", "");
  return step && air && ground;
}

/// Times of passes of the yardstick [us].
std::vector<double> yardstick(int passes) {
  benchmarks::DenseRiccati riccati;
  std::vector<double> us;
  volatile double sum = 0.0;  // keeps the passes
  for (int i = 0; i < passes; ++i) {
    const double start = benchmarks::thread_us();
    sum = sum + riccati.pass().trace();
    us.push_back(benchmarks::thread_us() - start);
  }
  return us;
}

/// The ticks of a flight that was repeated: the fastest time of each.
struct Ticks {
  std::vector<double> us;
  int unsolved = 0;
  [[nodiscard]] double median() const { return examples::percentile(us, 0.5); }
  [[nodiscard]] double worst_per_median() const {
    return *std::max_element(us.begin(), us.end()) / median();
  }
};

Ticks fastest(const Scenario& scenario, double (ClosedLoop::*control)(), int ticks, int repeat) {
  Ticks result;
  for (int r = 0; r < repeat; ++r) {
    ClosedLoop loop(scenario);
    result.us.resize(static_cast<std::size_t>(ticks), 1e9);
    result.unsolved = 0;
    for (double& us : result.us) {
      us = std::min(us, (loop.*control)());
      result.unsolved += loop.report().status != SolveStatus::iterated &&
                         loop.report().status != SolveStatus::converged;
    }
  }
  return result;
}

bool print_lines(int repeat) {
  const auto print = [](const char* key, double value) { std::printf("%s: %.3f\n", key, value); };
  const auto least = [](const std::vector<double>& us) {
    return *std::min_element(us.begin(), us.end());
  };
  const double riccati = least(yardstick(500 * repeat));
  std::vector<double> step;
  Solver solver(test_support::step_problem());
  for (int i = 0; i < 10 * repeat; ++i) {
    const double start = benchmarks::thread_us();
    solver.reset(test_support::step_start());
    (void)solver.solve(test_support::step_start());
    step.push_back(benchmarks::thread_us() - start);
  }
  constexpr int ticks = ClosedLoop::ticks;
  const Ticks air = fastest(benchmarks::air(), &ClosedLoop::iterate, ticks, repeat),
              ground = fastest(benchmarks::ground(), &ClosedLoop::iterate, ticks, repeat),
              exact = fastest(benchmarks::ground(), &ClosedLoop::converge, ticks, repeat),
              far = fastest(benchmarks::steps<20>(tilt_ropter::paper_bounds()),
                            &ClosedLoop::iterate, ticks, repeat),
              long_horizon = fastest(benchmarks::air(500), &ClosedLoop::iterate, 50, repeat);
  print("air_iteration_per_riccati", air.median() / riccati);
  print("air_worst_per_median", air.worst_per_median());
  print("ground_worst_per_median", ground.worst_per_median());
  print("ground_exact_worst_per_median", exact.worst_per_median());
  print("step_per_riccati", least(step) / riccati);
  print("far_step_worst_per_median", far.worst_per_median());
  std::printf("far_step_unsolved: %d\n", far.unsolved);
  print("n500_per_node_over_n20", long_horizon.median() / 500.0 / (air.median() / 20.0));
  return air.unsolved + ground.unsolved + exact.unsolved + far.unsolved + long_horizon.unsolved ==
         0;
}

}  // namespace

int main(int argc, char** argv) {
  int repeat = 5;
  bool nlopt_alone = false, lines = false;
  for (int i = 1; i < argc; ++i) {
    if (std::strcmp(argv[i], "--help") == 0 || std::strcmp(argv[i], "-h") == 0) {
      std::fputs(usage, stdout);
      return 0;
    }
    if (std::strcmp(argv[i], "--nlopt-alone") == 0) {
      nlopt_alone = true;
      continue;
    }
    if (std::strcmp(argv[i], "--lines") == 0) {
      lines = true;
      continue;
    }
    repeat = std::strcmp(argv[i], "--repeat") == 0 && i + 1 < argc ? std::atoi(argv[++i]) : 0;
    if (repeat < 1) {
      std::fputs(usage, stderr);
      return 2;
    }
  }
  if (lines) return print_lines(repeat) ? 0 : 1;
  std::printf("%-29s %7s %6s %9s %9s %6s %8s %10s %6s  %-11s %s\n%-112s %s\n", "", "median", "p99",
              "linearise", "factorise", "rows", "feedback", "iterations", "active", "result",
              "published:", "times in us", "acados tuned  as it comes  experiment  result");
  if (nlopt_alone) return run_nlopt_alone(repeat) ? 0 : 1;
  bool sound = run_step<Solver>(100 * repeat, "STEP   cold, to KKT 1e-6");
  sound =
      run_loop(benchmarks::air(), &ClosedLoop::iterate, ClosedLoop::ticks * repeat,
               "AIR    real-time iteration", "         211         397         131  0.04099 m") &&
      sound;
  sound =
      run_loop(benchmarks::air(), &ClosedLoop::converge, ClosedLoop::ticks * repeat,
               "AIR    to KKT 1e-6 each tick", "         920        1500           -  0.04099 m") &&
      sound;
  sound =
      run_loop(benchmarks::ground(), &ClosedLoop::iterate, ClosedLoop::ticks * repeat,
               "GROUND real-time iteration", "         184         346           -  0.0108 m") &&
      sound;
  sound = run_actuator_level() && sound;
  const std::vector<double> us = yardstick(500 * repeat);
  std::printf("%-29s %7.1f %6.1f   (18 states, 6 inputs, N = 20)\n", "plain dense Riccati in Eigen",
              examples::percentile(us, 0.5), examples::percentile(us, 0.99));
  if (!sound) std::fputs("a solve did not reach what was asked\n", stderr);
  return sound ? 0 : 1;
}
