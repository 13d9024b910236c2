// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace tilt_ropter::optimal_control {

/// Active-set solver for a Subproblem: Newton steps on its first-order conditions. Each step is one
/// Riccati pass. A constraint that is assumed active at a bound adds a quadratic term to the pass:
///
///     multiplier = m + weight (value - bound).
///
/// m is the last multiplier of the constraint. The weight is large compared to the curvature of the
/// cost. A relaxed constraint (multiplier at its penalty) adds its multiplier to the gradient only.
/// An inactive constraint adds nothing. If a pass contradicts the assumption for a constraint, the
/// next pass uses the corrected assumption. This is an augmented Lagrangian with a semismooth
/// Newton method (Hintermueller, Ito & Kunisch, "The primal-dual active set strategy as a
/// semismooth Newton method", 2003). No matrix is singular, for any number of active constraints
/// and also if they are linearly dependent.
///
/// From the last solution, one or two passes are usually enough. From a distant start, the passes
/// may never converge; the number of contradictions shows this early.
template <int States, int Inputs, int Constraints, typename Pattern>
class ActiveSet {
 public:
  using Program = Subproblem<States, Inputs, Constraints, Pattern>;

  /// Allocates everything for `horizon` intervals.
  explicit ActiveSet(int horizon)
      : states_(detail::size(horizon) + 1),
        curvatures_(states_.size(), Program::Vector::Ones()),
        weights_(states_.size()),
        offsets_(states_.size()) {}

  /// Sets the assumption for each constraint from its multiplier in the node.
  void assume(const Program& program) {
    stiffening_ = std::min(stiffening_, usual_stiffening);
    for (int k = 0; k <= program.horizon(); ++k)
      for (int i = 0; i < Constraints; ++i) {
        const auto& n = program.node(k);
        const double m = n.multiplier(i);
        const double bound = m > 0.0 ? n.upper(i) : n.lower(i);
        state(k, i) = m == 0.0 || !std::isfinite(bound) ? 0
                      : std::abs(m) >= n.penalty(i)     ? (m > 0.0 ? 2 : -2)
                                                        : (m > 0.0 ? 1 : -1);
      }
  }

  /// Number of constraints that are assumed active or relaxed.
  [[nodiscard]] int assumed() const {
    int count = 0;
    for (const auto& states : states_)
      for (const auto state : states) count += state != 0 ? 1 : 0;
    return count;
  }

  /// Returns the curvature of the cost along the value of a constraint of node k: the cost of
  /// moving this constraint. `row` is the gradient of the constraint by (dx, du). Uses the Hessians
  /// of the last pass without active constraints.
  [[nodiscard]] double curvature(int k, const typename Program::Vector& row) const {
    const auto& curvature = curvatures_[detail::size(k)];
    double squares = 0.0, weighted = 0.0;
    for (Eigen::Index j = 0; j < row.size(); ++j) {
      squares += row(j) * row(j);
      weighted += row(j) * row(j) * curvature(j);
    }
    return weighted / (squares * squares);
  }

  /// Riccati pass without active constraints. Stores the curvature of the cost, which is the
  /// reference for the weights. `damping` is added to the diagonals of the Hessians. Returns false
  /// if the cost has no minimum.
  [[nodiscard]] bool factorise_free(Program& program, double damping) {
    stiffening_ = usual_stiffening;
    double most = 0.0;
    const auto note = [&](int k, double* hessian, double*) {
      auto& c = curvatures_[detail::size(k)];
      for (int j = 0; j < Program::width; ++j) {
        c(j) = hessian[(Program::rows + 1) * j];
        most = std::max(most, c(j));
      }
    };
    const bool good = program.riccati.factorise(damping, note);
    for (auto& c : curvatures_)
      for (Eigen::Index j = 0; j < c.size(); ++j) c(j) = std::max(c(j), least_curvature * most);
    return good;
  }

  /// One Riccati pass with the current assumptions. Returns false if the cost has no minimum.
  [[nodiscard]] bool factorise(Program& program, double damping) {
    const auto terms = [&](int k, double* hessian, double* gradient) {
      add_terms(program, k, hessian, gradient);
    };
    return program.riccati.factorise(damping, terms);
  }

  /// Divides what is known of the cost of node k by `cost`, for another unit.
  void change_unit(int k, double cost) {
    for (double& c : curvatures_[detail::size(k)]) c /= cost;
  }
  /// Multiplies the weights by 10, up to a limit that is set by rounding errors. Necessary if many
  /// constraints are active: the curvature of the cost alone is then too small as a reference for
  /// the weights.
  void stiffen() { stiffening_ = std::min(10.0 * stiffening_, most_stiffening); }

  /// Divides the weights by 10, down to a limit: the stiffer they are, the larger is the rounding
  /// error of the inputs. Lasts until the next factorise_free(), which has new curvatures.
  void soften() { stiffening_ = std::max(0.1 * stiffening_, least_stiffening); }

  /// Computes the step of the last pass for the initial step dx0, and its multipliers. Stores the
  /// step in `program` and the multipliers in its nodes. Returns the number of constraints that
  /// contradict their assumption. The assumptions of these constraints are corrected for the next
  /// pass.
  int solve(Program& program, const typename Program::Tangent& dx0) {
    program.sweep(dx0);
    int contradictions = 0;
    for (int k = 0; k <= program.horizon(); ++k) {
      auto& n = program.node(k);
      for (int i = 0; i < Constraints; ++i) contradictions += judge(program, n, k, i);
    }
    return contradictions;
  }

 private:
  // State of a constraint: 0 inactive, +-1 active at its upper or lower bound, +-2 relaxed at that
  // bound (multiplier at its penalty).
  using States8 = std::array<signed char, detail::size(Constraints)>;

  signed char& state(int k, int i) { return states_[detail::size(k)][detail::size(i)]; }
  double& weight(int k, int i) { return weights_[detail::size(k)][detail::size(i)]; }

  double& offset(int k, int i) { return offsets_[detail::size(k)][detail::size(i)]; }

  void add_terms(const Program& program, int k, double* hessian, double* gradient) {
    constexpr int width = Program::width, rows = Program::rows;
    for (int i = 0; i < Constraints; ++i) {
      const signed char assumed = state(k, i);
      if (assumed == 0) continue;
      const auto& n = program.node(k);
      double row[detail::size(width)];
      for (int j = 0; j < States; ++j) row[j] = n.C(i, j);
      for (int j = 0; j < Inputs; ++j) row[States + j] = k < program.horizon() ? n.E(i, j) : 0.0;
      double slope = assumed > 0 ? n.penalty(i) : -n.penalty(i);
      if (assumed == 1 || assumed == -1) {
        double squares = 0.0, curvature = 0.0;
        for (int j = 0; j < width; ++j) {
          const double square = row[j] * row[j];
          squares += square;
          curvature += square * curvatures_[detail::size(k)](j);
        }
        if (squares == 0.0) {
          state(k, i) = 0;
          continue;
        }
        // Node 0 gets a larger weight because its input is applied. A stiff term does the least
        // harm there, because the backward pass ends at node 0.
        const double stiff = (k == 0 ? 100.0 : 1.0) * stiffening_ * curvature / (squares * squares);
        const double w = 1.0 / (1.0 / stiff + 1.0 / n.stiffness(i));
        weight(k, i) = w;
        slope =
            w * (n.value(i) - (assumed > 0 ? n.upper(i) : n.lower(i)) + n.multiplier(i) / stiff);
        offset(k, i) = n.multiplier(i) / stiff;
        for (int j = 0; j < width; ++j) {
          if (row[j] == 0.0) continue;
          const double factor = w * row[j];
          const int first = j < States ? j : 0, last = j < States ? States : width;
          for (int l = first; l < last; ++l) hessian[rows * j + l] += factor * row[l];
        }
      }
      for (int j = 0; j < width; ++j) gradient[j] += slope * row[j];
    }
  }

  // Sets the multiplier of constraint i of node k and corrects its assumption. Returns 1 if the
  // result contradicted the assumption, otherwise 0.
  int judge(const Program& program, typename Program::Node& n, int k, int i) {
    signed char& assumed = state(k, i);
    double& m = n.multiplier(i);
    const double value = n.predicted(i);
    const auto outside = [&](double bound) { return tolerance * (1.0 + std::abs(bound)); };
    if (assumed == 0) {
      m = 0.0;
      if (value - n.upper(i) > outside(n.upper(i)))
        assumed = 1;
      else if (n.lower(i) - value > outside(n.lower(i)))
        assumed = -1;
      if (assumed == 0) return 0;
      if (program.can_move(k, i)) return 1;
      assumed = static_cast<signed char>(2 * assumed);
      m = 0.5 * assumed * n.penalty(i);
      return 0;
    }
    const double side = assumed > 0 ? 1.0 : -1.0;
    const double bound = assumed > 0 ? n.upper(i) : n.lower(i);
    if (assumed == 2 || assumed == -2) {
      m = side * n.penalty(i);
      if (side * (value - bound) >= n.penalty(i) / n.stiffness(i) - outside(bound)) return 0;
      assumed = side > 0.0 ? 1 : -1;
      return 1;
    }
    m = weight(k, i) * (value - bound + offset(k, i));
    if (side * m > n.penalty(i)) {
      m = side * n.penalty(i);
      assumed = side > 0.0 ? 2 : -2;
      return 1;
    }
    if (side * m >= 0.0) return 0;
    m = 0.0;
    assumed = 0;
    return 1;
  }

  static constexpr double tolerance = 1e-8;  // relative violation that still counts as satisfied
  static constexpr double least_stiffening = 1e3, usual_stiffening = 1e6, most_stiffening = 1e10;
  static constexpr double least_curvature = 1e-6;  // relative to the largest curvature

  double stiffening_ = usual_stiffening;  // ratio of the weights to the curvature of the cost
  std::vector<States8> states_;
  std::vector<typename Program::Vector> curvatures_;  // diagonals of H in a pass without weights
  std::vector<std::array<double, detail::size(Constraints)>> weights_, offsets_;
};

}  // namespace tilt_ropter::optimal_control
