// SPDX-License-Identifier: BSD-3-Clause
#pragma once

/// What the solver tells.
namespace tilt_ropter {

/// How a solve or a real-time iteration ended. `converged` and `iterated` imply a solved quadratic
/// program and no hard constraint given up.
enum class SolveStatus {
  converged,        ///< the KKT residual is below the tolerance
  iterated,         ///< a real-time iteration was done, its quadratic program is solved
  infeasible,       ///< as one of the two above, but hard constraints had to be given up
  iteration_limit,  ///< reached in solve() or in the quadratic program; the last iterate is kept
  time_limit,       ///< likewise
  stalled,          ///< no step lowers the merit any more; the last iterate is kept
  failed,           ///< a non-finite number or no factorisation; the iterate before it is kept
  rejected,         ///< the initial state is not finite; nothing was changed
};

/// What became of the part of a solve that needs no measurement.
enum class PrepareStatus {
  prepared,
  failed,    ///< a number was not finite, or no factorisation: feedback() will fail
  rejected,  ///< the time is not finite; nothing was changed
};

/// True if there is a new iterate that can be used: all inputs are finite, and those of node 0
/// within their hard bounds.
[[nodiscard]] constexpr bool has_plan(SolveStatus status) {
  return status != SolveStatus::failed && status != SolveStatus::rejected;
}

/// What a solve reports. The KKT residual, violation, defect and cost are those of the iterate that
/// was linearised last: the returned one for solve(), the one before the step for feedback(). NaN
/// anywhere makes a residual infinite.
struct SolveReport {
  SolveStatus status = SolveStatus::failed;
  double cost = 0.0;
  double kkt = 0.0;               ///< largest of stationarity, defect, violation, complementarity
  double max_defect = 0.0;        ///< of continuity, in tangent coordinates
  double max_violation = 0.0;     ///< of constraints
  double max_equality = 0.0;      ///< of equalities with a weight
  double program_residual = 0.0;  ///< of the last quadratic program: see ProgramResidual
  int iterations = 0;
  int passes = 0;       ///< Riccati passes in the last quadratic program, besides prepare()'s
  int rounds = 0;       ///< of NLopt in the last quadratic program
  int active_rows = 0;  ///< constraints with a multiplier in the last quadratic program
  /// Constraints that the last quadratic program violates because keeping to them would cost more
  /// than their price, the hard ones among them, and their largest violations; see given_up().
  int given_up_rows = 0, given_up_hard_rows = 0;
  double largest_given_up = 0.0, largest_given_up_hard = 0.0;
  double step = 1.0;     ///< length of the last step, 1 if it was a full one
  double damping = 0.0;  ///< added to the Hessians because they were not positive definite
  double prepare_us = 0.0, feedback_us = 0.0;  ///< wall time of the two phases [us]
  /// Parts of prepare; the last one: gradients of the constraints that NLopt gets [us].
  double linearise_us = 0.0, factorise_us = 0.0, rows_us = 0.0;
};

}  // namespace tilt_ropter
