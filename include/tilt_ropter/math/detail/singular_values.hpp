// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/entries.hpp>

#include <Eigen/Core>

#include <cmath>
#include <utility>

namespace tilt_ropter {

/// Singular value decomposition A = left diag(values) right. A must not have more rows than
/// columns. The method rotates pairs of rows until all rows are orthogonal (one-sided Jacobi,
/// Hestenes 1958). Small and large values have the same relative accuracy (Demmel & Veselic,
/// "Jacobi's method is more accurate than QR", 1992). Eigen's decomposition is faster for large
/// matrices, but takes 50 times longer to compile.
template <int Rows, int Columns>
struct SingularValues {
  static_assert(Rows <= Columns);

  Eigen::Matrix<double, Rows, Rows> left = detail::Filled();  ///< orthogonal
  Eigen::Matrix<double, Rows, 1> values = detail::Filled();   ///< in decreasing order
  /// Orthonormal rows. The rows of zero values are zero.
  Eigen::Matrix<double, Rows, Columns> right;

  /// Decomposes `A`. Its entries must be finite, and their squares must not overflow or underflow.
  /// Does not allocate.
  explicit SingularValues(const Eigen::Matrix<double, Rows, Columns>& A) : right(A) {
    for (int i = 0; i < Rows; ++i) left(i, i) = 1.0;
    for (int sweep = 0; sweep < max_sweeps; ++sweep) {
      bool rotated = false;
      for (int i = 0; i < Rows; ++i)
        for (int j = i + 1; j < Rows; ++j) rotated = rotate(i, j) || rotated;
      if (!rotated) break;
    }
    for (int i = 0; i < Rows; ++i) {
      values(i) = std::sqrt(product(i, i));
      for (int c = 0; c < Columns; ++c)
        right(i, c) = values(i) > 0.0 ? right(i, c) / values(i) : 0.0;
    }
    for (int i = 0; i < Rows; ++i) {
      int most = i;
      for (int j = i; j < Rows; ++j)
        if (values(j) > values(most)) most = j;
      exchange(i, most);
    }
  }

  /// Returns the number of values above `fraction` times the largest value.
  [[nodiscard]] int rank(double fraction) const {
    int rank = 0;
    for (int i = 0; i < Rows; ++i) rank += values(i) > fraction * values(0);
    return rank;
  }

 private:
  [[nodiscard]] double product(int i, int j) const {
    double sum = 0.0;
    for (int c = 0; c < Columns; ++c) sum += right(i, c) * right(j, c);
    return sum;
  }

  // Makes rows i and j orthogonal. Returns false if they are already orthogonal.
  bool rotate(int i, int j) {
    const double ii = product(i, i), jj = product(j, j), ij = product(i, j);
    if (!(std::abs(ij) > 1e-15 * std::sqrt(ii) * std::sqrt(jj))) return false;
    const double ratio = (jj - ii) / (2.0 * ij),
                 tangent = (ratio < 0.0 ? -1.0 : 1.0) / (std::abs(ratio) + std::hypot(1.0, ratio)),
                 cosine = 1.0 / std::hypot(1.0, tangent), sine = cosine * tangent;
    const auto turn = [=](double& a, double& b) {
      const double before = a;
      a = cosine * before - sine * b;
      b = sine * before + cosine * b;
    };
    for (int c = 0; c < Columns; ++c) turn(right(i, c), right(j, c));
    for (int r = 0; r < Rows; ++r) turn(left(r, i), left(r, j));
    return true;
  }

  void exchange(int i, int j) {
    std::swap(values(i), values(j));
    for (int c = 0; c < Columns; ++c) std::swap(right(i, c), right(j, c));
    for (int r = 0; r < Rows; ++r) std::swap(left(r, i), left(r, j));
  }

  static constexpr int max_sweeps = 60;  // 6 or 7 sweeps are usual
};

}  // namespace tilt_ropter
