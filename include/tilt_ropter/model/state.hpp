// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <optional>

/// Wrench, also about other points and in other frames; states of actuators, body and NMPC; points
/// of a reference, and surfaces that it pushes on. No function in this header throws or allocates.
namespace tilt_ropter {

/// Force [N] and torque [N m] at the CoM, both in the body frame. transport() and wrench_in_world()
/// convert them to other points and frames.
template <typename Scalar>
struct Wrench {
  Vector3<Scalar> force = Vector3<Scalar>::Zero();
  Vector3<Scalar> torque = Vector3<Scalar>::Zero();
};
using Wrenchd = Wrench<double>;  ///< in double precision

/// Sum of two wrenches about the same point, in the same frame.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> operator+(const Wrench<Scalar>& a, const Wrench<Scalar>& b) noexcept {
  return {a.force + b.force, a.torque + b.torque};
}

/// Speed and tilt angle of every rotor: commanded, measured, modelled or true values.
template <int Rotors, typename Scalar = double>
struct ActuatorState {
  Eigen::Matrix<Scalar, Rotors, 1> rotor_speed =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [rad/s], >= 0
  Eigen::Matrix<Scalar, Rotors, 1> tilt_angle =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< about the rotor frame's x [rad]
};

/// Pose and twist of the body frame, the output of a state estimator.
template <typename Scalar>
struct BodyState {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< CoM in the world frame (ENU) [m]
  Vector3<Scalar> velocity = Vector3<Scalar>::Zero();  ///< CoM in the world frame [m/s]
  Eigen::Quaternion<Scalar> orientation =
      Eigen::Quaternion<Scalar>::Identity();                   ///< body -> world, unit
  Vector3<Scalar> angular_velocity = Vector3<Scalar>::Zero();  ///< body frame [rad/s]
};
using BodyStated = BodyState<double>;  ///< in double precision

/// State of the paper's NMPC, x = (F, M, p, v, q, w) (paper, Sec. States and Inputs).
template <typename Scalar>
struct State {
  Wrench<Scalar> wrench;
  BodyState<Scalar> body;
};
using Stated = State<double>;  ///< in double precision

/// Tangent vector of a State: (dF, dM, dp, dv, dtheta, dw), with dtheta in the body frame.
template <typename Scalar>
using StateTangent = Eigen::Matrix<Scalar, 18, 1>;
using StateTangentd = StateTangent<double>;  ///< in double precision

/// First index of each part of a StateTangent. Those of a wrench are also those of its rate.
struct TangentIndex {
  static constexpr int force = 0, torque = 3, position = 6, velocity = 9, orientation = 12,
                       angular_velocity = 15;
};

namespace detail {

/// Returns body (+) dx, where dx holds (dp, dv, dtheta, dw) from index `first` on.
template <typename Scalar, typename Tangent>
[[nodiscard]] BodyState<Scalar> retract_body(const BodyState<Scalar>& body, const Tangent& dx,
                                             int first) {
  BodyState<Scalar> moved;
  const auto add = [&dx](const Vector3<Scalar>& from, int index, Vector3<Scalar>& to) {
    for (int i = 0; i < 3; ++i) to(i) = from(i) + dx(index + i);
  };
  add(body.position, first, moved.position);
  add(body.velocity, first + 3, moved.velocity);
  const int r = first + 6;
  moved.orientation =
      (body.orientation * quaternion_exp(Vector3<Scalar>(dx(r), dx(r + 1), dx(r + 2))))
          .normalized();
  add(body.angular_velocity, first + 9, moved.angular_velocity);
  return moved;
}

/// Writes y (-) x as (dp, dv, dtheta, dw) from index `first` of dx on.
template <typename Scalar, typename Tangent>
void subtract_body(const BodyState<Scalar>& y, const BodyState<Scalar>& x, Tangent& dx, int first) {
  const auto subtract = [&dx](const Vector3<Scalar>& to, const Vector3<Scalar>& from, int index) {
    for (int i = 0; i < 3; ++i) dx(index + i) = to(i) - from(i);
  };
  subtract(y.position, x.position, first);
  subtract(y.velocity, x.velocity, first + 3);
  const Vector3<Scalar> turn =
      quaternion_log(Eigen::Quaternion<Scalar>(x.orientation.conjugate() * y.orientation));
  for (int i = 0; i < 3; ++i) dx(first + 6 + i) = turn(i);
  subtract(y.angular_velocity, x.angular_velocity, first + 9);
}

}  // namespace detail

/// Returns x (+) dx: the state reached from x along the tangent vector dx.
template <typename Scalar>
[[nodiscard]] State<Scalar> retract(const State<Scalar>& x, const StateTangent<Scalar>& dx) {
  using I = TangentIndex;
  State<Scalar> y;
  for (int i = 0; i < 3; ++i) {
    y.wrench.force(i) = x.wrench.force(i) + dx(I::force + i);
    y.wrench.torque(i) = x.wrench.torque(i) + dx(I::torque + i);
  }
  y.body = detail::retract_body(x.body, dx, I::position);
  return y;
}

/// Returns y (-) x: the tangent vector from x to y, so that retract(x, difference(y, x)) = y.
template <typename Scalar>
[[nodiscard]] StateTangent<Scalar> difference(const State<Scalar>& y, const State<Scalar>& x) {
  using I = TangentIndex;
  StateTangent<Scalar> dx;
  for (int i = 0; i < 3; ++i) {
    dx(I::force + i) = y.wrench.force(i) - x.wrench.force(i);
    dx(I::torque + i) = y.wrench.torque(i) - x.wrench.torque(i);
  }
  detail::subtract_body(y.body, x.body, dx, I::position);
  return dx;
}

/// Returns true if every number is finite and the quaternion can be normalised.
template <typename Scalar>
[[nodiscard]] bool is_finite(const BodyState<Scalar>& x) noexcept {
  return all_finite(x.position) && all_finite(x.velocity) && all_finite(x.orientation.coeffs()) &&
         x.orientation.squaredNorm() > Scalar(1e-6) && all_finite(x.angular_velocity);
}

/// Returns true if every number is finite.
template <typename Scalar>
[[nodiscard]] bool is_finite(const Wrench<Scalar>& w) noexcept {
  return all_finite(w.force) && all_finite(w.torque);
}

/// Returns the wrench about another point, in the same frame, with torque M + lever x F. `lever`
/// [m] points from the reference point of the result to the reference point of `wrench`. Examples:
/// A force at point p of the body frame is transport({force, zero}, p) about the CoM. An estimate
/// about the CoM is transport(estimate, -p) about p.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> transport(const Wrench<Scalar>& wrench,
                                       const Vector3<Scalar>& lever) noexcept {
  return {wrench.force, wrench.torque + lever.cross(wrench.force)};
}

/// Returns a body-frame wrench in world axes, about the CoM. `orientation`: body -> world, unit.
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> wrench_in_world(
    const Wrench<Scalar>& in_body, const Eigen::Quaternion<Scalar>& orientation) noexcept {
  return {orientation * in_body.force, orientation * in_body.torque};
}

/// Inverse of wrench_in_world().
template <typename Scalar>
[[nodiscard]] Wrench<Scalar> wrench_in_body(const Wrench<Scalar>& in_world,
                                            const Eigen::Quaternion<Scalar>& orientation) noexcept {
  return wrench_in_world(in_world, orientation.conjugate());
}

/// A plane in the world that a tool of the vehicle may touch. It need not be vertical.
struct Surface {
  Eigen::Vector3d point = Eigen::Vector3d::Zero();     ///< on the surface, world frame [m]
  Eigen::Vector3d normal = -Eigen::Vector3d::UnitX();  ///< outward unit vector, world frame
  /// Point of the vehicle that touches, body frame [m]. The further the line of the push passes
  /// from the CoM, the larger is the torque that it needs.
  Eigen::Vector3d tool = Eigen::Vector3d::Zero();
  double friction = 0.5;  ///< Coulomb coefficient
};

/// A force on a surface.
struct SurfacePush {
  Surface surface;
  double force = 0.0;  ///< along the inward normal, > 0 [N]
};

/// Returns true if all numbers are finite, the force is positive and the normal has length one.
[[nodiscard]] inline bool is_usable(const SurfacePush& push) noexcept {
  const Surface& s = push.surface;
  double sum = s.friction + push.force;  // finite if all numbers are
  for (int i = 0; i < 3; ++i) sum += s.point(i) + s.tool(i);
  return std::isfinite(sum) && std::abs(s.normal.squaredNorm() - 1.0) < 1e-6 && s.friction >= 0.0 &&
         push.force > 0.0;
}

/// Returns the part of `velocity` along the surface, zero if too slow to slide (world frame) [m/s].
[[nodiscard]] inline Eigen::Vector3d slide_along(const Surface& surface,
                                                 const Eigen::Vector3d& velocity) noexcept {
  constexpr double least = 1e-3;  // [m/s]
  const double off = surface.normal.dot(velocity);
  Eigen::Vector3d along = velocity;
  for (int i = 0; i < 3; ++i) along(i) -= off * surface.normal(i);
  if (!(along.squaredNorm() > least * least)) along.setZero();
  return along;
}

/// A half-space that the CoM stays in: normal . position >= least.
struct HalfSpace {
  /// Unit vector into the half-space, world frame. Zero: the whole space, if `least` is zero.
  Eigen::Vector3d normal = Eigen::Vector3d::Zero();
  double least = 0.0;  ///< [m]

  /// Returns how far `position` (world frame) is outside [m], negative inside.
  [[nodiscard]] double beyond(const Eigen::Vector3d& position) const noexcept {
    double inside = 0.0;
    for (int i = 0; i < 3; ++i) inside += normal(i) * position(i);
    return least - inside;
  }
};

/// Returns true if all numbers are finite and the normal has length one, or all numbers are zero.
[[nodiscard]] inline bool is_usable(const HalfSpace& h) noexcept {
  double length = 0.0;  // squared
  for (int i = 0; i < 3; ++i) length += h.normal(i) * h.normal(i);
  return std::isfinite(h.least) &&
         (std::abs(length - 1.0) < 1e-6 || (length == 0.0 && h.least == 0.0));
}

/// Returns the half-space in which a vehicle of this radius about its CoM [m] does not reach
/// `surface`.
[[nodiscard]] inline HalfSpace in_front_of(const Surface& surface, double radius) noexcept {
  return {surface.normal, radius - HalfSpace{surface.normal, 0.0}.beyond(surface.point)};
}

/// One point of a time-parametrised reference. A reference is any callable that returns a point:
/// `ReferencePoint reference(double time)`. It must be defined for every time: it holds the first
/// point before its start and the last point after its end. It must be smooth enough that velocity
/// and angular velocity are the derivatives of position and orientation.
struct ReferencePoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();               ///< CoM, world frame [m]
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();               ///< world frame [m/s]
  Eigen::Vector3d acceleration = Eigen::Vector3d::Zero();           ///< world frame [m/s^2]
  Eigen::Quaterniond orientation = Eigen::Quaterniond::Identity();  ///< body -> world
  Eigen::Vector3d angular_velocity = Eigen::Vector3d::Zero();       ///< body frame [rad/s]
  Eigen::Vector3d angular_acceleration =
      Eigen::Vector3d::Zero();  ///< derivative of angular_velocity, body frame [rad/s^2]
  /// The vehicle pushes on a surface here. Position and velocity along its normal are then not
  /// followed: the vehicle comes closer, at most at 0.1 m/s, until its tool touches, and holds the
  /// force. The rest of the point is followed as ever, for example to slide along the surface.
  /// ContactEstimator has to know the reference. In the air only.
  std::optional<SurfacePush> push;
  /// Half-spaces in which the CoM stays at this time, also if the reference or the way to it is
  /// outside. They may differ from time to time, as those of a corridor do. See in_front_of().
  std::array<HalfSpace, 4> inside;
};

/// Returns `point`, or if it is outside `h` the nearest point inside, which only moves along the
/// boundary.
[[nodiscard]] inline ReferencePoint held_inside(const HalfSpace& h, ReferencePoint point) noexcept {
  const double beyond = h.beyond(point.position);
  if (!(beyond > 0.0)) return point;
  const double v = h.normal.dot(point.velocity), a = h.normal.dot(point.acceleration);
  for (int i = 0; i < 3; ++i) {
    point.position(i) += beyond * h.normal(i);
    point.velocity(i) -= v * h.normal(i);
    point.acceleration(i) -= a * h.normal(i);
  }
  return point;
}

}  // namespace tilt_ropter
