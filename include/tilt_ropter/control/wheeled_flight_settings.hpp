// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Core>

#include <limits>

/// The settings of the paper's optimal-control problem: weights, bounds, prices of violation, the
/// cost of the last node. They know no solver.
namespace tilt_ropter {

/// Weights of the squared errors, per axis; the cost has no 1/2 and no time step in it.
struct NmpcWeights {
  Eigen::Vector3d force{0.02, 0.02, 0.02};          ///< F - F_r, body [1/N^2]
  Eigen::Vector3d torque{0.2, 0.2, 0.2};            ///< M - M_r, body [1/(N m)^2]
  Eigen::Vector3d position{60.0, 60.0, 80.0};       ///< world [1/m^2]
  Eigen::Vector3d velocity{6.0, 6.0, 8.0};          ///< world [s^2/m^2]
  Eigen::Vector3d orientation{30.0, 30.0, 30.0};    ///< 2 vec(q (x) q_r^-1), world [1/rad^2]
  Eigen::Vector3d angular_velocity{0.6, 0.6, 0.6};  ///< body [s^2/rad^2]
  Eigen::Vector3d force_rate{0.02, 0.02, 0.02};     ///< dF [s^2/N^2]
  Eigen::Vector3d torque_rate{0.2, 0.2, 0.2};       ///< dM [s^2/(N m)^2]
  double terminal = 5.0;  ///< factor on the state's weights at the end, see TerminalCost
  Eigen::Vector3d ground{1e3, 1e3, 1e3};  ///< v_By [s^2/m^2], w_x [s^2/rad^2], p_z - r [1/m^2]
};

/// Bounds on wrench, wrench rate and body rate, all in the body frame. Infinite means none.
struct NmpcBounds {
  Eigen::Vector3d force_rate{20.0, 20.0, 40.0};     ///< |dF| <= [N/s]
  Eigen::Vector3d torque_rate{4.0, 4.0, 4.0};       ///< |dM| <= [N m/s]
  Eigen::Vector3d force_min{-6.0, -6.0, 0.0};       ///< [N]
  Eigen::Vector3d force_max{6.0, 6.0, 30.0};        ///< [N]
  Eigen::Vector3d torque_min{-1.5, -1.5, -1.5};     ///< [N m]
  Eigen::Vector3d torque_max{1.5, 1.5, 1.5};        ///< [N m]
  Eigen::Vector3d angular_velocity{4.0, 4.0, 3.0};  ///< |w| <= [rad/s]
};

/// The bounds of the paper's table (paper, Tab. NMPC Parameters). They
/// allow 0.13 m/s^2 sideways without leaning and need 7 s from rest thrust to hover.
[[nodiscard]] inline NmpcBounds paper_bounds() {
  NmpcBounds b;
  b.force_rate.setConstant(2.0);
  b.torque_rate.setConstant(2.0);
  b.force_min << -0.2, -0.2, 0.0;
  b.force_max << 0.2, 0.2, 20.0;
  b.torque_min.setConstant(-20.0);
  b.torque_max.setConstant(20.0);
  b.angular_velocity << 2.0, 2.0, 1.5;
  return b;
}

/// What the last node costs, which stands for all that comes after the horizon.
enum class TerminalCost {
  weights,  ///< the state's weights times NmpcWeights.terminal
  /// e' P e, the least that the error can cost from there on near level hover: P solves the
  /// discrete Riccati equation of the problem linearised there, bounds left out. P is that of
  /// heading zero and turns with the reference's heading, so the weights of position, velocity and
  /// orientation have to be the same for x and y. It is not exact where the reference leans or
  /// accelerates, nor on the ground.
  riccati,
};

/// Prices of violating a constraint by one unit: one whose multiplier would have to be larger is
/// given up. Infinite: a hard constraint.
struct NmpcPenalties {
  /// Bounds on the wrench's rate: hard, and so met by what is commanded whatever else becomes of a
  /// plan [s/N, s/(N m)].
  double rate = std::numeric_limits<double>::infinity();
  double wrench = 1e4;            ///< [1/N, 1/(N m)]
  double angular_velocity = 1e4;  ///< for comfort; the state measured may be beyond [s/rad]
  double actuators = 1e4;         ///< of the rows of ActuatorRows, by their units
};

/// What the problem needs beyond the model.
struct WheeledFlightSettings {
  int intervals = 20;     ///< N (paper: 20)
  double interval = 0.1;  ///< length of one [s] (paper: 0.1)
  NmpcWeights weights;
  TerminalCost terminal_cost = TerminalCost::weights;
  NmpcBounds bounds;
  NmpcPenalties penalties;
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
