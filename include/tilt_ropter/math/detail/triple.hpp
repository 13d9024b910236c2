// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <Eigen/Core>

/// 3-vectors and 3x3 matrices for the few functions where microseconds matter. Every compiler
/// inlines their operators into the caller. They are therefore compiled for the caller's
/// instruction set. Eigen's operators do not guarantee this.
namespace tilt_ropter::detail {

// Type of a scalar factor that is not deduced from the argument. The argument can then be any
// expression that converts to Scalar, such as an expression of automatic differentiation.
template <typename Scalar>
struct FactorOf {
  using type = Scalar;
};
template <typename Scalar>
using Factor = typename FactorOf<Scalar>::type;

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
};

/// 3x3 matrix, stored as its three columns.
template <typename Scalar>
struct Square {
  Triple<Scalar> x, y, z;

  [[gnu::always_inline]] Square& operator+=(const Square& b) {
    x += b.x;
    y += b.y;
    z += b.z;
    return *this;
  }
};

template <typename Scalar>
[[gnu::always_inline]] inline Triple<Scalar> operator+(const Triple<Scalar>& a,
                                                       const Triple<Scalar>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <typename Scalar>
[[gnu::always_inline]] inline Triple<Scalar> operator-(const Triple<Scalar>& a,
                                                       const Triple<Scalar>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <typename Scalar>
[[gnu::always_inline]] inline Triple<Scalar> operator*(const Factor<Scalar>& s,
                                                       const Triple<Scalar>& a) {
  return {s * a.x, s * a.y, s * a.z};
}
/// Multiplies entry by entry.
template <typename Scalar>
[[gnu::always_inline]] inline Triple<Scalar> scaled(const Triple<Scalar>& a,
                                                    const Triple<Scalar>& by) {
  return {a.x * by.x, a.y * by.y, a.z * by.z};
}
template <typename Scalar>
[[gnu::always_inline]] inline Scalar dot(const Triple<Scalar>& a, const Triple<Scalar>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <typename Scalar>
[[gnu::always_inline]] inline Triple<Scalar> cross(const Triple<Scalar>& a,
                                                   const Triple<Scalar>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> operator+(const Square<Scalar>& m,
                                                       const Square<Scalar>& n) {
  return {m.x + n.x, m.y + n.y, m.z + n.z};
}
template <typename Scalar>
[[gnu::always_inline]] inline Triple<Scalar> operator*(const Square<Scalar>& m,
                                                       const Triple<Scalar>& a) {
  return {m.x.x * a.x + m.y.x * a.y + m.z.x * a.z, m.x.y * a.x + m.y.y * a.y + m.z.y * a.z,
          m.x.z * a.x + m.y.z * a.y + m.z.z * a.z};
}
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> operator*(const Square<Scalar>& m,
                                                       const Square<Scalar>& n) {
  return {m * n.x, m * n.y, m * n.z};
}
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> operator*(const Factor<Scalar>& s,
                                                       const Square<Scalar>& m) {
  return {s * m.x, s * m.y, s * m.z};
}
/// Scales the rows: diag(by) m.
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> scaled(const Square<Scalar>& m,
                                                    const Triple<Scalar>& by) {
  return {scaled(m.x, by), scaled(m.y, by), scaled(m.z, by)};
}
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> transposed(const Square<Scalar>& m) {
  return {{m.x.x, m.y.x, m.z.x}, {m.x.y, m.y.y, m.z.y}, {m.x.z, m.y.z, m.z.z}};
}
/// Returns m times the cross-product matrix of a.
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> times_cross(const Square<Scalar>& m,
                                                         const Triple<Scalar>& a) {
  return {a.z * m.y - a.y * m.z, a.x * m.z - a.z * m.x, a.y * m.x - a.x * m.y};
}
/// Returns the derivative of -w x (J w) with respect to w. `inertia` is J, `momentum` is J w.
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> gyroscopic(const Square<Scalar>& inertia,
                                                        const Triple<Scalar>& w,
                                                        const Triple<Scalar>& momentum) {
  const Scalar zero(0);
  return {Triple<Scalar>{zero, momentum.z, -momentum.y} - cross(w, inertia.x),
          Triple<Scalar>{-momentum.z, zero, momentum.x} - cross(w, inertia.y),
          Triple<Scalar>{momentum.y, -momentum.x, zero} - cross(w, inertia.z)};
}
/// Returns d I + a b' + the cross-product matrix of c.
template <typename Scalar>
[[gnu::always_inline]] inline Square<Scalar> outer(const Factor<Scalar>& d, const Triple<Scalar>& a,
                                                   const Triple<Scalar>& b,
                                                   const Triple<Scalar>& c) {
  return {{d + a.x * b.x, a.y * b.x + c.z, a.z * b.x - c.y},
          {a.x * b.y - c.z, d + a.y * b.y, a.z * b.y + c.x},
          {a.x * b.z + c.y, a.y * b.z - c.x, d + a.z * b.z}};
}

template <typename Derived>
[[gnu::always_inline]] inline Triple<typename Derived::Scalar> triple(
    const Eigen::MatrixBase<Derived>& a) {
  return {a.coeff(0), a.coeff(1), a.coeff(2)};
}
/// Reads the entries row, row + 1, row + 2 of a column.
template <typename Matrix>
[[gnu::always_inline]] inline Triple<typename Matrix::Scalar> triple_at(const Matrix& m, int row,
                                                                        int column = 0) {
  return {m.coeff(row, column), m.coeff(row + 1, column), m.coeff(row + 2, column)};
}
/// Reads the 3x3 block whose first entry is (row, column).
template <typename Matrix>
[[gnu::always_inline]] inline Square<typename Matrix::Scalar> square_at(const Matrix& m, int row,
                                                                        int column) {
  return {triple_at(m, row, column), triple_at(m, row, column + 1), triple_at(m, row, column + 2)};
}
template <typename Derived>
[[gnu::always_inline]] inline Square<typename Derived::Scalar> square(
    const Eigen::MatrixBase<Derived>& m) {
  return square_at(m.derived(), 0, 0);
}
/// Returns the inverse of a 3x3 matrix, from its cofactors. Compiles faster than Eigen's.
inline Eigen::Matrix3d inverse(const Eigen::Matrix3d& m) noexcept {
  const auto [x, y, z] = square(m);
  const Triple<double> yz = cross(y, z), zx = cross(z, x), xy = cross(x, y);
  const double determinant = dot(x, yz);
  Eigen::Matrix3d result;
  result << yz.x, yz.y, yz.z, zx.x, zx.y, zx.z, xy.x, xy.y, xy.z;
  for (int i = 0; i < 9; ++i) result(i) /= determinant;
  return result;
}
/// Writes the entries row, row + 1, row + 2 of a column.
template <typename Scalar, typename Matrix>
[[gnu::always_inline]] inline void put(const Triple<Scalar>& a, Matrix& m, int row, int column) {
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

}  // namespace tilt_ropter::detail
