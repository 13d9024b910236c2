#pragma once

#include "support/full_run.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

/// A problem for the work of an iteration: many active constraints, any horizon.
namespace test_support {

using tilt_ropter::optimal_control::ProblemDimensions;
using tilt_ropter::optimal_control::QuadraticModel;

/// Three masses on a line. The force and the speed of each mass are bounded, and its target jumps
/// between two places. Most nodes therefore have more than one active constraint.
struct Masses {
  static constexpr int states = 6, inputs = 3, constraints = 6, equalities = 0;
  using State = Eigen::Matrix<double, 6, 1>;
  using D = ProblemDimensions<Masses>;
  int intervals = 20;
  double target = 1.0, row_penalty = 1e4;

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
  D::Constraints penalty(int) const { return D::Constraints::Constant(row_penalty); }
};

/// Mean number of active constraints per node, mean number of passes per iteration, and number of
/// passes in the last iteration.
struct MeanWork {
  double active = 0.0, passes = 0.0;
  int last_passes = 0;
};

/// Runs `count` iterations: measure(iterate) calls iterate(). If `flips` is true, the target
/// changes its sign in every iteration, which is the worst case for warm starts. Otherwise the
/// target is nearly constant.
template <typename Measure>
MeanWork iterate_masses(int horizon, bool flips, int count, const Measure& measure) {
  using namespace tilt_ropter::optimal_control;
  Masses masses;
  masses.intervals = horizon;
  SolverSettings settings;
  settings.program.max_passes = 1000;
  MultipleShooting<Masses> solver(masses, settings);
  const Masses::State rest = Masses::State::Zero();
  solver.reset(rest);
  MeanWork work;
  for (int i = 0; i < count; ++i) {
    solver.problem().target = flips ? (i % 2 == 0 ? 1.0 : -1.0) : 1.0 + 1e-7 * (i % 2);
    measure([&] {
      EXPECT_EQ(solver.prepare(), PrepareStatus::prepared);
      (void)solver.feedback(rest);
    });
    const SolveReport& report = solver.report();
    EXPECT_EQ(report.status, SolveStatus::iterated) << report.program_residual;
    work.active += static_cast<double>(report.active_constraints) / (horizon * count);
    work.passes += static_cast<double>(report.passes) / count;
    work.last_passes = report.passes;
  }
  return work;
}

}  // namespace test_support
