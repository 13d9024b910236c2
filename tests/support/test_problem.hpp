#pragma once

#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

/// Common code of the test problems. Each problem is written as a model: its equations are
/// templates on the scalar type, for automatic differentiation, and its derivatives are written by
/// hand. TestProblem turns a model into a problem for the solvers.
namespace test_support {

constexpr double infinity = std::numeric_limits<double>::infinity();

/// A problem for the solvers, made from a `Model` with
///     states, inputs, constraints, equalities, residuals, StateOf<Scalar>; int intervals;
///     moved(x, dx), between(y, x), flow(k, x, u), residual(k, x, u), constraints_of(k, x, u),
///     as templates; flow_derivatives, residual_derivatives, constraint_derivatives, by hand, and
///     constraint_bounds(k, lower, upper, penalty); equalities_of, equality_derivatives,
///     equality_weights if there are equalities.
/// The cost is |residual|^2.
template <typename Model>
class TestProblem : public Model {
 public:
  using D = tilt_ropter::optimal_control::ProblemDimensions<Model>;
  using State = typename Model::template StateOf<double>;
  using Tangent = typename D::Tangent;
  using Input = typename D::Input;
  using Constraints = typename D::Constraints;

  explicit TestProblem(Model model)
      : Model(std::move(model)),
        lower_(static_cast<std::size_t>(this->intervals) + 1),
        upper_(lower_.size()),
        penalty_(lower_.size()) {
    for (int k = 0; k <= this->intervals; ++k) {
      const auto i = static_cast<std::size_t>(k);
      this->constraint_bounds(k, lower_[i], upper_[i], penalty_[i]);
    }
  }

  int horizon() const { return this->intervals; }
  State retract(const State& x, const Tangent& dx) const {
    return this->template moved<double>(x, dx);
  }
  Tangent difference(const State& y, const State& x) const {
    return this->template between<double>(y, x);
  }
  State step(int k, const State& x, const Input& u) const {
    return this->template flow<double>(k, x, u);
  }
  State step(int k, const State& x, const Input& u, typename D::A& A, typename D::B& B) const {
    return this->flow_derivatives(k, x, u, A, B);
  }

  double cost(int k, const State& x, const Input& u) const {
    return this->template residual<double>(k, x, u).squaredNorm();
  }
  void cost_model(
      int k, const State& x, const Input& u,
      tilt_ropter::optimal_control::QuadraticModel<Model::states, Model::inputs>& model) const {
    const auto r = this->template residual<double>(k, x, u);
    Eigen::Matrix<double, Model::residuals, Model::states> by_state;
    Eigen::Matrix<double, Model::residuals, Model::inputs> by_input;
    this->residual_derivatives(k, x, u, by_state, by_input);
    model.lx() = 2.0 * by_state.transpose() * r;
    model.lu() = 2.0 * by_input.transpose() * r;
    model.lxx() = 2.0 * by_state.transpose() * by_state;
    model.lux() = 2.0 * by_input.transpose() * by_state;
    model.luu() = 2.0 * by_input.transpose() * by_input;
  }

  Constraints constraint_values(int k, const State& x, const Input& u) const {
    return this->template constraints_of<double>(k, x, u);
  }
  const Constraints& lower(int k) const { return lower_[static_cast<std::size_t>(k)]; }
  const Constraints& upper(int k) const { return upper_[static_cast<std::size_t>(k)]; }
  const Constraints& penalty(int k) const { return penalty_[static_cast<std::size_t>(k)]; }

  typename D::Equalities equality_values(int k, const State& x) const {
    return this->template equalities_of<double>(k, x);
  }

 private:
  std::vector<Constraints> lower_, upper_, penalty_;
};

/// One classical Runge-Kutta step of `dt` of the vector field f(x).
template <typename State, typename Field>
State runge_kutta_step(const State& x, double dt, const Field& f) {
  using Scalar = typename State::Scalar;
  const State k1 = f(x);
  const State k2 = f(State(x + Scalar(dt / 2.0) * k1));
  const State k3 = f(State(x + Scalar(dt / 2.0) * k2));
  const State k4 = f(State(x + Scalar(dt) * k3));
  return x + Scalar(dt / 6.0) * (k1 + Scalar(2) * k2 + Scalar(2) * k3 + k4);
}

/// The same step with its derivatives `a` by x and `b` by u, from the variational equations.
/// `by_state` and `by_input` are df/dx and df/du.
template <typename State, typename Field, typename ByState, typename ByInput, typename A,
          typename B>
State runge_kutta_step(const State& x, double dt, const Field& f, const ByState& by_state,
                       const ByInput& by_input, A& a, B& b) {
  const double node[4] = {0.0, dt / 2.0, dt / 2.0, dt};
  const double weight[4] = {dt / 6.0, dt / 3.0, dt / 3.0, dt / 6.0};
  State rate = State::Zero(), end = x;
  A a_rate = A::Zero();
  B b_rate = B::Zero();
  a.setIdentity();
  b.setZero();
  for (int i = 0; i < 4; ++i) {
    const State stage = x + node[i] * rate;
    const A fx = by_state(stage);
    a_rate = A(fx + node[i] * fx * a_rate);
    b_rate = B(by_input(stage) + node[i] * fx * b_rate);
    rate = f(stage);
    end += weight[i] * rate;
    a += weight[i] * a_rate;
    b += weight[i] * b_rate;
  }
  return end;
}

}  // namespace test_support
