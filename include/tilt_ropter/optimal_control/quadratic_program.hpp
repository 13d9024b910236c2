#pragma once

#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/optimal_control/multipliers.hpp>
#include <tilt_ropter/optimal_control/riccati.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <utility>
#include <vector>

/// The quadratic program of one SQP step: the linear-quadratic problem of Riccati with two-sided
/// rows lower <= value + C dx + E du <= upper at every node, each with a price for violating it.
namespace tilt_ropter {

/// Limits and tolerances of one SQP step.
struct QuadraticProgramSettings {
  double row_tolerance = 1e-9;  ///< violation that makes a row join the working set
  int max_active_rows = 0;      ///< room of the working set; 0: 150, or 3 per node if that is more
  int max_rounds = 20;          ///< of adding rows
  double sigma = 1e12;          ///< quadratic part of the penalty on violated rows
  DualSettings dual;
};

inline void validate(const QuadraticProgramSettings& s) {
  require_positive("QuadraticProgramSettings.row_tolerance", s.row_tolerance);
  require(s.max_active_rows >= 0, "QuadraticProgramSettings.max_active_rows", s.max_active_rows,
          ">= 0");
  require(s.max_rounds > 0, "QuadraticProgramSettings.max_rounds", s.max_rounds, "> 0");
  require_positive("QuadraticProgramSettings.sigma", s.sigma);
  validate(s.dual);
}

/// Rows of one node.
template <int States, int Inputs, int Rows>
struct NodeRows {
  using Values = Eigen::Matrix<double, Rows, 1>;
  Values value = Values::Zero();  ///< at the point of linearisation
  Eigen::Matrix<double, Rows, States> C = Eigen::Matrix<double, Rows, States>::Zero();
  Eigen::Matrix<double, Rows, Inputs> E = Eigen::Matrix<double, Rows, Inputs>::Zero();
  Values lower = Values::Zero(), upper = Values::Zero();  ///< infinite: no bound
  Values penalty = Values::Zero();  ///< L1 price of a violation: bound on the multiplier
  /// In: warm start. Out: solution. > 0 at the upper bound, < 0 at the lower.
  Values multiplier = Values::Zero();
  Values predicted = Values::Zero();  ///< value + C dx + E du at the solution
};

/// Solves by the dual of the rows that matter (the working set): a row's gradient with respect to
/// the coordinates z of Riccati comes from one adjoint sweep, all rows in one batch; NLopt solves
/// for the multipliers; a forward sweep shows which rows the solution violates; they join, and so
/// on. The rows that had a multiplier last time are the first working set, and their gradients need
/// no measurement: they are prepare()'s.
template <int States, int Inputs, int Rows, typename Blocks = FullTransition<States, Inputs>>
class QuadraticProgram {
 public:
  using Tangent = Eigen::Matrix<double, States, 1>;
  using Input = Eigen::Matrix<double, Inputs, 1>;
  using Values = Eigen::Matrix<double, Rows, 1>;
  using Node = NodeRows<States, Inputs, Rows>;

  /// Allocates everything for `horizon` intervals; settings must be valid.
  QuadraticProgram(int horizon, const QuadraticProgramSettings& settings)
      : settings_(settings),
        horizon_(horizon),
        riccati_(horizon),
        nodes_(static_cast<std::size_t>(horizon) + 1),
        dx_(nodes_.size(), Tangent::Zero()),
        du_(nodes_.size(), Input::Zero()),
        in_set_(nodes_.size()),
        capacity_(capacity(settings.max_active_rows, horizon)),
        dual_(capacity_, settings.dual),
        gradients_(capacity_, Inputs * horizon),
        gram_(capacity_, capacity_),
        offsets_(capacity_),
        bounds_(capacity_),
        multipliers_(capacity_),
        z_(Eigen::VectorXd::Zero(Inputs * horizon)) {
    active_.reserve(static_cast<std::size_t>(capacity_));
    const int room = (capacity_ + batch_rows - 1) / batch_rows * batch_rows;
    for (Batch& batch : adjoints_) batch.setZero(room, States + Inputs);
  }

  [[nodiscard]] RiccatiStage<States, Inputs>& stage(int k) { return riccati_.stage(k); }
  [[nodiscard]] const RiccatiStage<States, Inputs>& stage(int k) const { return riccati_.stage(k); }
  [[nodiscard]] Node& node(int k) { return nodes_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Node& node(int k) const { return nodes_[static_cast<std::size_t>(k)]; }

  /// Factorises the stages, with `damping` added to their Hessians' diagonals. False if the cost
  /// has no minimum.
  [[nodiscard]] bool factorise(double damping = 0.0) {
    damping_ = damping;
    return riccati_.factorise(damping);
  }
  [[nodiscard]] double damping() const { return damping_; }  ///< of the last factorisation

  /// The first working set and its gradients; after factorise().
  void prepare() {
    active_.clear();
    for (int k = horizon_; k >= 0; --k)
      for (int i = 0; i < Rows; ++i) {
        const double m = node(k).multiplier(i);
        if (m == 0.0 || size() == capacity_) continue;
        if (!std::isfinite(m > 0.0 ? node(k).upper(i) : node(k).lower(i))) continue;  // gone now
        multipliers_(size()) = std::abs(m);
        active_.push_back({k, i, m > 0.0 ? 1.0 : -1.0});
      }
    add_gradients(0);
  }

  /// The step dx(k), du(k) and multipliers for the initial step dx0; after prepare(). False if no
  /// finite solution was found, or none before `deadline`. The multipliers of the last solve stay
  /// then.
  [[nodiscard]] bool solve(const Tangent& dx0,
                           std::optional<SolverClock::time_point> deadline = {}) {
    z_.setZero();
    sweep(dx0);
    for (int i = 0; i < size(); ++i) offsets_(i) = violation(row(i));
    for (rounds_ = 1;; ++rounds_) {
      const int count = size();
      if (count > 0) {
        auto lambda = multipliers_.head(count);
        if (!dual_.solve(gram_.topLeftCorner(count, count), offsets_.head(count),
                         bounds_.head(count), lambda, deadline))
          return false;
        z_.setZero();  // a minus sign before the product would make a temporary
        z_.noalias() -= gradients_.topRows(count).transpose() * lambda;
        sweep(dx0);
      }
      if (rounds_ > settings_.max_rounds || !add_violated_rows()) break;
    }
    for (int k = 0; k <= horizon_; ++k)
      if (!all_finite(dx(k)) || !all_finite(du(k))) return false;
    store_multipliers();
    return true;
  }

  [[nodiscard]] const Tangent& dx(int k) const { return dx_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Input& du(int k) const { return du_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] bool late() const { return dual_.late(); }            ///< the deadline has passed
  [[nodiscard]] int rounds() const { return rounds_; }                ///< of the last solve
  [[nodiscard]] int active_rows() const { return active_rows_; }      ///< rows with a multiplier
  [[nodiscard]] int given_up_rows() const { return given_up_rows_; }  ///< with the largest possible
  [[nodiscard]] int left_out_rows() const {
    return left_out_rows_;
  }  ///< violated, and found no room

 private:
  /// A row of the working set: component of node k, at its upper (+1) or lower (-1) bound.
  struct Row {
    int k, component;
    double side;
    [[nodiscard]] std::size_t slot() const {
      return static_cast<std::size_t>(side > 0.0 ? Rows + component : component);
    }
  };

  using Batch = typename Riccati<States, Inputs, Blocks>::Batch;

  static int capacity(int asked, int horizon) {
    const int automatic = std::max(150, 3 * (horizon + 1));
    return std::min(asked > 0 ? asked : automatic, 2 * Rows * (horizon + 1));
  }
  [[nodiscard]] int size() const { return static_cast<int>(active_.size()); }
  [[nodiscard]] const Row& row(int i) const { return active_[static_cast<std::size_t>(i)]; }

  /// Gradients by z of the rows from `first` on, which are ordered by falling node, by one adjoint
  /// sweep for all of them, and their part of G G'.
  void add_gradients(int first) {
    const int last = size();
    if (first == last) return;
    gradients_.middleRows(first, last - first).setZero();
    Batch *after = &adjoints_[0], *here = &adjoints_[1];
    int count = 0;  // rows whose node has been reached
    for (int k = row(first).k; k >= 0; --k) {
      if (count > 0) riccati_.step_back(k, *after, *here, count);
      for (; first + count < last && row(first + count).k == k; ++count) {
        const Row& r = row(first + count);
        here->row(count) << r.side * node(k).E.row(r.component),
            r.side * node(k).C.row(r.component);
        bounds_(first + count) = node(k).penalty(r.component);
      }
      if (k < horizon_) {
        riccati_.to_coordinates(k, *here, count);
        gradients_.block(first, Inputs * k, count, Inputs) = here->topLeftCorner(count, Inputs);
      }
      std::swap(after, here);
    }
    add_gram(first);
  }

  /// Rows from `first` on of G G', in pieces that Eigen packs on the stack. The gradient of a row
  /// is zero after its node, and rows are ordered by falling node.
  void add_gram(int first) {
    constexpr int depth = std::max(1, 24 / Inputs), width = 512;
    const int last = size();
    gram_.block(first, 0, last - first, last).setZero();
    int count = last - first;
    for (int k = 0; k < horizon_; k += depth) {
      while (count > 0 && row(first + count - 1).k < k) --count;
      const int entries = Inputs * std::min(depth, horizon_ - k);
      for (int i = first; i < first + count; i += width)
        for (int j = 0; j < last; j += width) {
          const int rows = std::min(width, first + count - i), columns = std::min(width, last - j);
          gram_.block(i, j, rows, columns).noalias() +=
              gradients_.block(i, Inputs * k, rows, entries) *
              gradients_.block(j, Inputs * k, columns, entries).transpose();
        }
    }
    gram_.diagonal().segment(first, last - first).array() += 1.0 / settings_.sigma;
  }

  /// Linear-quadratic prediction for z.
  void sweep(const Tangent& dx0) {
    dx_[0] = dx0;
    for (int k = 0; k <= horizon_; ++k) {
      const auto i = static_cast<std::size_t>(k);
      Node& n = nodes_[i];
      n.predicted = n.value;
      n.predicted.noalias() += n.C * dx_[i];
      if (k == horizon_) break;
      const auto& s = riccati_.stage(k);
      du_[i] = riccati_.input_step(k, dx_[i], z_.template segment<Inputs>(Inputs * k));
      n.predicted.noalias() += n.E * du_[i];
      dx_[i + 1] = s.defect;
      dx_[i + 1].noalias() += s.A * dx_[i];
      dx_[i + 1].noalias() += s.B * du_[i];
    }
  }

  [[nodiscard]] double violation(const Row& r) const {
    const Node& n = node(r.k);
    return r.side > 0.0 ? n.predicted(r.component) - n.upper(r.component)
                        : n.lower(r.component) - n.predicted(r.component);
  }

  /// Rows that the prediction violates join the working set. False if there were none.
  bool add_violated_rows() {
    const int first = size();
    left_out_rows_ = 0;
    for (auto& flags : in_set_) flags.fill(false);
    for (const Row& r : active_) in_set_[static_cast<std::size_t>(r.k)][r.slot()] = true;
    for (int k = horizon_; k >= 0; --k) {
      const Node& n = node(k);
      const Values over = n.predicted - n.upper, under = n.lower - n.predicted;
      for (int i = 0; i < Rows; ++i) {
        if (std::max(over(i), under(i)) <= settings_.row_tolerance) continue;
        const Row r{k, i, over(i) > under(i) ? 1.0 : -1.0};
        if (in_set_[static_cast<std::size_t>(k)][r.slot()]) continue;
        if (size() < capacity_)
          active_.push_back(r);
        else
          ++left_out_rows_;
      }
    }
    const int last = size();
    if (first == last) return false;
    add_gradients(first);
    for (int i = first; i < last; ++i) {
      multipliers_(i) = 0.0;
      // The row's value without any multiplier: its value now less what z contributes.
      offsets_(i) = violation(row(i)) - gradients_.row(i).dot(z_);
    }
    return true;
  }

  void store_multipliers() {
    for (Node& n : nodes_) n.multiplier.setZero();
    active_rows_ = given_up_rows_ = 0;
    for (int i = 0; i < size(); ++i) {
      if (!(multipliers_(i) > 0.0)) continue;
      const Row& r = row(i);
      node(r.k).multiplier(r.component) += r.side * multipliers_(i);
      ++active_rows_;
      if (multipliers_(i) >= bounds_(i)) ++given_up_rows_;
    }
  }

  QuadraticProgramSettings settings_;
  int horizon_;
  Riccati<States, Inputs, Blocks> riccati_;
  std::vector<Node> nodes_;
  std::vector<Tangent> dx_;
  std::vector<Input> du_;
  std::vector<std::array<bool, 2 * static_cast<std::size_t>(Rows)>> in_set_;
  int capacity_;
  DualSolver<> dual_;
  std::vector<Row> active_;
  Eigen::MatrixXd gradients_;  // row i: gradient of row i by z
  std::array<Batch, 2> adjoints_;
  Eigen::MatrixXd gram_;
  Eigen::VectorXd offsets_, bounds_, multipliers_, z_;
  double damping_ = 0.0;
  int rounds_ = 0, active_rows_ = 0, given_up_rows_ = 0, left_out_rows_ = 0;
};

}  // namespace tilt_ropter
