// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>

#include <Eigen/Core>

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace tilt_ropter::optimal_control {

/// List of the finite bounds of a Subproblem: each entry is one side (upper or lower) of one
/// constraint. Also adds the weights of the constraints to the Hessians. This takes little time for
/// constraints whose gradient has a single entry.
template <int States, int Inputs, int Constraints, typename Pattern>
class BoundedSides {
 public:
  using Program = Subproblem<States, Inputs, Constraints, Pattern>;
  using Vector = typename Program::Vector;

  /// One finite bound of one constraint.
  struct Side {
    int k, row;   ///< node, and constraint of this node
    int at;       ///< index of the constraint among all nodes: Constraints * k + row
    double sign;  ///< 1: upper bound, -1: lower bound
  };

  /// Allocates everything for `horizon` intervals.
  explicit BoundedSides(int horizon) : nodes_(static_cast<std::size_t>(horizon) + 1) {
    sides_.reserve(2 * static_cast<std::size_t>(Constraints) * nodes_.size());
    immovable_.reserve(static_cast<std::size_t>(Constraints) * nodes_.size());
  }

  /// Reads the finite bounds of `program` at its current linearisation. Does not allocate.
  void read(const Program& program) {
    sides_.clear();
    immovable_.clear();
    for (int k = 0; k <= program.horizon(); ++k) {
      const auto& n = program.node(k);
      Node& node = nodes_[static_cast<std::size_t>(k)];
      node.single = node.dense = node.columns = 0;
      std::array<bool, static_cast<std::size_t>(width)> reached{};
      for (int i = 0; i < Constraints; ++i) {
        const bool above = std::isfinite(n.upper(i)), below = std::isfinite(n.lower(i));
        if (!above && !below) continue;
        Vector& gradient = node.gradient[static_cast<std::size_t>(node.dense)];
        gradient = program.constraint_gradient(k, i);
        int entries = 0, last = 0;
        for (int j = 0; j < width; ++j)
          if (gradient(j) != 0.0) {
            ++entries;
            last = j;
          }
        if (entries == 0) {
          immovable_.push_back({k, i});
          continue;
        }
        if (entries == 1) {
          const auto b = static_cast<std::size_t>(node.single++);
          node.single_constraint[b] = i;
          node.entry[b] = last;
          node.square[b] = gradient(last) * gradient(last);
        } else {
          node.row[static_cast<std::size_t>(node.dense++)] = i;
          for (int j = 0; j < width; ++j)
            if (gradient(j) != 0.0) reached[static_cast<std::size_t>(j)] = true;
        }
        for (const double sign : {1.0, -1.0})
          if (sign > 0.0 ? above : below) sides_.push_back({k, i, Constraints * k + i, sign});
      }
      for (int j = 0; j < width; ++j)
        if (reached[static_cast<std::size_t>(j)])
          node.column[static_cast<std::size_t>(node.columns++)] = j;
    }
  }

  [[nodiscard]] Eigen::Index count() const { return static_cast<Eigen::Index>(sides_.size()); }
  [[nodiscard]] const Side& operator[](Eigen::Index i) const {
    return sides_[static_cast<std::size_t>(i)];
  }
  /// Bounded constraints that no step changes. They have no entry in the list of sides.
  [[nodiscard]] const std::vector<typename Program::ActiveConstraint>& immovable() const {
    return immovable_;
  }

  /// Adds weight gradient gradient' of each constraint of node k to the Hessian of this node. The
  /// Hessian has Program::rows x Program::width numbers, `weights` has one number per constraint.
  template <int W>
  [[gnu::always_inline]] inline void add_weights(int k, const double* weights,
                                                 double* hessian) const {
    constexpr int rows = Program::rows, packets = rows / W;
    const Node& node = nodes_[static_cast<std::size_t>(k)];
    for (int b = 0; b < node.single; ++b) {
      const auto i = static_cast<std::size_t>(b);
      hessian[(rows + 1) * node.entry[i]] += weights[node.single_constraint[i]] * node.square[i];
    }
    if (node.dense == 0) return;
    for (int c = 0; c < node.columns; ++c) {
      const int j = node.column[static_cast<std::size_t>(c)];
      double* column = hessian + rows * j;
      detail::Packet<W> sum[detail::size(packets)];
#pragma GCC unroll 16
      for (int t = 0; t < packets; ++t) detail::load<W>(column + W * t, sum[t]);
      for (int d = 0; d < node.dense; ++d) {
        const auto i = static_cast<std::size_t>(d);
        const double factor = weights[node.row[i]] * node.gradient[i](j);
#pragma GCC unroll 16
        for (int t = 0; t < packets; ++t)
          detail::add_product<W>(sum[t], node.gradient[i].data() + W * t, factor);
      }
#pragma GCC unroll 16
      for (int t = 0; t < packets; ++t) detail::store<W>(column + W * t, sum[t]);
    }
  }

 private:
  static constexpr int width = Program::width;

  // The bounded constraints of a node, grouped by the number of entries of their gradients.
  struct Node {
    int single = 0;  // constraints with one non-zero entry
    std::array<int, static_cast<std::size_t>(Constraints)> single_constraint{}, entry{};
    std::array<double, static_cast<std::size_t>(Constraints)> square{};
    int dense = 0;  // constraints with several non-zero entries
    std::array<int, static_cast<std::size_t>(Constraints)> row{};
    std::array<Vector, static_cast<std::size_t>(Constraints)> gradient;
    int columns = 0;  // columns with a non-zero entry in a gradient of this group
    std::array<int, static_cast<std::size_t>(width)> column{};
  };

  std::vector<Node> nodes_;
  std::vector<Side> sides_;
  std::vector<typename Program::ActiveConstraint> immovable_;
};

}  // namespace tilt_ropter::optimal_control
