// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace tilt_ropter::optimal_control {

/// States at the nodes 0 .. N and inputs of the intervals 0 .. N - 1. The input of node N is zero.
template <typename Problem>
class Trajectory {
 public:
  using State = typename Problem::State;
  using Tangent = typename ProblemDimensions<Problem>::Tangent;
  using Input = typename ProblemDimensions<Problem>::Input;

  /// Allocates; the functions below do not.
  explicit Trajectory(int horizon) : x_(detail::size(horizon) + 1), u_(x_.size(), Input::Zero()) {}

  [[nodiscard]] int horizon() const { return static_cast<int>(x_.size()) - 1; }
  [[nodiscard]] State& x(int k) { return x_[detail::size(k)]; }
  [[nodiscard]] const State& x(int k) const { return x_[detail::size(k)]; }
  [[nodiscard]] Input& u(int k) { return u_[detail::size(k)]; }
  [[nodiscard]] const Input& u(int k) const { return u_[detail::size(k)]; }

  void swap(Trajectory& other) noexcept {
    x_.swap(other.x_);
    u_.swap(other.u_);
  }

  /// Sets this trajectory to `here` plus `length` times the step of a quadratic program.
  template <typename Program>
  void set_moved(const Problem& problem, const Trajectory& here, const Program& program,
                 double length) {
    for (int k = 0; k <= horizon(); ++k) {
      const double* step = program.step(k).data();  // (dx, du)
      x(k) = problem.retract(here.x(k), scaled(length, step));
      for (int i = 0; k < horizon() && i < inputs; ++i)
        u(k)(i) = here.u(k)(i) + length * step[states + i];
    }
  }

  /// Moves the nodes `intervals` >= 0 ahead in time, by interpolation between the old nodes. Beyond
  /// the old end the last input continues. If the problem returns no finite state there, the last
  /// state stays.
  void shift(const Problem& problem, double intervals) {
    const double whole = std::floor(std::min(intervals, 1.0 * horizon()));
    for (int i = 0; i < static_cast<int>(whole); ++i) advance(problem, 1.0);
    if (intervals > whole) advance(problem, std::min(intervals - whole, 1.0));
  }

 private:
  static constexpr int states = Problem::states, inputs = Problem::inputs;

  static Tangent scaled(double factor, const double* entries) {
    Tangent result;
    for (int i = 0; i < states; ++i) result(i) = factor * entries[i];
    return result;
  }

  // Moves by a fraction `part` of one interval.
  void advance(const Problem& problem, double part) {
    const int n = horizon();
    Tangent ahead = problem.difference(problem.step(n - 1, x(n), u(n - 1)), x(n));
    if (!all_finite(ahead)) std::fill_n(ahead.data(), states, 0.0);
    for (int k = 0; k < n; ++k) {
      const Tangent to_next = problem.difference(x(k + 1), x(k));
      x(k) = problem.retract(x(k), scaled(part, to_next.data()));
      for (int i = 0; k + 1 < n && i < inputs; ++i) u(k)(i) += part * (u(k + 1)(i) - u(k)(i));
    }
    x(n) = problem.retract(x(n), scaled(part, ahead.data()));
  }

  std::vector<State> x_;
  std::vector<Input> u_;
};

/// Equality constraints of a problem as part of its cost: the sum over the nodes of (m + w h / 2) h
/// with weights w and multipliers m. As constraints of the dual, the equalities would cost ten
/// times more. Weights alone bring h only near zero; multipliers bring h to zero (Nocedal & Wright,
/// "Numerical Optimization", Sec. 17.3).
template <typename Problem>
class AugmentedLagrangian {
 public:
  using D = ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Equalities = typename D::Equalities;
  using Model = QuadraticModel<D::nx, D::nu>;

  /// Allocates; the functions below do not.
  AugmentedLagrangian(int horizon, double max_multiplier)
      : multipliers_(detail::size(horizon) + 1, detail::Filled()),
        added_(multipliers_.size()),
        max_multiplier_(max_multiplier) {}

  /// True if node k has an equality whose weight is positive or NaN.
  [[nodiscard]] bool has(const Problem& problem, int k) const {
    bool any = false;
    if constexpr (D::ne > 0) {
      const Equalities w = weights(problem, k);
      for (int i = 0; i < D::ne; ++i) any |= !(w(i) <= 0.0);
    }
    return any;
  }
  /// True if any node has such an equality.
  [[nodiscard]] bool any(const Problem& problem) const {
    for (std::size_t k = 0; k < multipliers_.size(); ++k)
      if (has(problem, static_cast<int>(k))) return true;
    return false;
  }

  /// Sets all multipliers to zero.
  void forget_multipliers() {
    for (Equalities& m : multipliers_) detail::fill(m, 0.0);
  }
  /// Divides all costs by `cost`, for another unit.
  void change_unit(double cost) {
    for (Equalities& m : multipliers_)
      for (int i = 0; i < D::ne; ++i) m(i) /= cost;
    max_multiplier_ /= cost;
    for (Added& added : added_)
      for (double& entry : added.entries) entry /= cost;
  }
  /// Moves the multipliers `nodes` nodes ahead in time. The multipliers of the last node stay.
  void shift(int nodes) {
    for (std::size_t k = 0; k < multipliers_.size(); ++k)
      multipliers_[k] = multipliers_[std::min(k + detail::size(nodes), multipliers_.size() - 1)];
  }
  /// Resets the weights to the weights of the problem.
  void forget_scale() {
    scale_ = 1.0;
    last_residual_ = detail::infinity;
  }

  /// Adds the terms of node k to the model of its cost. Returns the largest |h|.
  double add_to_model(const Problem& problem, int k, const State& x, Model& model) {
    double largest = 0.0;
    if constexpr (D::ne > 0) {
      if (!has(problem, k)) return 0.0;
      const Equalities w = weights(problem, k), h = problem.equality_values(k, x);
      typename D::EqualitiesX H;
      problem.equality_derivatives(k, x, H);
      Added& added = added_[detail::size(k)];
      for (int j = 0; j < D::nx; ++j) {  // most entries are usually zero
        bool any = false;
        for (int i = 0; i < D::ne; ++i) any |= H(i, j) != 0.0;
        if (any) added.columns[added.count++] = j;
      }
      const auto columns = added.begin(), end = added.end();
      double* entry = added.entries.data();
      for (auto a = columns; a != end; ++a) {
        *entry++ = model.lx()(*a);
        for (auto b = columns; b != end; ++b) *entry++ = model.lxx()(*b, *a);
      }
      for (int i = 0; i < D::ne; ++i) {
        if (w(i) <= 0.0) continue;
        largest = detail::larger(largest, std::abs(h(i)));
        const double slope = w(i) * h(i) + multiplier(k)(i);
        for (auto a = columns; a != end; ++a) {
          model.lx()(*a) += slope * H(i, *a);
          const double factor = w(i) * H(i, *a);
          if (factor == 0.0) continue;
          for (auto b = columns; b != end; ++b) model.lxx()(*b, *a) += factor * H(i, *b);
        }
        if (added.count == 0 && !std::isfinite(slope))
          largest = std::numeric_limits<double>::quiet_NaN();  // no entry of the model shows it
      }
    }
    return largest;
  }
  /// Restores the model of node k as it was before the last add_to_model().
  void take_from_model(int k, Model& model) {
    if constexpr (D::ne > 0) {
      Added& added = added_[detail::size(k)];
      const double* entry = added.entries.data();
      for (auto a = added.begin(); a != added.end(); ++a) {
        model.lx()(*a) = *entry++;
        for (auto b = added.begin(); b != added.end(); ++b) model.lxx()(*b, *a) = *entry++;
      }
      added.count = 0;
    }
  }

  /// Returns the terms of node k in the cost.
  [[nodiscard]] double value(const Problem& problem, int k, const State& x) const {
    double sum = 0.0;
    if constexpr (D::ne > 0) {
      if (!has(problem, k)) return 0.0;
      const Equalities w = weights(problem, k), h = problem.equality_values(k, x);
      for (int i = 0; i < D::ne; ++i)
        if (w(i) > 0.0) sum += (multiplier(k)(i) + 0.5 * w(i) * h(i)) * h(i);
    }
    return sum;
  }

  /// Returns the derivatives of the terms of node k by its equalities.
  [[nodiscard]] Equalities slopes(const Problem& problem, int k, const State& x) const {
    Equalities result = detail::Filled();
    if constexpr (D::ne > 0) {
      const Equalities w = weights(problem, k), h = problem.equality_values(k, x);
      for (int i = 0; i < D::ne; ++i)
        if (w(i) > 0.0) result(i) = multiplier(k)(i) + w(i) * h(i);
    }
    return result;
  }
  /// Returns the sum of |h| of node k.
  [[nodiscard]] double distance(const Problem& problem, int k, const State& x) const {
    double sum = 0.0;
    if constexpr (D::ne > 0) {
      if (!has(problem, k)) return 0.0;
      const Equalities w = problem.equality_weights(k), h = problem.equality_values(k, x);
      for (int i = 0; i < D::ne; ++i)
        if (w(i) > 0.0) sum += std::abs(h(i));
    }
    return sum;
  }

  /// Updates the multipliers after a step to `trajectory`. `residual` is the largest |h| at the
  /// start of the step. If full steps do not halve the residual, the weights grow.
  void update(const Problem& problem, const Trajectory<Problem>& trajectory, double residual,
              bool full_step) {
    if constexpr (D::ne > 0) {
      if (residual > 0.5 * last_residual_ && full_step) scale_ = std::min(3.0 * scale_, 1e4);
      last_residual_ = residual;
      for (int k = 1; k <= trajectory.horizon(); ++k) {
        const Equalities w = weights(problem, k), h = problem.equality_values(k, trajectory.x(k));
        for (int i = 0; i < D::ne; ++i) {
          double& m = multipliers_[detail::size(k)](i);
          m = w(i) > 0.0 ? m + w(i) * h(i) : 0.0;
          m = std::min(std::max(m, -max_multiplier_), max_multiplier_);
        }
      }
    }
  }

 private:
  // The states on which the equalities of a node depend, and the entries of the model for these
  // states before add_to_model().
  struct Added {
    [[nodiscard]] const int* begin() const { return columns.data(); }
    [[nodiscard]] const int* end() const { return columns.data() + count; }

    std::size_t count = 0;
    std::array<int, detail::size(D::nx)> columns{};
    std::array<double, detail::size(D::nx*(D::nx + 1))> entries{};
  };

  // The weights of node 0 are zero because the solver cannot change the measured state.
  [[nodiscard]] Equalities weights(const Problem& problem, int k) const {
    Equalities w = detail::Filled();
    if (k == 0) return w;
    w = problem.equality_weights(k);
    for (int i = 0; i < D::ne; ++i) w(i) *= scale_;
    return w;
  }
  [[nodiscard]] const Equalities& multiplier(int k) const { return multipliers_[detail::size(k)]; }

  std::vector<Equalities> multipliers_;
  std::vector<Added> added_;  // terms in the model of each node
  double max_multiplier_, scale_ = 1.0;
  double last_residual_ = detail::infinity;
};

}  // namespace tilt_ropter::optimal_control
