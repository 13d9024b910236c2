// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/riccati.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

/// The quadratic program of one SQP step: the linear-quadratic problem of Riccati with two-sided
/// constraints lower <= value + C dx + E du <= upper at every node, see NodeConstraints.
/// All methods that solve the program share its data and sweeps.
namespace tilt_ropter::optimal_control {

/// Cost of a `violation` >= 0. The cost is quadratic while its slope, stiffness times violation, is
/// below the penalty, and linear beyond.
[[nodiscard]] inline double violation_cost(double penalty, double stiffness, double violation) {
  const double linear = violation - 0.5 * penalty / stiffness;
  return stiffness * violation < penalty ? 0.5 * stiffness * violation * violation
                                         : penalty * linear;
}

/// Constraints of one node.
///
/// Every constraint has a penalty: the cost of violating it by one unit, and the upper bound on its
/// multiplier (Nocedal & Wright, "Numerical Optimization", Sec. 17.2). Every constraint has a
/// stiffness: the multiplier per unit of violation. While a multiplier m is below the penalty, the
/// violation is m / stiffness. Therefore every program has a solution.
template <int States, int Inputs, int Constraints>
struct NodeConstraints {
  using Values = Eigen::Matrix<double, Constraints, 1>;
  Values value = detail::Filled();  ///< at the point of linearisation
  Eigen::Matrix<double, Constraints, States> C = detail::Filled();  ///< derivative by the state
  Eigen::Matrix<double, Constraints, Inputs> E = detail::Filled();  ///< derivative by the input
  Values lower = detail::Filled{-detail::infinity};                 ///< infinite: no bound
  Values upper = detail::Filled{detail::infinity};                  ///< infinite: no bound
  Values penalty = detail::Filled{1.0};                             ///< largest multiplier, finite
  Values stiffness = detail::Filled{detail::infinity};  ///< infinite: no violation below penalty
  /// In: warm start. Out: solution. > 0 at the upper bound, < 0 at the lower.
  Values multiplier = detail::Filled();
  Values predicted = detail::Filled();  ///< value + C dx + E du at the current step
  /// Finite penalties of the hard constraints in the last program, see InteriorPoint.
  Values finite_penalty = detail::Filled{detail::infinity};
  /// `crossed`: some lower bound was above its upper bound, see Subproblem::check_node().
  /// `crosses`: the same for each constraint, valid only if `crossed`.
  bool crossed = false;
  std::array<bool, detail::size(Constraints)> crosses{};
  std::array<bool, detail::size(Constraints)> hard{};  ///< its own penalty is infinite

  /// Returns the violation of the original bounds of constraint i at this value, at least zero.
  [[nodiscard]] double violation(int i, double constraint_value) const {
    const bool swapped = crossed && crosses[detail::size(i)];
    const double below = swapped ? upper(i) : lower(i), above = swapped ? lower(i) : upper(i);
    return std::max({0.0, below - constraint_value, constraint_value - above});
  }
};

/// Residual of a step and its multipliers in a program: the largest residual of each condition.
struct ProgramResidual {
  double stationarity = 0.0;     ///< of the inputs, relative to the largest term
  double violation = 0.0;        ///< beyond the violation that the multiplier accounts for,
                                 ///< relative to the bound
  double complementarity = 0.0;  ///< the smaller of distance from the bound, relative to the bound,
                                 ///< and multiplier, relative to the largest multiplier
  double gap = 0.0;              ///< error of the cost due to complementarity, relative to the cost
  [[nodiscard]] double largest() const {
    const double most = std::max({stationarity, violation, complementarity, gap});
    return stationarity + violation + complementarity + gap < detail::infinity
               ? most
               : detail::infinity;  // also for NaN
  }
};

/// Data of the program, a step, and the functions that all solution methods need. Allocates only in
/// the constructor.
template <int States, int Inputs, int Constraints, typename Pattern = FullTransition>
class Subproblem {
 public:
  using Factorisation = Riccati<States, Inputs, Pattern>;
  using Node = NodeConstraints<States, Inputs, Constraints>;
  using Values = typename Node::Values;
  using Vector = typename Factorisation::Vector;
  using Tangent = typename Factorisation::Tangent;
  static constexpr int width = Factorisation::width, rows = Factorisation::rows;

  explicit Subproblem(int horizon)
      : riccati(horizon),
        nodes_(detail::size(horizon) + 1),
        steps_(nodes_.size(), detail::Filled()),
        costates_(nodes_.size(), Tangent::Zero()) {
    active_.reserve(detail::size(Constraints) * nodes_.size());
  }

  [[nodiscard]] int horizon() const { return riccati.horizon(); }
  [[nodiscard]] Node& node(int k) { return nodes_[detail::size(k)]; }
  [[nodiscard]] const Node& node(int k) const { return nodes_[detail::size(k)]; }
  [[nodiscard]] auto dx(int k) const { return step(k).template head<States>(); }
  [[nodiscard]] auto du(int k) const { return step(k).template segment<Inputs>(States); }
  [[nodiscard]] Vector& step(int k) { return steps_[detail::size(k)]; }
  [[nodiscard]] const Vector& step(int k) const { return steps_[detail::size(k)]; }
  [[nodiscard]] std::vector<Vector>& steps() { return steps_; }
  /// Sets dx of node 0.
  void set_first(const Tangent& dx0) { detail::copy_first(States, dx0, steps_[0]); }

  /// Prepares the cost and the constraints that were written to node k for a solve. Constraints
  /// with infinite penalty are hard: they get a penalty so large that only constraints that must be
  /// violated are relaxed. Constraints with penalty or stiffness zero are removed. If the lower
  /// bound is above the upper bound, the two are swapped; the solutions are the same, because the
  /// penalty is paid for the gap in any case. Returns false if a number is not finite, a bound is
  /// NaN, or a penalty or stiffness is negative.
  [[nodiscard]] bool check_node(int k) {
    Node& n = node(k);
    n.crossed = false;
    for (int i = 0; i < Constraints; ++i)
      n.hard[detail::size(i)] = n.penalty(i) == detail::infinity;
    for (int i = 0; i < Constraints; ++i) {
      if (!n.hard[detail::size(i)]) continue;
      // A relaxed hard constraint keeps the penalty at which it was relaxed.
      const bool was_relaxed = std::abs(n.multiplier(i)) >= n.finite_penalty(i);
      n.penalty(i) = n.finite_penalty(i) = was_relaxed ? n.finite_penalty(i) : hard_penalty;
    }
    bool regular = true;
    for (int i = 0; i < Constraints; ++i)
      regular &= n.lower(i) <= n.upper(i) && n.penalty(i) > 0.0 && n.stiffness(i) > 0.0;
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

  /// Divides the cost of node k by `cost` and each of its constraints by its entry of `rows`, with
  /// everything that belongs to them.
  void change_units(int k, double cost, const Values& units) {
    Node& n = node(k);
    for (int i = 0; i < Constraints; ++i) {
      const double row = units(i), slope = row / cost;
      n.multiplier(i) *= slope;
      n.penalty(i) *= slope;
      n.finite_penalty(i) *= slope;
      n.stiffness(i) *= row * slope;
      n.predicted(i) /= row;
      n.value(i) /= row;
      n.lower(i) /= row;
      n.upper(i) /= row;
      for (int j = 0; j < States; ++j) n.C(i, j) /= row;
      for (int j = 0; j < Inputs; ++j) n.E(i, j) /= row;
    }
    auto& model = riccati.stage(k).cost;
    for (Eigen::Index i = 0; i < model.hessian.size(); ++i) model.hessian.data()[i] /= cost;
    for (Eigen::Index i = 0; i < model.gradient.size(); ++i) model.gradient(i) /= cost;
  }

  /// Largest violation of the constraints of node k at the point of linearisation, at least zero.
  [[nodiscard]] double violation_here(int k) const {
    const Node& n = node(k);
    double most = detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      return excess_of<packet()>(n.value, n);
    });
    for (int i = 0; n.crossed && i < Constraints; ++i)
      most = std::max(most, n.violation(i, n.value(i)));
    return most;
  }

  /// True if constraint i of node k depends on one input and nothing else.
  [[nodiscard]] bool single_input(int k, int i) const { return entries(k, i) == 1; }
  /// Returns false if no step changes the value of constraint i of node k.
  [[nodiscard]] bool can_move(int k, int i) const { return entries(k, i) > 0; }
  /// Gradient of constraint i of node k by (dx, du).
  [[nodiscard]] Vector constraint_gradient(int k, int i) const {
    Vector gradient = detail::Filled();
    if constexpr (Constraints > 0) {
      for (int j = 0; j < States; ++j) gradient(j) = node(k).C(i, j);
      for (int j = 0; k < horizon() && j < Inputs; ++j) gradient(States + j) = node(k).E(i, j);
    }
    return gradient;
  }

  /// Computes the predicted values of the constraints of all nodes after the step, and their
  /// largest violation.
  void predict() {
    excess_ = detail::vectorised([this](auto packet) __attribute__((always_inline)) {
      double excess = 0.0;
      for (int k = 0; k <= horizon(); ++k) {
        Node& n = node(k);
        n.predicted = n.value;
        add_constraint_values<packet()>(k, step(k), n.predicted.data());
        excess = detail::larger(excess, excess_of<packet()>(n.predicted, n));
      }
      return excess;
    });
  }
  /// Computes the optimal step of the last factorisation from dx0, and calls predict().
  void sweep(const Tangent& dx0) {
    set_first(dx0);
    riccati.sweep(steps_);
    predict();
  }
  /// Multiplier of the continuity constraint that ends at node k >= 1, as of the last residual().
  [[nodiscard]] const Tangent& costate(int k) const { return costates_[detail::size(k)]; }
  /// Largest violation in the last prediction, at least zero; infinite if a number was not finite.
  [[nodiscard]] double excess() const { return excess_; }
  /// The same for the given values of the constraints of a node.
  template <int Width>
  [[gnu::always_inline]] static inline double excess_of(const Values& values, const Node& n) {
    detail::FiniteCheck<Width> check;
    detail::Packet<Width> most{};
    double rest = 0.0;
    int i = 0;
    for (; i + Width <= Constraints; i += Width) {
      detail::Packet<Width> value, lower, upper;
      detail::load<Width>(values.data() + i, value);
      detail::load<Width>(n.lower.data() + i, lower);
      detail::load<Width>(n.upper.data() + i, upper);
      check.add(value);
      const detail::Packet<Width> over = value - upper, under = lower - value;
      most = over > most ? over : most;
      most = under > most ? under : most;
    }
    for (; i < Constraints; ++i) {
      check.add(values(i));
      rest = std::max({rest, values(i) - n.upper(i), n.lower(i) - values(i)});
    }
#pragma GCC unroll 4
    for (int j = 0; j < Width; ++j) rest = std::max(rest, most[j]);
    return check.passed() ? rest : detail::infinity;
  }

  /// Constraint i of node k. active() lists the constraints with a multiplier, after
  /// collect_active().
  struct ActiveConstraint {
    int k, i;
  };
  [[nodiscard]] const std::vector<ActiveConstraint>& active() const {
    return active_;
  }
  /// Collects the constraints that have a multiplier, from the last node to the first.
  void collect_active() {
    active_.clear();
    for (int k = horizon(); k >= 0; --k) {
      const Values& m = node(k).multiplier;
      for (int i = 0; i < Constraints; ++i)
        if (m(i) != 0.0) active_.push_back({k, i});
    }
  }

  /// Backward propagation of derivatives, from the last node to the first: the derivative by (dx,
  /// du) of each node, with the effect on all later nodes. The derivatives start from the gradients
  /// that set(width, k, g) writes and, if `with_multipliers`, from the multipliers of active().
  /// Calls see(k, derivative, own) with the node's own part of the derivative. Returns false if a
  /// number is not finite.
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
        detail::load<Width>(g.data(), sum);
        for (int i = 0; k < horizon() && i < States; ++i) {
          detail::add_product<Width>(sum, riccati.stage(k).transition.data() + rows * i,
                                     adjoint(i));
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

  /// Adds C dx + E du of node k to `values`, for w = (dx, du).
  template <int Width>
  [[gnu::always_inline]] inline void add_constraint_values(int k, const Vector& w,
                                                           double* values) const {
    const Node& n = node(k);
    if constexpr (Constraints >= Width) {
      detail::Packet<Width> sum[detail::size(row_packets<Width>)];
#pragma GCC unroll 16
      for (int t = 0; t < row_packets<Width>; ++t)
        detail::load<Width>(values + row_packet<Width>(t), sum[t]);
      for (int j = 0; j < States; ++j) {
#pragma GCC unroll 16
        for (int t = 0; t < row_packets<Width>; ++t)
          detail::add_product<Width>(sum[t], n.C.data() + Constraints * j + row_packet<Width>(t),
                                     w(j));
      }
      for (int j = 0; k < horizon() && j < Inputs; ++j) {
#pragma GCC unroll 16
        for (int t = 0; t < row_packets<Width>; ++t)
          detail::add_product<Width>(sum[t], n.E.data() + Constraints * j + row_packet<Width>(t),
                                     w(States + j));
      }
#pragma GCC unroll 16
      for (int t = 0; t < row_packets<Width>; ++t)
        detail::store<Width>(values + row_packet<Width>(t), sum[t]);
    } else {
      for (int i = 0; i < Constraints; ++i) {
        for (int j = 0; j < States; ++j) values[i] += n.C(i, j) * w(j);
        for (int j = 0; k < horizon() && j < Inputs; ++j) values[i] += n.E(i, j) * w(States + j);
      }
    }
  }

  /// Computes the gradient of the cost of node k at w = (dx, du), without continuity and
  /// constraints. `damping` is added to the diagonal of the Hessian.
  template <int Width>
  [[gnu::always_inline]] inline void cost_gradient(int k, const Vector& at, double damping,
                                                   Vector& g) const {
    constexpr int packets = rows / Width, state_packets = (States + Width - 1) / Width;
    const auto& cost = riccati.stage(k).cost;
    const double* w = at.data();
#pragma GCC unroll 16
    for (int t = 0; t < packets; ++t) {
      detail::Packet<Width> sum;
      detail::load<Width>(cost.gradient.data() + Width * t, sum);
      detail::add_product<Width>(sum, w + Width * t, damping);
      detail::store<Width>(g.data() + Width * t, sum);
    }
    double of_inputs[detail::size(Inputs)];  // because the last packet of dx can reach into du
    for (int j = 0; j < Inputs; ++j) {
      of_inputs[j] = g(States + j);
      if (k < horizon())
        of_inputs[j] += detail::dot<Width, rows>(cost.hessian.data() + rows * (States + j), w);
    }
    detail::Packet<Width> sum[detail::size(state_packets)];
    detail::load<Width>(g.data(), sum);
    for (int j = 0; j < (k < horizon() ? width : States); ++j)
      detail::add_product<Width>(sum, cost.hessian.data() + rows * j, w[j]);
    detail::store<Width>(g.data(), sum);
    for (int j = 0; j < Inputs; ++j) g(States + j) = of_inputs[j];
  }

  /// Change of the cost by the step, including the penalty of every violation. Requires predict().
  [[nodiscard]] double cost_of_step(double damping) const {
    double sum = 0.0;
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      Vector g;
      for (int k = 0; k <= horizon(); ++k) {
        cost_gradient<packet()>(k, step(k), damping, g);
        const auto& cost = riccati.stage(k).cost.gradient;
        const int columns = k < horizon() ? width : States;
        for (int j = 0; j < columns; ++j) sum += 0.5 * (g(j) + cost(j)) * step(k)(j);
      }
    });
    for (const Node& n : nodes_)
      for (int i = 0; i < Constraints; ++i) {
        if (n.predicted(i) > n.upper(i) || n.predicted(i) < n.lower(i))
          sum += violation_cost(n.penalty(i), n.stiffness(i), n.violation(i, n.predicted(i)));
      }
    return sum;
  }

  /// Residual of the step with the multipliers in the nodes. Requires predict(). Sets costate().
  [[nodiscard]] ProgramResidual residual(double damping) {
    double cost = cost_here;
    return residual(
        &Node::predicted, excess_, cost,
        true, [&](auto packet, int k, Vector& g) __attribute__((always_inline)) {
          cost_gradient<packet()>(k, step(k), damping, g);
          for (int j = 0; j < width; ++j)
            cost += 0.5 * (g(j) + riccati.stage(k).cost.gradient(j)) * step(k)(j);
        });
  }
  /// The same for no step: how far the point of linearisation is from an optimum. `violation` is
  /// the largest of violation_here(). The result has a violation only if it is the largest.
  [[nodiscard]] ProgramResidual residual_here(double violation) {
    return residual(
        &Node::value, violation, cost_here,
        false, [&](auto, int k, Vector& g) __attribute__((always_inline)) {
          g = riccati.stage(k).cost.gradient;
        });
  }

  /// Hard bounds on single inputs are relaxed only if nothing else is left to relax.
  bool inputs_last = true;
  double cost_here = 0.0;  ///< cost at the point of linearisation
  /// Penalty of a hard constraint until a better one is known, see InteriorPoint.
  static constexpr double hard_penalty = 1e12;

  Factorisation riccati;

 private:
  template <int Width>
  static constexpr int row_packets = (Constraints + Width - 1) / Width;
  template <int Width>
  static constexpr int row_packet(int t) {
    return Width * t < Constraints - Width ? Width * t : Constraints - Width;
  }

  // Number of inputs on which constraint i of node k depends, plus twice that of states.
  [[nodiscard]] int entries(int k, int i) const {
    int count = 0;
    for (int j = 0; j < States; ++j) count += 2 * (node(k).C(i, j) != 0.0);
    for (int j = 0; k < horizon() && j < Inputs; ++j) count += node(k).E(i, j) != 0.0;
    return count;
  }

  [[nodiscard]] bool repair(Node& n) {
    for (int i = 0; i < Constraints; ++i) {
      double &lower = n.lower(i), &upper = n.upper(i);
      if (!(n.penalty(i) >= 0.0) || !(n.stiffness(i) >= 0.0)) return false;
      if (!(lower <= upper) && !(lower > upper)) return false;
      if (n.penalty(i) == 0.0 || n.stiffness(i) == 0.0) {
        lower = -detail::infinity;
        upper = detail::infinity;
        n.penalty(i) = n.stiffness(i) = 1.0;
      } else if (lower > upper) {
        std::swap(lower, upper);
        if (!n.crossed) n.crosses.fill(false);
        n.crossed = n.crosses[detail::size(i)] = true;
      }
    }
    return true;
  }

  // `gradient` sets the gradient of the cost of a node, and completes `cost`.
  template <typename Gradient>
  [[nodiscard]] ProgramResidual residual(Values Node::*values, double excess, const double& cost,
                                         bool relative, const Gradient& gradient) {
    collect_active();
    ProgramResidual r;
    double largest_term = 0.0;
    const bool finite =
        sweep_back(true, gradient, [&](int k, const Vector& sum, const Vector& own) {
          detail::copy_first(States, sum, costates_[detail::size(k)]);
          for (int j = States; k < horizon() && j < width; ++j) {
            r.stationarity = std::max(r.stationarity, std::abs(sum(j)));
            largest_term = std::max(largest_term, std::abs(own(j)));
          }
        });
    double largest_multiplier = 0.0;
    for (const ActiveConstraint& row : active_) {
      const Node& n = node(row.k);
      const double m = std::abs(n.multiplier(row.i));
      largest_multiplier = std::max(largest_multiplier, m);
      // The large terms of contradicting hard constraints cancel each other, and their rounding
      // errors hide the remaining terms.
      if (n.hard[detail::size(row.i)] && m >= n.penalty(row.i))
        largest_term =
            std::max(largest_term, m * detail::largest(constraint_gradient(row.k, row.i)));
    }
    r.stationarity = finite ? r.stationarity / (1.0 + largest_term) : detail::infinity;
    for (const ActiveConstraint& row : active_) {
      const Node& n = node(row.k);
      const double m = std::abs(n.multiplier(row.i)), value = (n.*values)(row.i);
      const bool above = n.multiplier(row.i) > 0.0;
      const double bound = above ? n.upper(row.i) : n.lower(row.i),
                   inside = m / n.stiffness(row.i) + (above ? bound - value : value - bound);
      r.complementarity = std::max(r.complementarity, std::min(m / (1.0 + largest_multiplier),
                                                               inside / (1.0 + std::abs(bound))));
      if (inside > 0.0 || m < n.penalty(row.i)) r.gap += m * std::abs(inside);
    }
    r.gap /= 1.0 + std::abs(cost);
    const bool decides = relative || excess > r.largest();
    r.violation = excess;
    if (excess > 0.0 && excess < detail::infinity)
      r.violation = decides ? unpaid_violation(values, largest_multiplier, relative) : 0.0;
    return r;
  }

  // Largest violation beyond the part that the multiplier accounts for. For each constraint, the
  // smaller of two numbers counts: the violation, if `relative` to the bound, and the distance of
  // the multiplier from its penalty, relative to the largest multiplier.
  [[nodiscard]] double unpaid_violation(Values Node::*values, double largest_multiplier,
                                        bool relative) const {
    double largest = 0.0;
    for (const Node& n : nodes_)
      for (int i = 0; i < Constraints; ++i) {
        const double value = (n.*values)(i), over = value - n.upper(i), under = n.lower(i) - value;
        const double most = std::max(over, under), m = std::abs(n.multiplier(i));
        if (!(most > 0.0)) continue;
        const double bound = over > under ? n.upper(i) : n.lower(i),
                     unpaid =
                         (most - m / n.stiffness(i)) / (relative ? 1.0 + std::abs(bound) : 1.0);
        largest =
            std::max(largest, std::min(unpaid, (n.penalty(i) - m) / (1.0 + largest_multiplier)));
      }
    return largest;
  }

  std::vector<Node> nodes_;
  std::vector<Vector> steps_;
  std::vector<Tangent> costates_;
  std::vector<ActiveConstraint> active_;
  double excess_ = 0.0;
};

}  // namespace tilt_ropter::optimal_control
