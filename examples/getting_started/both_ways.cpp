// Both ways: the same problem by the solver of the library and by NLopt alone. A mass of 1 kg stops
// from 2 m/s at the origin, with at most 1 N.

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <cstdio>
#include <string>

using namespace tilt_ropter::optimal_control;

struct Mass {  // state: position [m], speed [m/s]; input: force [N]
  static constexpr int states = 2, inputs = 1, residuals = 3, constraints = 1;
  template <typename S, int Size>
  using V = Eigen::Matrix<S, Size, 1>;

  int horizon() const { return 60; }
  template <typename S>
  V<S, 2> step(int, const V<S, 2>& x, const V<S, 1>& u) const {
    return {x(0) + S(0.1) * x(1) + S(0.005) * u(0), x(1) + S(0.1) * u(0)};
  }
  template <typename S>
  V<S, 3> residual(int, const V<S, 2>& x, const V<S, 1>& u) const {
    return {x(0), S(0.2) * x(1), S(0.1) * u(0)};
  }
  template <typename S>
  V<S, 1> constraint_values(int, const V<S, 2>&, const V<S, 1>& u) const {
    return u;
  }
  V<double, 1> lower(int) const { return V<double, 1>(-1.0); }
  V<double, 1> upper(int) const { return V<double, 1>(1.0); }
};

template <template <typename> class Solver>
bool solve(const char* name) {
  SolverSettings settings;
  settings.max_time = 60.0;  // [s]: the same result on a computer with other work
  Solver<AutoDiffProblem<Mass>> solver{AutoDiffProblem<Mass>(), settings};
  solver.reset({0.0, 2.0});
  const SolveReport report = solver.solve({0.0, 2.0});
  std::printf("%-18s %s, cost %.6f, first force %.4f N\n", name, to_string(report.status),
              report.cost, solver.input(0)(0));
  return report.status == SolveStatus::converged;
}

int main(int argc, char** argv) {
  if (argc > 1) return std::puts("usage: both_ways"), std::string(argv[1]) == "--help" ? 0 : 2;
  return solve<MultipleShooting>("multiple shooting") && solve<SingleShooting>("NLopt alone") ? 0
                                                                                              : 1;
}
