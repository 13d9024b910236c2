// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/actuator_rows.hpp>
#include <tilt_ropter/control/ground_contact_settings.hpp>
#include <tilt_ropter/control/wheeled_flight_settings.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <algorithm>

/// What Nmpc can be told, and how a vehicle that is not the Tilt-Ropter gets settings that fly it
/// without tuning: weights from allowed errors by Bryson's rule, bounds from weight and size.
namespace tilt_ropter {

/// WheeledFlightSettings with weights that hold the vehicle to its path closely, and damp its
/// attitude enough for one whose actuators are slower and later than the controller knows. With a
/// quarter of this weight on angular velocity, servos and rotors 1.7 times as slow as believed let
/// a heavy vehicle rock until it tips.
[[nodiscard]] inline WheeledFlightSettings damped_flight_settings() {
  WheeledFlightSettings s;
  s.weights.position << 240.0, 240.0, 320.0;
  s.weights.velocity << 16.0, 16.0, 20.0;
  s.weights.angular_velocity.setConstant(10.0);
  return s;
}

/// The solver's own settings with less work at most, for a loop: a tick whose quadratic program
/// takes more passes says approximate. After the worst that the example stress_flights begins with,
/// up to 30 would be needed, and flights with 8 recover the same.
[[nodiscard]] inline SolverSettings real_time_settings() {
  SolverSettings s;
  s.program.max_passes = 10;
  return s;
}

/// The defaults fly the reference vehicle; nmpc_settings() has those for another one.
struct NmpcSettings {
  WheeledFlightSettings problem = damped_flight_settings();
  SolverSettings solver = real_time_settings();
  double period = 0.01;  ///< of the loop that calls the controller [s]
  /// For prepare() and feedback() together, cold starts and plans made anew included; work that
  /// would end later is not begun, and what is left is the next tick's. Zero: half the period.
  /// Infinite: none. In [s].
  double time_limit = 0.0;
  GroundContactSettings ground;
  /// A plan older than this is not followed; the safe wrench is commanded [s].
  double max_plan_age = 0.2;
  /// So many failures in a row, and the next solve starts cold from the measured state.
  int failures_before_reset = 3;
  /// False: F_r = (0, 0, m g) and M_r = 0, as in the paper. True: what the reference's acceleration
  /// and the estimated external wrench ask for, which leaves no offset at rest.
  bool wrench_feedforward = true;
  /// True: a plan keeps to what the servos' speed and the rotors' thrust allow, see ActuatorRows.
  /// False: as in the paper, to the boxes of NmpcBounds alone.
  bool actuator_rows = true;
  ActuatorRowSettings actuators;  ///< no effect without actuator_rows
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

/// The paper's parameters: its table of bounds, N and interval, its reference
/// wrench, and no rows beyond its own.
[[nodiscard]] inline NmpcSettings paper_nmpc_settings() {
  NmpcSettings s;
  s.problem.intervals = 20;
  s.problem.interval = 0.1;
  s.problem.bounds = paper_bounds();
  s.wrench_feedforward = false;
  s.actuator_rows = false;
  return s;
}

/// Errors that are allowed, each as bad as any other: what tuning is done with. An allowed position
/// error of half the size pulls the vehicle in with four times the weight. Forces are in units of
/// the vehicle's weight m g and torques in m g times the mean distance of its rotors from the CoM,
/// so that the same numbers fly a vehicle of any size. Those here are the reference vehicle's
/// weights of NmpcSettings, to four digits.
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

/// Mean distance of the rotors from the CoM [m].
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

/// Settings with which a vehicle flies without tuning. Weights are one over the square of the
/// allowed error (A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975); bounds on force and
/// torque and the thrusts kept on the ground are the reference vehicle's as shares of weight and of
/// weight times size, down_force the more the slower the servos are, up to four times. Whether the
/// actuators give what the bounds allow is not asked: ActuatorRows bounds thrusts and tilt rates,
/// and control_authority() knows what rotors that do not tilt can do. Throws std::invalid_argument
/// for errors out of range, and for a vehicle without mass or size.
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
  NmpcBounds& b = s.problem.bounds;
  for (Eigen::Vector3d* force : {&b.force_min, &b.force_max, &b.force_rate}) *force *= by_weight;
  for (Eigen::Vector3d* torque : {&b.torque_min, &b.torque_max, &b.torque_rate})
    *torque *= by_lever;
  // The same change of force along the ground takes an arm a smaller turn where there is more
  // thrust to turn.
  const bool tilts = std::any_of(vehicle.rotors.begin(), vehicle.rotors.end(),
                                 [](const RotorGeometry& rotor) { return rotor.tilts; });
  const double by_servos =
      tilts ? std::clamp(reference.servo.max_rate / vehicle.servo.max_rate, 1.0, 4.0) : 1.0;
  s.ground.down_force *= by_weight * by_servos;
  s.ground.rotor_thrust *= by_weight;
  return s;
}

}  // namespace tilt_ropter
