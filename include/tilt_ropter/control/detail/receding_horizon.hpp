// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/reference.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

/// The part of a controller that does not depend on what it commands: one real-time iteration per
/// tick, its time limit, and the reactions to faults. Nmpc and ActuatorNmpc are built on it; Nmpc
/// describes the reactions.
namespace tilt_ropter::detail {

/// Base class of the controller `Level`, which has these private members, and this class as a
/// friend:
///
///     const Settings& settings() const;      // period, time_limit, max_plan_age, solver, ...
///     void set_nodes();                      // from points_, contact_ and body_state_
///     State initial_state(double time);      // of the plan, for body_state_
///     void set_guess(double time, State&);   // the known part of the first state, before it
///     bool is_credible(const State&) const;  // false: only bad input leads to such a state
///     void set_command(double age);          // writes the command of the plan to result_
///     void set_old_command(double time);     // the same for a plan from an earlier measurement
///     void set_safe_command();
///
/// `Plan` is derived from PlanTime. No function allocates or throws after construction.
/// `Solver` is optimal_control::MultipleShooting of the problem, or has its functions for a loop.
template <typename Level, typename Solver, typename Plan, typename Result>
class RecedingHorizon {
 protected:
  using State = typename Solver::State;
  using Clock = optimal_control::SolverClock;

  template <typename Problem>
  RecedingHorizon(Problem problem, const optimal_control::SolverSettings& settings,
                  const GroundContact& ground, double mass)
      : ground_(ground),
        solver_(std::move(problem), settings),
        points_(static_cast<std::size_t>(solver_.horizon()) + 1),
        mass_(mass) {}

  // The part of prepare() before the reference is evaluated.
  void begin(double time, const ContactEstimate& contact) {
    prepared_ = false;
    if (!std::isfinite(time)) return;
    forget_old_plan(time);
    if (is_plausible(contact)) contact_ = contact;
  }

  // The part of prepare() after it.
  optimal_control::PrepareStatus finish(double time) {
    if (!continue_reference()) return optimal_control::PrepareStatus::failed;
    level().set_nodes();
    prepared_ = true;
    if (cold_)
      return optimal_control::PrepareStatus::prepared;  // feedback() does the rest, from the
                                                        // measured state
    // The controller itself commands a part of the state at `time`. With this part in the
    // linearisation point, the constraints of the first node are exact, and the command satisfies
    // them.
    if (!solver_.interrupted()) {
      State first = solver_.state(0);
      level().set_guess(time, first);
      solver_.set_guess(0, first, solver_.input(0));
    }
    return solver_.prepare();
  }

  // The result of feedback() for the measurement body_state_ at `time`.
  const Result& plan_for(double time) {
    if (!prepared_) return continue_last_plan(time, NmpcStatus::solver_failed);
    const auto deadline = deadline_from(Clock::now());
    forget_old_plan(time);
    if (cold_) level().set_nodes();  // with this measurement, not with the last one
    const State x = level().initial_state(time);
    if (cold_) start_cold(x);
    prepared_ = false;
    bool credible = make_plan(x, deadline);
    if (!credible && optimal_control::has_plan(result_.report.status)) {
      solver_.restore_previous();
      if (!cold_ && can_start_again(deadline)) {
        start_cold(x);
        plan_.drop();  // start_cold() has overwritten it
        credible = make_plan(x, deadline);
        if (!credible && optimal_control::has_plan(result_.report.status))
          solver_.restore_previous();
      }
      if (!credible) result_.report.status = optimal_control::SolveStatus::failed;
    }
    if (!credible) return continue_last_plan(time, NmpcStatus::solver_failed);
    if (!solver_.has_step() && plan_in_force(time))
      return hand_out_last_plan(time, NmpcStatus::approximate);
    failures_ = 0;
    cold_ = false;
    plan_.begin(solver_, time);
    plan_status_ = (result_.report.status == optimal_control::SolveStatus::iterated ||
                    result_.report.status == optimal_control::SolveStatus::converged) &&
                           !reference_ends_
                       ? NmpcStatus::solved
                       : NmpcStatus::approximate;
    result_.status = plan_status_;
    level().set_command(0.0);
    return result_;
  }

  const Result& continue_last_plan(double time, NmpcStatus status) {
    prepared_ = false;
    if (++failures_ >= level().settings().failures_before_reset) cold_ = true;
    return hand_out_last_plan(time, status);
  }

  const Result& hand_out_last_plan(double time, NmpcStatus status) {
    const double age = plan_.age(time);
    if (plan_.exists() && age >= 0.0 && age <= level().settings().max_plan_age) {
      level().set_old_command(time);
      result_.status = status;
    } else {
      plan_.drop();
      cold_ = true;
      level().set_safe_command();
      result_.on_ground = contact_.on_ground;
      result_.status = NmpcStatus::no_plan;
    }
    return result_;
  }

  [[nodiscard]] bool plan_in_force(double time) const {
    return plan_.in_force(time, level().settings().max_plan_age);
  }

  GroundContact ground_;
  Solver solver_;
  std::vector<ReferencePoint> points_;
  BodyStated body_state_;    // last good measurement
  ContactEstimate contact_;  // last good estimate
  Result result_;
  Plan plan_;
  NmpcStatus plan_status_ = NmpcStatus::no_plan;
  Clock::duration prepare_time_{};
  bool prepared_ = false, reference_ends_ = false;

 private:
  [[nodiscard]] Level& level() { return static_cast<Level&>(*this); }
  [[nodiscard]] const Level& level() const { return static_cast<const Level&>(*this); }

  [[nodiscard]] bool is_plausible(const ContactEstimate& contact) const {
    const double most = 10.0 * mass_ * gravity;
    const auto is_small = [most](const Wrenchd& w) {  // false for NaN
      return w.force.norm() <= most && w.torque.norm() <= most;
    };
    return is_finite(contact) && is_small(contact.disturbance) && is_small(contact.rolling) &&
           is_small(contact.external);
  }

  // From the first point of the reference that is not finite on, the reference goes on straight
  // from the point before it. Returns false if not even the first point is finite.
  [[nodiscard]] bool continue_reference() {
    reference_ends_ = false;
    const double interval = level().settings().problem.interval;
    for (std::size_t k = 0; k < points_.size(); ++k) {
      ReferencePoint& point = points_[k];
      const double length = point.orientation.norm();
      if (!reference_ends_ && all_finite(point.position) && all_finite(point.velocity) &&
          all_finite(point.acceleration) && all_finite(point.angular_velocity) &&
          all_finite(point.angular_acceleration) && length > 0.1 && length < 10.0)
        continue;
      if (k == 0) return false;
      reference_ends_ = true;
      point = points_[k - 1];
      point.position += interval * point.velocity;
      point.acceleration.setZero();
      point.orientation *= quaternion_exp(Eigen::Vector3d(interval * point.angular_velocity));
      point.angular_acceleration.setZero();
    }
    return true;
  }

  // End of the time limit of this tick; the time of prepare() counts.
  [[nodiscard]] Clock::time_point deadline_from(Clock::time_point now) const {
    const auto& settings = level().settings();
    const double limit = settings.time_limit > 0.0 ? settings.time_limit : 0.5 * settings.period;
    return now - prepare_time_ +
           std::chrono::duration_cast<Clock::duration>(
               std::chrono::duration<double>(std::min(limit, 1e6)));
  }

  // Discards the plan after an interruption, because no actuator has followed it.
  void forget_old_plan(double time) {
    if (plan_.exists() && !plan_in_force(time)) {
      plan_.drop();
      cold_ = true;
    }
  }

  [[nodiscard]] bool make_plan(const State& x, Clock::time_point deadline) {
    result_.report = solver_.feedback(x, deadline);
    return optimal_control::has_plan(result_.report.status) && plan_is_credible();
  }

  // Checks whether a cold start fits into the same tick without making it much longer.
  [[nodiscard]] bool can_start_again(Clock::time_point deadline) const {
    const auto needed = std::chrono::duration_cast<Clock::duration>(
        std::chrono::duration<double, std::micro>(2.0 * solver_.report().prepare_us));
    return 4 * solver_.report().passes <= level().settings().solver.program.max_passes &&
           Clock::now() + needed < deadline;
  }

  // Cold start: sets the state of every node to `x` and prepares the solver.
  void start_cold(const State& x) {
    solver_.reset(x);
    plan_.reset(x);
    (void)solver_.prepare();
  }

  // Returns false if a state of the plan is not credible or moves more than a kilometre away. Bad
  // input then caused the plan, and single iterations do not recover from it.
  [[nodiscard]] bool plan_is_credible() const {
    for (int k = 1; k <= solver_.horizon(); ++k) {
      const State& x = solver_.state(k);
      if (!(level().is_credible(x) && (x.body.position - body_state_.position).norm() <= 1e3))
        return false;
    }
    return true;
  }

  double mass_;
  int failures_ = 0;
  bool cold_ = true;
};

}  // namespace tilt_ropter::detail
