// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <chrono>
#include <cmath>
#include <limits>
#include <tuple>

/// Settings of the solver. This header does not need NLopt, so that programs without a solver can
/// create, check and store settings.
namespace tilt_ropter::optimal_control {

/// NLopt's algorithms for the dual; all converge to the same point.
enum class DualAlgorithm { truncated_newton, lbfgs, variable_metric, ccsa, slsqp };

/// Clock of all time limits.
using SolverClock = std::chrono::steady_clock;

/// Limits and tolerances for the dual of the constraints.
struct DualSettings {
  /// NLopt's algorithm; it changes time and memory, but not the solution.
  DualAlgorithm algorithm = DualAlgorithm::truncated_newton;
  int max_evaluations = 40;  ///< of the dual's gradient in one call of NLopt, between Newton steps
  double tolerance = 1e-11;  ///< on the scaled projected gradient of an accepted solution
  double constraint_tolerance = 1e-9;  ///< violation above which a constraint joins the working set
  int max_rounds = 20;                 ///< rounds in which constraints join the working set
};

[[nodiscard]] inline bool operator==(const DualSettings& a, const DualSettings& b) {
  const auto all = [](const DualSettings& s) {
    return std::tie(s.algorithm, s.max_evaluations, s.tolerance, s.constraint_tolerance,
                    s.max_rounds);
  };
  return all(a) == all(b);
}

inline void validate(const DualSettings& s) {
  require(s.max_evaluations > 0, "DualSettings.max_evaluations", s.max_evaluations, "> 0");
  require_positive("DualSettings.tolerance", s.tolerance);
  require_positive("DualSettings.constraint_tolerance", s.constraint_tolerance);
  require(s.max_rounds > 0, "DualSettings.max_rounds", s.max_rounds, "> 0");
}

/// Method that solves a quadratic program.
enum class ProgramMethod {
  automatic,   ///< NLopt if few constraints are active, else methods that use the structure
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
  int max_passes = 100;  ///< Riccati passes in one solve, without the pass of prepare()
  DualSettings dual;     ///< limits and tolerances of the dual
};

[[nodiscard]] inline bool operator==(const QuadraticProgramSettings& a,
                                     const QuadraticProgramSettings& b) {
  const auto all = [](const QuadraticProgramSettings& s) {
    return std::tie(s.method, s.tolerance, s.max_dual_constraints, s.max_passes, s.dual);
  };
  return all(a) == all(b);
}

inline void validate(const QuadraticProgramSettings& s) {
  require_positive("QuadraticProgramSettings.tolerance", s.tolerance);
  require(s.max_dual_constraints >= 0 && s.max_dual_constraints <= 1000,
          "QuadraticProgramSettings.max_dual_constraints", s.max_dual_constraints, "in [0, 1000]");
  require(s.max_passes >= 1, "QuadraticProgramSettings.max_passes", s.max_passes, ">= 1");
  validate(s.dual);
}

/// Limits and tolerances. The defaults suit problems whose cost is of order 1 to 10^4.
struct SolverSettings {
  int max_iterations = 200;  ///< of solve()
  double max_time = 1.0;     ///< time limit of solve() [s]
  /// Time limit of feedback() [s]. An iteration that would end later is not started. At most 1000,
  /// or infinite: no limit.
  double max_feedback_time = std::numeric_limits<double>::infinity();
  double tolerance = 1e-6;         ///< on the KKT residual, for solve()
  double min_step = 1e-4;          ///< shortest step length in the line search of solve()
  int memory = 16;                 ///< past moves for Anderson acceleration in solve(); 0: none
  double max_multiplier = 1e6;     ///< bound on the absolute multiplier of an equality
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
  require(s.min_step > 0.0 && s.min_step <= 1.0, "SolverSettings.min_step", s.min_step,
          "in (0, 1]");
  require(s.memory >= 0 && s.memory <= 100, "SolverSettings.memory", s.memory, "in [0, 100]");
  require_non_negative("SolverSettings.max_multiplier", s.max_multiplier);
  validate(s.program);
}

}  // namespace tilt_ropter::optimal_control
