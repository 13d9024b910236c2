// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/simd.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <utility>

/// The small linear algebra of the control loop: entries, 3-vectors, the inverse of a 3x3 matrix,
/// singular values, Cholesky factorisations.
///
/// Matrices are stored in Eigen's types, and the estimators and identification compute with Eigen
/// where a few types suffice. Products and Cholesky are from here: a program with Ekf takes 6.8 s
/// to compile instead of 22.4 s (GCC, -O2). In the control loop the functions below replace
/// Eigen's, for four reasons.
///
/// 1. Time to compile. Every user of the controller compiles them. A file that includes Eigen/Dense
///    takes 0.8 s (clang 14, -O2). One use of each adds:
///
///        own      Eigen
///        0.15 s   5.0 s    singular values of a 6x8 matrix (JacobiSVD)
///        0.15 s   1.9 s    Cholesky factorisation, solution and product of any size (LLT)
///        0.06 s   0.43 s   one expression of 3-vectors and one of 3x3 matrices
///        0.05 s   0.17 s   inverse of a 3x3 matrix
///
///    A program that uses Nmpc takes 11.0 s with Filled and fill(), 11.9 s with Eigen's Constant.
/// 2. Instructions. vectorised() compiles a function for AVX2 and FMA, with all that the compiler
///    inlines into it. Every compiler inlines the operators of 3-vectors and 3x3 matrices, because
///    they are always_inline. Eigen's operators do not guarantee this.
/// 3. Scalars. 3-vectors work with numbers, Lanes and automatic differentiation. The factor of a
///    product is converted to the scalar first, so any expression of automatic differentiation can
///    be a factor.
/// 4. Singular matrices. Eigen's LLT ends at the first pivot that is not positive. The
///    factorisations below leave out that column and solve for the others. The singular values have
///    the same relative accuracy, whether they are small or large.
///
/// The control loop has two Cholesky factorisations: one for a size that is known when the file is
/// compiled, one for a size that is known only at run time. To factorise and solve takes them 0.13
/// and 0.24 us for 6 rows, 46 and 16 us for 80 rows. LLT takes 0.23 and 25 us. The elimination in
/// Riccati is a third one. It is a part of the pass over columns of packets and stays there.
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

/// Returns the largest absolute value of all entries. Ignores NaN. Zero if there are no entries.
template <typename Matrix>
[[nodiscard]] double largest(const Matrix& matrix) {
  double most = 0.0;
  for (decltype(matrix.size()) i = 0; i < matrix.size(); ++i)
    most = std::max(most, std::abs(matrix.coeff(i)));
  return most;
}

template <typename Scalar>
struct Square;

/// Vector of three components.
template <typename Scalar>
struct Triple {
  Scalar x, y, z;

  [[gnu::always_inline]] Triple& operator+=(const Triple& b) {
    x += b.x;
    y += b.y;
    z += b.z;
    return *this;
  }

  [[gnu::always_inline]] friend Triple operator+(const Triple& a, const Triple& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
  }
  [[gnu::always_inline]] friend Triple operator-(const Triple& a, const Triple& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
  }
  [[gnu::always_inline]] friend Triple operator*(const Scalar& s, const Triple& a) {
    return {s * a.x, s * a.y, s * a.z};
  }
  /// Multiplies entry by entry.
  [[gnu::always_inline]] friend Triple scaled(const Triple& a, const Triple& by) {
    return {a.x * by.x, a.y * by.y, a.z * by.z};
  }
  [[gnu::always_inline]] friend Scalar dot(const Triple& a, const Triple& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
  }
  [[gnu::always_inline]] friend Triple cross(const Triple& a, const Triple& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
  }
  /// Returns d I + a b' + the cross-product matrix of c.
  [[gnu::always_inline]] friend Square<Scalar> outer(const Scalar& d, const Triple& a,
                                                     const Triple& b, const Triple& c) {
    return {{d + a.x * b.x, a.y * b.x + c.z, a.z * b.x - c.y},
            {a.x * b.y - c.z, d + a.y * b.y, a.z * b.y + c.x},
            {a.x * b.z + c.y, a.y * b.z - c.x, d + a.z * b.z}};
  }
};

/// 3x3 matrix, stored as its three columns.
template <typename Scalar>
struct Square {
  using Triple = detail::Triple<Scalar>;
  Triple x, y, z;

  [[gnu::always_inline]] Square& operator+=(const Square& b) {
    x += b.x;
    y += b.y;
    z += b.z;
    return *this;
  }

  [[gnu::always_inline]] friend Square operator+(const Square& m, const Square& n) {
    return {m.x + n.x, m.y + n.y, m.z + n.z};
  }
  [[gnu::always_inline]] friend Triple operator*(const Square& m, const Triple& a) {
    return {m.x.x * a.x + m.y.x * a.y + m.z.x * a.z, m.x.y * a.x + m.y.y * a.y + m.z.y * a.z,
            m.x.z * a.x + m.y.z * a.y + m.z.z * a.z};
  }
  [[gnu::always_inline]] friend Square operator*(const Square& m, const Square& n) {
    return {m * n.x, m * n.y, m * n.z};
  }
  [[gnu::always_inline]] friend Square operator*(const Scalar& s, const Square& m) {
    return {s * m.x, s * m.y, s * m.z};
  }
  /// Scales the rows: diag(by) m.
  [[gnu::always_inline]] friend Square scaled(const Square& m, const Triple& by) {
    return {scaled(m.x, by), scaled(m.y, by), scaled(m.z, by)};
  }
  [[gnu::always_inline]] friend Square transposed(const Square& m) {
    return {{m.x.x, m.y.x, m.z.x}, {m.x.y, m.y.y, m.z.y}, {m.x.z, m.y.z, m.z.z}};
  }
  /// Returns m times the cross-product matrix of a.
  [[gnu::always_inline]] friend Square times_cross(const Square& m, const Triple& a) {
    return {a.z * m.y - a.y * m.z, a.x * m.z - a.z * m.x, a.y * m.x - a.x * m.y};
  }
};

/// Reads the entries row, row + 1, row + 2 of a column.
template <typename Matrix>
[[gnu::always_inline]] inline Triple<typename Matrix::Scalar> triple(const Matrix& m, int row = 0,
                                                                     int column = 0) {
  return {m.coeff(row, column), m.coeff(row + 1, column), m.coeff(row + 2, column)};
}
/// Reads the 3x3 block whose first entry is (row, column).
template <typename Matrix>
[[gnu::always_inline]] inline Square<typename Matrix::Scalar> square(const Matrix& m, int row = 0,
                                                                     int column = 0) {
  return {triple(m, row, column), triple(m, row, column + 1), triple(m, row, column + 2)};
}
/// Writes the entries row, row + 1, row + 2 of a column.
template <typename Scalar, typename Matrix>
[[gnu::always_inline]] inline void put(const Triple<Scalar>& a, Matrix& m, int row = 0,
                                       int column = 0) {
  m.coeffRef(row, column) = a.x;
  m.coeffRef(row + 1, column) = a.y;
  m.coeffRef(row + 2, column) = a.z;
}
/// Writes the 3x3 block whose first entry is (row, column).
template <typename Scalar, typename Matrix>
[[gnu::always_inline]] inline void put(const Square<Scalar>& a, Matrix& m, int row, int column) {
  put(a.x, m, row, column);
  put(a.y, m, row, column + 1);
  put(a.z, m, row, column + 2);
}

/// Returns the inverse of a 3x3 matrix, from its cofactors. If the determinant is zero, the entries
/// are infinite or NaN.
[[nodiscard]] inline Eigen::Matrix3d inverse(const Eigen::Matrix3d& m) noexcept {
  const auto [x, y, z] = square(m);
  const Triple<double> yz = cross(y, z), zx = cross(z, x), xy = cross(x, y);
  const double determinant = dot(x, yz);
  Eigen::Matrix3d result;
  result << yz.x, yz.y, yz.z, zx.x, zx.y, zx.z, xy.x, xy.y, xy.z;
  for (int i = 0; i < 9; ++i) result(i) /= determinant;
  return result;
}

/// Singular value decomposition A = left diag(values) right. A must not have more rows than
/// columns. The method rotates pairs of rows until all rows are orthogonal (one-sided Jacobi,
/// Hestenes 1958). Small and large values have the same relative accuracy (Demmel & Veselic,
/// "Jacobi's method is more accurate than QR", 1992).
template <int Rows, int Columns>
struct SingularValues {
  static_assert(Rows <= Columns);

  Eigen::Matrix<double, Rows, Rows> left = Filled();  ///< orthogonal
  Eigen::Matrix<double, Rows, 1> values = Filled();   ///< in decreasing order
  /// Orthonormal rows. The rows of zero values are zero.
  Eigen::Matrix<double, Rows, Columns> right;

  /// Decomposes `A`. Its entries must be finite, and their squares must not overflow or underflow;
  /// with -ffast-math their fourth powers. With a NaN, an infinite entry or an overflow, a value is
  /// not finite, and the rank is less than Rows. Does not allocate.
  explicit SingularValues(const Eigen::Matrix<double, Rows, Columns>& A) : right(A) {
    constexpr int max_sweeps = 60;  // 6 or 7 sweeps are usual
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
      std::swap(values(i), values(most));
      for (int c = 0; c < Columns; ++c) std::swap(right(i, c), right(most, c));
      for (int r = 0; r < Rows; ++r) std::swap(left(r, i), left(r, most));
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
};

/// Replaces the lower triangle of a symmetric matrix of fixed size by its Cholesky factor. If the
/// pivot of a column is at most 1e-15 times its diagonal entry, or NaN, the column is left out: its
/// diagonal entry becomes infinite, the entries below zero. The upper triangle is not read.
template <int Size>
void factorise(Eigen::Matrix<double, Size, Size>& matrix) noexcept {
  for (int j = 0; j < Size; ++j) {
    const double before = matrix(j, j);
    double pivot = before;
    for (int k = 0; k < j; ++k) pivot -= matrix(j, k) * matrix(j, k);
    const bool flat = !(pivot > 1e-15 * before) || !(before > 0.0);
    const double root = flat ? std::numeric_limits<double>::infinity() : std::sqrt(pivot);
    matrix(j, j) = root;
    for (int i = j + 1; i < Size; ++i) {
      double entry = matrix(i, j);
      for (int k = 0; k < j; ++k) entry -= matrix(i, k) * matrix(j, k);
      matrix(i, j) = flat ? 0.0 : entry / root;
    }
  }
}

/// Replaces the `Size` entries of x by the solution y of L L' y = x, where L is the `factor` from
/// factorise(). The entries of y for columns that were left out are zero.
template <int Size>
void solve_factorised(const Eigen::Matrix<double, Size, Size>& factor, double* x) noexcept {
  for (int j = 0; j < Size; ++j) {
    for (int k = 0; k < j; ++k) x[j] -= factor(j, k) * x[k];
    x[j] /= factor(j, j);
  }
  for (int j = Size - 1; j >= 0; --j) {
    for (int k = j + 1; k < Size; ++k) x[j] -= factor(k, j) * x[k];
    x[j] /= factor(j, j);
  }
}

/// Cholesky factorisation S = L L' of a symmetric matrix of any scalar, for the estimators. The
/// upper triangle is not read.
template <typename Scalar, int Size>
struct Cholesky {
  Eigen::Matrix<Scalar, Size, Size> factor;  ///< L in the lower triangle
  bool is_definite = true;                   ///< false: a pivot is not positive, and L is useless

  explicit Cholesky(const Eigen::Matrix<Scalar, Size, Size>& matrix) noexcept : factor(matrix) {
    using std::sqrt;
    for (int j = 0; j < Size && is_definite; ++j) {
      for (int i = j; i < Size; ++i)
        for (int k = 0; k < j; ++k) factor(i, j) -= factor(i, k) * factor(j, k);
      is_definite = factor(j, j) > Scalar(0);
      factor(j, j) = sqrt(factor(j, j));
      for (int i = j + 1; i < Size; ++i) factor(i, j) /= factor(j, j);
    }
  }

  /// Returns rows S^-1, by whole columns.
  template <int Rows>
  [[nodiscard]] Eigen::Matrix<Scalar, Rows, Size> solve_rows(
      Eigen::Matrix<Scalar, Rows, Size> rows) const noexcept {
    const auto eliminate = [&rows](int j, int k, const Scalar& by) {
      for (int i = 0; i < Rows; ++i) rows(i, j) -= by * rows(i, k);
    };
    const auto divide = [&rows](int j, const Scalar& by) {
      for (int i = 0; i < Rows; ++i) rows(i, j) /= by;
    };
    for (int j = 0; j < Size; ++j) {
      for (int k = 0; k < j; ++k) eliminate(j, k, factor(j, k));
      divide(j, factor(j, j));
    }
    for (int j = Size - 1; j >= 0; --j) {
      for (int k = j + 1; k < Size; ++k) eliminate(j, k, factor(k, j));
      divide(j, factor(j, j));
    }
    return rows;
  }
  /// Returns S^-1 x.
  [[nodiscard]] Eigen::Matrix<Scalar, Size, 1> solve(
      const Eigen::Matrix<Scalar, Size, 1>& x) const noexcept {
    const Eigen::Matrix<Scalar, 1, Size> row = solve_rows(Eigen::Matrix<Scalar, 1, Size>(x.data()));
    return Eigen::Matrix<Scalar, Size, 1>(row.data());
  }
};

/// A factor of a product of fixed size: entry (k, j) is data[along * k + across * j].
template <typename Scalar>
struct Entries {
  const Scalar* data;
  int along, across;
};
template <typename Matrix>
[[nodiscard]] Entries<typename Matrix::Scalar> entries(const Matrix& m) {
  return {m.data(), 1, static_cast<int>(m.rows())};
}
template <typename Matrix>
[[nodiscard]] Entries<typename Matrix::Scalar> transposed_entries(const Matrix& m) {
  return {m.data(), static_cast<int>(m.rows()), 1};
}

/// result += factor A B for any scalar. A and the result are stored by columns, without gaps.
template <int Rows, int Inner, int Columns, typename Scalar>
void add_product(const Scalar* a, const Entries<Scalar>& b, Scalar* result,
                 const Scalar& factor = Scalar(1)) noexcept {
  for (int j = 0; j < Columns; ++j) {
    Scalar sum[size(Rows)] = {};
    for (int k = 0; k < Inner; ++k) {
      const Scalar& entry = b.data[b.along * k + b.across * j];
      for (int i = 0; i < Rows; ++i) sum[i] += a[Rows * k + i] * entry;
    }
    for (int i = 0; i < Rows; ++i) result[Rows * j + i] += factor * sum[i];
  }
}

/// Replaces M by (M + M') / 2.
template <typename Scalar, int Size>
void symmetrise(Eigen::Matrix<Scalar, Size, Size>& m) noexcept {
  for (int j = 1; j < Size; ++j)
    for (int i = 0; i < j; ++i) m(i, j) = m(j, i) = (m(i, j) + m(j, i)) / Scalar(2);
}

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
    add_product<Width>(sum, column, x.data[x.stride * j]);
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

/// The same in packets for an n x n matrix whose size is known only at run time. A column is set to
/// zero if its pivot is at most `least` times its diagonal entry, or NaN: it then depends linearly
/// on the columns before it. Returns the number of these columns. The upper triangle is not read.
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

/// Replaces x by the solution y of L L' y = x, where L is the `factor` from factorise() above. The
/// entries of y for columns that were set to zero are zero.
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
