// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/optimal_control/detail/augmented_lagrangian.hpp>
#include <tilt_ropter/optimal_control/detail/merit.hpp>
#include <tilt_ropter/optimal_control/detail/trajectory.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter::optimal_control {

/// The best of a guess and of the ends of several starts from it. The measure is the cost plus
/// defects and violations times the largest multiplier of all starts, at most times their penalty.
/// The weights of the line search do not serve: they are near zero where a multiplier is, so that
/// iterates far from any solution can look good.
template <typename Problem, typename Program>
class BestPlan {
 public:
  using Plan = Trajectory<Problem>;

  /// Allocates; the functions below do not.
  explicit BestPlan(int horizon) : guess_(horizon), plan_(horizon), merit_(horizon) {}

  /// Starts with the guess as the best plan.
  void begin(const Plan& guess) {
    guess_ = plan_ = guess;
    status_ = SolveStatus::stalled;
    weight_ = 0.0;
    is_guess_ = true;
    is_last_ = false;
  }

  /// Takes the end of a start if no plan before it is better. `program` has the multipliers.
  void offer(const Problem& problem, const Program& program,
             const AugmentedLagrangian<Problem>& equalities, const Plan& end, SolveStatus status) {
    for (int k = 1; k <= end.horizon(); ++k)
      weight_ = std::max(weight_, detail::largest(program.costate(k)));
    for (const auto& [k, i] : program.active())
      weight_ = std::max(weight_, std::abs(program.node(k).multiplier(i)));
    if (!(weight_ < std::numeric_limits<double>::infinity())) weight_ = 1e12;
    const auto value = [&](const Plan& plan) {
      return value_of(problem, program, equalities, plan);
    };
    // Rounding decides for a solution.
    const double best = value(plan_), rounding = 1e-6 * std::abs(best);
    is_last_ =
        value(end) <= best + (is_solution(status_) ? -rounding : rounding) || !std::isfinite(best);
    if (!is_last_) return;
    plan_ = end;
    status_ = status;
    is_guess_ = false;
  }

  /// Replaces `plan` by `other` if that is better by the same measure.
  void choose(const Problem& problem, const Program& program,
              const AugmentedLagrangian<Problem>& equalities, Plan& plan, const Plan& other) {
    const double value = value_of(problem, program, equalities, plan);
    if (!(value <= value_of(problem, program, equalities, other))) plan = other;
  }

  [[nodiscard]] const Plan& guess() const { return guess_; }
  [[nodiscard]] const Plan& plan() const { return plan_; }
  /// How the start ended that led to plan(); `stalled` if it is the guess.
  [[nodiscard]] SolveStatus status() const { return status_; }
  [[nodiscard]] bool is_guess() const { return is_guess_; }
  [[nodiscard]] bool is_last() const { return is_last_; }  ///< plan() was offered last

 private:
  [[nodiscard]] double value_of(const Problem& problem, const Program& program,
                                const AugmentedLagrangian<Problem>& equalities, const Plan& plan) {
    merit_.weigh_alike(program, weight_);
    double sum = merit_.value(problem, program, equalities, plan);
    for (int k = 1; k <= plan.horizon(); ++k)
      sum += weight_ * equalities.distance(problem, k, plan.x(k));
    return sum;
  }

  Plan guess_, plan_;
  Merit<Problem, Program> merit_;
  SolveStatus status_ = SolveStatus::stalled;
  double weight_ = 0.0;
  bool is_guess_ = true, is_last_ = false;
};

}  // namespace tilt_ropter::optimal_control
