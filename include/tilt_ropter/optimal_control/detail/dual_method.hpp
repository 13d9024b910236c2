// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/multipliers.hpp>
#include <tilt_ropter/optimal_control/detail/riccati.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <utility>
#include <vector>

namespace tilt_ropter::optimal_control {

/// Solves a Subproblem by the dual of the constraints in a working set. One adjoint sweep computes
/// the gradients of these constraints by the coordinates z of Riccati, all in one batch. NLopt
/// solves for the multipliers. A forward sweep shows which constraints the solution violates. These
/// constraints join the working set, and the next round starts. The first working set contains the
/// constraints that had a multiplier in the last solution. Their gradients need no measurement, so
/// prepare() computes them.
///
/// This is the fastest method for a few constraints. The work grows with the cube of their number,
/// and the memory with its square.
template <int States, int Inputs, int Constraints, typename Pattern>
class DualMethod {
 public:
  using Program = Subproblem<States, Inputs, Constraints, Pattern>;
  using Adjoint = AdjointBatch<States, Inputs, Pattern>;

  /// Allocates everything for `horizon` intervals and `capacity` constraints.
  DualMethod(int horizon, int capacity, DualAlgorithm algorithm)
      : capacity_(capacity),
        dual_(capacity, algorithm),
        gradients_(Eigen::MatrixXd::Zero(capacity, Inputs * horizon)),
        gram_(Eigen::MatrixXd::Zero(capacity, capacity)),
        offsets_(Eigen::VectorXd::Zero(capacity)),
        bounds_(offsets_),
        multipliers_(offsets_),
        z_(Eigen::VectorXd::Zero(Inputs * horizon)),
        in_set_(detail::size(horizon) + 1) {
    active_.reserve(detail::size(capacity));
    for (auto& batch : adjoints_) batch.setZero(detail::padded(capacity), States + Inputs);
  }

  [[nodiscard]] int capacity() const { return capacity_; }
  [[nodiscard]] bool late() const { return dual_.late(); }  ///< the deadline has passed
  [[nodiscard]] int rounds() const { return rounds_; }      ///< rounds of the last solve()
  /// These are as in DualSolver.
  void begin(int most_evaluations) { dual_.begin(most_evaluations); }
  [[nodiscard]] int evaluations() const { return dual_.evaluations(); }
  [[nodiscard]] int polishing_steps() const { return dual_.polishing_steps(); }

  /// Builds the first working set and computes its gradients. Requires the factorisation of
  /// `program` without terms. Returns false if the working set has more than capacity()
  /// constraints.
  [[nodiscard]] bool prepare(const Program& program) {
    active_.clear();
    for (const auto& [k, i] : program.active()) {
      const double m = program.node(k).multiplier(i);
      if (!std::isfinite(m > 0.0 ? program.node(k).upper(i) : program.node(k).lower(i))) continue;
      if (size() == capacity_) return false;
      multipliers_(size()) = std::abs(m);
      active_.push_back({k, i, m > 0.0 ? 1.0 : -1.0});
    }
    add_gradients(program, 0);
    return true;
  }

  /// Computes the step for the initial step dx0 and the multipliers. Stores the step in `program`
  /// and the multipliers in its nodes. Requires prepare(). The working set grows to at most `most`
  /// constraints (`most` <= capacity()). Returns true if no constraint outside of it is violated;
  /// false if it is full, if no rounds are left, or if no finite multipliers were found before the
  /// deadline.
  [[nodiscard]] bool solve(Program& program, const typename Program::Tangent& dx0,
                           std::optional<SolverClock::time_point> deadline, int most) {
    program.sweep(dx0);
    for (int i = 0; i < size(); ++i) offsets_(i) = violation(program, row(i));
    for (rounds_ = 1;; ++rounds_) {
      const int count = size();
      if (count > 0) {
        if (!dual_.solve(count, gram_, offsets_, bounds_, multipliers_, deadline)) return false;
        for (int j = 0; j < z_.size(); ++j)
          z_(j) = -detail::dot(&gradients_(0, j), multipliers_.data(), count);
        program.riccati.sweep(program.steps(), z_.data());
        program.predict();
      }
      const int first = size();
      const bool has_room = add_violated(program, most);
      if (size() == first && has_room) break;
      if (!has_room || rounds_ == max_rounds) {
        active_.resize(detail::size(first));
        store_multipliers(program);
        return false;
      }
      add_gradients(program, first);
      for (int i = first; i < size(); ++i) {
        multipliers_(i) = 0.0;
        offsets_(i) = violation(program, row(i));
      }
      // Value of a constraint for zero multipliers: its current value minus the contribution of z.
      if (first > 0)
        detail::add_product(-1.0, gradients(first, static_cast<int>(z_.size())), {z_.data()},
                            &offsets_(first));
    }
    store_multipliers(program);
    return true;
  }

 private:
  /// A constraint of the working set: `component` of node k, at its upper (+1) or lower (-1) bound.
  struct Active {
    int k, component;
    double side;
    [[nodiscard]] std::size_t slot() const {
      return detail::size(side > 0.0 ? Constraints + component : component);
    }
  };

  [[nodiscard]] int size() const { return static_cast<int>(active_.size()); }
  [[nodiscard]] const Active& row(int i) const { return active_[detail::size(i)]; }

  [[nodiscard]] static double violation(const Program& program, const Active& r) {
    const auto& n = program.node(r.k);
    return r.side > 0.0 ? n.predicted(r.component) - n.upper(r.component)
                        : n.lower(r.component) - n.predicted(r.component);
  }

  /// Adds the constraints that the prediction violates to the working set. Returns false if there
  /// are more than `most`.
  [[nodiscard]] bool add_violated(const Program& program, int most) {
    if (program.excess() <= constraint_tolerance) return true;
    for (auto& flags : in_set_) flags.fill(false);
    for (const Active& r : active_) in_set_[detail::size(r.k)][r.slot()] = true;
    for (int k = program.horizon(); k >= 0; --k) {
      const auto& n = program.node(k);
      for (int i = 0; i < Constraints; ++i) {
        const double over = n.predicted(i) - n.upper(i), under = n.lower(i) - n.predicted(i);
        const double bound = over > under ? n.upper(i) : n.lower(i);
        if (std::max(over, under) <= constraint_tolerance * (1.0 + std::abs(bound))) continue;
        const Active r{k, i, over > under ? 1.0 : -1.0};
        if (in_set_[detail::size(k)][r.slot()]) continue;
        if (size() == most) return false;
        active_.push_back(r);
      }
    }
    return true;
  }

  /// Computes the gradients by z of the constraints from `first` on, and their part of G G'. The
  /// constraints from `first` on are ordered by decreasing node, so one adjoint sweep serves all.
  void add_gradients(const Program& program, int first) {
    const int last = size();
    if (first == last) return;
    auto *after = &adjoints_[0], *here = &adjoints_[1];
    int count = 0;  // constraints whose node the sweep has reached
    for (int k = program.horizon(); k >= 0; --k) {
      if (count > 0) Adjoint::step_back(program.riccati.stage(k), *after, *here, count);
      for (; first + count < last && row(first + count).k == k; ++count) {
        const Active& r = row(first + count);
        if (count % detail::packet_width == 0)  // stale numbers in the rest of the packet decay
          for (int j = 0; j < States + Inputs; ++j)
            std::fill_n(&(*here)(count, j), detail::packet_width, 0.0);
        const auto gradient = program.constraint_gradient(r.k, r.component);
        for (int j = 0; j < States + Inputs; ++j) (*here)(count, j) = r.side * gradient(j);
        bounds_(first + count) = program.node(k).penalty(r.component);
      }
      if (k < program.horizon()) {
        if (count > 0) Adjoint::to_coordinates(program.riccati.stage(k), *here, count);
        for (int j = 0; j < Inputs; ++j) {
          double* column = &gradients_(first, Inputs * k + j);
          std::copy_n(&(*here)(0, States + j), count, column);
          std::fill(column + count, column + last - first, 0.0);
        }
      }
      std::swap(after, here);
    }
    add_gram(program, first);
  }

  /// Returns the gradients of the constraints from `first` on, by the first `count` entries of z.
  [[nodiscard]] detail::MatrixView gradients(int first, int count) const {
    return {gradients_.data() + first, size() - first, count, capacity_};
  }

  /// Computes the lower triangle of G G' + 1 / stiffness for the constraints from `first` on. The
  /// gradient of a constraint is zero for all nodes after its own.
  void add_gram(const Program& program, int first) {
    const int last = size(), end = Inputs * std::min(row(first).k + 1, program.horizon());
    for (int j = 0; j < last; ++j) {
      const int start = std::max(first, j);
      double* column = &gram_(start, j);
      std::fill_n(column, last - start, 0.0);
      detail::add_product(1.0, gradients(start, end), {&gradients_(j, 0), capacity_}, column);
    }
    for (int i = first; i < last; ++i) {
      const Active& r = row(i);
      gram_(i, i) += 1.0 / std::min(program.node(r.k).stiffness(r.component), most_stiffness);
    }
  }

  void store_multipliers(Program& program) const {
    for (int k = 0; k <= program.horizon(); ++k)
      std::fill_n(program.node(k).multiplier.data(), Constraints, 0.0);
    for (int i = 0; i < size(); ++i)
      if (multipliers_(i) > 0.0)
        program.node(row(i).k).multiplier(row(i).component) += row(i).side * multipliers_(i);
  }

  static constexpr int max_rounds = 20;  // in which constraints join the working set
  // Violation, relative to the bound, above which a constraint joins the working set.
  static constexpr double constraint_tolerance = 1e-9;
  // Limit that keeps the dual regular if constraints are multiples of each other.
  static constexpr double most_stiffness = 1e12;

  int capacity_;
  DualSolver dual_;
  std::vector<Active> active_;
  Eigen::MatrixXd gradients_;  // row i: gradient of constraint i of the working set by z
  std::array<typename Adjoint::Gradients, 2> adjoints_;
  Eigen::MatrixXd gram_;
  Eigen::VectorXd offsets_, bounds_, multipliers_, z_;
  std::vector<std::array<bool, 2 * detail::size(Constraints)>> in_set_;
  int rounds_ = 0;
};

}  // namespace tilt_ropter::optimal_control
