// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Core>

#include <limits>

/// Settings of the optimal-control problem at the level of thrusts and tilt angles: weights,
/// bounds, penalties. They do not depend on a solver.
namespace tilt_ropter {

/// Weights of the squared errors. The cost has no factor 1/2 and no time step.
struct ActuatorLevelWeights {
  Eigen::Vector3d position{240.0, 240.0, 320.0};       ///< p - p_r, world [1/m^2]
  Eigen::Vector3d velocity{16.0, 16.0, 20.0};          ///< v - v_r, world [s^2/m^2]
  Eigen::Vector3d orientation{30.0, 30.0, 30.0};       ///< 2 vec(q (x) q_r^-1), world [1/rad^2]
  Eigen::Vector3d angular_velocity{10.0, 10.0, 10.0};  ///< w - w_r, body [s^2/rad^2]
  /// Of the deviation of each rotor's thrust vector (T sin alpha, T cos alpha) from its reference,
  /// which is the smallest thrust that the reference motion needs [1/N^2].
  double thrust = 0.15;
  /// The same from 0.5 s after touch-down on, while the plan ends on the ground, if the vehicle
  /// drives without leaning. There the thrusts are a fifteenth of those in the air and carry
  /// nothing, so every deviation costs power.
  double thrust_on_ground = 2.25;
  double thrust_rate = 0.02;  ///< of each rotor [s^2/N^2]
  double tilt_rate = 0.003;   ///< of each rotor [s^2/rad^2]
  double terminal = 5.0;      ///< factor on the state weights at the last node
  /// Ground conditions v_By [s^2/m^2], w_x [s^2/rad^2], p_z - r [1/m^2].
  Eigen::Vector3d ground{1e3, 1e3, 1e3};
};

/// Bounds in addition to those of the vehicle's actuators. Infinite: no bound.
struct ActuatorLevelBounds {
  Eigen::Vector3d angular_velocity{4.0, 4.0, 3.0};  ///< |w| <= [rad/s]
  /// Upper limit of the planned tilt rate, as a fraction of the servo's max_rate, in (0, 1]. A
  /// command that is held for h seconds and inverts a lag with time constant T needs h / (2 T) more
  /// than the planned rate: 6 % at 100 Hz and 80 ms.
  double tilt_rate_fraction = 0.9;
};

/// Penalties for violating a constraint by one unit. A constraint whose multiplier would exceed its
/// penalty is relaxed. Infinite: a hard constraint. Bounds on the inputs are always hard.
struct ActuatorLevelPenalties {
  double thrust = 1e4;            ///< range of the thrusts [1/N]
  double tilt_angle = 1e4;        ///< range of the tilt angles [1/rad]
  double angular_velocity = 1e4;  ///< for comfort; a measured state may violate them [s/rad]
};

/// Settings of the problem, in addition to the vehicle.
struct ActuatorLevelSettings {
  int intervals = 20;            ///< number of intervals N
  double interval = 0.1;         ///< length of one interval [s]
  ActuatorLevelWeights weights;  ///< of the squared errors
  ActuatorLevelBounds bounds;
  ActuatorLevelPenalties penalties;  ///< for violating the bounds
};

inline void validate(const ActuatorLevelWeights& w) {
  require_non_negative("ActuatorLevelWeights.position [1/m^2]", w.position);
  require_non_negative("ActuatorLevelWeights.velocity [s^2/m^2]", w.velocity);
  require_non_negative("ActuatorLevelWeights.orientation [1/rad^2]", w.orientation);
  require_non_negative("ActuatorLevelWeights.angular_velocity [s^2/rad^2]", w.angular_velocity);
  require_non_negative("ActuatorLevelWeights.thrust [1/N^2]", w.thrust);
  require_non_negative("ActuatorLevelWeights.thrust_on_ground [1/N^2]", w.thrust_on_ground);
  require_positive("ActuatorLevelWeights.thrust_rate [s^2/N^2]", w.thrust_rate);
  require_positive("ActuatorLevelWeights.tilt_rate [s^2/rad^2]", w.tilt_rate);
  require_positive("ActuatorLevelWeights.terminal", w.terminal);
  require_non_negative("ActuatorLevelWeights.ground", w.ground);
}

inline void validate(const ActuatorLevelBounds& b) {
  require_positive_or_infinite("ActuatorLevelBounds.angular_velocity [rad/s]", b.angular_velocity);
  require(b.tilt_rate_fraction > 0.0 && b.tilt_rate_fraction <= 1.0,
          "ActuatorLevelBounds.tilt_rate_fraction", b.tilt_rate_fraction, "in (0, 1]");
}

inline void validate(const ActuatorLevelPenalties& p) {
  const auto require_price = [](const char* field, double price) {
    require(price > 0.0, field, price, "> 0, or infinite");
  };
  require_price("ActuatorLevelPenalties.thrust [1/N]", p.thrust);
  require_price("ActuatorLevelPenalties.tilt_angle [1/rad]", p.tilt_angle);
  require_price("ActuatorLevelPenalties.angular_velocity [s/rad]", p.angular_velocity);
}

inline void validate(const ActuatorLevelSettings& s) {
  require(s.intervals >= 1 && s.intervals <= 1000, "ActuatorLevelSettings.intervals", s.intervals,
          "in [1, 1000]");
  require_positive("ActuatorLevelSettings.interval [s]", s.interval);
  validate(s.weights);
  validate(s.bounds);
  validate(s.penalties);
}

}  // namespace tilt_ropter
