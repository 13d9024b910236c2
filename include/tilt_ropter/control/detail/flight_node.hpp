// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>
#include <vector>

/// What the wrench level and the actuator level have in common at the nodes of the horizon:
/// reference, external wrench, ground contact, bounds, and the terms of cost and constraints that
/// depend on the body alone.
namespace tilt_ropter {

/// Reference of a node, and the external wrench and ground contact that act on it.
struct FlightNode {
  BodyStated reference;    ///< p_r, v_r, q_r, w_r
  Wrenchd external;        ///< F_e, M_e during the interval that starts here (body frame)
  Freedomd freedom;        ///< motion that the ground leaves free during that interval
  bool on_ground = false;  ///< the paper's delta: non-holonomic conditions apply here
  bool touches = false;    ///< a surface that the vehicle pushes on holds the motion along `normal`
  Eigen::Vector3d normal = Eigen::Vector3d::Zero();  ///< of this surface, body frame, unit or zero
  std::array<HalfSpace, 4> inside;                   ///< of the CoM, see ReferencePoint::inside
  GroundPlane com_plane;                             ///< plane on which the CoM stays on the ground
  /// Axis about which the axle does not turn, unit vector in the body frame: body x, if the body is
  /// not pitched. The condition on the angular velocity at this node uses it.
  Eigen::Vector3d roll_axis = Eigen::Vector3d::UnitX();
};

namespace detail {

/// Penalty for violating a constraint of the state, such as a bound on a force or on the angular
/// velocity, by one unit. A constraint whose multiplier would exceed it is relaxed: a measured
/// state may violate the bounds. In the benchmark STEP no multiplier reaches it.
inline constexpr double state_penalty = 1e4;

/// Factors on the weights of (p, v, q, w) at a node that pushes on a surface. There, a push that
/// does not pass through the CoM and friction turn the vehicle, and the errors have to be a quarter
/// of those in the air to keep the turn small.
inline constexpr double touch_weights[] = {16.0, 4.0, 16.0, 4.0};

/// Rotation from one vector to another, by less than half a turn. `length` is the product of their
/// lengths.
[[nodiscard]] inline Eigen::Quaterniond shortest_turn(const Eigen::Vector3d& from,
                                                      const Eigen::Vector3d& to,
                                                      double length = 1.0) noexcept {
  const Eigen::Vector3d axis = from.cross(to) / length;
  Eigen::Quaterniond turn(1.0 + from.dot(to) / length, axis.x(), axis.y(), axis.z());
  turn.normalize();
  return turn;
}

/// Rotation q (x) q_r^-1 from reference to body, with w >= 0: the shorter of the two equivalent
/// rotations.
[[nodiscard]] inline Eigen::Quaterniond attitude_error(const FlightNode& node,
                                                       const BodyStated& body) {
  Eigen::Quaterniond turn = body.orientation * node.reference.orientation.conjugate();
  if (turn.w() < 0.0) turn.coeffs() = -turn.coeffs();
  return turn;
}

/// Writes (p - p_r, v - v_r, 2 vec(q (x) q_r^-1), w - w_r) from index `first` of `e` on. `turn` is
/// the result of attitude_error().
template <typename Error>
[[gnu::always_inline]] inline void put_body_error(const FlightNode& node, const BodyStated& body,
                                                  const Eigen::Quaterniond& turn, Error& e,
                                                  int first) {
  const BodyStated& reference = node.reference;
  put(triple(body.position) - triple(reference.position), e, first);
  put(triple(body.velocity) - triple(reference.velocity), e, first + 3);
  put(2.0 * Triple<double>{turn.x(), turn.y(), turn.z()}, e, first + 6);
  put(triple(body.angular_velocity) - triple(reference.angular_velocity), e, first + 9);
}

/// Derivative of 2 vec(q (x) q_r^-1) by dtheta: (w I - [v]x) R(q) for q (x) q_r^-1 = (w, v).
[[nodiscard]] inline Square<double> attitude_error_derivative(const Eigen::Quaterniond& turn,
                                                              const BodyStated& body) {
  const Triple<double> none{0.0, 0.0, 0.0};
  return outer(turn.w(), none, none, {-turn.x(), -turn.y(), -turn.z()}) *
         square(body.orientation.toRotationMatrix());
}

/// Derivative of the cost of all later nodes by a constant force on the body during the interval
/// that starts at `node`, body frame [1/N], to first order in the length `interval` [s] of this
/// interval. `mass` [kg]. `costate` is that of the end of the interval, see add_curvature() in
/// problem.hpp; its parts (dp, dv) begin in row `first`.
template <typename Costate>
[[nodiscard]] Triple<double> force_costate(const FlightNode& node, const BodyStated& body,
                                           double mass, double interval, const Costate& costate,
                                           int first) {
  const Triple<double> by_velocity =
      triple(costate, first + 3) + (0.5 * interval) * triple(costate, first);
  return (interval / mass) * (transposed(square(body.orientation.toRotationMatrix())) *
                              (transposed(square(node.freedom.linear)) * by_velocity));
}

/// Weight of the distance by which the CoM is outside a half-space of a node, in weights of the
/// position. References are inside: it acts on the way to them, and holds with an error of a
/// twentieth of that in the open. With 2000 the body turns twice as fast where noise and a wrong
/// model push it over the boundary, and corners are entered by a tenth less.
inline constexpr double weight_outside = 400.0;

/// Sum of the squares of these distances [m^2].
[[nodiscard]] inline double squares_outside(const FlightNode& node, const BodyStated& body) {
  double sum = 0.0;
  for (const HalfSpace& h : node.inside) {
    const double beyond = std::max(h.beyond(body.position), 0.0);
    sum += beyond * beyond;
  }
  return sum;
}

/// Adds `weight` times this sum to a model of the cost whose position begins at index `first`.
template <typename Model>
void add_squares_outside(const FlightNode& node, const BodyStated& body, double weight,
                         Model& model, int first) {
  for (const HalfSpace& h : node.inside) {
    const double beyond = h.beyond(body.position);
    if (!(beyond > 0.0)) continue;
    for (int i = 0; i < 3; ++i) {
      model.gradient(first + i) -= 2.0 * weight * beyond * h.normal(i);
      for (int j = 0; j < 3; ++j)
        model.hessian(first + i, first + j) += 2.0 * weight * h.normal(i) * h.normal(j);
    }
  }
}

/// Velocity in the body frame [m/s].
[[nodiscard]] inline Triple<double> body_velocity(const BodyStated& body) {
  return transposed(square(body.orientation.toRotationMatrix())) * triple(body.velocity);
}

}  // namespace detail

/// The common part of the problems of both levels: nodes, bounds, and the conditions of ground
/// contact as equalities. The last twelve tangent coordinates are (dp, dv, dtheta, dw).
template <typename StateType, typename NodeType, typename Settings, int States, int Inputs,
          int ConstraintCount>
class FlightProblem {
 public:
  static constexpr int states = States, inputs = Inputs, constraints = ConstraintCount,
                       equalities = 3;
  using State = StateType;
  using Node = NodeType;
  using D = optimal_control::ProblemDimensions<FlightProblem>;
  using Model = optimal_control::QuadraticModel<states, inputs>;
  using Tangent = typename D::Tangent;
  using Input = typename D::Input;
  using StateJacobian = typename D::A;
  using InputJacobian = typename D::B;
  using LaneStateJacobian = Eigen::Matrix<Lanes, states, states>;
  using LaneInputJacobian = Eigen::Matrix<Lanes, states, inputs>;
  using Constraints = typename D::Constraints;
  using ConstraintsX = typename D::ConstraintsX;
  using ConstraintsU = typename D::ConstraintsU;
  using Equalities = typename D::Equalities;
  using EqualitiesX = typename D::EqualitiesX;

  [[nodiscard]] const Settings& settings() const { return settings_; }
  [[nodiscard]] Node& node(int k) { return nodes_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Node& node(int k) const { return nodes_[static_cast<std::size_t>(k)]; }

  [[nodiscard]] int horizon() const { return settings_.intervals; }
  [[nodiscard]] State retract(const State& x, const Tangent& dx) const {
    using tilt_ropter::retract;  // of the state's header, found by its type
    return retract(x, dx);
  }
  [[nodiscard]] Tangent difference(const State& y, const State& x) const {
    using tilt_ropter::difference;
    return difference(y, x);
  }

  [[nodiscard]] const Constraints& lower(int k) const {
    return k == 0 ? first_lower_ : k == horizon() ? last_lower_ : lower_;
  }
  [[nodiscard]] const Constraints& upper(int k) const {
    return k == 0 ? first_upper_ : k == horizon() ? last_upper_ : upper_;
  }
  [[nodiscard]] const Constraints& penalty(int) const { return penalty_; }

  /// v_By, the angular velocity about the roll axis (w_x) and the height of the CoM over its plane
  /// (paper, Eq. mpc_subject), used where the node is on the ground.
  [[nodiscard]] Equalities equality_values(int k, const State& x) const {
    const FlightNode& n = node(k);
    return {detail::body_velocity(x.body).y,
            dot(detail::triple(n.roll_axis), detail::triple(x.body.angular_velocity)),
            x.body.position.z() - n.com_plane.height_at(x.body.position)};
  }
  void equality_derivatives(int k, const State& x, EqualitiesX& H) const {
    constexpr int first = states - 12;
    const FlightNode& n = node(k);
    const detail::Triple<double> axle = detail::square(x.body.orientation.toRotationMatrix()).y,
                                 velocity = detail::body_velocity(x.body);
    std::fill_n(H.data(), H.size(), 0.0);
    H(0, first + 3) = axle.x;
    H(0, first + 4) = axle.y;
    H(0, first + 5) = axle.z;
    H(0, first + 6) = velocity.z;
    H(0, first + 8) = -velocity.x;
    for (int i = 0; i < 3; ++i) H(1, first + 9 + i) = n.roll_axis(i);
    for (int i = 0; i < 2; ++i) H(2, first + i) = -n.com_plane.slope(i);
    H(2, first + 2) = 1.0;
  }
  [[nodiscard]] Equalities equality_weights(int k) const {
    if (!node(k).on_ground) return Equalities::Zero();
    const Eigen::Vector3d& w = settings_.weights.ground;
    return {2.0 * w.x(), 2.0 * w.y(), 2.0 * w.z()};
  }

 protected:
  explicit FlightProblem(const Settings& settings) : settings_(validated(settings)) {
    nodes_.resize(static_cast<std::size_t>(settings.intervals) + 1);
  }

  // Throws std::invalid_argument if `settings` are out of range or have another horizon.
  void require_usable(const Settings& settings) const {
    validate(settings);
    require(settings.intervals == settings_.intervals, "HorizonSettings.intervals",
            settings.intervals, "as at construction");
    require(settings.interval == settings_.interval, "HorizonSettings.interval [s]",
            settings.interval, "as at construction");
  }

  // Sets the bounds of the first and of the last node from lower_ and upper_, and the penalties.
  // From constraint `rate` on, `of_input` constraints depend on the input; the first of them are
  // the inputs themselves.
  void finish_bounds(int rate, int of_input) {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    // No plan can change the measured state, so node 0 has no bounds on it. The last node has no
    // input.
    first_upper_ = last_upper_ = upper_;
    first_lower_ = last_lower_ = lower_;
    std::fill_n(first_upper_.data(), rate, infinity);
    std::fill_n(first_lower_.data(), rate, -infinity);
    std::fill_n(last_upper_.data() + rate, of_input, infinity);
    std::fill_n(last_lower_.data() + rate, of_input, -infinity);
    // The rate is hard, so the command meets its bounds even if the plan violates others.
    penalty_.setConstant(detail::state_penalty);
    std::fill_n(penalty_.data() + rate, inputs, infinity);
  }

  // For step_lanes(): body states, and what acts during the intervals from k on, side by side.
  [[gnu::always_inline]] static inline void gather_bodies(const State* x, int count,
                                                          BodyState<Lanes>& lanes) {
    const auto take = [&](auto& to, auto BodyStated::*part) __attribute__((always_inline)) {
      gather_into(
          to, count, [&](int i) -> const auto& { return (x[i].body.*part); });
    };
    take(lanes.position, &BodyStated::position);
    take(lanes.velocity, &BodyStated::velocity);
    take(lanes.angular_velocity, &BodyStated::angular_velocity);
    gather_into(
        lanes.orientation.coeffs(),
        count, [&](int i) -> const auto& { return x[i].body.orientation.coeffs(); });
  }
  [[gnu::always_inline]] inline void gather_nodes(int k, int count, Wrench<Lanes>& external,
                                                  Freedom<Lanes>& freedom) const {
    const auto take = [&](auto& to, auto part, auto entry) __attribute__((always_inline)) {
      gather_into(
          to, count, [&](int i) -> const auto& { return (node(k + i).*part).*entry; });
    };
    take(external.force, &FlightNode::external, &Wrenchd::force);
    take(external.torque, &FlightNode::external, &Wrenchd::torque);
    take(freedom.linear, &FlightNode::freedom, &Freedomd::linear);
    take(freedom.angular, &FlightNode::freedom, &Freedomd::angular);
  }
  [[gnu::always_inline]] static inline void scatter_body(const BodyState<Lanes>& from, int lane,
                                                         BodyStated& to) {
    scatter(from.position, lane, to.position);
    scatter(from.velocity, lane, to.velocity);
    scatter(from.orientation.coeffs(), lane, to.orientation.coeffs());
    scatter(from.angular_velocity, lane, to.angular_velocity);
  }

  Settings settings_;
  std::vector<Node> nodes_;
  Constraints lower_, upper_, first_lower_, first_upper_, last_lower_, last_upper_, penalty_;
};

}  // namespace tilt_ropter
