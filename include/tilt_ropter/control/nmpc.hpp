// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/actuator_level.hpp>
#include <tilt_ropter/control/detail/own_term.hpp>
#include <tilt_ropter/control/detail/plan_in_force.hpp>
#include <tilt_ropter/control/detail/wrench_level.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>

/// The Tilt-Ropter's controller (paper, Sec. Control): it tracks a reference in the air and on the
/// ground, with one real-time iteration per call. Nmpc and ActuatorNmpc are its two levels.
namespace tilt_ropter {

/// The controller. `Level` tells what is planned and commanded, see Nmpc and ActuatorNmpc.
///
/// Call prepare(), measure, then call feedback(), at any rate. For every input, the output is
/// finite and within the bounds. The controller reacts to faults as follows, from mild to severe:
///
/// - The contact estimate is not finite. Or the observer is lost: a force of the estimate is above
///   ten times the weight, or a torque is above ten times the weight at one metre. The last good
///   estimate is used instead, for any length of time. Status solved.
/// - The measurement is not finite. Or there is no valid measurement (a stale estimate, which the
///   caller detects and reports by hold()). The last plan continues. Status bad_state.
/// - The quadratic program is not solved within the time limit or the limit on passes. The best
///   plan so far is used, and the next tick continues from there. Status approximate.
/// - The reference is not finite from some node on, its quaternion has no length, or one of its
///   half-spaces has a normal that is not of length one. It goes on straight from the node before.
///   Status approximate.
/// - There is no solution, for example because the reference is not finite now. The last plan
///   continues. Status solver_failed.
/// - The plan is not credible, for example after a measurement or a reference from far away. It is
///   computed again from a cold start in the same call. If the new plan is not better, the safe
///   command is returned with status no_plan. If there is no time for it, the last plan continues
///   with status solver_failed.
/// - Failures in a row reach failures_before_reset. The next solve starts cold, from the measured
///   state and the last command. If this solve fails, too, the last command continues.
/// - The last plan is older than max_plan_age, or there was no plan. The safe command is returned.
///   Status no_plan. After an interruption of this length, the next plan also starts from the safe
///   command.
///
/// One good tick ends each of these states. The safe command gives the wrench of hover against the
/// last known external wrench, or down_force in contact. It keeps a level vehicle level, but holds
/// no position. A caller without measurements must therefore reduce the thrust soon.
///
/// A tick uses at most 64 KB of stack in an optimised program.
template <typename Level>
class RecedingHorizonController {
 public:
  using Problem = typename Level::Problem;
  using Solver = typename Level::Solver;
  using Settings = typename Level::Settings;
  using Result = ControlResult<typename Level::Command>;
  using Actuators = typename Level::Actuators;
  using Term = typename Level::Term;

  /// `term` is a term of your own in the prediction of Nmpc, see OwnTerm. Throws
  /// std::invalid_argument if parameters or settings are out of range, and at the wrench level if
  /// the geometry cannot give every wrench (see control_authority()). Allocates. The functions for
  /// the loop below allocate only inside NLopt and never throw. If an actuator fails in flight,
  /// construct a new controller for the remaining vehicle, see with_stuck_servo() and
  /// with_weak_rotor().
  RecedingHorizonController(const Vehicle<Level::rotors>& vehicle, const Settings& settings,
                            const Term& term = Term());

  /// Uses the settings that fly this vehicle without tuning.
  explicit RecedingHorizonController(const Vehicle<Level::rotors>& vehicle);

  /// Changes the settings between two ticks, without a cold start: weights, bounds, ground contact,
  /// time limits. Only `solver` and the number and length of the intervals must stay the same. The
  /// next prepare() uses the new settings. After this call feedback() fails until prepare() is
  /// called again. Does not allocate, except with TerminalCost::riccati. Throws
  /// std::invalid_argument, and changes nothing, if the settings are out of range.
  void set_settings(const Settings& settings);

  /// Does all work that does not need the measurement of `time` [s]: reference, linearisation,
  /// factorisation. `reference` is any callable that returns a ReferencePoint for a time and does
  /// not throw. `contact` comes from ContactEstimator or from the caller. If the time is not
  /// finite, nothing is prepared (rejected), and feedback() fails.
  template <typename Reference>
  [[nodiscard]] optimal_control::PrepareStatus prepare(double time, const Reference& reference,
                                                       const ContactEstimate& contact) noexcept {
    const auto start = Clock::now();
    if (!begin(time, contact)) return optimal_control::PrepareStatus::rejected;
    for (std::size_t k = 0; k < inputs_.points.size(); ++k)
      inputs_.points[k] = reference(time + settings().problem.interval * static_cast<double>(k));
    const optimal_control::PrepareStatus status = finish(time);
    prepare_time_ = Clock::now() - start;
    return status;
  }

  /// Returns the command for the body state measured at `time` [s]. Needs a prepare() before. After
  /// a cold start or repeated failure this call also does the work of prepare().
  ///
  /// ActuatorNmpc also needs `actuators`, measured or modelled. Take both the speeds and the angles
  /// from ActuatorModel, unless the speed sensors have little noise: an inverted lag amplifies it.
  [[nodiscard]] const Result& feedback(
      double time, const BodyStated& measured,
      const Actuators& actuators = Level::without_actuators) noexcept;

  /// Nmpc only. Returns the wrench for the body state measured at `time` [s] between two ticks, for
  /// example in an inner loop at 1 kHz. The wrench rate is the rate of the plan plus a correction,
  /// within the bounds. The correction is the gain of the last factorisation times the deviation
  /// from the planned state. The wrench integrates the rates since the last call, and the next tick
  /// starts from it. Takes microseconds. If the state is not finite or no plan is in force, the
  /// call returns the result of hold(). This does not count as a failure.
  template <typename = void>  // a template, as not every level has it
  [[nodiscard]] const Result& between_ticks(double time, const BodyStated& measured) noexcept {
    if (!plan_in_force(time) || !is_finite(measured))
      return use_last_plan(time, NmpcStatus::bad_state);
    BodyStated body = measured;
    body.orientation.normalize();
    static_cast<Command&>(result_) = level_.correct(solver_, plan_, time, body);
    result_.status = plan_status_;
    return result_;
  }

  /// Replaces feedback() if there is no valid state at `time` [s].
  [[nodiscard]] const Result& hold(double time) noexcept {
    return continue_last_plan(time, NmpcStatus::bad_state);
  }

  /// Sets the measured `voltage` of the battery [V]. From the next prepare() on, plans respect the
  /// thrusts that this voltage allows; those of Nmpc if NmpcSettings::actuator_constraints is set.
  /// Returns true if voltage_ratio() accepts the voltage; if not, nothing changes.
  bool set_voltage(double voltage) noexcept {
    return level_.set_voltage(voltage, solver_.problem());
  }

  /// ActuatorNmpc only. Returns the speeds and angles of the smallest thrusts for `wrench` (body
  /// frame), as far as the rotors can give it. For the start in flight, for example.
  template <typename = void>  // a template, as not every level has it
  [[nodiscard]] Actuators command_for(const Wrenchd& wrench) const noexcept {
    return level_.command_for(solver_.problem(), wrench).command;
  }

  [[nodiscard]] const Result& result() const { return result_; }  ///< of the last call
  /// The estimate that the plan uses: from prepare(), or an earlier one if that was not plausible.
  [[nodiscard]] const ContactEstimate& contact() const { return inputs_.contact; }
  [[nodiscard]] const Solver& solver() const { return solver_; }
  [[nodiscard]] const Settings& settings() const { return level_.settings(); }

 private:
  using State = typename Solver::State;
  using Command = typename Level::Command;
  using Clock = optimal_control::SolverClock;

  // The parts of prepare() before and after the reference is evaluated.
  [[nodiscard]] bool begin(double time, const ContactEstimate& contact);
  [[nodiscard]] optimal_control::PrepareStatus finish(double time);

  [[nodiscard]] bool is_plausible(const ContactEstimate& contact) const {
    const double most = 10.0 * level_.mass() * gravity;
    const auto is_small = [most](const Wrenchd& w) {  // false for NaN
      return w.force.norm() <= most && w.torque.norm() <= most;
    };
    return is_finite(contact) && is_small(contact.disturbance) && is_small(contact.rolling) &&
           is_small(contact.external) && is_small(contact.surface_reaction);
  }
  // From the first point of the reference that is not finite on, the reference goes on straight
  // from the point before it. Returns false if not even the first point is finite.
  [[nodiscard]] bool continue_reference() {
    inputs_.reference_ends = false;
    const double interval = settings().problem.interval;
    for (std::size_t k = 0; k < inputs_.points.size(); ++k) {
      ReferencePoint& point = inputs_.points[k];
      const double length = point.orientation.norm();
      if (!inputs_.reference_ends && all_finite(point.position) && all_finite(point.velocity) &&
          all_finite(point.acceleration) && all_finite(point.angular_velocity) &&
          all_finite(point.angular_acceleration) && length > 0.1 && length < 10.0 &&
          std::all_of(point.inside.begin(), point.inside.end(),
                      [](const HalfSpace& h) { return is_usable(h); }))
        continue;
      if (k == 0) return false;
      inputs_.reference_ends = true;
      point = inputs_.points[k - 1];
      point.position += interval * point.velocity;
      point.acceleration.setZero();
      point.orientation *= quaternion_exp(Eigen::Vector3d(interval * point.angular_velocity));
      point.angular_acceleration.setZero();
    }
    return true;
  }
  // End of the time limit of this tick; the time of prepare() counts.
  [[nodiscard]] Clock::time_point deadline_from(Clock::time_point now) const {
    const Settings& s = settings();
    const double limit = s.time_limit > 0.0 ? s.time_limit : 0.5 * s.period;
    return now - prepare_time_ +
           std::chrono::duration_cast<Clock::duration>(
               std::chrono::duration<double>(std::min(limit, 1e6)));
  }

  [[nodiscard]] bool plan_in_force(double time) const {
    return plan_.in_force(time, settings().max_plan_age);
  }
  // Discards the plan after an interruption, because no actuator has followed it.
  void forget_old_plan(double time) {
    if (!plan_.exists() || plan_in_force(time)) return;
    plan_.drop();
    cold_ = true;
  }
  // Solves from `x`. Returns false if there is no plan that is credible.
  [[nodiscard]] bool make_plan(const State& x, Clock::time_point deadline) {
    result_.report = solver_.feedback(x, deadline);
    return optimal_control::has_plan(result_.report.status) && plan_is_credible();
  }
  // Returns false if a state of the plan is not credible or moves more than a kilometre away. Bad
  // input then caused the plan, and single iterations do not recover from it.
  [[nodiscard]] bool plan_is_credible() const {
    for (int k = 1; k <= solver_.horizon(); ++k) {
      const State& x = solver_.state(k);
      if (!(level_.is_credible(solver_.problem(), x) &&
            (x.body.position - inputs_.body.position).norm() <= 1e3))
        return false;
    }
    return true;
  }
  // Checks whether a cold start fits into the same tick without making it much longer.
  [[nodiscard]] bool can_start_again(Clock::time_point deadline) const {
    const auto needed = std::chrono::duration_cast<Clock::duration>(
        std::chrono::duration<double, std::micro>(2.0 * solver_.report().prepare_us));
    return 4 * solver_.report().passes <= settings().solver.program.max_passes &&
           Clock::now() + needed < deadline;
  }
  // Cold start: sets the state of every node to `x` and prepares the solver.
  void start_cold(const State& x) {
    solver_.reset(x);
    plan_.reset(x);
    (void)solver_.prepare();
  }

  const Result& publish(const Command& command, NmpcStatus status) {
    static_cast<Command&>(result_) = command;
    result_.status = status;
    result_.on_ground = inputs_.contact.on_ground;
    return result_;
  }
  const Result& use_last_plan(double time, NmpcStatus status);
  const Result& continue_last_plan(double time, NmpcStatus status);

  Level level_;
  Solver solver_;
  detail::PlanInputs inputs_;
  typename Level::Plan plan_;
  NmpcStatus plan_status_ = NmpcStatus::no_plan;
  Result result_;
  Clock::duration prepare_time_{};
  double last_in_air_ = -std::numeric_limits<double>::infinity();  // [s]
  int failures_ = 0;
  bool cold_ = true, prepared_ = false;
};

template <typename Level>
RecedingHorizonController<Level>::RecedingHorizonController(const Vehicle<Level::rotors>& vehicle,
                                                            const Settings& settings,
                                                            const Term& term)
    : level_(validated(vehicle), validated(settings), term),
      solver_(level_.problem(), settings.solver) {
  inputs_.points.resize(static_cast<std::size_t>(solver_.horizon()) + 1);
  (void)publish(level_.safe_command(solver_.problem(), inputs_.contact), NmpcStatus::no_plan);
}

template <typename Level>
RecedingHorizonController<Level>::RecedingHorizonController(const Vehicle<Level::rotors>& vehicle)
    : RecedingHorizonController(vehicle, Level::settings_for(vehicle)) {}

template <typename Level>
void RecedingHorizonController<Level>::set_settings(const Settings& settings) {
  validate(settings);
  require(settings.solver == this->settings().solver, "ControllerSettings.solver", "another",
          "as at construction");
  level_.set_settings(settings, solver_.problem());
  prepared_ = false;
}

template <typename Level>
bool RecedingHorizonController<Level>::begin(double time, const ContactEstimate& contact) {
  prepared_ = false;
  if (!std::isfinite(time)) return false;
  forget_old_plan(time);
  if (is_plausible(contact)) inputs_.contact = contact;
  if (!inputs_.contact.on_ground || !(time >= last_in_air_)) last_in_air_ = time;
  inputs_.on_ground_for = time - last_in_air_;
  return true;
}

template <typename Level>
optimal_control::PrepareStatus RecedingHorizonController<Level>::finish(double time) {
  if (!continue_reference()) return optimal_control::PrepareStatus::failed;
  for (ReferencePoint& point : inputs_.points)
    for (const HalfSpace& h : point.inside) point = held_inside(h, point);
  if (inputs_.contact.blocked)
    for (ReferencePoint& point : inputs_.points)
      point = inputs_.contact.on_ground ? standing_at(inputs_.body, point)
                                        : in_front_of(*inputs_.contact.blocked, point);
  level_.set_nodes(inputs_, solver_.problem());
  prepared_ = true;
  if (cold_)
    return optimal_control::PrepareStatus::prepared;  // feedback() does the rest, from the
                                                      // measured state
  // The controller itself commands a part of the state at `time`. With this part in the
  // linearisation point, the constraints of the first node are exact, and the command satisfies
  // them.
  if (!solver_.interrupted())
    solver_.set_guess(0, level_.guess(solver_, plan_, time), solver_.input(0));
  return solver_.prepare();
}

template <typename Level>
auto RecedingHorizonController<Level>::feedback(double time, const BodyStated& measured,
                                                const Actuators& actuators) noexcept
    -> const Result& {
  if (!std::isfinite(time) || !is_finite(measured) || !Level::is_usable(actuators))
    return hold(time);
  inputs_.body = measured;
  inputs_.body.orientation.normalize();
  if (!prepared_) return continue_last_plan(time, NmpcStatus::solver_failed);
  const auto deadline = deadline_from(Clock::now());
  forget_old_plan(time);
  // With this measurement, not with the last one.
  if (cold_) level_.set_nodes(inputs_, solver_.problem());
  const State x = level_.initial_state(solver_, plan_, time, inputs_, actuators);
  if (cold_) start_cold(x);
  prepared_ = false;
  bool credible = make_plan(x, deadline);
  if (!credible && optimal_control::has_plan(result_.report.status)) {
    solver_.restore_previous();
    if (!cold_ && can_start_again(deadline)) {
      start_cold(x);
      plan_.drop();  // start_cold() has overwritten it
      credible = make_plan(x, deadline);
      if (!credible && optimal_control::has_plan(result_.report.status)) solver_.restore_previous();
    }
    if (!credible) result_.report.status = optimal_control::SolveStatus::failed;
  }
  if (!credible) return continue_last_plan(time, NmpcStatus::solver_failed);
  if (!solver_.has_step() && plan_in_force(time))
    return use_last_plan(time, NmpcStatus::approximate);
  failures_ = 0;
  cold_ = false;
  plan_.begin(solver_, time);
  plan_status_ = (result_.report.status == optimal_control::SolveStatus::iterated ||
                  result_.report.status == optimal_control::SolveStatus::converged) &&
                         !inputs_.reference_ends
                     ? NmpcStatus::solved
                     : NmpcStatus::approximate;
  return publish(level_.command(solver_, plan_, time), plan_status_);
}

template <typename Level>
auto RecedingHorizonController<Level>::continue_last_plan(double time, NmpcStatus status)
    -> const Result& {
  prepared_ = false;
  if (++failures_ >= settings().failures_before_reset) cold_ = true;
  return use_last_plan(time, status);
}

template <typename Level>
auto RecedingHorizonController<Level>::use_last_plan(double time, NmpcStatus status)
    -> const Result& {
  if (plan_in_force(time) && plan_.age(time) >= 0.0)
    return publish(level_.command(solver_, plan_, time), status);
  plan_.drop();
  cold_ = true;
  return publish(level_.safe_command(solver_.problem(), inputs_.contact), NmpcStatus::no_plan);
}

/// The controller of the wrench level: the plan's state has the wrench of the actuators, as in the
/// paper. Its result is the wrench and the rate of the wrench that an Allocation turns into
/// commands. The geometry must give every wrench.
///
/// `SolverOf` solves the problem. MultipleShooting does one real-time iteration a tick;
/// SingleShooting lets NLopt alone solve the whole problem in each tick, which takes a hundred
/// times as long. `Term` is the type of a term of your own in the prediction, see OwnTerm.
template <int Rotors, template <typename> class SolverOf = optimal_control::MultipleShooting,
          typename Term = NoOwnTerm>
class Nmpc : public RecedingHorizonController<detail::WrenchLevel<Rotors, SolverOf, Term>> {
 public:
  using RecedingHorizonController<
      detail::WrenchLevel<Rotors, SolverOf, Term>>::RecedingHorizonController;
};
template <int Rotors>
Nmpc(const Vehicle<Rotors>&) -> Nmpc<Rotors>;
template <int Rotors, typename Term = NoOwnTerm>
Nmpc(const Vehicle<Rotors>&, const NmpcSettings&, const Term& = Term())
    -> Nmpc<Rotors, optimal_control::MultipleShooting, Term>;

/// The controller of the actuator level: the plan's state has the thrust and the tilt angle of each
/// rotor. Its result is the speed and the tilt angle to send to each rotor, without an Allocation.
/// The commands invert the lags of the actuators. For any vehicle that can hover or drive: tilting
/// or fixed rotors, any rank of the allocation matrix.
///
/// A vehicle that cannot give every force without leaning, such as a quadrotor with fixed rotors,
/// leans as the reference's acceleration and the external force require. The heading of the
/// reference stays.
template <int Rotors>
class ActuatorNmpc : public RecedingHorizonController<detail::ActuatorLevel<Rotors>> {
 public:
  using RecedingHorizonController<detail::ActuatorLevel<Rotors>>::RecedingHorizonController;
};
template <int Rotors>
ActuatorNmpc(const Vehicle<Rotors>&) -> ActuatorNmpc<Rotors>;
template <int Rotors>
ActuatorNmpc(const Vehicle<Rotors>&, const ActuatorNmpcSettings&) -> ActuatorNmpc<Rotors>;

}  // namespace tilt_ropter
