// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

/// Plain loops over the entries of Eigen's matrices of fixed or dynamic size: what Eigen's own
/// expressions do, for code that every user of the controller compiles. Each expression is a dozen
/// types, and the compiler takes as long for them as for a screenful of loops.
namespace tilt_ropter::detail {

/// Becomes any matrix of fixed size whose entries all are `value`.
struct Filled {
  double value = 0.0;

  template <typename Matrix, typename Scalar = typename Matrix::Scalar>
  operator Matrix() const {
    Matrix matrix;
    std::fill_n(matrix.data(), matrix.size(), Scalar(value));
    return matrix;
  }
};

template <typename Matrix>
void fill(Matrix& matrix, double value) {
  std::fill_n(matrix.data(), matrix.size(), typename Matrix::Scalar(value));
}

/// Copies the first `count` entries.
template <typename From, typename To>
void copy_first(int count, const From& from, To& to) {
  for (int i = 0; i < count; ++i) to(i) = from(i);
}

/// The largest absolute value; NaN does not count.
template <typename Matrix>
[[nodiscard]] double largest(const Matrix& matrix) {
  double most = 0.0;
  for (decltype(matrix.size()) i = 0; i < matrix.size(); ++i)
    most = std::max(most, std::abs(matrix.coeff(i)));
  return most;
}

}  // namespace tilt_ropter::detail
