// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

/// Allocation matrix of a vehicle's geometry (paper, Sec. Control Allocation).
namespace tilt_ropter {

namespace detail {

/// Writes the wrench at the CoM, body frame, of a force of 1 N along an axis of the rotor frame,
/// times `sign`, to a column of a 6 x 2n matrix.
template <typename Matrix>
void put_wrench(const RotorGeometry& rotor, const RotorParameters& parameters, double sign,
                int axis, int column, Matrix& matrix) {
  const Triple<double> force = sign * triple(rotor.orientation, 0, axis);
  const double drag = static_cast<int>(rotor.spin) * parameters.torque_ratio;
  put(force, matrix, 0, column);
  put(cross(triple(rotor.position), force) - drag * force, matrix, 3, column);
}

/// Writes the allocation matrix to `matrix`, 6 x 2n zeros. Returns the size of the vehicle [m]: its
/// longest arm plus torque_ratio.
template <int Rotors, typename Matrix>
double put_allocation(const Vehicle<Rotors>& vehicle, Matrix& matrix) {
  double size = 1e-9;
  for (int i = 0; i < Rotors; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[detail::size(i)];
    const RotorParameters& parameters = rotor_parameters(vehicle, detail::size(i));
    size = std::max(size, rotor.position.norm() + parameters.torque_ratio);
    if (!(rotor.effectiveness > 0.0)) continue;
    if (rotor.tilts) put_wrench(rotor, parameters, -1.0, 1, 2 * i, matrix);
    put_wrench(rotor, parameters, 1.0, 2, 2 * i + 1, matrix);
  }
  return size;
}

/// Returns the wrench A T [N; N m] of the thrusts T [N]: see AllocationMatrix.
template <typename Scalar, typename Value, int Components>
[[nodiscard]] Wrench<Value> wrench_of(const Eigen::Matrix<Scalar, 6, Components>& matrix,
                                      const Eigen::Matrix<Value, Components, 1>& thrusts) noexcept {
  Wrench<Value> wrench;
  for (int j = 0; j < Components; ++j)
    for (int row = 0; row < 3; ++row) {
      wrench.force(row) += Value(matrix(row, j)) * thrusts(j);
      wrench.torque(row) += Value(matrix(row + 3, j)) * thrusts(j);
    }
  return wrench;
}

/// Returns the thrusts [N] of least norm for a wrench, from the pseudoinverse of A.
template <typename Scalar, int Components>
[[nodiscard]] Eigen::Matrix<Scalar, Components, 1> least_thrusts(
    const Eigen::Matrix<Scalar, Components, 6>& pseudoinverse,
    const Wrench<Scalar>& wrench) noexcept {
  Eigen::Matrix<Scalar, Components, 1> thrusts = Filled();
  add_product<Components, 3, 1>(pseudoinverse.data(), entries(wrench.force), thrusts.data());
  add_product<Components, 3, 1>(pseudoinverse.data() + 3 * Components, entries(wrench.torque),
                                thrusts.data());
  return thrusts;
}

}  // namespace detail

/// Allocation matrix A with W = A T. W = (F, M) is the wrench at the CoM in the body frame. T =
/// (T_1l, T_1v, ..., T_nl, T_nv) holds the lateral and vertical thrusts T_il = T_i sin(alpha_i),
/// T_iv = T_i cos(alpha_i) (paper, Eq. allocation).
///
/// Rotor i pushes along (0, -T_il, T_iv) in its rotor frame. This force f, rotated to the body
/// frame, has the torque r_i x f - spin_i torque_ratio_i f. Column T_il of a rotor that does not
/// tilt is zero. Both columns of a lost rotor are zero. An effectiveness between 0 and 1 is not
/// part of A; it is applied where the thrusts T_i become speeds.
template <int Rotors>
struct AllocationMatrix {
  static constexpr int components = 2 * Rotors;

  Eigen::Matrix<double, 6, components> matrix = detail::Filled();  ///< A; rows F [1] and M [m]
  Eigen::Matrix<double, components, 6> pseudoinverse = detail::Filled();  ///< Moore-Penrose inverse
  Eigen::MatrixXd null_space;  ///< orthonormal columns; zero rows for zero columns of A

  /// Allocates. Throws std::invalid_argument if the geometry cannot give every wrench. The message
  /// names the rank of A and the unreachable directions.
  explicit AllocationMatrix(const Vehicle<Rotors>& vehicle) {
    static_assert(Rotors >= 3, "six components of a wrench need at least three tilting rotors");
    invert(detail::put_allocation(vehicle, matrix));
  }

  /// Singular values of A in descending order. Torques are in units of the vehicle's size, which is
  /// its longest arm plus torque_ratio. See allocation_rank(). Accepts any geometry whose products
  /// are finite, otherwise throws std::invalid_argument. Allocates.
  [[nodiscard]] static Eigen::Matrix<double, 6, 1> singular_values(const Vehicle<Rotors>& vehicle) {
    AllocationMatrix allocation;
    const double size = detail::put_allocation(vehicle, allocation.matrix);
    return allocation.decompose(size).values;
  }

 private:
  AllocationMatrix() = default;

  // For two rotors, two columns of zeros.
  using Decomposition = detail::SingularValues<6, std::max(6, components)>;

  /// Decomposes A with torques in units of the vehicle's size, so that the rank depends only on the
  /// shape. At full rank the pseudo-inverse does not depend on the size.
  [[nodiscard]] Decomposition decompose(double size) const {
    Eigen::Matrix<double, 6, std::max(6, components)> scaled = detail::Filled();
    for (int j = 0; j < components; ++j)
      for (int i = 0; i < 6; ++i) scaled(i, j) = matrix(i, j) / (i < 3 ? 1.0 : size);
    // Products of finite numbers may overflow. The rank of the decomposition is then meaningless.
    double squares = 0.0;
    for (Eigen::Index i = 0; i < scaled.size(); ++i) squares += scaled(i) * scaled(i);
    require(std::isfinite(squares), "size of the vehicle [m]", size,
            "one whose products are finite");
    return Decomposition(scaled);
  }

  void invert(double size) {
    const Decomposition svd = decompose(size);
    require_rank(svd);
    for (int i = 0; i < components; ++i)
      for (int j = 0; j < 6; ++j) {
        double sum = 0.0;
        for (int s = 0; s < 6; ++s) sum += svd.right(s, i) / svd.values(s) * svd.left(j, s);
        pseudoinverse(i, j) = j < 3 ? sum : sum / size;
      }
    set_null_space(svd);
  }

  /// Completes the rows of `svd` to an orthonormal basis. Each iteration takes the unit vector
  /// farthest from the current span. It makes it orthogonal to the span, twice because of rounding.
  void set_null_space(const Decomposition& svd) {
    std::vector<int> columns;  // of A that belong to an actuator
    for (int j = 0; j < components; ++j)
      if (!matrix.col(j).isZero(0.0)) columns.push_back(j);
    const auto count = static_cast<Eigen::Index>(columns.size()) - 6;
    null_space = Eigen::MatrixXd(components, count);
    for (Eigen::Index n = 0; n < count; ++n) {
      int farthest = columns.front();
      double most = -1.0;
      for (const int j : columns) {
        double square = 1.0;
        for (int s = 0; s < 6; ++s) square -= svd.right(s, j) * svd.right(s, j);
        for (Eigen::Index m = 0; m < n; ++m) square -= null_space(j, m) * null_space(j, m);
        if (square > most) {
          most = square;
          farthest = j;
        }
      }
      double* vector = null_space.data() + components * n;
      std::fill_n(vector, components, 0.0);
      vector[farthest] = 1.0;
      const auto take_out = [&](const auto& entry) {
        double along = 0.0;
        for (int i = 0; i < components; ++i) along += vector[i] * entry(i);
        for (int i = 0; i < components; ++i) vector[i] -= along * entry(i);
      };
      for (int twice = 0; twice < 2; ++twice) {
        for (int s = 0; s < 6; ++s) take_out([&](int i) { return svd.right(s, i); });
        for (Eigen::Index m = 0; m < n; ++m) take_out([&](int i) { return null_space(i, m); });
      }
      double square = 0.0;
      for (int i = 0; i < components; ++i) square += vector[i] * vector[i];
      for (int i = 0; i < components; ++i) vector[i] /= std::sqrt(square);
    }
  }

  static void require_rank(const Decomposition& svd) {
    const int rank = svd.rank(1e-6);
    if (rank == 6) return;
    static constexpr const char* names[] = {"force x",  "force y",  "force z",
                                            "torque x", "torque y", "torque z"};
    std::string missing;
    for (int axis = 0; axis < 6; ++axis) {
      double square = 0.0;
      for (int s = rank; s < 6; ++s) square += svd.left(axis, s) * svd.left(axis, s);
      if (square > 1e-12) missing += (missing.empty() ? "" : ", ") + std::string(names[axis]);
    }
    require(false, "rank of the allocation matrix", rank,
            "6, but " + std::to_string(6 - rank) +
                " direction(s) of the wrench cannot be produced; out of reach by themselves are " +
                missing);
  }
};

/// Rank of the allocation matrix of `vehicle`: the number of its singular values above 1e-6 times
/// the largest. Below 6 not every wrench is possible. Allocates. Throws as singular_values().
template <int Rotors>
[[nodiscard]] int allocation_rank(const Vehicle<Rotors>& vehicle) {
  const auto singular = AllocationMatrix<Rotors>::singular_values(vehicle);
  int rank = 0;
  for (int i = 0; i < 6; ++i) rank += singular(i) > 1e-6 * singular(0);
  return rank;
}

}  // namespace tilt_ropter
