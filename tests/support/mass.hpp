#pragma once

#include <Eigen/Core>

#include <limits>

namespace test_support {

/// A mass on a line that moves to `target` [m], with a bounded force [N] and speed [m/s]. For
/// AutoDiffProblem.
struct Mass {
  static constexpr int states = 2, inputs = 1, residuals = 3, constraints = 2;
  static constexpr double infinity = std::numeric_limits<double>::infinity();
  template <typename S>
  using Vector2 = Eigen::Matrix<S, 2, 1>;
  template <typename S>
  using Vector1 = Eigen::Matrix<S, 1, 1>;
  using Bounds = Eigen::Vector2d;

  int intervals = 30;
  double target = 1.0;
  Bounds low{-1.0, -infinity}, high{1.0, 0.4}, penalties{infinity, 1e3},
      stiffnesses{infinity, infinity};

  int horizon() const { return intervals; }
  template <typename S>
  Vector2<S> step(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {x(0) + S(0.1) * x(1) + S(0.005) * u(0), x(1) + S(0.1) * u(0)};
  }
  template <typename S>
  Eigen::Matrix<S, 3, 1> residual(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {x(0) - S(target), S(0.1) * x(1), S(0.1) * u(0)};
  }
  template <typename S>
  Vector2<S> constraint_values(int, const Vector2<S>& x, const Vector1<S>& u) const {
    return {u(0), x(1)};
  }
  Bounds lower(int) const { return low; }
  Bounds upper(int) const { return high; }
  Bounds penalty(int) const { return penalties; }
  Bounds stiffness(int) const { return stiffnesses; }
};

}  // namespace test_support
