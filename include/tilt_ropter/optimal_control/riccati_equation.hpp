// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/riccati.hpp>

#include <Eigen/Core>

#include <cmath>
#include <optional>

/// The cost to go of a horizon without end.
namespace tilt_ropter {

/// P of a horizon without end that has the same interval and cost throughout: the solution that
/// stabilises of the discrete algebraic Riccati equation
///
///     P = lxx + A' P A - (A' P B + lux') (luu + B' P B)^-1 (B' P A + lux),
///
/// by passes of Riccati from the identity, until none of its entries moves by more than 1e-12 of
/// sqrt(P_ii P_jj) in a pass. Empty if `max_passes` do not get there: it does not exist where some
/// motion that does not die out costs nothing or cannot be stopped. Allocates; takes about a
/// microsecond a pass for an NMPC, and as many passes as the slowest motion takes intervals to
/// decay by 1e-6, since the cost is its square.
template <int States, int Inputs, typename Pattern = FullTransition>
[[nodiscard]] std::optional<Eigen::Matrix<double, States, States>> endless_cost(
    const Eigen::Matrix<double, States, States>& A, const Eigen::Matrix<double, States, Inputs>& B,
    const QuadraticModel<States, Inputs>& cost, int max_passes = 20000) {
  Riccati<States, Inputs, Pattern> pass(1);
  auto& end = pass.stage(1).cost;
  if (!pass.set_transition(0, A, B)) return std::nullopt;
  pass.stage(0).cost = cost;
  Eigen::Matrix<double, States, States> P = detail::Filled();
  for (int i = 0; i < States; ++i) P(i, i) = 1.0;
  for (int i = 0; i < max_passes; ++i) {
    for (int c = 0; c < States; ++c)
      for (int r = 0; r < States; ++r) end.hessian(r, c) = P(r, c);
    if (!pass.factorise()) return std::nullopt;
    const auto last = P;
    P = pass.initial_cost();
    bool moved = false;
    for (int c = 0; c < States; ++c)
      for (int r = 0; r < States; ++r)
        moved |= !(std::abs(P(r, c) - last(r, c)) <= 1e-12 * std::sqrt(P(r, r) * P(c, c)));
    if (!moved) return P;
  }
  return std::nullopt;
}

}  // namespace tilt_ropter
