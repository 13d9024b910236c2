// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <array>
#include <limits>
#include <string>

/// Settings and results of Allocation.
namespace tilt_ropter {

/// How Allocation obtained the command, and whether the command gives the wanted wrench.
enum class AllocationStatus {
  ok,               ///< the wanted wrench, from the minimum-norm thrusts
  null_space_used,  ///< the wanted wrench, from other thrusts that are within limits
  turned_over,      ///< the wanted wrench, but an arm must turn by more than half a turn
  /// The wanted wrench, except for the thrust of rotors below h = max(hold_thrust, min_thrust).
  /// Each of these rotors loses at most 2 h.
  angle_held,
  /// The wanted wrench, except for arms that wait at the end of their servo's range.
  range_end_held,
  limited,  ///< out of reach: parts of the wrench are scaled down by priority
  /// The wrench is not finite: the command repeats the last command, and `lost` is zero.
  rejected
};

[[nodiscard]] constexpr const char* to_string(AllocationStatus status) noexcept {
  return detail::name_in({"ok", "null_space_used", "turned_over", "angle_held", "range_end_held",
                          "limited", "rejected"},
                         status);
}

/// Returns true if the command gives the whole wanted wrench.
[[nodiscard]] constexpr bool gives_wrench(AllocationStatus status) noexcept {
  return status == AllocationStatus::ok || status == AllocationStatus::null_space_used ||
         status == AllocationStatus::turned_over;
}

/// Groups of wrench components (body frame), which are scaled down together.
enum class WrenchGroup {
  level,     ///< M_x and M_y, roll and pitch torque
  lift,      ///< F_z
  sideways,  ///< F_x and F_y
  yaw        ///< M_z
};
inline constexpr int wrench_group_count = 4;

/// Settings of the steps by which Allocation goes beyond the inverse of the matrix.
struct AllocationSettings {
  /// Order in which the groups of an unreachable wrench are kept. The first group keeps the largest
  /// reachable fraction in [0, 1]. Then the second group is maximised with the first group fixed,
  /// and so on. While a group is maximised, later groups may take any fraction in [0, 1] that helps
  /// this group. No component therefore exceeds the wanted component or changes its sign, and each
  /// group keeps its direction. Name each group exactly once.
  std::array<WrenchGroup, wrench_group_count> priorities{WrenchGroup::level, WrenchGroup::lift,
                                                         WrenchGroup::sideways, WrenchGroup::yaw};
  /// Hysteresis at the ends of the servo's range [rad]. An arm waits at the end of the range while
  /// its target is less than this angle beyond the end. Otherwise the arm turns round to the
  /// equivalent angle inside the range. Noise below this value turns no arm over.
  static constexpr double range_end_margin = 0.1;
  /// Thrust below which a tilt angle lags behind its target, see hold_time [N]. The angle is
  /// undefined at zero thrust and keeps its last value there.
  double hold_thrust = 0.02;
  /// At a thrust T below h = max(hold_thrust, min_thrust) the angle approaches its target with the
  /// time constant hold_time (h^2 / T^2 - 1) [s].
  static constexpr double hold_time = 0.01;
  /// Fraction of the actuators' time constants by which commands lead a moving wrench. The lead
  /// compensates the first-order lags: 1 inverts the lags, 0 leaves them.
  double lag_compensation = 1.0;
  /// Thrust below which the lead of a tilt angle is reduced, as a fraction of one rotor's thrust in
  /// hover. The lead falls with the square of the thrust. At small thrust the rate of the angle is
  /// mostly noise, and the lag matters little.
  static constexpr double calm_fraction = 0.1;
};

inline void validate(const AllocationSettings& p) {
  std::array<int, wrench_group_count> named{};
  std::string order;
  bool known = true;
  for (const WrenchGroup group : p.priorities) {
    const int index = static_cast<int>(group);
    order += (order.empty() ? "" : ", ") + std::to_string(index);
    known = known && index >= 0 && index < wrench_group_count;
    if (known) ++named[detail::size(index)];
  }
  for (const int count : named) known = known && count == 1;
  require(known, "AllocationSettings.priorities", order,
          "level (0), lift (1), sideways (2) and yaw (3), each once, in any order");
  require_positive("AllocationSettings.hold_thrust [N]", p.hold_thrust);
  require_in("AllocationSettings.lag_compensation", p.lag_compensation, 0.0, 1.0);
}

/// Command, the wrench that the command gives, and the part of the wanted wrench that the command
/// does not give: wanted = achieved + lost.
template <int Rotors, typename Scalar = double>
struct AllocationResult {
  AllocationStatus status = AllocationStatus::rejected;
  /// Always finite and within limits. Before the first call, set it to the state of the actuators.
  ActuatorState<Rotors, Scalar> command;
  Wrench<Scalar> achieved;
  Wrench<Scalar> lost;
  /// Number of arms that this command turns by more than half a turn, at every status. Their thrust
  /// has a wrong direction until the servo arrives.
  int turned_over = 0;
  /// Time of the command [s]. The default means that the command is infinitely old.
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
