// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
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
/// At full rank it differs from the pseudo-inverse by about 1e-8 of its size. It ignores that a
/// thrust cannot be negative.
template <int Rotors>
class ThrustInverse {
 public:
  static constexpr int components = 2 * Rotors;
  using Thrusts = Eigen::Matrix<double, components, 1>;
  using Inverse = Eigen::Matrix<double, components, 6>;

  /// The vehicle must be valid. Does not allocate or throw.
  explicit ThrustInverse(const Vehicle<Rotors>& vehicle) noexcept {
    Columns matrix{};
    double size = 1e-9;
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorGeometry& rotor = vehicle.rotors[i];
      const double ratio = rotor_parameters(vehicle, i).torque_ratio;
      size = std::max(size, rotor.position.norm() + ratio);
      tilts_[i] = rotor.tilts;
      if (!(rotor.effectiveness > 0.0)) continue;
      const double drag = static_cast<int>(rotor.spin) * ratio;
      for (const bool vertical : {false, true}) {
        if (!vertical && !rotor.tilts) continue;
        const detail::Triple<double> force =
            (vertical ? 1.0 : -1.0) * detail::triple(rotor.orientation, 0, vertical ? 2 : 1);
        const detail::Triple<double> torque =
            cross(detail::triple(rotor.position), force) - drag * force;
        matrix[2 * i + vertical] = {force.x, force.y, force.z, torque.x, torque.y, torque.z};
      }
    }
    matrix_ = matrix;
    for (auto& column : matrix)
      for (std::size_t r = 3; r < 6; ++r) column[r] /= size;
    const Columns inverse = damped(matrix, 0, 6);
    for (int j = 0; j < components; ++j)
      for (int r = 0; r < 6; ++r)
        inverse_(j, r) = inverse[static_cast<std::size_t>(j)][static_cast<std::size_t>(r)] /
                         (r < 3 ? 1.0 : size);
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
        if (tilts_[static_cast<std::size_t>(i)]) continue;
        double& thrust = thrusts(2 * i + 1);
        const double inside = std::max(least(i), std::min(thrust, most(i)));
        clamped = clamped || std::abs(inside - thrust) > 1e-3 * most(i);
        thrust = inside;
      }
      if (!clamped) break;
      Wrenchd missing = wrench;
      for (int j = 0; j < components; ++j) {
        const auto& column = matrix_[static_cast<std::size_t>(j)];
        for (int r = 0; r < 3; ++r) {
          missing.force(r) -= column[static_cast<std::size_t>(r)] * thrusts(j);
          missing.torque(r) -= column[static_cast<std::size_t>(3 + r)] * thrusts(j);
        }
      }
      const Thrusts more = (*this)(missing);
      // A longer step than to the nearest point needs fewer iterations.
      for (int j = 0; j < components; ++j) thrusts(j) += 1.7 * more(j);
    }
    for (int i = 0; i < Rotors; ++i)
      if (!tilts_[static_cast<std::size_t>(i)])
        thrusts(2 * i + 1) = std::max(least(i), std::min(thrusts(2 * i + 1), most(i)));
    return thrusts;
  }

  /// Projection onto the forces (body frame) that the rotors can give without a torque: the
  /// identity for a fully actuated vehicle, the z axis for a flat multirotor with fixed rotors.
  [[nodiscard]] const Eigen::Matrix3d& steady_forces() const noexcept { return steady_forces_; }
  /// True if the vehicle must lean for a force that is not vertical in the body frame.
  [[nodiscard]] bool leans() const noexcept {
    double off = 0.0;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        off = std::max(off, std::abs(steady_forces_(i, j) - (i == j ? 1.0 : 0.0)));
    return off > 1e-3;
  }

 private:
  using Columns = std::array<std::array<double, 6>, static_cast<std::size_t>(components)>;

  // Columns of (M' (M M' + e I)^-1)', where M has the rows first to last - 1 of `matrix`. Other
  // rows of the result are zero.
  static Columns damped(const Columns& matrix, std::size_t first, std::size_t last) noexcept {
    double gram[6][6] = {};
    double trace = 0.0;
    for (std::size_t r = first; r < last; ++r) {
      for (std::size_t c = first; c < last; ++c)
        for (const auto& column : matrix) gram[r][c] += column[r] * column[c];
      trace += gram[r][r];
    }
    for (std::size_t r = first; r < last; ++r) gram[r][r] += std::max(1e-9 * trace, 1e-100);
    // L L' = gram, in place.
    for (std::size_t c = first; c < last; ++c) {
      for (std::size_t r = c; r < last; ++r)
        for (std::size_t k = first; k < c; ++k) gram[r][c] -= gram[r][k] * gram[c][k];
      gram[c][c] = std::sqrt(std::max(gram[c][c], 1e-100));
      for (std::size_t r = c + 1; r < last; ++r) gram[r][c] /= gram[c][c];
    }
    Columns solved{};
    for (std::size_t j = 0; j < matrix.size(); ++j) {
      auto& x = solved[j];
      for (std::size_t r = first; r < last; ++r) {
        x[r] = matrix[j][r];
        for (std::size_t k = first; k < r; ++k) x[r] -= gram[r][k] * x[k];
        x[r] /= gram[r][r];
      }
      for (std::size_t r = last; r-- > first;) {
        for (std::size_t k = r + 1; k < last; ++k) x[r] -= gram[k][r] * x[k];
        x[r] /= gram[r][r];
      }
    }
    return solved;
  }

  // With the forces G = A_F (I - A_M^+ A_M) of thrusts without torque, the projection G G^+.
  void set_steady_forces(const Columns& matrix) noexcept {
    const Columns by_torque = damped(matrix, 3, 6);
    Columns free = matrix;  // rows 0 to 2: G
    for (std::size_t j = 0; j < matrix.size(); ++j)
      for (std::size_t i = 0; i < matrix.size(); ++i) {
        double along = 0.0;
        for (std::size_t r = 3; r < 6; ++r) along += by_torque[i][r] * matrix[j][r];
        for (std::size_t r = 0; r < 3; ++r) free[j][r] -= matrix[i][r] * along;
      }
    // Directions of force below a thousandth of the thrusts do not count.
    for (auto& column : free)
      for (std::size_t r = 0; r < 3; ++r)
        if (std::abs(column[r]) < 1e-3) column[r] = 0.0;
    const Columns inverse = damped(free, 0, 3);
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) {
        double sum = 0.0;
        for (std::size_t j = 0; j < matrix.size(); ++j)
          sum += free[j][static_cast<std::size_t>(r)] * inverse[j][static_cast<std::size_t>(c)];
        steady_forces_(r, c) = sum;
      }
  }

  Columns matrix_{};  // A
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};
  Inverse inverse_ = detail::Filled();
  Eigen::Matrix3d steady_forces_ = Eigen::Matrix3d::Zero();
};

}  // namespace tilt_ropter
