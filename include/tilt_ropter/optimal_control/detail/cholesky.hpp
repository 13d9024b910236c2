// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/simd.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>

/// Products and Cholesky factorisations of small matrices whose size is known only at run time.
/// Eigen's functions are made for large matrices and add seconds to the compile time.
namespace tilt_ropter::detail {

/// A matrix whose columns are `stride` numbers apart in memory.
struct MatrixView {
  const double* data;
  int rows, columns;
  std::ptrdiff_t stride;
};

/// A vector whose entries are `stride` numbers apart in memory, such as a row of a MatrixView.
struct VectorView {
  const double* data;
  std::ptrdiff_t stride = 1;
};

/// add_product() for `Packets` packets of rows, from row `first` on.
template <int Width, int Packets>
[[gnu::always_inline]] inline void add_product_rows(double factor, const MatrixView& m,
                                                    const VectorView& x, int first,
                                                    double* result) {
  Packet<Width> sum[size(Packets)] = {};
  for (int j = 0; j < m.columns; ++j) {
    const double* column = m.data + m.stride * j + first;
#pragma GCC unroll 4
    for (int t = 0; t < Packets; ++t)
      add_product<Width>(sum[t], column + Width * t, x.data[x.stride * j]);
  }
#pragma GCC unroll 4
  for (int t = 0; t < Packets; ++t) {
    double* entries = result + first + Width * t;
    Packet<Width> before;
    load<Width>(entries, before);
    store<Width>(entries, before + factor * sum[t]);
  }
}

/// result += factor M x.
inline void add_product(double factor, const MatrixView& m, const VectorView& x, double* result) {
  vectorised([&](auto packet) __attribute__((always_inline)) {
    constexpr int Width = packet();
    int i = 0;
    for (; i + 4 * Width <= m.rows; i += 4 * Width)
      add_product_rows<Width, 4>(factor, m, x, i, result);
    for (; i + Width <= m.rows; i += Width) add_product_rows<Width, 1>(factor, m, x, i, result);
    for (; i < m.rows; ++i) {
      double sum = 0.0;
      for (int j = 0; j < m.columns; ++j) sum += m.data[m.stride * j + i] * x.data[x.stride * j];
      result[i] += factor * sum;
    }
    return true;
  });
}

/// Returns a' b for vectors of `count` entries.
[[nodiscard]] inline double dot(const double* a, const double* b, int count) {
  return vectorised([&](auto packet) __attribute__((always_inline)) {
    constexpr int Width = packet();
    Packet<Width> sums[2] = {};  // two sums, because each addition must wait for the one before
    int i = 0;
    for (; i + 2 * Width <= count; i += 2 * Width) {
#pragma GCC unroll 2
      for (int t = 0; t < 2; ++t) {
        Packet<Width> left, right;
        load<Width>(a + i + Width * t, left);
        load<Width>(b + i + Width * t, right);
        sums[t] += left * right;
      }
    }
    sums[0] += sums[1];
    double sum = 0.0;
#pragma GCC unroll 4
    for (int t = 0; t < Width; ++t) sum += sums[0][t];
    for (; i < count; ++i) sum += a[i] * b[i];
    return sum;
  });
}

/// Replaces the lower triangle of an n x n matrix by its Cholesky factor. A column is set to zero
/// if its pivot is at most `least` times its diagonal entry: it then depends linearly on the
/// columns before it. Returns the number of these columns.
[[nodiscard]] inline int factorise(double* matrix, std::ptrdiff_t stride, int n,
                                   double least = 0.0) {
  int dropped = 0;
  for (int j = 0; j < n; ++j) {
    double* column = matrix + stride * j;
    const double diagonal = column[j];
    add_product(-1.0, {matrix + j, n - j, j, stride}, {matrix + j, stride}, column + j);
    if (column[j] > least * diagonal) {
      const double root = std::sqrt(column[j]), inverse = 1.0 / root;
      column[j] = root;
      for (int i = j + 1; i < n; ++i) column[i] *= inverse;
    } else {  // also if the pivot is NaN
      std::fill(column + j, column + n, 0.0);
      ++dropped;
    }
  }
  return dropped;
}

/// Replaces x by the solution y of L L' y = x, where L is the `factor` from factorise(). The
/// entries of y for columns that factorise() set to zero are zero.
inline void solve_factorised(const double* factor, std::ptrdiff_t stride, int n, double* x) {
  for (int j = 0; j < n; ++j) {
    const double* column = factor + stride * j;
    x[j] = column[j] > 0.0 ? x[j] / column[j] : 0.0;
    add_product(-1.0, {column + j + 1, n - j - 1, 1, stride}, {x + j}, x + j + 1);
  }
  for (int j = n - 1; j >= 0; --j) {
    const double* column = factor + stride * j;
    const double rest = x[j] - dot(column + j + 1, x + j + 1, n - j - 1);
    x[j] = column[j] > 0.0 ? rest / column[j] : 0.0;
  }
}

}  // namespace tilt_ropter::detail
