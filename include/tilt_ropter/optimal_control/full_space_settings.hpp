// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

/// Settings and report of FullSpace. This header does not need NLopt.
namespace tilt_ropter::optimal_control {

/// Result of a solve of FullSpace.
enum class FullSpaceStatus {
  converged,   ///< NLopt makes no more steps and the constraints hold, both within tolerance
  limit,       ///< on calls of NLopt or time reached; the last point is kept
  infeasible,  ///< NLopt makes no more steps, but constraints are violated
  failed,      ///< non-finite number, singular subproblem or no memory; the last base is kept
  rejected,    ///< the initial state is not finite; nothing was changed
};

/// Limits and tolerances of FullSpace.
struct FullSpaceSettings {
  int max_evaluations = 500;  ///< evaluations of the cost in one call of NLopt
  /// Largest step that counts as zero, in scaled variables (a step of 1 costs about 1/2). Also the
  /// largest constraint violation that counts as zero.
  double tolerance = 1e-9;
  int max_rebases = 20;    ///< calls of NLopt in one solve
  double max_time = 60.0;  ///< of one solve, checked between evaluations [s]
};

inline void validate(const FullSpaceSettings& s) {
  require(s.max_evaluations > 0, "FullSpaceSettings.max_evaluations", s.max_evaluations, "> 0");
  require_positive("FullSpaceSettings.tolerance", s.tolerance);
  require(s.max_rebases > 0, "FullSpaceSettings.max_rebases", s.max_rebases, "> 0");
  require_positive("FullSpaceSettings.max_time [s]", s.max_time);
}

/// Report of a solve. The values belong to the returned trajectory and come from the problem's
/// functions without scaling.
struct FullSpaceReport {
  FullSpaceStatus status = FullSpaceStatus::failed;  ///< how the solve ended
  double cost = 0.0;                                 ///< sum over all nodes
  double max_defect = 0.0;                           ///< of continuity, in tangent coordinates
  double max_violation = 0.0;                        ///< of constraints
  double max_equality = 0.0;                         ///< of equalities with a weight, k > 0
  int evaluations = 0;                               ///< of the cost
  int rebases = 0;                                   ///< calls of NLopt
};

}  // namespace tilt_ropter::optimal_control
