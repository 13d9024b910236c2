// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/actuator_constraints.hpp>
#include <tilt_ropter/control/detail/own_term.hpp>
#include <tilt_ropter/control/detail/plan_in_force.hpp>
#include <tilt_ropter/control/detail/reference_wrench.hpp>
#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <algorithm>
#include <cstddef>
#include <type_traits>
#include <utility>

namespace tilt_ropter::detail {

/// The wrench level of RecedingHorizonController: the wrench is a part of the plan's state, its
/// rate is the input. No function but the constructor and set_settings() throws or allocates.
template <int Rotors, template <typename> class SolverOf = optimal_control::MultipleShooting,
          typename OwnTermType = NoOwnTerm>
class WrenchLevel {
 public:
  static constexpr int rotors = Rotors;
  using Term = OwnTermType;
  static constexpr bool has_term = !std::is_same_v<Term, NoOwnTerm>;
  using Problem =
      std::conditional_t<has_term, ProblemWithTerm<Rotors, Term>, WheeledFlightProblem<Rotors>>;
  using Solver = SolverOf<Problem>;
  using Plan = WrenchPlan<Solver>;
  using Settings = NmpcSettings;
  using Command = WrenchCommand;
  /// The plan does not start from measured actuators, but from the commanded wrench.
  struct Actuators {};
  static constexpr Actuators without_actuators{};

  /// Throws std::invalid_argument if parameters or settings are out of range, or if the geometry
  /// cannot give every wrench.
  WrenchLevel(const Vehicle<Rotors>& vehicle, const Settings& settings, const Term& term)
      : term_(term),
        settings_(settings),
        actuators_(vehicle, settings.problem.bounds.tilt_rate_fraction),
        reference_wrench_(vehicle, settings.ground) {}

  [[nodiscard]] static Settings settings_for(const Vehicle<Rotors>& vehicle) {
    return nmpc_settings(vehicle);
  }
  [[nodiscard]] static bool is_usable(const Actuators&) { return true; }
  [[nodiscard]] const Settings& settings() const { return settings_; }
  [[nodiscard]] double mass() const { return reference_wrench_.body().mass; }

  /// The problem that the solver solves.
  [[nodiscard]] Problem problem() const {
    WheeledFlightProblem<Rotors> plain(reference_wrench_.body(), settings_.problem,
                                       constraints(settings_));
    if constexpr (has_term)
      return Problem(std::move(plain), term_);
    else
      return plain;
  }

  /// Changes the settings of this level and of `problem`. Throws std::invalid_argument, and changes
  /// nothing, if the problem cannot have the new settings.
  void set_settings(const Settings& settings, Problem& problem) {
    problem.set_settings(settings.problem, constraints(settings));
    settings_ = settings;
    reference_wrench_.set_settings(settings.ground);
  }

  /// See RecedingHorizonController::set_voltage().
  bool set_voltage(double voltage, Problem& problem) noexcept {
    if (!actuators_.set_voltage(voltage)) return false;
    problem.set_actuators(constraints(settings_));
    return true;
  }

  /// Sets references, external wrenches and ground contact of the nodes of `problem`.
  void set_nodes(const PlanInputs& inputs, Problem& problem) const {
    const double lifted = ground().lifted(inputs.body, inputs.points[0]);
    for (std::size_t k = 0; k < inputs.points.size(); ++k) {
      WheeledFlightNode& node = problem.node(static_cast<int>(k));
      const double ahead = settings_.problem.interval * static_cast<double>(k);
      const ReferencePoint followed = ground().apply(inputs.contact, inputs.body, ahead,
                                                     inputs.points[0], inputs.points[k], node);
      node.wrench_reference = {};
      switch (settings_.wrench_reference) {
        case WrenchReference::zero:
          break;
        case WrenchReference::hover:
          node.wrench_reference.force.z() =
              node.on_ground ? settings_.ground.down_force : mass() * gravity;
          break;
        case WrenchReference::inverse_dynamics:
          Wrenchd external = node.external;
          if constexpr (has_term) external = external + term_(node.reference).wrench;
          node.wrench_reference = reference_wrench_(followed, external, node.on_ground, lifted);
      }
    }
  }

  /// The state at `time` [s], from which the plan starts.
  [[nodiscard]] Stated initial_state(const Solver& solver, const Plan& plan, double time,
                                     const PlanInputs& inputs, const Actuators&) const {
    return {plan.exists() ? plan.wrench(solver, time)
                          : safe_command(solver.problem(), inputs.contact).wrench,
            ground().stopped(solver.problem().node(0), inputs.body)};
  }

  /// The first state of the solver, with the part of it that is known before the measurement at
  /// `time` [s].
  [[nodiscard]] Stated guess(const Solver& solver, const Plan& plan, double time) const {
    return {plan.wrench(solver, time), solver.state(0).body};
  }

  /// Returns false above ten times the bounds on body rate, force or torque: only bad input leads
  /// to such a state.
  [[nodiscard]] bool is_credible(const Problem& problem, const Stated& x) const {
    const NmpcBounds& b = problem.settings().bounds;
    const double force = std::max(largest(b.force_min), largest(b.force_max)),
                 torque = std::max(largest(b.torque_min), largest(b.torque_max));
    return x.body.angular_velocity.norm() <= 10.0 * largest(b.angular_velocity) &&
           x.wrench.force.norm() <= 10.0 * force && x.wrench.torque.norm() <= 10.0 * torque;
  }

  /// What the plan commands at `time` [s].
  [[nodiscard]] Command command(const Solver& solver, const Plan& plan, double time) const {
    return {plan.wrench(solver, time), unpacked(plan.planned_rate(solver, plan.age(time)))};
  }

  /// What is commanded without a plan.
  [[nodiscard]] Command safe_command(const Problem& problem, const ContactEstimate& contact) const {
    return {within(problem.settings().bounds, reference_wrench_.without_plan(contact)), {}};
  }

  /// See RecedingHorizonController::between_ticks(). `measured` has a unit quaternion.
  [[nodiscard]] Command correct(const Solver& solver, Plan& plan, double time,
                                const BodyStated& measured) const {
    const Stated x{plan.wrench(solver, time), ground().stopped(solver.problem().node(0), measured)};
    return {x.wrench, unpacked(plan.correct(solver, time, x))};
  }

 private:
  using Rate = typename Plan::Rate;

  [[nodiscard]] const GroundContact& ground() const { return reference_wrench_.ground(); }

  // No bounds if the settings switch them off.
  [[nodiscard]] ActuatorConstraints<Rotors> constraints(const Settings& settings) const {
    return settings.actuator_constraints
               ? actuators_.with(settings.problem.bounds.tilt_rate_fraction)
               : ActuatorConstraints<Rotors>();
  }

  [[nodiscard]] static Wrenchd unpacked(const Rate& rate) {
    return {{rate(0), rate(1), rate(2)}, {rate(3), rate(4), rate(5)}};
  }

  Term term_;
  Settings settings_;
  ActuatorConstraints<Rotors> actuators_;  // with the measured voltage
  ReferenceWrench<Rotors> reference_wrench_;
};

}  // namespace tilt_ropter::detail
