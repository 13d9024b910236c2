// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <limits>

/// Settings of the paper's optimal-control problem: weights, bounds, penalties, cost of the last
/// node. They do not depend on a solver.
namespace tilt_ropter {

/// Weights of the squared errors, per axis. The cost has no factor 1/2 and no time step.
struct NmpcWeights {
  Eigen::Vector3d force{0.02, 0.02, 0.02};          ///< F - F_r, body [1/N^2]
  Eigen::Vector3d torque{0.2, 0.2, 0.2};            ///< M - M_r, body [1/(N m)^2]
  Eigen::Vector3d position{60.0, 60.0, 80.0};       ///< p - p_r, world [1/m^2]
  Eigen::Vector3d velocity{6.0, 6.0, 8.0};          ///< v - v_r, world [s^2/m^2]
  Eigen::Vector3d orientation{30.0, 30.0, 30.0};    ///< 2 vec(q (x) q_r^-1), world [1/rad^2]
  Eigen::Vector3d angular_velocity{0.6, 0.6, 0.6};  ///< w - w_r, body [s^2/rad^2]
  Eigen::Vector3d force_rate{0.02, 0.02, 0.02};     ///< dF [s^2/N^2]
  Eigen::Vector3d torque_rate{0.2, 0.2, 0.2};       ///< dM [s^2/(N m)^2]
  double terminal = 5.0;  ///< factor on the state weights at the last node, see TerminalCost
  /// Ground conditions v_By [s^2/m^2], w_x [s^2/rad^2], p_z - r [1/m^2].
  Eigen::Vector3d ground{1e3, 1e3, 1e3};
  /// Added to force.z() at nodes on the ground [1/N^2]. The thrust falls after touch-down, and
  /// rises before take-off, with the time constant sqrt(force_rate.z() / (force.z() +
  /// ground_thrust)) [s].
  double ground_thrust = 0.0;
};

/// Bounds on wrench, wrench rate and body rate, all in the body frame. Infinite: no bound.
struct NmpcBounds {
  Eigen::Vector3d force_rate{20.0, 20.0, 40.0};     ///< |dF| <= [N/s]
  Eigen::Vector3d torque_rate{4.0, 4.0, 4.0};       ///< |dM| <= [N m/s]
  Eigen::Vector3d force_min{-6.0, -6.0, 0.0};       ///< F >= [N]
  Eigen::Vector3d force_max{6.0, 6.0, 30.0};        ///< F <= [N]
  Eigen::Vector3d torque_min{-1.5, -1.5, -1.5};     ///< M >= [N m]
  Eigen::Vector3d torque_max{1.5, 1.5, 1.5};        ///< M <= [N m]
  Eigen::Vector3d angular_velocity{4.0, 4.0, 3.0};  ///< |w| <= [rad/s]
};

/// Returns `wrench` cut to the bounds.
[[nodiscard]] inline Wrenchd within(const NmpcBounds& b, const Wrenchd& wrench) noexcept {
  Wrenchd cut;
  for (int i = 0; i < 3; ++i) {
    cut.force(i) = std::clamp(wrench.force(i), b.force_min(i), b.force_max(i));
    cut.torque(i) = std::clamp(wrench.torque(i), b.torque_min(i), b.torque_max(i));
  }
  return cut;
}

/// Returns the wrench rate `rate`, force first [N/s; N m/s], cut to the bounds.
[[nodiscard]] inline Eigen::Matrix<double, 6, 1> within(
    const NmpcBounds& b, const Eigen::Matrix<double, 6, 1>& rate) noexcept {
  Eigen::Matrix<double, 6, 1> cut;
  for (int i = 0; i < 3; ++i) {
    cut(i) = std::clamp(rate(i), -b.force_rate(i), b.force_rate(i));
    cut(3 + i) = std::clamp(rate(3 + i), -b.torque_rate(i), b.torque_rate(i));
  }
  return cut;
}

/// The bounds of the paper's table (paper, Tab. NMPC Parameters). They allow 0.13 m/s^2 sideways
/// without tilting the body, and need 7 s from the thrust at rest to hover.
[[nodiscard]] inline NmpcBounds paper_bounds() {
  NmpcBounds b;
  b.force_rate.setConstant(2.0);
  b.torque_rate.setConstant(2.0);
  b.force_min = {-0.2, -0.2, 0.0};
  b.force_max = {0.2, 0.2, 20.0};
  b.torque_min.setConstant(-20.0);
  b.torque_max.setConstant(20.0);
  b.angular_velocity = {2.0, 2.0, 1.5};
  return b;
}

/// Cost of the last node. It stands for the cost after the horizon.
enum class TerminalCost {
  weights,  ///< the state weights times NmpcWeights.terminal
  /// e' P e, the minimum cost of the error after the horizon near level hover. P solves the
  /// discrete algebraic Riccati equation of the problem linearised there, without bounds. P is
  /// computed for heading zero and turned with the reference's heading. The weights of position,
  /// velocity and orientation must therefore be the same for x and y. The cost is not exact on the
  /// ground or where the reference tilts or accelerates.
  riccati,
};

/// Penalties for violating a constraint by one unit. A constraint whose multiplier would exceed its
/// penalty is relaxed. Infinite: a hard constraint.
struct NmpcPenalties {
  /// Bounds on the wrench rate [s/N, s/(N m)]. They are hard, so the command meets them even if the
  /// plan violates other constraints.
  double rate = std::numeric_limits<double>::infinity();
  double wrench = 1e4;            ///< bounds on the wrench [1/N, 1/(N m)]
  double angular_velocity = 1e4;  ///< for comfort; a measured state may violate them [s/rad]
  double actuators = 1e4;         ///< of ActuatorConstraints, per unit of each constraint
};

/// Settings of the problem, in addition to the model's parameters.
struct WheeledFlightSettings {
  int intervals = 20;     ///< number of intervals N (paper: 20)
  double interval = 0.1;  ///< length of one interval [s] (paper: 0.1)
  NmpcWeights weights;    ///< of the squared errors
  /// Cost of the last node.
  TerminalCost terminal_cost = TerminalCost::weights;
  NmpcBounds bounds;        ///< on wrench, wrench rate and body rate
  NmpcPenalties penalties;  ///< for violating the bounds
};

inline void validate(const NmpcWeights& w) {
  require_non_negative("NmpcWeights.force [1/N^2]", w.force);
  require_non_negative("NmpcWeights.torque [1/(N m)^2]", w.torque);
  require_non_negative("NmpcWeights.position [1/m^2]", w.position);
  require_non_negative("NmpcWeights.velocity [s^2/m^2]", w.velocity);
  require_non_negative("NmpcWeights.orientation [1/rad^2]", w.orientation);
  require_non_negative("NmpcWeights.angular_velocity [s^2/rad^2]", w.angular_velocity);
  require_positive("NmpcWeights.force_rate [s^2/N^2]", w.force_rate);
  require_positive("NmpcWeights.torque_rate [s^2/(N m)^2]", w.torque_rate);
  require_positive("NmpcWeights.terminal", w.terminal);
  require_non_negative("NmpcWeights.ground", w.ground);
  require_non_negative("NmpcWeights.ground_thrust [1/N^2]", w.ground_thrust);
}

inline void validate(const NmpcBounds& b) {
  require_positive_or_infinite("NmpcBounds.force_rate [N/s]", b.force_rate);
  require_positive_or_infinite("NmpcBounds.torque_rate [N m/s]", b.torque_rate);
  require_ordered("NmpcBounds.force [N]", b.force_min, b.force_max);
  require_ordered("NmpcBounds.torque [N m]", b.torque_min, b.torque_max);
  require_positive_or_infinite("NmpcBounds.angular_velocity [rad/s]", b.angular_velocity);
}

inline void validate(const NmpcPenalties& p) {
  const auto require_price = [](const char* field, double price) {
    require(price > 0.0, field, price, "> 0, or infinite");
  };
  require_price("NmpcPenalties.rate [s/N, s/(N m)]", p.rate);
  require_price("NmpcPenalties.wrench [1/N, 1/(N m)]", p.wrench);
  require_price("NmpcPenalties.angular_velocity [s/rad]", p.angular_velocity);
  require_price("NmpcPenalties.actuators", p.actuators);
}

inline void validate(const WheeledFlightSettings& s) {
  require(s.intervals >= 1 && s.intervals <= 1000, "WheeledFlightSettings.intervals", s.intervals,
          "in [1, 1000]");
  require_positive("WheeledFlightSettings.interval [s]", s.interval);
  validate(s.weights);
  if (s.terminal_cost == TerminalCost::riccati) {
    const auto require_round = [](const char* field, const Eigen::Vector3d& weight) {
      require(weight.x() == weight.y(), field, weight,
              "the same for x and y with TerminalCost::riccati, which turns with the heading");
    };
    require_round("NmpcWeights.position [1/m^2]", s.weights.position);
    require_round("NmpcWeights.velocity [s^2/m^2]", s.weights.velocity);
    require_round("NmpcWeights.orientation [1/rad^2]", s.weights.orientation);
  }
  validate(s.bounds);
  validate(s.penalties);
}

}  // namespace tilt_ropter
