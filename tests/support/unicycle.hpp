#pragma once

#include "support/test_problem.hpp"

#include <Eigen/Core>

#include <cmath>

namespace test_support {

/// A unicycle that parks at the origin with heading along x. A disc stands in its way, and the
/// unicycle must drive slowly near the disc. State: position [m] and heading, a point on the circle
/// [rad]. Inputs: speed [m/s] and turn rate [rad/s].
struct UnicycleModel {
  static constexpr int states = 3, inputs = 2, constraints = 4, equalities = 0, residuals = 5;
  template <typename S>
  using StateOf = Eigen::Matrix<S, 3, 1>;
  template <typename S>
  using InputOf = Eigen::Matrix<S, 2, 1>;
  using D = tilt_ropter::optimal_control::ProblemDimensions<UnicycleModel>;

  int intervals = 6;
  double interval = 0.25;
  Eigen::Vector2d obstacle{-1.0, 0.1};
  double radius = 0.3;
  double terminal = 5.0;  // factor on the last node's residual

  template <typename S>
  StateOf<S> moved(const StateOf<S>& x, const StateOf<S>& dx) const {
    return {x(0) + dx(0), x(1) + dx(1), wrapped(S(x(2) + dx(2)))};
  }
  template <typename S>
  StateOf<S> between(const StateOf<S>& y, const StateOf<S>& x) const {
    return {y(0) - x(0), y(1) - x(1), wrapped(S(y(2) - x(2)))};
  }

  template <typename S>
  StateOf<S> rate(const StateOf<S>& x, const InputOf<S>& u) const {
    using std::cos;
    using std::sin;
    return {u(0) * cos(x(2)), u(0) * sin(x(2)), u(1)};
  }
  template <typename S>
  StateOf<S> flow(int, const StateOf<S>& x, const InputOf<S>& u) const {
    return runge_kutta_step(x, interval, [&](const StateOf<S>& y) { return rate<S>(y, u); });
  }
  Eigen::Vector3d flow_derivatives(int, const Eigen::Vector3d& x, const D::Input& u, D::A& A,
                                   D::B& B) const {
    return runge_kutta_step(
        x, interval, [&](const Eigen::Vector3d& y) { return rate<double>(y, u); },
        [&](const Eigen::Vector3d& y) {
          D::A f = D::A::Zero();
          f(0, 2) = -u(0) * std::sin(y(2));
          f(1, 2) = u(0) * std::cos(y(2));
          return f;
        },
        [](const Eigen::Vector3d& y) {
          D::B f;
          f << std::cos(y(2)), 0.0, std::sin(y(2)), 0.0, 0.0, 1.0;
          return f;
        },
        A, B);
  }

  template <typename S>
  Eigen::Matrix<S, 5, 1> residual(int k, const StateOf<S>& x, const InputOf<S>& u) const {
    using std::sin;
    const S w(factor(k)), r(input_weight(k));
    Eigen::Matrix<S, 5, 1> e;
    e << w * x(0), w * x(1), w * sin(x(2) / S(2)), r * u(0), r * u(1);
    return e;
  }
  template <typename ByState, typename ByInput>
  void residual_derivatives(int k, const Eigen::Vector3d& x, const D::Input&, ByState& by_state,
                            ByInput& by_input) const {
    by_state.setZero();
    by_state(0, 0) = by_state(1, 1) = factor(k);
    by_state(2, 2) = factor(k) * 0.5 * std::cos(x(2) / 2.0);
    by_input.setZero();
    by_input(3, 0) = by_input(4, 1) = input_weight(k);
  }

  /// Squared distance to the centre of the obstacle; speed minus half of this squared distance;
  /// speed; turn rate.
  template <typename S>
  Eigen::Matrix<S, 4, 1> constraints_of(int, const StateOf<S>& x, const InputOf<S>& u) const {
    const S dx = x(0) - S(obstacle.x()), dy = x(1) - S(obstacle.y());
    const S square = dx * dx + dy * dy;
    return {square, u(0) - S(0.5) * square, u(0), u(1)};
  }
  void constraint_derivatives(int, const Eigen::Vector3d& x, const D::Input&, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    C.setZero();
    E.setZero();
    C.block<1, 2>(0, 0) = 2.0 * (x.head<2>() - obstacle).transpose();
    C.row(1) = -0.5 * C.row(0);
    E(1, 0) = E(2, 0) = E(3, 1) = 1.0;
  }
  void constraint_bounds(int k, D::Constraints& lower, D::Constraints& upper,
                         D::Constraints& penalty) const {
    lower << radius * radius, -infinity, -0.5, -2.0;
    upper << infinity, 1.0, 2.0, 2.0;
    if (k == 0) lower(0) = -infinity;
    if (k == intervals) {
      lower.tail<3>().setConstant(-infinity);
      upper.tail<3>().setConstant(infinity);
    }
    penalty.setConstant(1e4);
  }

 private:
  template <typename S>
  static S wrapped(const S& angle) {
    using std::atan2;
    using std::cos;
    using std::sin;
    return atan2(S(sin(angle)), S(cos(angle)));
  }
  double factor(int k) const { return k == intervals ? terminal : 1.0; }
  double input_weight(int k) const { return k == intervals ? 0.0 : 0.3; }
};

using Unicycle = TestProblem<UnicycleModel>;

}  // namespace test_support
