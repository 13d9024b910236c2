// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

/// What FullSpace can be told, and what it reports. Knows no NLopt.
namespace tilt_ropter {

/// How a solve of FullSpace ended.
enum class FullSpaceStatus {
  converged,   ///< NLopt moves nothing any more and the constraints hold, both within tolerance
  limit,       ///< of calls of NLopt or time; the last point is kept
  infeasible,  ///< NLopt moves nothing any more, but constraints are violated
  failed,      ///< a non-finite number, a singular subproblem or no memory; the last base is kept
  rejected,    ///< the initial state is not finite; nothing was changed
};

/// Limits and tolerances of FullSpace.
struct FullSpaceSettings {
  int max_evaluations = 500;  ///< of the cost, in one call of NLopt
  /// Largest step that counts as none, in scaled variables (a step of 1 costs about 1/2), and
  /// largest violation of a constraint that counts as none.
  double tolerance = 1e-9;
  int max_rebases = 20;    ///< calls of NLopt in one solve
  double max_time = 60.0;  ///< of one solve, looked at between evaluations [s]
};

inline void validate(const FullSpaceSettings& s) {
  require(s.max_evaluations > 0, "FullSpaceSettings.max_evaluations", s.max_evaluations, "> 0");
  require_positive("FullSpaceSettings.tolerance", s.tolerance);
  require(s.max_rebases > 0, "FullSpaceSettings.max_rebases", s.max_rebases, "> 0");
  require_positive("FullSpaceSettings.max_time [s]", s.max_time);
}

/// What a solve reports. The figures are those of the returned trajectory, from the problem's plain
/// functions.
struct FullSpaceReport {
  FullSpaceStatus status = FullSpaceStatus::failed;
  double cost = 0.0;
  double max_defect = 0.0;     ///< of continuity, in tangent coordinates
  double max_violation = 0.0;  ///< of rows
  double max_equality = 0.0;   ///< of equalities with a weight, k > 0
  int evaluations = 0;         ///< of the cost
  int rebases = 0;             ///< calls of NLopt
};

}  // namespace tilt_ropter
