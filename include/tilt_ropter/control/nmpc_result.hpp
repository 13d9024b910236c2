// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/optimal_control/solve_report.hpp>

/// Output of Nmpc, and the source of the wrench in it.
namespace tilt_ropter {

/// Source of the wrench of an NmpcResult.
enum class NmpcStatus {
  /// The wrench comes from a plan for this measurement, and the program is solved. In the program,
  /// constraints that are not linear, such as the limits of the thrust, are linearised at the last
  /// plan. SolveReport::max_violation tells how much that plan violates them.
  solved,
  /// The wrench comes from a plan for this measurement, but the program reached its limit on time
  /// or passes, or it relaxed a hard constraint. SolveReport tells which. The plan is finite, and
  /// the command is within the bounds.
  approximate,
  bad_state,      ///< the measurement was not finite: the last plan continues
  solver_failed,  ///< no plan from this measurement: the last plan continues
  no_plan,        ///< no plan, or the last plan is too old: the safe wrench
};

/// Returns true if the wrench comes from a plan for this measurement.
[[nodiscard]] constexpr bool has_plan(NmpcStatus status) {
  return status == NmpcStatus::solved || status == NmpcStatus::approximate;
}

/// Output of the controller.
struct NmpcResult {
  NmpcStatus status = NmpcStatus::no_plan;  ///< source of the wrench
  Wrenchd wrench;          ///< to apply now, body frame [N; N m]; finite and within the bounds
  Wrenchd rate;            ///< rate of the wrench from now on, body frame [N/s; N m/s]; actuators
                           ///< with lag need it to follow the wrench, see Allocation::allocate
  bool on_ground = false;  ///< contact mode
  optimal_control::SolveReport report;  ///< of the last call of the solver
};

}  // namespace tilt_ropter
