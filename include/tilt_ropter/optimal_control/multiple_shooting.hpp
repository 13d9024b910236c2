#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/multipliers.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/riccati.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

/// Sequential quadratic programming on a multiple-shooting problem (Bock & Plitt 1984) with a
/// Gauss-Newton Hessian, in five steps: linearise, factorise, multipliers, elastic rows, step.
/// One pass is the real-time iteration (Diehl, Bock & Schlöder 2005), split in prepare(), before
/// the measurement comes, and feedback(), after it.
namespace tilt_ropter {

enum class SolveStatus {
  converged,        ///< the KKT residual is below the tolerance
  iterated,         ///< a real-time iteration was done as asked
  iteration_limit,  ///< the last iterate is kept
  time_limit,       ///< the last iterate is kept
  failed,           ///< a non-finite number or no factorisation; the iterate before it is kept
  rejected,         ///< the initial state is not finite; nothing was changed
};

struct SolverSettings {
  int max_iterations = 50;         ///< of solve()
  double max_time = 1.0;           ///< of solve(), looked at between iterations [s]
  double tolerance = 1e-6;         ///< on the KKT residual, for solve()
  double row_tolerance = 1e-9;     ///< violation that makes a row join the working set
  int max_active_rows = 150;       ///< room of the working set
  int max_rounds = 8;              ///< of adding rows within one quadratic program
  double sigma = 1e9;              ///< quadratic part of the penalty on violated rows
  double max_multiplier = 1e6;     ///< bound on an equality's multiplier
  bool update_multipliers = true;  ///< of equalities, in solve(): conditions met exactly, not only
                                   ///< by weight; feedback() never does, as noise would pile up
  DualSettings dual;
};

inline void validate(const SolverSettings& s) {
  require(s.max_iterations > 0, "SolverSettings.max_iterations", s.max_iterations, "> 0");
  require_positive("SolverSettings.max_time [s]", s.max_time);
  require_positive("SolverSettings.tolerance", s.tolerance);
  require_positive("SolverSettings.row_tolerance", s.row_tolerance);
  require(s.max_active_rows > 0, "SolverSettings.max_active_rows", s.max_active_rows, "> 0");
  require(s.max_rounds > 0, "SolverSettings.max_rounds", s.max_rounds, "> 0");
  require_positive("SolverSettings.sigma", s.sigma);
  require_non_negative("SolverSettings.max_multiplier", s.max_multiplier);
  require(s.dual.max_evaluations > 0, "DualSettings.max_evaluations", s.dual.max_evaluations,
          "> 0");
  require_positive("DualSettings.tolerance", s.dual.tolerance);
}

/// What a solve reports. The KKT residual, violation, defect and cost are those of the iterate that
/// was linearised last: the returned one for solve(), the one before the step for feedback().
struct SolveReport {
  SolveStatus status = SolveStatus::failed;
  double cost = 0.0;
  double kkt = 0.0;            ///< largest of stationarity, defect, violation, complementarity
  double max_defect = 0.0;     ///< of continuity, in tangent coordinates
  double max_violation = 0.0;  ///< of rows
  double max_equality = 0.0;   ///< of equalities with a weight
  int iterations = 0;
  int active_rows = 0;    ///< rows with a multiplier in the last quadratic program
  int given_up_rows = 0;  ///< of these, rows at their penalty: violated on purpose
  int rounds = 0;         ///< of the working set in the last quadratic program
  double prepare_us = 0.0, feedback_us = 0.0;  ///< wall time of the two phases [us]
  double linearise_us = 0.0, factorise_us = 0.0, rows_us = 0.0, dual_us = 0.0;  ///< their parts
};

template <typename Problem>
class MultipleShooting {
 public:
  using Dimensions = ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Tangent = typename Dimensions::Tangent;
  using Input = typename Dimensions::Input;
  using Rows = typename Dimensions::Rows;
  static constexpr int nx = Dimensions::nx, nu = Dimensions::nu, nc = Dimensions::nc,
                       ne = Dimensions::ne;

  /// Allocates everything; the loop functions below allocate nothing outside NLopt. Throws
  /// std::invalid_argument for settings out of range or a horizon below 1.
  explicit MultipleShooting(Problem problem, const SolverSettings& settings = {})
      : problem_(std::move(problem)),
        settings_(checked(settings)),
        horizon_(checked_horizon(problem_.horizon())),
        riccati_(horizon_),
        nodes_(static_cast<std::size_t>(horizon_) + 1),
        trial_(nodes_.size()),
        capacity_(std::min(settings.max_active_rows, nc * (horizon_ + 1))),
        dual_(capacity_, settings.dual),
        active_(),
        gradients_(nu * horizon_, capacity_),
        adjoints_(nx, capacity_),
        products_(nx + nu, capacity_),
        gram_(capacity_, capacity_),
        offsets_(capacity_),
        bounds_(capacity_),
        multipliers_(capacity_),
        z_(Eigen::VectorXd::Zero(nu * horizon_)) {
    active_.reserve(static_cast<std::size_t>(capacity_));
  }

  [[nodiscard]] Problem& problem() { return problem_; }
  [[nodiscard]] const Problem& problem() const { return problem_; }
  [[nodiscard]] int horizon() const { return horizon_; }
  [[nodiscard]] const State& state(int k) const { return node(k).x; }
  [[nodiscard]] const Input& input(int k) const { return node(k).u; }
  /// Multipliers of the rows of node k: > 0 at the upper bound, < 0 at the lower.
  [[nodiscard]] const Rows& row_multipliers(int k) const { return node(k).multiplier; }

  /// Cold start: every state x0, every input zero, no multipliers.
  void reset(const State& x0) {
    for (Node& n : nodes_) {
      n.x = x0;
      n.u.setZero();
      n.multiplier.setZero();
      n.equality_multiplier.setZero();
    }
  }

  /// Guess of the states and inputs at node k (the input of the last node means nothing).
  void set_guess(int k, const State& x, const Input& u) {
    node(k).x = x;
    node(k).u = u;
  }

  /// Steps 1 and 2 and the working set's gradients: all that needs no measurement. False if the
  /// problem returned a non-finite number or has no unique minimum.
  [[nodiscard]] bool prepare() noexcept {
    const auto start = Clock::now();
    report_.linearise_us = report_.factorise_us = report_.rows_us = report_.dual_us = 0.0;
    prepared_ = linearise();
    report_.linearise_us = since(start);
    const auto linearised = Clock::now();
    prepared_ = prepared_ && riccati_.factorise();
    report_.factorise_us = since(linearised);
    const auto factorised = Clock::now();
    if (prepared_) {
      select_last_active_rows();
      add_gradients(0);
    }
    report_.rows_us = since(factorised);
    report_.prepare_us = since(start);
    return prepared_;
  }

  /// Step 3 to 5 from the measured initial state; needs a prepare() before. Afterwards state(k) and
  /// input(k) are the new plan, or the old one if the report says failed or rejected.
  const SolveReport& feedback(const State& x0) noexcept { return take_step(x0, false); }

  /// Iterates to convergence from the current guess with the initial state fixed to x0.
  const SolveReport& solve(const State& x0) noexcept {
    const auto start = Clock::now();
    double prepare_us = 0.0, feedback_us = 0.0;
    int iteration = 0;
    SolveStatus status = SolveStatus::iteration_limit;
    if (!problem_.difference(x0, node(0).x).allFinite()) {
      report_.status = SolveStatus::rejected;
      return report_;
    }
    node(0).x = x0;
    for (;; ++iteration) {
      if (!prepare()) {
        status = SolveStatus::failed;
        break;
      }
      prepare_us += report_.prepare_us;
      if (settings_.update_multipliers) report_.kkt = std::max(report_.kkt, report_.max_equality);
      if (report_.kkt <= settings_.tolerance) {
        status = SolveStatus::converged;
        break;
      }
      if (iteration == settings_.max_iterations) break;
      if (since(start) > 1e6 * settings_.max_time) {
        status = SolveStatus::time_limit;
        break;
      }
      take_step(x0, settings_.update_multipliers);
      feedback_us += report_.feedback_us;
      if (report_.status != SolveStatus::iterated) {
        status = report_.status;
        break;
      }
    }
    report_.status = status;
    report_.iterations = iteration;
    report_.prepare_us = prepare_us;
    report_.feedback_us = feedback_us;
    return report_;
  }

  [[nodiscard]] const SolveReport& report() const { return report_; }

 private:
  using Clock = std::chrono::steady_clock;

  struct Node {
    State x{};
    Input u = Input::Zero();
    Rows multiplier = Rows::Zero();
    typename Dimensions::Equalities equality_multiplier = Dimensions::Equalities::Zero();
    Rows value = Rows::Zero();  // of the rows at (x, u)
    typename Dimensions::RowsX C = Dimensions::RowsX::Zero();
    typename Dimensions::RowsU E = Dimensions::RowsU::Zero();
    std::array<bool, 2 * static_cast<std::size_t>(nc)>
        in_set{};  // working set: lower bounds first, then upper
  };
  struct Trial {
    State x{};
    Input u = Input::Zero();
    Tangent dx = Tangent::Zero();
    Input du = Input::Zero();
    Rows value = Rows::Zero();
  };
  /// A row of the working set: component of node k, at its upper (+1) or lower (-1) bound.
  struct Row {
    int k, component;
    double side;
    [[nodiscard]] std::size_t slot() const {
      return static_cast<std::size_t>(side > 0.0 ? nc + component : component);
    }
  };

  static const SolverSettings& checked(const SolverSettings& settings) {
    validate(settings);
    return settings;
  }
  static int checked_horizon(int horizon) {
    require(horizon >= 1, "Problem.horizon()", horizon, ">= 1");
    return horizon;
  }
  static double since(Clock::time_point start) {
    return std::chrono::duration<double, std::micro>(Clock::now() - start).count();
  }

  Node& node(int k) { return nodes_[static_cast<std::size_t>(k)]; }
  const Node& node(int k) const { return nodes_[static_cast<std::size_t>(k)]; }
  Trial& trial(int k) { return trial_[static_cast<std::size_t>(k)]; }

  const SolveReport& take_step(const State& x0, bool update_multipliers) {
    const auto start = Clock::now();
    report_.iterations = 1;
    const Tangent dx0 = problem_.difference(x0, node(0).x);
    if (!dx0.allFinite()) {
      report_.status = SolveStatus::rejected;
    } else if (!prepared_ || !solve_quadratic_program(dx0)) {
      report_.status = SolveStatus::failed;
    } else {
      report_.kkt = std::max(report_.kkt, dx0.cwiseAbs().maxCoeff());
      for (int k = 0; k <= horizon_; ++k) {
        node(k).x = trial(k).x;
        node(k).u = trial(k).u;
      }
      store_multipliers();
      if (update_multipliers) update_equality_multipliers();
      report_.status = SolveStatus::iterated;
    }
    prepared_ = false;
    report_.feedback_us = since(start);
    return report_;
  }

  // Step 1: every interval's end state and derivative, every node's quadratic model and rows.
  bool linearise() {
    report_.cost = report_.max_defect = report_.max_violation = report_.max_equality = 0.0;
    for (int k = 0; k <= horizon_; ++k) {
      Node& n = node(k);
      auto& s = riccati_.stage(k);
      if (k < horizon_) {
        s.defect = problem_.difference(problem_.step(k, n.x, n.u, s.A, s.B), node(k + 1).x);
        report_.max_defect = std::max(report_.max_defect, s.defect.cwiseAbs().maxCoeff());
      }
      problem_.cost_model(k, n.x, n.u, s.cost);
      report_.cost += problem_.cost(k, n.x, n.u);
      if constexpr (ne > 0) add_equalities(k);
      n.value = problem_.row_values(k, n.x, n.u);
      problem_.row_derivatives(k, n.x, n.u, n.C, n.E);
      report_.max_violation =
          std::max(report_.max_violation, (n.value - problem_.upper(k)).maxCoeff());
      report_.max_violation =
          std::max(report_.max_violation, (problem_.lower(k) - n.value).maxCoeff());
    }
    report_.kkt = kkt_residual();
    return std::isfinite(report_.kkt) && std::isfinite(report_.cost);
  }

  // Augmented Lagrangian of the equalities, in the quadratic model: as rows of the dual they would
  // cost ten times more.
  void add_equalities(int k) {
    Node& n = node(k);
    auto& model = riccati_.stage(k).cost;
    const auto weights = problem_.equality_weights(k);
    if (k == 0 || !(weights.maxCoeff() > 0.0)) return;
    const auto h = problem_.equality_values(k, n.x);
    typename Dimensions::EqualitiesX H;
    problem_.equality_derivatives(k, n.x, H);
    for (int i = 0; i < ne; ++i) {
      if (!(weights(i) > 0.0)) continue;
      report_.max_equality = std::max(report_.max_equality, std::abs(h(i)));
      model.lx += (weights(i) * h(i) + n.equality_multiplier(i)) * H.row(i).transpose();
      model.lxx += weights(i) * H.row(i).transpose() * H.row(i);
    }
  }

  // Largest violation of the first-order conditions at the iterate with the current multipliers;
  // the multipliers of continuity follow from the adjoint recursion, so only the input's
  // stationarity remains.
  double kkt_residual() const {
    double residual = report_.max_defect;
    Tangent adjoint = riccati_.stage(horizon_).cost.lx;
    adjoint.noalias() += node(horizon_).C.transpose() * node(horizon_).multiplier;
    for (int k = horizon_; k >= 0; --k) {
      const Node& n = node(k);
      if (k < horizon_) {
        const auto& s = riccati_.stage(k);
        Input stationarity = s.cost.lu;
        stationarity.noalias() += s.B.transpose() * adjoint;
        stationarity.noalias() += n.E.transpose() * n.multiplier;
        residual = std::max(residual, stationarity.cwiseAbs().maxCoeff());
        Tangent next = s.cost.lx;
        next.noalias() += s.A.transpose() * adjoint;
        next.noalias() += n.C.transpose() * n.multiplier;
        adjoint = next;
      }
      const Rows& lower = problem_.lower(k);
      const Rows& upper = problem_.upper(k);
      const Rows& penalty = problem_.penalty(k);
      for (int i = 0; i < nc; ++i) {
        const double m = n.multiplier(i);
        const double over = n.value(i) - upper(i), under = lower(i) - n.value(i);
        if (std::abs(m) < penalty(i)) residual = std::max(residual, std::max(over, under));
        if (m > 0.0) residual = std::max(residual, std::min(m, -over));
        if (m < 0.0) residual = std::max(residual, std::min(-m, -under));
      }
    }
    return residual;
  }

  // Step 3, first half: the rows that had a multiplier last time.
  void select_last_active_rows() {
    active_.clear();
    for (int k = horizon_; k >= 0; --k)
      for (int i = 0; i < nc; ++i) {
        const double m = node(k).multiplier(i);
        if (m == 0.0 || static_cast<int>(active_.size()) == capacity_) continue;
        multipliers_(static_cast<Eigen::Index>(active_.size())) = std::abs(m);
        active_.push_back({k, i, m > 0.0 ? 1.0 : -1.0});
      }
  }

  // Gradients by z of the rows from `first` on, which are ordered by falling node, by one adjoint
  // sweep for all of them, and their part of G G'.
  void add_gradients(int first) {
    const int last = static_cast<int>(active_.size());
    if (first == last) return;
    int count = 0;  // rows whose node has been passed
    for (int k = active_[static_cast<std::size_t>(first)].k; k >= 0; --k) {
      if (k < horizon_) {
        const auto& s = riccati_.stage(k);
        if (count > 0) {
          products_.leftCols(count).noalias() = s.adjoint * adjoints_.leftCols(count);
          gradients_.block(nu * k, first, nu, count) = products_.bottomLeftCorner(nu, count);
          adjoints_.leftCols(count) = products_.topLeftCorner(nx, count);
        }
      }
      while (first + count < last && active_[static_cast<std::size_t>(first + count)].k == k) {
        const Row& row = active_[static_cast<std::size_t>(first + count)];
        const Node& n = node(k);
        auto adjoint = adjoints_.col(count);
        auto gradient = gradients_.col(first + count);
        gradient.setZero();
        adjoint = row.side * n.C.row(row.component).transpose();
        if (k < horizon_) {
          const auto& s = riccati_.stage(k);
          Input g = row.side * n.E.row(row.component).transpose();
          if (!g.isZero(0.0)) {
            s.L.template triangularView<Eigen::Lower>().solveInPlace(g);
            gradient.template segment<nu>(nu * k) = g;
            adjoint.noalias() -= s.Y.transpose() * g;
          }
        }
        bounds_(first + count) = problem_.penalty(k)(row.component);
        ++count;
      }
    }
    gram_.block(first, 0, last - first, last).noalias() =
        gradients_.middleCols(first, last - first).transpose() * gradients_.leftCols(last);
    gram_.diagonal().segment(first, last - first).array() += 1.0 / settings_.sigma;
  }

  // Linear-quadratic prediction for z; fills the trial steps and row values.
  void sweep(const Tangent& dx0) {
    trial(0).dx = dx0;
    for (int k = 0; k <= horizon_; ++k) {
      Trial& t = trial(k);
      const Node& n = node(k);
      t.value = n.value;
      t.value.noalias() += n.C * t.dx;
      if (k == horizon_) break;
      const auto& s = riccati_.stage(k);
      t.du = riccati_.input_step(k, t.dx, z_.template segment<nu>(nu * k));
      t.value.noalias() += n.E * t.du;
      Tangent& next = trial(k + 1).dx;
      next = s.defect;
      next.noalias() += s.A * t.dx;
      next.noalias() += s.B * t.du;
    }
  }

  double violation(const Row& row) const {
    const double value = trial_[static_cast<std::size_t>(row.k)].value(row.component);
    return row.side > 0.0 ? value - problem_.upper(row.k)(row.component)
                          : problem_.lower(row.k)(row.component) - value;
  }

  // Step 3 and 4: multipliers by NLopt on the working set, which grows by the rows that the
  // solution violates.
  bool solve_quadratic_program(const Tangent& dx0) {
    z_.setZero();
    sweep(dx0);
    int size = static_cast<int>(active_.size());
    for (int i = 0; i < size; ++i) offsets_(i) = violation(active_[static_cast<std::size_t>(i)]);
    report_.rounds = 0;
    for (int round = 0; round < settings_.max_rounds; ++round) {
      const auto start = Clock::now();
      if (size > 0) {
        auto lambda = multipliers_.head(size);
        if (!dual_.solve(gram_.topLeftCorner(size, size), offsets_.head(size), bounds_.head(size),
                         lambda))
          return false;
        z_.noalias() = -(gradients_.leftCols(size) * lambda);
        report_.dual_us += since(start);
        sweep(dx0);
      }
      const auto solved = Clock::now();
      report_.rounds = round + 1;
      if (!add_violated_rows()) break;
      size = static_cast<int>(active_.size());
      report_.rows_us += since(solved);
    }
    for (int k = 0; k <= horizon_; ++k) {
      Trial& t = trial(k);
      if (!t.dx.allFinite() || !t.du.allFinite()) return false;
      t.x = problem_.retract(node(k).x, t.dx);
      t.u = node(k).u;
      if (k < horizon_) t.u += t.du;
    }
    return true;
  }

  // Rows that the prediction violates join the working set. False if there were none.
  bool add_violated_rows() {
    const int first = static_cast<int>(active_.size());
    for (Node& n : nodes_) n.in_set.fill(false);
    for (const Row& row : active_) node(row.k).in_set[row.slot()] = true;
    for (int k = horizon_; k >= 0; --k) {
      const Rows over = trial(k).value - problem_.upper(k);
      const Rows under = problem_.lower(k) - trial(k).value;
      for (int i = 0; i < nc; ++i) {
        const Row row{k, i, over(i) > under(i) ? 1.0 : -1.0};
        if (std::max(over(i), under(i)) <= settings_.row_tolerance) continue;
        if (node(k).in_set[row.slot()] || static_cast<int>(active_.size()) == capacity_) continue;
        active_.push_back(row);
      }
    }
    const int last = static_cast<int>(active_.size());
    if (first == last) return false;
    add_gradients(first);
    for (int i = first; i < last; ++i) {
      const Row& row = active_[static_cast<std::size_t>(i)];
      multipliers_(i) = 0.0;
      // The row's value without any multiplier: its value now less what z contributes.
      offsets_(i) = violation(row) - gradients_.col(i).dot(z_);
    }
    return true;
  }

  void store_multipliers() {
    for (Node& n : nodes_) n.multiplier.setZero();
    report_.active_rows = report_.given_up_rows = 0;
    for (int i = 0; i < static_cast<int>(active_.size()); ++i) {
      if (!(multipliers_(i) > 0.0)) continue;
      const Row& row = active_[static_cast<std::size_t>(i)];
      node(row.k).multiplier(row.component) += row.side * multipliers_(i);
      ++report_.active_rows;
      if (multipliers_(i) >= bounds_(i)) ++report_.given_up_rows;
    }
  }

  void update_equality_multipliers() {
    if constexpr (ne > 0) {
      for (int k = 1; k <= horizon_; ++k) {
        const auto weights = problem_.equality_weights(k);
        const auto h = problem_.equality_values(k, node(k).x);
        for (int i = 0; i < ne; ++i) {
          double& m = node(k).equality_multiplier(i);
          m = weights(i) > 0.0 ? m + weights(i) * h(i) : 0.0;
          m = std::min(std::max(m, -settings_.max_multiplier), settings_.max_multiplier);
        }
      }
    }
  }

  Problem problem_;
  SolverSettings settings_;
  int horizon_;
  Riccati<nx, nu> riccati_;
  std::vector<Node> nodes_;
  std::vector<Trial> trial_;
  int capacity_;
  DualSolver dual_;
  std::vector<Row> active_;
  Eigen::MatrixXd gradients_;  // column i: gradient of row i by z
  Eigen::MatrixXd adjoints_, products_;
  Eigen::MatrixXd gram_;
  Eigen::VectorXd offsets_, bounds_, multipliers_, z_;
  SolveReport report_;
  bool prepared_ = false;
};

}  // namespace tilt_ropter
