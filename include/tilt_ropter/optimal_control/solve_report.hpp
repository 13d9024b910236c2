#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/quadratic_program.hpp>

#include <cmath>
#include <limits>

/// What the solver can be told, and what it tells.
namespace tilt_ropter {

/// How a solve or a real-time iteration ended.
enum class SolveStatus {
  converged,        ///< the KKT residual is below the tolerance
  iterated,         ///< a real-time iteration was done as asked
  iteration_limit,  ///< the last iterate is kept
  time_limit,       ///< the last iterate is kept, feedback()'s is that before it
  stalled,          ///< no step lowers the merit any more; the last iterate is kept
  failed,           ///< a non-finite number or no factorisation; the iterate before it is kept
  rejected,         ///< the initial state is not finite; nothing was changed
};

/// Limits and tolerances; the defaults serve problems whose cost is of order 1 to 10^4.
struct SolverSettings {
  int max_iterations = 200;  ///< of solve()
  double max_time = 1.0;     ///< of solve(), looked at between iterations [s]
  /// Of feedback(), looked at while it finds out which rows hold: most of what it takes when that
  /// is long. Finite: at most 1000 [s].
  double max_feedback_time = std::numeric_limits<double>::infinity();
  double tolerance = 1e-6;      ///< on the KKT residual, for solve()
  double min_step = 1e-4;       ///< shortest step that solve()'s line search tries
  int memory = 16;              ///< moves that solve() learns longer or shorter steps from; 0: none
  double max_multiplier = 1e6;  ///< bound on an equality's multiplier
  bool update_multipliers = true;  ///< of equalities, in solve(): conditions met exactly, not only
                                   ///< by weight; feedback() never does, as noise would pile up
  QuadraticProgramSettings program;
};

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

/// What a solve reports. The KKT residual, violation, defect and cost are those of the iterate that
/// was linearised last: the returned one for solve(), the one before the step for feedback().
struct SolveReport {
  SolveStatus status = SolveStatus::failed;
  double cost = 0.0;
  double kkt = 0.0;            ///< largest of stationarity, defect, violation, complementarity
  double max_defect = 0.0;     ///< of continuity, in tangent coordinates
  double max_violation = 0.0;  ///< of rows
  double max_equality = 0.0;   ///< of equalities with a weight
  int iterations = 0;
  int active_rows = 0;    ///< rows with a multiplier in the last quadratic program
  int given_up_rows = 0;  ///< of these, rows at their penalty: violated on purpose; see given_up()
  int left_out_rows = 0;  ///< violated rows for which max_active_rows had no room
  int rounds = 0;         ///< of the working set in the last quadratic program
  double step = 1.0;      ///< length of the last step, 1 if it was a full one
  double damping = 0.0;   ///< added to the Hessians because they were not positive definite
  double prepare_us = 0.0, feedback_us = 0.0;  ///< wall time of the two phases [us]
  double linearise_us = 0.0, factorise_us = 0.0, rows_us = 0.0;  ///< parts of prepare [us]
};

}  // namespace tilt_ropter
