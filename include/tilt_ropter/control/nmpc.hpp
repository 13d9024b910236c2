// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/detail/thrust_inverse.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/control/detail/actuator_constraints.hpp>
#include <tilt_ropter/control/detail/actuator_level_problem.hpp>
#include <tilt_ropter/control/detail/actuator_plan.hpp>
#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/detail/plan_in_force.hpp>
#include <tilt_ropter/control/detail/receding_horizon.hpp>
#include <tilt_ropter/control/detail/reference_wrench.hpp>
#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/reference.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

/// The Tilt-Ropter's controller (paper, Sec. Control). Nmpc computes the wrench that tracks a
/// reference in the air and on the ground, with one real-time iteration per call. ActuatorNmpc
/// plans at the level of thrusts and tilt angles, for any vehicle that can hover or drive: tilting
/// or fixed rotors, any rank of the allocation matrix. It needs no allocation.
namespace tilt_ropter {

/// Call prepare(), measure, then call feedback(), at any rate. Faults have the same effects as in
/// Nmpc; instead of the safe wrench, thrusts and angles that give this wrench are commanded.
///
/// The commands invert the first-order lags of rotors and servos: after one period with the
/// command, each speed and angle is where the plan has it. A servo with dead time receives the
/// command for the time at which it begins to act.
///
/// A vehicle that cannot give every force without leaning, such as a quadrotor with fixed rotors,
/// leans as the reference's acceleration and the external force require. The heading of the
/// reference stays.
template <int Rotors>
class ActuatorNmpc
    : detail::RecedingHorizon<ActuatorNmpc<Rotors>,
                              optimal_control::MultipleShooting<ActuatorLevelProblem<Rotors>>,
                              ActuatorPlan<Rotors>, ActuatorNmpcResult<Rotors>> {
  using Solver = optimal_control::MultipleShooting<ActuatorLevelProblem<Rotors>>;
  using Base = detail::RecedingHorizon<ActuatorNmpc, Solver, ActuatorPlan<Rotors>,
                                       ActuatorNmpcResult<Rotors>>;
  friend Base;
  using Base::body_state_, Base::contact_, Base::ground_, Base::plan_, Base::points_,
      Base::prepare_time_, Base::prepared_, Base::result_, Base::solver_;

 public:
  using Problem = ActuatorLevelProblem<Rotors>;
  using Result = ActuatorNmpcResult<Rotors>;

  /// Throws std::invalid_argument if parameters or settings are out of range. Allocates. The
  /// functions for the loop below allocate only inside NLopt and never throw. If an actuator fails
  /// in flight, construct a new controller for the remaining vehicle, see with_stuck_servo() and
  /// with_weak_rotor().
  ActuatorNmpc(const Vehicle<Rotors>& vehicle, const ActuatorNmpcSettings& settings);

  /// Uses the settings that fly this vehicle without tuning.
  explicit ActuatorNmpc(const Vehicle<Rotors>& vehicle);

  /// Changes the settings between two ticks, without a cold start. Only `solver` and the number and
  /// length of the intervals must stay the same. The next prepare() uses the new settings. Does not
  /// allocate. Throws std::invalid_argument, and changes nothing, if the settings are out of range.
  void set_settings(const ActuatorNmpcSettings& settings);

  /// The same as Nmpc::prepare().
  template <typename Reference>
  [[nodiscard]] optimal_control::PrepareStatus prepare(double time, const Reference& reference,
                                                       const ContactEstimate& contact) noexcept {
    const auto start = optimal_control::SolverClock::now();
    begin_to_prepare(time, contact);
    if (!std::isfinite(time)) return optimal_control::PrepareStatus::rejected;
    for (std::size_t k = 0; k < points_.size(); ++k)
      points_[k] = reference(time + settings_.problem.interval * static_cast<double>(k));
    const optimal_control::PrepareStatus status = finish_preparing(time);
    prepare_time_ = optimal_control::SolverClock::now() - start;
    return status;
  }

  /// Returns the command for the body state and the actuators measured or modelled at `time` [s].
  /// Take both the speeds and the angles from ActuatorModel, unless the speed sensors have little
  /// noise: an inverted lag amplifies it. Needs a prepare() before.
  [[nodiscard]] const Result& feedback(double time, const BodyStated& measured,
                                       const ActuatorState<Rotors>& actuators) noexcept;

  /// Replaces feedback() if there is no valid state at `time` [s].
  [[nodiscard]] const Result& hold(double time) noexcept;

  /// Sets the measured `voltage` of the battery [V]. From the next prepare() on, plans respect the
  /// thrusts that this voltage allows. Returns true if voltage_ratio() accepts the voltage; if not,
  /// nothing changes.
  bool set_voltage(double voltage) noexcept;

  /// Returns the speeds and angles of the smallest thrusts for `wrench` (body frame), as far as the
  /// rotors can give it. For the start in flight, for example.
  [[nodiscard]] ActuatorState<Rotors> command_for(const Wrenchd& wrench) const noexcept;

  [[nodiscard]] const Result& result() const { return result_; }  ///< of the last call
  /// The estimate that the plan uses: from prepare(), or an earlier one if that was not plausible.
  [[nodiscard]] const ContactEstimate& contact() const { return contact_; }
  [[nodiscard]] const Solver& solver() const { return solver_; }
  [[nodiscard]] const ActuatorNmpcSettings& settings() const { return settings_; }

 private:
  using State = ActuatedState<Rotors>;
  using Node = ActuatorLevelNode<Rotors>;

  // The parts of prepare() before and after the reference is evaluated.
  void begin_to_prepare(double time, const ContactEstimate& contact);
  optimal_control::PrepareStatus finish_preparing(double time);

  // For RecedingHorizon:
  void set_nodes();
  [[nodiscard]] State initial_state(double time) const;
  void set_guess(double time, State& first) const;
  [[nodiscard]] bool is_credible(const State& x) const;
  void set_command(double age);
  void set_old_command(double time) { set_command(plan_.age(time)); }
  void set_safe_command();

  // Turns the attitude so that the force that `point` needs can be given without a torque.
  void lean(ReferencePoint& point, const Wrenchd& external) const;
  // True if the vehicle can push forward without leaning.
  [[nodiscard]] bool pushes() const { return inverse_.steady_forces()(0, 0) > 0.5; }
  // Pitches a vehicle on one axle that cannot push forward: the thrust is more than eight times the
  // forward force, so the pitch stays below 7.2 degrees.
  void lean_on_wheels(Node& node, Wrenchd& wrench) const;
  // Sets the side force of the wheels of a vehicle that cannot push along its axle: it follows the
  // heading, and it can only steer. The model of a vehicle that can push has the force of the
  // reference's turn alone, see GroundContact; with this force it would steer instead of pushing.
  void steer(Node& node) const;
  void set_actuator_command(const State& x, const typename Problem::Input& rates);
  // Thrusts and angles of the smallest thrusts.
  [[nodiscard]] State actuators_for(const Wrenchd& wrench) const noexcept;
  [[nodiscard]] ActuatorState<Rotors> command_for(
      const State& x, const typename Problem::Input& rates) const noexcept;

  struct RotorLimits {
    RotorParameters parameters;
    double effectiveness = 1.0, min_speed = 0.0, max_speed = 0.0;
    bool tilts = true;
  };

  ActuatorNmpcSettings settings_;
  Vehicle<Rotors> vehicle_;
  std::optional<Undercarriage> undercarriage_;
  ThrustInverse<Rotors> inverse_;
  ReferenceWrench<Rotors> reference_wrench_;
  std::array<RotorLimits, static_cast<std::size_t>(Rotors)> rotors_;
  ActuatorState<Rotors> measured_;                                 // last good measurement
  double last_in_air_ = -std::numeric_limits<double>::infinity();  // [s]
  bool landed_ = true;  // see ActuatorLevelWeights::thrust_on_ground
};

template <int Rotors>
ActuatorNmpc<Rotors>::ActuatorNmpc(const Vehicle<Rotors>& vehicle,
                                   const ActuatorNmpcSettings& settings)
    : Base(Problem(vehicle, validated(settings).problem), settings.solver,
           GroundContact(vehicle.body, undercarriage(vehicle), settings.ground), vehicle.body.mass),
      settings_(settings),
      vehicle_(vehicle),
      undercarriage_(undercarriage(vehicle)),
      inverse_(vehicle),
      reference_wrench_(vehicle, settings.ground, inverse_.matrix()) {
  for (std::size_t i = 0; i < Rotors; ++i) {
    RotorLimits& rotor = rotors_[i];
    rotor.parameters = rotor_parameters(vehicle, i);
    rotor.effectiveness = vehicle.rotors[i].effectiveness;
    rotor.min_speed = speed_from_thrust(rotor.parameters.min_thrust, rotor.parameters);
    rotor.max_speed = speed_from_thrust(rotor.parameters.max_thrust, rotor.parameters);
    rotor.tilts = vehicle.rotors[i].tilts;
  }
  set_safe_command();
}

template <int Rotors>
ActuatorNmpc<Rotors>::ActuatorNmpc(const Vehicle<Rotors>& vehicle)
    : ActuatorNmpc(vehicle, actuator_nmpc_settings(vehicle)) {}

template <int Rotors>
void ActuatorNmpc<Rotors>::set_settings(const ActuatorNmpcSettings& settings) {
  validate(settings);
  require(settings.solver == settings_.solver, "ActuatorNmpcSettings.solver", "another",
          "as at construction");
  solver_.problem().set_settings(settings.problem);
  settings_ = settings;
  ground_.set_settings(settings.ground);
  reference_wrench_.set_settings(settings.ground);
  prepared_ = false;
}

template <int Rotors>
bool ActuatorNmpc<Rotors>::set_voltage(double voltage) noexcept {
  const std::optional<double> ratio = voltage_ratio(vehicle_.battery, voltage);
  if (!ratio) return false;
  Eigen::Matrix<double, Rotors, 1> most;
  for (int i = 0; i < Rotors; ++i) {
    RotorLimits& rotor = rotors_[static_cast<std::size_t>(i)];
    const double thrust = max_thrust_at(rotor.parameters, *ratio);
    rotor.max_speed = speed_from_thrust(thrust, rotor.parameters);
    most(i) = rotor.effectiveness * thrust;
  }
  solver_.problem().set_max_thrust(most);
  return true;
}

template <int Rotors>
const ActuatorNmpcResult<Rotors>& ActuatorNmpc<Rotors>::feedback(
    double time, const BodyStated& measured, const ActuatorState<Rotors>& actuators) noexcept {
  if (!std::isfinite(time) || !is_finite(measured) || !all_finite(actuators.rotor_speed) ||
      !all_finite(actuators.tilt_angle))
    return hold(time);
  body_state_ = measured;
  body_state_.orientation.normalize();
  measured_ = actuators;
  return this->plan_for(time);
}

template <int Rotors>
const ActuatorNmpcResult<Rotors>& ActuatorNmpc<Rotors>::hold(double time) noexcept {
  return this->continue_last_plan(time, NmpcStatus::bad_state);
}

template <int Rotors>
void ActuatorNmpc<Rotors>::begin_to_prepare(double time, const ContactEstimate& contact) {
  this->begin(time, contact);
  if (!contact_.on_ground || !(time >= last_in_air_)) last_in_air_ = time;
  constexpr double landing = 0.5;  // from the first wheel until all stand, on a slope [s]
  landed_ = time - last_in_air_ > landing;
}

template <int Rotors>
optimal_control::PrepareStatus ActuatorNmpc<Rotors>::finish_preparing(double time) {
  return this->finish(time);
}

template <int Rotors>
ActuatedState<Rotors> ActuatorNmpc<Rotors>::initial_state(double /*time*/) const {
  const ActuatorLimits<Rotors>& limits = solver_.problem().limits();
  State x;
  x.body = body_state_;
  if (const auto& node = solver_.problem().node(0); node.on_ground) ground_.stop_held(node, x.body);
  for (int i = 0; i < Rotors; ++i) {
    const auto k = static_cast<std::size_t>(i);
    const RotorLimits& rotor = rotors_[k];
    const double thrust =
        rotor.effectiveness * thrust_from_speed(measured_.rotor_speed(i), rotor.parameters);
    x.thrust(i) = std::clamp(thrust, limits.min_thrust(i), limits.max_thrust(i));
    if (!rotor.tilts) continue;
    x.tilt_angle(i) = std::clamp(measured_.tilt_angle(i), limits.min_angle(i), limits.max_angle(i));
  }
  return x;
}

template <int Rotors>
void ActuatorNmpc<Rotors>::set_guess(double time, State& first) const {
  const State planned = plan_.planned(solver_, plan_.age(time));
  first.thrust = planned.thrust;
  first.tilt_angle = planned.tilt_angle;
}

template <int Rotors>
bool ActuatorNmpc<Rotors>::is_credible(const State& x) const {
  const ActuatorLimits<Rotors>& limits = solver_.problem().limits();
  bool credible =
      x.body.angular_velocity.norm() <= 10.0 * settings_.problem.bounds.angular_velocity.maxCoeff();
  for (int i = 0; i < Rotors; ++i)
    credible = credible && std::abs(x.thrust(i)) <= 10.0 * limits.max_thrust(i) + 1.0 &&
               std::abs(x.tilt_angle(i)) <= 100.0;
  return credible;
}

template <int Rotors>
void ActuatorNmpc<Rotors>::lean(ReferencePoint& point, const Wrenchd& external) const {
  const Eigen::Matrix3d& possible = inverse_.steady_forces();
  Eigen::Vector3d needed = vehicle_.body.mass * point.acceleration;
  needed.z() += vehicle_.body.mass * gravity;
  // The external force is constant in the body frame, so the attitude is found by iteration.
  for (int n = 0; n < 4; ++n) {
    const Eigen::Vector3d force = point.orientation.conjugate() * needed - external.force;
    Eigen::Vector3d given;
    for (int i = 0; i < 3; ++i)
      given(i) =
          possible(i, 0) * force.x() + possible(i, 1) * force.y() + possible(i, 2) * force.z();
    const double length = force.norm() * given.norm();
    if (!(length > 1e-6)) return;
    const Eigen::Vector3d axis = given.cross(force) / length;
    Eigen::Quaterniond turn(1.0 + given.dot(force) / length, axis.x(), axis.y(), axis.z());
    turn.normalize();
    point.orientation = (point.orientation * turn).normalized();
  }
}

template <int Rotors>
void ActuatorNmpc<Rotors>::lean_on_wheels(Node& node, Wrenchd& wrench) const {
  // The thrust grows smoothly with the force, otherwise the nose would have to jump up or down
  // where the force changes its sign.
  constexpr double least = 0.1;      // thrust / weight
  constexpr double per_force = 8.0;  // thrust / forward force, for large forces
  if (!undercarriage_ || !undercarriage_->pitches || pushes()) return;
  const double forward = wrench.force.x(),
               total = std::hypot(std::max(wrench.force.z(), least * vehicle_.body.mass * gravity),
                                  per_force * forward),
               half = 0.5 * std::asin(forward / total);
  node.reference.orientation =
      node.reference.orientation * Eigen::Quaterniond(std::cos(half), 0.0, std::sin(half), 0.0);
  wrench.force.x() = 0.0;
  wrench.force.z() = total;
}

template <int Rotors>
void ActuatorNmpc<Rotors>::steer(Node& node) const {
  node.steering = {};
  if (!node.on_ground || !ground_.holds() || !undercarriage_->rolls ||
      inverse_.steady_forces()(1, 1) > 0.5)
    return;
  const BodyStated& reference = node.reference;
  const Eigen::Vector3d up = reference.orientation.conjugate() * node.com_plane.normal();
  const double speed = (reference.orientation.conjugate() * reference.velocity).x();
  for (int i = 0; i < 3; ++i) node.steering.speed(i) = speed * up(i);
  node.steering.side = 0.0;
  // GroundContact has added the side force of the reference's turn.
  node.external.force.y() -=
      vehicle_.body.mass * node.steering.speed.dot(reference.angular_velocity);
}

template <int Rotors>
void ActuatorNmpc<Rotors>::set_nodes() {
  Problem& problem = solver_.problem();
  const bool leans = inverse_.leans();
  const double interval = settings_.problem.interval;
  for (std::size_t k = 0; k < points_.size(); ++k) {
    Node& node = problem.node(static_cast<int>(k));
    ReferencePoint followed = ground_.apply(
        contact_, body_state_, interval * static_cast<double>(k), points_[0], points_[k], node);
    if (leans && !node.on_ground) {
      lean(followed, node.external);
      node.reference.orientation = followed.orientation;
    }
    steer(node);
    Wrenchd wrench = reference_wrench_(followed, node.external, node.on_ground);
    if (leans && node.on_ground) {
      lean_on_wheels(node, wrench);
      ground_.hold_rotation(node.reference.orientation, node);
    }
    const auto thrusts =
        inverse_.within(wrench, problem.limits().min_thrust, problem.limits().max_thrust);
    for (int i = 0; i < Rotors; ++i) {
      node.lateral_reference(i) = thrusts(2 * i);
      node.vertical_reference(i) = thrusts(2 * i + 1);
    }
  }
  // A vehicle that drives by leaning needs its thrust there.
  const bool stays =
      landed_ && pushes() && problem.node(0).on_ground && problem.node(problem.horizon()).on_ground;
  for (int k = 0; k <= problem.horizon(); ++k) problem.node(k).stays_on_ground = stays;
  // The condition on the angular velocity at a node is that of the interval before it. The pitch
  // may change from one node to the next, and the model cannot follow within no time.
  for (int k = problem.horizon(); leans && k > 0; --k)
    if (problem.node(k).on_ground && problem.node(k - 1).on_ground)
      problem.node(k).roll_axis = problem.node(k - 1).roll_axis;
  // The angular velocity that the leaning adds.
  for (int k = 0; leans && k < problem.horizon(); ++k) {
    BodyStated &here = problem.node(k).reference, &next = problem.node(k + 1).reference;
    if (problem.node(k).on_ground != problem.node(k + 1).on_ground) continue;
    here.angular_velocity =
        quaternion_log(Eigen::Quaterniond(here.orientation.conjugate() * next.orientation)) /
        interval;
    next.angular_velocity = here.angular_velocity;
  }
}

template <int Rotors>
void ActuatorNmpc<Rotors>::set_command(double age) {
  // A command to a servo acts after its dead time.
  const double ahead = age + vehicle_.servo.dead_time;
  set_actuator_command(plan_.planned(solver_, age), plan_.rates(solver_, age));
  if (!(vehicle_.servo.dead_time > 0.0)) return;
  result_.command.tilt_angle =
      command_for(plan_.planned(solver_, ahead), plan_.rates(solver_, ahead)).tilt_angle;
}

template <int Rotors>
void ActuatorNmpc<Rotors>::set_safe_command() {
  Wrenchd wrench;
  if (contact_.on_ground) {
    wrench.force.z() = settings_.ground.down_force;
  } else {
    wrench = {-contact_.disturbance.force, -contact_.disturbance.torque};
    wrench.force.z() += vehicle_.body.mass * gravity;
  }
  set_actuator_command(actuators_for(wrench), Problem::Input::Zero());
}

template <int Rotors>
ActuatedState<Rotors> ActuatorNmpc<Rotors>::actuators_for(const Wrenchd& wrench) const noexcept {
  const ActuatorLimits<Rotors>& limits = solver_.problem().limits();
  const auto thrusts = inverse_.within(wrench, limits.min_thrust, limits.max_thrust);
  State x;
  for (int i = 0; i < Rotors; ++i) {
    const double lateral = thrusts(2 * i), vertical = thrusts(2 * i + 1);
    if (rotors_[static_cast<std::size_t>(i)].tilts) {
      x.thrust(i) = std::sqrt(lateral * lateral + vertical * vertical);
      x.tilt_angle(i) = std::atan2(lateral, vertical);
    } else {
      x.thrust(i) = vertical;
    }
  }
  return x;
}

template <int Rotors>
ActuatorState<Rotors> ActuatorNmpc<Rotors>::command_for(const Wrenchd& wrench) const noexcept {
  return command_for(actuators_for(wrench), Problem::Input::Zero());
}

template <int Rotors>
ActuatorState<Rotors> ActuatorNmpc<Rotors>::command_for(
    const State& x, const typename Problem::Input& rates) const noexcept {
  const ActuatorLimits<Rotors>& limits = solver_.problem().limits();
  const double period = settings_.period,
               reached_by_servo = -std::expm1(-period / vehicle_.servo.time_constant);
  ActuatorState<Rotors> command;
  for (int i = 0; i < Rotors; ++i) {
    const RotorLimits& rotor = rotors_[static_cast<std::size_t>(i)];
    const RotorParameters& parameters = rotor.parameters;
    // A lost rotor gets the slowest speed.
    const double per_effectiveness = rotor.effectiveness > 0.0 ? 1.0 / rotor.effectiveness : 0.0;
    const auto speed_at = [&](double thrust) {
      const double clamped = std::clamp(thrust, limits.min_thrust(i), limits.max_thrust(i));
      return speed_from_thrust(per_effectiveness * clamped, parameters);
    };
    const double speed = speed_at(x.thrust(i)),
                 reached = -std::expm1(-period / parameters.time_constant),
                 target = speed + (speed_at(x.thrust(i) + period * rates(i)) - speed) / reached;
    command.rotor_speed(i) = std::clamp(target, rotor.min_speed, rotor.max_speed);
    if (rotor.tilts)
      command.tilt_angle(i) =
          std::clamp(x.tilt_angle(i) + period * rates(Rotors + i) / reached_by_servo,
                     limits.min_angle(i), limits.max_angle(i));
  }
  return command;
}

template <int Rotors>
void ActuatorNmpc<Rotors>::set_actuator_command(const State& x,
                                                const typename Problem::Input& rates) {
  result_.command = command_for(x, rates);
  result_.thrust = x.thrust;
  result_.tilt_angle = x.tilt_angle;
  for (int i = 0; i < Rotors; ++i) {
    result_.thrust_rate(i) = rates(i);
    result_.tilt_rate(i) = rates(Rotors + i);
  }
  result_.wrench = solver_.problem().body().wrench(x);
  result_.on_ground = contact_.on_ground;
}

/// Call prepare(), measure, then call feedback(), at any rate. For every input, the output is
/// finite and within the bounds. The controller reacts to faults as follows, from mild to severe:
///
/// - The contact estimate is not finite. Or the observer is lost: a force of the estimate is above
///   ten times the weight, or a torque is above ten times the weight at one metre. The last good
///   estimate is used instead, for any length of time. Status solved.
/// - The measurement is not finite. Or there is no valid measurement (a stale estimate, which the
///   caller detects and reports by hold()). The last plan continues. Status bad_state.
/// - The quadratic program is not solved within NmpcSettings.time_limit or the limit on passes. The
///   best plan so far is used, and the next tick continues from there. Status approximate.
/// - The reference is not finite from some node on, or its quaternion has no length. It goes on
///   straight from the node before. Status approximate.
/// - There is no solution, for example because the reference is not finite now. The last plan
///   continues. Status solver_failed.
/// - The plan is not credible, for example after a measurement or a reference from far away. It is
///   computed again from a cold start in the same call. If the new plan is not better, the safe
///   wrench is returned with status no_plan. If there is no time for it, the last plan continues
///   with status solver_failed.
/// - Failures in a row reach failures_before_reset. The next solve starts cold, from the measured
///   state and the last commanded wrench. If this solve fails, too, the last commanded wrench
///   continues.
/// - The last plan is older than max_plan_age, or there was no plan. The safe wrench is returned.
///   Status no_plan. After an interruption of this length, the next plan also starts from the safe
///   wrench.
///
/// One good tick ends each of these states. The safe wrench is hover against the last known
/// external wrench, or down_force in contact. It keeps a level vehicle level, but holds no
/// position. A caller without measurements must therefore reduce the thrust soon.
///
/// A tick uses at most 64 KB of stack in an optimised program.
///
/// `SolverOf` solves the problem. MultipleShooting does one real-time iteration a tick;
/// SingleShooting lets NLopt alone solve the whole problem in each tick, which takes a hundred
/// times as long.
template <int Rotors, template <typename> class SolverOf = optimal_control::MultipleShooting>
class Nmpc
    : detail::RecedingHorizon<Nmpc<Rotors, SolverOf>, SolverOf<WheeledFlightProblem<Rotors>>,
                              PlanInForce<SolverOf<WheeledFlightProblem<Rotors>>>, NmpcResult> {
  using Solver = SolverOf<WheeledFlightProblem<Rotors>>;
  using Base = detail::RecedingHorizon<Nmpc, Solver, PlanInForce<Solver>, NmpcResult>;
  friend Base;
  using Base::body_state_, Base::contact_, Base::ground_, Base::plan_, Base::plan_in_force,
      Base::points_, Base::prepare_time_, Base::prepared_, Base::result_, Base::solver_;

 public:
  using Problem = WheeledFlightProblem<Rotors>;

  /// Throws std::invalid_argument if parameters or settings are out of range, or if the geometry
  /// cannot give every wrench (see control_authority()). Allocates. The functions for the loop
  /// below allocate only inside NLopt and never throw. If an actuator fails in flight, construct a
  /// new controller for the remaining vehicle.
  Nmpc(const Vehicle<Rotors>& vehicle, const NmpcSettings& settings);

  /// Uses the settings that fly this vehicle without tuning.
  explicit Nmpc(const Vehicle<Rotors>& vehicle);

  /// Changes the settings between two ticks, without a cold start: weights, bounds, penalties,
  /// ground contact, time limits. Only `solver` and the number and length of the intervals must
  /// stay the same. The next prepare() uses the new settings. After this call feedback() fails
  /// until prepare() is called again. Does not allocate, except with TerminalCost::riccati. Throws
  /// std::invalid_argument, and changes nothing, if the settings are out of range.
  void set_settings(const NmpcSettings& settings);

  /// Does all work that does not need the measurement of `time` [s]: reference, linearisation,
  /// factorisation. `reference` is any callable that returns a ReferencePoint for a time and does
  /// not throw. `contact` comes from ContactEstimator or from the caller. If the time is not
  /// finite, nothing is prepared (rejected), and feedback() fails.
  template <typename Reference>
  [[nodiscard]] optimal_control::PrepareStatus prepare(double time, const Reference& reference,
                                                       const ContactEstimate& contact) noexcept {
    const auto start = optimal_control::SolverClock::now();
    begin_to_prepare(time, contact);
    if (!std::isfinite(time)) return optimal_control::PrepareStatus::rejected;
    for (std::size_t k = 0; k < points_.size(); ++k)
      points_[k] = reference(time + settings_.problem.interval * static_cast<double>(k));
    const optimal_control::PrepareStatus status = finish_preparing(time);
    prepare_time_ = optimal_control::SolverClock::now() - start;
    return status;
  }

  /// Returns the wrench to command for the body state measured at `time` [s]. Needs a prepare()
  /// before. After a cold start or repeated failure this call also does the work of prepare().
  [[nodiscard]] const NmpcResult& feedback(double time, const BodyStated& measured) noexcept;

  /// Returns the wrench for the body state measured at `time` [s] between two ticks, for example in
  /// an inner loop at 1 kHz. The wrench rate is the rate of the plan plus a correction, within the
  /// bounds. The correction is the gain of the last factorisation times the deviation from the
  /// planned state. The wrench integrates the rates since the last call, and the next tick starts
  /// from it. Takes microseconds. If the state is not finite or no plan is in force, the call
  /// returns the result of hold(). This does not count as a failure.
  [[nodiscard]] const NmpcResult& between_ticks(double time, const BodyStated& measured) noexcept;

  /// Replaces feedback() if there is no valid state at `time` [s].
  [[nodiscard]] const NmpcResult& hold(double time) noexcept;

  /// Sets the measured `voltage` of the battery [V]. From the next prepare() on, plans respect the
  /// thrusts that this voltage allows, if NmpcSettings::actuator_constraints is set. Returns true
  /// if voltage_ratio() accepts the voltage; if not, nothing changes.
  bool set_voltage(double voltage) noexcept {
    if (!actuators_.set_voltage(voltage)) return false;
    (void)solver_.problem().set_voltage(voltage);
    return true;
  }

  [[nodiscard]] const NmpcResult& result() const { return result_; }  ///< of the last call
  /// The estimate that the plan uses: from prepare(), or an earlier one if that was not plausible.
  [[nodiscard]] const ContactEstimate& contact() const { return contact_; }
  [[nodiscard]] const Solver& solver() const { return solver_; }
  [[nodiscard]] const NmpcSettings& settings() const { return settings_; }

 private:
  using Actuators = ActuatorConstraints<Rotors>;
  using Rate = typename PlanInForce<Solver>::Rate;

  // The parts of prepare() before and after the reference is evaluated.
  void begin_to_prepare(double time, const ContactEstimate& contact);
  optimal_control::PrepareStatus finish_preparing(double time);

  // For RecedingHorizon:
  void set_nodes();
  [[nodiscard]] Stated initial_state(double time) const;
  void set_guess(double time, Stated& first) const { first.wrench = plan_.wrench(solver_, time); }
  // False above ten times the bounds on body rate, force or torque.
  [[nodiscard]] bool is_credible(const Stated& x) const;
  void set_command(double age);
  void set_old_command(double time);
  void set_safe_command();

  void set_node(double ahead, const ReferencePoint& point, WheeledFlightNode& node) const;

  /// Wrench without a plan. In the air it carries the weight and the known external wrench without
  /// turning the vehicle; on the ground it is almost no thrust.
  [[nodiscard]] Wrenchd safe_wrench() const;

  void set_rate(const Rate& rate) {
    for (int i = 0; i < 3; ++i) {
      result_.rate.force(i) = rate(i);
      result_.rate.torque(i) = rate(3 + i);
    }
  }

  NmpcSettings settings_;
  RigidBodyParameters body_;
  Actuators actuators_;
  ReferenceWrench<Rotors> reference_wrench_;
};

template <int Rotors, template <typename> class SolverOf>
Nmpc<Rotors, SolverOf>::Nmpc(const Vehicle<Rotors>& vehicle, const NmpcSettings& settings)
    : Base(Problem(vehicle.body, validated(settings).problem,
                   settings.actuator_constraints ? Actuators(vehicle, settings.actuators)
                                                 : Actuators()),
           settings.solver, GroundContact(vehicle.body, undercarriage(vehicle), settings.ground),
           vehicle.body.mass),
      settings_(settings),
      body_(vehicle.body),
      actuators_(vehicle, settings.actuators),
      reference_wrench_(vehicle, settings.ground) {
  result_.wrench = safe_wrench();
}

template <int Rotors, template <typename> class SolverOf>
Nmpc<Rotors, SolverOf>::Nmpc(const Vehicle<Rotors>& vehicle)
    : Nmpc(vehicle, nmpc_settings(vehicle)) {}

template <int Rotors, template <typename> class SolverOf>
void Nmpc<Rotors, SolverOf>::set_settings(const NmpcSettings& settings) {
  validate(settings);
  require(settings.solver == settings_.solver, "NmpcSettings.solver", "another",
          "as at construction");
  solver_.problem().set_settings(settings.problem, settings.actuator_constraints
                                                       ? actuators_.with(settings.actuators)
                                                       : Actuators());
  settings_ = settings;
  ground_.set_settings(settings.ground);
  reference_wrench_.set_settings(settings.ground);
  prepared_ = false;
}

template <int Rotors, template <typename> class SolverOf>
const NmpcResult& Nmpc<Rotors, SolverOf>::feedback(double time,
                                                   const BodyStated& measured) noexcept {
  if (!std::isfinite(time) || !is_finite(measured))
    return this->continue_last_plan(time, NmpcStatus::bad_state);
  body_state_ = measured;
  body_state_.orientation.normalize();
  return this->plan_for(time);
}

template <int Rotors, template <typename> class SolverOf>
const NmpcResult& Nmpc<Rotors, SolverOf>::between_ticks(double time,
                                                        const BodyStated& measured) noexcept {
  if (!plan_in_force(time) || !is_finite(measured))
    return this->hand_out_last_plan(time, NmpcStatus::bad_state);
  Stated x;
  x.body = measured;
  x.body.orientation.normalize();
  if (const auto& node = solver_.problem().node(0); node.on_ground)
    ground_.stop_held(node, x.body);  // as in feedback()
  x.wrench = plan_.wrench(solver_, time);
  set_rate(plan_.correct(solver_, time, x));
  result_.wrench = x.wrench;
  result_.status = this->plan_status_;
  return result_;
}

template <int Rotors, template <typename> class SolverOf>
const NmpcResult& Nmpc<Rotors, SolverOf>::hold(double time) noexcept {
  return this->continue_last_plan(time, NmpcStatus::bad_state);
}

template <int Rotors, template <typename> class SolverOf>
void Nmpc<Rotors, SolverOf>::begin_to_prepare(double time, const ContactEstimate& contact) {
  this->begin(time, contact);
}

template <int Rotors, template <typename> class SolverOf>
optimal_control::PrepareStatus Nmpc<Rotors, SolverOf>::finish_preparing(double time) {
  return this->finish(time);
}

template <int Rotors, template <typename> class SolverOf>
Stated Nmpc<Rotors, SolverOf>::initial_state(double time) const {
  Stated x;
  x.body = body_state_;
  if (const auto& node = solver_.problem().node(0); node.on_ground) ground_.stop_held(node, x.body);
  x.wrench = plan_.exists() ? plan_.wrench(solver_, time) : safe_wrench();
  return x;
}

template <int Rotors, template <typename> class SolverOf>
bool Nmpc<Rotors, SolverOf>::is_credible(const Stated& x) const {
  const NmpcBounds& b = settings_.problem.bounds;
  const double turn = 10.0 * b.angular_velocity.maxCoeff(),
               force = 10.0 * b.force_min.cwiseAbs().cwiseMax(b.force_max.cwiseAbs()).maxCoeff(),
               torque = 10.0 * b.torque_min.cwiseAbs().cwiseMax(b.torque_max.cwiseAbs()).maxCoeff();
  return x.body.angular_velocity.norm() <= turn && x.wrench.force.norm() <= force &&
         x.wrench.torque.norm() <= torque;
}

template <int Rotors, template <typename> class SolverOf>
void Nmpc<Rotors, SolverOf>::set_nodes() {
  for (std::size_t k = 0; k < points_.size(); ++k)
    set_node(settings_.problem.interval * static_cast<double>(k), points_[k],
             solver_.problem().node(static_cast<int>(k)));
}

template <int Rotors, template <typename> class SolverOf>
void Nmpc<Rotors, SolverOf>::set_node(double ahead, const ReferencePoint& point,
                                      WheeledFlightNode& node) const {
  const ReferencePoint followed =
      ground_.apply(contact_, body_state_, ahead, points_[0], point, node);
  node.wrench_reference = {};
  switch (settings_.wrench_reference) {
    case WrenchReference::zero:
      break;
    case WrenchReference::hover:
      node.wrench_reference.force.z() =
          node.on_ground ? settings_.ground.down_force : body_.mass * gravity;
      break;
    case WrenchReference::inverse_dynamics:
      node.wrench_reference = reference_wrench_(followed, node.external, node.on_ground);
  }
}

template <int Rotors, template <typename> class SolverOf>
Wrenchd Nmpc<Rotors, SolverOf>::safe_wrench() const {
  Wrenchd wrench;
  if (contact_.on_ground) {
    wrench.force.z() = settings_.ground.down_force;
  } else {
    wrench = {-contact_.disturbance.force, -contact_.disturbance.torque};
    wrench.force.z() += body_.mass * gravity;
  }
  return within(settings_.problem.bounds, wrench);
}

template <int Rotors, template <typename> class SolverOf>
void Nmpc<Rotors, SolverOf>::set_command(double age) {
  result_.wrench = plan_.planned_wrench(solver_, age);
  set_rate(plan_.planned_rate(solver_, age));
  result_.on_ground = contact_.on_ground;
}

template <int Rotors, template <typename> class SolverOf>
void Nmpc<Rotors, SolverOf>::set_old_command(double time) {
  set_command(plan_.age(time));
  if (plan_.corrected()) result_.wrench = plan_.wrench(solver_, time);
}

template <int Rotors, template <typename> class SolverOf>
void Nmpc<Rotors, SolverOf>::set_safe_command() {
  result_.wrench = safe_wrench();
  result_.rate = {};
}

}  // namespace tilt_ropter
