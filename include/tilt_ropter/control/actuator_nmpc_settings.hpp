// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/actuator_level_settings.hpp>
#include <tilt_ropter/control/ground_contact_settings.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

/// Settings of ActuatorNmpc, and a function that computes settings for any vehicle without tuning.
namespace tilt_ropter {

/// real_time_settings() with a lower limit on passes. A pass takes longer than at the wrench level.
/// In the flights of the example stress_flights, four passes recover as fast as ten. After the
/// failure of an actuator, six are needed: with four, 2 of 320 flights were lost.
[[nodiscard]] inline optimal_control::SolverSettings actuator_real_time_settings() {
  optimal_control::SolverSettings s = real_time_settings();
  s.program.max_passes = 6;
  return s;
}

/// The defaults fly the reference vehicle. actuator_nmpc_settings() computes the settings for other
/// vehicles.
struct ActuatorNmpcSettings {
  /// Weights, bounds, penalties and horizon of the optimal-control problem.
  ActuatorLevelSettings problem;
  /// Limits and tolerances of the solver.
  optimal_control::SolverSettings solver = actuator_real_time_settings();
  double period = 0.01;  ///< period of the loop that calls the controller [s]
  /// Time limit for prepare() and feedback() together [s], as in NmpcSettings. Zero: half the
  /// period. Infinite: no limit.
  double time_limit = 0.0;
  GroundContactSettings ground;  ///< references and thrusts on the ground
  /// Age above which a plan is not followed and the safe command is given [s].
  double max_plan_age = 0.2;
  /// Number of failures in a row after which the next solve starts cold from the measured state.
  int failures_before_reset = 3;
};

inline void validate(const ActuatorNmpcSettings& s) {
  validate(s.problem);
  validate(s.solver);
  validate(s.ground);
  require_positive("ActuatorNmpcSettings.period [s]", s.period);
  require(s.time_limit >= 0.0, "ActuatorNmpcSettings.time_limit [s]", s.time_limit,
          ">= 0, or infinite");
  require_positive("ActuatorNmpcSettings.max_plan_age [s]", s.max_plan_age);
  require(s.failures_before_reset >= 1, "ActuatorNmpcSettings.failures_before_reset",
          s.failures_before_reset, ">= 1");
}

/// Allowed errors for tuning, as AllowedErrors. Thrusts are in units of the thrust of one rotor in
/// hover, so the same numbers fit a vehicle of any size. The defaults give the weights of
/// ActuatorLevelWeights for the reference vehicle.
struct AllowedActuatorErrors {
  Eigen::Vector3d position{0.06455, 0.06455, 0.0559};        ///< world [m]
  Eigen::Vector3d velocity{0.25, 0.25, 0.2236};              ///< world [m/s]
  Eigen::Vector3d orientation{0.1826, 0.1826, 0.1826};       ///< world [rad]
  Eigen::Vector3d angular_velocity{0.3162, 0.3162, 0.3162};  ///< body [rad/s]
  double thrust = 0.7019;                                    ///< of each rotor [thrust in hover]
  double thrust_on_ground = 0.1813;  ///< the same on the ground [thrust in hover]
  double thrust_rate = 1.922;        ///< of each rotor [thrust in hover / s]
  double tilt_rate = 18.26;          ///< of each rotor [rad/s]
};

inline void validate(const AllowedActuatorErrors& e) {
  require_positive("AllowedActuatorErrors.position [m]", e.position);
  require_positive("AllowedActuatorErrors.velocity [m/s]", e.velocity);
  require_positive("AllowedActuatorErrors.orientation [rad]", e.orientation);
  require_positive("AllowedActuatorErrors.angular_velocity [rad/s]", e.angular_velocity);
  require_positive("AllowedActuatorErrors.thrust [thrust in hover]", e.thrust);
  require_positive("AllowedActuatorErrors.thrust_on_ground [thrust in hover]", e.thrust_on_ground);
  require_positive("AllowedActuatorErrors.thrust_rate [thrust in hover / s]", e.thrust_rate);
  require_positive("AllowedActuatorErrors.tilt_rate [rad/s]", e.tilt_rate);
}

/// Returns settings with which a vehicle flies without tuning: weights of one over the square of
/// the allowed error. The settings for the ground are those of nmpc_settings(), except that
/// slow servos raise down_force by half as much. Throws std::invalid_argument if the errors are out
/// of range or the vehicle has no mass or size.
template <int Rotors>
[[nodiscard]] ActuatorNmpcSettings actuator_nmpc_settings(
    const Vehicle<Rotors>& vehicle, const AllowedActuatorErrors& errors = {}) {
  validate(errors);
  const auto weigh = [](double error) { return 1.0 / (error * error); };
  const auto weigh_all = [&](const Eigen::Vector3d& error) {
    return Eigen::Vector3d(weigh(error.x()), weigh(error.y()), weigh(error.z()));
  };
  ActuatorNmpcSettings s;
  s.ground = nmpc_settings(vehicle).ground;
  // The plan respects the speed of the servos: half of the thrust that slow ones add is enough.
  const double with_fast_servos =
      GroundContactSettings().down_force * vehicle.body.mass / tilt_ropter_vehicle().body.mass;
  s.ground.down_force = 0.5 * (with_fast_servos + s.ground.down_force);
  const double hover = vehicle.body.mass * gravity / Rotors;
  ActuatorLevelWeights& w = s.problem.weights;
  w.position = weigh_all(errors.position);
  w.velocity = weigh_all(errors.velocity);
  w.orientation = weigh_all(errors.orientation);
  w.angular_velocity = weigh_all(errors.angular_velocity);
  w.thrust = weigh(hover * errors.thrust);
  w.thrust_on_ground = weigh(hover * errors.thrust_on_ground);
  w.thrust_rate = weigh(hover * errors.thrust_rate);
  w.tilt_rate = weigh(errors.tilt_rate);
  return s;
}

}  // namespace tilt_ropter
