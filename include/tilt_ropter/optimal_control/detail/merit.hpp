// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/optimal_control/detail/augmented_lagrangian.hpp>
#include <tilt_ropter/optimal_control/detail/problem_constraints.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>
#include <tilt_ropter/optimal_control/detail/trajectory.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace tilt_ropter::optimal_control {

/// Returns the distance of `value` outside its bounds, or zero if it is inside; NaN for NaN.
[[nodiscard]] inline double violation(double value, double lower, double upper) {
  const double over = std::max(value - upper, lower - value);
  return over <= 0.0 ? 0.0 : over;
}

/// Merit function of the line search: cost + weighted 1-norms of defects and violations (Nocedal &
/// Wright, "Numerical Optimization", Sec. 15.4). The weights follow the multipliers (Powell 1978).
template <typename Problem, typename Program>
class Merit {
 public:
  using D = ProblemDimensions<Problem>;
  using Tangent = typename D::Tangent;
  using AllConstraints = ProblemConstraints<Problem>;
  using Constraints = typename AllConstraints::Values;

  /// Allocates; the functions below do not.
  explicit Merit(int horizon)
      : defect_weights_(static_cast<std::size_t>(horizon) + 1),
        constraint_weights_(defect_weights_.size()) {
    forget();
  }

  /// Sets all weights to zero.
  void forget() {
    for (Tangent& w : defect_weights_) w.setZero();
    for (Constraints& w : constraint_weights_) w.setZero();
  }

  /// Sets every weight to `weight`, but that of a soft constraint at most to its penalty.
  void weigh_alike(const Program& program, double weight) {
    for (std::size_t k = 0; k < defect_weights_.size(); ++k) {
      const auto& node = program.node(static_cast<int>(k));
      for (int i = 0; i < D::nx; ++i) defect_weights_[k](i) = weight;
      for (int i = 0; i < AllConstraints::count; ++i)
        constraint_weights_[k](i) =
            node.hard[static_cast<std::size_t>(i)] ? weight : std::min(weight, node.penalty(i));
    }
  }

  /// Updates the weights from the multipliers of a solved program. Returns the slope of the merit
  /// function along the step of the program.
  double update(const Program& program, int horizon) {
    double slope = 0.0;
    double largest = 0.0;
    for (int k = 1; k <= horizon; ++k)
      largest = std::max(largest, detail::largest(program.costate(k)));
    const double least = least_share * largest;
    for (int k = horizon; k >= 0; --k) {
      const auto& s = program.riccati.stage(k);
      const auto& node = program.node(k);
      Constraints& constraint_weight = constraint_weights_[static_cast<std::size_t>(k)];
      const double* step = program.step(k).data();  // (dx, du)
      for (int i = 0; i < (k < horizon ? D::nx + D::nu : D::nx); ++i)
        slope += s.cost.gradient(i) * step[i];
      for (int i = 0; i < AllConstraints::count; ++i) {
        follow(constraint_weight(i), node.multiplier(i));
        // With a weight above the penalty, the merit would rise towards a solution that relaxes
        // this constraint.
        constraint_weight(i) = std::min(constraint_weight(i), node.penalty(i));
        slope += of_constraint(node, constraint_weight, i, node.predicted(i)) -
                 of_constraint(node, constraint_weight, i, node.value(i));
      }
      if (k < horizon) {
        Tangent& defect_weight = defect_weights_[static_cast<std::size_t>(k)];
        for (int i = 0; i < D::nx; ++i)
          follow(defect_weight(i), std::max(least, std::abs(program.costate(k + 1)(i))));
        slope -= weighted_norm(defect_weight, s.defect.data());
      }
    }
    return slope;
  }

  /// Returns the merit at the point where `program` was linearised; `cost` is the cost there.
  [[nodiscard]] double value_here(const Problem& problem, const Program& program,
                                  const AugmentedLagrangian<Problem>& equalities,
                                  const Trajectory<Problem>& here, double cost) const {
    double sum = cost;
    for (int k = 0; k <= here.horizon(); ++k) {
      sum += equalities.value(problem, k, here.x(k)) +
             of_constraints(program, k, program.node(k).value);
      if (k < here.horizon())
        sum += weighted_norm(defect_weight(k), program.riccati.stage(k).defect.data());
    }
    return sum;
  }

  /// Returns the merit at any other trajectory.
  [[nodiscard]] double value(const Problem& problem, const Program& program,
                             const AugmentedLagrangian<Problem>& equalities,
                             const Trajectory<Problem>& at) const {
    double sum = 0.0;
    for (int k = 0; k <= at.horizon(); ++k) {
      const auto& x = at.x(k);
      const auto& u = at.u(k);
      sum += problem.cost(k, x, u) + equalities.value(problem, k, x);
      sum += of_constraints(program, k, AllConstraints::values(problem, k, x, u));
      if (k < at.horizon()) {
        const Tangent defect = problem.difference(problem.step(k, x, u), at.x(k + 1));
        sum += weighted_norm(defect_weight(k), defect.data());
      }
    }
    return sum;
  }

 private:
  static void follow(double& weight, double multiplier) {
    const double m = 1.1 * std::abs(multiplier);
    weight = std::max(m, 0.5 * (weight + m));
  }

  [[nodiscard]] static double weighted_norm(const Tangent& weight, const double* defect) {
    double sum = 0.0;
    for (int i = 0; i < D::nx; ++i) sum += weight(i) * std::abs(defect[i]);
    return sum;
  }

  [[nodiscard]] const Tangent& defect_weight(int k) const {
    return defect_weights_[static_cast<std::size_t>(k)];
  }

  [[nodiscard]] double of_constraints(const Program& program, int k,
                                      const Constraints& value) const {
    const auto& node = program.node(k);
    const Constraints& weight = constraint_weights_[static_cast<std::size_t>(k)];
    double sum = 0.0;
    for (int i = 0; i < AllConstraints::count; ++i) sum += of_constraint(node, weight, i, value(i));
    return sum;
  }
  // Cost of the violation if the stiffness is finite, otherwise the weight times the violation.
  [[nodiscard]] static double of_constraint(const typename Program::Node& node,
                                            const Constraints& weight, int i, double value) {
    const double v = violation(value, node.lower(i), node.upper(i));
    return std::isfinite(node.stiffness(i)) ? violation_cost(node.penalty(i), node.stiffness(i), v)
                                            : weight(i) * v;
  }

  static constexpr double least_share = 0.01;

  std::vector<Tangent> defect_weights_;  // one for each interval, at its first node
  std::vector<Constraints> constraint_weights_;
};

}  // namespace tilt_ropter::optimal_control
