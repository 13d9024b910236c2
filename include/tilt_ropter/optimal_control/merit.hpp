// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/optimal_control/augmented_lagrangian.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/problem_rows.hpp>
#include <tilt_ropter/optimal_control/subproblem.hpp>
#include <tilt_ropter/optimal_control/trajectory.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace tilt_ropter {

/// By how much a value is outside its bounds; NaN for NaN.
[[nodiscard]] inline double violation(double value, double lower, double upper) {
  const double over = std::max(value - upper, lower - value);
  return over <= 0.0 ? 0.0 : over;
}

/// The merit function of a line search: cost + weighted 1-norms of defects and violations (Nocedal
/// & Wright, "Numerical Optimization", Sec. 15.4), whose weights follow the multipliers (Powell
/// 1978).
template <typename Problem, typename Program>
class Merit {
 public:
  using D = ProblemDimensions<Problem>;
  using Tangent = typename D::Tangent;
  using AllRows = ProblemRows<Problem>;
  using Rows = typename AllRows::Values;

  /// Allocates; the functions below do not.
  explicit Merit(int horizon)
      : defect_weights_(static_cast<std::size_t>(horizon) + 1),
        row_weights_(defect_weights_.size()) {
    forget();
  }

  void forget() {
    for (Tangent& w : defect_weights_) w.setZero();
    for (Rows& w : row_weights_) w.setZero();
  }

  /// Weights from the multipliers of a solved program; returns the merit's slope along its step.
  double update(const Program& program, int horizon) {
    double slope = 0.0;
    Tangent adjoint = Tangent::Zero();  // multiplier of the continuity that ends at node k
    for (int k = horizon; k >= 0; --k) {
      const auto& s = program.riccati.stage(k);
      const auto& rows = program.node(k);
      Rows& row_weight = row_weights_[static_cast<std::size_t>(k)];
      const double* step = program.step(k).data();  // (dx, du)
      for (int i = 0; i < (k < horizon ? D::nx + D::nu : D::nx); ++i)
        slope += s.cost.gradient(i) * step[i];
      for (int i = 0; i < AllRows::count; ++i) {
        follow(row_weight(i), rows.multiplier(i));
        // Beyond the price, the merit would rise towards the solution that pays it.
        row_weight(i) = std::min(row_weight(i), rows.price(i));
        slope += of_row(rows, row_weight, i, rows.predicted(i)) -
                 of_row(rows, row_weight, i, rows.value(i));
      }
      if (k < horizon) {
        Tangent& defect_weight = defect_weights_[static_cast<std::size_t>(k)];
        for (int i = 0; i < D::nx; ++i) follow(defect_weight(i), adjoint(i));
        slope -= weighted_norm(defect_weight, s.defect.data());
      }
      adjoint = adjoint_before(program, k, adjoint);
    }
    return slope;
  }

  /// At the point where `program` was linearised, which has this cost.
  [[nodiscard]] double value_here(const Problem& problem, const Program& program,
                                  const AugmentedLagrangian<Problem>& equalities,
                                  const Trajectory<Problem>& here, double cost) const {
    double sum = cost;
    for (int k = 0; k <= here.horizon(); ++k) {
      sum += equalities.value(problem, k, here.x(k)) + of_rows(program, k, program.node(k).value);
      if (k < here.horizon())
        sum += weighted_norm(defect_weight(k), program.riccati.stage(k).defect.data());
    }
    return sum;
  }

  /// Anywhere else.
  [[nodiscard]] double value(const Problem& problem, const Program& program,
                             const AugmentedLagrangian<Problem>& equalities,
                             const Trajectory<Problem>& at) const {
    double sum = 0.0;
    for (int k = 0; k <= at.horizon(); ++k) {
      const auto& x = at.x(k);
      const auto& u = at.u(k);
      sum += problem.cost(k, x, u) + equalities.value(problem, k, x);
      sum += of_rows(program, k, AllRows::values(problem, k, x, u));
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

  // The multiplier of the continuity that ends at node k, from that of the next one (k < N).
  [[nodiscard]] static Tangent adjoint_before(const Program& program, int k, const Tangent& after) {
    typename Program::Vector gradient;
    program.template cost_gradient<2>(k, program.step(k), program.damping(), gradient);
    program.template add_row_gradients<2>(k, program.node(k).multiplier.data(), gradient);
    const auto& transition = program.riccati.stage(k).transition;
    Tangent before;
    for (int j = 0; j < D::nx; ++j) before(j) = gradient(j);
    for (int i = 0; k < program.horizon() && i < D::nx; ++i)
      for (int j = 0; j < D::nx; ++j) before(j) += transition(j, i) * after(i);
    return before;
  }

  [[nodiscard]] static double weighted_norm(const Tangent& weight, const double* defect) {
    double sum = 0.0;
    for (int i = 0; i < D::nx; ++i) sum += weight(i) * std::abs(defect[i]);
    return sum;
  }

  [[nodiscard]] const Tangent& defect_weight(int k) const {
    return defect_weights_[static_cast<std::size_t>(k)];
  }

  [[nodiscard]] double of_rows(const Program& program, int k, const Rows& value) const {
    const auto& rows = program.node(k);
    const Rows& weight = row_weights_[static_cast<std::size_t>(k)];
    double sum = 0.0;
    for (int i = 0; i < AllRows::count; ++i) sum += of_row(rows, weight, i, value(i));
    return sum;
  }
  // What it costs by itself, or a weight times its violation.
  [[nodiscard]] static double of_row(const typename Program::Node& rows, const Rows& weight, int i,
                                     double value) {
    const double v = violation(value, rows.lower(i), rows.upper(i));
    return std::isfinite(rows.stiffness(i)) ? violation_cost(rows.price(i), rows.stiffness(i), v)
                                            : weight(i) * v;
  }

  std::vector<Tangent> defect_weights_;  // of the interval that starts at the node
  std::vector<Rows> row_weights_;
};

}  // namespace tilt_ropter
