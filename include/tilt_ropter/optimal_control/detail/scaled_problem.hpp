// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

namespace tilt_ropter::optimal_control {

// A member of the user's problem may have the name of a variable below.
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wshadow"

/// The same problem with another unit of the cost and of each constraint, where its own is far from
/// costs of 1 to 10^4 and constraints of 10^-3 to 10^3, for which the thresholds of the solver are
/// made. The units are powers of two: scaling rounds nothing. States and inputs keep their units.
template <typename Problem>
class ScaledProblem : public Problem {
 public:
  using State = typename Problem::State;
  using Dimensions = ProblemDimensions<Problem>;
  using Input = typename Dimensions::Input;
  using Model = QuadraticModel<Dimensions::nx, Dimensions::nu>;
  using Constraints = ProblemConstraints<Problem>;
  using Rows = typename Constraints::Values;

  explicit ScaledProblem(Problem problem) : Problem(std::move(problem)) { forget_units(); }

  /// The units of the problem itself.
  void forget_units() {
    cost_unit_ = 1.0;
    for (Rows& units : row_units_) units.setOnes();
    natural_rows_ = true;
  }
  /// Chooses units by the guess, which is linearised in the problem's own: an unusual `cost`
  /// becomes about 64, and the largest bound of a constraint, or its distance from a bound of zero,
  /// about 1. node(k) has the values and bounds of node k. Returns false if all units stay.
  template <typename Nodes>
  bool choose_units(double cost, const Nodes& node) {
    forget_units();
    std::array<Rows, 2> size{Rows::Zero(), Rows::Zero()}, distance = size;
    for (int k = 0; k <= this->horizon(); ++k) {
      const auto& n = node(k);
      Rows &sizes = size[group(k)], &distances = distance[group(k)];
      for (int i = 0; i < Constraints::count; ++i)
        for (const double bound : {n.lower(i), n.upper(i)}) {
          if (!std::isfinite(bound)) continue;
          sizes(i) = std::max(sizes(i), std::abs(bound));
          distances(i) = std::max(distances(i), std::abs(n.value(i) - bound));
        }
    }
    const double root = power_of_two(std::sqrt(std::abs(cost) / 64.0));
    if (std::abs(cost) < 1e-1 || std::abs(cost) > 1e5) cost_unit_ = root * root;
    for (const std::size_t group : {0U, 1U})
      for (int i = 0; i < Constraints::count; ++i) {
        const double largest = size[group](i) > 0.0 ? size[group](i) : distance[group](i);
        if (largest >= 1e-3 && largest <= 1e3) continue;
        row_units_[group](i) = power_of_two(largest);
        natural_rows_ = natural_rows_ && row_units_[group](i) == 1.0;
      }
    return !natural();
  }
  [[nodiscard]] bool natural() const { return natural_rows_ && cost_unit_ == 1.0; }
  [[nodiscard]] bool natural_rows() const { return natural_rows_; }
  [[nodiscard]] double cost_unit() const { return cost_unit_; }
  /// Units of the constraints of node k.
  [[nodiscard]] const Rows& row_units(int k) const { return row_units_[group(k)]; }

  /// Multipliers of the constraints of node k in their own units, for the cost in its new unit.
  [[nodiscard]] Rows per_constraint(int k, const Rows& multipliers) const {
    Rows result = multipliers;
    for (int i = 0; !natural_rows_ && i < Constraints::count; ++i) result(i) /= row_units(k)(i);
    return result;
  }

  [[nodiscard]] double cost(int k, const State& x, const Input& u) const {
    return Problem::cost(k, x, u) / cost_unit_;
  }
  void cost_model(int k, const State& x, const Input& u, Model& model) const {
    scale(model, cost_unit_);
    Problem::cost_model(k, x, u, model);
    scale(model, 1.0 / cost_unit_);
  }

  [[nodiscard]] typename Dimensions::Equalities equality_weights(int k) const {
    typename Dimensions::Equalities weights = Problem::equality_weights(k);
    for (int i = 0; i < Dimensions::ne; ++i) weights(i) /= cost_unit_;
    return weights;
  }

 private:
  // 1 for constraints that only node N has, else 0.
  [[nodiscard]] std::size_t group(int k) const {
    return k == this->horizon() && Constraints::of_end >= 0;
  }
  static double power_of_two(double number) {
    if (!(number > 0.0) || !std::isfinite(number)) return 1.0;
    return std::exp2(std::round(std::log2(number)));
  }
  static void scale(Model& model, double factor) {
    if (factor == 1.0) return;
    for (Eigen::Index i = 0; i < model.hessian.size(); ++i) model.hessian.data()[i] *= factor;
    for (Eigen::Index i = 0; i < model.gradient.size(); ++i) model.gradient(i) *= factor;
  }

  double cost_unit_ = 1.0;
  std::array<Rows, 2> row_units_;
  bool natural_rows_ = true;
};
#pragma GCC diagnostic pop

/// The constraints in their new units.
template <typename Problem>
class ProblemConstraints<ScaledProblem<Problem>> : public ProblemConstraints<Problem> {
  using Own = ProblemConstraints<Problem>;

 public:
  using typename Own::ByInput;
  using typename Own::ByState;
  using typename Own::Input;
  using typename Own::State;
  using typename Own::Values;

  [[nodiscard]] static Values values(const ScaledProblem<Problem>& problem, int k, const State& x,
                                     const Input& u) {
    Values values = Own::values(problem, k, x, u);
    if (!problem.natural_rows())
      for (int i = 0; i < Own::count; ++i) values(i) /= problem.row_units(k)(i);
    return values;
  }
  static void derivatives(const ScaledProblem<Problem>& problem, int k, const State& x,
                          const Input& u, ByState& C, ByInput& E) {
    multiply(problem, k, C, E, 1.0);
    Own::derivatives(problem, k, x, u, C, E);
    multiply(problem, k, C, E, -1.0);
  }
  static void bounds(const ScaledProblem<Problem>& problem, int k, Values& lower, Values& upper,
                     Values& penalty, Values& stiffness) {
    Own::bounds(problem, k, lower, upper, penalty, stiffness);
    if (problem.natural()) return;
    for (int i = 0; i < Own::count; ++i) {
      const double unit = problem.row_units(k)(i);
      lower(i) /= unit;
      upper(i) /= unit;
      penalty(i) *= unit / problem.cost_unit();
      stiffness(i) *= unit * unit / problem.cost_unit();
    }
  }

 private:
  static void multiply(const ScaledProblem<Problem>& problem, int k, ByState& C, ByInput& E,
                       double power) {
    if (problem.natural_rows()) return;
    for (int i = 0; i < Own::count; ++i) {
      const double factor = power > 0.0 ? problem.row_units(k)(i) : 1.0 / problem.row_units(k)(i);
      for (int j = 0; j < C.cols(); ++j) C(i, j) *= factor;
      for (int j = 0; j < E.cols(); ++j) E(i, j) *= factor;
    }
  }
};

}  // namespace tilt_ropter::optimal_control
