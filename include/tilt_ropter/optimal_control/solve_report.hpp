// SPDX-License-Identifier: BSD-3-Clause
#pragma once

/// Reports of the solver.
namespace tilt_ropter::optimal_control {

/// Result of a solve or a real-time iteration. `converged` and `iterated` imply that the quadratic
/// program is solved and no hard constraint is relaxed.
enum class SolveStatus {
  converged,        ///< the KKT residual is below the tolerance
  iterated,         ///< a real-time iteration is done, its quadratic program is solved
  damped,           ///< like iterated, but its Hessians had to be damped to be positive definite
  infeasible,       ///< like converged or iterated, but hard constraints are relaxed
  iteration_limit,  ///< reached in solve() or in the quadratic program; the last iterate is kept
  time_limit,       ///< reached in solve() or in the quadratic program; the last iterate is kept
  stalled,          ///< no step lowers the merit any more; the last iterate is kept
  failed,           ///< non-finite number or no factorisation; the previous iterate is kept
  rejected,         ///< the initial state is not finite; nothing was changed
};

[[nodiscard]] constexpr const char* to_string(SolveStatus status) {
  switch (status) {
    case SolveStatus::converged:
      return "converged";
    case SolveStatus::iterated:
      return "iterated";
    case SolveStatus::damped:
      return "damped";
    case SolveStatus::infeasible:
      return "infeasible";
    case SolveStatus::iteration_limit:
      return "iteration_limit";
    case SolveStatus::time_limit:
      return "time_limit";
    case SolveStatus::stalled:
      return "stalled";
    case SolveStatus::failed:
      return "failed";
    case SolveStatus::rejected:
      return "rejected";
  }
  return "unknown";
}

/// What solved a quadratic program.
enum class ProgramSolver {
  riccati,         ///< one Riccati pass: no constraint is active
  nlopt,           ///< NLopt, on the dual of the active constraints
  active_set,      ///< Riccati passes with the active constraints of the last solution
  interior_point,  ///< interior point, with a last pass of the active set
};

[[nodiscard]] constexpr const char* to_string(ProgramSolver solver) {
  switch (solver) {
    case ProgramSolver::riccati:
      return "riccati";
    case ProgramSolver::nlopt:
      return "nlopt";
    case ProgramSolver::active_set:
      return "active_set";
    case ProgramSolver::interior_point:
      return "interior_point";
  }
  return "unknown";
}

/// Result of the part of a solve that needs no measurement.
enum class PrepareStatus {
  prepared,
  failed,    ///< non-finite number or no factorisation: feedback() will fail
  rejected,  ///< the time is not finite; nothing was changed
};

/// Returns true if there is a new, usable iterate: all inputs are finite, and the inputs of node 0
/// are within their hard bounds.
[[nodiscard]] constexpr bool has_plan(SolveStatus status) {
  return status != SolveStatus::failed && status != SolveStatus::rejected;
}

/// Returns true if solve() ended where the conditions of an optimum hold, except of hard
/// constraints that cannot all be satisfied.
[[nodiscard]] constexpr bool is_solution(SolveStatus status) {
  return status == SolveStatus::converged || status == SolveStatus::infeasible;
}

/// Report of a solve. KKT residual, violation, defect and cost belong to the last linearised
/// iterate. For solve() this is the returned iterate, for feedback() the iterate before the step.
/// Any NaN makes a residual infinite.
struct SolveReport {
  SolveStatus status = SolveStatus::failed;  ///< how the solve ended
  double cost = 0.0;                         ///< sum over all nodes
  double kkt = 0.0;               ///< largest of stationarity, defect, violation, complementarity
  double max_defect = 0.0;        ///< of continuity, in tangent coordinates
  double max_violation = 0.0;     ///< of constraints
  double max_equality = 0.0;      ///< residual of equalities with a weight
  double program_residual = 0.0;  ///< of the last quadratic program, see ProgramResidual
  int iterations = 0;             ///< SQP iterations; 1 for feedback()
  int passes = 0;  ///< Riccati passes in the last quadratic program, without those of prepare()
  ProgramSolver solved_by = ProgramSolver::riccati;  ///< of the last quadratic program
  /// In the last quadratic program: rounds of NLopt, with two sweeps through the horizon each,
  /// gradient evaluations by NLopt, and our Newton steps that polished its results.
  int rounds = 0, evaluations = 0, polishing_steps = 0;
  int active_constraints = 0;  ///< constraints with a multiplier in the last quadratic program
  /// Number and largest violation of the constraints that the last quadratic program relaxed,
  /// because satisfying them would cost more than their price; also for the hard constraints among
  /// them. See relaxed().
  int relaxed_constraints = 0, relaxed_hard_constraints = 0;
  double largest_relaxation = 0.0, largest_hard_relaxation = 0.0;
  double step = 1.0;     ///< length of the last step, 1 for a full step
  double damping = 0.0;  ///< added to Hessians that were not positive definite
  double prepare_us = 0.0, feedback_us = 0.0;  ///< wall time of the two phases [us]
  /// Wall time of the parts of prepare [us]. gradients_us: gradients of the constraints for NLopt.
  double linearise_us = 0.0, factorise_us = 0.0, gradients_us = 0.0;
};

}  // namespace tilt_ropter::optimal_control
