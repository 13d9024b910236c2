// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/triple.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include <type_traits>

/// Rigid body under an actuator wrench and an external wrench (paper, Sec. Rigid Body Dynamics,
/// Eqs. rb1-rb4), with its discrete step and the analytic sensitivity of that step.
namespace tilt_ropter {

/// Accelerations that a support leaves free. Wheels on the ground remove the acceleration along the
/// ground's normal and the angular acceleration about body x. The ground's reaction then needs no
/// model.
template <typename Scalar>
struct Freedom {
  Matrix3<Scalar> linear = Matrix3<Scalar>::Identity();  ///< projection matrix, world frame
  Vector3<Scalar> angular = Vector3<Scalar>::Ones();     ///< per body axis: 1 free, 0 held
};
using Freedomd = Freedom<double>;  ///< in double precision

/// Time derivative of a BodyState.
template <typename Scalar>
struct BodyDerivative {
  Vector3<Scalar> velocity;               ///< dp/dt [m/s]
  Vector3<Scalar> acceleration;           ///< dv/dt, world frame [m/s^2]
  Eigen::Quaternion<Scalar> orientation;  ///< dq/dt, not a unit quaternion [1/s]
  Vector3<Scalar> angular_acceleration;   ///< body frame [rad/s^2]
};
using BodyDerivatived = BodyDerivative<double>;  ///< in double precision

/// Prediction model of the controller. The actuator wrench (F, M) is the integral of its rate and
/// drives the body.
template <typename Scalar>
class RigidBody {
 public:
  using WrenchRate = Eigen::Matrix<Scalar, 6, 1>;
  using StateJacobian = Eigen::Matrix<Scalar, 18, 18>;
  using InputJacobian = Eigen::Matrix<Scalar, 18, 6>;

  /// Throws std::invalid_argument if no rigid body has these `parameters`.
  explicit RigidBody(const RigidBodyParameters& parameters) {
    validate(parameters);
    mass_ = Scalar(parameters.mass);
    const Eigen::Matrix3d inverse = parameters.inertia.inverse();
    for (int i = 0; i < 9; ++i) {
      inertia_(i) = Scalar(parameters.inertia(i));
      inverse_inertia_(i) = Scalar(inverse(i));
    }
  }

  [[nodiscard]] const Scalar& mass() const { return mass_; }
  [[nodiscard]] const Matrix3<Scalar>& inertia() const { return inertia_; }

  /// Returns the derivative by Eqs. rb1-rb4. `wrench` is the sum of all wrenches at the CoM, body
  /// frame.
  [[nodiscard]] BodyDerivative<Scalar> derivative(const BodyState<Scalar>& body,
                                                  const Wrench<Scalar>& wrench) const {
    const Vector3<Scalar> w = body.angular_velocity;
    const Vector3<Scalar> half = w / Scalar(2);
    BodyDerivative<Scalar> d;
    d.velocity = body.velocity;
    d.acceleration = body.orientation.toRotationMatrix() * wrench.force / mass_;
    d.acceleration.z() -= Scalar(gravity);
    d.orientation =
        body.orientation * Eigen::Quaternion<Scalar>(Scalar(0), half.x(), half.y(), half.z());
    d.angular_acceleration = inverse_inertia_ * (wrench.torque - w.cross(inertia_ * w));
    return d;
  }

  /// Returns the state after one classical Runge-Kutta step of `dt` [s]. The wrench rate `u` (body
  /// frame, [N/s; N m/s]) and the `external` wrench (body frame) are constant during the step. The
  /// quaternion is normalised at the end.
  [[nodiscard]] State<Scalar> step(const State<Scalar>& x, const WrenchRate& u,
                                   const Wrench<Scalar>& external, Scalar dt,
                                   const Freedom<Scalar>& freedom = {}) const {
    State<Scalar> next;
    integrate<false>(x, u, external, dt, freedom, next, nullptr, nullptr);
    return next;
  }

  /// The same step with its exact derivative in tangent coordinates (dF, dM, dp, dv, dtheta, dw):
  /// dx+ = A dx + B du.
  [[nodiscard]] State<Scalar> step(const State<Scalar>& x, const WrenchRate& u,
                                   const Wrench<Scalar>& external, Scalar dt,
                                   const Freedom<Scalar>& freedom, StateJacobian& A,
                                   InputJacobian& B) const {
    State<Scalar> next;
    integrate<true>(x, u, external, dt, freedom, next, &A, &B);
    return next;
  }

  /// The same, but inlined into the caller. Writes the state to `next`.
  [[gnu::always_inline]] inline void step_inline(const State<Scalar>& x, const WrenchRate& u,
                                                 const Wrench<Scalar>& external, const Scalar& dt,
                                                 const Freedom<Scalar>& freedom,
                                                 State<Scalar>& next, StateJacobian& A,
                                                 InputJacobian& B) const {
    integrate<true>(x, u, external, dt, freedom, next, &A, &B);
  }

 private:
  using Triple = detail::Triple<Scalar>;
  using Square = detail::Square<Scalar>;

  // Values of one Runge-Kutta stage that its derivative needs.
  struct Stage {
    Square w_by_w, turned_by_v;          // d(rate of w)/dw, d(rotated force)/dv
    Triple half_w, half_v, turned_by_c;  // turned_by_c: d(rotated force)/dc
    Scalar half_c;
  };

  // The attitude equation is linear in q from the left. Every stage of the Runge-Kutta step is
  // therefore q (x) (c, v), where (c, v) starts at identity and depends on w only. The dependencies
  // form a chain: (M, dM, w) -> w stages -> (c, v) stages -> force stages -> (v, p). The derivative
  // with respect to the initial attitude is the cross product with the integrated impulse.
  template <bool WithSensitivity>
  [[gnu::always_inline]] inline void integrate(const State<Scalar>& x, const WrenchRate& rate,
                                               const Wrench<Scalar>& external, const Scalar& dt,
                                               const Freedom<Scalar>& freedom, State<Scalar>& next,
                                               StateJacobian* A, InputJacobian* B) const {
    using detail::cross;
    using detail::dot;
    using detail::triple;
    using std::sqrt;
    const Scalar zero(0), one(1), two(2), half(0.5),
        half_dt = half * dt, sixth = dt / Scalar(6), third = dt / Scalar(3),
        position_weight = dt * sixth;  // weight of the first three stages
    const Scalar node[4] = {zero, half_dt, half_dt, dt};
    const Scalar velocity_weight[4] = {sixth, third, third, sixth};

    const Scalar &qw = x.body.orientation.coeffs().coeffRef(3),
                 &qx = x.body.orientation.coeffs().coeffRef(0),
                 &qy = x.body.orientation.coeffs().coeffRef(1),
                 &qz = x.body.orientation.coeffs().coeffRef(2);
    const Triple qv{qx, qy, qz};
    const Square rotation = detail::outer(qw * qw - dot(qv, qv), two * qv, qv, (two * qw) * qv);
    const Square inertia = detail::square(inertia_),
                 inverse_inertia =
                     detail::scaled(detail::square(inverse_inertia_), triple(freedom.angular));
    const Triple w0 = triple(x.body.angular_velocity), none{zero, zero, zero};
    const Triple force0 = triple(x.wrench.force) + triple(external.force),
                 torque0 = triple(x.wrench.torque) + triple(external.torque),
                 force_rate = detail::triple_at(rate, TangentIndex::force),
                 torque_rate = detail::triple_at(rate, TangentIndex::torque);

    Triple w_rate = none, w_sum = none, v_rate = none, v_sum = none;
    Scalar c_rate = zero, c_sum = one;
    Triple velocity_impulse = none, position_impulse = none;  // in the initial body frame
    const Square empty{none, none, none};
    Square velocity_by_force = empty, velocity_by_rate = empty, position_by_force = empty,
           position_by_rate = empty;
    Stage stages[4];

    for (int i = 0; i < 4; ++i) {
      const Scalar t = node[i], weight = velocity_weight[i];
      const Triple w = w0 + t * w_rate, v = t * v_rate, momentum = inertia * w,
                   f = force0 + t * force_rate;
      const Scalar c = one + t * c_rate, along = dot(v, f), level = c * c - dot(v, v);
      const Triple turned = level * f + (two * along) * v + (two * c) * cross(v, f);
      w_rate = inverse_inertia * (torque0 + t * torque_rate - cross(w, momentum));
      c_rate = -half * dot(v, w);
      v_rate = (half * c) * w + half * cross(v, w);
      w_sum += weight * w_rate;
      c_sum += weight * c_rate;
      v_sum += weight * v_rate;
      velocity_impulse += weight * turned;
      if (i < 3) position_impulse += position_weight * turned;

      if constexpr (WithSensitivity) {
        Stage& s = stages[i];
        s.w_by_w = inverse_inertia * detail::gyroscopic(inertia, w, momentum);
        s.half_w = half * w;
        s.half_v = half * v;
        s.half_c = half * c;
        s.turned_by_c = (two * c) * f + two * cross(v, f);
        s.turned_by_v = detail::outer(two * along, two * v, f, (-two * c) * f) +
                        detail::outer(zero, (-two) * f, v, none);
        const Square turn = detail::outer(level, two * v, v, (two * c) * v);
        velocity_by_force += weight * turn;
        velocity_by_rate += (weight * t) * turn;
        if (i < 3) {
          position_by_force += position_weight * turn;
          position_by_rate += (position_weight * t) * turn;
        }
      }
    }

    const Scalar norm = sqrt(c_sum * c_sum + dot(v_sum, v_sum)), per_norm = one / norm,
                 c = c_sum * per_norm, per_mass = one / mass_, down = Scalar(-gravity) * dt;
    const Square linear = detail::square(freedom.linear), to_world = linear * (per_mass * rotation);
    const Triple v = per_norm * v_sum, fall = down * linear.z;

    next.wrench.force = x.wrench.force;
    next.wrench.torque = x.wrench.torque;
    const Triple position = triple(x.body.position) + dt * triple(x.body.velocity) +
                            to_world * position_impulse + half_dt * fall,
                 velocity = triple(x.body.velocity) + to_world * velocity_impulse + fall,
                 angular_velocity = w0 + w_sum;
    detail::put(triple(x.wrench.force) + dt * force_rate, next.wrench.force, 0, 0);
    detail::put(triple(x.wrench.torque) + dt * torque_rate, next.wrench.torque, 0, 0);
    detail::put(position, next.body.position, 0, 0);
    detail::put(velocity, next.body.velocity, 0, 0);
    detail::put(angular_velocity, next.body.angular_velocity, 0, 0);
    const Scalar real = qw * c - dot(qv, v);
    const Triple vector = qw * v + c * qv + cross(qv, v);
    const Scalar per_length = one / sqrt(real * real + dot(vector, vector));
    auto& orientation = next.body.orientation.coeffs();
    detail::put(per_length * vector, orientation, 0, 0);
    orientation.coeffRef(3) = per_length * real;
    if constexpr (!WithSensitivity) return;

    using I = TangentIndex;
    for (int i = 0; i < 18 * 18; ++i) A->coeffRef(i) = zero;
    for (int i = 0; i < 18 * 6; ++i) B->coeffRef(i) = zero;
    for (int i = 0; i < 18; ++i) A->coeffRef(i, i) = one;
    for (int i = 0; i < 6; ++i) B->coeffRef(i, i) = dt;
    for (int i = 0; i < 3; ++i) A->coeffRef(I::position + i, I::velocity + i) = dt;
    detail::put(to_world * position_by_force, *A, I::position, I::force);
    detail::put(to_world * velocity_by_force, *A, I::velocity, I::force);
    detail::put(to_world * position_by_rate, *B, I::position, I::force);
    detail::put(to_world * velocity_by_rate, *B, I::velocity, I::force);
    detail::put(detail::times_cross(to_world, -one * position_impulse), *A, I::position,
                I::orientation);
    detail::put(detail::times_cross(to_world, -one * velocity_impulse), *A, I::velocity,
                I::orientation);
    detail::put(detail::outer(c * c - dot(v, v), two * v, v, (-two * c) * v), *A, I::orientation,
                I::orientation);

    // Sets one column of the derivatives with respect to M, dM or w. `start` is the derivative of
    // the initial w. `push` and `push_rate` are the constant and the linear part in time of the
    // derivative of the rate of w.
    const auto set_column = [&](const Triple& start, const Triple& push, const Triple& push_rate,
                                auto& jacobian, int column) __attribute__((always_inline)) {
      Triple dw_rate = none, dw_sum = start, dv_rate = none, dv_sum = none, by_velocity = none,
             by_position = none;
      Scalar dc_rate = zero, dc_sum = zero;
#pragma GCC unroll 4
      for (int i = 0; i < 4; ++i) {
        const Stage& s = stages[i];
        const Scalar t = node[i], weight = velocity_weight[i];
        const Triple dw = start + t * dw_rate, dv = t * dv_rate;
        const Scalar dc = t * dc_rate;
        const Triple turned = dc * s.turned_by_c + s.turned_by_v * dv;
        dw_rate = s.w_by_w * dw + push + t * push_rate;
        // d((c, v) (x) w) / 2
        dc_rate = -dot(dv, s.half_w) - dot(s.half_v, dw);
        dv_rate = dc * s.half_w + cross(dv, s.half_w) + s.half_c * dw + cross(s.half_v, dw);
        dw_sum += weight * dw_rate;
        dc_sum += weight * dc_rate;
        dv_sum += weight * dv_rate;
        by_velocity += weight * turned;
        if (i < 3) by_position += position_weight * turned;
      }
      detail::put(to_world * by_position, jacobian, I::position, column);
      detail::put(to_world * by_velocity, jacobian, I::velocity, column);
      detail::put((two * per_norm) * (c * dv_sum - cross(v, dv_sum) - dc_sum * v), jacobian,
                  I::orientation, column);
      detail::put(dw_sum, jacobian, I::angular_velocity, column);
    };
    const Triple pushes[3] = {inverse_inertia.x, inverse_inertia.y, inverse_inertia.z};
    const auto set_columns = [&](const auto& set) __attribute__((always_inline)) {
      for (int i = 0; i < 3; ++i) {
        set(none, pushes[i], none, *A, I::torque + i);
        set(none, none, pushes[i], *B, I::torque + i);
        set({Scalar(i == 0), Scalar(i == 1), Scalar(i == 2)}, none, none, *A,
            I::angular_velocity + i);
      }
    };
    if constexpr (std::is_arithmetic_v<Scalar>) {
      // Nine calls instead of nine inlined copies save a tenth of the compile time of a program
      // that uses Nmpc.
      set_columns([&](const Triple& start, const Triple& push, const Triple& push_rate,
                      auto& jacobian, int column) __attribute__((noinline)) {
        set_column(start, push, push_rate, jacobian, column);
      });
    } else {
      set_columns(set_column);
    }
  }

  Scalar mass_;
  Matrix3<Scalar> inertia_, inverse_inertia_;
};
using RigidBodyd = RigidBody<double>;  ///< in double precision

}  // namespace tilt_ropter
