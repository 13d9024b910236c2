#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/SVD>

#include <algorithm>
#include <cstddef>
#include <string>
#include <vector>

/// The allocation matrix of a vehicle's geometry (paper, Sec. Control Allocation).
namespace tilt_ropter {

/// W = A T with W = (F, M) at the CoM in the body frame and T = (T_1l, T_1v, ..., T_nl, T_nv), the
/// lateral and vertical thrusts T_il = T_i sin(alpha_i), T_iv = T_i cos(alpha_i) (paper, Eq.
/// allocation). Rotor i pushes along (0, -T_il, T_iv) in its rotor frame; that force f, turned to
/// the body frame, has the torque r_i x f - spin_i torque_ratio f. Column T_il of a rotor that does
/// not tilt is zero, so are both columns of a lost one. Of a rotor's effectiveness between 0 and 1
/// the thrusts T_i know nothing; it counts where they become speeds.
template <int Rotors>
struct AllocationMatrix {
  static_assert(Rotors >= 3, "six components of a wrench need at least three tilting rotors");
  static constexpr int components = 2 * Rotors;

  Eigen::Matrix<double, 6, components> matrix =
      Eigen::Matrix<double, 6, components>::Zero();  ///< A; rows F [1] and M [m]
  Eigen::Matrix<double, components, 6> pseudoinverse =
      Eigen::Matrix<double, components, 6>::Zero();  ///< Moore-Penrose
  Eigen::MatrixXd null_space;                        ///< orthonormal columns, zero where A's are

  /// Allocates. Throws std::invalid_argument on a geometry that cannot give every wrench, naming
  /// the rank of A and what is out of reach.
  explicit AllocationMatrix(const Vehicle<Rotors>& vehicle) { invert(fill(vehicle)); }

  /// Singular values of A, the largest first, torques in units of the vehicle's size: its longest
  /// arm plus torque_ratio. A's rank is the number of those above 1e-6 times the largest. Of any
  /// geometry whose products are finite, else throws std::invalid_argument; allocates.
  [[nodiscard]] static Eigen::Matrix<double, 6, 1> singular_values(const Vehicle<Rotors>& vehicle) {
    AllocationMatrix allocation;
    const Columns columns = allocation.fill(vehicle);
    return decompose(allocation.scaled(columns)).singularValues().template head<6>();
  }

 private:
  /// The columns of A that a rotor stands behind, and the vehicle's size [m].
  struct Columns {
    std::vector<int> of;
    double size = 1e-9;
  };

  AllocationMatrix() = default;

  /// Writes A.
  Columns fill(const Vehicle<Rotors>& vehicle) {
    Columns columns;
    for (int i = 0; i < Rotors; ++i) {
      const RotorGeometry& rotor = vehicle.rotors[static_cast<std::size_t>(i)];
      columns.size = std::max(columns.size, rotor.position.norm() + vehicle.rotor.torque_ratio);
      if (!(rotor.effectiveness > 0.0)) continue;
      if (rotor.tilts) {
        matrix.col(2 * i) = wrench_of(rotor, -rotor.orientation.col(1), vehicle.rotor);
        columns.of.push_back(2 * i);
      }
      matrix.col(2 * i + 1) = wrench_of(rotor, rotor.orientation.col(2), vehicle.rotor);
      columns.of.push_back(2 * i + 1);
    }
    return columns;
  }

  static Eigen::Matrix<double, 6, 1> wrench_of(const RotorGeometry& rotor,
                                               const Eigen::Vector3d& force,
                                               const RotorParameters& parameters) {
    Eigen::Matrix<double, 6, 1> wrench;
    wrench << force, rotor.position.cross(force) -
                         static_cast<int>(rotor.spin) * parameters.torque_ratio * force;
    return wrench;
  }

  /// Diagonal that measures torques in units of the vehicle's size, so that the rank is that of its
  /// shape; with full rank the pseudo-inverse does not depend on it.
  static Eigen::Matrix<double, 6, 1> scale(const Columns& columns) {
    Eigen::Matrix<double, 6, 1> diagonal;
    diagonal << 1.0, 1.0, 1.0, Eigen::Vector3d::Constant(1.0 / columns.size);
    return diagonal;
  }

  [[nodiscard]] Eigen::MatrixXd scaled(const Columns& columns) const {
    const auto count = static_cast<Eigen::Index>(columns.of.size());
    // Made square by zeros, which needs no QR decomposition and spares the compiler two of them.
    const Eigen::Index side = std::max<Eigen::Index>(count, 6);
    Eigen::MatrixXd square = Eigen::MatrixXd::Zero(side, side);
    for (Eigen::Index j = 0; j < count; ++j)
      square.col(j).head<6>() =
          scale(columns).asDiagonal() * matrix.col(columns.of[static_cast<std::size_t>(j)]);
    // Products of finite numbers may overflow, and the decomposition's rank is nonsense then.
    require(all_finite(square), "size of the vehicle [m]", columns.size,
            "one whose products are finite");
    return square;
  }

  void invert(const Columns& columns) {
    const auto count = static_cast<Eigen::Index>(columns.of.size());
    const auto svd = decompose(scaled(columns));
    require_rank(svd.matrixU(), svd.rank());

    const Eigen::MatrixXd inverse =
        svd.matrixV().leftCols(6) *
        svd.singularValues().template head<6>().cwiseInverse().asDiagonal() *
        svd.matrixU().template topLeftCorner<6, 6>().transpose() * scale(columns).asDiagonal();
    null_space.setZero(components, count - 6);
    for (Eigen::Index j = 0; j < count; ++j) {
      const int row = columns.of[static_cast<std::size_t>(j)];
      pseudoinverse.row(row) = inverse.row(j);
      if (count > 6) null_space.row(row) = svd.matrixV().row(j).tail(count - 6);
    }
  }

  /// A template, so that the compiler looks at it only where a matrix is made.
  template <typename Matrix>
  static auto decompose(const Matrix& square) {
    Eigen::JacobiSVD<Matrix, Eigen::NoQRPreconditioner> svd(
        square, Eigen::ComputeFullU | Eigen::ComputeFullV);
    svd.setThreshold(1e-6);
    return svd;
  }

  static void require_rank(const Eigen::MatrixXd& left_vectors, Eigen::Index rank) {
    if (rank == 6) return;
    static constexpr const char* names[] = {"force x",  "force y",  "force z",
                                            "torque x", "torque y", "torque z"};
    std::string missing;
    for (int axis = 0; axis < 6; ++axis)
      if (left_vectors.row(axis).tail(left_vectors.cols() - rank).norm() > 1e-6)
        missing += (missing.empty() ? "" : ", ") + std::string(names[axis]);
    require(false, "rank of the allocation matrix", rank,
            "6, but " + std::to_string(6 - rank) +
                " direction(s) of the wrench cannot be produced; out of reach by themselves are " +
                missing);
  }
};

}  // namespace tilt_ropter
