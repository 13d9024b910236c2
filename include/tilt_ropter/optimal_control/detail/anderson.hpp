// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>

#include <Eigen/Core>

#include <algorithm>

/// Anderson acceleration (Anderson 1965; Walker & Ni, "Anderson acceleration for fixed-point
/// iterations", 2011) of an iteration x <- x + f(x) that converges slowly, oscillates or diverges.
/// It is a secant method that uses only the visited points and their f.
namespace tilt_ropter::optimal_control {

/// Stores the last moves of an iteration and computes the accelerated step. Allocates only in the
/// constructor.
class Anderson {
 public:
  using Vector = Eigen::VectorXd;

  /// For vectors of `size` entries. Stores the last `memory` moves.
  Anderson(Eigen::Index size, int memory)
      : size_(static_cast<int>(size)),
        moves_(size, memory),
        changes_(size, memory),
        step_(size),
        gram_(memory, memory),
        factor_(memory, memory),
        weights_(memory) {}

  [[nodiscard]] bool empty() const { return count_ == 0; }
  void clear() { count_ = next_ = 0; }

  /// Adds a move between two points. `before` and `after` are f at these points. The entries should
  /// be scaled to similar importance.
  void add(const Vector& move, const Vector& before, const Vector& after) {
    const int memory = static_cast<int>(weights_.size());
    for (int i = 0; i < size_; ++i) {
      moves_(i, next_) = move(i);
      changes_(i, next_) = after(i) - before(i);
    }
    count_ = std::min(count_ + 1, memory);
    for (int i = 0; i < count_; ++i)
      gram_(i, next_) = gram_(next_, i) = detail::dot(change(i), change(next_), size_);
    next_ = (next_ + 1) % memory;
  }

  /// Returns the accelerated step from a point with this f. The step combines the stored moves so
  /// that the predicted f is smallest in the 2-norm.
  [[nodiscard]] const Vector& step(const Vector& f) {
    solve(f);
    std::copy_n(f.data(), size_, step_.data());
    for (const Matrix* columns : {&changes_, &moves_})
      detail::add_product(-1.0, {columns->data(), size_, count_, size_}, {weights_.data()},
                          step_.data());
    return step_;
  }

 private:
  using Matrix = Eigen::MatrixXd;

  [[nodiscard]] const double* change(int i) const { return &changes_(0, i); }

  // Least squares by the normal equations. A column that depends linearly on the columns before it
  // gets weight zero.
  void solve(const Vector& f) {
    for (int j = 0; j < count_; ++j) {
      weights_(j) = detail::dot(change(j), f.data(), size_);
      for (int i = j; i < count_; ++i) factor_(i, j) = gram_(i, j);
      factor_(j, j) *= 1.0 + 1e-10;
    }
    (void)detail::factorise(factor_.data(), factor_.rows(), count_, 1e-11);
    detail::solve_factorised(factor_.data(), factor_.rows(), count_, weights_.data());
  }

  int size_;
  Matrix moves_, changes_;  // one column per move
  Vector step_;
  Matrix gram_, factor_;  // changes_' changes_ and its lower Cholesky factor
  Vector weights_;
  int count_ = 0, next_ = 0;
};

}  // namespace tilt_ropter::optimal_control
