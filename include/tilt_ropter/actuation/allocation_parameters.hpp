// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <array>
#include <cstddef>
#include <limits>
#include <string>

/// What Allocation can be told, and what it reports.
namespace tilt_ropter {

/// How the commanded wrench was obtained, and whether it is the wanted wrench.
enum class AllocationStatus {
  ok,               ///< the wanted wrench, by the least thrusts
  null_space_used,  ///< the wanted wrench, by other thrusts that are within limits
  turned_over,      ///< the wanted wrench, but an arm has to turn by more than half a turn
  angle_held,  ///< the wanted wrench but for rotors below hold_thrust, at most 2 h lost for each
  range_end_held,  ///< the wanted wrench but for arms that wait at the end of their servo's range
  limited,         ///< out of reach: parts of the wrench were scaled down by priority
  rejected         ///< the wrench is not finite: the command repeats the last one, lost is zero
};

/// True if the command gives the whole wanted wrench.
[[nodiscard]] constexpr bool gives_wrench(AllocationStatus status) noexcept {
  return status == AllocationStatus::ok || status == AllocationStatus::null_space_used ||
         status == AllocationStatus::turned_over;
}

/// Parts of a wrench in the body frame that are scaled down together.
enum class WrenchGroup {
  level,     ///< M_x and M_y, roll and pitch torque
  lift,      ///< F_z
  sideways,  ///< F_x and F_y
  yaw        ///< M_z
};
inline constexpr std::size_t wrench_group_count = 4;

/// What Allocation does beyond the inverse of the matrix.
struct AllocationParameters {
  /// What is kept first of a wrench that is out of reach. The first group keeps the largest
  /// fraction in [0, 1] that can be reached, then the second with the first as it is, and so on.
  /// While a group is maximised, later groups may take any fraction in [0, 1] that helps it. So no
  /// component ever exceeds the wanted one or changes its sign, and a group keeps its direction.
  /// Each group must be named once.
  std::array<WrenchGroup, wrench_group_count> priorities{WrenchGroup::level, WrenchGroup::lift,
                                                         WrenchGroup::sideways, WrenchGroup::yaw};
  /// Angle beyond the end of the servo's range up to which an arm waits at that end, instead of
  /// turning round to the equivalent angle inside [rad]. It is the width of a hysteresis: noise of
  /// less than this turns no arm over. Zero: the arm turns over at once.
  double range_end_margin = 0.1;
  /// Thrust below which a tilt angle, undefined at zero, holds on to its last value [N].
  double hold_thrust = 0.02;
  /// At thrust T below h = max(hold_thrust, min_thrust) an angle approaches its target with the
  /// time constant hold_time (h^2 / T^2 - 1) [s].
  double hold_time = 0.01;
  /// Fraction of the actuators' time constants by which commands run ahead of a moving wrench, so
  /// that first-order lags arrive with it: 1 inverts them, 0 leaves them.
  double lag_compensation = 1.0;
  /// Thrust below which an angle runs ahead by less, falling with the thrust's square: its rate is
  /// mostly noise there, and lags matter little. As a fraction of one rotor's thrust in hover.
  double calm_share = 0.1;
};

/// Throws std::invalid_argument naming the field, its value and what is allowed.
inline void validate(const AllocationParameters& p) {
  std::array<int, wrench_group_count> named{};
  std::string order;
  bool known = true;
  for (const WrenchGroup group : p.priorities) {
    const int index = static_cast<int>(group);
    order += (order.empty() ? "" : ", ") + std::to_string(index);
    known = known && index >= 0 && index < static_cast<int>(wrench_group_count);
    if (known) ++named[static_cast<std::size_t>(index)];
  }
  for (const int count : named) known = known && count == 1;
  require(known, "AllocationParameters.priorities", order,
          "level (0), lift (1), sideways (2) and yaw (3), each once, in any order");
  require_in("AllocationParameters.range_end_margin [rad]", p.range_end_margin, 0.0, 0.5 * pi);
  require_positive("AllocationParameters.hold_thrust [N]", p.hold_thrust);
  require_positive("AllocationParameters.hold_time [s]", p.hold_time);
  require_in("AllocationParameters.lag_compensation", p.lag_compensation, 0.0, 1.0);
  require_positive("AllocationParameters.calm_share", p.calm_share);
}

/// What to command, what wrench it gives, and what of the wanted wrench it does not give: wanted =
/// achieved + lost.
template <int Rotors, typename Scalar = double>
struct AllocationResult {
  AllocationStatus status = AllocationStatus::rejected;
  /// Always finite and within limits. Before the first call: where the actuators are.
  ActuatorState<Rotors, Scalar> command;
  Wrench<Scalar> achieved;
  Wrench<Scalar> lost;
  /// Arms that this command turns by more than half a turn, because the short way leaves the
  /// servo's range. Their thrust points elsewhere until the servo arrives. Counted at any status.
  int turned_over = 0;
  /// Time of the command [s]; by default long ago.
  double time = -std::numeric_limits<double>::infinity();
};

/// Time derivative of an ActuatorState.
template <int Rotors, typename Scalar = double>
struct ActuatorRates {
  Eigen::Matrix<Scalar, Rotors, 1> rotor_acceleration =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [rad/s^2]
  Eigen::Matrix<Scalar, Rotors, 1> tilt_rate =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [rad/s]
};

}  // namespace tilt_ropter
