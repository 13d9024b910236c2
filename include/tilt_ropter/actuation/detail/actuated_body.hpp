// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/model/detail/body_step.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <array>
#include <cmath>
#include <cstddef>

/// Rigid body that is driven by the thrust and the tilt angle of each rotor, with its step and the
/// analytic sensitivity of that step. It needs no inverse of A: the vehicle may have any rotors.
namespace tilt_ropter {

/// Thrust and tilt angle of each rotor, and the body state.
template <int Rotors, typename Scalar = double>
struct ActuatedState {
  using Vector = Eigen::Matrix<Scalar, Rotors, 1>;
  Vector thrust = Vector::Zero();      ///< [N]
  Vector tilt_angle = Vector::Zero();  ///< about the rotor frame's x [rad]
  BodyState<Scalar> body;
};

/// First index of each part of a tangent vector of ActuatedState: (dT, dalpha, dp, dv, dtheta, dw),
/// with dtheta in the body frame. In an input, the thrust rates come first, then the tilt rates.
template <int Rotors>
struct ActuatedIndex {
  static constexpr int thrust = 0, tilt_angle = Rotors, position = 2 * Rotors,
                       velocity = position + 3, orientation = position + 6,
                       angular_velocity = position + 9;
};

/// Tangent vector of an ActuatedState.
template <int Rotors, typename Scalar = double>
using ActuatedTangent = Eigen::Matrix<Scalar, 2 * Rotors + 12, 1>;

/// Returns x (+) dx.
template <int Rotors, typename Scalar>
[[nodiscard]] ActuatedState<Rotors, Scalar> retract(const ActuatedState<Rotors, Scalar>& x,
                                                    const ActuatedTangent<Rotors, Scalar>& dx) {
  ActuatedState<Rotors, Scalar> y;
  for (int i = 0; i < Rotors; ++i) {
    y.thrust(i) = x.thrust(i) + dx(i);
    y.tilt_angle(i) = x.tilt_angle(i) + dx(Rotors + i);
  }
  y.body = detail::retract_body(x.body, dx, 2 * Rotors);
  return y;
}

/// Returns y (-) x, so that retract(x, difference(y, x)) = y.
template <int Rotors, typename Scalar>
[[nodiscard]] ActuatedTangent<Rotors, Scalar> difference(const ActuatedState<Rotors, Scalar>& y,
                                                         const ActuatedState<Rotors, Scalar>& x) {
  ActuatedTangent<Rotors, Scalar> dx;
  for (int i = 0; i < Rotors; ++i) {
    dx(i) = y.thrust(i) - x.thrust(i);
    dx(Rotors + i) = y.tilt_angle(i) - x.tilt_angle(i);
  }
  detail::subtract_body(y.body, x.body, dx, 2 * Rotors);
  return dx;
}

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
  explicit ActuatedBody(const Vehicle<Rotors>& vehicle) : body_(validated(vehicle).body) {
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorGeometry& geometry = vehicle.rotors[i];
      parameters_[i] = rotor_parameters(vehicle, i);
      effectiveness_[i] = geometry.effectiveness;
      tilts_[i] = geometry.tilts;
      if (!(geometry.effectiveness > 0.0)) continue;
      const auto push_along = [&](int axis) {
        Eigen::Matrix<double, 6, 1> w;
        detail::put_wrench(geometry, parameters_[i], 1.0, axis, 0, w);
        return Push{{Scalar(w(0)), Scalar(w(1)), Scalar(w(2))},
                    {Scalar(w(3)), Scalar(w(4)), Scalar(w(5))}};
      };
      rotors_[i].along_z = push_along(2);
      if (geometry.tilts) rotors_[i].along_y = push_along(1);
    }
  }

  [[nodiscard]] const Scalar& mass() const { return body_.mass; }

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
    detail::put(sum.force, wrench.force);
    detail::put(sum.torque, wrench.torque);
    return wrench;
  }

  /// Direction of the force of a rotor.
  struct Direction {
    Vector3<Scalar> along;       ///< unit vector, body frame
    Vector3<Scalar> derivative;  ///< of `along` by the tilt angle [1/rad]
  };
  /// Direction of the force of rotor i at the tilt angle `angle` [rad]. For a lost rotor both
  /// vectors are zero; for a rotor that does not tilt, at its angle of zero, the derivative is.
  [[nodiscard]] Direction direction(int i, const Scalar& angle) const {
    using std::cos;
    using std::sin;
    const Scalar s = sin(angle), c = cos(angle);
    Direction d;
    detail::put(rotor(i).at(s, c).force, d.along);
    detail::put(rotor(i).derivative_at(s, c).force, d.derivative);
    return d;
  }

  /// Thrust of rotor i [N] at `speed` [rad/s].
  [[nodiscard]] Scalar thrust(int i, const Scalar& speed) const {
    const auto k = detail::size(i);
    return Scalar(effectiveness_[k]) * thrust_from_speed(speed, parameters_[k]);
  }

  /// Wrench of rotors with these speeds [rad/s] and tilt angles [rad], body frame.
  [[nodiscard]] Wrench<Scalar> wrench(const ActuatorState<Rotors, Scalar>& actuators) const {
    State x;
    for (int i = 0; i < Rotors; ++i) {
      x.thrust(i) = thrust(i, actuators.rotor_speed(i));
      x.tilt_angle(i) = tilts_[detail::size(i)] ? actuators.tilt_angle(i) : Scalar(0);
    }
    return wrench(x);
  }

  /// Returns the state after one classical Runge-Kutta step of `dt` [s]. The rates `u` of thrusts
  /// [N/s] and tilt angles [rad/s] and the `external` wrench (body frame) are constant during the
  /// step. The quaternion is normalised at the end. `freedom` is as in RigidBody::step().
  [[nodiscard]] State step(const State& x, const Input& u, const Wrench<Scalar>& external,
                           const Scalar& dt, const Freedom<Scalar>& freedom = {},
                           const Steering<Scalar>& steering = {}) const {
    State next;
    integrate<false>(x, u, external, dt, freedom, steering, next, nullptr, nullptr);
    return next;
  }

  /// The same step with its exact derivative dx+ = A dx + B du in the coordinates of ActuatedIndex.
  [[nodiscard]] State step(const State& x, const Input& u, const Wrench<Scalar>& external,
                           const Scalar& dt, const Freedom<Scalar>& freedom, StateJacobian& A,
                           InputJacobian& B, const Steering<Scalar>& steering = {}) const {
    State next;
    for (Eigen::Index i = 0; i < A.size(); ++i) A.coeffRef(i) = Scalar(0);
    for (Eigen::Index i = 0; i < B.size(); ++i) B.coeffRef(i) = Scalar(0);
    for (int i = 0; i < states; ++i) A.coeffRef(i, i) = Scalar(1);
    integrate<true>(x, u, external, dt, freedom, steering, next, &A, &B);
    return next;
  }

  /// The same, but inlined into the caller. A must be the identity, and B zero, outside of the
  /// entries that can be non-zero.
  [[gnu::always_inline]] inline void step_inline(const State& x, const Input& u,
                                                 const Wrench<Scalar>& external, const Scalar& dt,
                                                 const Freedom<Scalar>& freedom,
                                                 const Steering<Scalar>& steering, State& next,
                                                 StateJacobian& A, InputJacobian& B) const {
    integrate<true>(x, u, external, dt, freedom, steering, next, &A, &B);
  }

 private:
  using Triple = detail::Triple<Scalar>;
  using Square = detail::Square<Scalar>;
  using I = ActuatedIndex<Rotors>;

  using BodyStep = detail::BodyStep<Scalar, true>;
  using Column = typename BodyStep::Column;
  using Push = detail::Push<Scalar>;

  static Push none() { return {BodyStep::none(), BodyStep::none()}; }

  /// Wrench of a thrust of 1 N.
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
  [[nodiscard]] const RotorPush& rotor(int i) const { return rotors_[detail::size(i)]; }

  // Thrust, sine and cosine of the angle of one rotor at the start, middle and end of a step.
  struct Sample {
    Scalar thrust, s, c;
  };

  // The wrench is no polynomial of time. The sensitivity is first computed by the wrench at start,
  // middle and end, then by the rotors.
  template <bool WithSensitivity>
  [[gnu::always_inline]] inline void integrate(const State& x, const Input& u,
                                               const Wrench<Scalar>& external, const Scalar& dt,
                                               const Freedom<Scalar>& freedom,
                                               const Steering<Scalar>& steering, State& next,
                                               StateJacobian* A, InputJacobian* B) const {
    using detail::triple;
    using std::cos;
    using std::sin;
    const Scalar zero(0), one(1), half_dt = Scalar(0.5) * dt;
    const Triple nothing = BodyStep::none();

    Sample samples[detail::size(Rotors)][3];
    Push pushed[3];
    for (Push& p : pushed) p = {triple(external.force), triple(external.torque)};
    for (int i = 0; i < Rotors; ++i) {
      const Scalar& rate = u.coeff(i);
      const Scalar turn = half_dt * u.coeff(Rotors + i);
      const Scalar s_turn = sin(turn), c_turn = cos(turn);
      Sample(&of)[3] = samples[detail::size(i)];
      of[0] = {x.thrust.coeff(i), sin(x.tilt_angle.coeff(i)), cos(x.tilt_angle.coeff(i))};
      for (int n = 1; n < 3; ++n)
        of[n] = {of[n - 1].thrust + half_dt * rate, of[n - 1].s * c_turn + of[n - 1].c * s_turn,
                 of[n - 1].c * c_turn - of[n - 1].s * s_turn};
      for (int n = 0; n < 3; ++n) {
        Push push = rotor(i).at(of[n].s, of[n].c);
        push.force.y = steering.side * push.force.y;
        pushed[n].force += of[n].thrust * push.force;
        pushed[n].torque += of[n].thrust * push.torque;
      }
    }

    BodyStep step(body_, dt, freedom, triple(steering.speed));
    step.template run<WithSensitivity>(body_, x.body, pushed, freedom, next.body);
    for (int i = 0; i < Rotors; ++i) {
      next.thrust.coeffRef(i) = x.thrust.coeff(i) + dt * u.coeff(i);
      next.tilt_angle.coeffRef(i) = x.tilt_angle.coeff(i) + dt * u.coeff(Rotors + i);
    }
    if constexpr (!WithSensitivity) return;

    for (int i = 0; i < inputs; ++i) B->coeffRef(i, i) = dt;
    step.template put_blocks<I>(*A);

    const Square& inverse_inertia = step.inverse_inertia();
    const Triple axes[3] = {inverse_inertia.x, inverse_inertia.y, inverse_inertia.z};
    // By the torque at the start and in the middle. The torque at the end acts on w alone.
    Square position_by_torque[2], velocity_by_torque[2], orientation_by_torque[2],
        angular_velocity_by_torque[3];
    for (int n = 0; n < 2; ++n) {
      const auto by_torque = [&](int axis) __attribute__((always_inline)) {
        return step.column_of(
            nothing, [&](int sample, Triple& w_rate) __attribute__((always_inline)) {
              if (sample == n) w_rate += axes[axis];
            });
      };
      const Column x_axis = by_torque(0), y_axis = by_torque(1), z_axis = by_torque(2);
      position_by_torque[n] = {x_axis.position, y_axis.position, z_axis.position};
      velocity_by_torque[n] = {x_axis.velocity, y_axis.velocity, z_axis.velocity};
      orientation_by_torque[n] = {x_axis.orientation, y_axis.orientation, z_axis.orientation};
      angular_velocity_by_torque[n] = {x_axis.angular_velocity, y_axis.angular_velocity,
                                       z_axis.angular_velocity};
    }
    angular_velocity_by_torque[2] = step.sixth() * inverse_inertia;
    const Triple kept[3] = {step.kept().x, step.kept().y, step.kept().z};
    for (int i = 0; i < 3; ++i) {
      const auto no_torque = [](int, Triple&) {};
      BodyStep::template put_column<I>(step.column_of(kept[i], no_torque), *A,
                                       I::angular_velocity + i);
    }
    Square position_by_force[3], velocity_by_force[3];
    for (int n = 0; n < 3; ++n) {
      position_by_force[n] = step.position_by_force(n);
      velocity_by_force[n] = step.velocity_by_force(n);
    }

    for (int i = 0; i < Rotors; ++i) {
      const Sample(&of)[3] = samples[detail::size(i)];
      Column by_thrust[3], by_angle[3];
      for (int n = 0; n < 3; ++n) {
        const auto effect = [&](Push push) __attribute__((always_inline)) {
          push.force.y = steering.side * push.force.y;
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
        const Column sum{start * of_sample[0].position + middle * of_sample[1].position,
                         start * of_sample[0].velocity + middle * of_sample[1].velocity +
                             end * of_sample[2].velocity,
                         start * of_sample[0].orientation + middle * of_sample[1].orientation,
                         start * of_sample[0].angular_velocity +
                             middle * of_sample[1].angular_velocity +
                             end * of_sample[2].angular_velocity};
        BodyStep::template put_column<I>(sum, jacobian, column);
      };
      put_sum(by_thrust, one, one, one, *A, I::thrust + i);
      put_sum(by_thrust, zero, half_dt, dt, *B, I::thrust + i);
      put_sum(by_angle, of[0].thrust, of[1].thrust, of[2].thrust, *A, I::tilt_angle + i);
      put_sum(by_angle, zero, half_dt * of[1].thrust, dt * of[2].thrust, *B, I::tilt_angle + i);
    }
  }

  detail::BodyInertia<Scalar> body_;
  std::array<RotorPush, detail::size(Rotors)> rotors_{};
  // For the wrench of speeds:
  std::array<RotorParameters, detail::size(Rotors)> parameters_{};
  std::array<double, detail::size(Rotors)> effectiveness_{};
  std::array<bool, detail::size(Rotors)> tilts_{};
};

}  // namespace tilt_ropter
