// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/optimal_control/solve_report.hpp>

/// What leaves Nmpc, and where it comes from.
namespace tilt_ropter {

/// Where the wrench of an NmpcResult comes from.
enum class NmpcStatus {
  solved,  ///< the wrench comes from a plan made from this measurement: a solved program
  /// The same, but the program was not solved within the limits on time or passes, or gave up a
  /// hard constraint: SolveReport says which. The plan is finite, and the command within the
  /// bounds.
  approximate,
  bad_state,      ///< the measurement was not finite: the last plan goes on
  solver_failed,  ///< no plan from this measurement: the last plan goes on
  no_plan,        ///< no plan, or it has run out: the safe wrench
};

/// True if the wrench comes from a plan made from this measurement.
[[nodiscard]] constexpr bool has_plan(NmpcStatus status) {
  return status == NmpcStatus::solved || status == NmpcStatus::approximate;
}

/// What leaves the controller.
struct NmpcResult {
  NmpcStatus status = NmpcStatus::no_plan;
  Wrench<> wrench;         ///< to apply now, body frame [N; N m]; finite and within the bounds
  Wrench<> rate;           ///< its rate from now on, body frame [N/s; N m/s]: what lagging
                           ///< actuators need to follow it, see Allocation::allocate
  bool on_ground = false;  ///< mode of contact
  SolveReport report;      ///< of the solver; of the last one if it was not called
};

}  // namespace tilt_ropter
