// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>

/// The constraints of one node of a quadratic program, and the residual of a step.
///
/// Every constraint has a penalty: the cost of violating it by one unit, and the upper bound on its
/// multiplier (Nocedal & Wright, "Numerical Optimization", Sec. 17.2). Every constraint has a
/// stiffness: the multiplier per unit of violation. While a multiplier m is below the penalty, the
/// violation is m / stiffness. Therefore every program has a solution.
namespace tilt_ropter::optimal_control {

/// Cost of a `violation` >= 0. The cost is quadratic while its slope, stiffness times violation, is
/// below the penalty, and linear beyond.
[[nodiscard]] inline double violation_cost(double penalty, double stiffness, double violation) {
  const double linear = violation - 0.5 * penalty / stiffness;
  return stiffness * violation < penalty ? 0.5 * stiffness * violation * violation
                                         : penalty * linear;
}

/// Constraints of one node.
template <int States, int Inputs, int Constraints>
struct NodeConstraints {
  using Values = Eigen::Matrix<double, Constraints, 1>;
  static constexpr double infinity = std::numeric_limits<double>::infinity();
  Values value = detail::Filled();  ///< at the point of linearisation
  Eigen::Matrix<double, Constraints, States> C = detail::Filled();  ///< derivative by the state
  Eigen::Matrix<double, Constraints, Inputs> E = detail::Filled();  ///< derivative by the input
  Values lower = detail::Filled{-infinity};                         ///< infinite: no bound
  Values upper = detail::Filled{infinity};                          ///< infinite: no bound
  Values penalty = detail::Filled{1.0};                             ///< largest multiplier, finite
  Values stiffness = detail::Filled{infinity};  ///< infinite: no violation below the penalty
  /// In: warm start. Out: solution. > 0 at the upper bound, < 0 at the lower.
  Values multiplier = detail::Filled();
  Values predicted = detail::Filled();  ///< value + C dx + E du at the current step
  /// Finite penalties of the hard constraints in the last program, see InteriorPoint.
  Values finite_penalty = detail::Filled{infinity};
  /// `crossed`: some lower bound was above its upper bound, see Subproblem::check_node().
  /// `crosses`: the same for each constraint, valid only if `crossed`.
  bool crossed = false;
  std::array<bool, static_cast<std::size_t>(Constraints)> crosses{};
  std::array<bool, static_cast<std::size_t>(Constraints)> hard{};  ///< its own penalty is infinite

  /// Returns the violation of the original bounds of constraint i at this value, at least zero.
  [[nodiscard]] double violation(int i, double constraint_value) const {
    const bool swapped = crossed && crosses[static_cast<std::size_t>(i)];
    const double below = swapped ? upper(i) : lower(i), above = swapped ? lower(i) : upper(i);
    return std::max({0.0, below - constraint_value, constraint_value - above});
  }
};

/// Residual of a step and its multipliers in a program: the largest residual of each condition.
struct ProgramResidual {
  double stationarity = 0.0;     ///< of the inputs, relative to the largest term
  double violation = 0.0;        ///< beyond the violation that the multiplier accounts for,
                                 ///< relative to the bound
  double complementarity = 0.0;  ///< the smaller of distance from the bound, relative to the bound,
                                 ///< and multiplier, relative to the largest multiplier
  double gap = 0.0;              ///< error of the cost due to complementarity, relative to the cost
  [[nodiscard]] double largest() const {
    const double most = std::max({stationarity, violation, complementarity, gap});
    return stationarity + violation + complementarity + gap <
                   std::numeric_limits<double>::infinity()
               ? most
               : std::numeric_limits<double>::infinity();  // also for NaN
  }
};

}  // namespace tilt_ropter::optimal_control
