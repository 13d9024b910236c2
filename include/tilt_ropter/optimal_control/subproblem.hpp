// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/packet.hpp>
#include <tilt_ropter/optimal_control/node_rows.hpp>
#include <tilt_ropter/optimal_control/riccati.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

/// The quadratic program of one SQP step: the linear-quadratic problem of Riccati with two-sided
/// constraints lower <= value + C dx + E du <= upper at every node, see NodeRows.
///
/// A long header, because all methods that solve the program share its data and these sweeps over
/// the nodes; none of them belongs to one method.
namespace tilt_ropter {

/// The program's data, a step, and what every way to solve it needs. Allocates in its constructor
/// only.
template <int States, int Inputs, int Rows, typename Pattern = FullTransition>
class Subproblem {
 public:
  using Factorisation = Riccati<States, Inputs, Pattern>;
  using Node = NodeRows<States, Inputs, Rows>;
  using Values = typename Node::Values;
  using Vector = typename Factorisation::Vector;
  using Tangent = typename Factorisation::Tangent;
  static constexpr int width = Factorisation::width, rows = Factorisation::rows;

  explicit Subproblem(int horizon)
      : riccati(horizon),
        nodes_(static_cast<std::size_t>(horizon) + 1),
        steps_(nodes_.size(), detail::Filled()) {
    active_.reserve(static_cast<std::size_t>(Rows) * nodes_.size());
  }

  [[nodiscard]] int horizon() const { return riccati.horizon(); }
  [[nodiscard]] Node& node(int k) { return nodes_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Node& node(int k) const { return nodes_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] auto dx(int k) const { return step(k).template head<States>(); }
  [[nodiscard]] auto du(int k) const { return step(k).template segment<Inputs>(States); }
  [[nodiscard]] Vector& step(int k) { return steps_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Vector& step(int k) const { return steps_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] std::vector<Vector>& steps() { return steps_; }
  /// dx of node 0.
  void set_first(const Tangent& dx0) { detail::copy_first(States, dx0, steps_[0]); }

  /// Makes of what was written into the cost and the constraints of node k what can be solved:
  /// those of infinite price are hard, and get a price so large that only those give up who must;
  /// constraints without a price go; and where the lower bound is above the upper one they change
  /// places, which has the same solutions: the price is paid for the gap in any case. False if a
  /// number is not one or a price is negative.
  [[nodiscard]] bool check_node(int k) {
    Node& n = node(k);
    n.crossed = false;
    for (int i = 0; i < Rows; ++i) n.hard[static_cast<std::size_t>(i)] = n.price(i) == infinity;
    for (int i = 0; i < Rows; ++i) {
      if (!n.hard[static_cast<std::size_t>(i)]) continue;
      // One that was given up goes on with the price at which it was.
      const bool gave_up = std::abs(n.multiplier(i)) >= n.stand_in(i);
      n.price(i) = n.stand_in(i) = gave_up ? n.stand_in(i) : hard_price;
    }
    bool regular = true;
    for (int i = 0; i < Rows; ++i)
      regular &= n.lower(i) <= n.upper(i) && n.price(i) > 0.0 && n.stiffness(i) > 0.0;
    if (!regular && !repair(n)) return false;
    return detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      const auto& cost = riccati.stage(k).cost;
      detail::FiniteCheck<packet()> check;
      check.add(cost.hessian.data(), cost.hessian.size());
      check.add(cost.gradient.data(), cost.gradient.size());
      check.add(n.value.data(), n.value.size());
      check.add(n.C.data(), n.C.size());
      if (k < horizon()) check.add(n.E.data(), n.E.size());
      return check.passed();
    });
  }

  /// How far the worst of the values at which the constraints of node k were linearised is outside
  /// its bounds, at least zero.
  [[nodiscard]] double violation_here(int k) const {
    const Node& n = node(k);
    const double excess = detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      return excess_of<packet()>(n.value, n);
    });
    if (!n.crossed) return excess;
    double most = excess;
    for (int i = 0; i < Rows; ++i) most = std::max(most, n.violation(i, n.value(i)));
    return most;
  }

  /// The largest violation, of the values at which the constraints were linearised, that no
  /// multiplier accounts for.
  [[nodiscard]] double unpaid_here() const {
    double largest = 0.0;
    for (const Node& n : nodes_)
      for (int i = 0; i < Rows; ++i) {
        const double size = std::abs(n.multiplier(i));
        if (size >= n.price(i)) continue;
        largest = std::max(largest, std::max(n.value(i) - n.upper(i), n.lower(i) - n.value(i)) -
                                        size / n.stiffness(i));
      }
    return largest;
  }

  /// The gradient of row i of node k by (dx, du).
  [[nodiscard]] Vector row_gradient(int k, int i) const {
    Vector gradient = detail::Filled();
    if constexpr (Rows > 0) {
      for (int j = 0; j < States; ++j) gradient(j) = node(k).C(i, j);
      for (int j = 0; k < horizon() && j < Inputs; ++j) gradient(States + j) = node(k).E(i, j);
    }
    return gradient;
  }

  /// Fills in what the constraints of all nodes are predicted to be after the step, and how far
  /// the worst of them is outside its bounds.
  void predict() {
    excess_ = detail::vectorised([this](auto packet) __attribute__((always_inline)) {
      double excess = 0.0;
      for (int k = 0; k <= horizon(); ++k) {
        Node& n = node(k);
        n.predicted = n.value;
        add_row_values<packet()>(k, step(k), n.predicted.data());
        excess = larger(excess, excess_of<packet()>(n.predicted, n));
      }
      return excess;
    });
  }
  /// How far the worst constraint was outside its bounds in the last prediction, at least zero;
  /// infinite if a number was not finite.
  [[nodiscard]] double excess() const { return excess_; }
  /// The same for the values of a node.
  template <int Width>
  [[gnu::always_inline]] static inline double excess_of(const Values& values, const Node& n) {
    detail::FiniteCheck<Width> check;
    detail::Packet<Width> most{};
    double rest = 0.0;
    int i = 0;
    for (; i + Width <= Rows; i += Width) {
      detail::Packet<Width> value, lower, upper;
      detail::load<Width>(values.data() + i, value);
      detail::load<Width>(n.lower.data() + i, lower);
      detail::load<Width>(n.upper.data() + i, upper);
      check.add(value);
      const detail::Packet<Width> over = value - upper, under = lower - value;
      most = over > most ? over : most;
      most = under > most ? under : most;
    }
    for (; i < Rows; ++i) {
      check.add(values(i));
      rest = std::max({rest, values(i) - n.upper(i), n.lower(i) - values(i)});
    }
#pragma GCC unroll 4
    for (int j = 0; j < Width; ++j) rest = std::max(rest, most[j]);
    return check.passed() ? rest : infinity;
  }

  /// Constraints with a multiplier, after collect_active().
  struct ActiveRow {
    int k, i;
  };
  [[nodiscard]] const std::vector<ActiveRow>& active() const {
    return active_;
  }
  /// Looks for the constraints that have a multiplier, from the last node to the first.
  void collect_active() {
    active_.clear();
    for (int k = horizon(); k >= 0; --k) {
      const Values& m = node(k).multiplier;
      for (int i = 0; i < Rows; ++i)
        if (m(i) != 0.0) active_.push_back({k, i});
    }
  }

  /// Derivatives by (dx, du) of each node with all that follows from them, from the last node to
  /// the first: of gradients that set(width, k, g) writes and, on request, of the multipliers.
  /// Calls see(k, derivative, the node's own part of it). False if a number is not finite.
  template <typename Set, typename See>
  [[nodiscard]] bool sweep_back(bool with_multipliers, const Set& set, const See& see) const {
    return detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      constexpr int Width = packet(), packets = rows / Width;
      detail::FiniteCheck<Width> check;
      Vector g, adjoint = detail::Filled();
      std::size_t next = with_multipliers ? 0 : active_.size();
      for (int k = horizon(); k >= 0; --k) {
        set(packet, k, g);
        for (; next < active_.size() && active_[next].k == k; ++next) {
          const int i = active_[next].i;
          const double m = node(k).multiplier(i);
          for (int j = 0; j < States; ++j) g(j) += m * node(k).C(i, j);
          for (int j = 0; k < horizon() && j < Inputs; ++j) g(States + j) += m * node(k).E(i, j);
        }
        detail::Packet<Width> sum[detail::size(packets)];
#pragma GCC unroll 16
        for (int t = 0; t < packets; ++t) detail::load<Width>(g.data() + Width * t, sum[t]);
        for (int i = 0; k < horizon() && i < States; ++i) {
#pragma GCC unroll 16
          for (int t = 0; t < packets; ++t)
            detail::add_product<Width>(
                sum[t], riccati.stage(k).transition.data() + rows * i + Width * t, adjoint(i));
        }
#pragma GCC unroll 16
        for (int t = 0; t < packets; ++t) {
          check.add(sum[t]);
          detail::store<Width>(adjoint.data() + Width * t, sum[t]);
        }
        see(k, adjoint, g);
      }
      return check.passed();
    });
  }

  /// False if no step changes the value of row i of node k.
  [[nodiscard]] bool can_move(int k, int i) const {
    bool moves = false;
    for (int j = 0; j < States; ++j) moves |= node(k).C(i, j) != 0.0;
    for (int j = 0; k < horizon() && j < Inputs; ++j) moves |= node(k).E(i, j) != 0.0;
    return moves;
  }

  /// Adds C dx + E du of node k to `values`.
  template <int Width>
  [[gnu::always_inline]] inline void add_row_values(int k, const Vector& w, double* values) const {
    const Node& n = node(k);
    if constexpr (Rows >= Width) {
      detail::Packet<Width> sum[detail::size(row_packets<Width>)];
#pragma GCC unroll 16
      for (int t = 0; t < row_packets<Width>; ++t)
        detail::load<Width>(values + row_packet<Width>(t), sum[t]);
      for (int j = 0; j < States; ++j) {
#pragma GCC unroll 16
        for (int t = 0; t < row_packets<Width>; ++t)
          detail::add_product<Width>(sum[t], n.C.data() + Rows * j + row_packet<Width>(t), w(j));
      }
      for (int j = 0; k < horizon() && j < Inputs; ++j) {
#pragma GCC unroll 16
        for (int t = 0; t < row_packets<Width>; ++t)
          detail::add_product<Width>(sum[t], n.E.data() + Rows * j + row_packet<Width>(t),
                                     w(States + j));
      }
#pragma GCC unroll 16
      for (int t = 0; t < row_packets<Width>; ++t)
        detail::store<Width>(values + row_packet<Width>(t), sum[t]);
    } else {
      for (int i = 0; i < Rows; ++i) {
        for (int j = 0; j < States; ++j) values[i] += n.C(i, j) * w(j);
        for (int j = 0; k < horizon() && j < Inputs; ++j) values[i] += n.E(i, j) * w(States + j);
      }
    }
  }

  /// Adds C' m and E' m of node k to the gradient.
  template <int Width>
  [[gnu::always_inline]] inline void add_row_gradients(int k, const double* m, Vector& g) const {
    const Node& n = node(k);
    const int columns = k < horizon() ? width : States;
    if constexpr (Rows >= Width) {
      // Packets of rows overlap where they do not come out even: there the second one counts for
      // its last rows only.
      detail::Packet<Width> factor[detail::size(row_packets<Width>)];
#pragma GCC unroll 16
      for (int t = 0; t < row_packets<Width>; ++t) {
        detail::load<Width>(m + row_packet<Width>(t), factor[t]);
        for (int i = 0; i < Width * t - row_packet<Width>(t); ++i) factor[t][i] = 0.0;
      }
      for (int j = 0; j < columns; ++j) {
        const double* column =
            j < States ? n.C.data() + Rows * j : n.E.data() + Rows * (j - States);
        detail::Packet<Width> sum{};
#pragma GCC unroll 16
        for (int t = 0; t < row_packets<Width>; ++t) {
          detail::Packet<Width> numbers;
          detail::load<Width>(column + row_packet<Width>(t), numbers);
          sum += numbers * factor[t];
        }
#pragma GCC unroll 4
        for (int i = 0; i < Width; ++i) g(j) += sum[i];
      }
    } else {
      for (int i = 0; i < Rows; ++i) {
        for (int j = 0; j < States; ++j) g(j) += m[i] * n.C(i, j);
        for (int j = States; j < columns; ++j) g(j) += m[i] * n.E(i, j - States);
      }
    }
  }

  /// Largest violation that is predicted, relative to the bound. Infinite if a number is not
  /// finite.
  [[nodiscard]] double largest_violation() const {
    double largest = 0.0;
    bool finite = true;
    for (const Node& n : nodes_)
      for (int i = 0; i < Rows; ++i) {
        const double over = n.predicted(i) - n.upper(i), under = n.lower(i) - n.predicted(i);
        const double unit = 1.0 + std::abs(over > under ? n.upper(i) : n.lower(i));
        finite = finite && (over < infinity || under < infinity);
        largest = std::max(largest, std::max(over, under) / unit);
      }
    return finite ? largest : infinity;
  }

  /// The gradient of the cost of node k at w = (dx, du), without continuity and constraints;
  /// `damping` is on the Hessian's diagonal.
  template <int Width>
  [[gnu::always_inline]] inline void cost_gradient(int k, const Vector& at, double damping,
                                                   Vector& g) const {
    using Stage = typename Factorisation::Stage;
    constexpr int packets = rows / Width;
    const Stage& s = riccati.stage(k);
    const double* w = at.data();
    detail::Packet<Width> sum[detail::size(packets)];
#pragma GCC unroll 16
    for (int t = 0; t < packets; ++t) {
      detail::load<Width>(s.cost.gradient.data() + Width * t, sum[t]);
      detail::add_product<Width>(sum[t], w + Width * t, damping);
    }
    for (int j = 0; j < (k < horizon() ? width : States); ++j) {
#pragma GCC unroll 16
      for (int t = 0; t < packets; ++t)
        detail::add_product<Width>(sum[t], s.cost.hessian.data() + rows * j + Width * t, w[j]);
    }
#pragma GCC unroll 16
    for (int t = 0; t < packets; ++t) detail::store<Width>(g.data() + Width * t, sum[t]);
    if (k == horizon()) return;
    for (int j = 0; j < Inputs; ++j)
      for (int i = 0; i < States; ++i) g(States + j) += s.cost.hessian(i, States + j) * w[i];
  }

  /// What the step changes the cost by, with the price of every violation, after predict().
  [[nodiscard]] double price_of_step(double damping) const {
    double sum = 0.0;
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      Vector g;
      for (int k = 0; k <= horizon(); ++k) {
        cost_gradient<packet()>(k, step(k), damping, g);
        const auto& cost = riccati.stage(k).cost.gradient;
        const int columns = k < horizon() ? width : States;
        for (int j = 0; j < columns; ++j) sum += 0.5 * (g(j) + cost(j)) * step(k)(j);
      }
      return true;
    });
    for (const Node& n : nodes_)
      for (int i = 0; i < Rows; ++i) {
        if (n.predicted(i) > n.upper(i) || n.predicted(i) < n.lower(i))
          sum += violation_cost(n.price(i), n.stiffness(i), n.violation(i, n.predicted(i)));
      }
    return sum;
  }

  /// Residual of the step with the multipliers in the nodes, after predict().
  [[nodiscard]] ProgramResidual residual(double damping) {
    collect_active();
    ProgramResidual r;
    double largest_term = 0.0, cost = cost_here;
    const bool finite = sweep_back(
        true,
        [&](auto packet, int k, Vector& g) __attribute__((always_inline)) {
          cost_gradient<packet()>(k, step(k), damping, g);
          for (int j = 0; j < width; ++j)
            cost += 0.5 * (g(j) + riccati.stage(k).cost.gradient(j)) * step(k)(j);
        },
        [&](int k, const Vector& sum, const Vector& own) {
          for (int j = States; k < horizon() && j < width; ++j) {
            r.stationarity = std::max(r.stationarity, std::abs(sum(j)));
            largest_term = std::max(largest_term, std::abs(own(j)));
          }
        });
    double largest_multiplier = 0.0;
    for (const ActiveRow& row : active_) {
      const Node& n = node(row.k);
      const double m = std::abs(n.multiplier(row.i));
      largest_multiplier = std::max(largest_multiplier, m);
      // Hard constraints that contradict each other cancel, and rounding of what they push with
      // hides the rest.
      if (n.hard[static_cast<std::size_t>(row.i)] && m >= n.price(row.i))
        largest_term = std::max(largest_term, m * detail::largest(row_gradient(row.k, row.i)));
    }
    r.stationarity = finite ? r.stationarity / (1.0 + largest_term) : infinity;
    r.violation = excess_;
    if (excess_ > 0.0 && excess_ < infinity) r.violation = unpaid_violation(largest_multiplier);
    for (const ActiveRow& row : active_) {
      const Node& n = node(row.k);
      const double m = std::abs(n.multiplier(row.i));
      const bool above = n.multiplier(row.i) > 0.0;
      const double bound = above ? n.upper(row.i) : n.lower(row.i),
                   inside = m / n.stiffness(row.i) +
                            (above ? bound - n.predicted(row.i) : n.predicted(row.i) - bound);
      r.complementarity = std::max(r.complementarity, std::min(m / (1.0 + largest_multiplier),
                                                               inside / (1.0 + std::abs(bound))));
      if (inside > 0.0 || m < n.price(row.i)) r.gap += m * std::abs(inside);
    }
    r.gap /= 1.0 + std::abs(cost);
    return r;
  }

  double cost_here = 0.0;  ///< of the point at which the program was linearised
  /// Until a better one is known, see InteriorPoint.
  static constexpr double hard_price = 1e12;

  Factorisation riccati;

 private:
  static constexpr double infinity = std::numeric_limits<double>::infinity();
  template <int Width>
  static constexpr int row_packets = (Rows + Width - 1) / Width;
  template <int Width>
  static constexpr int row_packet(int t) {
    return Width * t < Rows - Width ? Width * t : Rows - Width;
  }

  [[nodiscard]] static double larger(double a, double b) {
    return a > b ? a : b;
  }

  [[nodiscard]] bool repair(Node& n) {
    for (int i = 0; i < Rows; ++i) {
      double &lower = n.lower(i), &upper = n.upper(i);
      if (!(n.price(i) >= 0.0) || !(n.stiffness(i) >= 0.0)) return false;
      if (!(lower <= upper) && !(lower > upper)) return false;
      if (n.price(i) == 0.0 || n.stiffness(i) == 0.0) {
        lower = -infinity;
        upper = infinity;
        n.price(i) = n.stiffness(i) = 1.0;
      } else if (lower > upper) {
        std::swap(lower, upper);
        if (!n.crossed) n.crosses.fill(false);
        n.crossed = n.crosses[static_cast<std::size_t>(i)] = true;
      }
    }
    return true;
  }

  // Violations relative to the bound, as far as multipliers are not at their price, relative to the
  // largest multiplier.
  [[nodiscard]] double unpaid_violation(double largest_multiplier) const {
    double largest = 0.0;
    for (const Node& n : nodes_)
      for (int i = 0; i < Rows; ++i) {
        const double over = n.predicted(i) - n.upper(i), under = n.lower(i) - n.predicted(i);
        const double most = std::max(over, under), m = std::abs(n.multiplier(i));
        if (!(most > 0.0)) continue;
        const double unpaid =
            (most - m / n.stiffness(i)) / (1.0 + std::abs(over > under ? n.upper(i) : n.lower(i)));
        largest =
            std::max(largest, std::min(unpaid, (n.price(i) - m) / (1.0 + largest_multiplier)));
      }
    return largest;
  }

  std::vector<Node> nodes_;
  std::vector<Vector> steps_;
  std::vector<ActiveRow> active_;
  double excess_ = 0.0;
};

}  // namespace tilt_ropter
