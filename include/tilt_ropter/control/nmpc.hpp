// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/actuator_constraints.hpp>
#include <tilt_ropter/control/ground_contact.hpp>
#include <tilt_ropter/control/nmpc_result.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/control/plan_in_force.hpp>
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
/// - There is no solution, for example because the reference is not finite. The last plan
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
template <int Rotors>
class Nmpc {
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
  [[nodiscard]] const optimal_control::MultipleShooting<Problem>& solver() const { return solver_; }
  [[nodiscard]] const NmpcSettings& settings() const { return settings_; }

 private:
  using Actuators = ActuatorConstraints<Rotors>;
  using Rate = typename PlanInForce<Rotors>::Rate;

  // The parts of prepare() before and after the reference is evaluated.
  void begin_to_prepare(double time, const ContactEstimate& contact);
  optimal_control::PrepareStatus finish_preparing(double time);

  [[nodiscard]] bool is_plausible(const ContactEstimate& contact) const;

  // End of the time limit of this tick; the time of prepare() counts.
  [[nodiscard]] optimal_control::SolverClock::time_point deadline_from(
      optimal_control::SolverClock::time_point now) const;

  [[nodiscard]] bool plan_in_force(double time) const {
    return plan_.in_force(time, settings_.max_plan_age);
  }
  // Discards the plan after an interruption, because no actuator has followed it.
  void forget_old_plan(double time);

  [[nodiscard]] bool make_plan(const Stated& x, optimal_control::SolverClock::time_point deadline);

  // Checks whether a cold start fits into the same tick without making it much longer.
  [[nodiscard]] bool can_start_again(optimal_control::SolverClock::time_point deadline) const;

  /// Cold start: sets the state of every node to `x` and prepares the solver.
  void start_cold(const Stated& x);

  /// Returns false if the plan exceeds ten times the bounds on body rate, force or torque, or if it
  /// moves more than a kilometre away. Bad input then caused the plan, and single iterations do not
  /// recover from it.
  [[nodiscard]] bool plan_is_credible() const;

  void set_nodes();

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
  void set_command(double age);

  const NmpcResult& continue_last_plan(double time, NmpcStatus status);
  const NmpcResult& hand_out_last_plan(double time, NmpcStatus status);

  NmpcSettings settings_;
  RigidBodyParameters body_;
  Actuators actuators_;
  GroundContact ground_;
  ReferenceWrench<Rotors> reference_wrench_;
  optimal_control::MultipleShooting<Problem> solver_;
  std::vector<ReferencePoint> points_;
  BodyStated body_state_;    // last good measurement
  ContactEstimate contact_;  // last good estimate
  NmpcResult result_;
  PlanInForce<Rotors> plan_;
  NmpcStatus plan_status_ = NmpcStatus::no_plan;
  optimal_control::SolverClock::duration prepare_time_{};
  int failures_ = 0;
  bool prepared_ = false, cold_ = true;
};

template <int Rotors>
Nmpc<Rotors>::Nmpc(const Vehicle<Rotors>& vehicle, const NmpcSettings& settings)
    : settings_(validated(settings)),
      body_(vehicle.body),
      actuators_(vehicle, settings.actuators),
      ground_(vehicle.body, undercarriage(vehicle), settings.ground),
      reference_wrench_(vehicle, settings.ground),
      solver_(Problem(vehicle.body, settings.problem,
                      settings.actuator_constraints ? actuators_ : Actuators()),
              settings.solver),
      points_(static_cast<std::size_t>(settings.problem.intervals) + 1) {
  result_.wrench = safe_wrench();
}

template <int Rotors>
Nmpc<Rotors>::Nmpc(const Vehicle<Rotors>& vehicle) : Nmpc(vehicle, nmpc_settings(vehicle)) {}

template <int Rotors>
void Nmpc<Rotors>::set_settings(const NmpcSettings& settings) {
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

template <int Rotors>
const NmpcResult& Nmpc<Rotors>::feedback(double time, const BodyStated& measured) noexcept {
  if (!std::isfinite(time) || !is_finite(measured))
    return continue_last_plan(time, NmpcStatus::bad_state);
  body_state_ = measured;
  body_state_.orientation.normalize();
  if (!prepared_) return continue_last_plan(time, NmpcStatus::solver_failed);
  const auto deadline = deadline_from(optimal_control::SolverClock::now());
  forget_old_plan(time);
  if (cold_) set_nodes();  // with this measurement, not with the last one
  Stated x;
  x.body = body_state_;
  if (solver_.problem().node(0).on_ground) ground_.stop_held(x.body);
  x.wrench = plan_.exists() ? plan_.wrench(solver_, time) : safe_wrench();
  if (cold_) start_cold(x);
  prepared_ = false;
  bool credible = make_plan(x, deadline);
  if (!credible && optimal_control::has_plan(result_.report.status)) {
    solver_.take_back();
    if (!cold_ && can_start_again(deadline)) {
      start_cold(x);
      plan_.drop();  // start_cold() has overwritten it
      credible = make_plan(x, deadline);
      if (!credible && optimal_control::has_plan(result_.report.status)) solver_.take_back();
    }
    if (!credible) result_.report.status = optimal_control::SolveStatus::failed;
  }
  if (!credible) return continue_last_plan(time, NmpcStatus::solver_failed);
  if (!solver_.has_step() && plan_in_force(time))
    return hand_out_last_plan(time, NmpcStatus::approximate);
  failures_ = 0;
  cold_ = false;
  plan_.begin(solver_, time);
  plan_status_ = result_.report.status == optimal_control::SolveStatus::iterated
                     ? NmpcStatus::solved
                     : NmpcStatus::approximate;
  result_.status = plan_status_;
  set_command(0.0);
  return result_;
}

template <int Rotors>
const NmpcResult& Nmpc<Rotors>::between_ticks(double time, const BodyStated& measured) noexcept {
  if (!plan_in_force(time) || !is_finite(measured))
    return hand_out_last_plan(time, NmpcStatus::bad_state);
  Stated x;
  x.body = measured;
  x.body.orientation.normalize();
  if (solver_.problem().node(0).on_ground) ground_.stop_held(x.body);  // as in feedback()
  x.wrench = plan_.wrench(solver_, time);
  set_rate(plan_.correct(solver_, time, x));
  result_.wrench = x.wrench;
  result_.status = plan_status_;
  return result_;
}

template <int Rotors>
const NmpcResult& Nmpc<Rotors>::hold(double time) noexcept {
  return continue_last_plan(time, NmpcStatus::bad_state);
}

template <int Rotors>
void Nmpc<Rotors>::begin_to_prepare(double time, const ContactEstimate& contact) {
  prepared_ = false;
  if (!std::isfinite(time)) return;
  forget_old_plan(time);
  if (is_plausible(contact)) contact_ = contact;
}

template <int Rotors>
optimal_control::PrepareStatus Nmpc<Rotors>::finish_preparing(double time) {
  set_nodes();
  prepared_ = true;
  if (cold_)
    return optimal_control::PrepareStatus::prepared;  // feedback() does the rest, from the
                                                      // measured state
  // The controller itself commands the wrench at `time`. With this wrench as the linearisation
  // point, the constraints of the first node are exact, and the command satisfies them.
  if (!solver_.goes_on()) {
    Stated first = solver_.state(0);
    first.wrench = plan_.wrench(solver_, time);
    solver_.set_guess(0, first, solver_.input(0));
  }
  return solver_.prepare();
}

template <int Rotors>
bool Nmpc<Rotors>::is_plausible(const ContactEstimate& contact) const {
  const double most = 10.0 * body_.mass * gravity;
  const auto is_small = [most](const Wrenchd& w) {  // false for NaN
    return w.force.norm() <= most && w.torque.norm() <= most;
  };
  return is_finite(contact) && is_small(contact.disturbance) && is_small(contact.rolling) &&
         is_small(contact.external);
}

template <int Rotors>
optimal_control::SolverClock::time_point Nmpc<Rotors>::deadline_from(
    optimal_control::SolverClock::time_point now) const {
  const double limit = settings_.time_limit > 0.0 ? settings_.time_limit : 0.5 * settings_.period;
  return now - prepare_time_ +
         std::chrono::duration_cast<optimal_control::SolverClock::duration>(
             std::chrono::duration<double>(std::min(limit, 1e6)));
}

template <int Rotors>
void Nmpc<Rotors>::forget_old_plan(double time) {
  if (plan_.exists() && !plan_in_force(time)) {
    plan_.drop();
    cold_ = true;
  }
}

template <int Rotors>
bool Nmpc<Rotors>::make_plan(const Stated& x, optimal_control::SolverClock::time_point deadline) {
  result_.report = solver_.feedback(x, deadline);
  return optimal_control::has_plan(result_.report.status) && plan_is_credible();
}

template <int Rotors>
bool Nmpc<Rotors>::can_start_again(optimal_control::SolverClock::time_point deadline) const {
  const auto needed = std::chrono::duration_cast<optimal_control::SolverClock::duration>(
      std::chrono::duration<double, std::micro>(2.0 * solver_.report().prepare_us));
  return 4 * solver_.report().passes <= settings_.solver.program.max_passes &&
         optimal_control::SolverClock::now() + needed < deadline;
}

template <int Rotors>
void Nmpc<Rotors>::start_cold(const Stated& x) {
  solver_.reset(x);
  plan_.reset(x);
  (void)solver_.prepare();
}

template <int Rotors>
bool Nmpc<Rotors>::plan_is_credible() const {
  const NmpcBounds& b = settings_.problem.bounds;
  const double turn = 10.0 * b.angular_velocity.maxCoeff(),
               force = 10.0 * b.force_min.cwiseAbs().cwiseMax(b.force_max.cwiseAbs()).maxCoeff(),
               torque = 10.0 * b.torque_min.cwiseAbs().cwiseMax(b.torque_max.cwiseAbs()).maxCoeff();
  for (int k = 1; k <= solver_.horizon(); ++k) {
    const Stated& x = solver_.state(k);
    if (!(x.body.angular_velocity.norm() <= turn && x.wrench.force.norm() <= force &&
          x.wrench.torque.norm() <= torque &&
          (x.body.position - body_state_.position).norm() <= 1e3))
      return false;
  }
  return true;
}

template <int Rotors>
void Nmpc<Rotors>::set_nodes() {
  for (std::size_t k = 0; k < points_.size(); ++k)
    set_node(settings_.problem.interval * static_cast<double>(k), points_[k],
             solver_.problem().node(static_cast<int>(k)));
}

template <int Rotors>
void Nmpc<Rotors>::set_node(double ahead, const ReferencePoint& point,
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

template <int Rotors>
Wrenchd Nmpc<Rotors>::safe_wrench() const {
  Wrenchd wrench;
  if (contact_.on_ground) {
    wrench.force.z() = settings_.ground.down_force;
  } else {
    wrench = {-contact_.disturbance.force, -contact_.disturbance.torque};
    wrench.force.z() += body_.mass * gravity;
  }
  return within(settings_.problem.bounds, wrench);
}

template <int Rotors>
void Nmpc<Rotors>::set_command(double age) {
  result_.wrench = plan_.planned_wrench(solver_, age);
  set_rate(plan_.planned_rate(solver_, age));
  result_.on_ground = contact_.on_ground;
}

template <int Rotors>
const NmpcResult& Nmpc<Rotors>::continue_last_plan(double time, NmpcStatus status) {
  prepared_ = false;
  if (++failures_ >= settings_.failures_before_reset) cold_ = true;
  return hand_out_last_plan(time, status);
}

template <int Rotors>
const NmpcResult& Nmpc<Rotors>::hand_out_last_plan(double time, NmpcStatus status) {
  const double age = plan_.age(time);
  if (plan_.exists() && age >= 0.0 && age <= settings_.max_plan_age) {
    set_command(age);
    if (plan_.corrected()) result_.wrench = plan_.wrench(solver_, time);
    result_.status = status;
  } else {
    plan_.drop();
    cold_ = true;
    result_.wrench = safe_wrench();
    result_.rate = {};
    result_.on_ground = contact_.on_ground;
    result_.status = NmpcStatus::no_plan;
  }
  return result_;
}

}  // namespace tilt_ropter
