// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

/// Inverse of the allocation matrix for any number of rotors and any rank.
namespace tilt_ropter {

/// Smallest lateral and vertical thrusts T = (T_1l, T_1v, ..., T_nl, T_nv) for a wrench W = A T, in
/// the sense of least squares where the rotors cannot give the whole wrench. See AllocationMatrix
/// for A. The inverse is damped, A' (A A' + e I)^-1, with torques in units of the vehicle's size.
/// At full rank it differs from the pseudo-inverse by about 1e-8. Its thrusts may be negative.
template <int Rotors>
class ThrustInverse {
 public:
  static constexpr int components = 2 * Rotors;
  using Thrusts = Eigen::Matrix<double, components, 1>;
  using Inverse = Eigen::Matrix<double, components, 6>;

  /// The vehicle must be valid. Does not allocate or throw.
  explicit ThrustInverse(const Vehicle<Rotors>& vehicle) noexcept {
    const double size = detail::put_allocation(vehicle, matrix_);
    for (std::size_t i = 0; i < Rotors; ++i) tilts_[i] = vehicle.rotors[i].tilts;
    Matrix matrix = matrix_;
    for (int j = 0; j < components; ++j)
      for (int r = 3; r < 6; ++r) matrix(r, j) /= size;
    const Matrix inverse = damped(matrix, 0, 6);
    for (int j = 0; j < components; ++j)
      for (int r = 0; r < 6; ++r) inverse_(j, r) = inverse(r, j) / (r < 3 ? 1.0 : size);
    set_steady_forces(matrix);
  }

  /// A' (A A' + e I)^-1.
  [[nodiscard]] const Inverse& matrix() const noexcept { return inverse_; }

  /// Smallest thrusts [N] for `wrench` (body frame).
  [[nodiscard]] Thrusts operator()(const Wrenchd& wrench) const noexcept {
    Thrusts thrusts;
    for (int j = 0; j < components; ++j) {
      double sum = 0.0;
      for (int r = 0; r < 3; ++r)
        sum += inverse_(j, r) * wrench.force(r) + inverse_(j, 3 + r) * wrench.torque(r);
      thrusts(j) = sum;
    }
    return thrusts;
  }

  /// The same for rotors that cannot pull: the vertical thrusts of rotors that do not tilt are
  /// within
  /// [`least`, `most`] [N]. Alternates between the wrench and these limits at most 30 times, which
  /// is exact to a thousandth of the weight for the vehicles that need it.
  [[nodiscard]] Thrusts within(const Wrenchd& wrench, const Eigen::Matrix<double, Rotors, 1>& least,
                               const Eigen::Matrix<double, Rotors, 1>& most) const noexcept {
    Thrusts thrusts = (*this)(wrench);
    for (int n = 0; n < 30; ++n) {
      bool clamped = false;
      for (int i = 0; i < Rotors; ++i) {
        if (tilts_[detail::size(i)]) continue;
        double& thrust = thrusts(2 * i + 1);
        const double inside = std::max(least(i), std::min(thrust, most(i)));
        clamped = clamped || std::abs(inside - thrust) > 1e-3 * most(i);
        thrust = inside;
      }
      if (!clamped) break;
      Wrenchd missing = wrench;
      for (int j = 0; j < components; ++j)
        for (int r = 0; r < 3; ++r) {
          missing.force(r) -= matrix_(r, j) * thrusts(j);
          missing.torque(r) -= matrix_(3 + r, j) * thrusts(j);
        }
      const Thrusts more = (*this)(missing);
      // A longer step than to the nearest point needs fewer iterations.
      for (int j = 0; j < components; ++j) thrusts(j) += 1.7 * more(j);
    }
    for (int i = 0; i < Rotors; ++i)
      if (!tilts_[detail::size(i)])
        thrusts(2 * i + 1) = std::max(least(i), std::min(thrusts(2 * i + 1), most(i)));
    return thrusts;
  }

  /// Projection onto the forces (body frame) that the rotors can give without a torque: the
  /// identity for a fully actuated vehicle, the z axis for a flat multirotor with fixed rotors.
  [[nodiscard]] const Eigen::Matrix3d& steady_forces() const noexcept { return steady_forces_; }
  /// True if the vehicle must lean for a force that is not vertical in the body frame.
  [[nodiscard]] bool leans() const noexcept {
    Eigen::Matrix3d off = steady_forces_;
    for (int i = 0; i < 3; ++i) off(i, i) -= 1.0;
    return detail::largest(off) > 1e-3;
  }

 private:
  using Matrix = Eigen::Matrix<double, 6, components>;

  // Transpose of M' (M M' + e I)^-1, where M has the rows first to last - 1 of `matrix`. Other rows
  // of the result are zero.
  static Matrix damped(const Matrix& matrix, int first, int last) noexcept {
    Eigen::Matrix<double, 6, 6> gram = detail::Filled();
    double trace = 0.0;
    for (int r = first; r < last; ++r) {
      for (int c = first; c < last; ++c)
        for (int j = 0; j < components; ++j) gram(r, c) += matrix(r, j) * matrix(c, j);
      trace += gram(r, r);
    }
    for (int r = first; r < last; ++r) gram(r, r) += std::max(1e-9 * trace, 1e-100);
    detail::factorise(gram);  // leaves out the other rows: they are zero
    Matrix solved = detail::Filled();
    for (int j = 0; j < components; ++j) {
      for (int r = first; r < last; ++r) solved(r, j) = matrix(r, j);
      detail::solve_factorised(gram, &solved(0, j));
    }
    return solved;
  }

  // With the forces G = A_F (I - A_M^+ A_M) of thrusts without torque, the projection G G^+.
  void set_steady_forces(const Matrix& matrix) noexcept {
    const Matrix by_torque = damped(matrix, 3, 6);
    Matrix free = matrix;  // rows 0 to 2: G
    for (int j = 0; j < components; ++j)
      for (int i = 0; i < components; ++i) {
        double along = 0.0;
        for (int r = 3; r < 6; ++r) along += by_torque(r, i) * matrix(r, j);
        for (int r = 0; r < 3; ++r) free(r, j) -= matrix(r, i) * along;
      }
    // Directions of force below a thousandth of the thrusts do not count.
    for (int j = 0; j < components; ++j)
      for (int r = 0; r < 3; ++r)
        if (std::abs(free(r, j)) < 1e-3) free(r, j) = 0.0;
    const Matrix inverse = damped(free, 0, 3);
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) {
        double sum = 0.0;
        for (int j = 0; j < components; ++j) sum += free(r, j) * inverse(c, j);
        steady_forces_(r, c) = sum;
      }
  }

  Matrix matrix_ = detail::Filled();  // A
  std::array<bool, detail::size(Rotors)> tilts_{};
  Inverse inverse_ = detail::Filled();
  Eigen::Matrix3d steady_forces_ = Eigen::Matrix3d::Zero();
};

}  // namespace tilt_ropter
