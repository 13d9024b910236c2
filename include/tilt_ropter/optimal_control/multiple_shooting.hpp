#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/quadratic_program.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>
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
  stalled,          ///< no step lowers the merit any more; the last iterate is kept
  failed,           ///< a non-finite number or no factorisation; the iterate before it is kept
  rejected,         ///< the initial state is not finite; nothing was changed
};

/// Limits and tolerances; the defaults serve problems whose cost is of order 1 to 10^4.
struct SolverSettings {
  int max_iterations = 100;        ///< of solve()
  double max_time = 1.0;           ///< of solve(), looked at between iterations [s]
  double tolerance = 1e-6;         ///< on the KKT residual, for solve()
  double min_step = 1e-4;          ///< shortest step that solve()'s line search tries
  double max_multiplier = 1e6;     ///< bound on an equality's multiplier
  bool update_multipliers = true;  ///< of equalities, in solve(): conditions met exactly, not only
                                   ///< by weight; feedback() never does, as noise would pile up
  QuadraticProgramSettings program;
};

inline void validate(const SolverSettings& s) {
  require(s.max_iterations > 0, "SolverSettings.max_iterations", s.max_iterations, "> 0");
  require_positive("SolverSettings.max_time [s]", s.max_time);
  require_positive("SolverSettings.tolerance", s.tolerance);
  require(s.min_step > 0.0 && s.min_step <= 1.0, "SolverSettings.min_step", s.min_step,
          "in (0, 1]");
  require_non_negative("SolverSettings.max_multiplier", s.max_multiplier);
  validate(s.program);
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
  double step = 1.0;      ///< length of the last step, 1 if it was a full one
  double prepare_us = 0.0, feedback_us = 0.0;  ///< wall time of the two phases [us]
  double linearise_us = 0.0, factorise_us = 0.0, rows_us = 0.0;  ///< parts of prepare [us]
};

/// Owns the problem, the trajectory and the workspace. Two solvers share nothing.
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
        program_(horizon_, settings.program),
        nodes_(static_cast<std::size_t>(horizon_) + 1) {}

  [[nodiscard]] Problem& problem() { return problem_; }
  [[nodiscard]] const Problem& problem() const { return problem_; }
  [[nodiscard]] int horizon() const { return horizon_; }
  [[nodiscard]] const State& state(int k) const { return node(k).x; }
  [[nodiscard]] const Input& input(int k) const { return node(k).u; }
  /// Multipliers of the rows of node k: > 0 at the upper bound, < 0 at the lower. One as large as
  /// the row's penalty marks a row that was given up.
  [[nodiscard]] const Rows& row_multipliers(int k) const { return program_.node(k).multiplier; }

  /// Cold start: every state x0, every input zero, no multipliers.
  void reset(const State& x0) {
    for (int k = 0; k <= horizon_; ++k) {
      Node& n = node(k);
      n.x = n.trial_x = x0;
      n.u.setZero();
      n.trial_u.setZero();
      n.equality_multiplier.setZero();
      program_.node(k).multiplier.setZero();
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
    prepared_ = linearise();
    report_.linearise_us = since(start);
    const auto linearised = Clock::now();
    prepared_ = prepared_ && program_.factorise();
    report_.factorise_us = since(linearised);
    const auto factorised = Clock::now();
    if (prepared_) program_.prepare();
    report_.rows_us = since(factorised);
    report_.prepare_us = since(start);
    return prepared_;
  }

  /// Step 3 to 5 from the measured initial state; needs a prepare() before. Afterwards state(k) and
  /// input(k) are the new plan, or the old one if the report says failed or rejected.
  const SolveReport& feedback(const State& x0) noexcept {
    const auto start = Clock::now();
    report_.iterations = 1;
    report_.step = 1.0;
    const Tangent dx0 = problem_.difference(x0, node(0).x);
    if (!dx0.allFinite()) {
      report_.status = SolveStatus::rejected;
    } else if (!prepared_ || !solve_program(dx0)) {
      report_.status = SolveStatus::failed;
    } else {
      report_.kkt = std::max(report_.kkt, dx0.cwiseAbs().maxCoeff());
      try_step(1.0);
      accept();
      report_.status = SolveStatus::iterated;
    }
    prepared_ = false;
    report_.feedback_us = since(start);
    return report_;
  }

  /// Iterates to convergence from the current guess with the initial state fixed to x0: full steps
  /// where they lower the merit enough, shorter ones elsewhere.
  const SolveReport& solve(const State& x0) noexcept {
    const auto start = Clock::now();
    double prepare_us = 0.0, feedback_us = 0.0;
    int iteration = 0;
    if (!problem_.difference(x0, node(0).x).allFinite()) {
      report_.status = SolveStatus::rejected;
      return report_;
    }
    node(0).x = x0;
    report_.step = 1.0;
    last_equality_ = std::numeric_limits<double>::infinity();
    for (Node& n : nodes_) n.forget_weights();
    for (;; ++iteration) {
      const bool prepared = prepare();
      prepare_us += report_.prepare_us;
      if (settings_.update_multipliers) report_.kkt = std::max(report_.kkt, report_.max_equality);
      report_.status = !prepared                                 ? SolveStatus::failed
                       : report_.kkt <= settings_.tolerance      ? SolveStatus::converged
                       : iteration == settings_.max_iterations   ? SolveStatus::iteration_limit
                       : since(start) > 1e6 * settings_.max_time ? SolveStatus::time_limit
                                                                 : SolveStatus::iterated;
      if (report_.status != SolveStatus::iterated) break;
      const auto prepared_at = Clock::now();
      report_.status = search_step();
      feedback_us += since(prepared_at);
      if (report_.status != SolveStatus::iterated) break;
      if (settings_.update_multipliers) update_equality_multipliers();
    }
    report_.iterations = iteration;
    report_.prepare_us = prepare_us;
    report_.feedback_us = feedback_us;
    prepared_ = false;
    equality_scale_ = 1.0;
    return report_;
  }

  [[nodiscard]] const SolveReport& report() const { return report_; }

 private:
  using Clock = std::chrono::steady_clock;
  using Equalities = typename Dimensions::Equalities;

  struct Node {
    State x{};
    Input u = Input::Zero();
    State trial_x{};
    Input trial_u = Input::Zero();
    Equalities equality_multiplier = Equalities::Zero();
    bool model_has_equalities = false;  // in the cost model of the last linearisation
    // Weights of the merit function: defect of the interval that starts here, rows.
    Tangent defect_weight = Tangent::Zero();
    Rows row_weight = Rows::Zero();

    void forget_weights() {
      defect_weight.setZero();
      row_weight.setZero();
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
  static double violation(double value, double lower, double upper) {
    return std::max(0.0, std::max(value - upper, lower - value));
  }

  Node& node(int k) { return nodes_[static_cast<std::size_t>(k)]; }
  const Node& node(int k) const { return nodes_[static_cast<std::size_t>(k)]; }

  // Step 1: every interval's end state and derivative, every node's quadratic model and rows.
  bool linearise() {
    report_.cost = report_.max_defect = report_.max_violation = report_.max_equality = 0.0;
    for (int k = 0; k <= horizon_; ++k) {
      Node& n = node(k);
      auto& s = program_.stage(k);
      auto& rows = program_.node(k);
      if (k < horizon_) {
        s.defect = problem_.difference(problem_.step(k, n.x, n.u, s.A, s.B), node(k + 1).x);
        report_.max_defect = std::max(report_.max_defect, s.defect.cwiseAbs().maxCoeff());
      }
      if (n.model_has_equalities) s.cost = {};
      problem_.cost_model(k, n.x, n.u, s.cost);
      report_.cost += problem_.cost(k, n.x, n.u);
      if constexpr (ne > 0) add_equalities(k);
      rows.value = problem_.row_values(k, n.x, n.u);
      problem_.row_derivatives(k, n.x, n.u, rows.C, rows.E);
      rows.lower = problem_.lower(k);
      rows.upper = problem_.upper(k);
      rows.penalty = problem_.penalty(k);
      for (int i = 0; i < nc; ++i)
        report_.max_violation =
            std::max(report_.max_violation, violation(rows.value(i), rows.lower(i), rows.upper(i)));
    }
    report_.kkt = kkt_residual();
    return std::isfinite(report_.kkt) && std::isfinite(report_.cost);
  }

  // Augmented Lagrangian of the equalities, in the quadratic model: as rows of the dual they would
  // cost ten times more.
  void add_equalities(int k) {
    Node& n = node(k);
    auto& model = program_.stage(k).cost;
    const Equalities weights = equality_scale_ * problem_.equality_weights(k);
    n.model_has_equalities = k > 0 && weights.maxCoeff() > 0.0;
    if (!n.model_has_equalities) return;
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
    Tangent adjoint = Tangent::Zero();
    for (int k = horizon_; k >= 0; --k) {
      const auto& rows = program_.node(k);
      const auto& s = program_.stage(k);
      if (k < horizon_) {
        Input stationarity = s.cost.lu;
        stationarity.noalias() += s.B.transpose() * adjoint;
        stationarity.noalias() += rows.E.transpose() * rows.multiplier;
        residual = std::max(residual, stationarity.cwiseAbs().maxCoeff());
        adjoint = (s.A.transpose() * adjoint).eval();
      }
      adjoint += s.cost.lx;
      adjoint.noalias() += rows.C.transpose() * rows.multiplier;
      for (int i = 0; i < nc; ++i) {
        const double m = rows.multiplier(i);
        const double over = rows.value(i) - rows.upper(i), under = rows.lower(i) - rows.value(i);
        if (std::abs(m) < rows.penalty(i)) residual = std::max(residual, std::max(over, under));
        if (m > 0.0) residual = std::max(residual, std::min(m, -over));
        if (m < 0.0) residual = std::max(residual, std::min(-m, -under));
      }
    }
    return residual;
  }

  bool solve_program(const Tangent& dx0) {
    if (!program_.solve(dx0)) return false;
    report_.rounds = program_.rounds();
    report_.active_rows = program_.active_rows();
    report_.given_up_rows = program_.given_up_rows();
    return true;
  }

  // The point `length` of the way along the step.
  void try_step(double length) {
    for (int k = 0; k <= horizon_; ++k) {
      Node& n = node(k);
      n.trial_x = problem_.retract(n.x, length * program_.dx(k));
      n.trial_u = n.u;
      if (k < horizon_) n.trial_u += length * program_.du(k);
    }
  }

  void accept() {
    for (Node& n : nodes_) {
      n.x = n.trial_x;
      n.u = n.trial_u;
    }
  }

  // Step 5: backtracks on the merit function cost + weighted 1-norms of defects and violations
  // (Nocedal & Wright, Sec. 15.4), whose weights follow the multipliers (Powell 1978).
  SolveStatus search_step() {
    if (!solve_program(Tangent::Zero())) return SolveStatus::failed;
    const double slope = update_weights();
    const double merit_here = merit_of_linearisation();
    // Where rounding of the merit hides what a step does, the last length goes on.
    const bool close = -slope <= 1e-9 * (1.0 + std::abs(merit_here));
    double length = close ? report_.step : 1.0;
    try_step(length);
    double merit = close ? -std::numeric_limits<double>::infinity() : merit_of_trial();
    // The parabola through the merit here, its slope and its value at the end: where a Gauss-Newton
    // step goes far beyond the minimum, it does so every time, and only a shorter one converges.
    const double bend = merit - merit_here - slope;
    if (bend > 0.0 && -slope < 1.5 * bend) {
      length = std::max(0.1, -slope / (2.0 * bend));
      try_step(length);
      merit = merit_of_trial();
    }
    while (!(merit <= merit_here + 1e-4 * length * slope)) {
      length *= 0.5;
      if (length < settings_.min_step) return SolveStatus::stalled;
      try_step(length);
      merit = merit_of_trial();
    }
    report_.step = length;
    accept();
    return SolveStatus::iterated;
  }

  // Weights of the merit from the multipliers of the quadratic program; the merit's slope along the
  // step.
  double update_weights() {
    const auto follow = [](double& weight, double multiplier) {
      const double m = 1.1 * std::abs(multiplier);
      weight = std::max(m, 0.5 * (weight + m));
    };
    double slope = 0.0;
    Tangent adjoint = Tangent::Zero();  // multiplier of the continuity that ends at node k
    for (int k = horizon_; k >= 0; --k) {
      Node& n = node(k);
      const auto& s = program_.stage(k);
      const auto& rows = program_.node(k);
      slope += s.cost.lx.dot(program_.dx(k));
      for (int i = 0; i < nc; ++i) {
        follow(n.row_weight(i), rows.multiplier(i));
        slope += n.row_weight(i) * (violation(rows.predicted(i), rows.lower(i), rows.upper(i)) -
                                    violation(rows.value(i), rows.lower(i), rows.upper(i)));
      }
      if (k < horizon_) {
        slope += s.cost.lu.dot(program_.du(k));
        for (int i = 0; i < nx; ++i) follow(n.defect_weight(i), adjoint(i));
        slope -= n.defect_weight.dot(s.defect.cwiseAbs());
        adjoint = (s.A.transpose() * adjoint + s.cost.lux.transpose() * program_.du(k)).eval();
      }
      adjoint += s.cost.lx;
      adjoint.noalias() += s.cost.lxx * program_.dx(k);
      adjoint.noalias() += rows.C.transpose() * rows.multiplier;
    }
    return slope;
  }

  double merit_of_linearisation() const {
    double merit = report_.cost;
    for (int k = 0; k <= horizon_; ++k) {
      const Node& n = node(k);
      merit += merit_of_rows(k, program_.node(k).value);
      if (k < horizon_) merit += n.defect_weight.dot(program_.stage(k).defect.cwiseAbs());
      merit += merit_of_equalities(k, n.x);
    }
    return merit;
  }

  double merit_of_trial() const {
    double merit = 0.0;
    for (int k = 0; k <= horizon_; ++k) {
      const Node& n = node(k);
      merit += problem_.cost(k, n.trial_x, n.trial_u);
      merit += merit_of_rows(k, problem_.row_values(k, n.trial_x, n.trial_u));
      if (k < horizon_)
        merit += n.defect_weight.dot(
            problem_.difference(problem_.step(k, n.trial_x, n.trial_u), node(k + 1).trial_x)
                .cwiseAbs());
      merit += merit_of_equalities(k, n.trial_x);
    }
    return merit;
  }

  double merit_of_rows(int k, const Rows& value) const {
    const auto& rows = program_.node(k);
    double merit = 0.0;
    for (int i = 0; i < nc; ++i)
      merit += node(k).row_weight(i) * violation(value(i), rows.lower(i), rows.upper(i));
    return merit;
  }

  double merit_of_equalities(int k, const State& x) const {
    double merit = 0.0;
    if constexpr (ne > 0) {
      const Equalities weights = equality_scale_ * problem_.equality_weights(k);
      if (k == 0 || !(weights.maxCoeff() > 0.0)) return 0.0;
      const auto h = problem_.equality_values(k, x);
      for (int i = 0; i < ne; ++i)
        if (weights(i) > 0.0)
          merit += (node(k).equality_multiplier(i) + 0.5 * weights(i) * h(i)) * h(i);
    }
    return merit;
  }

  // Multiplier step of the augmented Lagrangian; where it does not bring the conditions closer, the
  // weights grow (Nocedal & Wright, Sec. 17.3).
  void update_equality_multipliers() {
    if constexpr (ne > 0) {
      if (report_.max_equality > 0.5 * last_equality_ && report_.step == 1.0)
        equality_scale_ = std::min(3.0 * equality_scale_, 1e4);
      last_equality_ = report_.max_equality;
      for (int k = 1; k <= horizon_; ++k) {
        const Equalities weights = equality_scale_ * problem_.equality_weights(k);
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
  QuadraticProgram<nx, nu, nc, typename TransitionBlocksOf<Problem>::type> program_;
  std::vector<Node> nodes_;
  SolveReport report_;
  double equality_scale_ = 1.0, last_equality_ = 0.0;
  bool prepared_ = false;
};

}  // namespace tilt_ropter
