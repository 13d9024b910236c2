// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/actuated_state.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/triple.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/LU>

#include <array>
#include <cmath>
#include <cstddef>

/// Rigid body that is driven by the thrust and the tilt angle of each rotor, with its discrete step
/// and the analytic sensitivity of that step. It needs no inverse of the allocation matrix, so the
/// vehicle may have any rotors.
namespace tilt_ropter {

/// Prediction model at the level of actuators. Thrusts and tilt angles are integrals of the inputs.
/// Rotor i pushes along n_i = (0, -sin alpha_i, cos alpha_i) in its rotor frame. Its wrench at the
/// CoM is F_i = T_i n_i, M_i = r_i x F_i - spin_i torque_ratio_i F_i (paper, Sec. Control
/// Allocation). A rotor that does not tilt has the angle zero. A lost rotor has no wrench.
template <int Rotors, typename Scalar = double>
class ActuatedBody {
 public:
  static constexpr int states = 2 * Rotors + 12, inputs = 2 * Rotors;
  using State = ActuatedState<Rotors, Scalar>;
  using Input = Eigen::Matrix<Scalar, inputs, 1>;
  using StateJacobian = Eigen::Matrix<Scalar, states, states>;
  using InputJacobian = Eigen::Matrix<Scalar, states, inputs>;

  /// Throws std::invalid_argument if the vehicle is not valid.
  explicit ActuatedBody(const Vehicle<Rotors>& vehicle) {
    validate(vehicle);
    mass_ = Scalar(vehicle.body.mass);
    const Eigen::Matrix3d inverse = vehicle.body.inertia.inverse();
    for (int i = 0; i < 9; ++i) {
      inertia_(i) = Scalar(vehicle.body.inertia(i));
      inverse_inertia_(i) = Scalar(inverse(i));
    }
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorGeometry& geometry = vehicle.rotors[i];
      parameters_[i] = rotor_parameters(vehicle, i);
      effectiveness_[i] = geometry.effectiveness;
      tilts_[i] = geometry.tilts;
      if (!(geometry.effectiveness > 0.0)) continue;
      const double drag =
          static_cast<int>(geometry.spin) * rotor_parameters(vehicle, i).torque_ratio;
      const auto push_along = [&](int axis) {
        const detail::Triple<double> force = detail::triple_at(geometry.orientation, 0, axis),
                                     torque =
                                         detail::cross(detail::triple(geometry.position), force) -
                                         drag * force;
        return Push{{Scalar(force.x), Scalar(force.y), Scalar(force.z)},
                    {Scalar(torque.x), Scalar(torque.y), Scalar(torque.z)}};
      };
      rotors_[i].along_z = push_along(2);
      if (geometry.tilts) rotors_[i].along_y = push_along(1);
    }
  }

  [[nodiscard]] const Scalar& mass() const { return mass_; }

  /// Wrench of all rotors at the CoM, body frame.
  [[nodiscard]] Wrench<Scalar> wrench(const State& x) const {
    using std::cos;
    using std::sin;
    Push sum = none();
    for (int i = 0; i < Rotors; ++i) {
      const Scalar s = sin(x.tilt_angle.coeff(i)), c = cos(x.tilt_angle.coeff(i));
      const Push push = rotor(i).at(s, c);
      sum.force += x.thrust.coeff(i) * push.force;
      sum.torque += x.thrust.coeff(i) * push.torque;
    }
    Wrench<Scalar> wrench;
    detail::put(sum.force, wrench.force, 0, 0);
    detail::put(sum.torque, wrench.torque, 0, 0);
    return wrench;
  }

  /// Thrust of rotor i [N] at `speed` [rad/s].
  [[nodiscard]] Scalar thrust(int i, const Scalar& speed) const {
    const auto k = static_cast<std::size_t>(i);
    return Scalar(effectiveness_[k]) * thrust_from_speed(speed, parameters_[k]);
  }

  /// Wrench of rotors with these speeds [rad/s] and tilt angles [rad], body frame.
  [[nodiscard]] Wrench<Scalar> wrench(const ActuatorState<Rotors, Scalar>& actuators) const {
    State x;
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      x.thrust(i) =
          Scalar(effectiveness_[k]) * thrust_from_speed(actuators.rotor_speed(i), parameters_[k]);
      x.tilt_angle(i) = tilts_[k] ? actuators.tilt_angle(i) : Scalar(0);
    }
    return wrench(x);
  }

  /// Returns the state after one classical Runge-Kutta step of `dt` [s]. The rates `u` of thrusts
  /// [N/s] and tilt angles [rad/s] and the `external` wrench (body frame) are constant during the
  /// step. The quaternion is normalised at the end. `freedom` is as in RigidBody::step().
  [[nodiscard]] State step(const State& x, const Input& u, const Wrench<Scalar>& external,
                           const Scalar& dt, const Freedom<Scalar>& freedom = {}) const {
    State next;
    integrate<false>(x, u, external, dt, freedom, next, nullptr, nullptr);
    return next;
  }

  /// The same step with its exact derivative in the tangent coordinates of ActuatedIndex:
  /// dx+ = A dx + B du.
  [[nodiscard]] State step(const State& x, const Input& u, const Wrench<Scalar>& external,
                           const Scalar& dt, const Freedom<Scalar>& freedom, StateJacobian& A,
                           InputJacobian& B) const {
    State next;
    for (Eigen::Index i = 0; i < A.size(); ++i) A.coeffRef(i) = Scalar(0);
    for (Eigen::Index i = 0; i < B.size(); ++i) B.coeffRef(i) = Scalar(0);
    for (int i = 0; i < states; ++i) A.coeffRef(i, i) = Scalar(1);
    integrate<true>(x, u, external, dt, freedom, next, &A, &B);
    return next;
  }

  /// The same, but inlined into the caller. A must be the identity, and B zero, outside of the
  /// entries that can be non-zero.
  [[gnu::always_inline]] inline void step_inline(const State& x, const Input& u,
                                                 const Wrench<Scalar>& external, const Scalar& dt,
                                                 const Freedom<Scalar>& freedom, State& next,
                                                 StateJacobian& A, InputJacobian& B) const {
    integrate<true>(x, u, external, dt, freedom, next, &A, &B);
  }

 private:
  using Triple = detail::Triple<Scalar>;
  using Square = detail::Square<Scalar>;
  using I = ActuatedIndex<Rotors>;

  /// Wrench of a thrust of 1 N.
  struct Push {
    Triple force, torque;
  };
  static Push none() {
    const Triple zero{Scalar(0), Scalar(0), Scalar(0)};
    return {zero, zero};
  }
  struct RotorPush {
    Push along_y = none(), along_z = none();  // axes of the rotor frame

    [[gnu::always_inline]] inline Push at(const Scalar& s, const Scalar& c) const {
      return {c * along_z.force - s * along_y.force, c * along_z.torque - s * along_y.torque};
    }
    // Derivative of at() by the angle.
    [[gnu::always_inline]] inline Push derivative_at(const Scalar& s, const Scalar& c) const {
      return {-s * along_z.force - c * along_y.force, -s * along_z.torque - c * along_y.torque};
    }
  };
  [[nodiscard]] const RotorPush& rotor(int i) const { return rotors_[static_cast<std::size_t>(i)]; }

  // Thrust, sine and cosine of the angle of one rotor at the start, middle and end of a step.
  struct Sample {
    Scalar thrust, s, c;
  };

  // Values of one Runge-Kutta stage that its derivative needs.
  struct Stage {
    Square w_by_w, turned_by_v;          // d(rate of w)/dw, d(rotated force)/dv
    Triple half_w, half_v, turned_by_c;  // turned_by_c: d(rotated force)/dc
    Scalar half_c;
  };

  // The body follows the equations of RigidBody::integrate(). Only the wrench differs: here it is
  // no polynomial of time. A classical Runge-Kutta step reads it at three times: start, middle and
  // end. The sensitivity is first computed by these three wrenches, then by the rotors.
  template <bool WithSensitivity>
  [[gnu::always_inline]] inline void integrate(const State& x, const Input& u,
                                               const Wrench<Scalar>& external, const Scalar& dt,
                                               const Freedom<Scalar>& freedom, State& next,
                                               StateJacobian* A, InputJacobian* B) const {
    using detail::cross;
    using detail::dot;
    using detail::triple;
    using std::cos;
    using std::sin;
    using std::sqrt;
    const Scalar zero(0), one(1), two(2), half(0.5), half_dt = half * dt, sixth = dt / Scalar(6),
                                                     third = dt / Scalar(3),
                                                     position_weight = dt * sixth;
    const Scalar node[4] = {zero, half_dt, half_dt, dt};
    const Scalar velocity_weight[4] = {sixth, third, third, sixth};
    constexpr int sample_of[4] = {0, 1, 1, 2};
    const Triple nothing{zero, zero, zero};
    const Square empty{nothing, nothing, nothing};

    Sample samples[static_cast<std::size_t>(Rotors)][3];
    Push pushed[3];
    for (Push& p : pushed) p = {triple(external.force), triple(external.torque)};
    for (int i = 0; i < Rotors; ++i) {
      const Scalar rate = u.coeff(i), turn = half_dt * u.coeff(Rotors + i);
      const Scalar s_turn = sin(turn), c_turn = cos(turn);
      Sample(&of)[3] = samples[static_cast<std::size_t>(i)];
      of[0] = {x.thrust.coeff(i), sin(x.tilt_angle.coeff(i)), cos(x.tilt_angle.coeff(i))};
      for (int n = 1; n < 3; ++n)
        of[n] = {of[n - 1].thrust + half_dt * rate, of[n - 1].s * c_turn + of[n - 1].c * s_turn,
                 of[n - 1].c * c_turn - of[n - 1].s * s_turn};
      for (int n = 0; n < 3; ++n) {
        const Push push = rotor(i).at(of[n].s, of[n].c);
        pushed[n].force += of[n].thrust * push.force;
        pushed[n].torque += of[n].thrust * push.torque;
      }
    }

    const Scalar &qw = x.body.orientation.coeffs().coeffRef(3),
                 &qx = x.body.orientation.coeffs().coeffRef(0),
                 &qy = x.body.orientation.coeffs().coeffRef(1),
                 &qz = x.body.orientation.coeffs().coeffRef(2);
    const Triple qv{qx, qy, qz};
    const Square rotation = detail::outer(qw * qw - dot(qv, qv), two * qv, qv, (two * qw) * qv);
    const Square inertia = detail::square(inertia_),
                 inverse_inertia =
                     detail::scaled(detail::square(inverse_inertia_), triple(freedom.angular));
    const Triple w0 = triple(x.body.angular_velocity);

    Triple w_rate = nothing, w_sum = nothing, v_rate = nothing, v_sum = nothing;
    Scalar c_rate = zero, c_sum = one;
    Triple velocity_impulse = nothing, position_impulse = nothing;  // in the initial body frame
    Square velocity_by_force[3] = {empty, empty, empty},
           position_by_force[3] = {empty, empty, empty};
    Stage stages[4];

    for (int i = 0; i < 4; ++i) {
      const Scalar t = node[i], weight = velocity_weight[i];
      const int n = sample_of[i];
      const Triple w = w0 + t * w_rate, v = t * v_rate, momentum = inertia * w, f = pushed[n].force;
      const Scalar c = one + t * c_rate, along = dot(v, f), level = c * c - dot(v, v);
      const Triple turned = level * f + (two * along) * v + (two * c) * cross(v, f);
      w_rate = inverse_inertia * (pushed[n].torque - cross(w, momentum));
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
                        detail::outer(zero, (-two) * f, v, nothing);
        const Square turn = detail::outer(level, two * v, v, (two * c) * v);
        velocity_by_force[n] += weight * turn;
        if (i < 3) position_by_force[n] += position_weight * turn;
      }
    }

    const Scalar norm = sqrt(c_sum * c_sum + dot(v_sum, v_sum)), per_norm = one / norm,
                 c = c_sum * per_norm, per_mass = one / mass_, down = Scalar(-gravity) * dt;
    const Square linear = detail::square(freedom.linear), to_world = linear * (per_mass * rotation);
    const Triple v = per_norm * v_sum, fall = down * linear.z;

    for (int i = 0; i < Rotors; ++i) {
      next.thrust.coeffRef(i) = x.thrust.coeff(i) + dt * u.coeff(i);
      next.tilt_angle.coeffRef(i) = x.tilt_angle.coeff(i) + dt * u.coeff(Rotors + i);
    }
    const Triple position = triple(x.body.position) + dt * triple(x.body.velocity) +
                            to_world * position_impulse + half_dt * fall,
                 velocity = triple(x.body.velocity) + to_world * velocity_impulse + fall,
                 angular_velocity = w0 + w_sum;
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

    for (int i = 0; i < inputs; ++i) B->coeffRef(i, i) = dt;
    for (int i = 0; i < 3; ++i) A->coeffRef(I::position + i, I::velocity + i) = dt;
    detail::put(detail::times_cross(to_world, -one * position_impulse), *A, I::position,
                I::orientation);
    detail::put(detail::times_cross(to_world, -one * velocity_impulse), *A, I::velocity,
                I::orientation);
    detail::put(detail::outer(c * c - dot(v, v), two * v, v, (-two * c) * v), *A, I::orientation,
                I::orientation);

    // Derivatives of (p, v, theta, w) by a change `start` of the initial w, or by a torque that
    // changes the rate of w by `push` at the start or in the middle.
    struct Column {
      Triple position, velocity, orientation, angular_velocity;
    };
    const auto column_of = [&](const Triple& start, const Triple& push, int sample)
        __attribute__((always_inline)) {
      Triple dw_rate = nothing, dw_sum = start, dv_rate = nothing, dv_sum = nothing,
             by_velocity = nothing, by_position = nothing;
      Scalar dc_rate = zero, dc_sum = zero;
#pragma GCC unroll 4
      for (int i = 0; i < 4; ++i) {
        const Stage& s = stages[i];
        const Scalar t = node[i], weight = velocity_weight[i];
        const Triple dw = start + t * dw_rate, dv = t * dv_rate;
        const Scalar dc = t * dc_rate;
        const Triple turned = dc * s.turned_by_c + s.turned_by_v * dv;
        dw_rate = s.w_by_w * dw;
        if (sample_of[i] == sample) dw_rate += push;
        // d((c, v) (x) w) / 2
        dc_rate = -dot(dv, s.half_w) - dot(s.half_v, dw);
        dv_rate = dc * s.half_w + cross(dv, s.half_w) + s.half_c * dw + cross(s.half_v, dw);
        dw_sum += weight * dw_rate;
        dc_sum += weight * dc_rate;
        dv_sum += weight * dv_rate;
        by_velocity += weight * turned;
        if (i < 3) by_position += position_weight * turned;
      }
      return Column{to_world * by_position, to_world * by_velocity,
                    (two * per_norm) * (c * dv_sum - cross(v, dv_sum) - dc_sum * v), dw_sum};
    };
    const Triple pushes[3] = {inverse_inertia.x, inverse_inertia.y, inverse_inertia.z};
    // By the torque at the start and in the middle. The torque at the end acts on w alone.
    Square position_by_torque[2], velocity_by_torque[2], orientation_by_torque[2],
        angular_velocity_by_torque[3];
    for (int n = 0; n < 2; ++n) {
      const Column x_axis = column_of(nothing, pushes[0], n),
                   y_axis = column_of(nothing, pushes[1], n),
                   z_axis = column_of(nothing, pushes[2], n);
      position_by_torque[n] = {x_axis.position, y_axis.position, z_axis.position};
      velocity_by_torque[n] = {x_axis.velocity, y_axis.velocity, z_axis.velocity};
      orientation_by_torque[n] = {x_axis.orientation, y_axis.orientation, z_axis.orientation};
      angular_velocity_by_torque[n] = {x_axis.angular_velocity, y_axis.angular_velocity,
                                       z_axis.angular_velocity};
    }
    angular_velocity_by_torque[2] = sixth * inverse_inertia;
    for (int i = 0; i < 3; ++i) {
      const Column of_w = column_of({Scalar(i == 0), Scalar(i == 1), Scalar(i == 2)}, nothing, -1);
      put_column(of_w.position, of_w.velocity, of_w.orientation, of_w.angular_velocity, *A,
                 I::angular_velocity + i);
    }
    for (int n = 0; n < 3; ++n) {
      position_by_force[n] = to_world * position_by_force[n];
      velocity_by_force[n] = to_world * velocity_by_force[n];
    }

    for (int i = 0; i < Rotors; ++i) {
      const Sample(&of)[3] = samples[static_cast<std::size_t>(i)];
      Column by_thrust[3], by_angle[3];
      for (int n = 0; n < 3; ++n) {
        const auto effect = [&](const Push& push) __attribute__((always_inline)) {
          Column column{nothing, velocity_by_force[n] * push.force, nothing,
                        angular_velocity_by_torque[n] * push.torque};
          if (n == 2) return column;
          column.position = position_by_force[n] * push.force + position_by_torque[n] * push.torque;
          column.velocity += velocity_by_torque[n] * push.torque;
          column.orientation = orientation_by_torque[n] * push.torque;
          return column;
        };
        by_thrust[n] = effect(rotor(i).at(of[n].s, of[n].c));
        by_angle[n] = effect(rotor(i).derivative_at(of[n].s, of[n].c));
      }
      const auto put_sum = [&](const Column(&of_sample)[3], const Scalar& start,
                               const Scalar& middle, const Scalar& end, auto& jacobian, int column)
          __attribute__((always_inline)) {
        put_column(start * of_sample[0].position + middle * of_sample[1].position,
                   start * of_sample[0].velocity + middle * of_sample[1].velocity +
                       end * of_sample[2].velocity,
                   start * of_sample[0].orientation + middle * of_sample[1].orientation,
                   start * of_sample[0].angular_velocity + middle * of_sample[1].angular_velocity +
                       end * of_sample[2].angular_velocity,
                   jacobian, column);
      };
      put_sum(by_thrust, one, one, one, *A, I::thrust + i);
      put_sum(by_thrust, zero, half_dt, dt, *B, I::thrust + i);
      put_sum(by_angle, of[0].thrust, of[1].thrust, of[2].thrust, *A, I::tilt_angle + i);
      put_sum(by_angle, zero, half_dt * of[1].thrust, dt * of[2].thrust, *B, I::tilt_angle + i);
    }
  }

  template <typename Matrix>
  [[gnu::always_inline]] static inline void put_column(const Triple& position,
                                                       const Triple& velocity,
                                                       const Triple& orientation,
                                                       const Triple& angular_velocity,
                                                       Matrix& jacobian, int column) {
    detail::put(position, jacobian, I::position, column);
    detail::put(velocity, jacobian, I::velocity, column);
    detail::put(orientation, jacobian, I::orientation, column);
    detail::put(angular_velocity, jacobian, I::angular_velocity, column);
  }

  Scalar mass_;
  Matrix3<Scalar> inertia_, inverse_inertia_;
  std::array<RotorPush, static_cast<std::size_t>(Rotors)> rotors_{};
  // For the wrench of speeds:
  std::array<RotorParameters, static_cast<std::size_t>(Rotors)> parameters_{};
  std::array<double, static_cast<std::size_t>(Rotors)> effectiveness_{};
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};
};

}  // namespace tilt_ropter
