#pragma once

#include "support/test_problem.hpp"

#include <Eigen/Core>

namespace test_support {

/// A mass on a line, in steps of one second with constant force: p+ = p + v + u/2, v+ = v + u. The
/// last position must reach `target`. Optional: |u| <= max_input, and the mass must stop at the end
/// (an equality). State: p [m], v [m/s].
struct DoubleIntegratorModel {
  static constexpr int states = 2, inputs = 1, constraints = 1, equalities = 1, residuals = 3;
  template <typename S>
  using StateOf = Eigen::Matrix<S, 2, 1>;
  template <typename S>
  using InputOf = Eigen::Matrix<S, 1, 1>;
  using D = tilt_ropter::optimal_control::ProblemDimensions<DoubleIntegratorModel>;

  int intervals = 7;
  double target = 0.0;
  double max_input = infinity;
  bool stops = false;
  double position_weight = 1.0;  // of the residual of the last position
  double velocity_weight = 0.5;  // of the residual of the velocity at every node

  static D::A transition() {
    D::A a;
    a << 1.0, 1.0, 0.0, 1.0;
    return a;
  }
  static D::B push() { return {0.5, 1.0}; }

  template <typename S>
  StateOf<S> moved(const StateOf<S>& x, const StateOf<S>& dx) const {
    return x + dx;
  }
  template <typename S>
  StateOf<S> between(const StateOf<S>& y, const StateOf<S>& x) const {
    return y - x;
  }
  template <typename S>
  StateOf<S> flow(int, const StateOf<S>& x, const InputOf<S>& u) const {
    return transition().template cast<S>() * x + push().template cast<S>() * u;
  }
  Eigen::Vector2d flow_derivatives(int k, const Eigen::Vector2d& x, const D::Input& u, D::A& A,
                                   D::B& B) const {
    A = transition();
    B = push();
    return flow<double>(k, x, u);
  }

  template <typename S>
  Eigen::Matrix<S, 3, 1> residual(int k, const StateOf<S>& x, const InputOf<S>& u) const {
    const Eigen::Vector3d w = residual_weights(k);
    return {S(w(0)) * (x(0) - S(target)), S(w(1)) * x(1), S(w(2)) * u(0)};
  }
  template <typename ByState, typename ByInput>
  void residual_derivatives(int k, const Eigen::Vector2d&, const D::Input&, ByState& by_state,
                            ByInput& by_input) const {
    const Eigen::Vector3d w = residual_weights(k);
    by_state << w(0), 0.0, 0.0, w(1), 0.0, 0.0;
    by_input << 0.0, 0.0, w(2);
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
    upper(0) = k == intervals ? infinity : max_input;
    lower = -upper;
    penalty(0) = 1e4;
  }

  template <typename S>
  Eigen::Matrix<S, 1, 1> equalities_of(int, const StateOf<S>& x) const {
    return Eigen::Matrix<S, 1, 1>(x(1));
  }
  void equality_derivatives(int, const Eigen::Vector2d&, D::EqualitiesX& H) const { H << 0.0, 1.0; }
  D::Equalities equality_weights(int k) const {
    return D::Equalities(stops && k == intervals ? 100.0 : 0.0);
  }

 private:
  Eigen::Vector3d residual_weights(int k) const {
    const bool last = k == intervals;
    return {last ? position_weight : 0.0, velocity_weight, last ? 0.0 : 0.1};
  }
};

using DoubleIntegrator = TestProblem<DoubleIntegratorModel>;

}  // namespace test_support
