// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/riccati_stage.hpp>

#include <Eigen/Core>

#include <cmath>
#include <cstddef>

namespace tilt_ropter::optimal_control {

/// Adjoint propagation of the derivatives of many linear functions of the trajectory at once, from
/// node to node. It uses the factorisation of Riccati, and its results are derivatives by Riccati's
/// coordinates z. DualMethod uses it for the gradients of its constraints.
template <int States, int Inputs, typename Pattern = FullTransition>
class AdjointBatch {
 public:
  using Stage = RiccatiStage<States, Inputs>;
  /// One function per row: its derivative by dx_k, then by du_k. The number of rows must be a
  /// multiple of detail::packet_width.
  using Gradients = Eigen::Matrix<double, Eigen::Dynamic, States + Inputs>;

  /// Adjoint step through the interval of node k, whose stage is `s`. Computes the derivatives by
  /// (dx_k, du_k) from the derivatives by dx_{k+1}, for the first `count` rows. Does not allocate.
  static void step_back(const Stage& s, const Gradients& after, Gradients& before,
                        Eigen::Index count) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      constexpr int Width = packet();
      static constexpr auto lists = detail::reached_by<States, Inputs, Pattern, 1>();
      for (int j = 0; j < width; ++j) {
        const auto& list = lists[static_cast<std::size_t>(j)];
        Eigen::Index i = 0;
        for (; i + 4 * Width <= count + Width - 1; i += 4 * Width)
          step_back_column<Width, 4>(s, list, after, i, before, j);
        for (; i < count; i += Width) step_back_column<Width, 1>(s, list, after, i, before, j);
      }
      return true;
    });
  }

  /// Transforms derivatives by (dx_k, du_k) into derivatives by (dx_k, z_k), for the first `count`
  /// rows. factorise() must have eliminated the inputs of this node. Does not allocate.
  static void to_coordinates(const Stage& s, Gradients& batch, Eigen::Index count) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      constexpr int Width = packet();
      const Eigen::Index stride = batch.rows();
      for (Eigen::Index first = 0; first < count; first += Width) {
        double* row = batch.data() + first;
        for (int j = 0; j < Inputs; ++j) {
          Packet<Width> by_input;
          detail::load<Width>(row + stride * (States + j), by_input);
          for (int i = 0; i < j; ++i)
            detail::add_product<Width>(by_input, row + stride * (States + i),
                                       -s.factor(States + j, i));
          detail::store<Width>(row + stride * (States + j), by_input);
          for (int i = 0; i < States; ++i) {
            Packet<Width> by_state;
            detail::load<Width>(row + stride * i, by_state);
            by_state -= by_input * s.factor(i, j);
            detail::store<Width>(row + stride * i, by_state);
          }
        }
        for (int j = 0; j < Inputs; ++j) {
          Packet<Width> by_input;
          detail::load<Width>(row + stride * (States + j), by_input);
          by_input *= std::sqrt(s.inverse_pivot(j));
          detail::store<Width>(row + stride * (States + j), by_input);
        }
      }
      return true;
    });
  }

 private:
  template <int Width>
  using Packet = detail::Packet<Width>;
  using List = detail::Reached<States>;
  static constexpr int width = States + Inputs;

  template <int Width, int Packets>
  [[gnu::always_inline]] static inline void step_back_column(const Stage& s, const List& list,
                                                             const Gradients& after,
                                                             Eigen::Index row, Gradients& before,
                                                             int column) {
    Packet<Width> sum[detail::size(Packets)] = {};
    for (int n = 0; n < list.count; ++n) {
      const int k = list.at[static_cast<std::size_t>(n)];
      const double factor = s.transition(column, k);
      const double* from = after.data() + after.rows() * k + row;
#pragma GCC unroll 4
      for (int t = 0; t < Packets; ++t)
        detail::add_product<Width>(sum[t], from + Width * t, factor);
    }
#pragma GCC unroll 4
    for (int t = 0; t < Packets; ++t)
      detail::store<Width>(before.data() + before.rows() * column + row + Width * t, sum[t]);
  }
};

}  // namespace tilt_ropter::optimal_control
