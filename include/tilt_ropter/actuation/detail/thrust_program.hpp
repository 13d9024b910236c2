// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

/// Small convex program for the allocation of thrusts, and an interior-point method that solves it.
namespace tilt_ropter::detail {

/// Convex set of thrusts of one rotor, in units of its largest thrust. The set has the half-planes
/// normal . t >= offset and, if `radius` is not zero, the disc |t| <= radius.
struct ThrustRegion {
  static constexpr int most = 3;

  Eigen::Vector2d center = Eigen::Vector2d::Zero();  ///< strictly inside the set
  std::array<Eigen::Vector2d, most> normal;
  std::array<double, most> offset{};
  int half_planes = 0;
  double radius = 1.0;

  void add(const Eigen::Vector2d& inward, double least) noexcept {
    normal[static_cast<std::size_t>(half_planes)] = inward;
    offset[static_cast<std::size_t>(half_planes)] = least;
    ++half_planes;
  }
};

/// Minimises a linear or a quadratic function of the variables z. The thrusts
/// t_i(z) = base_i + columns_i z must be in the region of each rotor i. The last `Bounded`
/// variables must satisfy lower < z < upper.
///
/// The method is a primal-dual interior-point method with feasible iterates (Boyd and Vandenberghe,
/// Convex Optimization, 2004, Sec. 11.7). Every iterate is strictly inside all constraints, so a
/// search that ends early still gives valid thrusts. Work and memory are bounded, and the result is
/// deterministic. Nothing throws or allocates.
template <int Rotors, int Variables, int Bounded>
class ThrustProgram {
 public:
  using Vector = Eigen::Matrix<double, Variables, 1>;
  static constexpr int first_bounded = Variables - Bounded;
  static constexpr int max_iterations = 80;

  /// Rows 2i and 2i + 1 belong to rotor i. They are zero for a rotor that `used` excludes.
  Eigen::Matrix<double, 2 * Rotors, 1> base;
  Eigen::Matrix<double, 2 * Rotors, Variables> columns;
  std::array<ThrustRegion, static_cast<std::size_t>(Rotors)> regions;
  std::array<bool, static_cast<std::size_t>(Rotors)> used{};
  std::array<double, static_cast<std::size_t>(Bounded)> lower{}, upper{};
  bool cautious = false;  ///< smaller steps, which converge in a few more cases

  /// Fixes variable `j` at its value in `z`.
  void fix(int j, const Vector& z) noexcept {
    base += z(j) * columns.col(j);
    columns.col(j).setZero();
    free_[static_cast<std::size_t>(j)] = false;
  }
  void release(int j) noexcept { free_[static_cast<std::size_t>(j)] = true; }
  [[nodiscard]] bool is_free(int j) const noexcept { return free_[static_cast<std::size_t>(j)]; }

  /// Moves `z`, which must be strictly inside, so that sign z(j) increases. Returns true where z(j)
  /// reaches `goal`; then z(j) = goal exactly. Returns false where the duality gap falls below
  /// `tolerance`. With `only_goal` it also returns false where the gap excludes the goal.
  [[nodiscard]] bool push(int j, double sign, double goal, bool only_goal, double tolerance,
                          Vector& z) const noexcept {
    Vector cost = Vector::Zero();
    cost(j) = -sign;
    return minimise(cost, 0.0, z, tolerance, {j, sign, goal, only_goal});
  }

  /// Moves `z` to the point of least |z| over the free variables before `first_bounded`.
  void shorten(double tolerance, Vector& z) const noexcept {
    (void)minimise(Vector::Zero(), 1.0, z, tolerance, {-1, 0.0, 0.0, false});
  }

 private:
  static constexpr int per_rotor = ThrustRegion::most + 1;
  static constexpr int constraints = Rotors * per_rotor + 2 * Bounded;
  using Numbers = std::array<double, static_cast<std::size_t>(constraints)>;
  using Thrusts = Eigen::Matrix<double, 2 * Rotors, 1>;

  /// Calls plane(k, row, normal, offset) for each half-plane and disc(k, row, radius) for each
  /// disc. Calls bound(k, variable, side, shift) for each bound side z + shift > 0. k counts
  /// constraints. `row` is the first row of the rotor.
  template <typename Plane, typename Disc, typename Bound>
  void each(const Plane& plane, const Disc& disc, const Bound& bound) const noexcept {
    std::size_t k = 0;
    for (std::size_t i = 0; i < Rotors; ++i) {
      if (!used[i]) continue;
      const ThrustRegion& region = regions[i];
      for (int p = 0; p < region.half_planes; ++p)
        plane(k++, static_cast<Eigen::Index>(2 * i), region.normal[static_cast<std::size_t>(p)],
              region.offset[static_cast<std::size_t>(p)]);
      if (region.radius > 0.0) disc(k++, static_cast<Eigen::Index>(2 * i), region.radius);
    }
    for (std::size_t b = 0; b < Bounded; ++b) {
      const auto j = static_cast<Eigen::Index>(b) + first_bounded;
      if (!free_[static_cast<std::size_t>(j)]) continue;
      bound(k++, j, 1.0, -lower[b]);
      bound(k++, j, -1.0, upper[b]);
    }
  }

  /// Computes the slack of each constraint, > 0 inside. Returns the number of constraints.
  std::size_t slacks(const Vector& z, const Thrusts& t, Numbers& slack) const noexcept {
    std::size_t count = 0;
    each(
        [&](std::size_t k, Eigen::Index row, const Eigen::Vector2d& normal, double offset) {
          slack[k] = normal.x() * t(row) + normal.y() * t(row + 1) - offset;
          count = k + 1;
        },
        [&](std::size_t k, Eigen::Index row, double radius) {
          const double size = std::sqrt(t(row) * t(row) + t(row + 1) * t(row + 1));
          slack[k] = 0.5 * (radius - size) * (radius + size);
          count = k + 1;
        },
        [&](std::size_t k, Eigen::Index j, double sign, double shift) {
          slack[k] = sign * z(j) + shift;
          count = k + 1;
        });
    return count;
  }

  /// Writes the slacks at `z` and returns true if all of them are > 0.
  bool inside(const Vector& z, Numbers& slack) const noexcept {
    const std::size_t count = slacks(z, base + columns * z, slack);
    bool all = true;
    for (std::size_t k = 0; k < count; ++k) all = all && slack[k] > 0.0;
    return all;
  }

  struct Target {
    int variable;
    double sign, goal;
    bool only_goal;
  };

  /// Minimises cost . z + weight |z|^2 / 2, with the square over the variables before
  /// `first_bounded`. Returns true if it ends at the target.
  bool minimise(const Vector& cost, double weight, Vector& z, double tolerance,
                const Target& target) const noexcept;

  std::array<bool, static_cast<std::size_t>(Variables)> free_{};
};

template <int Rotors, int Variables, int Bounded>
bool ThrustProgram<Rotors, Variables, Bounded>::minimise(const Vector& cost, double weight,
                                                         Vector& z, double tolerance,
                                                         const Target& target) const noexcept {
  Numbers slack, multiplier, change;
  Thrusts t = base + columns * z;
  const std::size_t count = slacks(z, t, slack);
  const auto constraint_count = static_cast<double>(count);
  // Start on the central path, with a duality gap of the size of the cost.
  const double first_gap =
      std::max(std::sqrt(cost.squaredNorm()) + weight * std::sqrt(z.squaredNorm()), 1e-6);
  for (std::size_t k = 0; k < count; ++k) multiplier[k] = first_gap / constraint_count / slack[k];

  double last_length = 1.0;
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    double gap = 0.0;
    for (std::size_t k = 0; k < count; ++k) gap += multiplier[k] * slack[k];

    // Gradient of the Lagrangian, gradient of the barrier sum log(slack), and reduced Hessian. The
    // terms of the rotors are first summed in each rotor's plane.
    Vector gradient = cost, barrier = Vector::Zero();
    Eigen::Matrix<double, Variables, Variables> hessian;
    hessian.setZero();
    for (int j = 0; j < first_bounded; ++j) {
      gradient(j) += weight * z(j);
      hessian(j, j) = weight;
    }
    const Vector cost_gradient = gradient;
    Thrusts thrust_gradient = Thrusts::Zero(), thrust_barrier = Thrusts::Zero();
    std::array<double, static_cast<std::size_t>(Rotors)> xx{}, xy{}, yy{};
    const auto add = [&](std::size_t k, Eigen::Index row, double x, double y) {
      const auto rotor = static_cast<std::size_t>(row / 2);
      const double ratio = multiplier[k] / slack[k];
      thrust_gradient(row) -= multiplier[k] * x;
      thrust_gradient(row + 1) -= multiplier[k] * y;
      thrust_barrier(row) += x / slack[k];
      thrust_barrier(row + 1) += y / slack[k];
      xx[rotor] += ratio * x * x;
      xy[rotor] += ratio * x * y;
      yy[rotor] += ratio * y * y;
    };
    each([&](std::size_t k, Eigen::Index row, const Eigen::Vector2d& normal,
             double) { add(k, row, normal.x(), normal.y()); },
         [&](std::size_t k, Eigen::Index row, double) {
           add(k, row, -t(row), -t(row + 1));
           xx[static_cast<std::size_t>(row / 2)] += multiplier[k];
           yy[static_cast<std::size_t>(row / 2)] += multiplier[k];
         },
         [&](std::size_t k, Eigen::Index j, double side, double) {
           gradient(j) -= multiplier[k] * side;
           barrier(j) += side / slack[k];
           hessian(j, j) += multiplier[k] / slack[k];
         });
    gradient += columns.transpose() * thrust_gradient;
    barrier += columns.transpose() * thrust_barrier;
    const double residual = std::sqrt(gradient.squaredNorm());
    if (gap < tolerance && (residual < 1e-3 * tolerance + 1e-12 || gap < 1e-4 * tolerance))
      return false;
    const bool aims = target.variable >= 0;
    const double ahead = aims ? target.sign * (target.goal - z(target.variable)) : 0.0;
    if (target.only_goal && residual < 1e-6 && ahead > gap + 10.0 * residual + tolerance)
      return false;
    for (int i = 0; i < Rotors; ++i) {
      const auto rotor = static_cast<std::size_t>(i);
      if (!used[rotor]) continue;
      for (int j = 0; j < Variables; ++j) {
        const double a = columns(2 * i, j), b = columns(2 * i + 1, j);
        const double x = xx[rotor] * a + xy[rotor] * b, y = xy[rotor] * a + yy[rotor] * b;
        for (int l = 0; l <= j; ++l)
          hessian(j, l) += columns(2 * i, l) * x + columns(2 * i + 1, l) * y;
      }
    }

    // A short step means that the iterate is off the central path. The next step leads back to it.
    const double centering = cautious            ? 0.5
                             : last_length > 0.7 ? 0.1
                             : last_length > 0.3 ? 0.4
                                                 : 0.9;
    const double mu = centering * gap / constraint_count;
    Vector step = mu * barrier - cost_gradient;
    factorise(hessian);  // directions without curvature get a zero step
    solve_factorised(hessian, step.data());
    for (int j = 0; j < Variables; ++j)
      if (!is_free(j)) step(j) = 0.0;

    // Longest steps that keep slacks and multipliers positive.
    const Thrusts move = columns * step;
    double longest = 1e3, dual_longest = 1.0;
    const auto limit_step = [&](std::size_t k, double slope, double square) {
      // The slack after a step of length a is slack + a slope - a^2 square / 2.
      change[k] = mu / slack[k] - multiplier[k] * slope / slack[k] - multiplier[k];
      if (change[k] < 0.0) dual_longest = std::min(dual_longest, -multiplier[k] / change[k]);
      if (square > 0.0) {
        const double root = std::sqrt(slope * slope + 2.0 * square * slack[k]);
        longest = std::min(longest,
                           slope > 0.0 ? (slope + root) / square : 2.0 * slack[k] / (root - slope));
      } else if (slope < 0.0) {
        longest = std::min(longest, -slack[k] / slope);
      }
    };
    each([&](std::size_t k, Eigen::Index row, const Eigen::Vector2d& normal,
             double) { limit_step(k, normal.x() * move(row) + normal.y() * move(row + 1), 0.0); },
         [&](std::size_t k, Eigen::Index row, double) {
           limit_step(k, -(t(row) * move(row) + t(row + 1) * move(row + 1)),
                      move(row) * move(row) + move(row + 1) * move(row + 1));
         },
         [&](std::size_t k, Eigen::Index j, double side, double) {
           limit_step(k, side * step(j), 0.0);
         });
    double length = std::min({1.0, 0.95 * longest, 0.95 * dual_longest});
    if (aims) {
      const double progress = target.sign * step(target.variable);
      const double to_goal = ahead / progress;
      if (progress > 0.0 && to_goal <= std::max(length, 0.9 * longest)) {
        Vector there = z + to_goal * step;
        there(target.variable) = target.goal;
        if (to_goal <= length || inside(there, slack)) {
          z = there;
          return true;
        }
      }
    }
    // Rounding may put a step outside if the feasible region is no thicker than the rounding error.
    Vector next = z + length * step;
    bool stays = inside(next, slack);
    for (int halving = 0; halving < 4 && !stays; ++halving) {
      length *= 0.5;
      next = z + length * step;
      stays = inside(next, slack);
    }
    if (!stays) return false;
    z = next;
    t = base + columns * z;
    last_length = length;
    for (std::size_t k = 0; k < count; ++k) multiplier[k] += length * change[k];
  }
  return false;
}

}  // namespace tilt_ropter::detail
