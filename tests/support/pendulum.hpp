#pragma once

#include "support/test_problem.hpp"

#include <Eigen/Core>

#include <cmath>

namespace test_support {

/// A pendulum of 1 kg and 1 m that must swing up. The torque u is too small to lift it (9.81 N m
/// would hold it horizontally). State: angle from upright [rad] and angular velocity [rad/s].
struct PendulumModel {
  static constexpr int states = 2, inputs = 1, constraints = 1, equalities = 0, residuals = 3;
  template <typename S>
  using StateOf = Eigen::Matrix<S, 2, 1>;
  template <typename S>
  using InputOf = Eigen::Matrix<S, 1, 1>;
  using D = tilt_ropter::optimal_control::ProblemDimensions<PendulumModel>;

  int intervals = 5;
  double interval = 0.1;
  double max_torque = 3.0;
  double terminal = 10.0;  // factor on the last node's residual

  template <typename S>
  StateOf<S> moved(const StateOf<S>& x, const StateOf<S>& dx) const {
    return x + dx;
  }
  template <typename S>
  StateOf<S> between(const StateOf<S>& y, const StateOf<S>& x) const {
    return y - x;
  }

  template <typename S>
  StateOf<S> rate(const StateOf<S>& x, const InputOf<S>& u) const {
    using std::sin;
    return {x(1), S(gravity) * sin(x(0)) - S(friction) * x(1) + u(0)};
  }
  template <typename S>
  StateOf<S> flow(int, const StateOf<S>& x, const InputOf<S>& u) const {
    return runge_kutta_step(x, interval, [&](const StateOf<S>& y) { return rate<S>(y, u); });
  }
  Eigen::Vector2d flow_derivatives(int, const Eigen::Vector2d& x, const D::Input& u, D::A& A,
                                   D::B& B) const {
    return runge_kutta_step(
        x, interval, [&](const Eigen::Vector2d& y) { return rate<double>(y, u); },
        [](const Eigen::Vector2d& y) {
          D::A f;
          f << 0.0, 1.0, gravity * std::cos(y(0)), -friction;
          return f;
        },
        [](const Eigen::Vector2d&) { return D::B(0.0, 1.0); }, A, B);
  }

  template <typename S>
  Eigen::Matrix<S, 3, 1> residual(int k, const StateOf<S>& x, const InputOf<S>& u) const {
    const S w(factor(k));
    return {w * x(0), w * S(0.3) * x(1), S(input_weight(k)) * u(0)};
  }
  template <typename ByState, typename ByInput>
  void residual_derivatives(int k, const Eigen::Vector2d&, const D::Input&, ByState& by_state,
                            ByInput& by_input) const {
    by_state << factor(k), 0.0, 0.0, 0.3 * factor(k), 0.0, 0.0;
    by_input << 0.0, 0.0, input_weight(k);
  }

  template <typename S>
  InputOf<S> constraints_of(int, const StateOf<S>&, const InputOf<S>& u) const {
    return u;
  }
  void constraint_derivatives(int, const Eigen::Vector2d&, const D::Input&, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    C.setZero();
    E.setOnes();
  }
  void constraint_bounds(int k, D::Constraints& lower, D::Constraints& upper,
                         D::Constraints& penalty) const {
    upper(0) = k == intervals ? infinity : max_torque;
    lower = -upper;
    penalty(0) = 1e4;
  }

 private:
  double factor(int k) const { return k == intervals ? terminal : 1.0; }
  double input_weight(int k) const { return k == intervals ? 0.0 : 0.1; }
  static constexpr double gravity = 9.81, friction = 0.1;
};

using Pendulum = TestProblem<PendulumModel>;

}  // namespace test_support
