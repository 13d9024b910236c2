// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

namespace tilt_ropter::detail {

/// The cost of the last node with TerminalCost::riccati: e' T' P T e for the error e of
/// WheeledFlightProblem::cost(). T turns the errors of position, velocity and orientation (world
/// axes) by the heading of the reference: in level hover the dynamics of the error are then the
/// same for all headings. The other errors are in body axes. The functions are not inlined, because
/// the code of all other nodes would become slower. They do not allocate.
class CostAfterHorizon {
 public:
  using Matrix = Eigen::Matrix<double, 18, 18>;
  using Model = optimal_control::QuadraticModel<18, 6>;

  /// `P`: the solution of the discrete algebraic Riccati equation at heading zero.
  explicit CostAfterHorizon(const Matrix& P) : P_(P) {}

  /// Cost of the error `e` at the reference's heading `yaw` [rad].
  [[nodiscard]] [[gnu::noinline]] double value(double yaw, StateTangentd e) const {
    const Square<double> turn = to_heading(yaw);
    for (const int i : {I::position, I::velocity, I::orientation}) put(turn * triple(e, i), e, i);
    double sum = 0.0;
    for (int j = 0; j < 18; ++j)
      for (int i = 0; i < 18; ++i) sum += e(i) * P_(i, j) * e(j);
    return sum;
  }

  /// Writes gradient and Gauss-Newton Hessian of value() by the state. `by_angle`: derivative of
  /// the orientation's error by dtheta, see attitude_error_derivative().
  [[gnu::noinline]] void set_model(double yaw, const StateTangentd& e,
                                   const Square<double>& by_angle, Model& model) const {
    const Triple<double> none{0.0, 0.0, 0.0};
    const Square<double> one = outer(1.0, none, none, none), turn = to_heading(yaw);
    const Square<double> of_error[6] = {one, one, turn, turn, turn, one},
                         of_state[6] = {one, one, turn, turn, turn * by_angle, one};
    for (int i = 0; i < 6; ++i) {
      const Square<double> back = 2.0 * transposed(of_state[i]);
      Triple<double> gradient = none;
      for (int j = 0; j < 6; ++j) {
        const Square<double> block = back * square(P_, 3 * i, 3 * j);
        gradient += block * (of_error[j] * triple(e, 3 * j));
        put(block * of_state[j], model.hessian, 3 * i, 3 * j);
      }
      put(gradient, model.gradient, 3 * i);
    }
  }

 private:
  using I = TangentIndex;

  [[nodiscard]] static Square<double> to_heading(double yaw) {
    return square(quaternion_from_yaw(-yaw).toRotationMatrix());
  }

  Matrix P_;
};

}  // namespace tilt_ropter::detail
