// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/detail/riccati.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>
#include <tilt_ropter/optimal_control/detail/trajectory.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/LU>

#include <nlopt.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

namespace tilt_ropter::detail {

template <typename Scalar>
using MatrixX = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;

// Matrices of any size: these functions compile once in a file, not once for each problem, and as
// templates only where they are used.

/// Returns the multipliers of constraints at their bound, least squares of their `gradients` (rows)
/// against the gradient of the cost.
template <typename Scalar>
[[nodiscard]] MatrixX<Scalar> multipliers_of(const MatrixX<Scalar>& gradients,
                                             const MatrixX<Scalar>& of_cost) {
  MatrixX<Scalar> gram = gradients * gradients.transpose();
  gram.diagonal().array() += 1e-12 * gram.trace();
  return gram.ldlt().solve(-(gradients * of_cost));
}

/// Returns a b^-1.
template <typename Scalar>
[[nodiscard]] MatrixX<Scalar> over(const MatrixX<Scalar>& a, const MatrixX<Scalar>& b) {
  const MatrixX<Scalar> right = b.transpose(), wanted = a.transpose();
  return right.partialPivLu().solve(wanted).transpose();
}

}  // namespace tilt_ropter::detail

/// NLopt alone: SLSQP solves a whole problem of optimal_control/problem.hpp. Against
/// MultipleShooting this is the plain way, and an independent one: it needs no quadratic programs,
/// no multipliers and no line search of ours, but dense algebra whose time grows with the cube of
/// the number of inputs of the horizon.
///
/// The variables are the coordinates z of Riccati (riccati.hpp) about a base trajectory, on which
/// the states follow from the inputs,
///
///     u_k = base_u_k + K_k difference(x_k, base_x_k) + T_k z_k,    x_{k+1} = step(x_k, u_k),
///
/// with the gains K and the factors T = L'^-1 of a Riccati pass. In these coordinates the Hessian
/// of the cost at the base is the identity, which is SLSQP's first guess of it, and the gains keep
/// unstable motions near the base. When a call of NLopt ends, its result is the next base. Another
/// call follows until one moves nothing.
///
/// Each call has the constraints that are violated at the base or by the unconstrained optimum, and
/// those that a call before it violated. A constraint with a penalty has a slack variable that
/// costs the penalty. Equalities by weight are handled by multipliers between the calls.
namespace tilt_ropter::optimal_control {

/// Solver that owns the problem and the trajectory. It has the functions of MultipleShooting that a
/// loop calls, so that Nmpc can be built on it: Nmpc<4, optimal_control::SingleShooting>.
///
/// Of SolverSettings it uses max_iterations (calls of NLopt, with 200 evaluations of the cost
/// each), max_time, max_feedback_time and tolerance: the violation of constraints and equalities
/// that counts as zero, and a hundredth of it the |z| that does. Of SolveReport it sets status,
/// cost, max_violation, max_equality, iterations, evaluations and feedback_us.
template <typename Problem>
class SingleShooting {
 public:
  using Dimensions = ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Tangent = typename Dimensions::Tangent;
  using Input = typename Dimensions::Input;
  using AllConstraints = ProblemConstraints<Problem>;
  static constexpr int nx = Dimensions::nx, nu = Dimensions::nu, nc = AllConstraints::count,
                       ne = Dimensions::ne;
  using Gain = Eigen::Matrix<double, nu, nx>;

  /// Throws std::invalid_argument if settings are out of range or the horizon is below 1.
  explicit SingleShooting(Problem problem, const SolverSettings& settings = {})
      : problem_(std::move(problem)),
        settings_(settings),
        horizon_(problem_.horizon()),
        base_(checked(horizon_, settings)),
        here_(horizon_),
        before_(horizon_),
        riccati_(horizon_),
        equalities_(horizon_, 1e6),
        intervals_(detail::size(horizon_)),
        steps_(intervals_.size() + 1),
        models_(steps_.size()),
        working_(steps_.size()) {}

  [[nodiscard]] Problem& problem() { return problem_; }
  [[nodiscard]] const Problem& problem() const { return problem_; }
  [[nodiscard]] int horizon() const { return horizon_; }
  [[nodiscard]] const State& state(int k) const { return base_.x(k); }
  [[nodiscard]] const Input& input(int k) const { return base_.u(k); }
  /// Gain of the feedback about the plan, from the last Riccati pass; it respects no constraint.
  [[nodiscard]] Gain gain(int k) const { return intervals_[at(k)].gain; }
  [[nodiscard]] const SolveReport& report() const { return report_; }

  /// Cold start: every state x0, every input zero.
  void reset(const State& x0) {
    for (int k = 0; k <= horizon_; ++k) set_guess(k, x0, Input::Zero());
    equalities_.forget_multipliers();
  }

  /// Sets the guess of the state and input at node k. The input of the last node is ignored.
  void set_guess(int k, const State& x, const Input& u) {
    base_.x(k) = x;
    if (k < horizon_) base_.u(k) = u;
  }

  /// Moves the plan ahead in time, as MultipleShooting::shift().
  void shift(double intervals) {
    if (intervals > 0.0) base_.shift(problem_, intervals);
  }

  /// Solves from the current guess, with the initial state fixed to x0. reset() or set_guess() must
  /// have set the guess at every node. Never throws. NLopt and this class allocate.
  const SolveReport& solve(const State& x0) noexcept {
    updates_multipliers_ = settings_.update_multipliers;
    return solve(x0, settings_.max_time);
  }

  /// Solves from the last plan, within SolverSettings::max_feedback_time and before `deadline`.
  /// Equalities hold by their weights, as in MultipleShooting::feedback().
  const SolveReport& feedback(const State& x0,
                              std::optional<SolverClock::time_point> deadline = {}) noexcept {
    before_ = base_;
    updates_multipliers_ = false;
    double limit = settings_.max_feedback_time;
    if (deadline) limit = std::min(limit, seconds(*deadline - SolverClock::now()));
    return solve(x0, limit);
  }

  /// There is no work before the measurement, and no work is left for the next tick.
  [[nodiscard]] PrepareStatus prepare() noexcept { return PrepareStatus::prepared; }
  [[nodiscard]] bool interrupted() const { return false; }
  [[nodiscard]] bool has_step() const { return true; }

  /// Restores the plan before the last feedback().
  void restore_previous() noexcept { base_.swap(before_); }

 private:
  static double seconds(SolverClock::duration duration) {
    return std::chrono::duration<double>(duration).count();
  }

  const SolveReport& solve(const State& x0, double limit) noexcept {
    report_ = {};
    report_.solved_by = ProgramSolver::nlopt;
    const auto start = SolverClock::now();
    const auto time_left = [&] { return limit - seconds(SolverClock::now() - start); };
    if (!all_finite(problem_.difference(x0, base_.x(0)))) {
      report_.status = SolveStatus::rejected;
      return report_;
    }
    base_.x(0) = x0;
    for (auto& rows : working_) rows.clear();
    equalities_.forget_scale();
    report_.status = start_at_guess() ? SolveStatus::iterated : SolveStatus::failed;
    while (report_.status == SolveStatus::iterated) {
      report_.status = report_.iterations == settings_.max_iterations ? SolveStatus::iteration_limit
                       : time_left() <= 0.0                           ? SolveStatus::time_limit
                                                                      : improve(time_left());
    }
    audit();
    // Whether a constraint cannot be satisfied, or only SLSQP does not find how, nobody knows.
    if (report_.status == SolveStatus::converged && hard_violation_ > settings_.tolerance)
      report_.status = SolveStatus::stalled;
    report_.feedback_us = 1e6 * seconds(SolverClock::now() - start);
    return report_;
  }

  template <typename P>
  using RetractDerivative = decltype(std::declval<const P&>().retract_derivative(
      std::declval<const State&>(), std::declval<const Tangent&>()));

  using A = typename Dimensions::A;
  using B = typename Dimensions::B;
  using Constraints = typename AllConstraints::Values;
  using ByState = typename AllConstraints::ByState;
  using ByInput = typename AllConstraints::ByInput;
  using Model = QuadraticModel<nx, nu>;
  using Factorisation = Riccati<nx, nu, typename TransitionPatternOf<Problem>::type>;
  static constexpr double huge = 1e100;
  static constexpr int max_evaluations = 200;  // of the cost in one call of NLopt
  using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

  // Gain and coordinates of an interval, and the derivatives at the current point.
  struct Interval {
    Gain gain;
    Eigen::Matrix<double, nu, nu> unit;  // T
    A by_state;                          // with the feedback
    B by_input;
    Eigen::Matrix<double, nu, nx> feedback;  // d u / d x
  };
  // A constraint in NLopt's problem: at its upper (+1) or lower (-1) bound.
  struct Row {
    int component;
    double side, bound, penalty, stiffness;
    int slack;    // index of its slack variable, or -1
    double unit;  // of the slack
    bool gives_way = false;
  };
  struct Destroy {
    void operator()(nlopt_opt optimizer) const { nlopt_destroy(optimizer); }
  };

  static int checked(int horizon, const SolverSettings& settings) {
    validate(settings);
    require(horizon >= 1, "Problem.horizon()", horizon, ">= 1");
    return horizon;
  }
  // A step in z of this length costs half its square.
  [[nodiscard]] double smallest_move() const { return 0.01 * settings_.tolerance; }
  static std::size_t at(int k) { return detail::size(k); }
  [[nodiscard]] int coordinates() const { return nu * horizon_; }

  // The guess may have defects. The first base follows it by the gains.
  [[nodiscard]] bool start_at_guess() {
    if (!factorise(true)) return false;
    const Eigen::VectorXd zero = Eigen::VectorXd::Zero(coordinates());
    if (!roll_out(zero.data(), false)) return false;
    base_.swap(here_);
    return true;
  }

  // Linearises at the base and factorises. With damping where the Hessian is not positive definite.
  [[nodiscard]] bool factorise(bool with_defects) {
    for (int k = 0; k <= horizon_; ++k) {
      Model& model = riccati_.stage(k).cost;
      equalities_.take_from_model(k, model);
      problem_.cost_model(k, base_.x(k), base_.u(k), model);
      (void)equalities_.add_to_model(problem_, k, base_.x(k), model);
      if (k == horizon_) break;
      A by_state;
      B by_input;
      const State end = problem_.step(k, base_.x(k), base_.u(k), by_state, by_input);
      if (!riccati_.set_transition(k, by_state, by_input)) return false;
      riccati_.set_defect(
          k, with_defects ? problem_.difference(end, base_.x(k + 1)) : Tangent(Tangent::Zero()));
    }
    double damping = 0.0;
    while (!riccati_.factorise(damping)) {
      damping = std::max(10.0 * damping, 1e-6);
      if (!(damping <= 1e12)) return false;
    }
    steps_[0].setZero();
    riccati_.sweep(steps_);
    optimum_ = steps_;
    for (int k = 0; k < horizon_; ++k) intervals_[at(k)].gain = riccati_.gain(k);
    Eigen::VectorXd z(coordinates());
    for (int j = 0; j < nu; ++j) {
      z.setZero();
      for (int k = 0; k < horizon_; ++k) z(nu * k + j) = 1.0;
      riccati_.sweep(steps_, z.data());
      for (int k = 0; k < horizon_; ++k) {
        const auto& w = steps_[at(k)];
        intervals_[at(k)].unit.col(j) = w.template segment<nu>(nx) - riccati_.feedforward(k) -
                                        intervals_[at(k)].gain * w.template head<nx>();
      }
    }
    return true;
  }

  // Computes the trajectory of the coordinates z, and the derivatives on it. Returns false if a
  // number is not finite.
  [[nodiscard]] bool roll_out(const double* z, bool with_derivatives) {
    here_.x(0) = base_.x(0);
    bool finite = true;
    for (int k = 0; k < horizon_; ++k) {
      Interval& interval = intervals_[at(k)];
      const Tangent dx = problem_.difference(here_.x(k), base_.x(k));
      here_.u(k) =
          base_.u(k) + interval.gain * dx + interval.unit * Eigen::Map<const Input>(z + nu * k);
      if (!with_derivatives) {
        here_.x(k + 1) = problem_.step(k, here_.x(k), here_.u(k));
      } else {
        here_.x(k + 1) =
            problem_.step(k, here_.x(k), here_.u(k), interval.by_state, interval.by_input);
        interval.feedback = interval.gain;
        if constexpr (detail::has_member<RetractDerivative, Problem>)
          interval.feedback =
              detail::over<double>(interval.gain, problem_.retract_derivative(base_.x(k), dx));
        interval.by_state += interval.by_input * interval.feedback;
      }
      finite = finite && all_finite(here_.u(k)) &&
               all_finite(problem_.difference(here_.x(k + 1), base_.x(k + 1)));
    }
    return finite;
  }

  // One call of NLopt. `iterated`: it moved.
  SolveStatus improve(double time) {
    if (!factorise(false)) return SolveStatus::failed;
    (void)choose_rows();
    slacks_ = rows_ = 0;
    for (auto& rows : working_)
      for (Row& row : rows) {
        row.slack = row.gives_way ? coordinates() + slacks_++ : -1;
        ++rows_;
      }
    const int size = coordinates() + slacks_;
    optimizer_.reset(nlopt_create(NLOPT_LD_SLSQP, static_cast<unsigned>(size)));
    if (!optimizer_) return SolveStatus::failed;
    nlopt_opt optimizer = optimizer_.get();
    Eigen::VectorXd variables = Eigen::VectorXd::Zero(size);  // z and slacks
    Eigen::VectorXd least = variables;
    least.head(coordinates()).setConstant(-detail::infinity);
    nlopt_set_lower_bounds(optimizer, least.data());
    nlopt_set_min_objective(optimizer, cost, this);
    if (rows_ > 0)
      nlopt_add_inequality_mconstraint(optimizer, static_cast<unsigned>(rows_), constraints, this,
                                       nullptr);
    nlopt_set_maxeval(optimizer, max_evaluations);
    nlopt_set_maxtime(optimizer, std::max(time, 1e-9));  // 0 would mean no limit
    latest_.setZero(size);
    before_latest_.setConstant(size, detail::infinity);
    finite_ = true;
    gradients_ = 0;
    double value = 0.0;
    const nlopt_result result = nlopt_optimize(optimizer, variables.data(), &value);
    ++report_.iterations;
    if (!finite_ || result == NLOPT_OUT_OF_MEMORY || result == NLOPT_INVALID_ARGS)
      return SolveStatus::failed;
    if (!roll_out(latest_.data(), false)) return SolveStatus::failed;
    const double moved = detail::largest(latest_.head(coordinates()));
    base_.swap(here_);
    double equality = 0.0;
    for (int k = 1; k <= horizon_; ++k)
      equality = std::max(equality, equalities_.distance(problem_, k, base_.x(k)));
    if (updates_multipliers_ && equality > settings_.tolerance) {
      equalities_.update(problem_, base_, equality, true);
      return SolveStatus::iterated;
    }
    const bool limited = result == NLOPT_MAXEVAL_REACHED || result == NLOPT_MAXTIME_REACHED;
    if (limited || moved > smallest_move() || violates_more()) return SolveStatus::iterated;
    return give_way() ? SolveStatus::iterated : SolveStatus::converged;
  }

  // Rows with a penalty get slack variables where nothing moves any more: all of them if a row is
  // violated, otherwise those whose multiplier is above the penalty. NLopt gives no multipliers;
  // they follow from the gradients of the rows at their bound. Returns false if none gets one.
  [[nodiscard]] bool give_way() {
    if (rows_ == 0) return false;
    const int size = coordinates() + slacks_;
    const Eigen::VectorXd zero = Eigen::VectorXd::Zero(size);
    Eigen::VectorXd gradient(size), values(rows_);
    Rows jacobian(rows_, size), slopes(rows_, coordinates());
    (void)cost(static_cast<unsigned>(size), zero.data(), gradient.data(), this);
    --report_.evaluations;
    constraints(static_cast<unsigned>(rows_), values.data(), static_cast<unsigned>(size),
                zero.data(), jacobian.data(), this);
    const bool violated = values.maxCoeff() > settings_.tolerance;
    std::vector<Row*> at_bound;
    const auto count = [&] { return static_cast<Eigen::Index>(at_bound.size()); };
    bool any = false;
    Eigen::Index index = 0;
    for (int k = horizon_; k >= 0; --k)
      for (Row& row : working_[at(k)]) {
        if (violated && row.slack == -1 && std::isfinite(row.penalty)) {
          row.gives_way = any = true;
        } else if (row.slack == -1 && values(index) > -settings_.tolerance) {
          slopes.row(count()) = jacobian.row(index).head(coordinates());
          at_bound.push_back(&row);
        }
        ++index;
      }
    if (violated) return any;
    const Eigen::VectorXd multipliers =
        detail::multipliers_of<double>(slopes.topRows(count()), gradient.head(coordinates()));
    for (Eigen::Index i = 0; i < count(); ++i) {
      Row& row = *at_bound[detail::size(i)];
      row.gives_way = multipliers(i) > row.penalty;
      any = any || row.gives_way;
    }
    return any;
  }

  // Adds the constraints that the base or the unconstrained optimum violates.
  bool choose_rows() {
    bool added = false;
    if constexpr (nc > 0) {
      for (int k = 0; k <= horizon_; ++k) {
        const Constraints c = AllConstraints::values(problem_, k, base_.x(k), base_.u(k));
        ByState C = ByState::Zero();
        ByInput E = ByInput::Zero();
        AllConstraints::derivatives(problem_, k, base_.x(k), base_.u(k), C, E);
        const auto& w = optimum_[at(k)];
        Constraints predicted = c + C * w.template head<nx>();
        if (k < horizon_) predicted += E * w.template segment<nu>(nx);
        Constraints lower, upper, penalty, stiffness = detail::Filled{detail::infinity};
        AllConstraints::bounds(problem_, k, lower, upper, penalty, stiffness);
        for (int i = 0; i < nc; ++i) {
          if (k == horizon_ && !AllConstraints::applies(problem_, k, E, i)) continue;
          if (k == 0 && C.row(i).isZero() && E.row(i).isZero()) continue;
          for (const double side : {1.0, -1.0}) {
            const double bound = side > 0.0 ? upper(i) : lower(i);
            const double over = side * (c(i) - bound), ahead = side * (predicted(i) - bound);
            if (!std::isfinite(bound) || std::max(over, ahead) <= -settings_.tolerance) continue;
            auto& rows = working_[at(k)];
            const auto same = [&](const Row& r) { return r.component == i && r.side == side; };
            if (std::any_of(rows.begin(), rows.end(), same)) continue;
            const double steepest = std::min(penalty(i), stiffness(i));
            rows.push_back({i, side, bound, penalty(i), stiffness(i), -1, 1.0 / std::sqrt(steepest),
                            std::isfinite(stiffness(i))});
            added = true;
          }
        }
      }
    }
    return added;
  }
  [[nodiscard]] bool violates_more() { return factorise(false) && choose_rows(); }

  // Stops NLopt at a NaN. Otherwise NLopt would use all its evaluations on it.
  void stop_unless(bool finite) {
    if (finite) return;
    finite_ = false;
    nlopt_force_stop(optimizer_.get());
  }

  // SLSQP requests gradients at every new iterate and at every full step from an iterate. If such a
  // point equals one of the last two points, either the full step is zero or no shorter step
  // decreases the merit.
  void look_for_the_end(const Eigen::Map<const Eigen::VectorXd>& v) {
    const double moved = (v - latest_).cwiseAbs().maxCoeff();
    const double moved_in_two = (v - before_latest_).cwiseAbs().maxCoeff();
    before_latest_.swap(latest_);
    latest_ = v;
    if (gradients_++ > 0 && std::min(moved, moved_in_two) <= smallest_move())
      nlopt_force_stop(optimizer_.get());
  }

  static double cost(unsigned size, const double* v, double* gradient, void* self_pointer) {
    auto& self = *static_cast<SingleShooting*>(self_pointer);
    const int n = self.horizon_;
    ++self.report_.evaluations;
    if (!self.roll_out(v, gradient != nullptr)) {  // too long a step: SLSQP takes a shorter one
      self.stop_unless(self.gradients_ > 0);
      if (gradient != nullptr) std::fill_n(gradient, size, 0.0);
      return huge;
    }
    double sum = 0.0;
    for (int k = 0; k <= n; ++k)
      sum += self.problem_.cost(k, self.here_.x(k), self.here_.u(k)) +
             self.equalities_.value(self.problem_, k, self.here_.x(k));
    for (const auto& rows : self.working_)
      for (const Row& row : rows)
        if (row.slack >= 0)
          sum += violation_cost(row.penalty, row.stiffness, row.unit * v[row.slack]);
    self.stop_unless(std::isfinite(sum));
    if (gradient == nullptr) return sum;
    Tangent costate = Tangent::Zero();
    for (int k = n; k >= 0; --k) {
      Model& model = self.models_[at(k)];
      self.problem_.cost_model(k, self.here_.x(k), self.here_.u(k), model);
      Tangent by_state = model.lx();
      if constexpr (ne > 0) {
        if (self.equalities_.has(self.problem_, k)) {
          typename Dimensions::EqualitiesX H;
          self.problem_.equality_derivatives(k, self.here_.x(k), H);
          by_state += H.transpose() * self.equalities_.slopes(self.problem_, k, self.here_.x(k));
        }
      }
      if (k == n) {
        costate = by_state;
        continue;
      }
      const Interval& interval = self.intervals_[at(k)];
      const Input by_input = model.lu() + interval.by_input.transpose() * costate;
      Eigen::Map<Input>(gradient + nu * k) = interval.unit.transpose() * by_input;
      costate = (by_state + interval.feedback.transpose() * model.lu() +
                 interval.by_state.transpose() * costate)
                    .eval();
    }
    for (const auto& rows : self.working_)
      for (const Row& row : rows)
        if (row.slack >= 0)
          gradient[row.slack] =
              row.unit * std::min(row.penalty, row.stiffness < detail::infinity
                                                   ? row.stiffness * row.unit * v[row.slack]
                                                   : row.penalty);
    const Eigen::Map<const Eigen::VectorXd> point(v, static_cast<Eigen::Index>(size)),
        g(gradient, static_cast<Eigen::Index>(size));
    self.stop_unless(all_finite(Eigen::VectorXd(g)));
    if (self.finite_) self.look_for_the_end(point);
    return sum;
  }

  // Constraints as values <= 0, by descending node.
  static void constraints(unsigned count, double* result, unsigned size, const double* v,
                          double* gradient, void* self_pointer) {
    auto& self = *static_cast<SingleShooting*>(self_pointer);
    if constexpr (nc > 0) {
      const bool finite = self.roll_out(v, gradient != nullptr);
      Eigen::Map<Rows> jacobian(gradient, gradient != nullptr ? count : 0, size);
      jacobian.setZero();
      Eigen::Matrix<double, Eigen::Dynamic, nx> adjoint(count, nx);
      Eigen::Index row = 0;
      for (int k = self.horizon_; k >= 0; --k) {
        if (k < self.horizon_ && gradient != nullptr && row > 0) {
          const Interval& interval = self.intervals_[at(k)];
          jacobian.block(0, nu * k, row, nu).noalias() =
              adjoint.topRows(row) * (interval.by_input * interval.unit);
          adjoint.topRows(row) = (adjoint.topRows(row) * interval.by_state).eval();
        }
        const auto& rows = self.working_[at(k)];
        if (rows.empty()) continue;
        const Constraints c =
            AllConstraints::values(self.problem_, k, self.here_.x(k), self.here_.u(k));
        ByState C = ByState::Zero();
        ByInput E = ByInput::Zero();
        if (gradient != nullptr)
          AllConstraints::derivatives(self.problem_, k, self.here_.x(k), self.here_.u(k), C, E);
        for (const Row& r : rows) {
          result[row] = finite ? r.side * (c(r.component) - r.bound) : huge;
          if (r.slack >= 0) result[row] -= r.unit * v[r.slack];
          if (gradient != nullptr) {
            adjoint.row(row) = r.side * C.row(r.component);
            if (k < self.horizon_) {
              const Interval& interval = self.intervals_[at(k)];
              adjoint.row(row) += r.side * E.row(r.component) * interval.feedback;
              jacobian.block(row, nu * k, 1, nu) = r.side * E.row(r.component) * interval.unit;
            }
            if (r.slack >= 0) jacobian(row, r.slack) = -r.unit;
          }
          ++row;
        }
      }
      if (!finite && gradient != nullptr) jacobian.setZero();
      self.stop_unless(all_finite(Rows(jacobian)));
    }
  }

  // Computes the report's values for the base.
  void audit() {
    report_.cost = report_.max_violation = report_.max_equality = hard_violation_ = 0.0;
    for (int k = 0; k <= horizon_; ++k) {
      report_.cost += problem_.cost(k, base_.x(k), base_.u(k));
      if (k > 0)
        report_.max_equality =
            std::max(report_.max_equality, equalities_.distance(problem_, k, base_.x(k)));
      if constexpr (nc > 0) {
        const Constraints c = AllConstraints::values(problem_, k, base_.x(k), base_.u(k));
        ByState C = ByState::Zero();
        ByInput E = ByInput::Zero();
        if (k == horizon_) AllConstraints::derivatives(problem_, k, base_.x(k), base_.u(k), C, E);
        Constraints lower, upper, penalty, stiffness = detail::Filled{detail::infinity};
        AllConstraints::bounds(problem_, k, lower, upper, penalty, stiffness);
        for (int i = 0; i < nc; ++i) {
          if (k == horizon_ && !AllConstraints::applies(problem_, k, E, i)) continue;
          const double over = std::max(c(i) - upper(i), lower(i) - c(i));
          report_.max_violation = detail::larger(report_.max_violation, over);
          if (!std::isfinite(penalty(i))) hard_violation_ = detail::larger(hard_violation_, over);
        }
      }
    }
    if (!std::isfinite(report_.cost)) report_.status = SolveStatus::failed;
  }

  Problem problem_;
  SolverSettings settings_;
  int horizon_;
  Trajectory<Problem> base_, here_, before_;
  Factorisation riccati_;
  AugmentedLagrangian<Problem> equalities_;
  std::vector<Interval> intervals_;
  std::vector<typename Factorisation::Vector> steps_, optimum_;
  std::vector<Model> models_;  // at the current point; entries that a problem does not set stay
  std::vector<std::vector<Row>> working_;  // of each node
  std::unique_ptr<nlopt_opt_s, Destroy> optimizer_;
  Eigen::VectorXd latest_, before_latest_;  // last points where NLopt requested gradients
  bool updates_multipliers_ = true;
  SolveReport report_;
  double hard_violation_ = 0.0;
  int rows_ = 0, slacks_ = 0;
  int gradients_ = 0;  // gradients requested in this call of NLopt
  bool finite_ = true;
};

}  // namespace tilt_ropter::optimal_control
