// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <limits>
#include <type_traits>
#include <utility>

namespace tilt_ropter::optimal_control {

/// The constraints of a problem in vectors of the same size for every node. The solvers read them
/// in this form, whether or not the problem has the optional functions.
template <typename Problem>
class ProblemConstraints {
 private:
  template <typename P, typename = void>
  struct TerminalCount : std::integral_constant<int, -1> {};
  template <typename P>
  struct TerminalCount<P, std::void_t<decltype(P::terminal_constraints)>>
      : std::integral_constant<int, P::terminal_constraints> {};
  template <typename P, typename = void>
  struct HasStiffness : std::false_type {};
  template <typename P>
  struct HasStiffness<P, std::void_t<decltype(std::declval<const P&>().stiffness(0))>>
      : std::true_type {};
  template <typename P, typename = void>
  struct HasTerminalStiffness : std::false_type {};
  template <typename P>
  struct HasTerminalStiffness<P,
                              std::void_t<decltype(std::declval<const P&>().terminal_stiffness())>>
      : std::true_type {};

 public:
  using D = ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Input = typename D::Input;
  static constexpr int of_nodes = D::nc;
  /// Number of separate constraints of node N; -1 if node N has the constraints of the other nodes.
  static constexpr int of_end = TerminalCount<Problem>::value;
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
    constexpr double infinity = std::numeric_limits<double>::infinity();
    if constexpr (count > of_nodes || of_end >= 0) {
      lower.setConstant(-infinity);
      upper.setConstant(infinity);
      penalty.setConstant(infinity);
    }
    if constexpr (HasStiffness<Problem>::value || HasTerminalStiffness<Problem>::value)
      stiffness.setConstant(infinity);
    if constexpr (of_end >= 0) {
      if (k == problem.horizon()) {
        if constexpr (of_end > 0) {
          detail::copy_first(of_end, problem.terminal_lower(), lower);
          detail::copy_first(of_end, problem.terminal_upper(), upper);
          detail::copy_first(of_end, problem.terminal_penalty(), penalty);
          if constexpr (HasTerminalStiffness<Problem>::value)
            detail::copy_first(of_end, problem.terminal_stiffness(), stiffness);
        }
        return;
      }
    }
    if constexpr (of_nodes > 0) {
      detail::copy_first(of_nodes, problem.lower(k), lower);
      detail::copy_first(of_nodes, problem.upper(k), upper);
      detail::copy_first(of_nodes, problem.penalty(k), penalty);
      if constexpr (HasStiffness<Problem>::value)
        detail::copy_first(of_nodes, problem.stiffness(k), stiffness);
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

}  // namespace tilt_ropter::optimal_control
