// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <type_traits>
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
  explicit BoundedSides(int horizon) : nodes_(detail::size(horizon) + 1) {
    sides_.reserve(2 * detail::size(Constraints) * nodes_.size());
    immovable_.reserve(detail::size(Constraints) * nodes_.size());
  }

  /// Reads the finite bounds of `program` at its current linearisation. Does not allocate.
  void read(const Program& program) {
    sides_.clear();
    immovable_.clear();
    for (int k = 0; k <= program.horizon(); ++k) {
      const auto& n = program.node(k);
      Node& node = nodes_[detail::size(k)];
      node.single = node.dense = node.columns = 0;
      std::array<int, detail::size(Constraints)> entries{}, last{};
      for (int j = 0; j < (k < program.horizon() ? width : States); ++j) {
        const double* column =
            j < States ? n.C.data() + Constraints * j : n.E.data() + Constraints * (j - States);
        for (int i = 0; i < Constraints; ++i)
          if (column[i] != 0.0) {
            ++entries[detail::size(i)];
            last[detail::size(i)] = j;
          }
      }
      std::array<bool, detail::size(width)> reached{};
      for (int i = 0; i < Constraints; ++i) {
        const bool above = std::isfinite(n.upper(i)), below = std::isfinite(n.lower(i));
        if (!above && !below) continue;
        if (entries[detail::size(i)] == 0) {
          immovable_.push_back({k, i});
          continue;
        }
        if (entries[detail::size(i)] == 1) {
          const int j = last[detail::size(i)];
          node.singles[detail::size(node.single++)] = {i, j,
                                                       j < States ? n.C(i, j) : n.E(i, j - States)};
        } else {
          const auto d = detail::size(node.dense++);
          node.row[d] = i;
          node.gradient[d] = program.constraint_gradient(k, i);
          for (int j = 0; j < width; ++j) reached[detail::size(j)] |= node.gradient[d](j) != 0.0;
        }
        for (const double sign : {1.0, -1.0})
          if (sign > 0.0 ? above : below) sides_.push_back({k, i, Constraints * k + i, sign});
      }
      for (int j = 0; j < width; ++j)
        if (reached[detail::size(j)]) node.column[detail::size(node.columns++)] = j;
    }
  }

  [[nodiscard]] Eigen::Index count() const { return static_cast<Eigen::Index>(sides_.size()); }
  [[nodiscard]] const Side& operator[](Eigen::Index i) const { return sides_[detail::size(i)]; }
  /// Bounded constraints that no step changes. They have no entry in the list of sides.
  [[nodiscard]] const std::vector<typename Program::ActiveConstraint>& immovable() const {
    return immovable_;
  }

  /// Adds weight gradient gradient' of each constraint of node k to the Hessian of this node. The
  /// Hessian has Program::rows x Program::width numbers, `weights` has one number per constraint.
  template <int W>
  [[gnu::always_inline]] inline void add_weights(int k, const double* weights,
                                                 double* hessian) const {
    const Node& node = nodes_[detail::size(k)];
    for (int b = 0; b < node.single; ++b) {
      const Single& s = node.singles[detail::size(b)];
      hessian[(Program::rows + 1) * s.entry] += weights[s.row] * s.slope * s.slope;
    }
    with_packets<W>(
        node, [&](auto first, auto count) __attribute__((always_inline)) {
          for (int c = 0; c < node.columns; ++c) {
            const int j = node.column[detail::size(c)];
            double* column = hessian + Program::rows * j + W * first();
            detail::Packet<W> sum[detail::size(count())];
            detail::load<W>(column, sum);
            for (int d = 0; d < node.dense; ++d) {
              const double* gradient = node.gradient[detail::size(d)].data();
              const double factor = weights[node.row[detail::size(d)]] * gradient[j];
              detail::add_product<W>(sum, gradient + W * first(), factor);
            }
            detail::store<W>(column, sum);
          }
        });
  }

  /// Sets values[i] to C dx + E du of each bounded constraint i of node k, for w = (dx, du).
  template <int W>
  [[gnu::always_inline]] inline void multiply(int k, const Vector& w, double* values) const {
    const Node& node = nodes_[detail::size(k)];
    for (int b = 0; b < node.single; ++b) {
      const Single& s = node.singles[detail::size(b)];
      values[s.row] = s.slope * w(s.entry);
    }
    with_packets<W>(
        node, [&](auto first, auto count) __attribute__((always_inline)) {
          for (int d = 0; d < node.dense; ++d)
            values[node.row[detail::size(d)]] = detail::dot<W, W * count()>(
                node.gradient[detail::size(d)].data() + W * first(), w.data() + W * first());
        });
  }

  /// Adds C' m and E' m of node k to the gradient g, for the multipliers m of the bounded
  /// constraints.
  template <int W>
  [[gnu::always_inline]] inline void add_gradients(int k, const double* m, Vector& g) const {
    const Node& node = nodes_[detail::size(k)];
    for (int b = 0; b < node.single; ++b) {
      const Single& s = node.singles[detail::size(b)];
      g(s.entry) += m[s.row] * s.slope;
    }
    with_packets<W>(
        node, [&](auto first, auto count) __attribute__((always_inline)) {
          detail::Packet<W> sum[detail::size(count())];
          detail::load<W>(g.data() + W * first(), sum);
          for (int d = 0; d < node.dense; ++d)
            detail::add_product<W>(sum, node.gradient[detail::size(d)].data() + W * first(),
                                   m[node.row[detail::size(d)]]);
          detail::store<W>(g.data() + W * first(), sum);
        });
  }

 private:
  static constexpr int width = Program::width;

  // A constraint with one non-zero entry in its gradient.
  struct Single {
    int row = 0, entry = 0;
    double slope = 0.0;
  };
  // The bounded constraints of a node, grouped by the number of entries of their gradients.
  struct Node {
    int single = 0;
    std::array<Single, detail::size(Constraints)> singles;
    int dense = 0;  // constraints with several non-zero entries
    std::array<int, detail::size(Constraints)> row{};
    std::array<Vector, detail::size(Constraints)> gradient;
    int columns = 0;  // columns with a non-zero entry in a gradient of this group
    std::array<int, detail::size(width)> column{};
  };

  // Calls body(first, count), constants, with the packets of a gradient that are not always zero:
  // often only the last states and the inputs matter.
  template <int W, typename Body>
  [[gnu::always_inline]] static inline void with_packets(const Node& node, const Body& body) {
    constexpr int packets = Program::rows / W, half = packets / 2;
    if (node.dense == 0) return;
    if (node.column[0] >= W * half)
      body(std::integral_constant<int, half>(), std::integral_constant<int, packets - half>());
    else
      body(std::integral_constant<int, 0>(), std::integral_constant<int, packets>());
  }

  std::vector<Node> nodes_;
  std::vector<Side> sides_;
  std::vector<typename Program::ActiveConstraint> immovable_;
};

/// Solves a Subproblem by a primal-dual interior-point method. Every iteration takes one Riccati
/// pass and two solves with its factorisation, for any set of active constraints. The method uses
/// predictor and corrector steps (Mehrotra 1992) as in HPIPM (Frison & Diehl 2020), and includes
/// the penalties of the constraints.
///
/// A bound with value v <= 0, penalty rho and stiffness 1 / c has slacks t and s and a multiplier
/// l,
///
///     v + t - s - c l = 0,    l t = mu,    (rho - l) s = mu,    t, s > 0,  0 < l < rho,
///
/// with mu -> 0. Eliminating t, s and l adds one weight 1 / (t / l + s / (rho - l) + c) to the
/// Hessian and one number to the gradient. No program is infeasible and no matrix is singular. An
/// iterate that is inside a bound stays inside it, so an interrupted solve leaves a plan that can
/// be flown.
///
/// The steps are listed in the order in which they run.
template <int States, int Inputs, int Constraints, typename Pattern>
class InteriorPoint {
 public:
  using Program = Subproblem<States, Inputs, Constraints, Pattern>;
  using Vector = typename Program::Vector;

  /// Allocates everything for `horizon` intervals.
  explicit InteriorPoint(int horizon)
      : sides_(horizon),
        here_(detail::size(horizon) + 1, detail::Filled()),
        change_(here_),
        cost_gradients_(here_),
        gradients_(here_),
        of_constraints_(Eigen::VectorXd::Zero(Constraints * (horizon + 1))) {
    const int most = 2 * Constraints * (horizon + 1);
    for (Eigen::VectorXd* numbers :
         {&penalty_, &per_stiffness_, &value_, &multiplier_, &slack_, &excess_, &weight_,
          &per_multiplier_, &per_rest_, &push_, &slack_aim_, &excess_aim_, &multiplier_change_,
          &slack_change_, &excess_change_, &value_change_, &of_multiplier_, &of_rest_})
      numbers->setOnes(detail::padded(std::max(most, 1)));
  }

  /// Starts from the inputs of the plan at which `program` was linearised. If these inputs lead far
  /// from the plan, starts from inputs that follow the deviation from the plan by the gains of the
  /// last pass. The step of that pass is in `program`. curvature(k, row) returns the cost of moving
  /// a constraint. The penalty of a hard constraint becomes `far_above` times the estimated slope
  /// of the cost along this constraint. Returns false, and does not start, if no step changes any
  /// bounded constraint.
  template <typename Curvature>
  [[nodiscard]] bool start(Program& program, double damping, double far_above,
                           const Curvature& curvature) {
    damping_ = damping;
    read_bounds(program);
    if (count() == 0) return false;
    double gain = 0.0;
    for (Vector& w : here_) detail::fill(w, 0.0);
    detail::copy_first(States, program.step(0), here_[0]);
    program.riccati.roll_out(here_);
    if (!(largest(here_) <= 100.0 * largest(program.steps()))) {
      program.riccati.sweep_plan(here_);
      for (Eigen::Index i = 0; i < count(); ++i) {
        const Side& side = sides_[i];
        const double v = std::max(value_change_(i), 0.0);
        gain += curvature(side.k, program.constraint_gradient(side.k, side.row)) * v * v;
      }
    }
    set_values(program);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      if (!program.node(side.k).hard[detail::size(side.row)])
        gain += 0.1 * penalty_(i) * std::max(value_(i), 0.0);
    }
    begin(program, gain + to_gain(program), far_above);
    return true;
  }

  /// Alternative to start(): continues the same program for another initial step. The inputs follow
  /// the difference by the gains of the last pass. Returns false, and changes no iterate, if a
  /// number is not finite.
  [[nodiscard]] bool go_on(Program& program, const typename Program::Tangent& dx0) {
    for (int i = 0; i < States; ++i) change_[0](i) = dx0(i) - here_[0](i);
    program.riccati.sweep_deviation(change_);
    if (!(largest(change_) < detail::infinity)) return false;
    multiply_constraints(change_);
    add_change(1.0);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      const double change = side.sign * of_constraints_(side.at);
      value_(i) += change;
      slack_(i) = std::max(slack_(i) - change, 0.1 * slack_(i));
    }
    return true;
  }

  /// One iteration. Returns false if the factorisation fails or a number is not finite.
  [[nodiscard]] bool iterate(Program& program) {
    const double mu = set_weights() / (2.0 * static_cast<double>(count()));
    const auto weights = [this](int k, double* hessian, double*) {
      detail::vectorised([&](auto packet) __attribute__((always_inline)) {
        sides_.template add_weights<packet()>(k, of_node(detail::size(k)), hessian);
      });
    };
    if (!program.riccati.factorise(damping_, weights)) return false;
    set_cost_gradients(program);
    aim_at_solution();
    find_direction(program);
    const double next = predict() / (2.0 * static_cast<double>(count()));
    ratio_ = std::min(1.0, next / mu);
    aim_at_center(ratio_ * ratio_ * ratio_ * mu, 1.0);
    find_direction(program);
    Lengths lengths = complete_direction();
    if (std::min(lengths.primal, lengths.dual) < short_step) {
      // The corrected direction allows only a short step: use the direction towards the centre
      // alone.
      aim_at_center(mu, 0.0);
      find_direction(program);
      lengths = complete_direction();
    }
    if (!move(lengths)) return false;
    stuck_ = std::min(lengths.primal, lengths.dual) < short_step ? stuck_ + 1 : 0;
    if (stuck_ == 3) {
      stuck_ = 0;
      center(restart_mu_ *= 1e3);
    }
    return true;
  }

  [[nodiscard]] double mu() const { return mu_; }  ///< mean complementarity product
  /// Mean complementarity product after start().
  [[nodiscard]] double first_mu() const { return first_mu_; }
  /// True if the last iteration nearly reached the solution, and shows for all but `few` bounds
  /// clearly whether they are active and whether they are at their penalty.
  [[nodiscard]] bool decided(int few) const {
    const auto unclear = [](double change) { return change > 0.3 && change < 0.7; };
    int undecided = 0;
    for (Eigen::Index i = 0; i < count(); ++i)
      undecided += unclear(of_multiplier_(i)) || unclear(of_rest_(i));
    return undecided <= few && ratio_ < 0.2;
  }

  /// Writes the step into `program` and the multipliers into its nodes. With `decided`, the
  /// multipliers of bounds that seem inactive become zero. Multipliers that seem to be at their
  /// penalty become the penalty.
  void finish(Program& program, bool decided) const {
    for (int k = 0; k <= program.horizon(); ++k) {
      program.step(k) = here_[detail::size(k)];
      detail::fill(program.node(k).multiplier, 0.0);
    }
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      const bool holds = of_multiplier_(i) < 0.5;
      if (!holds && decided) continue;
      const bool at_penalty =
          (of_rest_(i) > 0.5 && decided) || multiplier_(i) > (1.0 - 1e-6) * penalty_(i);
      program.node(side.k).multiplier(side.row) +=
          side.sign * (at_penalty ? penalty_(i) : multiplier_(i));
    }
    program.predict();
    for (const auto& [k, i] : sides_.immovable()) {
      auto& n = program.node(k);
      if (n.predicted(i) > n.upper(i)) n.multiplier(i) = n.penalty(i);
      if (n.predicted(i) < n.lower(i)) n.multiplier(i) = -n.penalty(i);
    }
  }

 private:
  using Sides = BoundedSides<States, Inputs, Constraints, Pattern>;
  using Side = typename Sides::Side;

  [[nodiscard]] static double largest(const std::vector<Vector>& w) {
    double most = 0.0, sum = 0.0;  // the sum is NaN if any entry is NaN
    for (const Vector& v : w) {
      for (Eigen::Index i = 0; i < v.size(); ++i) {
        most = std::max(most, std::abs(v(i)));
        sum += v(i);
      }
    }
    return std::isfinite(sum) ? most : detail::infinity;
  }
  [[nodiscard]] Eigen::Index count() const { return sides_.count(); }
  [[nodiscard]] double* of_node(std::size_t k) {
    return of_constraints_.data() + Constraints * static_cast<Eigen::Index>(k);
  }

  // here_ += length change_.
  void add_change(double length) {
    for (std::size_t k = 0; k < here_.size(); ++k)
      for (Eigen::Index i = 0; i < here_[k].size(); ++i) here_[k](i) += length * change_[k](i);
  }

  // Reads the bounds. Sets value_change_ to the values of the bounds at the step in `program`.
  void read_bounds(const Program& program) {
    sides_.read(program);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      const auto& n = program.node(side.k);
      penalty_(i) = n.penalty(side.row);
      per_stiffness_(i) = 1.0 / n.stiffness(side.row);
      value_change_(i) = side.sign > 0.0 ? n.predicted(side.row) - n.upper(side.row)
                                         : n.lower(side.row) - n.predicted(side.row);
    }
  }

  // Sets the values of all bounds at here_.
  void set_values(const Program& program) {
    multiply_constraints(here_);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      const auto& n = program.node(side.k);
      const double value = n.value(side.row) + of_constraints_(side.at);
      value_(i) = side.sign > 0.0 ? value - n.upper(side.row) : n.lower(side.row) - value;
    }
  }

  // Returns the cost at here_ minus the cost at the step of the program, without constraints. Sets
  // gradients_ to the gradients of the cost at that step.
  [[nodiscard]] double to_gain(const Program& program) {
    double sum = 0.0;
    set_cost_gradients(program);
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (int k = 0; k <= program.horizon(); ++k) {
        const auto i = detail::size(k);
        program.template cost_gradient<packet()>(k, program.step(k), damping_, gradients_[i]);
        for (int j = 0; j < Program::width; ++j)
          sum +=
              0.5 * (cost_gradients_[i](j) + gradients_[i](j)) * (here_[i](j) - program.step(k)(j));
      }
    });
    return std::abs(sum);
  }

  void begin(Program& program, double gain, double far_above) {
    unit_.fill(0.0);
    for (Eigen::Index i = 0; i < count(); ++i) {
      double& u = unit_[detail::size(sides_[i].row)];
      u = std::max({u, std::abs(value_change_(i) - value_(i)), value_(i)});
    }
    // Derivatives of the cost by (dx, du) of each node, with the effect on later nodes, at the step
    // of the program.
    (void)program.sweep_back(
        false, [&](auto, int k, Vector& g) { g = gradients_[detail::size(k)]; },
        [&](int k, const Vector& sum, const Vector&) { gradients_[detail::size(k)] = sum; });
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      auto& n = program.node(side.k);
      if (!n.hard[detail::size(side.row)]) continue;
      if (i > 0 && sides_[i - 1].at == side.at) {  // the other side of the same constraint
        penalty_(i) = penalty_(i - 1);
        continue;
      }
      const Vector row = program.constraint_gradient(side.k, side.row);
      double push = 1.0 + gain / std::max(unit_[detail::size(side.row)], 1e-100);
      for (int j = 0; j < Program::width; ++j)
        if (row(j) != 0.0)
          push = std::max(push, std::abs(gradients_[detail::size(side.k)](j) / row(j)));
      n.penalty(side.row) = n.finite_penalty(side.row) = penalty_(i) =
          program.inputs_last && program.single_input(side.k, side.row)
              ? 1e6 * std::min(far_above * push, Program::hard_penalty)
              : std::min(far_above * push, Program::hard_penalty);
    }
    first_mu_ = restart_mu_ = std::max(10.0 * gain / static_cast<double>(count()), 1e-8);
    center(restart_mu_);
  }

  // Sets slacks and multipliers to approximate values at here_ for complementarity products of
  // `mu`.
  void center(double mu) {
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      const double u = unit_[detail::size(side.row)];
      slack_(i) = std::max({-value_(i), value_(i), 0.1 * u, 1e-10});
      multiplier_(i) = std::min(mu / slack_(i), 0.1 * penalty_(i));
      excess_(i) = mu / (penalty_(i) - multiplier_(i));
      of_multiplier_(i) = 1.0;  // no bound counts as active
      of_rest_(i) = 0.0;
    }
    mu_ = mu;
  }

  // Loads or stores the packets of sides from i on: pairs of numbers and packets.
  template <int W, typename... More>
  [[gnu::always_inline]] static inline void load(Eigen::Index i, const Eigen::VectorXd& from,
                                                 detail::Packet<W>& packet, More&... more) {
    detail::load<W>(from.data() + i, packet);
    if constexpr (sizeof...(more) > 0) load<W>(i, more...);
  }
  template <int W, typename... More>
  [[gnu::always_inline]] static inline void store(Eigen::Index i, Eigen::VectorXd& to,
                                                  const detail::Packet<W>& packet, More&&... more) {
    detail::store<W>(to.data() + i, packet);
    if constexpr (sizeof...(more) > 0) store<W>(i, more...);
  }
  // Calls body(width, i) for every packet of sides.
  template <typename Body>
  void for_sides(const Body& body) const {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      const Eigen::Index end = count();
      for (Eigen::Index i = 0; i < end; i += packet()) body(packet, i);
    });
  }
  // Returns the sum of the numbers that body(width, i, total) adds to `total`.
  template <typename Body>
  [[nodiscard]] double sum_of_sides(const Body& body) const {
    double sum = 0.0;
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      constexpr int W = packet();
      detail::Packet<W> total{};
      const Eigen::Index end = count();
      for (Eigen::Index i = 0; i < end; i += W) body(packet, i, total);
#pragma GCC unroll 4
      for (int j = 0; j < W; ++j) sum += total[j];
    });
    return sum;
  }
  // Returns the largest values of two numbers of each side, at least `least`: body(width, i, first,
  // second) updates both.
  template <typename Body>
  [[nodiscard]] std::array<double, 2> largest_of_sides(double least, const Body& body) const {
    std::array<double, 2> most{least, least};
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      constexpr int W = packet();
      detail::Packet<W> first = detail::Packet<W>{} + least, second = first;
      const Eigen::Index end = count();
      for (Eigen::Index i = 0; i < end; i += W) body(packet, i, first, second);
#pragma GCC unroll 4
      for (int j = 0; j < W; ++j)
        most = {std::max(most[0], first[j]), std::max(most[1], second[j])};
    });
    return most;
  }
  // Computes the weights. Returns the sum of all complementarity products.
  double set_weights() {
    // Fill the last packet with numbers that do not affect the result.
    for (Eigen::Index i = count(); i < detail::padded(static_cast<int>(count())); ++i) {
      penalty_(i) = 2.0;
      multiplier_(i) = per_stiffness_(i) = value_(i) = 1.0;
      slack_(i) = excess_(i) = 1e-200;
      value_change_(i) = 0.0;
    }
    const double sum =
        sum_of_sides([&](auto packet, Eigen::Index i, auto& total) __attribute__((always_inline)) {
          constexpr int W = packet();
          using P = detail::Packet<W>;
          P l, t, s, rho, c;
          load<W>(i, multiplier_, l, slack_, t, excess_, s, penalty_, rho, per_stiffness_, c);
          const P rest = rho - l, per_l = 1.0 / l, per_rest = 1.0 / rest,
                  weight = 1.0 / (t * per_l + s * per_rest + c);
          store<W>(i, per_multiplier_, per_l, per_rest_, per_rest, weight_, weight);
          total += l * t + rest * s;
        });
    detail::fill(of_constraints_, 0.0);
    for (Eigen::Index i = 0; i < count(); ++i) of_constraints_(sides_[i].at) += weight_(i);
    return sum;
  }

  // Sets of_constraints_ to C dx + E du of the bounded constraints, for w = (dx, du).
  void multiply_constraints(const std::vector<Vector>& w) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (std::size_t k = 0; k < w.size(); ++k)
        sides_.template multiply<packet()>(static_cast<int>(k), w[k], of_node(k));
    });
  }

  void set_cost_gradients(const Program& program) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (std::size_t k = 0; k < here_.size(); ++k)
        program.template cost_gradient<packet()>(static_cast<int>(k), here_[k], damping_,
                                                 cost_gradients_[k]);
    });
  }

  // Predictor: sets push_ to the multipliers after a Newton step towards complementarity products
  // of zero, if the values of the bounds did not change.
  void aim_at_solution() {
    for_sides([&](auto packet, Eigen::Index i) __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, v, c, weight;
      load<W>(i, multiplier_, l, value_, v, per_stiffness_, c, weight_, weight);
      store<W>(i, push_, l + weight * (v - c * l));
    });
  }

  // Corrector: the same towards products of `mu`, with a second-order correction from the last
  // direction. The factor `correction` scales the second-order term.
  void aim_at_center(double mu, double correction) {
    for_sides([&](auto packet, Eigen::Index i) __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, t, s, v, c, weight, per_l, per_rest, dl, dt, ds;
      load<W>(i, multiplier_, l, slack_, t, excess_, s, value_, v, per_stiffness_, c, weight_,
              weight, per_multiplier_, per_l, per_rest_, per_rest, multiplier_change_, dl,
              slack_change_, dt, excess_change_, ds);
      const P slack_aim = (mu - correction * dl * dt) * per_l - t,
              excess_aim = (mu + correction * dl * ds) * per_rest - s;
      store<W>(i, slack_aim_, slack_aim, excess_aim_, excess_aim, push_,
               l + weight * (v + t - s - c * l + slack_aim - excess_aim));
    });
  }

  // Computes the step for the multipliers in push_ and the resulting change of the values.
  void find_direction(Program& program) {
    detail::fill(of_constraints_, 0.0);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      of_constraints_(side.at) += side.sign * push_(i);
    }
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (std::size_t k = 0; k < here_.size(); ++k) {
        gradients_[k] = cost_gradients_[k];
        sides_.template add_gradients<packet()>(static_cast<int>(k), of_node(k), gradients_[k]);
      }
    });
    program.riccati.solve(gradients_);
    std::fill_n(change_[0].data(), States, 0.0);
    program.riccati.sweep_change(change_);
    multiply_constraints(change_);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[i];
      value_change_(i) = side.sign * of_constraints_(side.at);
    }
  }

  // Completes the direction towards the solution and detects the active bounds from it. At an
  // active bound the slack vanishes and the multiplier stays; at an inactive bound the multiplier
  // vanishes and the slack stays (El-Bakry, Tapia & Zhang 1994). Returns the sum of the
  // complementarity products after the longest step along the direction.
  double predict() {
    const auto step = [&](auto packet, Eigen::Index i, auto& of_primal, auto& of_dual)
        __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, t, s, weight, per_l, per_rest, push, dv;
      load<W>(i, multiplier_, l, slack_, t, excess_, s, weight_, weight, per_multiplier_, per_l,
              per_rest_, per_rest, push_, push, value_change_, dv);
      const P dl = push - l + weight * dv, of_l = dl * per_l, of_rest = dl * per_rest;
      store<W>(i, multiplier_change_, dl, slack_change_, -t - t * of_l, excess_change_,
               s * of_rest - s, of_multiplier_, -of_l, of_rest_, of_rest);
      const P slacks = 1.0 + (of_l > -of_rest ? of_l : -of_rest),
              multipliers = -of_l > of_rest ? -of_l : of_rest;
      of_primal = slacks > of_primal ? slacks : of_primal;
      of_dual = multipliers > of_dual ? multipliers : of_dual;
    };
    const auto [most_primal, most_dual] = largest_of_sides(1.0, step);
    const double primal = 1.0 / most_primal, dual = 1.0 / most_dual;
    return sum_of_sides([&](auto packet, Eigen::Index i,
                            auto& total) __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, t, s, rho, dl, dt, ds;
      load<W>(i, multiplier_, l, slack_, t, excess_, s, penalty_, rho, multiplier_change_, dl,
              slack_change_, dt, excess_change_, ds);
      const P after = l + dual * dl;
      total += after * (t + primal * dt) + (rho - after) * (s + primal * ds);
    });
  }

  struct Lengths {
    double primal, dual;
  };

  // Completes the direction towards the centre. Returns the step lengths: the fraction
  // most_of_the_way of the distance to the nearest bound, at most 1.
  [[nodiscard]] Lengths complete_direction() {
    const auto step = [&](auto packet, Eigen::Index i, auto& of_primal, auto& of_dual)
        __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, t, s, weight, per_l, per_rest, push, slack_aim, excess_aim, dv;
      load<W>(i, multiplier_, l, slack_, t, excess_, s, weight_, weight, per_multiplier_, per_l,
              per_rest_, per_rest, push_, push, slack_aim_, slack_aim, excess_aim_, excess_aim,
              value_change_, dv);
      const P dl = push - l + weight * dv, dt = slack_aim - t * per_l * dl,
              ds = excess_aim + s * per_rest * dl, of_t = dt / t, of_s = ds / s, of_l = dl * per_l,
              of_rest = dl * per_rest;
      store<W>(i, multiplier_change_, dl, slack_change_, dt, excess_change_, ds);
      const P slacks = of_t < of_s ? -of_t : -of_s, multipliers = -of_l > of_rest ? -of_l : of_rest;
      of_primal = slacks > of_primal ? slacks : of_primal;
      of_dual = multipliers > of_dual ? multipliers : of_dual;
    };
    const auto [most_primal, most_dual] = largest_of_sides(most_of_the_way, step);
    return {most_of_the_way / most_primal, most_of_the_way / most_dual};
  }

  // Adds length times `change` to `numbers`, in the packet at i, and returns this packet in `sum`.
  template <int W>
  [[gnu::always_inline]] static inline void add_packet(const Eigen::VectorXd& change, double length,
                                                       Eigen::Index i, Eigen::VectorXd& numbers,
                                                       detail::Packet<W>& sum) {
    detail::Packet<W> step;
    detail::load<W>(numbers.data() + i, sum);
    detail::load<W>(change.data() + i, step);
    sum += length * step;
    detail::store<W>(numbers.data() + i, sum);
  }

  // Moves along the direction. Returns false, and changes nothing, if a number is not finite.
  [[nodiscard]] bool move(const Lengths& lengths) {
    const double primal = lengths.primal, dual = lengths.dual;
    if (!(largest(change_) * primal < detail::infinity) ||
        !(largest_change() * dual < detail::infinity))
      return false;
    add_change(primal);
    const double sum =
        sum_of_sides([&](auto packet, Eigen::Index i, auto& total) __attribute__((always_inline)) {
          constexpr int W = packet();
          using P = detail::Packet<W>;
          P l, t, s, v, rho;
          load<W>(i, penalty_, rho);
          add_packet<W>(multiplier_change_, dual, i, multiplier_, l);
          add_packet<W>(slack_change_, primal, i, slack_, t);
          add_packet<W>(excess_change_, primal, i, excess_, s);
          add_packet<W>(value_change_, primal, i, value_, v);
          total += l * t + (rho - l) * s;
        });
    mu_ = sum / (2.0 * static_cast<double>(count()));
    return true;
  }

  [[nodiscard]] double largest_change() const {
    double sum = 0.0;  // NaN if any change is NaN
    for (Eigen::Index i = 0; i < count(); ++i)
      sum += std::abs(multiplier_change_(i)) + std::abs(slack_change_(i)) +
             std::abs(excess_change_(i));
    return sum;
  }

  static constexpr double most_of_the_way = 0.99, short_step = 0.1;

  Sides sides_;
  std::vector<Vector> here_, change_, cost_gradients_, gradients_;
  Eigen::VectorXd of_constraints_;  // one number for each constraint of each node
  // One number for each side:
  Eigen::VectorXd penalty_, per_stiffness_, value_, multiplier_, slack_, excess_, weight_,
      per_multiplier_, per_rest_, push_, slack_aim_, excess_aim_, multiplier_change_, slack_change_,
      excess_change_, value_change_, of_multiplier_, of_rest_;
  double damping_ = 0.0, mu_ = 0.0, first_mu_ = 0.0, restart_mu_ = 0.0;
  double ratio_ = 1.0;  // by which a step of the last iteration to the solution would decrease mu
  int stuck_ = 0;
  std::array<double, detail::size(Constraints)> unit_{};  // estimated largest change of each value
};

}  // namespace tilt_ropter::optimal_control
