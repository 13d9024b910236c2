// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <utility>

/// A term of your own in the prediction of Nmpc: a force and a torque that follow from the state of
/// the body, such as drag or a learnt model.
namespace tilt_ropter {

/// The value of a term: a wrench at the CoM in the body frame, and its derivative by the motion of
/// the body. A term is any callable that returns this for a BodyStated, at any state, without
/// allocation or exceptions:
///
///     struct Drag {
///       double coefficient;  // [N s/m]
///       OwnTerm operator()(const BodyStated& body) const {
///         const Eigen::Matrix3d to_body = body.orientation.conjugate().toRotationMatrix();
///         const Eigen::Vector3d velocity = to_body * body.velocity;  // body frame
///         OwnTerm drag;
///         drag.wrench.force = -coefficient * velocity;
///         drag.derivative.block<3, 3>(0, 0) = -coefficient * to_body;
///         drag.derivative.block<3, 3>(0, 3) = -coefficient * skew(velocity);
///         return drag;
///       }
///     };
///     const Drag drag{0.3};
///     Nmpc nmpc(vehicle, settings, drag);
///
/// What the term explains is no external wrench any more. The observer has to know it, or it
/// reports it as well, and the controller compensates it twice:
///
///     observer.update(time, sample, allocation.wrench(applied) + drag(state).wrench);
///
/// The term acts at all nodes, in the air and on the ground, and the wrench of the reference
/// balances it. check_reference() and TerminalCost::riccati do not know it. During each interval of
/// the horizon (0.1 s) the prediction keeps its wrench constant, as in the middle of the interval.
/// A tick takes about twice as long. A wrong derivative makes the plans worse but not invalid. A
/// value that is not finite has the effect of a solver without solution.
struct OwnTerm {
  Wrenchd wrench;  ///< at the CoM, body frame [N; N m]
  /// Derivative of (force, torque) by (dv, dtheta, dw): velocity in the world frame [m/s], rotation
  /// in the body frame [rad], angular velocity in the body frame [rad/s].
  Eigen::Matrix<double, 6, 9> derivative = Eigen::Matrix<double, 6, 9>::Zero();
};

/// No term. It costs nothing.
struct NoOwnTerm {};

namespace detail {

/// WheeledFlightProblem with the term of a user, see OwnTerm. The wrench of the term is constant
/// during an interval: that of the state in the middle, which a half step without the term
/// predicts. The derivatives of the step are exact. The intervals are stepped one after the other,
/// which takes longer than side by side.
template <int Rotors, typename Term>
class ProblemWithTerm : public WheeledFlightProblem<Rotors> {
  using Plain = WheeledFlightProblem<Rotors>;

 public:
  using typename Plain::Input, typename Plain::InputJacobian, typename Plain::State,
      typename Plain::StateJacobian;

  /// By the term, everything that moves the body acts on everything that moves.
  struct TransitionPattern {
    static constexpr bool nonzero(int row, int column) {
      const bool moves = column < I::position || column >= I::velocity;
      return Plain::TransitionPattern::nonzero(row, column) || (row >= I::position && moves);
    }
  };

  ProblemWithTerm(Plain problem, const Term& term) : Plain(std::move(problem)), term_(term) {}

  [[nodiscard]] State step(int k, const State& x, const Input& u) const {
    return step_for(this->settings().interval, k, x, u);
  }

  [[nodiscard]] State step_for(double seconds, int k, const State& x, const Input& u) const {
    const Wrenchd& external = this->node(k).external;
    const State middle = this->step_under(external, 0.5 * seconds, k, x, u);
    return this->step_under(external + term_(middle.body).wrench, seconds, k, x, u);
  }

  [[nodiscard]] State step(int k, const State& x, const Input& u, StateJacobian& A,
                           InputJacobian& B) const {
    const Wrenchd& external = this->node(k).external;
    const double interval = this->settings().interval;
    const State middle = this->step_under(external, 0.5 * interval, k, x, u, A, B);
    const OwnTerm own = term_(middle.body);
    const Eigen::Matrix<double, 6, 18> by_state = own.derivative * A.template bottomRows<9>();
    const Eigen::Matrix<double, 6, 6> by_input = own.derivative * B.template bottomRows<9>();
    State end = this->step_under(external + own.wrench, interval, k, x, u, A, B);
    // A constant wrench acts on the body as the wrench of the state at the start does.
    const Eigen::Matrix<double, 12, 6> by_wrench = A.template bottomLeftCorner<12, 6>();
    A.template bottomRows<12>() += by_wrench * by_state;
    B.template bottomRows<12>() += by_wrench * by_input;
    return end;
  }

  void step_lanes() = delete;  // steps without the term

 private:
  using I = TangentIndex;

  Term term_;
};

}  // namespace detail
}  // namespace tilt_ropter
