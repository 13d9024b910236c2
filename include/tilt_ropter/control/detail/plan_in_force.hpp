// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {

/// Time of the plan that is commanded until the next plan replaces it. No function allocates or
/// throws.
class PlanTime {
 public:
  void drop() noexcept { exists_ = false; }  ///< No plan is in force any more.

  [[nodiscard]] bool exists() const noexcept { return exists_; }
  /// Time since the measurement of the plan [s].
  [[nodiscard]] double age(double time) const noexcept { return time - time_; }
  /// Returns true if a plan exists whose measurement is at most `max_age` [s] from `time`.
  [[nodiscard]] bool in_force(double time, double max_age) const noexcept {
    return exists_ && std::abs(age(time)) <= max_age;
  }

 protected:
  void begin_at(double time) noexcept {
    exists_ = true;
    time_ = time;
  }

 private:
  bool exists_ = false;
  double time_ = 0.0;
};

/// The plan that is commanded until the next plan replaces it: the wrench and its rate at any time,
/// and corrections from states that are measured between two plans.
///
/// The solver holds the trajectory of the plan. This class holds the rest: the time of the plan,
/// its first state, its feedback gain and the last correction. Wrenches [N; N m] and rates [N/s; N
/// m/s] are in the body frame, force first, and within the bounds of the problem. No function
/// allocates or throws.
template <typename Solver>
class PlanInForce : public PlanTime {
 public:
  using Rate = Eigen::Matrix<double, 6, 1>;

  /// Takes the plan that `solver` made for the measurement at `time` [s].
  void begin(const Solver& solver, double time) noexcept {
    begin_at(time);
    start_ = solver.state(0);
    gain_ = solver.gain(0);
    corrected_ = false;
  }

  /// Call this after solver.reset(x). If a plan exists, its wrench is then the wrench of `x`.
  void reset(const Stated& x) noexcept {
    start_ = x;
    corrected_ = false;
  }

  /// Wrench of the plan `age` [s] after its measurement; linear in each interval.
  [[nodiscard]] Wrenchd planned_wrench(const Solver& solver, double age) const noexcept {
    const double interval = solver.problem().settings().interval;
    const double clamped = std::min(std::max(age, 0.0), interval * solver.horizon());
    const int k = interval_at(solver, clamped);
    const Wrenchd& first = k == 0 ? start_.wrench : solver.state(k).wrench;
    return moved(solver, first, solver.input(k), clamped - interval * k);
  }

  /// Rate of the plan `age` >= 0 [s] after its measurement.
  [[nodiscard]] Rate planned_rate(const Solver& solver, double age) const noexcept {
    return within(solver.problem().settings().bounds, solver.input(interval_at(solver, age)));
  }

  /// True between correct() and the next plan.
  [[nodiscard]] bool corrected() const noexcept { return corrected_; }

  /// Wrench that is commanded at `time` [s], with the last correction.
  [[nodiscard]] Wrenchd wrench(const Solver& solver, double time) const noexcept {
    if (!corrected_) return planned_wrench(solver, age(time));
    return moved(solver, corrected_wrench_, corrected_rate_, std::max(time - corrected_time_, 0.0));
  }

  /// Corrects the rate for the state `x` at `time` [s], whose wrench is wrench(solver, time): adds
  /// the gain times the deviation from the state that the plan expects. Returns the corrected rate.
  const Rate& correct(const Solver& solver, double time, const Stated& x) noexcept {
    const double now = std::max(age(time), 0.0);
    const auto& problem = solver.problem();
    const int k = interval_at(solver, now);
    const Stated expected = problem.step_for(now - problem.settings().interval * k, k,
                                             k == 0 ? start_ : solver.state(k), solver.input(k));
    corrected_ = true;
    corrected_time_ = time;
    corrected_wrench_ = x.wrench;
    corrected_rate_ = within(problem.settings().bounds,
                             Rate(solver.input(k) + gain_ * problem.difference(x, expected)));
    return corrected_rate_;
  }

 private:
  [[nodiscard]] static int interval_at(const Solver& solver, double age) noexcept {
    return std::min(static_cast<int>(age / solver.problem().settings().interval),
                    solver.horizon() - 1);
  }

  // The wrench after `duration` [s] with a constant rate.
  [[nodiscard]] static Wrenchd moved(const Solver& solver, const Wrenchd& wrench, const Rate& rate,
                                     double duration) noexcept {
    Wrenchd later = wrench;
    for (int i = 0; i < 3; ++i) {
      later.force(i) += duration * rate(i);
      later.torque(i) += duration * rate(3 + i);
    }
    return within(solver.problem().settings().bounds, later);
  }

  Stated start_;
  typename Solver::Gain gain_ = Solver::Gain::Zero();
  // Set by correct():
  bool corrected_ = false;
  double corrected_time_ = 0.0;
  Wrenchd corrected_wrench_;
  Rate corrected_rate_ = Rate::Zero();
};

}  // namespace tilt_ropter
