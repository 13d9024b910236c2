#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

/// Rigid body driven by the wrench of its actuators and an external one (paper, Sec. Rigid Body
/// Dynamics, Eqs. rb1-rb4), its discrete step and the analytic sensitivity of that step.
namespace tilt_ropter {

/// Which axes a support leaves free to accelerate: 1 free, 0 held. Wheels on the ground hold world
/// z and body x; the reaction that does so needs no model then.
template <typename Scalar = double>
struct Freedom {
  Vector3<Scalar> linear = Vector3<Scalar>::Ones();   ///< world axes
  Vector3<Scalar> angular = Vector3<Scalar>::Ones();  ///< body axes
};

/// Derivative of a BodyState with respect to time.
template <typename Scalar = double>
struct BodyDerivative {
  Vector3<Scalar> velocity;               ///< dp/dt [m/s]
  Vector3<Scalar> acceleration;           ///< dv/dt, world frame [m/s^2]
  Eigen::Quaternion<Scalar> orientation;  ///< dq/dt, not a unit quaternion [1/s]
  Vector3<Scalar> angular_acceleration;   ///< body frame [rad/s^2]
};

/// The model that the controller predicts with: F and M integrate their rates, the body follows.
template <typename Scalar = double>
class RigidBody {
 public:
  using WrenchRate = Eigen::Matrix<Scalar, 6, 1>;
  using StateJacobian = Eigen::Matrix<Scalar, 18, 18>;
  using InputJacobian = Eigen::Matrix<Scalar, 18, 6>;

  /// Throws std::invalid_argument if the parameters are not those of a rigid body.
  explicit RigidBody(const RigidBodyParameters& parameters) {
    validate(parameters);
    mass_ = Scalar(parameters.mass);
    inertia_ = parameters.inertia.cast<Scalar>();
    inverse_inertia_ = Eigen::Matrix3d(parameters.inertia.inverse()).cast<Scalar>();
  }

  [[nodiscard]] const Scalar& mass() const { return mass_; }
  [[nodiscard]] const Matrix3<Scalar>& inertia() const { return inertia_; }

  /// Eqs. rb1-rb4 under the sum `wrench` of all wrenches at the CoM, body frame.
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

  /// One classical Runge-Kutta step of `dt` [s] with the wrench rate `u` (body frame, [N/s; N m/s])
  /// and the external wrench (body frame) held constant; the quaternion is normalised at the end.
  [[nodiscard]] State<Scalar> step(const State<Scalar>& x, const WrenchRate& u,
                                   const Wrench<Scalar>& external, Scalar dt,
                                   const Freedom<Scalar>& freedom = {}) const {
    return integrate<false>(x, u, external, dt, freedom, nullptr, nullptr);
  }

  /// The same step and its exact derivative in tangent coordinates (dF, dM, dp, dv, dtheta, dw):
  /// dx+ = A dx + B du.
  [[nodiscard]] State<Scalar> step(const State<Scalar>& x, const WrenchRate& u,
                                   const Wrench<Scalar>& external, Scalar dt,
                                   const Freedom<Scalar>& freedom, StateJacobian& A,
                                   InputJacobian& B) const {
    return integrate<true>(x, u, external, dt, freedom, &A, &B);
  }

 private:
  // The attitude equation is linear in q from the left, so every stage of the Runge-Kutta step is
  // q (x) c with c starting at identity and driven by w alone. That leaves a chain
  // (M, dM, w) -> w stages -> c stages -> force stages -> (v, p), and makes the derivative with
  // respect to the initial attitude the cross product with the integrated impulse. Flattened,
  // because a compiler that leaves these small products as calls takes twice as long.
  template <bool WithSensitivity>
  [[gnu::flatten]] State<Scalar> integrate(const State<Scalar>& x, const WrenchRate& u,
                                           const Wrench<Scalar>& external, Scalar dt,
                                           const Freedom<Scalar>& freedom,
                                           StateJacobian* state_jacobian,
                                           InputJacobian* input_jacobian) const {
    using Vector4 = Eigen::Matrix<Scalar, 4, 1>;  // quaternions as (w, x, y, z) here
    // Derivatives with respect to (M, dM, w), one column per component. Three rows more than the
    // nine needed let the compiler use whole registers.
    using Chain3 = Eigen::Matrix<Scalar, 12, 3>;
    using Chain4 = Eigen::Matrix<Scalar, 12, 4>;
    const Scalar node[4] = {Scalar(0), dt / Scalar(2), dt / Scalar(2), dt};
    const Scalar velocity_weight[4] = {dt / Scalar(6), dt / Scalar(3), dt / Scalar(3),
                                       dt / Scalar(6)};
    const Scalar position_weight = dt * dt / Scalar(6);  // of the first three stages

    const Matrix3<Scalar> rotation = x.body.orientation.toRotationMatrix();
    const Matrix3<Scalar> held_inverse_inertia = freedom.angular.asDiagonal() * inverse_inertia_;

    Vector3<Scalar> w = x.body.angular_velocity, w_rate = Vector3<Scalar>::Zero();
    Vector4 c(Scalar(1), Scalar(0), Scalar(0), Scalar(0)), c_rate = Vector4::Zero();
    Vector3<Scalar> w_sum = Vector3<Scalar>::Zero();
    Vector4 c_sum = Vector4::Zero();
    Vector3<Scalar> velocity_impulse = Vector3<Scalar>::Zero();  // in the initial body frame [N s]
    Vector3<Scalar> position_impulse = Vector3<Scalar>::Zero();  // [N s^2]

    Chain3 dw, dw_rate = Chain3::Zero(), dw_sum = Chain3::Zero();
    Chain4 dc, dc_rate = Chain4::Zero(), dc_sum = Chain4::Zero();
    Chain3 velocity_chain = Chain3::Zero(), position_chain = Chain3::Zero();
    Matrix3<Scalar> velocity_by_force = Matrix3<Scalar>::Zero(),
                    velocity_by_rate = Matrix3<Scalar>::Zero(),
                    position_by_force = Matrix3<Scalar>::Zero(),
                    position_by_rate = Matrix3<Scalar>::Zero();

    Chain3 initial_dw = Chain3::Zero(), by_torque = Chain3::Zero(), by_torque_rate = Chain3::Zero();
    if constexpr (WithSensitivity) {
      initial_dw.template middleRows<3>(6).setIdentity();
      by_torque.template topRows<3>() = held_inverse_inertia.transpose();
      by_torque_rate.template middleRows<3>(3) = held_inverse_inertia.transpose();
    }

    for (int stage = 0; stage < 4; ++stage) {
      const Scalar t = node[stage];
      const Scalar weight = velocity_weight[stage];
      if (stage > 0) {
        w = x.body.angular_velocity + t * w_rate;
        c = t * c_rate;
        c(0) += Scalar(1);
      }
      const Vector3<Scalar> momentum = inertia_ * w;
      const Vector3<Scalar> torque = x.wrench.torque + t * u.template tail<3>() + external.torque;
      w_rate = held_inverse_inertia * (torque - w.cross(momentum));
      const Vector3<Scalar> v = c.template tail<3>();
      c_rate(0) = -v.dot(w) / Scalar(2);
      c_rate.template tail<3>() = (c(0) * w + v.cross(w)) / Scalar(2);
      const Vector3<Scalar> f = x.wrench.force + t * u.template head<3>() + external.force;
      const Vector3<Scalar> turned =
          (c(0) * c(0) - v.squaredNorm()) * f + Scalar(2) * (v.dot(f) * v + c(0) * v.cross(f));
      w_sum += weight * w_rate;
      c_sum += weight * c_rate;
      velocity_impulse += weight * turned;
      if (stage < 3) position_impulse += position_weight * turned;

      if constexpr (WithSensitivity) {
        dw = t * dw_rate + initial_dw;
        dc = t * dc_rate;
        const Matrix3<Scalar> gyroscopic =
            held_inverse_inertia * (skew(momentum) - skew(w) * inertia_);
        turn_columns(dw, gyroscopic, dw_rate);
        dw_rate += by_torque + t * by_torque_rate;

        // d(c (x) w) / 2: the real part, then the vector part.
        const Vector3<Scalar> hw = w / Scalar(2), hv = v / Scalar(2);
        const Scalar hc = c(0) / Scalar(2);
        dc_rate.col(0) = -(dc.col(1) * hw.x() + dc.col(2) * hw.y() + dc.col(3) * hw.z()) -
                         (dw.col(0) * hv.x() + dw.col(1) * hv.y() + dw.col(2) * hv.z());
        dc_rate.col(1) = dc.col(0) * hw.x() + dc.col(2) * hw.z() - dc.col(3) * hw.y() +
                         dw.col(0) * hc + dw.col(2) * hv.y() - dw.col(1) * hv.z();
        dc_rate.col(2) = dc.col(0) * hw.y() + dc.col(3) * hw.x() - dc.col(1) * hw.z() +
                         dw.col(1) * hc + dw.col(0) * hv.z() - dw.col(2) * hv.x();
        dc_rate.col(3) = dc.col(0) * hw.z() + dc.col(1) * hw.y() - dc.col(2) * hw.x() +
                         dw.col(2) * hc + dw.col(1) * hv.x() - dw.col(0) * hv.y();
        dw_sum += weight * dw_rate;
        dc_sum += weight * dc_rate;

        const Vector3<Scalar> by_real = Scalar(2) * (c(0) * f + v.cross(f));
        Matrix3<Scalar> by_vector =
            Scalar(2) * (v * f.transpose() - f * v.transpose() - c(0) * skew(f));
        by_vector.diagonal().array() += Scalar(2) * v.dot(f);
        for (int i = 0; i < 3; ++i) {
          const auto dturned = dc.col(0) * by_real(i) + dc.col(1) * by_vector(i, 0) +
                               dc.col(2) * by_vector(i, 1) + dc.col(3) * by_vector(i, 2);
          velocity_chain.col(i) += weight * dturned;
          if (stage < 3) position_chain.col(i) += position_weight * dturned;
        }

        Matrix3<Scalar> stage_rotation = Scalar(2) * (v * v.transpose() + c(0) * skew(v));
        stage_rotation.diagonal().array() += c(0) * c(0) - v.squaredNorm();
        velocity_by_force += weight * stage_rotation;
        velocity_by_rate += (weight * t) * stage_rotation;
        if (stage < 3) {
          position_by_force += position_weight * stage_rotation;
          position_by_rate += (position_weight * t) * stage_rotation;
        }
      }
    }

    c = c_sum;
    c(0) += Scalar(1);
    using std::sqrt;
    const Scalar norm = sqrt(c.squaredNorm());
    c /= norm;
    const Eigen::Quaternion<Scalar> turn(c(0), c(1), c(2), c(3));
    const Vector3<Scalar> down(Scalar(0), Scalar(0), Scalar(-gravity));

    State<Scalar> next;
    next.wrench.force = x.wrench.force + dt * u.template head<3>();
    next.wrench.torque = x.wrench.torque + dt * u.template tail<3>();
    next.body.position = x.body.position + dt * x.body.velocity +
                         freedom.linear.cwiseProduct(rotation * position_impulse / mass_ +
                                                     (dt * dt / Scalar(2)) * down);
    next.body.velocity = x.body.velocity + freedom.linear.cwiseProduct(
                                               rotation * velocity_impulse / mass_ + dt * down);
    next.body.orientation = (x.body.orientation * turn).normalized();
    next.body.angular_velocity = x.body.angular_velocity + w_sum;

    if constexpr (WithSensitivity) {
      StateJacobian& A = *state_jacobian;
      InputJacobian& B = *input_jacobian;
      const Matrix3<Scalar> to_world = freedom.linear.asDiagonal() * rotation / mass_;
      A.setIdentity();
      B.setZero();
      B.template topRows<6>().diagonal().setConstant(dt);
      A.template block<3, 3>(6, 9).diagonal().setConstant(dt);

      A.template block<3, 3>(6, 0).noalias() = to_world * position_by_force;
      A.template block<3, 3>(9, 0).noalias() = to_world * velocity_by_force;
      B.template block<3, 3>(6, 0).noalias() = to_world * position_by_rate;
      B.template block<3, 3>(9, 0).noalias() = to_world * velocity_by_rate;
      A.template block<3, 3>(6, 12).noalias() = -to_world * skew(position_impulse);
      A.template block<3, 3>(9, 12).noalias() = -to_world * skew(velocity_impulse);
      A.template block<3, 3>(12, 12) = turn.toRotationMatrix().transpose();

      Matrix3<Scalar> to_angle = -skew(c.template tail<3>());
      to_angle.diagonal().array() += c(0);
      Chain3 angle_chain, turned_chain;
      turn_columns(dc_sum.template rightCols<3>(), to_angle, angle_chain);
      for (int i = 0; i < 3; ++i)
        angle_chain.col(i) = (Scalar(2) / norm) * (angle_chain.col(i) - c(1 + i) * dc_sum.col(0));
      dw_sum += initial_dw;
      const auto scatter = [&](int row, const Chain3& chain) {
        A.template block<3, 3>(row, 3) = chain.template topRows<3>().transpose();
        B.template block<3, 3>(row, 3) = chain.template middleRows<3>(3).transpose();
        A.template block<3, 3>(row, 15) = chain.template middleRows<3>(6).transpose();
      };
      turn_columns(position_chain, to_world, turned_chain);
      scatter(6, turned_chain);
      turn_columns(velocity_chain, to_world, turned_chain);
      scatter(9, turned_chain);
      scatter(12, angle_chain);
      scatter(15, dw_sum);
    }
    return next;
  }

  // out = chain turn', column by column.
  template <typename Chain, typename Result>
  static void turn_columns(const Chain& chain, const Matrix3<Scalar>& turn, Result& out) {
    for (int i = 0; i < 3; ++i)
      out.col(i) =
          chain.col(0) * turn(i, 0) + chain.col(1) * turn(i, 1) + chain.col(2) * turn(i, 2);
  }

  Scalar mass_;
  Matrix3<Scalar> inertia_, inverse_inertia_;
};

}  // namespace tilt_ropter
