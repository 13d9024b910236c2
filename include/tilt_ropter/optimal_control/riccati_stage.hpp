// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/entries.hpp>
#include <tilt_ropter/math/packet.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

/// What one node of Riccati's linear-quadratic problem is made of.
namespace tilt_ropter {

/// A node of the linear-quadratic problem in whole packets: vectors and columns are (dx, du),
/// filled up with zeros.
template <int States, int Inputs>
struct RiccatiStage {
  static constexpr int width = States + Inputs, rows = detail::padded(width),
                       state_rows = detail::padded(States), input_rows = detail::padded(Inputs);
  using Vector = Eigen::Matrix<double, rows, 1>;

  Eigen::Matrix<double, rows, state_rows> transition =
      detail::Filled();  ///< [A B]' of the interval from here
  Eigen::Matrix<double, state_rows, 1> defect = detail::Filled();
  QuadraticModel<States, Inputs> cost;

  // Written by factorise(): columns [Y; L] divided by the diagonal of L, in order of elimination;
  // one over its square; and what g_u had become when the input's turn came.
  Eigen::Matrix<double, rows, input_rows> factor = detail::Filled();
  Eigen::Matrix<double, Inputs, 1> inverse_pivot = detail::Filled();
  Eigen::Matrix<double, Inputs, 1> eliminated = detail::Filled();

  [[nodiscard]] auto A() const {
    return transition.template topLeftCorner<States, States>().transpose();
  }
  [[nodiscard]] auto B() const {
    return transition.template block<Inputs, States>(States, 0).transpose();
  }
};

/// What is added to the Hessian and gradient of a node before its inputs are eliminated:
/// add(k, hessian, gradient) of any callable, which has to outlive this, or nothing. Not a template
/// of Riccati::factorise(), which would then be compiled once more for every callable.
class NodeTerms {
 public:
  NodeTerms() = default;
  template <typename Add>
  NodeTerms(const Add& add)
      : add_(&add), call_([](const void* of, int k, double* hessian, double* gradient) {
          (*static_cast<const Add*>(of))(k, hessian, gradient);
        }) {}

  void operator()(int k, double* hessian, double* gradient) const {
    if (call_) call_(add_, k, hessian, gradient);
  }

 private:
  const void* add_ = nullptr;
  void (*call_)(const void*, int, double*, double*) = nullptr;
};

}  // namespace tilt_ropter
