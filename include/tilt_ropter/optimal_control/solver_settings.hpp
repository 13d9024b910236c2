// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/validation.hpp>

#include <chrono>
#include <cmath>
#include <tuple>

/// Settings and reports of the solvers.
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

[[nodiscard]] constexpr const char* to_string(SolveStatus status) noexcept {
  return tilt_ropter::detail::name_in(
      {"converged", "iterated", "damped", "infeasible", "iteration_limit", "time_limit", "stalled",
       "failed", "rejected"},
      status);
}

/// What solved a quadratic program.
enum class ProgramSolver {
  riccati,         ///< one Riccati pass: no constraint is active
  nlopt,           ///< NLopt, on the dual of the active constraints
  active_set,      ///< Riccati passes with the active constraints of the last solution
  interior_point,  ///< interior point, with a last pass of the active set
};

[[nodiscard]] constexpr const char* to_string(ProgramSolver solver) noexcept {
  return tilt_ropter::detail::name_in({"riccati", "nlopt", "active_set", "interior_point"}, solver);
}

/// Result of the part of a solve that needs no measurement.
enum class PrepareStatus {
  prepared,
  failed,    ///< non-finite number or no factorisation: feedback() will fail
  rejected,  ///< the time is not finite; nothing was changed
};

[[nodiscard]] constexpr const char* to_string(PrepareStatus status) noexcept {
  return tilt_ropter::detail::name_in({"prepared", "failed", "rejected"}, status);
}

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
  /// because satisfying them would cost more than their penalty; also for the hard constraints
  /// among them. See relaxed().
  int relaxed_constraints = 0, relaxed_hard_constraints = 0;
  double largest_relaxation = 0.0, largest_hard_relaxation = 0.0;
  double step = 1.0;     ///< length of the last step, 1 for a full step
  double damping = 0.0;  ///< added to Hessians that were not positive definite
  double prepare_us = 0.0, feedback_us = 0.0;  ///< wall time of the two phases [us]
  /// Wall time of the parts of prepare [us]. gradients_us: gradients of the constraints for NLopt.
  double linearise_us = 0.0, factorise_us = 0.0, gradients_us = 0.0;
};

/// NLopt's algorithms for the dual of the constraints. All converge to the same point; they differ
/// in time and memory.
enum class DualAlgorithm { truncated_newton, lbfgs, variable_metric, ccsa, slsqp };

/// Clock of all time limits. Where the standard library has no clock, as on a microcontroller, the
/// program defines TILT_ROPTER_CLOCK as the name of its own, in all its files: a class with
/// time_point, duration (64 bits, nanoseconds) and now(). One that stands still ends no solve.
#ifdef TILT_ROPTER_CLOCK
using SolverClock = TILT_ROPTER_CLOCK;
#else
using SolverClock = std::chrono::steady_clock;
#endif

/// False if the program defines TILT_ROPTER_WITHOUT_NLOPT, in all its files.
#ifdef TILT_ROPTER_WITHOUT_NLOPT
inline constexpr bool with_nlopt = false;
#else
inline constexpr bool with_nlopt = true;
#endif

/// Method that solves a quadratic program.
enum class ProgramMethod {
  automatic,   ///< NLopt if few constraints are active, else methods that use the structure.
               ///< Without NLopt the same as structured
  nlopt,       ///< NLopt, however many constraints are active: DualMethod
  structured,  ///< without NLopt: ActiveSet and InteriorPoint
};

/// Limits and tolerances of one SQP step.
struct QuadraticProgramSettings {
  ProgramMethod method = ProgramMethod::automatic;  ///< method of the solve
  /// Relative residual below which a program counts as solved, see ProgramResidual.
  double tolerance = 1e-6;
  /// Largest number of active constraints with which the method `automatic` uses NLopt. During the
  /// solve the working set may grow to twice this number, in a real-time iteration to 1.5 times: if
  /// more constraints join, the time spent in NLopt is lost.
  int max_dual_constraints = 16;
  /// Riccati passes in one solve, without the pass of prepare(). With the method `automatic`, the
  /// last one is left to NLopt if few constraints are active, and a long attempt of NLopt before
  /// them counts as passes, up to half of the limit.
  int max_passes = 100;
  DualAlgorithm algorithm = DualAlgorithm::truncated_newton;  ///< of NLopt
};

[[nodiscard]] inline bool operator==(const QuadraticProgramSettings& a,
                                     const QuadraticProgramSettings& b) {
  const auto all = [](const QuadraticProgramSettings& s) {
    return std::tie(s.method, s.tolerance, s.max_dual_constraints, s.max_passes, s.algorithm);
  };
  return all(a) == all(b);
}

inline void validate(const QuadraticProgramSettings& s) {
  require(with_nlopt || s.method != ProgramMethod::nlopt, "QuadraticProgramSettings.method",
          "nlopt", "another: TILT_ROPTER_WITHOUT_NLOPT is defined");
  require_positive("QuadraticProgramSettings.tolerance", s.tolerance);
  require(s.max_dual_constraints >= 0 && s.max_dual_constraints <= 1000,
          "QuadraticProgramSettings.max_dual_constraints", s.max_dual_constraints, "in [0, 1000]");
  require(s.max_passes >= 1, "QuadraticProgramSettings.max_passes", s.max_passes, ">= 1");
}

/// Limits and tolerances. The defaults suit problems whose cost is of order 1 to 10^4.
struct SolverSettings {
  int max_iterations = 200;  ///< of solve()
  double max_time = 1.0;     ///< time limit of solve() [s]
  /// Time limit of feedback() [s]. An iteration that would end later is not started. At most 1000,
  /// or infinite: no limit.
  double max_feedback_time = detail::infinity;
  double tolerance = 1e-6;  ///< on the KKT residual, for solve()
  /// Shortest step length in the line search of solve().
  static constexpr double min_step = 1e-4;
  int memory = 16;  ///< past moves for Anderson acceleration in solve(); 0: none
  /// Bound on the absolute multiplier of an equality.
  static constexpr double max_multiplier = 1e6;
  bool update_multipliers = true;  ///< of equalities, in solve(): equalities hold exactly, not only
                                   ///< by weight. feedback() never updates: noise would accumulate
  QuadraticProgramSettings program;  ///< limits and tolerances of the quadratic programs
};

[[nodiscard]] inline bool operator==(const SolverSettings& a, const SolverSettings& b) {
  const auto all = [](const SolverSettings& s) {
    return std::tie(s.max_iterations, s.max_time, s.max_feedback_time, s.tolerance, s.min_step,
                    s.memory, s.max_multiplier, s.update_multipliers, s.program);
  };
  return all(a) == all(b);
}

inline void validate(const SolverSettings& s) {
  require(s.max_iterations > 0, "SolverSettings.max_iterations", s.max_iterations, "> 0");
  require_positive("SolverSettings.max_time [s]", s.max_time);
  require(s.max_feedback_time > 0.0 &&
              (s.max_feedback_time <= 1000.0 || std::isinf(s.max_feedback_time)),
          "SolverSettings.max_feedback_time [s]", s.max_feedback_time, "in (0, 1000], or infinite");
  require_positive("SolverSettings.tolerance", s.tolerance);
  require(s.memory >= 0 && s.memory <= 100, "SolverSettings.memory", s.memory, "in [0, 100]");
  validate(s.program);
}

}  // namespace tilt_ropter::optimal_control
