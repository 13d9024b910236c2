#pragma once

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

/// Anderson acceleration (Anderson 1965; Walker & Ni, "Anderson acceleration for fixed-point
/// iterations", 2011) of an iteration x <- x + f(x) that creeps, oscillates or even diverges: a
/// secant method that knows only the points seen and their f.
namespace tilt_ropter {

/// Allocates in its constructor only.
template <typename Scalar = double>
class Anderson {
 public:
  using Vector = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;

  /// For vectors of `size` entries, remembering the last `memory` moves.
  Anderson(Eigen::Index size, int memory)
      : moves_(size, memory),
        changes_(size, memory),
        step_(size),
        gram_(memory, memory),
        factor_(memory, memory),
        weights_(memory) {}

  [[nodiscard]] bool empty() const { return count_ == 0; }
  void clear() { count_ = next_ = 0; }

  /// A move between two points and their f, whose entries should be scaled to matter alike.
  void add(const Vector& move, const Vector& before, const Vector& after) {
    moves_.col(next_) = move;
    changes_.col(next_) = after - before;
    count_ = std::min(count_ + 1, static_cast<int>(moves_.cols()));
    for (int i = 0; i < count_; ++i)
      gram_(i, next_) = gram_(next_, i) = changes_.col(i).dot(changes_.col(next_));
    next_ = (next_ + 1) % static_cast<int>(moves_.cols());
  }

  /// The step from a point with this f after which f is predicted to be smallest, in the 2-norm.
  [[nodiscard]] const Vector& step(const Vector& f) {
    step_ = f;
    solve(f);
    for (int i = 0; i < count_; ++i) step_ -= weights_(i) * (changes_.col(i) + moves_.col(i));
    return step_;
  }

 private:
  // Least squares by its normal equations; columns that the others hold already get no weight.
  void solve(const Vector& f) {
    for (int j = 0; j < count_; ++j) {
      for (int k = 0; k < j; ++k) {
        Scalar sum = gram_(j, k);
        for (int i = 0; i < k; ++i) sum -= factor_(j, i) * factor_(k, i);
        factor_(j, k) = factor_(k, k) > Scalar(0) ? sum / factor_(k, k) : Scalar(0);
      }
      const Scalar rest = gram_(j, j) * Scalar(1.0 + 1e-10) - factor_.row(j).head(j).squaredNorm();
      factor_(j, j) = rest > Scalar(1e-11) * gram_(j, j) ? std::sqrt(rest) : Scalar(0);
      const Scalar sum = changes_.col(j).dot(f) - factor_.row(j).head(j).dot(weights_.head(j));
      weights_(j) = factor_(j, j) > Scalar(0) ? sum / factor_(j, j) : Scalar(0);
    }
    for (int j = count_ - 1; j >= 0; --j) {
      const int below = count_ - 1 - j;
      const Scalar sum =
          weights_(j) - factor_.col(j).segment(j + 1, below).dot(weights_.segment(j + 1, below));
      weights_(j) = factor_(j, j) > Scalar(0) ? sum / factor_(j, j) : Scalar(0);
    }
  }

  using Matrix = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;

  Matrix moves_, changes_;  // one column each
  Vector step_;
  Matrix gram_, factor_;  // changes' changes and its lower Cholesky factor
  Vector weights_;
  int count_ = 0, next_ = 0;
};

}  // namespace tilt_ropter
