// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/actuator_constraints.hpp>
#include <tilt_ropter/control/ground_contact_settings.hpp>
#include <tilt_ropter/control/wheeled_flight_settings.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <limits>

/// Settings of Nmpc, and a function that computes settings for other vehicles than the Tilt-Ropter
/// without tuning: weights from allowed errors by Bryson's rule, bounds from weight and size.
namespace tilt_ropter {

/// WheeledFlightSettings with weights for close tracking. The attitude is damped enough for
/// actuators that are slower and later than the controller assumes. Example: servos and rotors are
/// 1.7 times slower than assumed. With a quarter of this weight on angular velocity, a heavy
/// vehicle then rocks until it tips.
[[nodiscard]] inline WheeledFlightSettings damped_flight_settings() {
  WheeledFlightSettings s;
  s.weights.position = {240.0, 240.0, 320.0};
  s.weights.velocity = {16.0, 16.0, 20.0};
  s.weights.angular_velocity.setConstant(10.0);
  s.weights.ground_thrust = 0.05;  // thrust falls in half a second: saves power
  return s;
}

/// The solver's default settings with a lower limit on passes, for a control loop. A tick whose
/// quadratic program needs more passes reports approximate. The worst initial conditions of the
/// example stress_flights would need up to 30 passes. Flights with 8 passes recover in the same
/// way.
[[nodiscard]] inline optimal_control::SolverSettings real_time_settings() {
  optimal_control::SolverSettings s;
  s.program.max_passes = 10;
  return s;
}

/// The wrench that the cost subtracts from the planned wrench: F_r and M_r.
enum class WrenchReference {
  zero,   ///< none: the cost is on F and M themselves (paper, Eq. mpc_optimization)
  hover,  ///< F_r = (0, 0, m g), on the ground (0, 0, down_force); M_r = 0
  /// The wrench that the reference's acceleration and the estimated external wrench require. It
  /// leaves no offset at rest.
  inverse_dynamics,
};

/// The defaults fly the reference vehicle. nmpc_settings() computes the settings for other
/// vehicles.
struct NmpcSettings {
  /// Weights, bounds, penalties and horizon of the optimal-control problem.
  WheeledFlightSettings problem = damped_flight_settings();
  /// Limits and tolerances of the solver.
  optimal_control::SolverSettings solver = real_time_settings();
  double period = 0.01;  ///< period of the loop that calls the controller [s]
  /// Time limit for prepare() and feedback() together, including cold starts and repeated plans
  /// [s]. Work that would end later is not started, and is left to the next tick. Zero: half the
  /// period. Infinite: no limit.
  double time_limit = 0.0;
  GroundContactSettings ground;  ///< references and thrusts on the ground
  /// Age above which a plan is not followed and the safe wrench is commanded [s].
  double max_plan_age = 0.2;
  /// Number of failures in a row after which the next solve starts cold from the measured state.
  int failures_before_reset = 3;
  WrenchReference wrench_reference = WrenchReference::inverse_dynamics;
  /// True: a plan respects the servo speed and the rotor thrust, see ActuatorConstraints. False: a
  /// plan respects only the boxes of NmpcBounds, as in the paper.
  bool actuator_constraints = true;
  ActuatorConstraintSettings actuators;  ///< limits; no effect without actuator_constraints
};

inline void validate(const NmpcSettings& s) {
  validate(s.problem);
  validate(s.solver);
  validate(s.ground);
  validate(s.actuators);
  require_positive("NmpcSettings.period [s]", s.period);
  require(s.time_limit >= 0.0, "NmpcSettings.time_limit [s]", s.time_limit, ">= 0, or infinite");
  require_positive("NmpcSettings.max_plan_age [s]", s.max_plan_age);
  require(s.failures_before_reset >= 1, "NmpcSettings.failures_before_reset",
          s.failures_before_reset, ">= 1");
}

/// The controller of the paper as printed: its table of bounds, N and interval; the cost on F and M
/// themselves; no constraints of actuators; the indicator function delta by heights over the ground
/// at z = 0; the whole estimated external wrench in the model; references followed as they are.
/// Each departure of the library from it is a field of NmpcSettings. The conditions on the ground
/// are nearly hard: their weights are large. No tick has a limit of passes or time, so that every
/// program is solved.
///
/// The paper prints no weights; these are ours. Its allocation has no lead:
/// AllocationSettings::lag_compensation is 0 there.
[[nodiscard]] inline NmpcSettings paper_nmpc_settings() {
  NmpcSettings s;
  s.problem.intervals = 20;
  s.problem.interval = 0.1;
  s.problem.bounds = paper_bounds();
  s.problem.weights.ground.setConstant(1e6);
  s.problem.weights.ground_thrust = 0.0;
  s.wrench_reference = WrenchReference::zero;
  s.actuator_constraints = false;
  s.ground.planned_height = 0.0;
  s.ground.contact_by_height = true;
  s.ground.model = GroundModel::external_wrench;
  s.ground.settling_speed = 0.0;
  s.solver = {};
  s.time_limit = std::numeric_limits<double>::infinity();
  return s;
}

/// Allowed errors for tuning; each of them costs the same. Half the allowed position error means
/// four times the position weight. Forces are in units of the vehicle's weight m g. Torques are in
/// units of m g times the mean distance of the rotors from the CoM. The same numbers therefore fit
/// a vehicle of any size. The defaults give the reference vehicle's weights of NmpcSettings, to
/// four digits.
struct AllowedErrors {
  Eigen::Vector3d position{0.06455, 0.06455, 0.0559};        ///< world [m]
  Eigen::Vector3d velocity{0.25, 0.25, 0.2236};              ///< world [m/s]
  Eigen::Vector3d orientation{0.1826, 0.1826, 0.1826};       ///< world [rad]
  Eigen::Vector3d angular_velocity{0.3162, 0.3162, 0.3162};  ///< body [rad/s]
  Eigen::Vector3d force{0.4805, 0.4805, 0.4805};             ///< body [m g]
  Eigen::Vector3d torque{0.8939, 0.8939, 0.8939};            ///< body [m g size]
  Eigen::Vector3d force_rate{0.4805, 0.4805, 0.4805};        ///< body [m g / s]
  Eigen::Vector3d torque_rate{0.8939, 0.8939, 0.8939};       ///< body [m g size / s]
};

inline void validate(const AllowedErrors& e) {
  require_positive("AllowedErrors.position [m]", e.position);
  require_positive("AllowedErrors.velocity [m/s]", e.velocity);
  require_positive("AllowedErrors.orientation [rad]", e.orientation);
  require_positive("AllowedErrors.angular_velocity [rad/s]", e.angular_velocity);
  require_positive("AllowedErrors.force [m g]", e.force);
  require_positive("AllowedErrors.torque [m g size]", e.torque);
  require_positive("AllowedErrors.force_rate [m g / s]", e.force_rate);
  require_positive("AllowedErrors.torque_rate [m g size / s]", e.torque_rate);
}

/// Mean distance of the rotors from the CoM, without lost rotors [m].
template <int Rotors>
[[nodiscard]] double size_of(const Vehicle<Rotors>& vehicle) {
  double sum = 0.0;
  int count = 0;
  for (const RotorGeometry& rotor : vehicle.rotors) {
    if (!(rotor.effectiveness > 0.0)) continue;
    sum += rotor.position.norm();
    ++count;
  }
  return count > 0 ? sum / count : 0.0;
}

/// Returns settings with which a vehicle flies without tuning. Weights are one over the square of
/// the allowed error (A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975). Bounds on force
/// and torque and the thrusts on the ground are scaled from the reference vehicle, by weight and by
/// weight times size. With tilting rotors, down_force also increases with slower servos, by up to
/// four times. The function does not check whether the actuators can reach the bounds.
/// ActuatorConstraints limits thrusts and tilt rates, and control_authority() tells the limits of
/// rotors that do not tilt. Throws std::invalid_argument if the errors are out of range or the
/// vehicle has no mass or size.
template <int Rotors>
[[nodiscard]] NmpcSettings nmpc_settings(const Vehicle<Rotors>& vehicle,
                                         const AllowedErrors& errors = {}) {
  validate(errors);
  validate(vehicle.body);
  const double weight = vehicle.body.mass * gravity, lever = weight * size_of(vehicle);
  require_positive("nmpc_settings: weight times mean distance of the rotors [N m]", lever);
  const auto weigh = [](const Eigen::Vector3d& error, double unit) -> Eigen::Vector3d {
    return (unit * error).cwiseAbs2().cwiseInverse();
  };
  NmpcSettings s;
  NmpcWeights& w = s.problem.weights;
  w.position = weigh(errors.position, 1.0);
  w.velocity = weigh(errors.velocity, 1.0);
  w.orientation = weigh(errors.orientation, 1.0);
  w.angular_velocity = weigh(errors.angular_velocity, 1.0);
  w.force = weigh(errors.force, weight);
  w.torque = weigh(errors.torque, lever);
  w.force_rate = weigh(errors.force_rate, weight);
  w.torque_rate = weigh(errors.torque_rate, lever);

  const Vehicle<4> reference = tilt_ropter_vehicle();
  const double by_weight = vehicle.body.mass / reference.body.mass,
               by_lever = lever / (reference.body.mass * gravity * size_of(reference));
  w.ground_thrust /= by_weight * by_weight;
  NmpcBounds& b = s.problem.bounds;
  for (Eigen::Vector3d* force : {&b.force_min, &b.force_max, &b.force_rate}) *force *= by_weight;
  for (Eigen::Vector3d* torque : {&b.torque_min, &b.torque_max, &b.torque_rate})
    *torque *= by_lever;
  // With more thrust, the same change of force along the ground needs a smaller turn of the arm.
  const bool tilts = std::any_of(vehicle.rotors.begin(), vehicle.rotors.end(),
                                 [](const RotorGeometry& rotor) { return rotor.tilts; });
  const double by_servos =
      tilts ? std::clamp(reference.servo.max_rate / vehicle.servo.max_rate, 1.0, 4.0) : 1.0;
  s.ground.down_force *= by_weight * by_servos;
  s.ground.rotor_thrust *= by_weight;
  return s;
}

}  // namespace tilt_ropter
