// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/entries.hpp>
#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/optimal_control/subproblem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace tilt_ropter {

/// Solves a Subproblem by a primal-dual interior-point method whose every iteration is one Riccati
/// pass and two solves with it, whatever holds: predictor and corrector (Mehrotra 1992) as in HPIPM
/// (Frison & Diehl 2020), with the constraints' prices in it.
///
/// A bound with value v <= 0, price rho and softness c = 1 / stiffness has slacks t and s and a
/// multiplier l,
///
///     v + t - s - c l = 0,    l t = mu,    (rho - l) s = mu,    t, s > 0,  0 < l < rho,
///
/// with mu -> 0. Eliminated, it adds one weight 1 / (t / l + s / (rho - l) + c) to the Hessian and
/// one number to the gradient. No program is infeasible, no matrix singular, and no iterate leaves
/// a bound that it is inside, so that a solve that is cut off leaves a plan that can be flown.
///
/// A long header for one method: the steps of an iteration work on the same eighteen vectors, one
/// number for each side of each bounded constraint, and are read in the order in which they run.
template <int States, int Inputs, int Rows, typename Pattern>
class InteriorPoint {
 public:
  using Program = Subproblem<States, Inputs, Rows, Pattern>;
  using Vector = typename Program::Vector;

  /// Allocates everything for `horizon` intervals.
  explicit InteriorPoint(int horizon)
      : nodes_(static_cast<std::size_t>(horizon) + 1),
        here_(nodes_.size(), detail::Filled()),
        change_(here_),
        cost_gradients_(here_),
        gradients_(here_),
        of_rows_(Eigen::VectorXd::Zero(Rows * (horizon + 1))) {
    const int most = 2 * Rows * (horizon + 1);
    sides_.reserve(static_cast<std::size_t>(most));
    immovable_.reserve(static_cast<std::size_t>(most / 2));
    for (Eigen::VectorXd* numbers :
         {&price_, &softness_, &value_, &multiplier_, &slack_, &excess_, &weight_, &per_multiplier_,
          &per_rest_, &push_, &slack_aim_, &excess_aim_, &multiplier_change_, &slack_change_,
          &excess_change_, &value_change_, &of_multiplier_, &of_rest_})
      numbers->setOnes(detail::padded(std::max(most, 1)));
  }

  /// Begins with the inputs of the plan from which `program` was linearised, or, where they lead
  /// far astray, with inputs that follow the deviation from it by the gains of the last pass, whose
  /// step is in `program`; curvature(k, row) is what it costs to move a constraint. Hard
  /// constraints get a price that is `far_above` times what the cost pushes against them with.
  /// False, and nothing is begun, if no step changes any bounded constraint.
  template <typename Curvature>
  [[nodiscard]] bool start(Program& program, double damping, double far_above,
                           const Curvature& curvature) {
    damping_ = damping;
    read_rows(program);
    if (sides_.empty()) return false;
    double gain = 0.0;
    for (Vector& w : here_) detail::fill(w, 0.0);
    detail::copy_first(States, program.step(0), here_[0]);
    program.riccati.roll_out(here_);
    if (!(largest(here_) <= 100.0 * largest(program.steps()))) {
      program.riccati.sweep_plan(here_);
      for (Eigen::Index i = 0; i < count(); ++i) {
        const Side& side = sides_[static_cast<std::size_t>(i)];
        const double v = std::max(value_change_(i), 0.0);
        gain += curvature(side.k, program.row_gradient(side.k, side.row)) * v * v;
      }
    }
    set_values(program);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[static_cast<std::size_t>(i)];
      if (!program.node(side.k).hard[static_cast<std::size_t>(side.row)])
        gain += 0.1 * price_(i) * std::max(value_(i), 0.0);
    }
    begin(program, gain + to_gain(program), far_above);
    return true;
  }

  /// Instead of start(): the same program with another initial step. Inputs follow the difference
  /// by the gains of the last pass. False, and nothing is done, if a number is not finite.
  [[nodiscard]] bool go_on(Program& program, const typename Program::Tangent& dx0) {
    for (int i = 0; i < States; ++i) change_[0](i) = dx0(i) - here_[0](i);
    program.riccati.sweep_deviation(change_);
    if (!(largest(change_) < infinity)) return false;
    multiply_rows(program, change_);
    add_change(1.0);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[static_cast<std::size_t>(i)];
      const double change = side.sign * of_rows_(side.at);
      value_(i) += change;
      slack_(i) = std::max(slack_(i) - change, 0.1 * slack_(i));
    }
    return true;
  }

  /// One iteration. False if there is no factorisation or a number is not finite.
  [[nodiscard]] bool iterate(Program& program) {
    const double mu = set_weights() / (2.0 * static_cast<double>(count()));
    const auto weights = [this](int k, double* hessian, double*) {
      detail::vectorised([&](auto packet) __attribute__((always_inline)) {
        add_weights<packet()>(k, hessian);
        return true;
      });
    };
    if (!program.riccati.factorise(damping_, weights)) return false;
    set_cost_gradients(program);
    aim_at_solution();
    find_direction(program);
    const double next = predict() / (2.0 * static_cast<double>(count()));
    const double ratio = std::min(1.0, next / mu);
    aim_at_center(ratio * ratio * ratio * mu, 1.0);
    find_direction(program);
    Lengths lengths = complete_direction();
    if (std::min(lengths.primal, lengths.dual) < short_step) {
      // The correction has led astray: towards the centre, and no further.
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

  [[nodiscard]] double mu() const { return mu_; }              ///< mean complementarity product
  [[nodiscard]] double first_mu() const { return first_mu_; }  ///< that of start()
  /// Bounds of which the last iteration does not clearly say whether they hold.
  [[nodiscard]] int undecided() const {
    const auto unclear = [](double change) { return change > 0.3 && change < 0.7; };
    int undecided = 0;
    for (Eigen::Index i = 0; i < count(); ++i)
      undecided += unclear(of_multiplier_(i)) || unclear(of_rest_(i));
    return undecided;
  }

  /// Writes the step into `program`, and the multipliers into its nodes; if `decided`, those of
  /// bounds that seem not to hold as zero, and those that seem to be at their price as that.
  void finish(Program& program, bool decided) const {
    for (int k = 0; k <= program.horizon(); ++k) {
      program.step(k) = here_[static_cast<std::size_t>(k)];
      detail::fill(program.node(k).multiplier, 0.0);
    }
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[static_cast<std::size_t>(i)];
      const bool holds = of_multiplier_(i) < 0.5;
      if (!holds && decided) continue;
      const bool at_price =
          (of_rest_(i) > 0.5 && decided) || multiplier_(i) > (1.0 - 1e-6) * price_(i);
      program.node(side.k).multiplier(side.row) +=
          side.sign * (at_price ? price_(i) : multiplier_(i));
    }
    program.predict();
    for (const auto& [k, i] : immovable_) {
      auto& n = program.node(k);
      if (n.predicted(i) > n.upper(i)) n.multiplier(i) = n.price(i);
      if (n.predicted(i) < n.lower(i)) n.multiplier(i) = -n.price(i);
    }
  }

 private:
  struct Side {      // a finite bound: of row `row` of node k, upper (+1) or lower (-1)
    int k, row, at;  // at: in of_rows_
    double sign;
  };
  // The rows of a node that have a bound, by what they add to a Hessian.
  struct NodeRowsRead {
    int bounds = 0;  // with a single non-zero entry
    std::array<int, static_cast<std::size_t>(Rows)> bound{}, entry{};
    std::array<double, static_cast<std::size_t>(Rows)> square{};
    int dense = 0;  // with more of them
    std::array<int, static_cast<std::size_t>(Rows)> row{};
    std::array<Vector, static_cast<std::size_t>(Rows)> gradient;
    int columns = 0;  // that they reach
    std::array<int, static_cast<std::size_t>(Program::width)> column{};
  };

  [[nodiscard]] static double largest(const std::vector<Vector>& w) {
    double most = 0.0, sum = 0.0;  // the sum is NaN if any is
    for (const Vector& v : w) {
      for (Eigen::Index i = 0; i < v.size(); ++i) {
        most = std::max(most, std::abs(v(i)));
        sum += v(i);
      }
    }
    return std::isfinite(sum) ? most : infinity;
  }
  [[nodiscard]] Eigen::Index count() const { return static_cast<Eigen::Index>(sides_.size()); }

  // here_ += length change_.
  void add_change(double length) {
    for (std::size_t k = 0; k < here_.size(); ++k)
      for (Eigen::Index i = 0; i < here_[k].size(); ++i) here_[k](i) += length * change_[k](i);
  }

  // Which bounds there are, and which entries of their rows; value_change_ is what their values are
  // at the step in `program`.
  void read_rows(const Program& program) {
    sides_.clear();
    immovable_.clear();
    for (int k = 0; k <= program.horizon(); ++k) {
      const auto& n = program.node(k);
      NodeRowsRead& node = nodes_[static_cast<std::size_t>(k)];
      node.bounds = node.dense = node.columns = 0;
      std::array<bool, static_cast<std::size_t>(Program::width)> reached{};
      for (int i = 0; i < Rows; ++i) {
        const bool above = std::isfinite(n.upper(i)), below = std::isfinite(n.lower(i));
        if (!above && !below) continue;
        Vector& gradient = node.gradient[static_cast<std::size_t>(node.dense)];
        gradient = program.row_gradient(k, i);
        int entries = 0, last = 0;
        for (int j = 0; j < Program::width; ++j)
          if (gradient(j) != 0.0) {
            ++entries;
            last = j;
          }
        if (entries == 0) {
          immovable_.push_back({k, i});
          continue;
        }
        if (entries == 1) {
          const auto b = static_cast<std::size_t>(node.bounds++);
          node.bound[b] = i;
          node.entry[b] = last;
          node.square[b] = gradient(last) * gradient(last);
        } else {
          node.row[static_cast<std::size_t>(node.dense++)] = i;
          for (int j = 0; j < Program::width; ++j)
            if (gradient(j) != 0.0) reached[static_cast<std::size_t>(j)] = true;
        }
        for (const double sign : {1.0, -1.0}) {
          if (!(sign > 0.0 ? above : below)) continue;
          const Eigen::Index at = count();
          sides_.push_back({k, i, Rows * k + i, sign});
          price_(at) = n.price(i);
          softness_(at) = 1.0 / n.stiffness(i);
          value_change_(at) =
              sign > 0.0 ? n.predicted(i) - n.upper(i) : n.lower(i) - n.predicted(i);
        }
      }
      for (int j = 0; j < Program::width; ++j)
        if (reached[static_cast<std::size_t>(j)])
          node.column[static_cast<std::size_t>(node.columns++)] = j;
    }
  }

  // Of all bounds at here_.
  void set_values(const Program& program) {
    multiply_rows(program, here_);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[static_cast<std::size_t>(i)];
      const auto& n = program.node(side.k);
      const double value = n.value(side.row) + of_rows_(side.at);
      value_(i) = side.sign > 0.0 ? value - n.upper(side.row) : n.lower(side.row) - value;
    }
  }

  // By how much the program's step would be better than here_ if nothing were bounded; gradients_
  // are those of the cost there.
  [[nodiscard]] double to_gain(const Program& program) {
    double sum = 0.0;
    set_cost_gradients(program);
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (int k = 0; k <= program.horizon(); ++k) {
        const auto i = static_cast<std::size_t>(k);
        program.template cost_gradient<packet()>(k, program.step(k), damping_, gradients_[i]);
        for (int j = 0; j < Program::width; ++j)
          sum +=
              0.5 * (cost_gradients_[i](j) + gradients_[i](j)) * (here_[i](j) - program.step(k)(j));
      }
      return true;
    });
    return std::abs(sum);
  }

  void begin(Program& program, double gain, double far_above) {
    std::array<double, static_cast<std::size_t>(Rows)> unit{};  // how far a row moves at most
    for (Eigen::Index i = 0; i < count(); ++i) {
      double& u = unit[static_cast<std::size_t>(sides_[static_cast<std::size_t>(i)].row)];
      u = std::max({u, std::abs(value_change_(i) - value_(i)), value_(i)});
    }
    // What the cost pushes with at the program's step.
    (void)program.sweep_back(
        false, [&](auto, int k, Vector& g) { g = gradients_[static_cast<std::size_t>(k)]; },
        [&](int k, const Vector& sum, const Vector&) {
          gradients_[static_cast<std::size_t>(k)] = sum;
        });
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[static_cast<std::size_t>(i)];
      auto& n = program.node(side.k);
      if (!n.hard[static_cast<std::size_t>(side.row)]) continue;
      const Vector row = program.row_gradient(side.k, side.row);
      double push = 1.0 + gain / std::max(unit[static_cast<std::size_t>(side.row)], 1e-100);
      for (int j = 0; j < Program::width; ++j)
        if (row(j) != 0.0)
          push = std::max(push, std::abs(gradients_[static_cast<std::size_t>(side.k)](j) / row(j)));
      n.price(side.row) = n.stand_in(side.row) = price_(i) =
          std::min(far_above * push, Program::hard_price);
    }
    unit_ = unit;
    first_mu_ = restart_mu_ = std::max(10.0 * gain / static_cast<double>(count()), 1e-8);
    center(restart_mu_);
  }

  // Slacks and multipliers about as they should be at here_ for products of `mu`.
  void center(double mu) {
    for (Eigen::Index i = 0; i < count(); ++i) {
      Side& side = sides_[static_cast<std::size_t>(i)];
      const double u = unit_[static_cast<std::size_t>(side.row)];
      slack_(i) = std::max({-value_(i), value_(i), 0.1 * u, 1e-10});
      multiplier_(i) = std::min(mu / slack_(i), 0.1 * price_(i));
      excess_(i) = mu / (price_(i) - multiplier_(i));
      of_multiplier_(i) = 1.0;  // nothing holds
      of_rest_(i) = 0.0;
    }
    mu_ = mu;
  }

  // Calls body(width, i) for every packet of sides.
  template <typename Body>
  void for_sides(const Body& body) const {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      const Eigen::Index end = count();
      for (Eigen::Index i = 0; i < end; i += packet()) body(packet, i);
      return true;
    });
  }
  // The sum of what body(width, i, total) adds to `total`.
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
      return true;
    });
    return sum;
  }
  // The largest of two numbers of each side, at least `least` each: body(width, i, first, second).
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
      return true;
    });
    return most;
  }
  // The sum of all complementarity products.
  double set_weights() {
    // What fills up the last packet has no say.
    for (Eigen::Index i = count(); i < detail::padded(static_cast<int>(count())); ++i) {
      price_(i) = 2.0;
      multiplier_(i) = softness_(i) = value_(i) = value_change_(i) = 1.0;
      slack_(i) = excess_(i) = 1e-200;
      value_change_(i) = 0.0;
    }
    const double sum =
        sum_of_sides([&](auto packet, Eigen::Index i, auto& total) __attribute__((always_inline)) {
          constexpr int W = packet();
          using P = detail::Packet<W>;
          P l, t, s, rho, c;
          detail::load<W>(multiplier_.data() + i, l);
          detail::load<W>(slack_.data() + i, t);
          detail::load<W>(excess_.data() + i, s);
          detail::load<W>(price_.data() + i, rho);
          detail::load<W>(softness_.data() + i, c);
          const P rest = rho - l, per_l = 1.0 / l, per_rest = 1.0 / rest,
                  weight = 1.0 / (t * per_l + s * per_rest + c);
          detail::store<W>(per_multiplier_.data() + i, per_l);
          detail::store<W>(per_rest_.data() + i, per_rest);
          detail::store<W>(weight_.data() + i, weight);
          total += l * t + rest * s;
        });
    detail::fill(of_rows_, 0.0);
    for (Eigen::Index i = 0; i < count(); ++i)
      of_rows_(sides_[static_cast<std::size_t>(i)].at) += weight_(i);
    return sum;
  }

  template <int W>
  [[gnu::always_inline]] inline void add_weights(int k, double* hessian) const {
    constexpr int rows = Program::rows, packets = rows / W;
    const NodeRowsRead& node = nodes_[static_cast<std::size_t>(k)];
    const double* weights = of_rows_.data() + Rows * k;
    for (int b = 0; b < node.bounds; ++b) {
      const auto i = static_cast<std::size_t>(b);
      hessian[(rows + 1) * node.entry[i]] += weights[node.bound[i]] * node.square[i];
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

  // Rows times w, of every node.
  void multiply_rows(const Program& program, const std::vector<Vector>& w) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (int k = 0; k <= program.horizon(); ++k) {
        double* result = of_rows_.data() + Rows * k;
        std::fill(result, result + Rows, 0.0);
        program.template add_row_values<packet()>(k, w[static_cast<std::size_t>(k)], result);
      }
      return true;
    });
  }

  void set_cost_gradients(const Program& program) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (std::size_t k = 0; k < here_.size(); ++k)
        program.template cost_gradient<packet()>(static_cast<int>(k), here_[k], damping_,
                                                 cost_gradients_[k]);
      return true;
    });
  }

  // push_: the multipliers after a Newton step towards complementarity products of zero, if it
  // changed no value.
  void aim_at_solution() {
    for_sides([&](auto packet, Eigen::Index i) __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, v, c, weight;
      detail::load<W>(multiplier_.data() + i, l);
      detail::load<W>(value_.data() + i, v);
      detail::load<W>(softness_.data() + i, c);
      detail::load<W>(weight_.data() + i, weight);
      detail::store<W>(push_.data() + i, l + weight * (v - c * l));
    });
  }

  // The same towards products of `mu`, with a second-order correction by the last direction.
  void aim_at_center(double mu, double correction) {
    for_sides([&](auto packet, Eigen::Index i) __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, t, s, v, c, weight, per_l, per_rest, dl, dt, ds;
      detail::load<W>(multiplier_.data() + i, l);
      detail::load<W>(slack_.data() + i, t);
      detail::load<W>(excess_.data() + i, s);
      detail::load<W>(value_.data() + i, v);
      detail::load<W>(softness_.data() + i, c);
      detail::load<W>(weight_.data() + i, weight);
      detail::load<W>(per_multiplier_.data() + i, per_l);
      detail::load<W>(per_rest_.data() + i, per_rest);
      detail::load<W>(multiplier_change_.data() + i, dl);
      detail::load<W>(slack_change_.data() + i, dt);
      detail::load<W>(excess_change_.data() + i, ds);
      const P slack_aim = (mu - correction * dl * dt) * per_l - t,
              excess_aim = (mu + correction * dl * ds) * per_rest - s;
      detail::store<W>(slack_aim_.data() + i, slack_aim);
      detail::store<W>(excess_aim_.data() + i, excess_aim);
      detail::store<W>(push_.data() + i, l + weight * (v + t - s - c * l + slack_aim - excess_aim));
    });
  }

  // The step for these multipliers, and how it changes the values.
  void find_direction(Program& program) {
    detail::fill(of_rows_, 0.0);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[static_cast<std::size_t>(i)];
      of_rows_(side.at) += side.sign * push_(i);
    }
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      for (std::size_t k = 0; k < here_.size(); ++k) {
        gradients_[k] = cost_gradients_[k];
        program.template add_row_gradients<packet()>(
            static_cast<int>(k), of_rows_.data() + Rows * static_cast<Eigen::Index>(k),
            gradients_[k]);
      }
      return true;
    });
    program.riccati.solve(gradients_);
    std::fill_n(change_[0].data(), States, 0.0);
    program.riccati.sweep_change(change_);
    multiply_rows(program, change_);
    for (Eigen::Index i = 0; i < count(); ++i) {
      const Side& side = sides_[static_cast<std::size_t>(i)];
      value_change_(i) = side.sign * of_rows_(side.at);
    }
  }

  // Completes the direction towards the solution, and tells by it which bounds hold: there the
  // slack vanishes and the multiplier stays, at others it is the other way round (El-Bakry, Tapia &
  // Zhang 1994). Returns the sum of the products after the longest step along it.
  double predict() {
    const auto [most_primal, most_dual] = largest_of_sides(
        1.0, [&](auto packet, Eigen::Index i, auto& of_primal, auto& of_dual)
                 __attribute__((always_inline)) {
                   constexpr int W = packet();
                   using P = detail::Packet<W>;
                   P l, t, s, weight, per_l, per_rest, push, dv;
                   detail::load<W>(multiplier_.data() + i, l);
                   detail::load<W>(slack_.data() + i, t);
                   detail::load<W>(excess_.data() + i, s);
                   detail::load<W>(weight_.data() + i, weight);
                   detail::load<W>(per_multiplier_.data() + i, per_l);
                   detail::load<W>(per_rest_.data() + i, per_rest);
                   detail::load<W>(push_.data() + i, push);
                   detail::load<W>(value_change_.data() + i, dv);
                   const P dl = push - l + weight * dv, of_l = dl * per_l, of_rest = dl * per_rest;
                   detail::store<W>(multiplier_change_.data() + i, dl);
                   detail::store<W>(slack_change_.data() + i, -t - t * of_l);
                   detail::store<W>(excess_change_.data() + i, s * of_rest - s);
                   detail::store<W>(of_multiplier_.data() + i, -of_l);
                   detail::store<W>(of_rest_.data() + i, of_rest);
                   const P slacks = 1.0 + (of_l > -of_rest ? of_l : -of_rest),
                           multipliers = -of_l > of_rest ? -of_l : of_rest;
                   of_primal = slacks > of_primal ? slacks : of_primal;
                   of_dual = multipliers > of_dual ? multipliers : of_dual;
                 });
    const double primal = 1.0 / most_primal, dual = 1.0 / most_dual;
    return sum_of_sides([&](auto packet, Eigen::Index i,
                            auto& total) __attribute__((always_inline)) {
      constexpr int W = packet();
      using P = detail::Packet<W>;
      P l, t, s, rho, dl, dt, ds;
      detail::load<W>(multiplier_.data() + i, l);
      detail::load<W>(slack_.data() + i, t);
      detail::load<W>(excess_.data() + i, s);
      detail::load<W>(price_.data() + i, rho);
      detail::load<W>(multiplier_change_.data() + i, dl);
      detail::load<W>(slack_change_.data() + i, dt);
      detail::load<W>(excess_change_.data() + i, ds);
      const P after = l + dual * dl;
      total += after * (t + primal * dt) + (rho - after) * (s + primal * ds);
    });
  }

  struct Lengths {
    double primal, dual;
  };

  // Completes the direction towards the centre; most of the way along it to the nearest bound.
  [[nodiscard]] Lengths complete_direction() {
    const auto [most_primal, most_dual] = largest_of_sides(
        most_of_the_way, [&](auto packet, Eigen::Index i, auto& of_primal, auto& of_dual)
                             __attribute__((always_inline)) {
                               constexpr int W = packet();
                               using P = detail::Packet<W>;
                               P l, t, s, weight, per_l, per_rest, push, slack_aim, excess_aim, dv;
                               detail::load<W>(multiplier_.data() + i, l);
                               detail::load<W>(slack_.data() + i, t);
                               detail::load<W>(excess_.data() + i, s);
                               detail::load<W>(weight_.data() + i, weight);
                               detail::load<W>(per_multiplier_.data() + i, per_l);
                               detail::load<W>(per_rest_.data() + i, per_rest);
                               detail::load<W>(push_.data() + i, push);
                               detail::load<W>(slack_aim_.data() + i, slack_aim);
                               detail::load<W>(excess_aim_.data() + i, excess_aim);
                               detail::load<W>(value_change_.data() + i, dv);
                               const P dl = push - l + weight * dv, dt = slack_aim - t * per_l * dl,
                                       ds = excess_aim + s * per_rest * dl, of_t = dt / t,
                                       of_s = ds / s, of_l = dl * per_l, of_rest = dl * per_rest;
                               detail::store<W>(multiplier_change_.data() + i, dl);
                               detail::store<W>(slack_change_.data() + i, dt);
                               detail::store<W>(excess_change_.data() + i, ds);
                               const P slacks = of_t < of_s ? -of_t : -of_s,
                                       multipliers = -of_l > of_rest ? -of_l : of_rest;
                               of_primal = slacks > of_primal ? slacks : of_primal;
                               of_dual = multipliers > of_dual ? multipliers : of_dual;
                             });
    return {most_of_the_way / most_primal, most_of_the_way / most_dual};
  }

  // False, and nothing is done, if a number is not finite.
  [[nodiscard]] bool move(const Lengths& lengths) {
    const double primal = lengths.primal, dual = lengths.dual;
    if (!(largest(change_) * primal < infinity) || !(largest_change() * dual < infinity))
      return false;
    add_change(primal);
    const double sum =
        sum_of_sides([&](auto packet, Eigen::Index i, auto& total) __attribute__((always_inline)) {
          constexpr int W = packet();
          using P = detail::Packet<W>;
          P l, t, s, v, rho, change;
          detail::load<W>(price_.data() + i, rho);
          detail::load<W>(multiplier_.data() + i, l);
          detail::load<W>(multiplier_change_.data() + i, change);
          l += dual * change;
          detail::store<W>(multiplier_.data() + i, l);
          detail::load<W>(slack_.data() + i, t);
          detail::load<W>(slack_change_.data() + i, change);
          t += primal * change;
          detail::store<W>(slack_.data() + i, t);
          detail::load<W>(excess_.data() + i, s);
          detail::load<W>(excess_change_.data() + i, change);
          s += primal * change;
          detail::store<W>(excess_.data() + i, s);
          detail::load<W>(value_.data() + i, v);
          detail::load<W>(value_change_.data() + i, change);
          v += primal * change;
          detail::store<W>(value_.data() + i, v);
          total += l * t + (rho - l) * s;
        });
    mu_ = sum / (2.0 * static_cast<double>(count()));
    return true;
  }

  [[nodiscard]] double largest_change() const {
    double sum = 0.0;  // NaN if any is
    for (Eigen::Index i = 0; i < count(); ++i)
      sum += std::abs(multiplier_change_(i)) + std::abs(slack_change_(i)) +
             std::abs(excess_change_(i));
    return sum;
  }

  static constexpr double infinity = std::numeric_limits<double>::infinity();
  static constexpr double most_of_the_way = 0.99, short_step = 0.1;

  std::vector<NodeRowsRead> nodes_;
  std::vector<Side> sides_;
  std::vector<typename Program::ActiveRow> immovable_;  // bounded rows that no step changes
  std::vector<Vector> here_, change_, cost_gradients_, gradients_;
  Eigen::VectorXd of_rows_;  // a number of each row of each node
  // Of each side:
  Eigen::VectorXd price_, softness_, value_, multiplier_, slack_, excess_, weight_, per_multiplier_,
      per_rest_, push_, slack_aim_, excess_aim_, multiplier_change_, slack_change_, excess_change_,
      value_change_, of_multiplier_, of_rest_;
  double damping_ = 0.0, mu_ = 0.0, first_mu_ = 0.0, restart_mu_ = 0.0;
  int stuck_ = 0;
  std::array<double, static_cast<std::size_t>(Rows)> unit_{};
};

}  // namespace tilt_ropter
