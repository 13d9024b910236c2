// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/actuator_constraints.hpp>
#include <tilt_ropter/control/detail/cost_after_horizon.hpp>
#include <tilt_ropter/control/detail/flight_node.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/detail/riccati.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <limits>
#include <optional>
#include <vector>

/// The paper's optimal-control problem (paper, Sec. Nonlinear Model Predictive Control): 19 states
/// (F, M, p, v, q, w) and 6 inputs (dF, dM). The constraints are bounds on wrench, wrench rate and
/// body rate, and the non-holonomic conditions of ground contact. MultipleShooting solves it.
namespace tilt_ropter {

/// Node of the wrench level.
struct WheeledFlightNode : FlightNode {
  Wrenchd wrench_reference;  ///< F_r, M_r (body frame)
};

/// The problem in the form that MultipleShooting needs: 18 tangent coordinates (dF, dM, dp, dv,
/// dtheta, dw), 6 inputs (dF/dt, dM/dt), 15 constraints (F, M, w, dF/dt, dM/dt), 3 ground
/// conditions. The caller sets the nodes' references and external wrenches before each solve. With
/// `Rotors` > 0, the constraints of ActuatorConstraints follow the paper's 15.
template <int Rotors>
class WheeledFlightProblem : public FlightProblem<Stated, WheeledFlightNode, WheeledFlightSettings,
                                                  18, 6, 15 + ActuatorConstraints<Rotors>::count> {
  using Base = FlightProblem<Stated, WheeledFlightNode, WheeledFlightSettings, 18, 6,
                             15 + ActuatorConstraints<Rotors>::count>;

 public:
  using Base::constraints, Base::horizon, Base::inputs, Base::node, Base::states;
  using typename Base::Constraints, typename Base::ConstraintsX, typename Base::ConstraintsU,
      typename Base::Input, typename Base::InputJacobian, typename Base::LaneInputJacobian,
      typename Base::LaneStateJacobian, typename Base::Model, typename Base::State,
      typename Base::StateJacobian, typename Base::Tangent;
  /// Index of the first constraint of each part.
  struct Part {
    static constexpr int force = 0, torque = 3, angular_velocity = 6, rate = 9, actuators = 15;
  };

  /// The wrench is the integral of the input. The position acts on no other state, and the velocity
  /// only on the position. Forces do not turn the body. Within one interval the torque rate does
  /// not reach the position.
  struct TransitionPattern {
    static constexpr bool nonzero(int row, int column) {
      enum Block { zero, diagonal, full };
      constexpr Block table[6][8] = {
          // F, M, p, v, theta, w, dF, dM
          {diagonal, zero, zero, zero, zero, zero, diagonal, zero},  // F
          {zero, diagonal, zero, zero, zero, zero, zero, diagonal},  // M
          {full, full, diagonal, diagonal, full, full, full, zero},  // p
          {full, full, zero, diagonal, full, full, full, full},      // v
          {zero, full, zero, zero, full, full, zero, full},          // theta
          {zero, full, zero, zero, zero, full, zero, full},          // w
      };
      const Block block = table[row / 3][column / 3];
      return block == full || (block == diagonal && row % 3 == column % 3);
    }
  };

  /// `actuators` has no bounds by default. Throws std::invalid_argument if parameters or settings
  /// are out of range. With TerminalCost::riccati it also throws if some error that does not decay
  /// costs nothing with these weights.
  explicit WheeledFlightProblem(const RigidBodyParameters& body,
                                const WheeledFlightSettings& settings = {},
                                const ActuatorConstraints<Rotors>& actuators = {})
      : Base(settings), body_(body), lanes_(body), actuators_(actuators) {
    set_weights();
    set_bounds();
    if (settings.terminal_cost == TerminalCost::riccati) set_terminal(settings.weights);
  }

  /// Changes settings and constraints for the next MultipleShooting::prepare(). The nodes stay as
  /// they are. The number and the length of the intervals must stay the same. Does not allocate,
  /// except with TerminalCost::riccati, which also takes milliseconds. Throws
  /// std::invalid_argument, and changes nothing, if the settings are out of range.
  void set_settings(const WheeledFlightSettings& settings,
                    const ActuatorConstraints<Rotors>& actuators = {}) {
    this->require_usable(settings);
    if (settings.terminal_cost == TerminalCost::riccati) set_terminal(settings.weights);
    settings_ = settings;
    set_weights();
    set_actuators(actuators);
  }

  /// The same for the constraints of the actuators alone, for example at another voltage.
  void set_actuators(const ActuatorConstraints<Rotors>& actuators) noexcept {
    actuators_ = actuators;
    set_bounds();
  }

  /// d difference(retract(x, dx + e), retract(x, dx)) / de, for SingleShooting.
  [[nodiscard]] StateJacobian retract_derivative(const State&, const Tangent& dx) const {
    StateJacobian derivative = StateJacobian::Identity();
    derivative.template block<3, 3>(I::orientation, I::orientation) =
        right_jacobian(dx.template segment<3>(I::orientation));
    return derivative;
  }

  [[nodiscard]] State step(int k, const State& x, const Input& u) const {
    return step_for(settings_.interval, k, x, u);
  }
  [[nodiscard]] State step(int k, const State& x, const Input& u, StateJacobian& A,
                           InputJacobian& B) const {
    return step_under(node(k).external, settings_.interval, k, x, u, A, B);
  }

  /// End state after the first `seconds` of interval k.
  [[nodiscard]] State step_for(double seconds, int k, const State& x, const Input& u) const {
    return step_under(node(k).external, seconds, k, x, u);
  }

  /// The same with another external wrench than that of the node; with the derivatives.
  [[nodiscard]] State step_under(const Wrenchd& external, double seconds, int k, const State& x,
                                 const Input& u) const {
    return body_.step(x, u, external, seconds, node(k).freedom);
  }
  [[nodiscard]] State step_under(const Wrenchd& external, double seconds, int k, const State& x,
                                 const Input& u, StateJacobian& A, InputJacobian& B) const {
    return body_.step(x, u, external, seconds, node(k).freedom, A, B);
  }

  /// Steps the `count` intervals k, k + 1, .. side by side. If there are fewer than four, the
  /// remaining lanes repeat the last interval.
  [[gnu::always_inline]] inline void step_lanes(int k, int count, const State* x, const Input* u,
                                                State* ends, LaneStateJacobian& A,
                                                LaneInputJacobian& B) const {
    tilt_ropter::State<Lanes> start, end;
    gather_into(
        start.wrench.force, count, [&](int i) -> const auto& { return x[i].wrench.force; });
    gather_into(
        start.wrench.torque, count, [&](int i) -> const auto& { return x[i].wrench.torque; });
    Base::gather_bodies(x, count, start.body);
    Eigen::Matrix<Lanes, 6, 1> rate;
    gather_into(
        rate, count, [&](int i) -> const auto& { return u[i]; });
    Wrench<Lanes> external;
    Freedom<Lanes> freedom;
    Base::gather_nodes(k, count, external, freedom);
    lanes_.step_inline(start, rate, external, Lanes(settings_.interval), freedom, end, A, B);
    for (int i = 0; i < count; ++i) {
      scatter(end.wrench.force, i, ends[i].wrench.force);
      scatter(end.wrench.torque, i, ends[i].wrench.torque);
      Base::scatter_body(end.body, i, ends[i].body);
    }
  }

  /// e' Q e + u' R u with e = (F - F_r, M - M_r, p - p_r, v - v_r, 2 vec(q (x) q_r^-1), w - w_r).
  /// For the last node see TerminalCost.
  [[nodiscard]] double cost(int k, const State& x, const Input& u) const {
    const Tangent e = error(k, x);
    const double outside = weight_outside(k) * detail::squares_outside(node(k), x.body);
    if (ends_with_riccati(k)) return after_horizon_.front().value(heading_of_end(), e) + outside;
    const Tangent& q = state_weights(k);
    double sum = outside + ground_thrust_weight(k) * e(I::force + 2) * e(I::force + 2);
    for (int i = 0; i < states; ++i) sum += e(i) * q(i) * e(i);
    if (node(k).touches) {
      const double along = dot(detail::triple(node(k).normal), detail::triple(e, I::force));
      sum += push_weight() * along * along;
    }
    for (int i = 0; k < horizon() && i < inputs; ++i) sum += u(i) * input_weights_(i) * u(i);
    return sum;
  }

  void cost_model(int k, const State& x, const Input& u, Model& model) const {
    // Entries that add_curvature() or half-spaces change and that are not set below.
    model.hessian.template topLeftCorner<6, 6>().setZero();
    for (int j = 0; j < 3; ++j)
      for (int i = 0; i < 3; ++i)
        model.hessian(I::force + i, I::orientation + j) =
            model.hessian(I::orientation + i, I::force + j) =
                model.hessian(I::position + i, I::position + j) = 0.0;
    const Tangent e = error(k, x);
    const Square by_angle =
        detail::attitude_error_derivative(detail::attitude_error(node(k), x.body), x.body);
    if (ends_with_riccati(k)) {
      after_horizon_.front().set_model(heading_of_end(), e, by_angle, model);
      return add_outside(k, x, model);
    }
    const Tangent& q = state_weights(k);
    for (int i = 0; i < states; ++i) {
      model.gradient(i) = 2.0 * q(i) * e(i);
      model.hessian(i, i) = 2.0 * q(i);
    }
    constexpr int thrust = I::force + 2;
    model.gradient(thrust) += 2.0 * ground_thrust_weight(k) * e(thrust);
    model.hessian(thrust, thrust) += 2.0 * ground_thrust_weight(k);
    if (node(k).touches) {
      const Eigen::Vector3d& n = node(k).normal;
      const double along = dot(detail::triple(n), detail::triple(e, I::force)),
                   weight = 2.0 * push_weight();
      for (int i = 0; i < 3; ++i) {
        model.gradient(I::force + i) += weight * along * n(i);
        for (int j = 0; j < 3; ++j)
          model.hessian(I::force + i, I::force + j) += weight * n(i) * n(j);
      }
    }
    const Square weighted = transposed(scaled(by_angle, 2.0 * detail::triple(q, I::orientation)));
    detail::put(weighted * detail::triple(e, I::orientation), model.gradient, I::orientation);
    detail::put(weighted * by_angle, model.hessian, I::orientation, I::orientation);
    add_outside(k, x, model);
    for (int i = 0; k < horizon() && i < inputs; ++i) {
      model.gradient(states + i) = 2.0 * input_weights_(i) * u(i);
      model.hessian(states + i, states + i) = 2.0 * input_weights_(i);
    }
  }

  /// Adds the curvature of the thrust limits and of the force's direction to the Hessian (see
  /// problem.hpp) at a node where a limit of the force acts. The costate asks for more force along
  /// F than there is, and only its direction can change. With f = |F|, e = F / f, a the part of the
  /// costate along -F and dF_e the part of dF across e, the second-order term of the dynamics in
  /// (dF, dtheta) is a f |e x dtheta - dF_e / f|^2 / 2 - a |dF_e|^2 / (2 f), to first order in the
  /// length of the interval. The first part is the change of the direction in the world, and
  /// convex. The second part is left out: the curvature of the limits balances it. Where no limit
  /// acts nothing does, and the Gauss-Newton Hessian is the better one.
  ///
  /// Without these terms the steps at a limit of the thrust are too long: in a climb with a weak
  /// battery each plan violates the limits more than the last one.
  void add_curvature(int k, const State& x, const Input&, const Constraints& multipliers,
                     const Tangent& costate, Model& model) const {
    bool limited = false;  // by a bound on the force or a limit of a thrust
    for (int i = 0; i < 3; ++i) limited |= multipliers(Part::force + i) != 0.0;
    for (int i = constraints - Rotors; i < constraints; ++i) limited |= multipliers(i) > 0.0;
    if (!limited) return;
    actuators_.add_curvature(packed(x.wrench), multipliers.template tail<3 * Rotors>(),
                             model.hessian.template topLeftCorner<6, 6>());
    const Triple force = detail::triple(x.wrench.force),
                 wanted = detail::force_costate(node(k), x.body, body_.mass(), settings_.interval,
                                                costate, I::position);
    const double f = std::sqrt(dot(force, force)), a = -dot(wanted, force) / f;
    if (!(a > 0.0)) return;  // also for zero force
    const Triple none{0.0, 0.0, 0.0}, e = (1.0 / f) * force;
    const Square across = outer(1.0, -1.0 * e, e, none), turn = outer(0.0, none, none, -a * e);
    const auto add = [&model](const Square& block, int row, int column) {
      detail::put(detail::square(model.hessian, row, column) + block, model.hessian, row, column);
    };
    add(a / f * across, I::force, I::force);
    add(a * f * across, I::orientation, I::orientation);
    add(turn, I::force, I::orientation);
    add(transposed(turn), I::orientation, I::force);
  }

  [[nodiscard]] Constraints constraint_values(int, const State& x, const Input& u) const {
    using detail::triple;
    Constraints value;
    detail::put(triple(x.wrench.force), value, Part::force);
    detail::put(triple(x.wrench.torque), value, Part::torque);
    detail::put(triple(x.body.angular_velocity), value, Part::angular_velocity);
    for (int i = 0; i < inputs; ++i) value(Part::rate + i) = u(i);
    const auto of_actuators = actuators_.values(packed(x.wrench), u);
    std::copy_n(of_actuators.data(), 3 * Rotors, value.data() + Part::actuators);
    return value;
  }
  void constraint_derivatives(int, const State& x, const Input& u, ConstraintsX& C,
                              ConstraintsU& E) const {
    for (int i = 0; i < 6; ++i) C(Part::force + i, I::force + i) = E(Part::rate + i, i) = 1.0;
    for (int i = 0; i < 3; ++i) C(Part::angular_velocity + i, I::angular_velocity + i) = 1.0;
    actuators_.derivatives(packed(x.wrench), u, C.template bottomLeftCorner<3 * Rotors, 6>(),
                           E.template bottomRows<3 * Rotors>());
  }

 private:
  using Triple = detail::Triple<double>;
  using Square = detail::Square<double>;
  using I = TangentIndex;
  using Base::lower_, Base::nodes_, Base::settings_, Base::upper_;

  static Tangent state_weights_of(const NmpcWeights& w) {
    const Eigen::Vector3d* blocks[] = {&w.force,    &w.torque,      &w.position,
                                       &w.velocity, &w.orientation, &w.angular_velocity};
    Tangent all;
    for (int i = 0; i < 6; ++i) detail::put(detail::triple(*blocks[i]), all, 3 * i);
    return all;
  }

  void set_weights() {
    Tangent weights = state_weights_of(settings_.weights);
    for (int touches : {0, 1}) {
      for (int i = 0; touches == 1 && i < 12; ++i)
        weights(I::position + i) *= detail::touch_weights[i / 3];
      state_weights_[0][touches] = weights;
      for (int i = 0; i < states; ++i)
        state_weights_[1][touches](i) = settings_.weights.terminal * weights(i);
    }
    input_weights_ = packed({settings_.weights.force_rate, settings_.weights.torque_rate});
  }

  void set_bounds() {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    const NmpcBounds& b = settings_.bounds;
    const Eigen::Vector3d* upper[] = {&b.force_max, &b.torque_max, &b.angular_velocity,
                                      &b.force_rate, &b.torque_rate};
    const Eigen::Vector3d* lower[] = {&b.force_min, &b.torque_min};
    for (int i = 0; i < 5; ++i) {
      detail::put(detail::triple(*upper[i]), upper_, 3 * i);
      const Triple below = i < 2 ? detail::triple(*lower[i]) : -1.0 * detail::triple(*upper[i]);
      detail::put(below, lower_, 3 * i);
    }
    std::copy_n(actuators_.upper().data(), 3 * Rotors, upper_.data() + Part::actuators);
    std::fill_n(lower_.data() + Part::actuators, 3 * Rotors, -infinity);
    this->finish_bounds(Part::rate, 6 + 2 * Rotors);
    std::fill_n(this->first_upper_.data() + constraints - Rotors, Rotors, infinity);
  }

  [[nodiscard]] Tangent error(int k, const State& x) const {
    using detail::triple;
    const WheeledFlightNode& n = node(k);
    const auto &wrench = x.wrench, &wrench_reference = n.wrench_reference;
    Tangent e;
    detail::put(triple(wrench.force) - triple(wrench_reference.force), e, I::force);
    detail::put(triple(wrench.torque) - triple(wrench_reference.torque), e, I::torque);
    detail::put_body_error(n, x.body, detail::attitude_error(n, x.body), e, I::position);
    return e;
  }

  [[nodiscard]] bool ends_with_riccati(int k) const {
    return k == horizon() && settings_.terminal_cost == TerminalCost::riccati;
  }
  [[nodiscard]] double heading_of_end() const {
    return yaw_of(nodes_.back().reference.orientation);
  }

  // At heading zero the tangent coordinates equal those of the error, to first order.
  void set_terminal(const NmpcWeights& weights) {
    State hover;
    hover.wrench.force.z() = body_.mass() * gravity;
    StateJacobian A;
    InputJacobian B;
    (void)body_.step(hover, Input::Zero(), {}, settings_.interval, {}, A, B);
    const Tangent of_state = state_weights_of(weights);
    const Input of_input = packed({weights.force_rate, weights.torque_rate});
    Model cost;
    for (int i = 0; i < states; ++i) cost.hessian(i, i) = of_state(i);
    for (int i = 0; i < inputs; ++i) cost.hessian(states + i, states + i) = of_input(i);
    const std::optional<StateJacobian> P =
        optimal_control::solve_dare<states, inputs, TransitionPattern>(A, B, cost);
    require(P.has_value(), "WheeledFlightSettings.terminal_cost", "riccati",
            "used with weights by which every error that stays costs something, as NmpcWeights."
            "position and .orientation > 0 do, enough for it to decay within 20000 intervals");
    after_horizon_.assign(1, detail::CostAfterHorizon(*P));
  }

  [[nodiscard]] double ground_thrust_weight(int k) const {
    if (!node(k).on_ground) return 0.0;
    return (k == horizon() ? settings_.weights.terminal : 1.0) * settings_.weights.ground_thrust;
  }
  // Weight of the force along the normal of a surface that the vehicle pushes on [1/N^2].
  [[nodiscard]] double push_weight() const {
    constexpr double time_constant = 0.15;  // of the force [s]
    return settings_.weights.force_rate.maxCoeff() / (time_constant * time_constant);
  }
  [[nodiscard]] double weight_outside(int k) const {
    return detail::weight_outside * settings_.weights.position.maxCoeff() *
           (k == horizon() ? settings_.weights.terminal : 1.0);
  }
  void add_outside(int k, const State& x, Model& model) const {
    detail::add_squares_outside(node(k), x.body, weight_outside(k), model, I::position);
  }
  [[nodiscard]] const Tangent& state_weights(int k) const {
    return state_weights_[k == horizon()][node(k).touches];
  }

  // Of a wrench, or of the weights of its rate.
  [[nodiscard]] static Input packed(const Wrenchd& wrench) {
    Input w;
    detail::put(detail::triple(wrench.force), w, I::force);
    detail::put(detail::triple(wrench.torque), w, I::torque);
    return w;
  }

  RigidBodyd body_;
  RigidBody<Lanes> lanes_;
  ActuatorConstraints<Rotors> actuators_;
  Tangent state_weights_[2][2];  ///< of the last node; of a node that touches a surface
  Input input_weights_;
  std::vector<detail::CostAfterHorizon> after_horizon_;  // of TerminalCost::riccati, else empty
};

}  // namespace tilt_ropter
