// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/full_space_settings.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/problem_constraints.hpp>

#include <Eigen/Core>
#include <Eigen/LU>

#include <nlopt.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

/// Direct solver for a problem of optimal_control/problem.hpp: NLopt's SLSQP solves the whole
/// nonlinear program. The solver is slow and exact. It uses dense matrices of all states and
/// inputs, so the time grows with the cube of the horizon. The Tilt-Ropter's 96 variables of 4
/// intervals take 20 ms, 480 variables of 20 intervals take 3 s. Hessians come from BFGS instead of
/// Gauss-Newton, constraints and equalities are hard, and NLopt handles all of them. FullSpace is
/// the reference solver for tests and for users who need exact solutions.
///
/// This header is long because the cost, the constraints and their gradients for NLopt share one
/// layout of the variables.
///
///     variables     dx_1 .. dx_N, du_0 .. du_{N-1}: steps from a base trajectory, in tangent
///                   coordinates; the initial state is fixed
///     minimise      sum of cost(k, x_k (+) dx_k, u_k + du_k)
///     subject to    continuity  step(x_k, u_k) (-) base_{k+1} - dx_{k+1} = 0
///                   constraints lower <= c(x, u) <= upper, each finite bound by itself
///                   equalities  h(x) = 0, where their weight is > 0 and k > 0
///
/// When SLSQP stops, the base moves to the final point, the steps are set to zero, and SLSQP
/// restarts. This ends when a whole call moves nothing. The final point then depends only on
/// derivatives at zero steps. At other steps the derivative of the retraction is needed. A problem
/// whose retraction is not plain addition therefore has one more member,
///
///     // d difference(retract(x, dx + e), retract(x, dx)) / de at e = 0
///     D::A retract_derivative(const State& x, const D::Tangent& dx) const;
///
/// If it is absent, the identity is used. The identity is exact if the retraction is addition.
/// Otherwise the derivatives are wrong far from the base, and more calls of NLopt are needed.
///
/// Differences to MultipleShooting: linear and quadratic penalties are ignored, so a problem
/// without a feasible point is reported as infeasible and not solved. Equality weights only switch
/// equalities on and off. Equalities that no variable can change (for example a height that the
/// problem holds anyway) make SLSQP's subproblem singular, and the solve fails.
namespace tilt_ropter::optimal_control {

/// Solves a `Problem` as one nonlinear program, see above.
template <typename Problem>
class FullSpace {
 public:
  using Dimensions = ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Tangent = typename Dimensions::Tangent;
  using Input = typename Dimensions::Input;
  using AllConstraints = ProblemConstraints<Problem>;
  static constexpr int nx = Dimensions::nx, nu = Dimensions::nu, nc = AllConstraints::count,
                       ne = Dimensions::ne;

  /// Throws std::invalid_argument if settings are out of range or the horizon is below 1.
  explicit FullSpace(Problem problem, const FullSpaceSettings& settings = {})
      : problem_(std::move(problem)), settings_(settings), horizon_(problem_.horizon()) {
    validate(settings);
    require(horizon_ >= 1, "Problem.horizon()", horizon_, ">= 1");
    const auto nodes = static_cast<std::size_t>(horizon_) + 1;
    nodes_.resize(nodes);
    bounds_.reserve(2 * static_cast<std::size_t>(nc) * nodes);
    equalities_.reserve(static_cast<std::size_t>(ne) * nodes);
    const int size = (nx + nu) * horizon_;
    for (Eigen::VectorXd* v : {&scale_, &variables_, &latest_, &before_latest_}) v->setZero(size);
    optimizer_.reset(nlopt_create(NLOPT_LD_SLSQP, static_cast<unsigned>(size)));
  }

  [[nodiscard]] Problem& problem() { return problem_; }
  [[nodiscard]] const Problem& problem() const { return problem_; }
  [[nodiscard]] int horizon() const { return horizon_; }
  [[nodiscard]] const State& state(int k) const { return node(k).base; }
  [[nodiscard]] const Input& input(int k) const { return node(k).base_input; }
  [[nodiscard]] const FullSpaceReport& report() const { return report_; }

  /// Cold start: every state x0, every input zero.
  void reset(const State& x0) {
    for (int k = 0; k <= horizon_; ++k) set_guess(k, x0, Input::Zero());
  }

  /// Sets the guess of the state and input at node k. The input of the last node is ignored.
  void set_guess(int k, const State& x, const Input& u) {
    node(k).base = x;
    node(k).base_input = u;
  }

  /// Solves from the current guess, with the initial state fixed to x0. reset() or set_guess() must
  /// have set the guess at every node. Never throws. NLopt allocates its workspace.
  const FullSpaceReport& solve(const State& x0) noexcept {
    report_ = {};
    if (!all_finite(problem_.difference(x0, x0))) {
      report_.status = FullSpaceStatus::rejected;
      return report_;
    }
    node(0).base = x0;
    node(horizon_).base_input.setZero();
    const auto start = std::chrono::steady_clock::now();
    const auto time_left = [&] {
      const std::chrono::duration<double> passed = std::chrono::steady_clock::now() - start;
      return settings_.max_time - passed.count();
    };
    Call last = add_constraints() ? Call::moved : Call::failed;
    while (last == Call::moved && report_.rebases < settings_.max_rebases && time_left() > 0.0)
      last = call_nlopt(time_left());
    audit();
    const double infeasibility = detail::larger(
        report_.max_defect, detail::larger(report_.max_violation, report_.max_equality));
    if (last == Call::failed || !std::isfinite(report_.cost) || !std::isfinite(infeasibility))
      report_.status = FullSpaceStatus::failed;
    else if (last == Call::moved)
      report_.status = FullSpaceStatus::limit;
    else if (infeasibility > settings_.tolerance)
      report_.status = FullSpaceStatus::infeasible;
    else
      report_.status = last == Call::settled ? FullSpaceStatus::converged : FullSpaceStatus::failed;
    return report_;
  }

 private:
  template <typename P, typename = void>
  struct HasRetractDerivative : std::false_type {};
  template <typename P>
  struct HasRetractDerivative<P,
                              std::void_t<decltype(std::declval<const P&>().retract_derivative(
                                  std::declval<const State&>(), std::declval<const Tangent&>()))>>
      : std::true_type {};
  static constexpr bool curved = HasRetractDerivative<Problem>::value;

  using A = typename Dimensions::A;
  using B = typename Dimensions::B;
  // NLopt's layout of the gradients of a vector of constraints.
  using Jacobian =
      Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>;
  using Vector = Eigen::Map<Eigen::VectorXd>;
  using Point = Eigen::Map<const Eigen::VectorXd>;

  struct Node {
    State base{}, x{};  // x = base (+) dx
    Input base_input = Input::Zero(), u = Input::Zero();
    Tangent dx = Tangent::Zero();
    A turn = A::Identity();  // derivative of the retraction at dx
  };
  struct Bound {  // a finite bound of a constraint: upper (side +1) or lower (-1)
    int k, component;
    double side, limit;
  };
  using Constraints = typename AllConstraints::Values;
  struct ConstraintBounds {
    Constraints lower, upper, price, stiffness;
  };
  struct Equality {
    int k, component;
  };
  enum class Call { moved, settled, stuck, failed };  // result of a call of NLopt
  struct Destroy {
    void operator()(nlopt_opt optimizer) const { nlopt_destroy(optimizer); }
  };

  Node& node(int k) { return nodes_[static_cast<std::size_t>(k)]; }
  const Node& node(int k) const { return nodes_[static_cast<std::size_t>(k)]; }

  // Index of the steps of node k in the variables: du_0, dx_1, du_1, dx_2, ..
  static Eigen::Index input_at(int k) { return (nx + nu) * k; }
  static Eigen::Index state_at(int k) { return (nx + nu) * k - nx; }

  // Adds all current bounds and equalities to NLopt.
  bool add_constraints() {
    if (!optimizer_) return false;
    bounds_.clear();
    equalities_.clear();
    for (int k = 0; k <= horizon_; ++k) {
      const ConstraintBounds bounds = constraint_bounds(k);
      for (int i = 0; i < nc; ++i) {
        if (std::isfinite(bounds.upper(i))) bounds_.push_back({k, i, 1.0, bounds.upper(i)});
        if (std::isfinite(bounds.lower(i))) bounds_.push_back({k, i, -1.0, bounds.lower(i)});
      }
      if constexpr (ne > 0) {
        const auto weights = problem_.equality_weights(k);
        for (int i = 0; i < ne; ++i)
          if (k > 0 && weights(i) > 0.0) equalities_.push_back({k, i});
      }
    }
    nlopt_opt optimizer = optimizer_.get();
    nlopt_remove_equality_constraints(optimizer);
    nlopt_remove_inequality_constraints(optimizer);
    const auto equalities =
        static_cast<unsigned>(nx * horizon_) + static_cast<unsigned>(equalities_.size());
    // No constraint tolerances: with tolerances SLSQP would prefer a cheaper point at their limit.
    return nlopt_set_min_objective(optimizer, cost, this) > 0 &&
           nlopt_add_equality_mconstraint(optimizer, equalities, equality, this, nullptr) > 0 &&
           (bounds_.empty() ||
            nlopt_add_inequality_mconstraint(optimizer, static_cast<unsigned>(bounds_.size()), row,
                                             this, nullptr) > 0);
  }

  // At node N, only bounds of constraints that do not depend on the input.
  [[nodiscard]] ConstraintBounds constraint_bounds(int k) const {
    ConstraintBounds b;
    AllConstraints::bounds(problem_, k, b.lower, b.upper, b.price, b.stiffness);
    if (k < horizon_) return b;
    typename AllConstraints::ByState C = AllConstraints::ByState::Zero();
    typename AllConstraints::ByInput E = AllConstraints::ByInput::Zero();
    AllConstraints::derivatives(problem_, k, node(k).base, Input::Zero(), C, E);
    for (int i = 0; i < nc; ++i)
      if (!AllConstraints::applies(problem_, k, E, i)) {
        b.lower(i) = -std::numeric_limits<double>::infinity();
        b.upper(i) = std::numeric_limits<double>::infinity();
      }
    return b;
  }

  // SLSQP starts with the identity as Hessian. The variables are therefore scaled so that the
  // diagonal of the cost's Hessian is one.
  void choose_scale() {
    for (int k = 0; k <= horizon_; ++k) {
      QuadraticModel<nx, nu> model;
      problem_.cost_model(k, node(k).base, node(k).base_input, model);
      if (k > 0) scale_.segment<nx>(state_at(k)) = model.lxx().diagonal();
      if (k < horizon_) scale_.segment<nu>(input_at(k)) = model.luu().diagonal();
    }
    scale_ = scale_.cwiseMax(1e-4).cwiseSqrt().cwiseInverse();
  }

  // Makes one call of NLopt from the base, and moves the base to the result.
  Call call_nlopt(double time) {
    choose_scale();
    nlopt_result result = optimize(time, 0.0);
    const auto limited = [&] {
      return result == NLOPT_MAXEVAL_REACHED || result == NLOPT_MAXTIME_REACHED;
    };
    if (finite_ && gradients_ < 2 && !limited()) {
      // SLSQP tried no step. Either the start is the optimum, and a slightly different start leads
      // back to it, or SLSQP cannot solve its subproblem. NLopt returns the same code in both
      // cases.
      result = optimize(time, 1e-6);
      if (finite_ && gradients_ < 2 && !limited()) return Call::stuck;
    }
    if (!finite_ || result == NLOPT_OUT_OF_MEMORY || result == NLOPT_INVALID_ARGS)
      return Call::failed;
    place(latest_);
    for (Node& n : nodes_) {
      n.base = n.x;
      n.base_input = n.u;
    }
    ++report_.rebases;
    const bool moved = latest_.cwiseAbs().maxCoeff() > settings_.tolerance;
    return moved || limited() ? Call::moved : Call::settled;
  }

  // Runs NLopt from variables of this size. The result is in latest_.
  nlopt_result optimize(double time, double size) {
    nlopt_opt optimizer = optimizer_.get();
    nlopt_set_maxeval(optimizer, settings_.max_evaluations);
    nlopt_set_maxtime(optimizer, std::max(time, 1e-9));  // 0 would mean no limit
    nlopt_set_force_stop(optimizer, 0);
    variables_.setConstant(size);
    latest_.setZero();
    before_latest_.setConstant(std::numeric_limits<double>::infinity());
    finite_ = true;
    gradients_ = 0;
    double value = 0.0;
    return nlopt_optimize(optimizer, variables_.data(), &value);
  }

  // Converts steps to states and inputs.
  template <typename Variables>
  void place(const Variables& v) {
    for (int k = 0; k <= horizon_; ++k) {
      Node& n = node(k);
      n.x = n.base;
      n.u = n.base_input;
      if (k > 0) {
        n.dx = scale_.segment<nx>(state_at(k)).cwiseProduct(v.template segment<nx>(state_at(k)));
        n.x = problem_.retract(n.base, n.dx);
        if constexpr (curved) n.turn = problem_.retract_derivative(n.base, n.dx);
      }
      if (k < horizon_)
        n.u += scale_.segment<nu>(input_at(k)).cwiseProduct(v.template segment<nu>(input_at(k)));
    }
  }

  // Stops NLopt at a NaN. Otherwise NLopt would use all its evaluations on it.
  void stop_unless(bool finite) {
    if (finite) return;
    finite_ = false;
    nlopt_force_stop(optimizer_.get());
  }

  // SLSQP requests gradients at every new iterate and at every full step from an iterate. If such a
  // point equals one of the last two points, either the full step is zero or no shorter step
  // decreases the merit.
  void look_for_the_end(const Point& v) {
    const double moved = (v - latest_).cwiseAbs().maxCoeff();
    const double moved_in_two = (v - before_latest_).cwiseAbs().maxCoeff();
    before_latest_.swap(latest_);
    latest_ = v;
    if (gradients_++ > 0 && std::min(moved, moved_in_two) <= settings_.tolerance)
      nlopt_force_stop(optimizer_.get());
  }

  static double cost(unsigned size, const double* v, double* gradient, void* self_pointer) {
    auto& self = *static_cast<FullSpace*>(self_pointer);
    const Point point(v, static_cast<Eigen::Index>(size));
    ++self.report_.evaluations;
    self.place(point);
    double sum = 0.0;
    for (int k = 0; k <= self.horizon_; ++k) {
      const Node& n = self.node(k);
      sum += self.problem_.cost(k, n.x, n.u);
      if (gradient == nullptr) continue;
      Vector g(gradient, static_cast<Eigen::Index>(size));
      QuadraticModel<nx, nu> model;
      self.problem_.cost_model(k, n.x, n.u, model);
      if (k > 0) g.segment<nx>(state_at(k)) = n.turn.transpose() * model.lx();
      if (k < self.horizon_) g.segment<nu>(input_at(k)) = model.lu();
    }
    self.stop_unless(std::isfinite(sum));
    if (gradient != nullptr) {
      Vector g(gradient, static_cast<Eigen::Index>(size));
      g.array() *= self.scale_.array();
      self.stop_unless(all_finite(g));
      if (self.finite_) self.look_for_the_end(point);
    }
    return sum;
  }

  // Takes the point v and returns where NLopt wants the values and, if at all, their Jacobian,
  // which is zero so far.
  std::pair<Vector, Jacobian> outputs(unsigned count, double* result, unsigned size,
                                      const double* v, double* gradient) {
    const auto rows = static_cast<Eigen::Index>(count), columns = static_cast<Eigen::Index>(size);
    place(Point(v, columns));
    std::pair<Vector, Jacobian> to{Vector(result, rows),
                                   Jacobian(gradient, gradient ? rows : 0, columns)};
    to.second.setZero();
    return to;
  }

  // Continuity of every interval, then the equalities.
  static void equality(unsigned count, double* result, unsigned size, const double* v,
                       double* gradient, void* self_pointer) {
    auto& self = *static_cast<FullSpace*>(self_pointer);
    const Problem& problem = self.problem_;
    std::pair<Vector, Jacobian> to = self.outputs(count, result, size, v, gradient);
    Vector& value = to.first;
    Jacobian& jacobian = to.second;
    for (int k = 0; k < self.horizon_; ++k) {
      const Node& n = self.node(k);
      const Node& next = self.node(k + 1);
      A by_state;
      B by_input;
      const State end =
          gradient ? problem.step(k, n.x, n.u, by_state, by_input) : problem.step(k, n.x, n.u);
      const Tangent reached = problem.difference(end, next.base);
      value.segment<nx>(nx * k) = reached - next.dx;
      if (!gradient) continue;
      if constexpr (curved) {
        const Eigen::PartialPivLU<A> turn(problem.retract_derivative(next.base, reached));
        by_state = turn.solve(A(by_state * n.turn));
        by_input = turn.solve(by_input);
      }
      if (k > 0) jacobian.block<nx, nx>(nx * k, state_at(k)) = by_state;
      jacobian.block<nx, nu>(nx * k, input_at(k)) = by_input;
      jacobian.block<nx, nx>(nx * k, state_at(k + 1)) = -A::Identity();
    }
    if constexpr (ne > 0) {
      Eigen::Index index = nx * self.horizon_;
      for (const Equality& e : self.equalities_) {
        const Node& n = self.node(e.k);
        value(index) = problem.equality_values(e.k, n.x)(e.component);
        if (gradient) {
          typename Dimensions::EqualitiesX H;
          problem.equality_derivatives(e.k, n.x, H);
          jacobian.block<1, nx>(index, state_at(e.k)) = H.row(e.component) * n.turn;
        }
        ++index;
      }
    }
    self.finish(value, jacobian);
  }

  // Finite bounds of constraints, as values <= 0.
  static void row(unsigned count, double* result, unsigned size, const double* v, double* gradient,
                  void* self_pointer) {
    auto& self = *static_cast<FullSpace*>(self_pointer);
    const Problem& problem = self.problem_;
    std::pair<Vector, Jacobian> to = self.outputs(count, result, size, v, gradient);
    Vector& value = to.first;
    Jacobian& jacobian = to.second;
    if constexpr (nc == 0) return;
    Constraints c;
    typename AllConstraints::ByState C;
    typename AllConstraints::ByInput E;
    int evaluated = -1;
    for (std::size_t i = 0; i < self.bounds_.size(); ++i) {
      const Bound& b = self.bounds_[i];
      const auto index = static_cast<Eigen::Index>(i);
      const Node& n = self.node(b.k);
      if (evaluated != b.k) {
        c = AllConstraints::values(problem, b.k, n.x, n.u);
        if (gradient) {
          C.setZero();
          E.setZero();
          AllConstraints::derivatives(problem, b.k, n.x, n.u, C, E);
        }
        evaluated = b.k;
      }
      value(index) = b.side * (c(b.component) - b.limit);
      if (!gradient) continue;
      if (b.k > 0)
        jacobian.block<1, nx>(index, state_at(b.k)) = b.side * C.row(b.component) * n.turn;
      if (b.k < self.horizon_)
        jacobian.block<1, nu>(index, input_at(b.k)) = b.side * E.row(b.component);
    }
    self.finish(value, jacobian);
  }

  void finish(const Vector& value, Jacobian& jacobian) {
    stop_unless(all_finite(value));
    jacobian.array().rowwise() *= scale_.transpose().array();
    stop_unless(all_finite(jacobian));
  }

  // Computes the report's values for the base trajectory.
  void audit() {
    const auto raise = [](double& largest, double value) {
      largest = detail::larger(largest, value);
    };
    for (int k = 0; k <= horizon_; ++k) {
      const Node& n = node(k);
      report_.cost += problem_.cost(k, n.base, n.base_input);
      if (k < horizon_) {
        const State end = problem_.step(k, n.base, n.base_input);
        const Tangent defect = problem_.difference(end, node(k + 1).base);
        for (int i = 0; i < nx; ++i) raise(report_.max_defect, std::abs(defect(i)));
      }
      const Constraints c = AllConstraints::values(problem_, k, n.base, n.base_input);
      const ConstraintBounds bounds = constraint_bounds(k);
      for (int i = 0; i < nc; ++i) {
        raise(report_.max_violation, c(i) - bounds.upper(i));
        raise(report_.max_violation, bounds.lower(i) - c(i));
      }
    }
    if constexpr (ne > 0)
      for (const Equality& e : equalities_)
        raise(report_.max_equality,
              std::abs(problem_.equality_values(e.k, node(e.k).base)(e.component)));
  }

  Problem problem_;
  FullSpaceSettings settings_;
  int horizon_;
  std::unique_ptr<nlopt_opt_s, Destroy> optimizer_;
  std::vector<Node> nodes_;
  std::vector<Bound> bounds_;
  std::vector<Equality> equalities_;
  Eigen::VectorXd scale_;                   // step = scale * variable
  Eigen::VectorXd variables_;               // NLopt's variables
  Eigen::VectorXd latest_, before_latest_;  // last points where NLopt requested gradients
  FullSpaceReport report_;
  int gradients_ = 0;  // gradients requested in this call of NLopt
  bool finite_ = true;
};

}  // namespace tilt_ropter::optimal_control
