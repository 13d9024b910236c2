// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <limits>

/// Settings and results of Nmpc and ActuatorNmpc, and functions that compute settings for other
/// vehicles than the Tilt-Ropter without tuning: weights from allowed errors by Bryson's rule,
/// bounds from weight and size.
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

[[nodiscard]] constexpr const char* to_string(NmpcStatus status) noexcept {
  return detail::name_in({"solved", "approximate", "bad_state", "solver_failed", "no_plan"},
                         status);
}

/// Returns true if the wrench comes from a plan for this measurement.
[[nodiscard]] constexpr bool has_plan(NmpcStatus status) {
  return status == NmpcStatus::solved || status == NmpcStatus::approximate;
}

/// Command of the wrench level.
struct WrenchCommand {
  Wrenchd wrench;  ///< to apply now, body frame [N; N m]; finite and within the bounds
  Wrenchd rate;    ///< rate of the wrench from now on, body frame [N/s; N m/s]; actuators with lag
                   ///< need it to follow the wrench, see Allocation::allocate
};

/// Command of the actuator level.
template <int Rotors>
struct ActuatorCommand {
  ActuatorState<Rotors> command;  ///< to send now; finite and within the limits
  /// Thrusts [N] and tilt angles [rad] of the plan at the time of the command, and their rates.
  Eigen::Matrix<double, Rotors, 1> thrust = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                   tilt_angle = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                   thrust_rate = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                   tilt_rate = Eigen::Matrix<double, Rotors, 1>::Zero();
  Wrenchd wrench;  ///< of these thrusts and angles, body frame [N; N m]
};

/// Output of the controller: the command, and how it was obtained.
template <typename Command>
struct ControlResult : Command {
  NmpcStatus status = NmpcStatus::no_plan;  ///< source of the command
  bool on_ground = false;                   ///< contact mode
  optimal_control::SolveReport report;      ///< of the last call of the solver
};
using NmpcResult = ControlResult<WrenchCommand>;  ///< output of Nmpc
/// Output of ActuatorNmpc.
template <int Rotors>
using ActuatorNmpcResult = ControlResult<ActuatorCommand<Rotors>>;

/// How the model of the controller represents the ground.
enum class GroundModel {
  /// The model cannot move in the directions that the ground holds. Of the external wrench, only
  /// ContactEstimate::rolling acts on it.
  held,
  /// The model moves freely, and the whole estimated external wrench acts on it (paper, Sec.
  /// External Wrench Estimation).
  external_wrench,
};

/// Settings for references on the ground, for the descent to the ground, and for the thrust there.
struct GroundContactSettings {
  /// Height above the standing height of the CoM below which a reference counts as on the ground
  /// [m]. It applies to a reference that neither takes off nor lands. For a reference that takes
  /// off or lands, the limit is one millimetre.
  static constexpr double reference_tolerance = 0.03;
  /// Height of the ground for which references were planned [m]. A reference on this ground counts
  /// as on the ground, also where the estimated ground is lower. -infinity: only the estimated
  /// ground counts.
  double planned_height = -std::numeric_limits<double>::infinity();
  /// Selects the condition for the ground constraints. False: the reference is on the ground as
  /// above, and ContactEstimate::on_ground. True: the heights of the reference and of the vehicle
  /// are both within height_tolerance of the standing height (paper, indicator function delta).
  bool contact_by_height = false;
  static constexpr double height_tolerance = 0.005;  ///< used with contact_by_height [m]
  GroundModel model = GroundModel::held;
  /// Descent speed where the reference is on the ground and the vehicle has not touched it yet
  /// [m/s]. Zero: the vehicle follows the reference as it is, as in the paper.
  double settling_speed = 0.10;
  /// Vertical thrust that is commanded on the ground [N]. It keeps the tilt angles defined. While
  /// the vehicle drives beside its reference or turned from it, rotors carry up to half the weight.
  double down_force = 0.75;
  /// Vertical thrust that a rotor keeps on the ground where torques reduce its thrust [N]. See
  /// ReferenceWrench::ground_thrust().
  double rotor_thrust = 0.06;
};

inline void validate(const GroundContactSettings& s) {
  require(s.planned_height < std::numeric_limits<double>::infinity(),
          "GroundContactSettings.planned_height [m]", s.planned_height, "finite, or -infinity");
  require(s.settling_speed == 0.0 || (s.settling_speed >= 0.01 && s.settling_speed <= 10.0),
          "GroundContactSettings.settling_speed [m/s]", s.settling_speed, "0, or in [0.01, 10]");
  require_finite("GroundContactSettings.down_force [N]", s.down_force);
  require_non_negative("GroundContactSettings.rotor_thrust [N]", s.rotor_thrust);
}

/// Weights of the squared errors of the body at both levels of control, per axis. The cost has no
/// factor 1/2 and no time step. The defaults track closely. The attitude is damped enough for
/// actuators that are slower and later than the controller assumes. Example: servos and rotors are
/// 1.7 times slower than assumed. With a quarter of this weight on angular velocity, a heavy
/// vehicle then rocks until it tips.
struct FlightWeights {
  Eigen::Vector3d position{240.0, 240.0, 320.0};       ///< p - p_r, world [1/m^2]
  Eigen::Vector3d velocity{16.0, 16.0, 20.0};          ///< v - v_r, world [s^2/m^2]
  Eigen::Vector3d orientation{30.0, 30.0, 30.0};       ///< 2 vec(q (x) q_r^-1), world [1/rad^2]
  Eigen::Vector3d angular_velocity{10.0, 10.0, 10.0};  ///< w - w_r, body [s^2/rad^2]
  double terminal = 5.0;  ///< factor on the state weights at the last node, see TerminalCost
  /// Ground conditions v_By [s^2/m^2], w_x [s^2/rad^2], p_z - r [1/m^2].
  Eigen::Vector3d ground{1e3, 1e3, 1e3};
};

inline void validate(const FlightWeights& w) {
  require_non_negative("FlightWeights.position [1/m^2]", w.position);
  require_non_negative("FlightWeights.velocity [s^2/m^2]", w.velocity);
  require_non_negative("FlightWeights.orientation [1/rad^2]", w.orientation);
  require_non_negative("FlightWeights.angular_velocity [s^2/rad^2]", w.angular_velocity);
  require_positive("FlightWeights.terminal", w.terminal);
  require_non_negative("FlightWeights.ground", w.ground);
}

/// Weights of the wrench level.
struct NmpcWeights : FlightWeights {
  Eigen::Vector3d force{0.02, 0.02, 0.02};       ///< F - F_r, body [1/N^2]
  Eigen::Vector3d torque{0.2, 0.2, 0.2};         ///< M - M_r, body [1/(N m)^2]
  Eigen::Vector3d force_rate{0.02, 0.02, 0.02};  ///< dF [s^2/N^2]
  Eigen::Vector3d torque_rate{0.2, 0.2, 0.2};    ///< dM [s^2/(N m)^2]
  /// Added to force.z() at nodes on the ground [1/N^2]. The thrust falls after touch-down, and
  /// rises before take-off, with the time constant sqrt(force_rate.z() / (force.z() +
  /// ground_thrust)) [s]. The default, half a second, saves power.
  double ground_thrust = 0.05;
};

inline void validate(const NmpcWeights& w) {
  validate(static_cast<const FlightWeights&>(w));
  require_non_negative("NmpcWeights.force [1/N^2]", w.force);
  require_non_negative("NmpcWeights.torque [1/(N m)^2]", w.torque);
  require_positive("NmpcWeights.force_rate [s^2/N^2]", w.force_rate);
  require_positive("NmpcWeights.torque_rate [s^2/(N m)^2]", w.torque_rate);
  require_non_negative("NmpcWeights.ground_thrust [1/N^2]", w.ground_thrust);
}

/// Weights of the actuator level.
struct ActuatorLevelWeights : FlightWeights {
  /// Of the deviation of each rotor's thrust vector (T sin alpha, T cos alpha) from its reference,
  /// which is the smallest thrust that the reference motion needs [1/N^2].
  double thrust = 0.15;
  /// The same from 0.5 s after touch-down on, while the plan ends on the ground, if the vehicle
  /// drives without leaning. There the thrusts are a fifteenth of those in the air and carry
  /// nothing, so every deviation costs power.
  double thrust_on_ground = 2.25;
  double thrust_rate = 0.02;  ///< of each rotor [s^2/N^2]
  double tilt_rate = 0.003;   ///< of each rotor [s^2/rad^2]
};

inline void validate(const ActuatorLevelWeights& w) {
  validate(static_cast<const FlightWeights&>(w));
  require_non_negative("ActuatorLevelWeights.thrust [1/N^2]", w.thrust);
  require_non_negative("ActuatorLevelWeights.thrust_on_ground [1/N^2]", w.thrust_on_ground);
  require_positive("ActuatorLevelWeights.thrust_rate [s^2/N^2]", w.thrust_rate);
  require_positive("ActuatorLevelWeights.tilt_rate [s^2/rad^2]", w.tilt_rate);
}

/// Bounds at both levels of control; at the actuator level, in addition to those of the vehicle's
/// actuators.
struct FlightBounds {
  Eigen::Vector3d angular_velocity{4.0, 4.0, 3.0};  ///< |w| <=, body frame, or infinite [rad/s]
  /// Upper limit of the planned tilt rate, as a fraction of the servo's max_rate, in (0, 1]. The
  /// rate of the commands to the servo is higher than planned: a command that is held for h seconds
  /// and inverts a lag with time constant T needs an extra h / (2 T), which is 6 % at 100 Hz and
  /// 80 ms.
  double tilt_rate_fraction = 0.9;
};

inline void validate(const FlightBounds& b) {
  require_positive_or_infinite("FlightBounds.angular_velocity [rad/s]", b.angular_velocity);
  require(b.tilt_rate_fraction > 0.0 && b.tilt_rate_fraction <= 1.0,
          "FlightBounds.tilt_rate_fraction", b.tilt_rate_fraction, "in (0, 1]");
}

/// Bounds of the wrench level, all in the body frame. Infinite: no bound. `tilt_rate_fraction` has
/// no effect without NmpcSettings::actuator_constraints. It is lower here, because with
/// AllocationSettings.calm_fraction the lead of a command grows while the thrust grows: about 10 %.
struct NmpcBounds : FlightBounds {
  Eigen::Vector3d force_rate{20.0, 20.0, 40.0};  ///< |dF| <= [N/s]
  Eigen::Vector3d torque_rate{4.0, 4.0, 4.0};    ///< |dM| <= [N m/s]
  Eigen::Vector3d force_min{-6.0, -6.0, 0.0};    ///< F >= [N]
  Eigen::Vector3d force_max{6.0, 6.0, 30.0};     ///< F <= [N]
  Eigen::Vector3d torque_min{-1.5, -1.5, -1.5};  ///< M >= [N m]
  Eigen::Vector3d torque_max{1.5, 1.5, 1.5};     ///< M <= [N m]

  NmpcBounds() { tilt_rate_fraction = 0.85; }
};

inline void validate(const NmpcBounds& b) {
  validate(static_cast<const FlightBounds&>(b));
  require_positive_or_infinite("NmpcBounds.force_rate [N/s]", b.force_rate);
  require_positive_or_infinite("NmpcBounds.torque_rate [N m/s]", b.torque_rate);
  require_ordered("NmpcBounds.force [N]", b.force_min, b.force_max);
  require_ordered("NmpcBounds.torque [N m]", b.torque_min, b.torque_max);
}

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

/// Settings of the optimal-control problem of one level, in addition to the vehicle.
template <typename Weights, typename Bounds>
struct HorizonSettings {
  int intervals = 20;     ///< number of intervals N (paper: 20)
  double interval = 0.1;  ///< length of one interval [s] (paper: 0.1)
  Weights weights;        ///< of the squared errors
  Bounds bounds;
};

template <typename Weights, typename Bounds>
void validate(const HorizonSettings<Weights, Bounds>& s) {
  require(s.intervals >= 1 && s.intervals <= 1000, "HorizonSettings.intervals", s.intervals,
          "in [1, 1000]");
  require_positive("HorizonSettings.interval [s]", s.interval);
  validate(s.weights);
  validate(s.bounds);
}

/// Settings of the problem of the wrench level.
struct WheeledFlightSettings : HorizonSettings<NmpcWeights, NmpcBounds> {
  TerminalCost terminal_cost = TerminalCost::weights;  ///< cost of the last node
  /// Limit on passes in a control loop. The worst initial conditions of the example stress_flights
  /// would need up to 30 passes. Flights with 8 passes recover in the same way.
  static constexpr int max_passes = 10;
};

inline void validate(const WheeledFlightSettings& s) {
  validate(static_cast<const HorizonSettings<NmpcWeights, NmpcBounds>&>(s));
  if (s.terminal_cost != TerminalCost::riccati) return;
  const auto require_round = [](const char* field, const Eigen::Vector3d& weight) {
    require(weight.x() == weight.y(), field, weight,
            "the same for x and y with TerminalCost::riccati, which turns with the heading");
  };
  require_round("FlightWeights.position [1/m^2]", s.weights.position);
  require_round("FlightWeights.velocity [s^2/m^2]", s.weights.velocity);
  require_round("FlightWeights.orientation [1/rad^2]", s.weights.orientation);
}

/// Settings of the problem of the actuator level.
struct ActuatorLevelSettings : HorizonSettings<ActuatorLevelWeights, FlightBounds> {
  /// Limit on passes in a control loop. A pass takes longer than at the wrench level. In the
  /// flights of the example stress_flights, four passes recover as fast as ten. After the failure
  /// of an actuator, six are needed: with four, 2 of 320 flights were lost.
  static constexpr int max_passes = 6;
};

/// Settings of both levels of control. `Problem` is WheeledFlightSettings or ActuatorLevelSettings.
template <typename Problem>
struct ControllerSettings {
  /// Weights, bounds and horizon of the optimal-control problem.
  Problem problem;
  /// Limits and tolerances of the solver, with a lower limit on passes than its default. A tick
  /// whose quadratic program needs more passes reports approximate.
  optimal_control::SolverSettings solver;
  double period = 0.01;  ///< period of the loop that calls the controller [s]
  /// Time limit for prepare() and feedback() together, including cold starts and repeated plans
  /// [s]. Work that would end later is not started, and is left to the next tick. Zero: half the
  /// period. Infinite: no limit.
  double time_limit = 0.0;
  GroundContactSettings ground;  ///< references and thrusts on the ground
  /// Age above which a plan is not followed and the safe command is given [s].
  double max_plan_age = 0.2;
  /// Number of failures in a row after which the next solve starts cold from the measured state.
  int failures_before_reset = 3;

  ControllerSettings() { solver.program.max_passes = Problem::max_passes; }
};

template <typename Problem>
void validate(const ControllerSettings<Problem>& s) {
  validate(s.problem);
  validate(s.solver);
  validate(s.ground);
  require_positive("ControllerSettings.period [s]", s.period);
  require(s.time_limit >= 0.0, "ControllerSettings.time_limit [s]", s.time_limit,
          ">= 0, or infinite");
  require_positive("ControllerSettings.max_plan_age [s]", s.max_plan_age);
  require(s.failures_before_reset >= 1, "ControllerSettings.failures_before_reset",
          s.failures_before_reset, ">= 1");
}

/// The wrench that the cost subtracts from the planned wrench: F_r and M_r.
enum class WrenchReference {
  zero,   ///< none: the cost is on F and M themselves (paper, Eq. mpc_optimization)
  hover,  ///< F_r = (0, 0, m g), on the ground (0, 0, down_force); M_r = 0
  /// The wrench that the reference's acceleration and the estimated external wrench require. It
  /// leaves no offset at rest.
  inverse_dynamics,
};

/// Settings of Nmpc. The defaults fly the reference vehicle. nmpc_settings() computes the settings
/// for other vehicles.
struct NmpcSettings : ControllerSettings<WheeledFlightSettings> {
  WrenchReference wrench_reference = WrenchReference::inverse_dynamics;
  /// True: a plan respects the servo speed and the rotor thrust, see ActuatorConstraints. False: a
  /// plan respects only the boxes of NmpcBounds, as in the paper.
  bool actuator_constraints = true;
};

/// Settings of ActuatorNmpc. The defaults fly the reference vehicle. actuator_nmpc_settings()
/// computes the settings for other vehicles.
using ActuatorNmpcSettings = ControllerSettings<ActuatorLevelSettings>;

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
/// units of m g times the mean distance of the rotors from the CoM. Thrusts are in units of the
/// thrust of one rotor in hover. The same numbers therefore fit a vehicle of any size. The defaults
/// give the weights of NmpcSettings and ActuatorNmpcSettings for the reference vehicle, to four
/// digits.
struct AllowedErrors {
  Eigen::Vector3d position{0.06455, 0.06455, 0.0559};        ///< world [m]
  Eigen::Vector3d velocity{0.25, 0.25, 0.2236};              ///< world [m/s]
  Eigen::Vector3d orientation{0.1826, 0.1826, 0.1826};       ///< world [rad]
  Eigen::Vector3d angular_velocity{0.3162, 0.3162, 0.3162};  ///< body [rad/s]
  // Of the wrench level:
  Eigen::Vector3d force{0.4805, 0.4805, 0.4805};        ///< body [m g]
  Eigen::Vector3d torque{0.8939, 0.8939, 0.8939};       ///< body [m g size]
  Eigen::Vector3d force_rate{0.4805, 0.4805, 0.4805};   ///< body [m g / s]
  Eigen::Vector3d torque_rate{0.8939, 0.8939, 0.8939};  ///< body [m g size / s]
  // Of the actuator level:
  double thrust = 0.7019;            ///< of each rotor [thrust in hover]
  double thrust_on_ground = 0.1813;  ///< the same on the ground [thrust in hover]
  double thrust_rate = 1.922;        ///< of each rotor [thrust in hover / s]
  double tilt_rate = 18.26;          ///< of each rotor [rad/s]
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
  require_positive("AllowedErrors.thrust [thrust in hover]", e.thrust);
  require_positive("AllowedErrors.thrust_on_ground [thrust in hover]", e.thrust_on_ground);
  require_positive("AllowedErrors.thrust_rate [thrust in hover / s]", e.thrust_rate);
  require_positive("AllowedErrors.tilt_rate [rad/s]", e.tilt_rate);
}

namespace detail {

/// Weight of an allowed error in units of `unit`: one over its square.
[[nodiscard]] inline double weigh(double error, double unit = 1.0) {
  return 1.0 / ((unit * error) * (unit * error));
}
[[nodiscard]] inline Eigen::Vector3d weigh(const Eigen::Vector3d& error, double unit = 1.0) {
  return {weigh(error.x(), unit), weigh(error.y(), unit), weigh(error.z(), unit)};
}

inline void set_weights(const AllowedErrors& errors, FlightWeights& w) {
  w.position = weigh(errors.position);
  w.velocity = weigh(errors.velocity);
  w.orientation = weigh(errors.orientation);
  w.angular_velocity = weigh(errors.angular_velocity);
}

}  // namespace detail

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
  NmpcSettings s;
  NmpcWeights& w = s.problem.weights;
  detail::set_weights(errors, w);
  w.force = detail::weigh(errors.force, weight);
  w.torque = detail::weigh(errors.torque, lever);
  w.force_rate = detail::weigh(errors.force_rate, weight);
  w.torque_rate = detail::weigh(errors.torque_rate, lever);

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

/// The same for ActuatorNmpc. The settings for the ground are those of nmpc_settings(), except that
/// slow servos raise down_force by half as much.
template <int Rotors>
[[nodiscard]] ActuatorNmpcSettings actuator_nmpc_settings(const Vehicle<Rotors>& vehicle,
                                                          const AllowedErrors& errors = {}) {
  ActuatorNmpcSettings s;
  s.ground = nmpc_settings(vehicle, errors).ground;
  // The plan respects the speed of the servos: half of the thrust that slow ones add is enough.
  const double with_fast_servos =
      GroundContactSettings().down_force * vehicle.body.mass / tilt_ropter_vehicle().body.mass;
  s.ground.down_force = 0.5 * (with_fast_servos + s.ground.down_force);
  const double hover = vehicle.body.mass * gravity / Rotors;
  ActuatorLevelWeights& w = s.problem.weights;
  detail::set_weights(errors, w);
  w.thrust = detail::weigh(errors.thrust, hover);
  w.thrust_on_ground = detail::weigh(errors.thrust_on_ground, hover);
  w.thrust_rate = detail::weigh(errors.thrust_rate, hover);
  w.tilt_rate = detail::weigh(errors.tilt_rate);
  return s;
}

}  // namespace tilt_ropter
