// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/detail/thrust_inverse.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/control/detail/actuator_level_problem.hpp>
#include <tilt_ropter/control/detail/plan_in_force.hpp>
#include <tilt_ropter/control/detail/reference_wrench.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>

namespace tilt_ropter::detail {

/// The actuator level of RecedingHorizonController: thrusts and tilt angles are a part of the
/// plan's state, their rates are the input. No function but the constructor and set_settings()
/// throws or allocates.
///
/// The commands invert the first-order lags of rotors and servos: after one period with the
/// command, each speed and angle is where the plan has it. A servo with dead time receives the
/// command for the time at which it begins to act.
template <int Rotors>
class ActuatorLevel {
 public:
  static constexpr int rotors = Rotors;
  using Problem = ActuatorLevelProblem<Rotors>;
  using Solver = optimal_control::MultipleShooting<Problem>;
  using State = ActuatedState<Rotors>;
  using Plan = PlanInForce<Solver>;
  using Settings = ActuatorNmpcSettings;
  using Command = ActuatorCommand<Rotors>;
  struct Term {};                           ///< none
  using Actuators = ActuatorState<Rotors>;  ///< measured or modelled: the plan starts from them

  /// Throws std::invalid_argument if parameters or settings are out of range.
  ActuatorLevel(const Vehicle<Rotors>& vehicle, const Settings& settings, const Term&)
      : settings_(settings),
        vehicle_(vehicle),
        inverse_(vehicle),
        reference_wrench_(vehicle, settings.ground, inverse_.matrix()) {
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorParameters& rotor = rotor_parameters(vehicle, i);
      min_speed_[i] = speed_from_thrust(rotor.min_thrust, rotor);
      max_speed_[i] = speed_from_thrust(rotor.max_thrust, rotor);
    }
  }

  [[nodiscard]] static Settings settings_for(const Vehicle<Rotors>& vehicle) {
    return actuator_nmpc_settings(vehicle);
  }
  [[nodiscard]] static bool is_usable(const Actuators& actuators) {
    return all_finite(actuators.rotor_speed) && all_finite(actuators.tilt_angle);
  }
  [[nodiscard]] const Settings& settings() const { return settings_; }
  [[nodiscard]] double mass() const { return vehicle_.body.mass; }

  // As in WrenchLevel:
  [[nodiscard]] Problem problem() const { return Problem(vehicle_, settings_.problem); }
  void set_settings(const Settings& settings, Problem& problem) {
    problem.set_settings(settings.problem);
    settings_ = settings;
    reference_wrench_.set_settings(settings.ground);
  }

  bool set_voltage(double voltage, Problem& problem) noexcept {
    const std::optional<double> ratio = voltage_ratio(vehicle_.battery, voltage);
    if (!ratio) return false;
    Eigen::Matrix<double, Rotors, 1> most;
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const RotorParameters& rotor = rotor_parameters(vehicle_, k);
      const double thrust = max_thrust_at(rotor, *ratio);
      max_speed_[k] = speed_from_thrust(thrust, rotor);
      most(i) = vehicle_.rotors[k].effectiveness * thrust;
    }
    problem.set_max_thrust(most);
    return true;
  }
  void set_nodes(const PlanInputs& inputs, Problem& problem) const {
    const bool leans = inverse_.leans();
    const double interval = settings_.problem.interval,
                 lifted = ground().lifted(inputs.body, inputs.points[0]);
    for (std::size_t k = 0; k < inputs.points.size(); ++k) {
      Node& node = problem.node(static_cast<int>(k));
      ReferencePoint followed =
          ground().apply(inputs.contact, inputs.body, interval * static_cast<double>(k),
                         inputs.points[0], inputs.points[k], node);
      if (leans && !node.on_ground) {
        lean(followed, node.external);
        node.reference.orientation = followed.orientation;
      }
      steer(node);
      Wrenchd wrench = reference_wrench_(followed, node.external, node.on_ground, lifted);
      if (leans && node.on_ground) {
        lean_on_wheels(node, wrench);
        ground().hold_rotation(node.reference.orientation, node);
      }
      const auto thrusts =
          inverse_.within(wrench, problem.limits().min_thrust, problem.limits().max_thrust);
      for (int i = 0; i < Rotors; ++i) {
        node.lateral_reference(i) = thrusts(2 * i);
        node.vertical_reference(i) = thrusts(2 * i + 1);
      }
    }
    // A vehicle that drives by leaning needs its thrust there.
    constexpr double landing = 0.5;  // from the first wheel until all stand, on a slope [s]
    const bool stays = inputs.on_ground_for > landing && pushes() && problem.node(0).on_ground &&
                       problem.node(problem.horizon()).on_ground;
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
  [[nodiscard]] State initial_state(const Solver& solver, const Plan&, double,
                                    const PlanInputs& inputs, const Actuators& actuators) const {
    const ActuatorLimits<Rotors>& limits = solver.problem().limits();
    State x;
    x.body = ground().stopped(solver.problem().node(0), inputs.body);
    for (int i = 0; i < Rotors; ++i) {
      const double thrust = solver.problem().body().thrust(i, actuators.rotor_speed(i));
      x.thrust(i) = std::clamp(thrust, limits.min_thrust(i), limits.max_thrust(i));
      if (!vehicle_.rotors[static_cast<std::size_t>(i)].tilts) continue;
      x.tilt_angle(i) =
          std::clamp(actuators.tilt_angle(i), limits.min_angle(i), limits.max_angle(i));
    }
    return x;
  }
  [[nodiscard]] State guess(const Solver& solver, const Plan& plan, double time) const {
    State first = planned(solver, plan, plan.age(time));
    first.body = solver.state(0).body;
    return first;
  }
  [[nodiscard]] bool is_credible(const Problem& problem, const State& x) const {
    const ActuatorLimits<Rotors>& limits = problem.limits();
    bool credible = x.body.angular_velocity.norm() <=
                    10.0 * settings_.problem.bounds.angular_velocity.maxCoeff();
    for (int i = 0; i < Rotors; ++i)
      credible = credible && std::abs(x.thrust(i)) <= 10.0 * limits.max_thrust(i) + 1.0 &&
                 std::abs(x.tilt_angle(i)) <= 100.0;
    return credible;
  }
  [[nodiscard]] Command command(const Solver& solver, const Plan& plan, double time) const {
    const double age = plan.age(time), dead_time = vehicle_.servo.dead_time;
    const auto rates = [&](double at) -> const Input& {
      return solver.input(plan.at(solver, at).k);
    };
    Command given = command_at(solver.problem(), planned(solver, plan, age), rates(age));
    if (!(dead_time > 0.0)) return given;
    // A command to a servo acts after its dead time.
    const double ahead = age + dead_time;
    given.command.tilt_angle =
        with_lead(solver.problem(), planned(solver, plan, ahead), rates(ahead)).tilt_angle;
    return given;
  }
  [[nodiscard]] Command safe_command(const Problem& problem, const ContactEstimate& contact) const {
    return command_for(problem, reference_wrench_.without_plan(contact));
  }

  /// What commands the smallest thrusts for `wrench` (body frame), as far as the rotors can give
  /// it.
  [[nodiscard]] Command command_for(const Problem& problem, const Wrenchd& wrench) const noexcept {
    const ActuatorLimits<Rotors>& limits = problem.limits();
    const auto thrusts = inverse_.within(wrench, limits.min_thrust, limits.max_thrust);
    State x;
    for (int i = 0; i < Rotors; ++i) {
      const double lateral = thrusts(2 * i), vertical = thrusts(2 * i + 1);
      if (vehicle_.rotors[static_cast<std::size_t>(i)].tilts) {
        x.thrust(i) = std::sqrt(lateral * lateral + vertical * vertical);
        x.tilt_angle(i) = std::atan2(lateral, vertical);
      } else {
        x.thrust(i) = vertical;
      }
    }
    return command_at(problem, x, Input::Zero());
  }

 private:
  using Node = ActuatorLevelNode<Rotors>;
  using Input = typename Problem::Input;

  [[nodiscard]] const GroundContact& ground() const { return reference_wrench_.ground(); }

  // Thrusts and angles of the plan `age` [s] after its measurement, linear in each interval. The
  // body state is that of the start of the interval.
  [[nodiscard]] State planned(const Solver& solver, const Plan& plan, double age) const {
    const auto place = plan.within_horizon(solver, age);
    State x = place.start;
    for (int i = 0; i < Rotors; ++i) {
      x.thrust(i) += place.passed * solver.input(place.k)(i);
      x.tilt_angle(i) += place.passed * solver.input(place.k)(Rotors + i);
    }
    return x;
  }
  // Turns the attitude so that the force that `point` needs can be given without a torque.
  void lean(ReferencePoint& point, const Wrenchd& external) const {
    Eigen::Vector3d needed = vehicle_.body.mass * point.acceleration;
    needed.z() += vehicle_.body.mass * gravity;
    // The external force is constant in the body frame, so the attitude is found by iteration.
    for (int n = 0; n < 4; ++n) {
      const Eigen::Vector3d force = point.orientation.conjugate() * needed - external.force;
      Eigen::Vector3d given;
      put(square(inverse_.steady_forces()) * triple(force), given);
      const double length = force.norm() * given.norm();
      if (!(length > 1e-6)) return;
      point.orientation = (point.orientation * shortest_turn(given, force, length)).normalized();
    }
  }
  // True if the vehicle can push forward without leaning.
  [[nodiscard]] bool pushes() const { return inverse_.steady_forces()(0, 0) > 0.5; }
  // Pitches a vehicle on one axle that cannot push forward: the thrust is more than eight times the
  // forward force, so the pitch stays below 7.2 degrees.
  void lean_on_wheels(Node& node, Wrenchd& wrench) const {
    // The thrust grows smoothly with the force, otherwise the nose would have to jump up or down
    // where the force changes its sign.
    constexpr double least = 0.1;      // thrust / weight
    constexpr double per_force = 8.0;  // thrust / forward force, for large forces
    if (!ground().undercarriage() || !ground().undercarriage()->pitches || pushes()) return;
    const double forward = wrench.force.x(),
                 total =
                     std::hypot(std::max(wrench.force.z(), least * vehicle_.body.mass * gravity),
                                per_force * forward),
                 half = 0.5 * std::asin(forward / total);
    node.reference.orientation =
        node.reference.orientation * Eigen::Quaterniond(std::cos(half), 0.0, std::sin(half), 0.0);
    wrench.force.x() = 0.0;
    wrench.force.z() = total;
  }
  // Sets the side force of the wheels of a vehicle that cannot push along its axle: it follows the
  // heading, and it can only steer. The model of a vehicle that can push has the force of the
  // reference's turn alone, see GroundContact; with this force it would steer instead of pushing.
  void steer(Node& node) const {
    node.steering = {};
    if (!node.on_ground || !ground().holds() || !ground().undercarriage()->rolls ||
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
  // The command that gives `x` now and moves it with `rates`.
  [[nodiscard]] Command command_at(const Problem& problem, const State& x,
                                   const Input& rates) const noexcept {
    return {with_lead(problem, x, rates),
            x.thrust,
            x.tilt_angle,
            rates.template head<Rotors>(),
            rates.template tail<Rotors>(),
            problem.body().wrench(x)};
  }
  [[nodiscard]] ActuatorState<Rotors> with_lead(const Problem& problem, const State& x,
                                                const Input& rates) const noexcept {
    const ActuatorLimits<Rotors>& limits = problem.limits();
    const double period = settings_.period,
                 reached_by_servo = -std::expm1(-period / vehicle_.servo.time_constant);
    ActuatorState<Rotors> command;
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const RotorParameters& rotor = rotor_parameters(vehicle_, k);
      // A lost rotor gets the slowest speed.
      const double effectiveness = vehicle_.rotors[k].effectiveness,
                   per_effectiveness = effectiveness > 0.0 ? 1.0 / effectiveness : 0.0;
      const auto speed_at = [&](double thrust) {
        const double clamped = std::clamp(thrust, limits.min_thrust(i), limits.max_thrust(i));
        return speed_from_thrust(per_effectiveness * clamped, rotor);
      };
      const double speed = speed_at(x.thrust(i)),
                   reached = -std::expm1(-period / rotor.time_constant),
                   target = speed + (speed_at(x.thrust(i) + period * rates(i)) - speed) / reached;
      command.rotor_speed(i) = std::clamp(target, min_speed_[k], max_speed_[k]);
      if (vehicle_.rotors[k].tilts)
        command.tilt_angle(i) =
            std::clamp(x.tilt_angle(i) + period * rates(Rotors + i) / reached_by_servo,
                       limits.min_angle(i), limits.max_angle(i));
    }
    return command;
  }

  Settings settings_;
  Vehicle<Rotors> vehicle_;
  ThrustInverse<Rotors> inverse_;
  ReferenceWrench<Rotors> reference_wrench_;
  std::array<double, static_cast<std::size_t>(Rotors)> min_speed_{}, max_speed_{};  // [rad/s]
};

}  // namespace tilt_ropter::detail
