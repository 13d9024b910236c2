// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/optimal_control/detail/anderson.hpp>
#include <tilt_ropter/optimal_control/detail/augmented_lagrangian.hpp>
#include <tilt_ropter/optimal_control/detail/merit.hpp>
#include <tilt_ropter/optimal_control/detail/trajectory.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter::optimal_control {

/// Finds the next iterate of MultipleShooting::solve() from the step of a quadratic program.
///
/// If the steps have become slow or the merit function is nearly level, the step from Anderson is
/// tried first. This step need not lower the merit if the merit is level or if rounding errors hide
/// its change. The norms in the merit function reject good steps there (Maratos effect). Such a
/// step is on trust: if the step of the next program is not shorter, the search goes back to the
/// start of the step on trust. Otherwise, the search is a line search along the step of the
/// program.
template <typename Problem, typename Program>
class StepSearch {
 public:
  using D = ProblemDimensions<Problem>;
  using Points = Trajectory<Problem>;
  static constexpr int nx = D::nx, nu = D::nu;

  /// Allocates; the functions below do not.
  StepSearch(int horizon, const SolverSettings& settings)
      : settings_(settings),
        horizon_(horizon),
        trial_(horizon),
        base_(horizon),
        merit_(horizon),
        anderson_((nx + nu) * (horizon + 1), settings.memory),
        residual_(zeros((nx + nu) * (horizon + 1))),
        base_residual_(residual_),
        move_(residual_),
        scale_(residual_) {}

  /// Call this before the first step of a solve. If `accelerated` is false, only line searches are
  /// used.
  void begin(bool accelerated) {
    merit_.forget();
    lowest_merit_ = std::numeric_limits<double>::infinity();
    accelerates_ = accelerated && settings_.memory > 0;
    forget_moves();
    length_ = 1.0;
    first_ = true;
  }

  void forget() {
    merit_.forget();
    forget_moves();
  }
  /// True if the last step was accepted without a lower merit and is not yet confirmed as better.
  [[nodiscard]] bool on_trust() const { return on_trust_; }
  [[nodiscard]] double length() const { return length_; }  ///< length of the last step
  /// Lowest merit of all iterates since begin(); each merit uses the weights of its iterate.
  [[nodiscard]] double lowest_merit() const { return lowest_merit_; }
  [[nodiscard]] bool accelerates() const { return accelerates_; }
  /// Uses only line searches from now on, because the acceleration makes no progress. Discards the
  /// stored moves.
  void stop_accelerating() {
    forget_moves();
    accelerates_ = false;
  }

  /// Moves `here` by the step in `program`, which was linearised there; `cost` is the cost there.
  /// Goes back to the start of the step on trust if this step was not an improvement. Returns
  /// iterated, or stalled if no step is better.
  SolveStatus advance(const Problem& problem, const Program& program,
                      const AugmentedLagrangian<Problem>& equalities, double cost, Points& here) {
    if (accelerates_) {
      if (first_) set_scale(program);
      first_ = false;
      pack_step(program);
      if (moved_) anderson_.add(move_, base_residual_, residual_);
      if (on_trust_ && !(norm(residual_) < 0.9 * norm(base_residual_)))
        return go_back(problem, here, true);
    }
    const double slope = merit_.update(program, horizon_);
    const double merit = merit_.value_here(problem, program, equalities, here, cost);
    lowest_merit_ = std::min(lowest_merit_, merit);
    const bool level = -slope <= 1e-4 * (1.0 + std::abs(merit)) && !searches_;
    const bool hidden = -slope <= 1e-9 * (1.0 + std::abs(merit));
    searches_ = on_trust_ = false;
    attempts_ = 0;
    const auto merit_of_trial = [&] { return merit_.value(problem, program, equalities, trial_); };
    if (!accelerates_)
      return search_line(problem, program, merit, slope, hidden, merit_of_trial, here);

    // Far from the solution and with fast progress, stored moves are soon outdated.
    const bool far = -slope > 1e-3 * (1.0 + std::abs(merit));
    if (far && moved_ && norm(residual_) < 0.6 * norm(base_residual_)) anderson_.clear();
    base_ = here;
    base_residual_ = residual_;
    moved_ = true;
    if (!anderson_.empty()) {
      move_ = anderson_.step(residual_);
      try_move(problem, here);
      const bool lower = merit_of_trial() <= merit + 1e-4 * slope;
      if (lower || level || hidden) {
        on_trust_ = !lower;
        length_ = 1.0;
        here.swap(trial_);
        return SolveStatus::iterated;
      }
    }
    on_trust_ = hidden;
    const SolveStatus status =
        search_line(problem, program, merit, slope, hidden, merit_of_trial, here);
    for (int i = 0; i < move_.size(); ++i) move_(i) = length_ * residual_(i);
    return status;
  }

  /// Goes back to the start of the step on trust. If `learnt`, the acceleration knows the end of
  /// that step, and tries a better step from the same start (fewer than max_attempts times).
  /// Otherwise the line search must find the next step.
  SolveStatus go_back(const Problem& problem, Points& here, bool learnt) {
    here = base_;
    if (learnt && ++attempts_ < max_attempts) {
      move_ = anderson_.step(base_residual_);
      try_move(problem, here);
      here.swap(trial_);
    } else {
      forget_moves();
      searches_ = true;
    }
    return SolveStatus::iterated;
  }
  /// Goes back to the start of the step on trust, at the end of a solve.
  void give_back(Points& here) { here.swap(base_); }

 private:
  // Line search along the step of the quadratic program.
  template <typename MeritOfTrial>
  SolveStatus search_line(const Problem& problem, const Program& program, double merit,
                          double slope, bool hidden, const MeritOfTrial& merit_of_trial,
                          Points& here) {
    double length = 1.0;
    if (hidden) {  // the merit gives no information here: without acceleration, use the last length
      if (!accelerates_) length = length_;
      try_step(problem, program, length, here);
    } else {
      try_step(problem, program, length, here);
      double there = merit_of_trial();
      // Parabola through the merit here, its slope and its value at the end of the step. If a
      // Gauss-Newton step goes far beyond the minimum, it does so in every iteration, and only a
      // shorter step converges.
      const double bend = there - merit - slope;
      if (bend > 0.0 && -slope < 1.5 * bend) {
        length = std::max(0.1, -slope / (2.0 * bend));
        try_step(problem, program, length, here);
        there = merit_of_trial();
      }
      while (!(there <= merit + 1e-4 * length * slope)) {
        length *= 0.5;
        if (length < settings_.min_step) return SolveStatus::stalled;
        try_step(problem, program, length, here);
        there = merit_of_trial();
      }
    }
    length_ = length;
    here.swap(trial_);
    return SolveStatus::iterated;
  }

  void try_step(const Problem& problem, const Program& program, double length, const Points& here) {
    trial_.set_moved(problem, here, program, length);
  }

  void forget_moves() {
    anderson_.clear();
    moved_ = on_trust_ = searches_ = false;
    attempts_ = 0;
  }

  // Packs the step of the quadratic program into one vector, scaled by the square roots of the
  // diagonals of the first Hessians.
  void pack_step(const Program& program) {
    for (int k = 0; k <= horizon_; ++k)
      for (int i = 0; i < entries_of(k); ++i)
        residual_(entry(k, i)) = scale_(entry(k, i)) * program.step(k)(i);
  }
  void try_move(const Problem& problem, const Points& here) {
    for (int k = 0; k <= horizon_; ++k) {
      typename D::Tangent dx;
      for (int i = 0; i < nx; ++i) dx(i) = move_(entry(k, i)) / scale_(entry(k, i));
      trial_.x(k) = problem.retract(here.x(k), dx);
      for (int i = nx; i < entries_of(k); ++i)
        trial_.u(k)(i - nx) = here.u(k)(i - nx) + move_(entry(k, i)) / scale_(entry(k, i));
    }
  }
  void set_scale(const Program& program) {
    for (int k = 0; k <= horizon_; ++k) {
      const auto& hessian = program.riccati.stage(k).cost.hessian;
      for (int i = 0; i < entries_of(k); ++i)
        scale_(entry(k, i)) = std::sqrt(std::max(std::abs(hessian(i, i)), 1e-6));
    }
  }
  // Number of entries of (dx, du) of node k, and index of entry i of node k in a vector of all
  // nodes.
  [[nodiscard]] int entries_of(int k) const { return k < horizon_ ? nx + nu : nx; }
  [[nodiscard]] static int entry(int k, int i) { return (nx + nu) * k + i; }

  [[nodiscard]] static Eigen::VectorXd zeros(int size) {
    Eigen::VectorXd vector(size);
    std::fill_n(vector.data(), size, 0.0);
    return vector;
  }
  [[nodiscard]] static double norm(const Eigen::VectorXd& v) {
    return std::sqrt(detail::dot(v.data(), v.data(), static_cast<int>(v.size())));
  }

  static constexpr int max_attempts = 5;

  SolverSettings settings_;
  int horizon_;
  Points trial_, base_;  // base_: start of the last step
  Merit<Problem, Program> merit_;
  Anderson anderson_;
  // Scaled: step of the program at the iterate, step of the program at the base, step taken from
  // the base. Last: the scales.
  Eigen::VectorXd residual_, base_residual_, move_, scale_;
  double length_ = 1.0, lowest_merit_ = 0.0;
  bool accelerates_ = false, first_ = true;
  bool moved_ = false;     // move_ and base_residual_ are set
  bool on_trust_ = false;  // the last step was accepted without a lower merit
  bool searches_ = false;  // the next step must lower the merit
  int attempts_ = 0;       // steps on trust from the same base
};

}  // namespace tilt_ropter::optimal_control
