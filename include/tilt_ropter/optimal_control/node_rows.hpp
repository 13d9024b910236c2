// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/entries.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>

/// The constraints of one node of a quadratic program, and how far a step is from solving it.
///
/// Every constraint has a price, the cost of violating it by one unit, which bounds its multiplier
/// (Nocedal & Wright, "Numerical Optimization", Sec. 17.2), and a stiffness, the multiplier per
/// unit of violation: a multiplier m goes with a violation of m / stiffness while it is below the
/// price. So every program has a solution.
namespace tilt_ropter {

/// What a violation >= 0 costs: quadratic up to where its slope, the stiffness times it, reaches
/// the price, linear from there on.
[[nodiscard]] inline double violation_cost(double price, double stiffness, double violation) {
  const double linear = violation - 0.5 * price / stiffness;
  return stiffness * violation < price ? 0.5 * stiffness * violation * violation : price * linear;
}

/// Constraints of one node.
template <int States, int Inputs, int Rows>
struct NodeRows {
  using Values = Eigen::Matrix<double, Rows, 1>;
  static constexpr double infinity = std::numeric_limits<double>::infinity();
  Values value = detail::Filled();  ///< at the point of linearisation
  Eigen::Matrix<double, Rows, States> C = detail::Filled();
  Eigen::Matrix<double, Rows, Inputs> E = detail::Filled();
  Values lower = detail::Filled{-infinity};  ///< infinite: no bound
  Values upper = detail::Filled{infinity};
  Values price = detail::Filled{1.0};           ///< largest multiplier, finite
  Values stiffness = detail::Filled{infinity};  ///< infinite: no violation below the price
  /// In: warm start. Out: solution. > 0 at the upper bound, < 0 at the lower.
  Values multiplier = detail::Filled();
  Values predicted = detail::Filled();  ///< value + C dx + E du at the current step
  /// Of hard constraints: the finite price that the last program had for them, see InteriorPoint.
  Values stand_in = detail::Filled{infinity};
  /// The lower bound was above the upper one, see Subproblem::check_node(); in any row, in row i.
  bool crossed = false;
  std::array<bool, static_cast<std::size_t>(Rows)> crosses{};
  std::array<bool, static_cast<std::size_t>(Rows)> hard{};  ///< its own price is infinite

  /// How far row i would be outside the bounds it was given with this value, at least zero.
  [[nodiscard]] double violation(int i, double row_value) const {
    const bool swapped = crossed && crosses[static_cast<std::size_t>(i)];
    const double below = swapped ? upper(i) : lower(i), above = swapped ? lower(i) : upper(i);
    return std::max({0.0, below - row_value, row_value - above});
  }
};

/// How far a step with its multipliers is from solving a program: the largest of each condition.
struct ProgramResidual {
  double stationarity = 0.0;     ///< of the inputs, relative to the largest term
  double violation = 0.0;        ///< beyond what the multiplier pays for, relative to the bound
  double complementarity = 0.0;  ///< distance from the bound or multiplier, whichever is smaller,
                                 ///< relative to the bound and to the largest multiplier
  double gap = 0.0;              ///< what the cost is off by for that, relative to the cost
  [[nodiscard]] double largest() const {
    const double most = std::max({stationarity, violation, complementarity, gap});
    return stationarity + violation + complementarity + gap <
                   std::numeric_limits<double>::infinity()
               ? most
               : std::numeric_limits<double>::infinity();  // NaN, too
  }
};

}  // namespace tilt_ropter
