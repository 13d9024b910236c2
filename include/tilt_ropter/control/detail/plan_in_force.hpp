// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

/// What a plan is made from, and the plan that is commanded until the next plan replaces it.
namespace tilt_ropter::detail {

/// What a plan is made from, besides the measured actuators.
struct PlanInputs {
  BodyStated body;                     ///< last good measurement
  ContactEstimate contact;             ///< last good estimate
  std::vector<ReferencePoint> points;  ///< reference at each node
  bool reference_ends = false;         ///< the last points continue a reference that is not finite
  /// Time for which the vehicle has been on the ground [s].
  double on_ground_for = std::numeric_limits<double>::infinity();
};

/// The plan in force. The solver holds its trajectory; this class holds the rest: the time of its
/// measurement and its first state, which the solver replaces before the next plan is complete. No
/// function allocates or throws.
template <typename Solver>
class PlanInForce {
 public:
  using State = typename Solver::State;

  /// Takes the plan that `solver` made for the measurement at `time` [s].
  void begin(const Solver& solver, double time) noexcept {
    exists_ = true;
    time_ = time;
    start_ = solver.state(0);
  }
  /// Call this after solver.reset(x).
  void reset(const State& x) noexcept { start_ = x; }
  void drop() noexcept { exists_ = false; }  ///< No plan is in force any more.

  [[nodiscard]] bool exists() const noexcept { return exists_; }
  /// Time since the measurement of the plan [s].
  [[nodiscard]] double age(double time) const noexcept { return time - time_; }
  /// Returns true if a plan exists whose measurement is at most `max_age` [s] from `time`.
  [[nodiscard]] bool in_force(double time, double max_age) const noexcept {
    return exists_ && std::abs(age(time)) <= max_age;
  }

  /// Interval `k` of the trajectory, the state at its start, and the time since its start [s].
  struct Place {
    int k;
    const State& start;
    double passed;
  };
  /// The place `age` [s] after the measurement, at least 0. The last interval has no end.
  [[nodiscard]] Place at(const Solver& solver, double age) const noexcept {
    const double interval = solver.problem().settings().interval, now = std::max(age, 0.0);
    const int k = static_cast<int>(std::min(now / interval, solver.horizon() - 1.0));
    return {k, k == 0 ? start_ : solver.state(k), now - interval * k};
  }
  /// The same, but not after the end of the horizon.
  [[nodiscard]] Place within_horizon(const Solver& solver, double age) const noexcept {
    return at(solver, std::min(age, solver.problem().settings().interval * solver.horizon()));
  }

 private:
  bool exists_ = false;
  double time_ = 0.0;
  State start_;
};

/// The plan of the wrench level: the wrench and its rate at any time, and corrections from states
/// that are measured between two plans. Wrenches [N; N m] and rates [N/s; N m/s] are in the body
/// frame, force first, and within the bounds of the problem. No function allocates or throws.
template <typename Solver>
class WrenchPlan : public PlanInForce<Solver> {
 public:
  using Rate = Eigen::Matrix<double, 6, 1>;

  void begin(const Solver& solver, double time) noexcept {
    PlanInForce<Solver>::begin(solver, time);
    gain_ = solver.gain(0);
    corrected_ = false;
  }

  /// If a plan exists, its wrench is then the wrench of `x`.
  void reset(const Stated& x) noexcept {
    PlanInForce<Solver>::reset(x);
    corrected_ = false;
  }

  /// Rate of the plan `age` [s] after its measurement.
  [[nodiscard]] Rate planned_rate(const Solver& solver, double age) const noexcept {
    return within(solver.problem().settings().bounds, solver.input(this->at(solver, age).k));
  }

  /// Wrench that is commanded at `time` [s]: that of the plan, linear in each interval, or that of
  /// the last correction.
  [[nodiscard]] Wrenchd wrench(const Solver& solver, double time) const noexcept {
    if (corrected_)
      return moved(solver, corrected_wrench_, corrected_rate_,
                   std::max(time - corrected_time_, 0.0));
    const auto place = this->within_horizon(solver, this->age(time));
    return moved(solver, place.start.wrench, solver.input(place.k), place.passed);
  }

  /// Corrects the rate for the state `x` at `time` [s], whose wrench is wrench(solver, time): adds
  /// the gain times the deviation from the state that the plan expects. Returns the corrected rate.
  const Rate& correct(const Solver& solver, double time, const Stated& x) noexcept {
    const auto place = this->at(solver, this->age(time));
    const auto& problem = solver.problem();
    const Stated expected =
        problem.step_for(place.passed, place.k, place.start, solver.input(place.k));
    corrected_ = true;
    corrected_time_ = time;
    corrected_wrench_ = x.wrench;
    corrected_rate_ = within(problem.settings().bounds,
                             Rate(solver.input(place.k) + gain_ * problem.difference(x, expected)));
    return corrected_rate_;
  }

 private:
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

  typename Solver::Gain gain_ = Solver::Gain::Zero();
  // Set by correct():
  bool corrected_ = false;  // until the next plan
  double corrected_time_ = 0.0;
  Wrenchd corrected_wrench_;
  Rate corrected_rate_ = Rate::Zero();
};

}  // namespace tilt_ropter::detail
