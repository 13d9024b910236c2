// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/optimal_control/detail/riccati.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <cmath>
#include <optional>

/// The cost to go of an infinite horizon.
namespace tilt_ropter::optimal_control {

/// Returns P of an infinite horizon with the same interval and cost at every node: the stabilising
/// solution of the discrete algebraic Riccati equation
///
///     P = lxx + A' P A - (A' P B + lux') (luu + B' P B)^-1 (B' P A + lux).
///
/// The function repeats passes of Riccati from the identity until no entry P_ij changes by more
/// than 1e-12 sqrt(P_ii P_jj) in a pass. Returns nothing if `max_passes` passes are not enough or a
/// pass fails. P does not exist if a motion that does not decay has no cost or cannot be stopped.
/// Allocates. For an NMPC, a pass takes about a microsecond. The number of passes is the number of
/// intervals in which the slowest motion decays by 1e-6, because the cost is the square of the
/// motion.
template <int States, int Inputs, typename Pattern = FullTransition>
[[nodiscard]] std::optional<Eigen::Matrix<double, States, States>> solve_dare(
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

}  // namespace tilt_ropter::optimal_control
