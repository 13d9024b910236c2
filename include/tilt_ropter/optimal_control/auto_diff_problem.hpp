// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>
#include <unsupported/Eigen/AutoDiff>

#include <limits>
#include <type_traits>
#include <utility>

/// Problems by automatic differentiation.
namespace tilt_ropter::detail {

template <typename User>
using ConstraintsMember = std::integral_constant<int, User::constraints>;
template <typename User>
using LowerMember = decltype(std::declval<const User&>().lower(0));
template <typename User>
using PenaltyMember = decltype(std::declval<const User&>().penalty(0));
template <typename User>
using TerminalLowerMember = decltype(std::declval<const User&>().terminal_lower());
template <typename User>
using TerminalPenaltyMember = decltype(std::declval<const User&>().terminal_penalty());
template <typename User>
using TerminalResidualsMember = std::integral_constant<int, User::terminal_residuals>;
template <typename User>
using TerminalResidualMember = decltype(std::declval<const User&>().terminal_residual(
    std::declval<const Eigen::Matrix<double, User::states, 1>&>()));

template <typename User>
using ResidualsMember = std::integral_constant<int, User::residuals>;
template <typename User>
using CostMember = decltype(std::declval<const User&>().cost(
    0, std::declval<const Eigen::Matrix<double, User::states, 1>&>(),
    std::declval<const Eigen::Matrix<double, User::inputs, 1>&>()));
template <typename User>
using CurvatureMember = std::enable_if_t<User::curvature>;

}  // namespace tilt_ropter::detail

namespace tilt_ropter::optimal_control {

/// A problem for MultipleShooting, made from a struct whose functions are templates on the scalar
/// type. The derivatives are exact, by forward automatic differentiation (Eigen's AutoDiffScalar).
/// The state is a vector and its retraction is addition. There are no equalities by weight.
/// problem.hpp has an example. With V<S, n> for Eigen::Matrix<S, n, 1> the struct has
///
///     static constexpr int states, inputs, residuals;
///     int horizon() const;  // number of intervals N
///     template <typename S>  // end of interval k, 0 <= k < N
///     V<S, states> step(int k, const V<S, states>& x, const V<S, inputs>& u) const;
///     template <typename S>  // cost of node k: the square of its norm
///     V<S, residuals> residual(int k, const V<S, states>& x, const V<S, inputs>& u) const;
///
/// and may have
///
///     static constexpr int constraints;  // number of constraints lower <= c(x, u) <= upper
///     template <typename S>
///     V<S, constraints> constraint_values(int k, const V<S, states>& x,
///                                         const V<S, inputs>& u) const;
///     V<double, constraints> lower(int k) const;  // and upper(k)
///     V<double, constraints> penalty(int k) const;  // absent: infinite, all constraints are hard
///     V<double, constraints> stiffness(int k) const;
///
///     // constraints of node N instead of those above; terminal_constraints = 0: no constraints
///     // and no functions
///     static constexpr int terminal_constraints;
///     template <typename S>
///     V<S, terminal_constraints> terminal_constraint_values(const V<S, states>& x) const;
///     V<double, terminal_constraints> terminal_lower() const;  // and terminal_upper()
///     V<double, terminal_constraints> terminal_penalty() const;  // absent: infinite
///     V<double, terminal_constraints> terminal_stiffness() const;
///
///     // cost of node N instead of residual(N, x, 0); terminal_residuals = 0: no cost
///     static constexpr int terminal_residuals;
///     template <typename S>
///     V<S, terminal_residuals> terminal_residual(const V<S, states>& x) const;
///
///     // any other cost of node k, added to the squares; `residuals` may then be absent. u is zero
///     // at node N. Its Hessian enters without the parts that are not positive semidefinite
///     template <typename S>
///     S cost(int k, const V<S, states>& x, const V<S, inputs>& u) const;
///
///     // true: second derivatives of dynamics and constraints enter the Hessian, too, without the
///     // parts that are not positive semidefinite; see add_curvature() in problem.hpp
///     static constexpr bool curvature;
///
/// Equal lower and upper bounds make an equality. Without `terminal_constraints`, the `constraints`
/// that do not depend on the input also apply at node N. There the functions are called with an
/// arbitrary input, and a constraint whose derivative by this input is not zero is ignored.
///
/// The functions may be static. Intermediate results must be declared as S or as a matrix of S.
/// With auto they refer to temporaries. The residual of node N must be differentiable at u = 0.
/// AutoDiffProblem allocates only if the struct allocates; Eigen's atan2 of AutoDiffScalars
/// allocates.
template <typename User>
class AutoDiffProblem {
  template <template <typename> class Member>
  static constexpr bool has = detail::has_member<Member, User>;
  static_assert(has<detail::ConstraintsMember> || !has<detail::LowerMember>,
                "lower(k) needs constraints");
  static_assert(has<detail::TerminalConstraintsMember> || !has<detail::TerminalLowerMember>,
                "terminal_lower() needs terminal_constraints");
  static_assert(has<detail::TerminalResidualsMember> || !has<detail::TerminalResidualMember>,
                "terminal_residual(x) needs terminal_residuals");
  static constexpr bool has_terminal_cost = has<detail::TerminalResidualsMember>;
  static constexpr bool has_cost = has<detail::CostMember>;
  static constexpr int residuals = detail::count_of<detail::ResidualsMember, User>(),
                       end_constraints =
                           detail::count_of<detail::TerminalConstraintsMember, User>(),
                       end_residuals = detail::count_of<detail::TerminalResidualsMember, User>();

 public:
  static constexpr int states = User::states, inputs = User::inputs, equalities = 0,
                       constraints = detail::count_of<detail::ConstraintsMember, User>(),
                       /// -1: as the other nodes
      terminal_constraints = has<detail::TerminalConstraintsMember> ? end_constraints : -1;
  using D = ProblemDimensions<AutoDiffProblem>;
  using Tangent = typename D::Tangent;
  using State = Tangent;
  using Input = typename D::Input;
  using Constraints = typename D::Constraints;
  using Model = QuadraticModel<states, inputs>;
  using TerminalConstraints = Eigen::Matrix<double, end_constraints, 1>;
  using TerminalConstraintsX = Eigen::Matrix<double, end_constraints, states>;

  explicit AutoDiffProblem(User user = User()) : user_(std::move(user)) {}

  /// The struct. Its references and weights may change between solves, its horizon may not.
  [[nodiscard]] User& user() { return user_; }
  [[nodiscard]] const User& user() const { return user_; }

  [[nodiscard]] int horizon() const { return user_.horizon(); }
  [[nodiscard]] State retract(const State& x, const Tangent& dx) const { return x + dx; }
  [[nodiscard]] Tangent difference(const State& y, const State& x) const { return y - x; }

  [[nodiscard]] State step(int k, const State& x, const Input& u) const {
    return user_.step(k, x, u);
  }
  [[nodiscard]] State step(int k, const State& x, const Input& u, typename D::A& A,
                           typename D::B& B) const {
    const Duals<states> end = user_.step(k, variables(x), variables(u, states));
    set_derivatives(end, A, B);
    return values(end);
  }

  [[nodiscard]] double cost(int k, const State& x, const Input& u) const {
    const Input at = k < horizon() ? u : Input(Input::Zero());
    double sum = 0.0;
    if constexpr (has_cost) sum = user_.cost(k, x, at);
    if (k == horizon() && has_terminal_cost) {
      if constexpr (end_residuals > 0) sum += user_.terminal_residual(x).squaredNorm();
    } else if constexpr (residuals > 0) {
      sum += user_.residual(k, x, at).squaredNorm();
    }
    return sum;
  }
  void cost_model(int k, const State& x, const Input& u, Model& model) const {
    const Input at = k < horizon() ? u : Input(Input::Zero());
    if (k == horizon() && has_terminal_cost) {
      if constexpr (end_residuals > 0)
        set_model<end_residuals>(user_.terminal_residual(variables(x)), k, model);
    } else if constexpr (residuals > 0) {
      set_model<residuals>(user_.residual(k, variables(x), variables(at, states)), k, model);
    }
    if constexpr (has_cost) {
      if (residuals == 0 || (k == horizon() && has_terminal_cost && end_residuals == 0)) {
        model.hessian.setZero();
        model.gradient.setZero();
      }
      const Dual2 value = user_.cost(k, variables_of_second(x), variables_of_second(at, states));
      for (int i = 0; i < (k < horizon() ? states + inputs : states); ++i)
        model.gradient(i) += value.derivatives()(i).value();
      add_convex_part(k, second_derivatives(value), model);
    }
  }

  [[nodiscard]] Constraints constraint_values(int k, const State& x, const Input& u) const {
    return user_.constraint_values(k, x, k < horizon() ? u : arbitrary_input());
  }
  void constraint_derivatives(int k, const State& x, const Input& u, typename D::ConstraintsX& C,
                              typename D::ConstraintsU& E) const {
    const Input at = k < horizon() ? u : arbitrary_input();
    const Duals<constraints> c = user_.constraint_values(k, variables(x), variables(at, states));
    set_derivatives(c, C, E);
  }
  [[nodiscard]] Constraints lower(int k) const { return user_.lower(k); }
  [[nodiscard]] Constraints upper(int k) const { return user_.upper(k); }
  [[nodiscard]] Constraints penalty(int k) const {
    if constexpr (has<detail::PenaltyMember>) return user_.penalty(k);
    return Constraints::Constant(detail::infinity);
  }
  template <typename U = User>
  [[nodiscard]] auto stiffness(int k) const
      -> decltype(Constraints(std::declval<const U&>().stiffness(k))) {
    return user_.stiffness(k);
  }

  [[nodiscard]] TerminalConstraints terminal_constraint_values(const State& x) const {
    return user_.terminal_constraint_values(x);
  }
  void terminal_constraint_derivatives(const State& x, TerminalConstraintsX& C) const {
    const Duals<end_constraints> c = user_.terminal_constraint_values(variables(x));
    for (int i = 0; i < end_constraints; ++i)
      C.row(i) = c(i).derivatives().template head<states>().transpose();
  }
  [[nodiscard]] TerminalConstraints terminal_lower() const { return user_.terminal_lower(); }
  [[nodiscard]] TerminalConstraints terminal_upper() const { return user_.terminal_upper(); }
  [[nodiscard]] TerminalConstraints terminal_penalty() const {
    if constexpr (has<detail::TerminalPenaltyMember>) return user_.terminal_penalty();
    return TerminalConstraints::Constant(detail::infinity);
  }
  template <typename U = User>
  [[nodiscard]] auto terminal_stiffness() const
      -> decltype(TerminalConstraints(std::declval<const U&>().terminal_stiffness())) {
    return user_.terminal_stiffness();
  }

  /// Exists if the struct asks for it: see `curvature` above.
  template <typename Multipliers, typename U = User, typename = detail::CurvatureMember<U>>
  void add_curvature(int k, const State& x, const Input& u, const Multipliers& multipliers,
                     const Tangent& costate, Model& model) const {
    const auto x2 = variables_of_second(x);
    const auto u2 = variables_of_second(k < horizon() ? u : arbitrary_input(), states);
    Dual2 sum(Dual(0.0));
    if (k < horizon()) {
      const Eigen::Matrix<Dual2, states, 1> end = user_.step(k, x2, u2);
      for (int i = 0; i < states; ++i) sum += end(i) * Dual2(Dual(costate(i)));
    }
    if (k == horizon() && has<detail::TerminalConstraintsMember>) {
      if constexpr (end_constraints > 0) {
        const Eigen::Matrix<Dual2, end_constraints, 1> c = user_.terminal_constraint_values(x2);
        for (int i = 0; i < end_constraints; ++i) sum += c(i) * Dual2(Dual(multipliers(i)));
      }
    } else if constexpr (constraints > 0) {
      const Eigen::Matrix<Dual2, constraints, 1> c = user_.constraint_values(k, x2, u2);
      for (int i = 0; i < constraints; ++i) sum += c(i) * Dual2(Dual(multipliers(i)));
    }
    add_convex_part(k, second_derivatives(sum), model);
  }

 private:
  // A number with its derivatives by (x, u).
  using Dual = Eigen::AutoDiffScalar<Eigen::Matrix<double, states + inputs, 1>>;
  template <int Count>
  using Duals = Eigen::Matrix<Dual, Count, 1>;

  // The same with second derivatives.
  using Dual2 = Eigen::AutoDiffScalar<Eigen::Matrix<Dual, states + inputs, 1>>;
  using Hessian = Eigen::Matrix<double, states + inputs, states + inputs>;

  template <int Count>
  static Eigen::Matrix<Dual2, Count, 1> variables_of_second(
      const Eigen::Matrix<double, Count, 1>& numbers, int first = 0) {
    Eigen::Matrix<Dual2, Count, 1> result;
    for (int i = 0; i < Count; ++i) {
      result(i).value() = Dual(numbers(i), states + inputs, first + i);
      for (int j = 0; j < states + inputs; ++j)
        result(i).derivatives()(j) = Dual(j == first + i ? 1.0 : 0.0);
    }
    return result;
  }
  static Hessian second_derivatives(const Dual2& value) {
    Hessian result;
    for (int i = 0; i < states + inputs; ++i) result.col(i) = value.derivatives()(i).derivatives();
    return result;
  }

  // Adds `hessian` to that of the model, without the negative curvature of the sum.
  void add_convex_part(int k, Hessian hessian, Model& model) const {
    const int size = k < horizon() ? states + inputs : states;
    for (int j = 0; j < states + inputs; ++j)
      for (int i = 0; i < states + inputs; ++i) {
        // The model has lux only in the columns of the inputs.
        const bool mirrored = i >= states && j < states;
        const double entry = mirrored ? model.hessian(j, i) : model.hessian(i, j);
        hessian(i, j) = i < size && j < size ? hessian(i, j) + entry : 0.0;
      }
    if (!all_finite(hessian)) {
      model.gradient(0) = std::numeric_limits<double>::quiet_NaN();
      return;
    }
    // Eigenvalues: the singular values of a matrix that is shifted until it has no negative ones.
    const double shift = hessian.norm();
    for (int i = 0; i < states + inputs; ++i) hessian(i, i) += shift;
    const detail::SingularValues<states + inputs, states + inputs> parts(hessian);
    const Eigen::Matrix<double, states + inputs, 1> scales =
        (parts.values.array() - shift).max(0.0).sqrt();
    const Hessian scaled = parts.left * scales.asDiagonal();
    hessian.noalias() = scaled * scaled.transpose();
    model.lxx() = hessian.template topLeftCorner<states, states>();
    if (k == horizon()) return;
    model.lux() = hessian.template bottomLeftCorner<inputs, states>();
    model.luu() = hessian.template bottomRightCorner<inputs, inputs>();
  }
  // Independent variables: entries of (x, u), starting at index `first`.
  template <int Count>
  static Duals<Count> variables(const Eigen::Matrix<double, Count, 1>& numbers, int first = 0) {
    Duals<Count> duals;
    for (int i = 0; i < Count; ++i) duals(i) = Dual(numbers(i), states + inputs, first + i);
    return duals;
  }

  // No zero entries, because the derivative of a square is zero there, and no two equal entries.
  static Input arbitrary_input() {
    Input u;
    for (int i = 0; i < inputs; ++i) u(i) = 0.37 + 0.113 * i;
    return u;
  }

  template <int Count>
  static Eigen::Matrix<double, Count, 1> values(const Duals<Count>& duals) {
    return duals.unaryExpr([](const Dual& dual) { return dual.value(); });
  }

  template <int Count>
  static void set_derivatives(const Duals<Count>& duals,
                              Eigen::Matrix<double, Count, states>& by_state,
                              Eigen::Matrix<double, Count, inputs>& by_input) {
    for (int i = 0; i < Count; ++i) {
      by_state.row(i) = duals(i).derivatives().template head<states>().transpose();
      by_input.row(i) = duals(i).derivatives().template tail<inputs>().transpose();
    }
  }

  // Sets the Gauss-Newton model of |r|^2. Its Hessian has no second derivatives of r.
  template <int Count>
  void set_model(const Duals<Count>& residual, int k, Model& model) const {
    const Eigen::Matrix<double, Count, 1> r = values<Count>(residual);
    Eigen::Matrix<double, Count, states> by_state;
    Eigen::Matrix<double, Count, inputs> by_input;
    set_derivatives<Count>(residual, by_state, by_input);
    model.lx().noalias() = 2.0 * by_state.transpose().lazyProduct(r);
    model.lxx().noalias() = 2.0 * by_state.transpose().lazyProduct(by_state);
    if (k == horizon()) return;
    model.lu().noalias() = 2.0 * by_input.transpose().lazyProduct(r);
    model.lux().noalias() = 2.0 * by_input.transpose().lazyProduct(by_state);
    model.luu().noalias() = 2.0 * by_input.transpose().lazyProduct(by_input);
  }

  User user_;
};

}  // namespace tilt_ropter::optimal_control
