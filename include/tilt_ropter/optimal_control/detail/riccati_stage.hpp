// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <array>
#include <cstddef>

/// The data of one node of the linear-quadratic problem of Riccati.
namespace tilt_ropter::optimal_control {

/// A node of the linear-quadratic problem, stored in whole packets: vectors and columns are (dx,
/// du), padded with zeros.
template <int States, int Inputs>
struct RiccatiStage {
  static constexpr int width = States + Inputs, rows = detail::padded(width),
                       state_rows = detail::padded(States), input_rows = detail::padded(Inputs);
  using Vector = Eigen::Matrix<double, rows, 1>;

  Eigen::Matrix<double, rows, state_rows> transition =
      detail::Filled();  ///< [A B]' of the interval that starts here
  Eigen::Matrix<double, state_rows, 1> defect = detail::Filled();
  QuadraticModel<States, Inputs> cost;

  // factorise() writes the following three: the columns [Y; L] divided by the diagonal of L, in
  // order of elimination; 1 / (diagonal of L)^2; and the entry of g_u of each input at its
  // elimination.
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

/// Terms that are added to the Hessian and gradient of a node before its inputs are eliminated:
/// add(k, hessian, gradient) of any callable, or nothing. The callable must outlive this object.
/// The callable's type is erased: as a template, Riccati::factorise() would be compiled for every
/// callable.
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

}  // namespace tilt_ropter::optimal_control

namespace tilt_ropter::detail {

/// The entries of dx at the end of an interval that depend on certain entries of (dx, du) at its
/// start.
template <int States>
struct Reached {
  int count = 0;
  std::array<int, static_cast<std::size_t>(States)> at{};
};

/// Returns one list for each packet of `Width` entries of (dx, du), from the pattern of [A B].
template <int States, int Inputs, typename Pattern, int Width>
constexpr auto reached_by() {
  constexpr int width = States + Inputs;
  std::array<Reached<States>, static_cast<std::size_t>(padded(width) / Width)> lists{};
  for (int t = 0; t < padded(width) / Width; ++t)
    for (int row = 0; row < States; ++row) {
      bool nonzero = false;
      for (int column = Width * t; column < Width * (t + 1) && column < width; ++column)
        nonzero = nonzero || Pattern::nonzero(row, column);
      if (!nonzero) continue;
      auto& list = lists[static_cast<std::size_t>(t)];
      list.at[static_cast<std::size_t>(list.count++)] = row;
    }
  return lists;
}

}  // namespace tilt_ropter::detail
