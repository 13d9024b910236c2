// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/actuator_constraints.hpp>
#include <tilt_ropter/control/ground_contact.hpp>
#include <tilt_ropter/control/nmpc_result.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/control/plan_in_force.hpp>
#include <tilt_ropter/control/receding_horizon.hpp>
#include <tilt_ropter/control/reference_wrench.hpp>
#include <tilt_ropter/control/wheeled_flight_problem.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <vector>

/// The Tilt-Ropter's controller (paper, Sec. Control). It computes the wrench that tracks a
/// reference in the air and on the ground, with one real-time iteration per call.
///
/// This header is long because the controller is one class: every fallback needs the measurement,
/// the solver and the plan in force (plan_in_force.hpp).
namespace tilt_ropter {

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
