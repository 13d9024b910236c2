// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/one_processor.hpp>

#include <Eigen/Core>

#include <cmath>
#include <limits>

/// Include this header wherever code tests whether a number is finite. With -ffast-math the
/// compiler assumes that all numbers are finite. Bad input then passes the tests, and its effects
/// are unpredictable.
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0
#error "tilt_ropter asks isfinite(), which -ffast-math takes away: add -fno-finite-math-only"
#endif

namespace tilt_ropter {

/// Returns true if every entry is finite. For scalars of automatic differentiation, tests the value
/// but not the derivatives. Eigen's allFinite() tests whether x - x is NaN. Clang's
/// -fassociative-math, a part of -ffast-math, replaces x - x by zero.
template <typename Derived>
[[nodiscard]] bool all_finite(const Eigen::MatrixBase<Derived>& values) noexcept {
  using Limits = Eigen::NumTraits<typename Derived::Scalar>;
  bool finite = true;
  for (Eigen::Index j = 0; j < values.cols(); ++j)
    for (Eigen::Index i = 0; i < values.rows(); ++i)
      finite &= values.coeff(i, j) >= Limits::lowest() && values.coeff(i, j) <= Limits::highest();
  return finite;
}

namespace detail {

inline constexpr double infinity = std::numeric_limits<double>::infinity();

/// The larger of two numbers, NaN if either of them is NaN: std::max may drop a NaN.
[[nodiscard]] inline double larger(double a, double b) noexcept {
  return std::isnan(a) || a > b ? a : b;
}

}  // namespace detail

}  // namespace tilt_ropter
