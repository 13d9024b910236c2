// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

/// Plain loops over the entries of Eigen matrices of fixed or dynamic size. They replace Eigen's
/// expressions in code that every user of the controller compiles. One Eigen expression
/// instantiates about a dozen types; their compile time equals that of a screenful of loops.
namespace tilt_ropter::detail {

/// Converts to a matrix of any fixed size with all entries equal to `value`.
struct Filled {
  double value = 0.0;

  template <typename Matrix, typename Scalar = typename Matrix::Scalar>
  operator Matrix() const {
    Matrix matrix;
    std::fill_n(matrix.data(), matrix.size(), Scalar(value));
    return matrix;
  }
};

/// Sets all entries to `value`.
template <typename Matrix>
void fill(Matrix& matrix, double value) {
  std::fill_n(matrix.data(), matrix.size(), typename Matrix::Scalar(value));
}

/// Copies the first `count` entries of a vector.
template <typename From, typename To>
void copy_first(int count, const From& from, To& to) {
  for (int i = 0; i < count; ++i) to(i) = from(i);
}

/// Returns the largest absolute value of all entries. Ignores NaN.
template <typename Matrix>
[[nodiscard]] double largest(const Matrix& matrix) {
  double most = 0.0;
  for (decltype(matrix.size()) i = 0; i < matrix.size(); ++i)
    most = std::max(most, std::abs(matrix.coeff(i)));
  return most;
}

}  // namespace tilt_ropter::detail
