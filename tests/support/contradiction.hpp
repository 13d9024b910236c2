#pragma once

#include "support/test_problem.hpp"

#include <Eigen/Core>

namespace test_support {

/// A problem without a feasible point: x+ = x + u, cost weight * u^2 at every node. One constraint
/// requires u >= 1 at a penalty of 5 per unit, another one u <= -1 at a penalty of 3. The intervals
/// are independent of each other. The minimum of weight * u^2 + 5 (1 - u) + 3 (1 + u) in [-1, 1] is
/// at u = min(1, 1 / weight).
struct ContradictionModel {
  static constexpr int states = 1, inputs = 1, constraints = 2, equalities = 0, residuals = 1;
  template <typename S>
  using StateOf = Eigen::Matrix<S, 1, 1>;
  using D = tilt_ropter::optimal_control::ProblemDimensions<ContradictionModel>;
  using Vector1d = Eigen::Matrix<double, 1, 1>;

  int intervals = 4;
  double weight = 2.0;

  template <typename S>
  StateOf<S> moved(const StateOf<S>& x, const StateOf<S>& dx) const {
    return x + dx;
  }
  template <typename S>
  StateOf<S> between(const StateOf<S>& y, const StateOf<S>& x) const {
    return y - x;
  }
  template <typename S>
  StateOf<S> flow(int, const StateOf<S>& x, const StateOf<S>& u) const {
    return x + u;
  }
  Vector1d flow_derivatives(int, const Vector1d& x, const D::Input& u, D::A& A, D::B& B) const {
    A.setOnes();
    B.setOnes();
    return x + u;
  }

  template <typename S>
  StateOf<S> residual(int k, const StateOf<S>&, const StateOf<S>& u) const {
    return StateOf<S>(S(residual_weight(k)) * u(0));
  }
  template <typename ByState, typename ByInput>
  void residual_derivatives(int k, const Vector1d&, const D::Input&, ByState& by_state,
                            ByInput& by_input) const {
    by_state.setZero();
    by_input(0) = residual_weight(k);
  }

  template <typename S>
  Eigen::Matrix<S, 2, 1> constraints_of(int, const StateOf<S>&, const StateOf<S>& u) const {
    return {u(0), u(0)};
  }
  void constraint_derivatives(int, const Vector1d&, const D::Input&, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    C.setZero();
    E.setOnes();
  }
  void constraint_bounds(int k, D::Constraints& lower, D::Constraints& upper,
                         D::Constraints& penalty) const {
    lower << (k == intervals ? -infinity : 1.0), -infinity;
    upper << infinity, (k == intervals ? infinity : -1.0);
    penalty << 5.0, 3.0;
  }

 private:
  double residual_weight(int k) const { return k == intervals ? 0.0 : std::sqrt(weight); }
};

using Contradiction = TestProblem<ContradictionModel>;

}  // namespace test_support
