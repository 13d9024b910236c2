// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// The Runge-Kutta step of a rigid body that the prediction models of both control levels share.
namespace tilt_ropter {

/// Motion that a support leaves free. Wheels on the ground remove the acceleration along its normal
/// and the rotation about the direction in which they roll. Its reaction then needs no model.
template <typename Scalar>
struct Freedom {
  /// Projection matrix of the acceleration, world frame.
  Matrix3<Scalar> linear = Matrix3<Scalar>::Identity();
  /// Projection matrix of the angular velocity and of its rate, body frame. At the start of a step
  /// the angular velocity loses what the support holds. See held_about().
  Matrix3<Scalar> angular = Matrix3<Scalar>::Identity();
};
using Freedomd = Freedom<double>;  ///< in double precision

/// Side force of wheels that roll without slipping. The wheels give the force along body y that
/// turns the velocity as fast as the body turns; rotors do not move the body along the axle. The
/// defaults mean: no wheels.
template <typename Scalar>
struct Steering {
  /// Acceleration along body y by w, body frame: speed of the wheels times ground's normal [m/s].
  Vector3<Scalar> speed = Vector3<Scalar>::Zero();
  Scalar side{1};  ///< part of the rotors' force along body y that moves the body: 1 or 0
};
using Steeringd = Steering<double>;  ///< in double precision

/// Returns Freedom::angular for a body that a support holds about `axis` (unit vector, body frame),
/// as an impulse about it does: I - J^-1 a a' / (a' J^-1 a). `inverse` is J^-1.
[[nodiscard]] inline Eigen::Matrix3d held_about(const Eigen::Vector3d& axis,
                                                const Eigen::Matrix3d& inverse) noexcept {
  double turned[3], along = 0.0;
  for (int i = 0; i < 3; ++i) {
    turned[i] = inverse(i, 0) * axis.x() + inverse(i, 1) * axis.y() + inverse(i, 2) * axis.z();
    along += axis(i) * turned[i];
  }
  Eigen::Matrix3d kept;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) kept(i, j) = (i == j ? 1.0 : 0.0) - turned[i] * axis(j) / along;
  return kept;
}

namespace detail {

/// Mass and inertia as scalars of the step.
template <typename Scalar>
struct BodyInertia {
  Scalar mass;                               // [kg]
  Matrix3<Scalar> inertia, inverse_inertia;  // about the CoM, body frame [kg m^2]

  explicit BodyInertia(const RigidBodyParameters& parameters) : mass(Scalar(parameters.mass)) {
    const Eigen::Matrix3d inverse = detail::inverse(parameters.inertia);
    for (int i = 0; i < 9; ++i) {
      inertia(i) = Scalar(parameters.inertia(i));
      inverse_inertia(i) = Scalar(inverse(i));
    }
  }
};

/// Force and torque at the CoM, body frame [N; N m].
template <typename Scalar>
struct Push {
  Triple<Scalar> force, torque;
};

/// One classical Runge-Kutta step of a body, with what its derivatives need. The step reads the
/// wrench at three times: the start, the middle and the end. The quaternion is normalised at the
/// end. Every function is inlined into the caller.
///
/// With `Steers`, the force along body y also depends on w, see Steering.
///
/// The attitude equation is linear in q from the left. Every stage of the step is therefore
/// q (x) (c, v), where (c, v) starts at identity and depends on w only. The dependencies form a
/// chain: (torque, w) -> w stages -> (c, v) stages -> force stages -> (v, p). The derivative with
/// respect to the initial attitude is the cross product with the integrated impulse.
template <typename Scalar, bool Steers = false>
class BodyStep {
 public:
  using Triple = detail::Triple<Scalar>;
  using Square = detail::Square<Scalar>;

  /// Derivatives of (p, v, theta, w) by one number.
  struct Column {
    Triple position, velocity, orientation, angular_velocity;
  };

  [[gnu::always_inline]] static inline Triple none() { return {Scalar(0), Scalar(0), Scalar(0)}; }

  [[gnu::always_inline]] inline BodyStep(const BodyInertia<Scalar>& body, const Scalar& dt,
                                         const Freedom<Scalar>& freedom,
                                         const Triple& steering = none())
      : dt_(dt), half_dt_(Scalar(0.5) * dt), sixth_(dt / Scalar(6)), third_(dt / Scalar(3)) {
    if constexpr (Steers) steering_ = body.mass * steering;
    angular_ = square(freedom.angular);
    inverse_inertia_ = angular_ * square(body.inverse_inertia);
  }

  /// Sets `next` to the state after the step. `pushes`: the wrench at start, middle and end. Keeps
  /// what the derivatives need if `WithSensitivity`.
  template <bool WithSensitivity>
  [[gnu::always_inline]] inline void run(const BodyInertia<Scalar>& body,
                                         const BodyState<Scalar>& x,
                                         const Push<Scalar> (&pushes)[3],
                                         const Freedom<Scalar>& freedom, BodyState<Scalar>& next) {
    using std::sqrt;
    const Scalar zero(0), one(1), two(2), half(0.5);
    const Scalar &qw = x.orientation.coeffs().coeffRef(3), &qx = x.orientation.coeffs().coeffRef(0),
                 &qy = x.orientation.coeffs().coeffRef(1), &qz = x.orientation.coeffs().coeffRef(2);
    const Triple qv{qx, qy, qz};
    const Square rotation = outer(qw * qw - dot(qv, qv), two * qv, qv, (two * qw) * qv);
    const Square inertia = square(body.inertia);
    const Triple w0 = angular_ * triple(x.angular_velocity);

    Triple w_rate = none(), w_sum = none(), v_rate = none(), v_sum = none();
    Scalar c_rate = zero, c_sum = one;
    velocity_impulse_ = position_impulse_ = none();
    if constexpr (WithSensitivity)
      for (int n = 0; n < 3; ++n)
        velocity_by_force_[n] = position_by_force_[n] = {none(), none(), none()};
    for (int i = 0; i < 4; ++i) {
      const int n = sample_of(i);
      const Scalar &t = time_of(i), &weight = weight_of(i);
      const Triple w = w0 + t * w_rate, v = t * v_rate, momentum = inertia * w;
      Triple f = pushes[n].force;
      if constexpr (Steers) f.y += dot(steering_, w);
      const Scalar c = one + t * c_rate, along = dot(v, f), level = c * c - dot(v, v);
      const Triple turned = level * f + (two * along) * v + (two * c) * cross(v, f);
      w_rate = inverse_inertia_ * (pushes[n].torque - cross(w, momentum));
      c_rate = -half * dot(v, w);
      v_rate = (half * c) * w + half * cross(v, w);
      w_sum += weight * w_rate;
      c_sum += weight * c_rate;
      v_sum += weight * v_rate;
      velocity_impulse_ += weight * turned;
      if (i < 3) position_impulse_ += (dt_ * sixth_) * turned;

      if constexpr (WithSensitivity) {
        Stage& s = stages_[i];
        s.w_by_w = inverse_inertia_ * gyroscopic(inertia, w, momentum);
        s.half_w = half * w;
        s.half_v = half * v;
        s.half_c = half * c;
        s.turned_by_c = (two * c) * f + two * cross(v, f);
        s.turned_by_v =
            outer(two * along, two * v, f, (-two * c) * f) + outer(zero, (-two) * f, v, none());
        const Square turn = outer(level, two * v, v, (two * c) * v);
        if constexpr (Steers) s.turned_side = turn.y;
        velocity_by_force_[n] += weight * turn;
        if (i < 3) position_by_force_[n] += (dt_ * sixth_) * turn;
      }
    }

    const Scalar norm = sqrt(c_sum * c_sum + dot(v_sum, v_sum));
    per_norm_ = one / norm;
    c_ = c_sum * per_norm_;
    v_ = per_norm_ * v_sum;
    const Square linear = square(freedom.linear);
    to_world_ = linear * ((one / body.mass) * rotation);
    const Triple fall = (Scalar(-gravity) * dt_) * linear.z;
    const Triple position = triple(x.position) + dt_ * triple(x.velocity) +
                            to_world_ * position_impulse_ + half_dt_ * fall,
                 velocity = triple(x.velocity) + to_world_ * velocity_impulse_ + fall,
                 angular_velocity = w0 + w_sum;
    put(position, next.position);
    put(velocity, next.velocity);
    put(angular_velocity, next.angular_velocity);
    const Scalar real = qw * c_ - dot(qv, v_);
    const Triple vector = qw * v_ + c_ * qv + cross(qv, v_);
    const Scalar per_length = one / sqrt(real * real + dot(vector, vector));
    auto& orientation = next.orientation.coeffs();
    put(per_length * vector, orientation);
    orientation.coeffRef(3) = per_length * real;
  }

  // After run<true>():

  /// Derivatives by the force at start, middle or end (`n`) [s/kg, s^2/kg].
  [[gnu::always_inline]] inline Square velocity_by_force(int n) const {
    return to_world_ * velocity_by_force_[n];
  }
  [[gnu::always_inline]] inline Square position_by_force(int n) const {
    return to_world_ * position_by_force_[n];
  }
  /// w after the start of the step by w before it, one column per body axis.
  [[nodiscard]] const Square& kept() const { return angular_; }
  /// Rate of w by the torque, one column per body axis.
  [[nodiscard]] const Square& inverse_inertia() const { return inverse_inertia_; }
  /// Weight of the last stage [s].
  [[nodiscard]] const Scalar& sixth() const { return sixth_; }
  /// Time of sample n after the start [s].
  [[gnu::always_inline]] inline Scalar time_at(int n) const {
    return n == 0 ? Scalar(0) : n == 1 ? half_dt_ : dt_;
  }

  /// Sets the blocks of A by position, velocity and attitude, at the places of the index `I`, but
  /// for its diagonal of ones.
  template <typename I, typename Matrix>
  [[gnu::always_inline]] inline void put_blocks(Matrix& A) const {
    const Scalar one(1), two(2);
    for (int i = 0; i < 3; ++i) A.coeffRef(I::position + i, I::velocity + i) = dt_;
    put(times_cross(to_world_, -one * position_impulse_), A, I::position, I::orientation);
    put(times_cross(to_world_, -one * velocity_impulse_), A, I::velocity, I::orientation);
    put(outer(c_ * c_ - dot(v_, v_), two * v_, v_, (-two * c_) * v_), A, I::orientation,
        I::orientation);
  }

  /// Derivatives by a change `start` of the initial w, and by a torque: add(n, dw_rate) adds the
  /// rate of w that the torque causes at sample `n`.
  template <typename Add>
  [[gnu::always_inline]] inline Column column_of(const Triple& start, const Add& add) const {
    Triple dw_rate = none(), dw_sum = start, dv_rate = none(), dv_sum = none(),
           by_velocity = none(), by_position = none();
    Scalar dc_rate(0), dc_sum(0);
#pragma GCC unroll 4
    for (int i = 0; i < 4; ++i) {
      const Stage& s = stages_[i];
      const Scalar &t = time_of(i), &weight = weight_of(i);
      const Triple dw = start + t * dw_rate, dv = t * dv_rate;
      const Scalar dc = t * dc_rate;
      Triple turned = dc * s.turned_by_c + s.turned_by_v * dv;
      if constexpr (Steers) turned += dot(steering_, dw) * s.turned_side;
      dw_rate = s.w_by_w * dw;
      add(sample_of(i), dw_rate);
      // d((c, v) (x) w) / 2
      dc_rate = -dot(dv, s.half_w) - dot(s.half_v, dw);
      dv_rate = dc * s.half_w + cross(dv, s.half_w) + s.half_c * dw + cross(s.half_v, dw);
      dw_sum += weight * dw_rate;
      dc_sum += weight * dc_rate;
      dv_sum += weight * dv_rate;
      by_velocity += weight * turned;
      if (i < 3) by_position += (dt_ * sixth_) * turned;
    }
    return {to_world_ * by_position, to_world_ * by_velocity,
            (Scalar(2) * per_norm_) * (c_ * dv_sum - cross(v_, dv_sum) - dc_sum * v_), dw_sum};
  }

  /// Writes a column to a Jacobian with the index `I`.
  template <typename I, typename Matrix>
  [[gnu::always_inline]] static inline void put_column(const Column& of, Matrix& jacobian,
                                                       int column) {
    put(of.position, jacobian, I::position, column);
    put(of.velocity, jacobian, I::velocity, column);
    put(of.orientation, jacobian, I::orientation, column);
    put(of.angular_velocity, jacobian, I::angular_velocity, column);
  }

 private:
  // Returns the derivative of -w x (J w) with respect to w. `inertia` is J, `momentum` is J w.
  [[gnu::always_inline]] static inline Square gyroscopic(const Square& inertia, const Triple& w,
                                                         const Triple& momentum) {
    const Scalar zero(0);
    return {Triple{zero, momentum.z, -momentum.y} - cross(w, inertia.x),
            Triple{-momentum.z, zero, momentum.x} - cross(w, inertia.y),
            Triple{momentum.y, -momentum.x, zero} - cross(w, inertia.z)};
  }

  // Values of one Runge-Kutta stage that its derivative needs.
  struct Stage {
    Square w_by_w, turned_by_v;          // d(rate of w)/dw, d(rotated force)/dv
    Triple half_w, half_v, turned_by_c;  // turned_by_c: d(rotated force)/dc
    Triple turned_side;                  // d(rotated force)/d(force along body y), if it steers
    Scalar half_c;
  };

  // Sample, time and weight of a stage.
  [[gnu::always_inline]] static inline int sample_of(int stage) {
    return (stage + 1) / 2;
  }
  [[gnu::always_inline]] inline Scalar time_of(int stage) const {
    return time_at(sample_of(stage));
  }
  [[gnu::always_inline]] inline const Scalar& weight_of(int stage) const {
    return stage == 0 || stage == 3 ? sixth_ : third_;
  }

  Scalar dt_, half_dt_, sixth_, third_;
  Square angular_;          // projection of w
  Triple steering_;         // force along body y by w, if it steers
  Square inverse_inertia_;  // of the free rotations
  Stage stages_[4];
  Square velocity_by_force_[3], position_by_force_[3];  // in the initial body frame
  Triple velocity_impulse_, position_impulse_;          // in the initial body frame
  Scalar c_, per_norm_;
  Triple v_;
  Square to_world_;  // rotation over mass, of the free axes
};

}  // namespace detail

}  // namespace tilt_ropter
