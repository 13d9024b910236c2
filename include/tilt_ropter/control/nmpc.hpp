// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/actuator_rows.hpp>
#include <tilt_ropter/control/ground_contact.hpp>
#include <tilt_ropter/control/nmpc_result.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
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

/// The Tilt-Ropter's controller (paper, Sec. Control): the wrench that tracks a reference in the
/// air and on the ground, one real-time iteration per call.
namespace tilt_ropter {

/// prepare(), then measure, then feedback(), at any rate. Whatever comes in, what goes out is
/// finite and within the bounds. What goes out when something is wrong, from the mildest on:
///
/// - The contact estimate is not finite, or a wrench of it is more than ten times the weight, or
///   that at a metre (a lost observer): the last one that was stands in for it, for as long as it
///   takes. Status solved.
/// - The measurement is not finite, or there is none to trust (a stale estimate, which the caller
///   sees: hold()): the last plan goes on. Status bad_state.
/// - The quadratic program is not solved in time (NmpcSettings.time_limit) or in so many passes:
///   the best plan so far is used, and the next tick goes on from there. Status approximate.
/// - There is no solution, as with a reference that is not finite: the last plan goes on. Status
///   solver_failed.
/// - The plan goes where no vehicle does, as after a measurement or a reference from far away: it
///   is made anew from cold in the same call, and if that is no better, the safe wrench goes out.
///   Where there is no time for it, the last plan goes on. Status solver_failed.
/// - So often in a row (failures_before_reset): the next solve starts cold, from the measured state
///   and the wrench commanded last, which goes on if that fails, too.
/// - The last plan is older than max_plan_age, or there was none: the safe wrench. Status no_plan.
///   After an interruption as long as that, the next plan begins with it, too.
///
/// One good tick ends each of these. The safe wrench is hover against the external wrench known
/// last, or down_force in contact: it keeps level what is level and holds no position, so a caller
/// without measurements has to take the thrust away before long.
///
/// A tick takes at most 64 KB of stack in an optimised program.
template <int Rotors>
class Nmpc {
 public:
  using Problem = WheeledFlightProblem<Rotors>;

  /// Throws std::invalid_argument for parameters or settings out of range, and for a geometry that
  /// cannot give every wrench (see control_authority()). Allocates; the functions below allocate
  /// nothing outside NLopt and never throw. When an actuator fails in flight, make another one for
  /// the vehicle that is left.
  Nmpc(const Vehicle<Rotors>& vehicle, const NmpcSettings& settings);

  /// With the settings that fly this vehicle without tuning.
  explicit Nmpc(const Vehicle<Rotors>& vehicle);

  /// Takes other settings between two ticks, without a cold start: weights, bounds, prices, what
  /// is done on the ground, limits on time. Only `solver` and the number and length of intervals
  /// stay as they were made. The next prepare() goes by them; after one, feedback() fails until
  /// there is another. Allocates nothing, but with TerminalCost::riccati. Throws
  /// std::invalid_argument, and changes nothing, for settings out of range.
  void set_settings(const NmpcSettings& settings);

  /// Everything that can be done before the measurement of time `time` [s] comes: reference,
  /// linearisation, factorisation. `reference` is any callable that returns a ReferencePoint for a
  /// time and does not throw; `contact` is ContactEstimator's or the caller's own. With a time that
  /// is not finite nothing is prepared (rejected), and feedback() fails.
  template <typename Reference>
  [[nodiscard]] PrepareStatus prepare(double time, const Reference& reference,
                                      const ContactEstimate& contact) noexcept {
    const auto start = SolverClock::now();
    begin_to_prepare(time, contact);
    if (!std::isfinite(time)) return PrepareStatus::rejected;
    for (std::size_t k = 0; k < points_.size(); ++k)
      points_[k] = reference(time + settings_.problem.interval * static_cast<double>(k));
    const PrepareStatus status = finish_preparing(time);
    prepare_time_ = SolverClock::now() - start;
    return status;
  }

  /// The wrench to command from the body state measured at `time` [s]. Needs a prepare() before.
  /// After a cold start or repeated failure this one call does the work of prepare(), too.
  [[nodiscard]] const NmpcResult& feedback(double time, const BodyState<>& measured) noexcept;

  /// Between two ticks, as from an inner loop at 1 kHz: the wrench for the body state measured at
  /// `time` [s]. Its rate is that of the plan, corrected by the gains of the last factorisation for
  /// the deviation from where the plan should be by now, within the bounds; the wrench follows from
  /// the rates since the last call, and the next tick starts from it. Takes microseconds. With a
  /// state that is not finite, or without a plan that is in force: as hold(), but not counted as a
  /// failure.
  [[nodiscard]] const NmpcResult& between_ticks(double time, const BodyState<>& measured) noexcept;

  /// Instead of feedback(), where there is no state to trust at `time` [s].
  [[nodiscard]] const NmpcResult& hold(double time) noexcept;

  /// Takes the measured `voltage` of the battery [V]: plans from the next prepare() on keep to the
  /// thrusts that it leaves, where NmpcSettings::actuator_rows is set. Returns whether
  /// voltage_ratio() accepts it; if not, nothing changes.
  bool set_voltage(double voltage) noexcept {
    if (!actuators_.set_voltage(voltage)) return false;
    (void)solver_.problem().set_voltage(voltage);
    return true;
  }

  [[nodiscard]] const NmpcResult& result() const { return result_; }  ///< of the last call
  /// What the plan goes by: that of prepare(), or an earlier one where that was not plausible.
  [[nodiscard]] const ContactEstimate& contact() const { return contact_; }
  [[nodiscard]] const MultipleShooting<Problem>& solver() const { return solver_; }
  [[nodiscard]] const NmpcSettings& settings() const { return settings_; }

 private:
  using Actuators = ActuatorRows<Rotors>;
  using Rate = Eigen::Matrix<double, 6, 1>;

  // What prepare() does before it looks at the reference, and after.
  void begin_to_prepare(double time, const ContactEstimate& contact);
  PrepareStatus finish_preparing(double time);

  [[nodiscard]] bool is_plausible(const ContactEstimate& contact) const;

  // When this tick has to be over, prepare() counted.
  [[nodiscard]] SolverClock::time_point deadline_from(SolverClock::time_point now) const;

  [[nodiscard]] bool plan_in_force(double time) const;
  // After an interruption: nobody has followed it.
  void forget_old_plan(double time);

  [[nodiscard]] bool make_plan(const State<>& x, SolverClock::time_point deadline);

  // In the same tick, which must not get much longer by it.
  [[nodiscard]] bool can_start_again(SolverClock::time_point deadline) const;

  /// A plan from anywhere begins with the whole horizon at `x`.
  void start_cold(const State<>& x);

  /// False if the plan turns or pushes ten times as much as the bounds allow, or goes a kilometre
  /// away: bad input has led it astray, from where one iteration at a time does not find back.
  [[nodiscard]] bool plan_is_credible() const;

  void set_nodes();

  void set_node(double ahead, const ReferencePoint& point, WheeledFlightNode& node) const;

  [[nodiscard]] int interval_at(double age) const {
    return std::min(static_cast<int>(age / settings_.problem.interval), solver_.horizon() - 1);
  }

  /// Wrench of the last plan `age` [s] after its measurement: linear in each interval.
  [[nodiscard]] Wrench<> planned_wrench(double age) const;

  /// What has been commanded by now, while a plan is in force.
  [[nodiscard]] Wrench<> wrench_at(double time) const;

  [[nodiscard]] Wrench<> within_bounds(const Wrench<>& wrench) const;
  [[nodiscard]] Rate rate_within_bounds(const Rate& rate) const;

  /// Without a plan: carry the weight and what else is known to pull, turn nothing; on the ground,
  /// almost no thrust.
  [[nodiscard]] Wrench<> safe_wrench() const;

  void set_command(double age);

  const NmpcResult& continue_last_plan(double time, NmpcStatus status);
  const NmpcResult& hand_out_last_plan(double time, NmpcStatus status);

  NmpcSettings settings_;
  RigidBodyParameters body_;
  Actuators actuators_;
  GroundContact ground_;
  ReferenceWrench<Rotors> reference_wrench_;
  MultipleShooting<Problem> solver_;
  std::vector<ReferencePoint> points_;
  BodyState<> body_state_;   // the last good measurement
  ContactEstimate contact_;  // the last good one
  NmpcResult result_;
  double plan_time_ = 0.0;
  State<> plan_start_;  // at plan_time_
  typename MultipleShooting<Problem>::Gain gain_ = MultipleShooting<Problem>::Gain::Zero();
  NmpcStatus plan_status_ = NmpcStatus::no_plan;
  // By between_ticks() since the last tick:
  bool corrected_ = false;
  double corrected_time_ = 0.0;
  Wrench<> corrected_wrench_;
  Rate corrected_rate_ = Rate::Zero();
  SolverClock::duration prepare_time_{};
  int failures_ = 0;
  bool prepared_ = false, has_plan_ = false, cold_ = true;
};

template <int Rotors>
Nmpc<Rotors>::Nmpc(const Vehicle<Rotors>& vehicle, const NmpcSettings& settings)
    : settings_(validated(settings)),
      body_(vehicle.body),
      actuators_(vehicle, settings.actuators),
      ground_(vehicle.body, undercarriage(vehicle), settings.ground),
      reference_wrench_(vehicle, settings.ground),
      solver_(Problem(vehicle.body, settings.problem,
                      settings.actuator_rows ? actuators_ : Actuators()),
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
  solver_.problem().set_settings(
      settings.problem, settings.actuator_rows ? actuators_.with(settings.actuators) : Actuators());
  settings_ = settings;
  ground_.set_settings(settings.ground);
  reference_wrench_.set_settings(settings.ground);
  prepared_ = false;
}

template <int Rotors>
const NmpcResult& Nmpc<Rotors>::feedback(double time, const BodyState<>& measured) noexcept {
  if (!std::isfinite(time) || !is_finite(measured))
    return continue_last_plan(time, NmpcStatus::bad_state);
  body_state_ = measured;
  body_state_.orientation.normalize();
  if (!prepared_) return continue_last_plan(time, NmpcStatus::solver_failed);
  const auto deadline = deadline_from(SolverClock::now());
  forget_old_plan(time);
  if (cold_) set_nodes();  // with this measurement, not the last
  State<> x;
  x.body = body_state_;
  if (solver_.problem().node(0).on_ground) ground_.stop_held(x.body);
  x.wrench = has_plan_ ? wrench_at(time) : safe_wrench();
  if (cold_) start_cold(x);
  prepared_ = false;
  bool credible = make_plan(x, deadline);
  if (!credible && tilt_ropter::has_plan(result_.report.status)) {
    solver_.take_back();
    if (!cold_ && can_start_again(deadline)) {
      start_cold(x);
      has_plan_ = false;  // it has been written over
      credible = make_plan(x, deadline);
      if (!credible && tilt_ropter::has_plan(result_.report.status)) solver_.take_back();
    }
    if (!credible) result_.report.status = SolveStatus::failed;
  }
  if (!credible) return continue_last_plan(time, NmpcStatus::solver_failed);
  if (!solver_.has_step() && plan_in_force(time))
    return hand_out_last_plan(time, NmpcStatus::approximate);
  failures_ = 0;
  cold_ = false;
  has_plan_ = true;
  plan_time_ = time;
  plan_start_ = solver_.state(0);
  gain_ = solver_.gain(0);
  corrected_ = false;
  plan_status_ =
      result_.report.status == SolveStatus::iterated ? NmpcStatus::solved : NmpcStatus::approximate;
  result_.status = plan_status_;
  set_command(0.0);
  return result_;
}

template <int Rotors>
const NmpcResult& Nmpc<Rotors>::between_ticks(double time, const BodyState<>& measured) noexcept {
  if (!plan_in_force(time) || !is_finite(measured))
    return hand_out_last_plan(time, NmpcStatus::bad_state);
  const double age = std::max(time - plan_time_, 0.0), interval = settings_.problem.interval;
  const Problem& problem = solver_.problem();
  const int k = interval_at(age);
  State<> x;
  x.body = measured;
  x.body.orientation.normalize();
  if (problem.node(0).on_ground) ground_.stop_held(x.body);  // as in feedback()
  x.wrench = wrench_at(time);
  const State<> expected = problem.step_for(
      age - interval * k, k, k == 0 ? plan_start_ : solver_.state(k), solver_.input(k));
  corrected_ = true;
  corrected_time_ = time;
  corrected_wrench_ = x.wrench;
  corrected_rate_ =
      rate_within_bounds(Rate(solver_.input(k) + gain_ * problem.difference(x, expected)));
  result_.wrench = x.wrench;
  result_.rate = {corrected_rate_.head<3>(), corrected_rate_.tail<3>()};
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
PrepareStatus Nmpc<Rotors>::finish_preparing(double time) {
  set_nodes();
  prepared_ = true;
  if (cold_) return PrepareStatus::prepared;  // feedback() does the rest, from where it measures
  // The wrench at `time` is the controller's own. Linearised there, the first node's rows are
  // exact, and what is commanded keeps to them.
  if (!solver_.goes_on()) {
    State<> first = solver_.state(0);
    first.wrench = wrench_at(time);
    solver_.set_guess(0, first, solver_.input(0));
  }
  return solver_.prepare();
}

template <int Rotors>
bool Nmpc<Rotors>::is_plausible(const ContactEstimate& contact) const {
  const double most = 10.0 * body_.mass * gravity;
  const auto is_small = [most](const Wrench<>& w) {  // not a comparison that NaN passes
    return w.force.norm() <= most && w.torque.norm() <= most;
  };
  return is_finite(contact) && is_small(contact.disturbance) && is_small(contact.rolling);
}

template <int Rotors>
SolverClock::time_point Nmpc<Rotors>::deadline_from(SolverClock::time_point now) const {
  const double limit = settings_.time_limit > 0.0 ? settings_.time_limit : 0.5 * settings_.period;
  return now - prepare_time_ +
         std::chrono::duration_cast<SolverClock::duration>(
             std::chrono::duration<double>(std::min(limit, 1e6)));
}

template <int Rotors>
bool Nmpc<Rotors>::plan_in_force(double time) const {
  return has_plan_ && std::abs(time - plan_time_) <= settings_.max_plan_age;
}

template <int Rotors>
void Nmpc<Rotors>::forget_old_plan(double time) {
  if (has_plan_ && !plan_in_force(time)) {
    has_plan_ = false;
    cold_ = true;
  }
}

template <int Rotors>
bool Nmpc<Rotors>::make_plan(const State<>& x, SolverClock::time_point deadline) {
  result_.report = solver_.feedback(x, deadline);
  return tilt_ropter::has_plan(result_.report.status) && plan_is_credible();
}

template <int Rotors>
bool Nmpc<Rotors>::can_start_again(SolverClock::time_point deadline) const {
  const auto needed = std::chrono::duration_cast<SolverClock::duration>(
      std::chrono::duration<double, std::micro>(2.0 * solver_.report().prepare_us));
  return 4 * solver_.report().passes <= settings_.solver.program.max_passes &&
         SolverClock::now() + needed < deadline;
}

template <int Rotors>
void Nmpc<Rotors>::start_cold(const State<>& x) {
  solver_.reset(x);
  plan_start_ = x;
  corrected_ = false;
  (void)solver_.prepare();
}

template <int Rotors>
bool Nmpc<Rotors>::plan_is_credible() const {
  const NmpcBounds& b = settings_.problem.bounds;
  const double turn = 10.0 * b.angular_velocity.maxCoeff(),
               force = 10.0 * b.force_min.cwiseAbs().cwiseMax(b.force_max.cwiseAbs()).maxCoeff(),
               torque = 10.0 * b.torque_min.cwiseAbs().cwiseMax(b.torque_max.cwiseAbs()).maxCoeff();
  for (int k = 1; k <= solver_.horizon(); ++k) {
    const State<>& x = solver_.state(k);
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
  const ReferencePoint followed = ground_.apply(contact_, body_state_, ahead, point, node);
  if (settings_.wrench_feedforward) {
    node.wrench_reference = reference_wrench_(followed, node.external, node.on_ground);
  } else {
    node.wrench_reference = {};
    node.wrench_reference.force.z() =
        node.on_ground ? settings_.ground.down_force : body_.mass * gravity;
  }
}

template <int Rotors>
Wrench<> Nmpc<Rotors>::planned_wrench(double age) const {
  const double interval = settings_.problem.interval;
  const double clamped = std::min(std::max(age, 0.0), interval * solver_.horizon());
  const int k = interval_at(clamped);
  const Wrench<>& start = k == 0 ? plan_start_.wrench : solver_.state(k).wrench;
  const Rate& rate = solver_.input(k);
  const double t = clamped - interval * k;
  return within_bounds({start.force + t * rate.head<3>(), start.torque + t * rate.tail<3>()});
}

template <int Rotors>
Wrench<> Nmpc<Rotors>::wrench_at(double time) const {
  if (!corrected_) return planned_wrench(time - plan_time_);
  const double t = std::max(time - corrected_time_, 0.0);
  return within_bounds({corrected_wrench_.force + t * corrected_rate_.head<3>(),
                        corrected_wrench_.torque + t * corrected_rate_.tail<3>()});
}

template <int Rotors>
Wrench<> Nmpc<Rotors>::within_bounds(const Wrench<>& wrench) const {
  const NmpcBounds& b = settings_.problem.bounds;
  return {wrench.force.cwiseMax(b.force_min).cwiseMin(b.force_max),
          wrench.torque.cwiseMax(b.torque_min).cwiseMin(b.torque_max)};
}

template <int Rotors>
typename Nmpc<Rotors>::Rate Nmpc<Rotors>::rate_within_bounds(const Rate& rate) const {
  Rate most;
  most << settings_.problem.bounds.force_rate, settings_.problem.bounds.torque_rate;
  return rate.cwiseMax(-most).cwiseMin(most);
}

template <int Rotors>
Wrench<> Nmpc<Rotors>::safe_wrench() const {
  Wrench<> wrench;
  if (contact_.on_ground) {
    wrench.force.z() = settings_.ground.down_force;
  } else {
    wrench = {-contact_.disturbance.force, -contact_.disturbance.torque};
    wrench.force.z() += body_.mass * gravity;
  }
  return within_bounds(wrench);
}

template <int Rotors>
void Nmpc<Rotors>::set_command(double age) {
  result_.wrench = planned_wrench(age);
  const Rate rate = rate_within_bounds(solver_.input(interval_at(age)));
  result_.rate = {rate.head<3>(), rate.tail<3>()};
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
  const double age = time - plan_time_;
  if (has_plan_ && age >= 0.0 && age <= settings_.max_plan_age) {
    set_command(age);
    if (corrected_) result_.wrench = wrench_at(time);
    result_.status = status;
  } else {
    has_plan_ = false;
    cold_ = true;
    result_.wrench = safe_wrench();
    result_.rate = {};
    result_.on_ground = contact_.on_ground;
    result_.status = NmpcStatus::no_plan;
  }
  return result_;
}

}  // namespace tilt_ropter
