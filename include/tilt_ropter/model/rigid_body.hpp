// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/detail/body_step.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <type_traits>

/// Rigid body under an actuator wrench and an external wrench (paper, Sec. Rigid Body Dynamics,
/// Eqs. rb1-rb4), with its discrete step and the analytic sensitivity of that step.
namespace tilt_ropter {

/// Prediction model of the controller. The integral (F, M) of the wrench rate drives the body.
template <typename Scalar>
class RigidBody {
 public:
  using WrenchRate = Eigen::Matrix<Scalar, 6, 1>;
  using StateJacobian = Eigen::Matrix<Scalar, 18, 18>;
  using InputJacobian = Eigen::Matrix<Scalar, 18, 6>;

  /// Throws std::invalid_argument if no rigid body has these `parameters`.
  explicit RigidBody(const RigidBodyParameters& parameters) : body_(validated(parameters)) {}

  [[nodiscard]] const Scalar& mass() const { return body_.mass; }

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

  /// The same step with its exact derivative dx+ = A dx + B du in the coordinates of TangentIndex.
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

  // The wrench is linear in time.
  template <bool WithSensitivity>
  [[gnu::always_inline]] inline void integrate(const State<Scalar>& x, const WrenchRate& rate,
                                               const Wrench<Scalar>& external, const Scalar& dt,
                                               const Freedom<Scalar>& freedom, State<Scalar>& next,
                                               StateJacobian* A, InputJacobian* B) const {
    using detail::triple;
    using I = TangentIndex;
    using BodyStep = detail::BodyStep<Scalar>;
    const Scalar zero(0), one(1);
    const Triple force_rate = detail::triple(rate, I::force),
                 torque_rate = detail::triple(rate, I::torque), none = BodyStep::none();
    BodyStep step(body_, dt, freedom);
    detail::Push<Scalar> pushes[3];
    pushes[0] = {triple(x.wrench.force) + triple(external.force),
                 triple(x.wrench.torque) + triple(external.torque)};
    for (int n = 1; n < 3; ++n)
      pushes[n] = {pushes[0].force + step.time_at(n) * force_rate,
                   pushes[0].torque + step.time_at(n) * torque_rate};
    step.template run<WithSensitivity>(body_, x.body, pushes, freedom, next.body);
    detail::put(triple(x.wrench.force) + dt * force_rate, next.wrench.force);
    detail::put(triple(x.wrench.torque) + dt * torque_rate, next.wrench.torque);
    if constexpr (!WithSensitivity) return;

    for (int i = 0; i < 18 * 18; ++i) A->coeffRef(i) = zero;
    for (int i = 0; i < 18 * 6; ++i) B->coeffRef(i) = zero;
    for (int i = 0; i < 18; ++i) A->coeffRef(i, i) = one;
    for (int i = 0; i < 6; ++i) B->coeffRef(i, i) = dt;
    step.template put_blocks<I>(*A);
    const auto velocity_middle = step.velocity_by_force(1),
               velocity_end = step.velocity_by_force(2),
               position_middle = step.position_by_force(1);
    detail::put(step.velocity_by_force(0) + velocity_middle + velocity_end, *A, I::velocity,
                I::force);
    detail::put(step.position_by_force(0) + position_middle, *A, I::position, I::force);
    detail::put(step.time_at(1) * velocity_middle + dt * velocity_end, *B, I::velocity, I::force);
    detail::put(step.time_at(1) * position_middle, *B, I::position, I::force);

    // Sets one column of the derivatives with respect to M, dM or w. `start`: derivative of the
    // initial w. `push`, `push_rate`: constant and linear part in time of that of the rate of w.
    const auto set_column = [&](const Triple& start, const Triple& push, const Triple& push_rate,
                                auto& jacobian, int column) __attribute__((always_inline)) {
      const auto add = [&](int n, Triple& w_rate) __attribute__((always_inline)) {
        w_rate += push + step.time_at(n) * push_rate;
      };
      BodyStep::template put_column<I>(step.column_of(start, add), jacobian, column);
    };
    const Triple axes[3] = {step.inverse_inertia().x, step.inverse_inertia().y,
                            step.inverse_inertia().z};
    const Triple kept[3] = {step.kept().x, step.kept().y, step.kept().z};
    const auto set_columns = [&](const auto& set) __attribute__((always_inline)) {
      for (int i = 0; i < 3; ++i) {
        set(none, axes[i], none, *A, I::torque + i);
        set(none, none, axes[i], *B, I::torque + i);
        set(kept[i], none, none, *A, I::angular_velocity + i);
      }
    };
    if constexpr (std::is_arithmetic_v<Scalar>) {
      // Nine calls instead of nine inlined copies save a tenth of the compile time of Nmpc.
      set_columns([&](const Triple& start, const Triple& push, const Triple& push_rate,
                      auto& jacobian, int column) __attribute__((noinline)) {
        set_column(start, push, push_rate, jacobian, column);
      });
    } else {
      set_columns(set_column);
    }
  }

  detail::BodyInertia<Scalar> body_;
};
using RigidBodyd = RigidBody<double>;  ///< in double precision

}  // namespace tilt_ropter
