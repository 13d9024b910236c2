// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <chrono>
#include <cmath>
#include <limits>
#include <tuple>

/// What the solver can be told. Needs no NLopt, so settings can be made, checked and stored where
/// nothing is solved.
namespace tilt_ropter {

/// NLopt's algorithms that can solve the dual; all reach the same point.
enum class DualAlgorithm { truncated_newton, lbfgs, variable_metric, ccsa, slsqp };

/// The clock of all time limits.
using SolverClock = std::chrono::steady_clock;

/// How the dual of the rows is solved, and how well.
struct DualSettings {
  DualAlgorithm algorithm = DualAlgorithm::truncated_newton;
  int max_evaluations = 40;  ///< of the dual's gradient in one call of NLopt, between Newton steps
  double tolerance = 1e-11;  ///< on the scaled projected gradient of an accepted solution
  double row_tolerance = 1e-9;  ///< violation that makes a constraint join the working set
  int max_rounds = 20;          ///< of adding constraints
};

[[nodiscard]] inline bool operator==(const DualSettings& a, const DualSettings& b) {
  const auto all = [](const DualSettings& s) {
    return std::tie(s.algorithm, s.max_evaluations, s.tolerance, s.row_tolerance, s.max_rounds);
  };
  return all(a) == all(b);
}

inline void validate(const DualSettings& s) {
  require(s.max_evaluations > 0, "DualSettings.max_evaluations", s.max_evaluations, "> 0");
  require_positive("DualSettings.tolerance", s.tolerance);
  require_positive("DualSettings.row_tolerance", s.row_tolerance);
  require(s.max_rounds > 0, "DualSettings.max_rounds", s.max_rounds, "> 0");
}

/// How a quadratic program is solved.
enum class ProgramMethod {
  automatic,       ///< by the dual where few constraints hold, else by Riccati passes
  dual,            ///< by NLopt: DualMethod
  interior_point,  ///< by InteriorPoint as soon as a constraint is violated
};

/// Limits and tolerances of one SQP step.
struct QuadraticProgramSettings {
  ProgramMethod method = ProgramMethod::automatic;
  /// Residual of a solved program (see ProgramResidual), relative.
  double tolerance = 1e-6;
  /// Active constraints up to which the method `automatic` leaves them to NLopt. In solve() up to
  /// twice as many may matter on the way.
  int max_dual_rows = 16;
  int max_passes = 100;  ///< Riccati passes in one solve, besides that of prepare()
  DualSettings dual;
};

[[nodiscard]] inline bool operator==(const QuadraticProgramSettings& a,
                                     const QuadraticProgramSettings& b) {
  const auto all = [](const QuadraticProgramSettings& s) {
    return std::tie(s.method, s.tolerance, s.max_dual_rows, s.max_passes, s.dual);
  };
  return all(a) == all(b);
}

inline void validate(const QuadraticProgramSettings& s) {
  require_positive("QuadraticProgramSettings.tolerance", s.tolerance);
  require(s.max_dual_rows >= 0 && s.max_dual_rows <= 1000, "QuadraticProgramSettings.max_dual_rows",
          s.max_dual_rows, "in [0, 1000]");
  require(s.max_passes >= 1, "QuadraticProgramSettings.max_passes", s.max_passes, ">= 1");
  validate(s.dual);
}

/// Limits and tolerances; the defaults serve problems whose cost is of order 1 to 10^4.
struct SolverSettings {
  int max_iterations = 200;  ///< of solve()
  double max_time = 1.0;     ///< of solve() [s]
  /// Of feedback(); an iteration that would end later is not begun. Finite: at most 1000 [s].
  double max_feedback_time = std::numeric_limits<double>::infinity();
  double tolerance = 1e-6;      ///< on the KKT residual, for solve()
  double min_step = 1e-4;       ///< shortest step that solve()'s line search tries
  int memory = 16;              ///< moves that solve() learns longer or shorter steps from; 0: none
  double max_multiplier = 1e6;  ///< bound on an equality's multiplier
  bool update_multipliers = true;  ///< of equalities, in solve(): conditions met exactly, not only
                                   ///< by weight; feedback() never does, as noise would pile up
  QuadraticProgramSettings program;
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

}  // namespace tilt_ropter
