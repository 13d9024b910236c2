// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <type_traits>
#include <utility>

namespace tilt_ropter::detail {

/// True if the type has the function or constant that Member<Type> refers to.
template <template <typename> class Member, typename Type, typename = void>
inline constexpr bool has_member = false;
template <template <typename> class Member, typename Type>
inline constexpr bool has_member<Member, Type, std::void_t<Member<Type>>> = true;

/// Value of such a constant, or `absent` if the type does not have it.
template <template <typename> class Member, typename Type>
constexpr int count_of(int absent = 0) {
  if constexpr (has_member<Member, Type>) return Member<Type>::value;
  return absent;
}

template <typename Type>
using TerminalConstraintsMember = std::integral_constant<int, Type::terminal_constraints>;
template <typename Type>
using StiffnessMember = decltype(std::declval<const Type&>().stiffness(0));
template <typename Type>
using TerminalStiffnessMember = decltype(std::declval<const Type&>().terminal_stiffness());

}  // namespace tilt_ropter::detail

// clang-format off
/// The concept of a multiple-shooting problem. A problem is any type `Problem` with
///
///     static constexpr int states, inputs;    // dimensions of the tangent space and of the input
///     static constexpr int constraints, equalities;  // counts per node
///     using State = ...;                      // a point of the state manifold
///     using D = ProblemDimensions<Problem>;   // the vector and matrix types below
///
///     int horizon() const;                                          // number of intervals N
///     State retract(const State& x, const D::Tangent& dx) const;    // x (+) dx
///     D::Tangent difference(const State& y, const State& x) const;  // y (-) x
///
///     // end state of interval k (0 <= k < N); the second overload also returns the derivatives
///     State step(int k, const State& x, const D::Input& u) const;
///     State step(int k, const State& x, const D::Input& u, D::A& A, D::B& B) const;
///
///     // cost of node k (k = N: terminal cost, u is zero and unused) and its Gauss-Newton model
///     double cost(int k, const State& x, const D::Input& u) const;
///     void cost_model(int k, const State& x, const D::Input& u, QuadraticModel<nx, nu>& m) const;
///
///     // only if constraints > 0: lower <= c(x, u) <= upper; an infinite bound is no bound.
///     // The penalty is the cost of violating a constraint by one unit. It is the largest
///     // multiplier of the constraint. Infinite: a hard constraint. At node N, constraints that
///     // depend on the input (non-zero entry in E) are ignored.
///     D::Constraints constraint_values(int k, const State& x, const D::Input& u) const;
///     void constraint_derivatives(int k, const State& x, const D::Input& u,
///                          D::ConstraintsX& C, D::ConstraintsU& E) const;
///     const D::Constraints& lower(int k) const;
///     const D::Constraints& upper(int k) const;
///     const D::Constraints& penalty(int k) const;
///
///     // only if equalities > 0: h(x) = 0 by weight; a weight of zero disables the equality
///     D::Equalities equality_values(int k, const State& x) const;
///     void equality_derivatives(int k, const State& x, D::EqualitiesX& H) const;
///     D::Equalities equality_weights(int k) const;
///
/// Optional members of a problem:
///
///     using TransitionPattern = ...;  // entries of A and B that can be non-zero: FullTransition
///
///     // adds second derivatives of constraints and dynamics to lxx, lux and luu of a node, without
///     // the parts that are not positive semidefinite. The solver calls it after cost_model(),
///     // which must then set every entry that this function changes. multipliers: of the node's
///     // constraints, > 0 at the upper bound. costate: derivative of the cost of all later nodes by
///     // the end of interval k, zero for k = N. A Gauss-Newton Hessian lacks these terms; where
///     // multipliers are large, iterations may not converge without them.
///     void add_curvature(int k, const State& x, const D::Input& u,
///                        const ProblemConstraints<Problem>::Values& multipliers,
///                        const D::Tangent& costate, QuadraticModel<nx, nu>& m) const;
///
///     // a violation v costs stiffness v^2 / 2 until the slope of this cost reaches the penalty:
///     // the multiplier is min(stiffness v, penalty). Infinite, or absent: the penalty alone
///     const D::Constraints& stiffness(int k) const;
///
///     // separate constraints of node N; the constraints of the other nodes then end at N - 1
///     static constexpr int terminal_constraints;
///     TerminalConstraints terminal_constraint_values(const State& x) const;
///     void terminal_constraint_derivatives(const State& x, TerminalConstraintsX& C) const;
///     const TerminalConstraints& terminal_lower() const;    // likewise terminal_upper(),
///     const TerminalConstraints& terminal_penalty() const;  // terminal_stiffness()
///
///     // the intervals k .. k + count - 1, count <= 4, side by side. x and u start at node k. A is
///     // the identity and B is zero where nothing is written.
///     void step_lanes(int k, int count, const State* x, const D::Input* u, State* ends,
///                     Eigen::Matrix<Lanes, nx, nx>& A, Eigen::Matrix<Lanes, nx, nu>& B) const;
///
/// All derivatives by the state are in tangent coordinates: d/d(dx) of f(x (+) dx) at dx = 0. The
/// problem must set A, B and H completely. An entry of the model, C and E that is not set keeps its
/// last value for that node, initially zero. None of these functions may throw or allocate. They
/// may return non-finite numbers, which the solver reports as a failure.
///
/// AutoDiffProblem makes such a type from four short functions and computes the derivatives; a
/// complete program is examples/getting_started/solve.cpp. check_derivatives() finds errors in
/// derivatives written by hand. In a loop, call shift(1.0) and prepare() in every interval before the
/// measurement comes, then feedback(measured); input(0) is the input to apply.
// clang-format on
namespace tilt_ropter::optimal_control {

/// Vector and matrix types of a problem.
template <typename Problem>
struct ProblemDimensions {
  static constexpr int nx = Problem::states, nu = Problem::inputs, nc = Problem::constraints,
                       ne = Problem::equalities;
  using Tangent = Eigen::Matrix<double, nx, 1>;
  using Input = Eigen::Matrix<double, nu, 1>;
  using A = Eigen::Matrix<double, nx, nx>;
  using B = Eigen::Matrix<double, nx, nu>;
  using Constraints = Eigen::Matrix<double, nc, 1>;
  using ConstraintsX = Eigen::Matrix<double, nc, nx>;
  using ConstraintsU = Eigen::Matrix<double, nc, nu>;
  using Equalities = Eigen::Matrix<double, ne, 1>;
  using EqualitiesX = Eigen::Matrix<double, ne, nx>;
};

/// Quadratic model of a node's cost,
/// l + lx' dx + lu' du + 1/2 dx' lxx dx + du' lux dx + 1/2 du' luu du, with symmetric lxx and luu.
template <int States, int Inputs>
class QuadraticModel {
 public:
  static constexpr int width = States + Inputs, rows = detail::padded(width);

  [[nodiscard]] auto lx() { return gradient.template head<States>(); }
  [[nodiscard]] auto lu() { return gradient.template segment<Inputs>(States); }
  [[nodiscard]] auto lxx() { return hessian.template topLeftCorner<States, States>(); }
  [[nodiscard]] auto lux() { return hessian.template block<States, Inputs>(0, States).transpose(); }
  [[nodiscard]] auto luu() { return hessian.template block<Inputs, Inputs>(States, States); }
  [[nodiscard]] auto lx() const { return gradient.template head<States>(); }
  [[nodiscard]] auto lu() const { return gradient.template segment<Inputs>(States); }
  [[nodiscard]] auto lxx() const { return hessian.template topLeftCorner<States, States>(); }
  [[nodiscard]] auto lux() const {
    return hessian.template block<States, Inputs>(0, States).transpose();
  }
  [[nodiscard]] auto luu() const { return hessian.template block<Inputs, Inputs>(States, States); }

  /// Storage of the solver: order (dx, du), padded with zeros to whole packets. lux' is stored only
  /// in the columns of du.
  Eigen::Matrix<double, rows, width> hessian = detail::Filled();
  Eigen::Matrix<double, rows, 1> gradient = detail::Filled();
};

/// Entries of [A B] that can be non-zero; here all. A problem with structural zeros can define a
/// type of this form named TransitionPattern. The solver then skips multiplications by these zeros.
struct FullTransition {
  static constexpr bool nonzero(int /*row*/, int /*column*/) { return true; }
};

/// The TransitionPattern of a problem, or FullTransition if the problem has none.
template <typename Problem, typename = void>
struct TransitionPatternOf {
  using type = FullTransition;
};
/// Specialisation for a problem that has its own TransitionPattern.
template <typename Problem>
struct TransitionPatternOf<Problem, std::void_t<typename Problem::TransitionPattern>> {
  using type = typename Problem::TransitionPattern;
};

/// True for a problem that has step_lanes().
template <typename Problem, typename = void>
struct HasLanes : std::false_type {};
template <typename Problem>
struct HasLanes<Problem, std::void_t<decltype(&Problem::step_lanes)>> : std::true_type {};

/// The constraints of a problem in vectors of the same size for every node. The solvers read them
/// in this form, whether or not the problem has the optional functions.
template <typename Problem>
class ProblemConstraints {
 public:
  using D = ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Input = typename D::Input;
  static constexpr int of_nodes = D::nc;
  /// Number of separate constraints of node N; -1 if node N has the constraints of the other nodes.
  static constexpr int of_end = detail::count_of<detail::TerminalConstraintsMember, Problem>(-1);
  static constexpr int count = std::max(of_nodes, of_end);
  using Values = Eigen::Matrix<double, count, 1>;
  using ByState = Eigen::Matrix<double, count, D::nx>;
  using ByInput = Eigen::Matrix<double, count, D::nu>;

  [[nodiscard]] static Values values(const Problem& problem, int k, const State& x,
                                     const Input& u) {
    if constexpr (count == of_nodes && of_end < 0) {
      if constexpr (count > 0) return problem.constraint_values(k, x, u);
      return {};
    } else {
      Values all = Values::Zero();
      if (k == problem.horizon()) {
        if constexpr (of_end > 0)
          all.template head<of_end>() = problem.terminal_constraint_values(x);
      } else if constexpr (of_nodes > 0) {
        all.template head<of_nodes>() = problem.constraint_values(k, x, u);
      }
      return all;
    }
  }

  /// Writes the derivatives. Entries that the problem does not set keep their values.
  static void derivatives(const Problem& problem, int k, const State& x, const Input& u, ByState& C,
                          ByInput& E) {
    if constexpr (count == of_nodes && of_end < 0) {
      if constexpr (count > 0) problem.constraint_derivatives(k, x, u, C, E);
    } else if (k == problem.horizon()) {
      if constexpr (of_end > 0) {
        Eigen::Matrix<double, of_end, D::nx> by_state = C.template topRows<of_end>();
        problem.terminal_constraint_derivatives(x, by_state);
        C.template topRows<of_end>() = by_state;
      }
    } else if constexpr (of_nodes > 0) {
      typename D::ConstraintsX by_state = C.template topRows<of_nodes>();
      typename D::ConstraintsU by_input = E.template topRows<of_nodes>();
      problem.constraint_derivatives(k, x, u, by_state, by_input);
      C.template topRows<of_nodes>() = by_state;
      E.template topRows<of_nodes>() = by_input;
    }
  }

  /// Writes bounds, penalty and stiffness, infinite where the problem has none. If the problem has
  /// no stiffness at all, `stiffness` is not written.
  static void bounds(const Problem& problem, int k, Values& lower, Values& upper, Values& penalty,
                     Values& stiffness) {
    constexpr bool has_stiffness = detail::has_member<detail::StiffnessMember, Problem>,
                   has_terminal_stiffness =
                       detail::has_member<detail::TerminalStiffnessMember, Problem>;
    if constexpr (count > of_nodes || of_end >= 0) {
      lower.setConstant(-detail::infinity);
      upper.setConstant(detail::infinity);
      penalty.setConstant(detail::infinity);
    }
    if constexpr (has_stiffness || has_terminal_stiffness) stiffness.setConstant(detail::infinity);
    if constexpr (of_end >= 0) {
      if (k == problem.horizon()) {
        if constexpr (of_end > 0) {
          detail::copy_first(of_end, problem.terminal_lower(), lower);
          detail::copy_first(of_end, problem.terminal_upper(), upper);
          detail::copy_first(of_end, problem.terminal_penalty(), penalty);
          if constexpr (has_terminal_stiffness)
            detail::copy_first(of_end, problem.terminal_stiffness(), stiffness);
        }
        return;
      }
    }
    if constexpr (of_nodes > 0) {
      detail::copy_first(of_nodes, problem.lower(k), lower);
      detail::copy_first(of_nodes, problem.upper(k), upper);
      detail::copy_first(of_nodes, problem.penalty(k), penalty);
      if constexpr (has_stiffness) detail::copy_first(of_nodes, problem.stiffness(k), stiffness);
    }
  }

  /// Returns true if constraint i, with the derivative `E`, applies at node k. Node N has no input.
  [[nodiscard]] static bool applies(const Problem& problem, int k, const ByInput& E, int i) {
    if constexpr (count == 0) return false;
    bool sees_input = false;
    for (int j = 0; j < D::nu; ++j) sees_input |= E(i, j) != 0.0;
    return k < problem.horizon() || of_end >= 0 || !sees_input;
  }
};

/// True for a problem that has add_curvature().
template <typename Problem, typename = void>
struct HasCurvature : std::false_type {};
template <typename P>
struct HasCurvature<
    P, std::void_t<decltype(std::declval<const P&>().add_curvature(
           0, typename P::State(), typename ProblemDimensions<P>::Input(),
           typename ProblemConstraints<P>::Values(), typename ProblemDimensions<P>::Tangent(),
           std::declval<QuadraticModel<P::states, P::inputs>&>()))>> : std::true_type {};

}  // namespace tilt_ropter::optimal_control
