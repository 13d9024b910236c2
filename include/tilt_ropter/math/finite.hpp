// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/one_processor.hpp>

#include <Eigen/Core>

/// For every header that asks whether a number is finite: -ffast-math would have it believe so of
/// all, and what bad input does then is anyone's guess.
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0
#error "tilt_ropter asks isfinite(), which -ffast-math takes away: add -fno-finite-math-only"
#endif

namespace tilt_ropter {

/// True if every entry is finite, of the values where there are derivatives, too. Eigen's
/// allFinite() asks whether x - x is NaN, which clang's -fassociative-math, a part of -ffast-math,
/// makes zero.
template <typename Derived>
[[nodiscard]] bool all_finite(const Eigen::MatrixBase<Derived>& values) noexcept {
  using Limits = Eigen::NumTraits<typename Derived::Scalar>;
  bool finite = true;
  for (Eigen::Index j = 0; j < values.cols(); ++j)
    for (Eigen::Index i = 0; i < values.rows(); ++i)
      finite &= values.coeff(i, j) >= Limits::lowest() && values.coeff(i, j) <= Limits::highest();
  return finite;
}

}  // namespace tilt_ropter
