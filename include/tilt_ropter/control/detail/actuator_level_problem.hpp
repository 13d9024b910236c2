// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/control/detail/flight_node.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>

/// The optimal-control problem with the thrust and the tilt angle of each rotor as states and their
/// rates as inputs. It goes beyond the paper, whose problem has the wrench as a state and needs the
/// inverse of the allocation matrix. M. Li, J. Sugihara and M. Zhao (RA-L 2024, arXiv 2405.09871)
/// control a tiltable quadrotor at this level. Their inputs are commands, and first-order servos
/// are in the model.
///
/// The inputs are rates, not commands, for three reasons. Thrusts and angles are then continuous
/// and linear between two nodes, so that a tick that is ten times shorter than an interval follows
/// the plan exactly. The speed limit of a servo becomes a bound on one input. And actuators that
/// are faster than an interval need no shorter interval. ActuatorNmpc inverts the lags to turn
/// rates into commands.
namespace tilt_ropter {

/// Node of the actuator level.
template <int Rotors>
struct ActuatorLevelNode : FlightNode {
  using Vector = Eigen::Matrix<double, Rotors, 1>;
  Vector lateral_reference = Vector::Zero();   ///< reference of T sin(alpha) [N]
  Vector vertical_reference = Vector::Zero();  ///< reference of T cos(alpha) [N]
  bool stays_on_ground = false;                ///< see ActuatorLevelWeights::thrust_on_ground
  Steeringd steering;  ///< wheels that steer the vehicle during the interval that starts here
};

/// Ranges of the thrusts and tilt angles, and bounds on their rates.
template <int Rotors>
struct ActuatorLimits {
  using Vector = Eigen::Matrix<double, Rotors, 1>;
  Vector min_thrust, max_thrust;  ///< [N]
  Vector min_angle, max_angle;    ///< infinite for rotors that do not tilt [rad]
  Vector thrust_rate, tilt_rate;  ///< bounds on the absolute values [N/s], [rad/s]

  /// Limits of `vehicle` at the nominal voltage. The bound on the thrust rate is the largest rate
  /// that the lag of the speed allows.
  explicit ActuatorLimits(const Vehicle<Rotors>& vehicle) {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const RotorGeometry& geometry = vehicle.rotors[k];
      const RotorParameters& rotor = rotor_parameters(vehicle, k);
      min_thrust(i) = geometry.effectiveness * rotor.min_thrust;
      max_thrust(i) = geometry.effectiveness * rotor.max_thrust;
      // dT/dt = (dT/dOmega) (Omega_max - Omega) / time_constant, largest at half the top speed.
      thrust_rate(i) = std::max(0.5 * max_thrust(i), 1e-3) / rotor.time_constant;
      min_angle(i) = geometry.tilts ? vehicle.servo.min_angle : -infinity;
      max_angle(i) = geometry.tilts ? vehicle.servo.max_angle : infinity;
      tilt_rate(i) = vehicle.servo.max_rate;
    }
  }
};

/// The problem in the form that MultipleShooting needs: the tangent coordinates of ActuatedIndex,
/// the inputs (dT/dt, dalpha/dt), constraints (w, T, alpha, dT/dt, dalpha/dt), 3 ground conditions.
/// The caller sets the nodes' references and external wrenches before each solve.
///
/// A rotor that does not tilt keeps an angle that has no effect; its tilt rate is zero in every
/// solution, because it costs something and gives nothing.
template <int Rotors>
class ActuatorLevelProblem
    : public FlightProblem<ActuatedState<Rotors>, ActuatorLevelNode<Rotors>, ActuatorLevelSettings,
                           2 * Rotors + 12, 2 * Rotors, 4 * Rotors + 3> {
  using Base = FlightProblem<ActuatedState<Rotors>, ActuatorLevelNode<Rotors>,
                             ActuatorLevelSettings, 2 * Rotors + 12, 2 * Rotors, 4 * Rotors + 3>;

 public:
  using Base::constraints, Base::horizon, Base::inputs, Base::node, Base::states;
  using typename Base::Constraints, typename Base::ConstraintsX, typename Base::ConstraintsU,
      typename Base::Input, typename Base::InputJacobian, typename Base::LaneInputJacobian,
      typename Base::LaneStateJacobian, typename Base::Model, typename Base::Node,
      typename Base::State, typename Base::StateJacobian, typename Base::Tangent;
  using I = ActuatedIndex<Rotors>;
  /// Index of the first constraint of each part.
  struct Part {
    static constexpr int angular_velocity = 0, thrust = 3, tilt_angle = thrust + Rotors,
                         rate = tilt_angle + Rotors;
  };

  /// Thrusts and tilt angles are integrals of the inputs. All of them act on the body.
  struct TransitionPattern {
    static constexpr bool nonzero(int row, int column) {
      const bool of_actuators = column < I::position || column >= states;
      if (row < I::position) return of_actuators && (column == row || column == states + row);
      if (of_actuators) return true;
      const int to = (row - I::position) / 3, from = (column - I::position) / 3;
      const bool same_axis = (row - I::position) % 3 == (column - I::position) % 3;
      // Order of the parts: position, velocity, orientation, angular velocity.
      if (from < 2) return to <= from && same_axis;
      return from == 3 || to <= from;
    }
  };

  /// Throws std::invalid_argument if the vehicle or the settings are out of range.
  explicit ActuatorLevelProblem(const Vehicle<Rotors>& vehicle,
                                const ActuatorLevelSettings& settings = {})
      : Base(settings), body_(vehicle), lanes_(vehicle), limits_(vehicle), nominal_(limits_) {
    set_bounds();
  }

  /// As WheeledFlightProblem::set_settings(). Does not allocate.
  void set_settings(const ActuatorLevelSettings& settings) {
    this->require_usable(settings);
    settings_ = settings;
    set_bounds();
  }

  /// Sets the largest thrusts [N], for example those at the measured voltage. They are clamped to
  /// the limits of the vehicle.
  void set_max_thrust(const Eigen::Matrix<double, Rotors, 1>& thrust) noexcept {
    for (int i = 0; i < Rotors; ++i)
      limits_.max_thrust(i) =
          std::max(limits_.min_thrust(i), std::min(thrust(i), nominal_.max_thrust(i)));
    set_bounds();
  }

  [[nodiscard]] const ActuatorLimits<Rotors>& limits() const { return limits_; }
  [[nodiscard]] const ActuatedBody<Rotors>& body() const { return body_; }

  [[nodiscard]] State step(int k, const State& x, const Input& u) const {
    return body_.step(x, u, node(k).external, settings_.interval, node(k).freedom,
                      node(k).steering);
  }
  [[nodiscard]] State step(int k, const State& x, const Input& u, StateJacobian& A,
                           InputJacobian& B) const {
    return body_.step(x, u, node(k).external, settings_.interval, node(k).freedom, A, B,
                      node(k).steering);
  }

  /// As WheeledFlightProblem::step_lanes().
  [[gnu::always_inline]] inline void step_lanes(int k, int count, const State* x, const Input* u,
                                                State* ends, LaneStateJacobian& A,
                                                LaneInputJacobian& B) const {
    ActuatedState<Rotors, Lanes> start, end;
    gather_into(
        start.thrust, count, [&](int i) -> const auto& { return x[i].thrust; });
    gather_into(
        start.tilt_angle, count, [&](int i) -> const auto& { return x[i].tilt_angle; });
    Base::gather_bodies(x, count, start.body);
    Eigen::Matrix<Lanes, inputs, 1> rate;
    gather_into(
        rate, count, [&](int i) -> const auto& { return u[i]; });
    Wrench<Lanes> external;
    Freedom<Lanes> freedom;
    Base::gather_nodes(k, count, external, freedom);
    Steering<Lanes> steering;
    gather_into(
        steering.speed, count, [&](int i) -> const auto& { return node(k + i).steering.speed; });
    steering.side = gather([&](int lane) __attribute__((always_inline)) {
      return node(k + std::min(lane, count - 1)).steering.side;
    });
    lanes_.step_inline(start, rate, external, Lanes(settings_.interval), freedom, steering, end, A,
                       B);
    for (int i = 0; i < count; ++i) {
      scatter(end.thrust, i, ends[i].thrust);
      scatter(end.tilt_angle, i, ends[i].tilt_angle);
      Base::scatter_body(end.body, i, ends[i].body);
    }
  }

  /// Sum of weighted squares of the errors of ActuatorLevelWeights.
  [[nodiscard]] double cost(int k, const State& x, const Input& u) const {
    const Node& n = node(k);
    const double factor = k == horizon() ? settings_.weights.terminal : 1.0;
    const BodyVector q = body_weights(n);
    BodyVector e;
    detail::put_body_error(n, x.body, detail::attitude_error(n, x.body), e, 0);
    double states_sum = 0.0, inputs_sum = 0.0;
    for (int i = 0; i < e.size(); ++i) states_sum += e(i) * q(i) * e(i);
    for (int i = 0; i < Rotors; ++i) {
      const double lateral = x.thrust(i) * std::sin(x.tilt_angle(i)) - n.lateral_reference(i),
                   vertical = x.thrust(i) * std::cos(x.tilt_angle(i)) - n.vertical_reference(i);
      states_sum += thrust_weight(n) * (lateral * lateral + vertical * vertical);
      inputs_sum += settings_.weights.thrust_rate * u(i) * u(i) +
                    settings_.weights.tilt_rate * u(Rotors + i) * u(Rotors + i);
    }
    states_sum += weight_outside() * detail::squares_outside(n, x.body);
    return factor * states_sum + (k < horizon() ? inputs_sum : 0.0);
  }

  void cost_model(int k, const State& x, const Input& u, Model& model) const {
    for (int i = 0; i < 3; ++i) {  // entries of add_curvature() and of half-spaces
      for (int j = 0; j < 3; ++j) model.hessian(I::position + i, I::position + j) = 0.0;
      for (int j = 0; j < Rotors; ++j)
        model.hessian(I::orientation + i, I::tilt_angle + j) =
            model.hessian(I::tilt_angle + j, I::orientation + i) = 0.0;
    }
    const Node& n = node(k);
    const double factor = k == horizon() ? settings_.weights.terminal : 1.0;
    const BodyVector q = body_weights(n);
    const Eigen::Quaterniond turn = detail::attitude_error(n, x.body);
    const detail::Square<double> by_angle = detail::attitude_error_derivative(turn, x.body);
    BodyVector e;
    detail::put_body_error(n, x.body, turn, e, 0);
    for (int i = 0; i < e.size(); ++i) {
      model.gradient(I::position + i) = 2.0 * factor * q(i) * e(i);
      model.hessian(I::position + i, I::position + i) = 2.0 * factor * q(i);
    }
    detail::add_squares_outside(n, x.body, factor * weight_outside(), model, I::position);
    const detail::Square<double> weighted =
        transposed(scaled(by_angle, 2.0 * factor * detail::triple(q, orientation_error)));
    detail::put(weighted * detail::triple(e, orientation_error), model.gradient, I::orientation, 0);
    detail::put(weighted * by_angle, model.hessian, I::orientation, I::orientation);
    const double by_thrust = 2.0 * factor * thrust_weight(n);
    for (int i = 0; i < Rotors; ++i) {
      // The derivatives (sin, cos) by the thrust and T (cos, -sin) by the angle are orthogonal.
      const double thrust = x.thrust(i), s = std::sin(x.tilt_angle(i)),
                   c = std::cos(x.tilt_angle(i)), lateral = n.lateral_reference(i),
                   vertical = n.vertical_reference(i);
      model.gradient(I::thrust + i) = by_thrust * (thrust - s * lateral - c * vertical);
      model.gradient(I::tilt_angle + i) = by_thrust * thrust * (s * vertical - c * lateral);
      model.hessian(I::thrust + i, I::thrust + i) = by_thrust;
      model.hessian(I::tilt_angle + i, I::tilt_angle + i) = by_thrust * thrust * thrust;
    }
    for (int i = 0; k < horizon() && i < inputs; ++i) {
      const double r =
          2.0 * (i < Rotors ? settings_.weights.thrust_rate : settings_.weights.tilt_rate);
      model.gradient(states + i) = r * u(i);
      model.hessian(states + i, states + i) = r;
    }
  }

  /// Adds the curvature of the directions of the rotors' forces to the Hessian (see problem.hpp) at
  /// a node where the limit of a thrust acts, as WheeledFlightProblem does for the total force. For
  /// a rotor with the thrust T along e, with e' = de/dalpha and a, the part of the costate along
  /// -e, this is a T |e x dtheta - e' dalpha|^2 / 2: the change of its direction in the world.
  void add_curvature(int k, const State& x, const Input&, const Constraints& multipliers,
                     const Tangent& costate, Model& model) const {
    bool limited = false;
    for (int i = 0; i < Rotors; ++i) limited |= multipliers(Part::thrust + i) > 0.0;
    if (!limited) return;
    const detail::Triple<double> none{0.0, 0.0, 0.0},
        wanted = detail::force_costate(node(k), x.body, body_.mass(), settings_.interval, costate,
                                       I::position);
    detail::Square<double> turning = detail::square(model.hessian, I::orientation, I::orientation);
    for (int i = 0; i < Rotors; ++i) {
      const auto direction = body_.direction(i, x.tilt_angle(i));
      const auto e = detail::triple(direction.along),
                 derivative = detail::triple(direction.derivative);
      const double a = -x.thrust(i) * dot(wanted, e);
      if (!(a > 0.0)) continue;
      turning += a * outer(1.0, -1.0 * e, e, none);
      const detail::Triple<double> both = a * cross(e, derivative);
      const int column = I::tilt_angle + i;
      model.hessian(column, column) += a * dot(derivative, derivative);
      for (int j = 0; j < 3; ++j) {
        const double part = j == 0 ? both.x : j == 1 ? both.y : both.z;
        model.hessian(I::orientation + j, column) += part;
        model.hessian(column, I::orientation + j) += part;
      }
    }
    detail::put(turning, model.hessian, I::orientation, I::orientation);
  }

  [[nodiscard]] Constraints constraint_values(int, const State& x, const Input& u) const {
    Constraints value;
    detail::put(detail::triple(x.body.angular_velocity), value, Part::angular_velocity);
    for (int i = 0; i < Rotors; ++i) {
      value(Part::thrust + i) = x.thrust(i);
      value(Part::tilt_angle + i) = x.tilt_angle(i);
    }
    for (int i = 0; i < inputs; ++i) value(Part::rate + i) = u(i);
    return value;
  }
  void constraint_derivatives(int, const State&, const Input&, ConstraintsX& C,
                              ConstraintsU& E) const {
    for (int i = 0; i < 3; ++i) C(Part::angular_velocity + i, I::angular_velocity + i) = 1.0;
    for (int i = 0; i < inputs; ++i)
      C(Part::thrust + i, I::thrust + i) = E(Part::rate + i, i) = 1.0;
  }

 private:
  using BodyVector = Eigen::Matrix<double, 12, 1>;
  static constexpr int orientation_error = 6;
  using Base::lower_, Base::settings_, Base::upper_;

  [[nodiscard]] double weight_outside() const {
    return detail::weight_outside * settings_.weights.position.maxCoeff();
  }
  [[nodiscard]] double thrust_weight(const Node& n) const {
    return n.stays_on_ground ? settings_.weights.thrust_on_ground : settings_.weights.thrust;
  }

  [[nodiscard]] BodyVector body_weights(const Node& n) const {
    const ActuatorLevelWeights& w = settings_.weights;
    BodyVector all;
    detail::put(detail::triple(w.position), all);
    detail::put(detail::triple(w.velocity), all, 3);
    detail::put(detail::triple(w.orientation), all, orientation_error);
    detail::put(detail::triple(w.angular_velocity), all, 9);
    for (int i = 0; n.touches && i < 12; ++i) all(i) *= detail::touch_weights[i / 3];
    return all;
  }

  void set_bounds() noexcept {
    for (int i = 0; i < 3; ++i) {
      upper_(i) = settings_.bounds.angular_velocity(i);
      lower_(i) = -upper_(i);
    }
    for (int i = 0; i < Rotors; ++i) {
      lower_(Part::thrust + i) = limits_.min_thrust(i);
      upper_(Part::thrust + i) = limits_.max_thrust(i);
      lower_(Part::tilt_angle + i) = limits_.min_angle(i);
      upper_(Part::tilt_angle + i) = limits_.max_angle(i);
      upper_(Part::rate + i) = limits_.thrust_rate(i);
      upper_(Part::rate + Rotors + i) = settings_.bounds.tilt_rate_fraction * limits_.tilt_rate(i);
    }
    for (int i = Part::rate; i < constraints; ++i) lower_(i) = -upper_(i);
    this->finish_bounds(Part::rate, inputs);
  }

  ActuatedBody<Rotors> body_;
  ActuatedBody<Rotors, Lanes> lanes_;
  ActuatorLimits<Rotors> limits_, nominal_;
};

}  // namespace tilt_ropter
