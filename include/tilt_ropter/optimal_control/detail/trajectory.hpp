// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
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
  explicit Trajectory(int horizon)
      : x_(static_cast<std::size_t>(horizon) + 1), u_(x_.size(), Input::Zero()) {}

  [[nodiscard]] int horizon() const { return static_cast<int>(x_.size()) - 1; }
  [[nodiscard]] State& x(int k) { return x_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const State& x(int k) const { return x_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] Input& u(int k) { return u_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Input& u(int k) const { return u_[static_cast<std::size_t>(k)]; }

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

}  // namespace tilt_ropter::optimal_control
