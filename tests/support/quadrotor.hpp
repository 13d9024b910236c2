#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "support/test_problem.hpp"

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace test_support {

/// A flat quadrotor of 1 kg that flies to the origin and hovers. Inputs: thrusts of its four rotors
/// [N]. State: p, v, q, w with tangent (dp, dv, dtheta, dw); dtheta and w are in the body frame.
struct QuadrotorModel {
  static constexpr int states = 12, inputs = 4, constraints = 4, equalities = 0, residuals = 16;
  template <typename S>
  using StateOf = tilt_ropter::BodyState<S>;
  template <typename S>
  using TangentOf = Eigen::Matrix<S, 12, 1>;
  template <typename S>
  using InputOf = Eigen::Matrix<S, 4, 1>;
  using D = tilt_ropter::optimal_control::ProblemDimensions<QuadrotorModel>;

  int intervals = 5;
  double interval = 0.1;
  double max_thrust = 4.0;
  double terminal = 3.0;  // factor on the last node's residual
  tilt_ropter::RigidBodyd rigid_body{body()};

  template <typename S>
  StateOf<S> moved(const StateOf<S>& x, const TangentOf<S>& dx) const {
    tilt_ropter::StateTangent<S> all = tilt_ropter::StateTangent<S>::Zero();
    all.template tail<12>() = dx;
    return tilt_ropter::retract<S>({{}, x}, all).body;
  }
  template <typename S>
  TangentOf<S> between(const StateOf<S>& y, const StateOf<S>& x) const {
    return tilt_ropter::difference<S>({{}, y}, {{}, x}).template tail<12>();
  }
  D::A retract_derivative(const StateOf<double>&, const D::Tangent& dx) const {
    D::A derivative = D::A::Identity();
    derivative.block<3, 3>(6, 6) = tilt_ropter::right_jacobian(dx.segment<3>(6));
    return derivative;
  }

  /// Returns force and torque for unit thrusts: arms of 0.2 m along +x, +y, -x, -y; drag torque
  /// 0.016 m per unit of thrust.
  static Eigen::Matrix<double, 6, 4> allocation() {
    Eigen::Matrix<double, 6, 4> a = Eigen::Matrix<double, 6, 4>::Zero();
    a.row(2).setOnes();
    a.row(3) << 0.0, 0.2, 0.0, -0.2;
    a.row(4) << -0.2, 0.0, 0.2, 0.0;
    a.row(5) << 0.016, -0.016, 0.016, -0.016;
    return a;
  }
  static tilt_ropter::RigidBodyParameters body() {
    tilt_ropter::RigidBodyParameters parameters;
    parameters.mass = 1.0;
    parameters.inertia = Eigen::Vector3d(0.01, 0.012, 0.02).asDiagonal();
    return parameters;
  }
  static double hover_thrust() { return tilt_ropter::gravity / 4.0; }

  template <typename S>
  StateOf<S> flow(int, const StateOf<S>& x, const InputOf<S>& u) const {
    const Eigen::Matrix<S, 6, 1> wrench = allocation().template cast<S>() * u;
    return tilt_ropter::RigidBody<S>(body())
        .step({{wrench.template head<3>(), wrench.template tail<3>()}, x},
              Eigen::Matrix<S, 6, 1>::Zero(), {}, S(interval))
        .body;
  }
  StateOf<double> flow_derivatives(int, const StateOf<double>& x, const D::Input& u, D::A& A,
                                   D::B& B) const {
    const Eigen::Matrix<double, 6, 1> wrench = allocation() * u;
    Eigen::Matrix<double, 18, 18> by_state;
    Eigen::Matrix<double, 18, 6> by_rate;
    const tilt_ropter::Stated end =
        rigid_body.step({{wrench.head<3>(), wrench.tail<3>()}, x},
                        Eigen::Matrix<double, 6, 1>::Zero(), {}, interval, {}, by_state, by_rate);
    A = by_state.bottomRightCorner<12, 12>();
    B = by_state.bottomLeftCorner<12, 6>() * allocation();
    return end.body;
  }

  template <typename S>
  Eigen::Matrix<S, 16, 1> residual(int k, const StateOf<S>& x, const InputOf<S>& u) const {
    const S w(factor(k)), sign(x.orientation.w() < S(0) ? -2.0 : 2.0);
    Eigen::Matrix<S, 16, 1> e;
    e << w * x.position, w * S(0.5) * x.velocity, w * sign * x.orientation.vec(),
        w * S(0.2) * x.angular_velocity,
        S(input_weight(k)) * (u - InputOf<S>::Constant(S(hover_thrust())));
    return e;
  }
  template <typename ByState, typename ByInput>
  void residual_derivatives(int k, const StateOf<double>& x, const D::Input&, ByState& by_state,
                            ByInput& by_input) const {
    const double w = factor(k), sign = x.orientation.w() < 0.0 ? -1.0 : 1.0;
    by_state.setZero();
    by_state.diagonal() << w, w, w, 0.5 * w, 0.5 * w, 0.5 * w, 0.0, 0.0, 0.0, 0.2 * w, 0.2 * w,
        0.2 * w;
    by_state.template block<3, 3>(6, 6) = sign * w * tilt_ropter::skew(x.orientation.vec());
    by_state.template block<3, 3>(6, 6).diagonal().array() += sign * w * x.orientation.w();
    by_input.setZero();
    by_input.template bottomRows<4>().diagonal().setConstant(input_weight(k));
  }

  template <typename S>
  InputOf<S> constraints_of(int, const StateOf<S>&, const InputOf<S>& u) const {
    return u;
  }
  void constraint_derivatives(int, const StateOf<double>&, const D::Input&, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    C.setZero();
    E.setIdentity();
  }
  void constraint_bounds(int k, D::Constraints& lower, D::Constraints& upper,
                         D::Constraints& penalty) const {
    lower.setConstant(k == intervals ? -infinity : 0.0);
    upper.setConstant(k == intervals ? infinity : max_thrust);
    penalty.setConstant(1e4);
  }

 private:
  double factor(int k) const { return k == intervals ? terminal : 1.0; }
  double input_weight(int k) const { return k == intervals ? 0.0 : 0.2; }
};

using Quadrotor = TestProblem<QuadrotorModel>;

}  // namespace test_support
