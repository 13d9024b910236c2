// Solve: your own optimal-control problem with the solver of the library. A cart of 1 kg drives 2 m
// and stops, with at most 1 N and 1 m/s.

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <cstdio>
#include <string>

using namespace tilt_ropter::optimal_control;

struct Cart {  // state: position [m], speed [m/s]; input: force [N]
  static constexpr int states = 2, inputs = 1, residuals = 3, constraints = 2;
  template <typename S>
  using Vector2 = Eigen::Matrix<S, 2, 1>;
  template <typename S>
  using Vector1 = Eigen::Matrix<S, 1, 1>;

  int horizon() const { return 50; }
  template <typename S>  // the state after an interval of 0.1 s
  Vector2<S> step(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {x(0) + S(0.1) * x(1) + S(0.005) * u(0), x(1) + S(0.1) * u(0)};
  }
  template <typename S>  // the cost is the sum of the squared residuals
  Eigen::Matrix<S, 3, 1> residual(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {x(0) - S(2.0), S(0.2) * x(1), S(0.1) * u(0)};
  }
  template <typename S>  // the solver keeps these between lower() and upper()
  Vector2<S> constraint_values(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {x(1), u(0)};
  }
  Vector2<double> lower(int) const { return {-1.0, -1.0}; }
  Vector2<double> upper(int) const { return {1.0, 1.0}; }
};

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: solve    drives a cart; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  SolverSettings settings;
  settings.max_time = 60.0;  // [s]: the same result on a computer with other work
  // The derivatives are by automatic differentiation.
  MultipleShooting solver{AutoDiffProblem<Cart>(), settings};
  const Eigen::Vector2d start(0.0, 0.0);
  solver.reset(start);
  const SolveReport& report = solver.solve(start);
  const bool solved = report.status == SolveStatus::converged;
  std::printf("%s after %d iterations, KKT residual %.0e\n", solved ? "converged" : "not solved",
              report.iterations, report.kkt);
  for (int k = 0; k <= solver.horizon(); k += 10)
    std::printf("t %.1f s  position %.3f m  speed %.3f m/s\n", 0.1 * k, solver.state(k)(0),
                solver.state(k)(1));
  return solved ? 0 : 1;
}
