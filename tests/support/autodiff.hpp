#pragma once

#include <Eigen/Core>
#include <unsupported/Eigen/AutoDiff>

/// Jacobians by forward automatic differentiation: an independent reference for analytic Jacobians.
namespace test_support {

template <int Inputs>
using Dual = Eigen::AutoDiffScalar<Eigen::Matrix<double, Inputs, 1>>;

/// Returns the Jacobian at zero of a function from a vector of `Inputs` duals to a vector of
/// `Outputs` duals.
template <int Outputs, int Inputs, typename Function>
Eigen::Matrix<double, Outputs, Inputs> jacobian_at_zero(const Function& function) {
  Eigen::Matrix<Dual<Inputs>, Inputs, 1> zero;
  for (int i = 0; i < Inputs; ++i) zero(i) = Dual<Inputs>(0.0, Inputs, i);
  const Eigen::Matrix<Dual<Inputs>, Outputs, 1> value = function(zero);
  Eigen::Matrix<double, Outputs, Inputs> jacobian;
  for (int i = 0; i < Outputs; ++i) {
    if (value(i).derivatives().size() == Inputs)
      jacobian.row(i) = value(i).derivatives().transpose();
    else
      jacobian.row(i).setZero();
  }
  return jacobian;
}

}  // namespace test_support
