// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>

/// What the wrench level and the actuator level have in common at one node of the horizon:
/// reference, external wrench, ground contact, and the terms of cost and constraints that depend on
/// the body alone.
namespace tilt_ropter {

/// Reference of a node, and the external wrench and ground contact that act on it.
struct FlightNode {
  BodyStated reference;    ///< p_r, v_r, q_r, w_r
  Wrenchd external;        ///< F_e, M_e during the interval that starts here (body frame)
  Freedomd freedom;        ///< motion that the ground leaves free during that interval
  bool on_ground = false;  ///< the paper's delta: non-holonomic conditions apply here
  GroundPlane com_plane;   ///< plane on which the CoM stays on the ground
  /// Axis about which the axle does not turn, unit vector in the body frame: body x, if the body is
  /// not pitched. The condition on the angular velocity at this node uses it.
  Eigen::Vector3d roll_axis = Eigen::Vector3d::UnitX();
};

namespace detail {

/// Penalty for violating a constraint of the state, such as a bound on a force or on the angular
/// velocity, by one unit. A constraint whose multiplier would exceed it is relaxed: a measured
/// state may violate the bounds. In the benchmark STEP no multiplier reaches it.
inline constexpr double state_penalty = 1e4;

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

/// Velocity in the body frame [m/s].
[[nodiscard]] inline Triple<double> body_velocity(const BodyStated& body) {
  return transposed(square(body.orientation.toRotationMatrix())) * triple(body.velocity);
}

/// v_By, the angular velocity about the roll axis (w_x) and the height of the CoM over its plane
/// (paper, Eq. mpc_subject).
[[nodiscard]] inline Eigen::Vector3d ground_conditions(const FlightNode& node,
                                                       const BodyStated& body) {
  return {body_velocity(body).y, dot(triple(node.roll_axis), triple(body.angular_velocity)),
          body.position.z() - node.com_plane.height_at(body.position)};
}

/// Derivatives of ground_conditions(). The parts (dp, dv, dtheta, dw) begin in column `first`.
template <typename Derivative>
void put_ground_derivatives(const FlightNode& node, const BodyStated& body, Derivative& H,
                            int first) {
  const Square<double> to_world = square(body.orientation.toRotationMatrix());
  const Triple<double> velocity = body_velocity(body);
  std::fill_n(H.data(), H.size(), 0.0);
  H(0, first + 3) = to_world.y.x;
  H(0, first + 4) = to_world.y.y;
  H(0, first + 5) = to_world.y.z;
  H(0, first + 6) = velocity.z;
  H(0, first + 8) = -velocity.x;
  for (int i = 0; i < 3; ++i) H(1, first + 9 + i) = node.roll_axis(i);
  H(2, first) = -node.com_plane.slope.x();
  H(2, first + 1) = -node.com_plane.slope.y();
  H(2, first + 2) = 1.0;
}

}  // namespace detail
}  // namespace tilt_ropter
