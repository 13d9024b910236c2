// The work of an iteration grows linearly with the length of the horizon (check 21).

#include "../../examples/support/statistics.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/sanitizer.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <ctime>
#include <vector>

namespace tilt_ropter::optimal_control {
namespace {

using test_support::check_at_most;

double thread_seconds() {
  std::timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

/// Three masses on a line. The force and the speed of each mass are bounded, and its target jumps
/// between two places. Most nodes therefore have more than one active constraint.
struct Masses {
  static constexpr int states = 6, inputs = 3, constraints = 6, equalities = 0;
  using State = Eigen::Matrix<double, 6, 1>;
  using D = ProblemDimensions<Masses>;
  int intervals = 20;
  double target = 1.0, price = 1e4;

  int horizon() const { return intervals; }
  State retract(const State& x, const State& dx) const { return x + dx; }
  State difference(const State& y, const State& x) const { return y - x; }
  static D::A transition() {
    D::A A = D::A::Identity();
    A.topRightCorner<3, 3>().diagonal().setConstant(0.1);
    return A;
  }
  static D::B push() {
    D::B B = D::B::Zero();
    B.topRows<3>().diagonal().setConstant(0.005);
    B.bottomRows<3>().diagonal().setConstant(0.1);
    return B;
  }
  State step(int, const State& x, const D::Input& u) const { return transition() * x + push() * u; }
  State step(int k, const State& x, const D::Input& u, D::A& A, D::B& B) const {
    A = transition();
    B = push();
    return step(k, x, u);
  }
  State error(int k, const State& x) const {
    State e = x;
    for (int i = 0; i < 3; ++i) e(i) -= (k + 6 * i) % 24 < 12 ? target : -target;
    return e;
  }
  static State weights() {
    State w = State::Constant(1e-3);
    w.head<3>().setOnes();
    return w;
  }
  double cost(int k, const State& x, const D::Input& u) const {
    return error(k, x).dot(weights().cwiseProduct(error(k, x))) + 1e-4 * u.squaredNorm();
  }
  void cost_model(int k, const State& x, const D::Input& u, QuadraticModel<6, 3>& m) const {
    m.lx() = 2.0 * weights().cwiseProduct(error(k, x));
    m.lxx().diagonal() = 2.0 * weights();
    m.lu() = 2e-4 * u;
    m.luu().diagonal().setConstant(2e-4);
  }
  D::Constraints constraint_values(int, const State& x, const D::Input& u) const {
    D::Constraints r;
    r << u, x.tail<3>();
    return r;
  }
  void constraint_derivatives(int, const State&, const D::Input&, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    C.bottomRightCorner<3, 3>().setIdentity();
    E.topRows<3>().setIdentity();
  }
  D::Constraints upper(int k) const {
    D::Constraints r;
    r << 2.0, 2.0, 2.0, 0.6, 0.6, 0.6;
    if (k == 0) r.tail<3>().setConstant(10.0);
    return r;
  }
  D::Constraints lower(int k) const { return -upper(k); }
  D::Constraints penalty(int) const { return D::Constraints::Constant(price); }
};

struct Work {
  double seconds = 0.0;  // median time of an iteration [s]
  // Mean number of active constraints per node, mean number of passes per iteration.
  double active = 0.0, passes = 0.0;
};

// Runs iterations. If `flips` is true, the target changes its sign in every iteration, which is the
// worst case for warm starts. Otherwise the target is nearly constant.
Work iterate(int horizon, bool flips) {
  Masses masses;
  masses.intervals = horizon;
  SolverSettings settings;
  settings.program.max_passes = 1000;
  MultipleShooting<Masses> solver(masses, settings);
  const Masses::State rest = Masses::State::Zero();
  solver.reset(rest);
  Work work;
  std::vector<double> seconds;
  const int count = test_support::quick_or_full(9, 31);
  for (int i = 0; i < count; ++i) {
    solver.problem().target = flips ? (i % 2 == 0 ? 1.0 : -1.0) : 1.0 + 1e-7 * (i % 2);
    const double start = thread_seconds();
    EXPECT_EQ(solver.prepare(), PrepareStatus::prepared);
    const SolveReport& report = solver.feedback(rest);
    seconds.push_back(thread_seconds() - start);
    EXPECT_EQ(report.status, SolveStatus::iterated) << report.program_residual;
    work.active += static_cast<double>(report.active_constraints) / (horizon * count);
    work.passes += static_cast<double>(report.passes) / count;
  }
  work.seconds = examples::percentile(seconds, 0.5);
  return work;
}

TEST(LinearWork, CostPerNodeIsTheSameForAnyHorizon) {
  // The speed of the machine changes in the course of seconds: each round compares all horizons,
  // and the median of the rounds counts.
  const std::vector<int> horizons = {20, 50, 100, 200};
  std::vector<double> ratios;
  for (int round = 0; round < 11; ++round) {
    std::vector<double> cost;
    for (const int horizon : horizons) {
      const Work work = iterate(horizon, false);
      EXPECT_GT(work.active, 1.2);
      EXPECT_LE(work.passes, 2.0);
      cost.push_back(work.seconds / (horizon * (1.0 + work.passes)));
    }
    const auto [least, most] = std::minmax_element(cost.begin(), cost.end());
    ratios.push_back(*most / *least);
  }
  if (test_support::under_address_sanitizer()) return;
  check_at_most(21, "cost per node from N = 20 to 200, largest over smallest",
                examples::percentile(ratios, 0.5), 1.3);
}

TEST(LinearWork, TenTimesTheHorizonWithAllConstraintsFlipping) {
  Work shorter = iterate(50, true), longer = iterate(500, true);
  for (int again = 0; again < 3; ++again) {
    shorter.seconds = std::min(shorter.seconds, iterate(50, true).seconds);
    longer.seconds = std::min(longer.seconds, iterate(500, true).seconds);
  }
  EXPECT_GT(longer.active, 1.2);
  EXPECT_LE(longer.passes, 1.6 * shorter.passes + 5.0);
  if (test_support::under_address_sanitizer()) return;
  check_at_most(21, "N = 500 over N = 50, all constraints flipping",
                longer.seconds / shorter.seconds, 15.0);
}

}  // namespace
}  // namespace tilt_ropter::optimal_control
