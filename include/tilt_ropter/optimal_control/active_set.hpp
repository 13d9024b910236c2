// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/optimal_control/subproblem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace tilt_ropter {

/// Solves a Subproblem by Newton steps on its first-order conditions, each of them one Riccati
/// pass: constraints that are held at a bound enter the pass as quadratic terms,
///
///     multiplier = m + weight (value - bound),
///
/// with their last multiplier m and a weight that is large beside the cost's own curvature, those
/// at their price by their multiplier, the others not at all. Where the pass contradicts what it
/// assumed of a constraint, the next one assumes otherwise (an augmented Lagrangian with a
/// semismooth Newton method; Hintermueller, Ito & Kunisch, "The primal-dual active set strategy as
/// a semismooth Newton method", 2003). Nothing is singular, however many constraints hold and
/// however they depend on one another.
///
/// From the last solution one pass or two are enough as a rule. From far away they may never end,
/// which the number of contradictions tells early.
template <int States, int Inputs, int Rows, typename Pattern>
class ActiveSet {
 public:
  using Program = Subproblem<States, Inputs, Rows, Pattern>;

  /// Allocates everything for `horizon` intervals.
  explicit ActiveSet(int horizon)
      : states_(static_cast<std::size_t>(horizon) + 1),
        curvatures_(states_.size(), Program::Vector::Ones()),
        weights_(states_.size()),
        offsets_(states_.size()) {}

  /// Assumes what the multipliers in the nodes say.
  void assume(const Program& program) {
    stiffening_ = least_stiffening;
    for (int k = 0; k <= program.horizon(); ++k)
      for (int i = 0; i < Rows; ++i) {
        const auto& n = program.node(k);
        const double m = n.multiplier(i);
        const double bound = m > 0.0 ? n.upper(i) : n.lower(i);
        state(k, i) = m == 0.0 || !std::isfinite(bound) ? 0
                      : std::abs(m) >= n.price(i)       ? (m > 0.0 ? 2 : -2)
                                                        : (m > 0.0 ? 1 : -1);
      }
  }

  /// How much it costs to move a constraint with this gradient, from the curvature of the last pass
  /// in which none held.
  [[nodiscard]] double curvature(int k, const typename Program::Vector& row) const {
    const auto& curvature = curvatures_[static_cast<std::size_t>(k)];
    double squares = 0.0, weighted = 0.0;
    for (Eigen::Index j = 0; j < row.size(); ++j) {
      squares += row(j) * row(j);
      weighted += row(j) * row(j) * curvature(j);
    }
    return weighted / (squares * squares);
  }

  /// A pass in which no constraint holds: notes the curvature that weights are measured by. False
  /// if the cost has no minimum.
  [[nodiscard]] bool factorise_free(Program& program, double damping) {
    double most = 0.0;
    const auto note = [&](int k, double* hessian, double*) {
      auto& c = curvatures_[static_cast<std::size_t>(k)];
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

  /// One pass with what is assumed. False if the cost has no minimum.
  [[nodiscard]] bool factorise(Program& program, double damping) {
    const auto terms = [&](int k, double* hessian, double* gradient) {
      add_terms(program, k, hessian, gradient);
    };
    return program.riccati.factorise(damping, terms);
  }

  /// Makes weights ten times as large, as far as rounding allows: where many constraints hold, the
  /// cost's own curvature is no measure of what they stand against.
  void stiffen() { stiffening_ = std::min(10.0 * stiffening_, most_stiffening); }

  /// The step of the last pass for the initial step dx0, and its multipliers, in the nodes of
  /// `program`. Returns the number of constraints that contradict what was assumed; from now on the
  /// opposite is.
  int solve(Program& program, const typename Program::Tangent& dx0) {
    program.set_first(dx0);
    program.riccati.sweep(program.steps());
    program.predict();
    int contradictions = 0;
    for (int k = 0; k <= program.horizon(); ++k) {
      auto& n = program.node(k);
      for (int i = 0; i < Rows; ++i) contradictions += judge(program, n, k, i);
    }
    return contradictions;
  }

 private:
  // Of a constraint: 0 free, +-1 held at its upper or lower bound, +-2 at its price there.
  using States8 = std::array<signed char, static_cast<std::size_t>(Rows)>;

  signed char& state(int k, int i) {
    return states_[static_cast<std::size_t>(k)][static_cast<std::size_t>(i)];
  }
  double& weight(int k, int i) {
    return weights_[static_cast<std::size_t>(k)][static_cast<std::size_t>(i)];
  }

  double& offset(int k, int i) {
    return offsets_[static_cast<std::size_t>(k)][static_cast<std::size_t>(i)];
  }

  void add_terms(const Program& program, int k, double* hessian, double* gradient) {
    constexpr int width = Program::width, rows = Program::rows;
    for (int i = 0; i < Rows; ++i) {
      const int assumed = state(k, i);
      if (assumed == 0) continue;
      const auto& n = program.node(k);
      double row[static_cast<std::size_t>(width)];
      for (int j = 0; j < States; ++j) row[j] = n.C(i, j);
      for (int j = 0; j < Inputs; ++j) row[States + j] = k < program.horizon() ? n.E(i, j) : 0.0;
      double slope = assumed > 0 ? n.price(i) : -n.price(i);
      if (assumed == 1 || assumed == -1) {
        double squares = 0.0, curvature = 0.0;
        for (int j = 0; j < width; ++j) {
          const double square = row[j] * row[j];
          squares += square;
          curvature += square * curvatures_[static_cast<std::size_t>(k)](j);
        }
        if (squares == 0.0) {
          state(k, i) = 0;
          continue;
        }
        // The first input is what is used, and stiffness hurts least where the pass ends.
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

  // 1 if the constraint contradicts what was assumed.
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
      m = 0.5 * assumed * n.price(i);
      return 0;
    }
    const double side = assumed > 0 ? 1.0 : -1.0;
    const double bound = assumed > 0 ? n.upper(i) : n.lower(i);
    if (assumed == 2 || assumed == -2) {
      m = side * n.price(i);
      if (side * (value - bound) >= n.price(i) / n.stiffness(i) - outside(bound)) return 0;
      assumed = side > 0.0 ? 1 : -1;
      return 1;
    }
    m = weight(k, i) * (value - bound + offset(k, i));
    if (side * m > n.price(i)) {
      m = side * n.price(i);
      assumed = side > 0.0 ? 2 : -2;
      return 1;
    }
    if (side * m >= 0.0) return 0;
    m = 0.0;
    assumed = 0;
    return 1;
  }

  static constexpr double tolerance = 1e-8;  // relative violation that is none
  static constexpr double least_stiffening = 1e6, most_stiffening = 1e10;
  static constexpr double least_curvature = 1e-6;  // of the largest

  double stiffening_ = least_stiffening;  // weights over the cost's curvature
  std::vector<States8> states_;
  std::vector<typename Program::Vector> curvatures_;  // diagonals of H in a pass without weights
  std::vector<std::array<double, static_cast<std::size_t>(Rows)>> weights_, offsets_;
};

}  // namespace tilt_ropter
