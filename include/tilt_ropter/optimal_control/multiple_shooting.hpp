#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/anderson.hpp>
#include <tilt_ropter/optimal_control/augmented_lagrangian.hpp>
#include <tilt_ropter/optimal_control/merit.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/quadratic_program.hpp>
#include <tilt_ropter/optimal_control/solve_report.hpp>
#include <tilt_ropter/optimal_control/trajectory.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

/// Sequential quadratic programming on a multiple-shooting problem (Bock & Plitt 1984) with a
/// Gauss-Newton Hessian, in five steps: linearise, factorise, multipliers, elastic rows, step.
/// One pass is the real-time iteration (Diehl, Bock & Schlöder 2005), split in prepare(), before
/// the measurement comes, and feedback(), after it.
namespace tilt_ropter {

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
        here_(horizon_),
        trial_(horizon_),
        base_(horizon_),
        equalities_(horizon_, settings.max_multiplier),
        merit_(horizon_),
        model_has_equalities_(static_cast<std::size_t>(horizon_) + 1, false),
        anderson_((nx + nu) * (horizon_ + 1), settings.memory),
        residual_(Eigen::VectorXd::Zero((nx + nu) * (horizon_ + 1))),
        base_residual_(residual_),
        move_(residual_),
        scale_(residual_) {}

  [[nodiscard]] Problem& problem() { return problem_; }
  [[nodiscard]] const Problem& problem() const { return problem_; }
  [[nodiscard]] int horizon() const { return horizon_; }
  [[nodiscard]] const State& state(int k) const { return here_.x(k); }
  [[nodiscard]] const Input& input(int k) const { return here_.u(k); }
  /// Multipliers of the rows of node k: > 0 at the upper bound, < 0 at the lower.
  [[nodiscard]] const Rows& row_multipliers(int k) const { return program_.node(k).multiplier; }
  /// True if the last quadratic program violates this row of node k because keeping to it would
  /// cost more than its penalty.
  [[nodiscard]] bool given_up(int k, int row) const {
    const double multiplier = std::abs(program_.node(k).multiplier(row));
    return multiplier > 0.0 && multiplier >= program_.node(k).penalty(row);
  }

  /// Cold start: every state x0, every input zero, no multipliers.
  void reset(const State& x0) {
    for (int k = 0; k <= horizon_; ++k) {
      here_.x(k) = x0;
      here_.u(k).setZero();
      program_.node(k).multiplier.setZero();
    }
    equalities_.forget_multipliers();
    report_.damping = 0.0;
  }

  /// Guess of the states and inputs at node k (the input of the last node means nothing).
  void set_guess(int k, const State& x, const Input& u) {
    here_.x(k) = x;
    if (k < horizon_) here_.u(k) = u;
  }

  /// Moves the plan ahead in time by elapsed time / length of an interval, so that it fits nodes
  /// that have moved with the clock. Multipliers move with the nodes they are nearest to. Nothing
  /// happens unless `intervals` > 0.
  void shift(double intervals) noexcept {
    if (!(intervals > 0.0)) return;
    here_.shift(problem_, intervals);
    const int whole = static_cast<int>(std::min(std::round(intervals), 1.0 * horizon_));
    equalities_.shift(whole);
    for (int k = 0; whole > 0 && k <= horizon_; ++k)
      program_.node(k).multiplier = program_.node(std::min(k + whole, horizon_)).multiplier;
    prepared_ = false;
  }

  /// Steps 1 and 2 and the working set's gradients: all that needs no measurement. False if the
  /// problem returned a non-finite number.
  [[nodiscard]] bool prepare() noexcept {
    const auto start = Clock::now();
    prepared_ = linearise();
    report_.linearise_us = since(start);
    const auto linearised = Clock::now();
    prepared_ = prepared_ && factorise();
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
    const Tangent dx0 = problem_.difference(x0, here_.x(0));
    if (!all_finite(dx0)) {
      report_.status = SolveStatus::rejected;
    } else if (!prepared_ || !solve_program(dx0, deadline(start))) {
      report_.status = prepared_ && program_.late() ? SolveStatus::time_limit : SolveStatus::failed;
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

  /// Iterates to convergence from the current guess with the initial state fixed to x0. Steps are
  /// accelerated (see Anderson), full or shorter, whatever lowers the merit enough.
  const SolveReport& solve(const State& x0) noexcept {
    const auto start = Clock::now();
    double prepare_us = 0.0, feedback_us = 0.0;
    int iteration = 0;
    if (!all_finite(problem_.difference(x0, here_.x(0)))) {
      report_.status = SolveStatus::rejected;
      return report_;
    }
    here_.x(0) = x0;
    report_.step = 1.0;
    equalities_.forget_scale();
    merit_.forget();
    updates_multipliers_ = settings_.update_multipliers && equalities_.any(problem_);
    accelerates_ = settings_.memory > 0 && !updates_multipliers_;
    forget_moves();
    for (;; ++iteration) {
      bool prepared = prepare();
      prepare_us += report_.prepare_us;
      if (updates_multipliers_) report_.kkt = std::max(report_.kkt, report_.max_equality);
      const bool converged = prepared && report_.kkt <= settings_.tolerance;
      report_.status = converged                                 ? SolveStatus::converged
                       : iteration == settings_.max_iterations   ? SolveStatus::iteration_limit
                       : since(start) > 1e6 * settings_.max_time ? SolveStatus::time_limit
                       : !prepared && !on_trust_                 ? SolveStatus::failed
                                                                 : SolveStatus::iterated;
      if (report_.status != SolveStatus::iterated) break;
      const auto prepared_at = Clock::now();
      if (iteration == 0 && accelerates_) set_scale();
      report_.status = prepared ? search_step() : go_back(false);
      feedback_us += since(prepared_at);
      if (report_.status != SolveStatus::iterated) break;
      if (updates_multipliers_)
        equalities_.update(problem_, here_, report_.max_equality, report_.step == 1.0);
    }
    if (on_trust_ && report_.status != SolveStatus::converged) {  // nothing says it is better
      here_.swap(base_);
      (void)linearise();
    }
    report_.iterations = iteration;
    report_.prepare_us = prepare_us;
    report_.feedback_us = feedback_us;
    prepared_ = false;
    equalities_.forget_scale();
    return report_;
  }

  [[nodiscard]] const SolveReport& report() const { return report_; }

 private:
  using Clock = SolverClock;
  using Program = QuadraticProgram<nx, nu, nc, typename TransitionBlocksOf<Problem>::type>;

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

  // Step 1: every interval's end state and derivative, every node's quadratic model and rows.
  bool linearise() {
    report_.cost = report_.max_defect = report_.max_violation = report_.max_equality = 0.0;
    bool rows_are_finite = true;
    for (int k = 0; k <= horizon_; ++k) {
      const State& x = here_.x(k);
      const Input& u = here_.u(k);
      auto& s = program_.stage(k);
      auto& rows = program_.node(k);
      if (k < horizon_) {
        s.defect = problem_.difference(problem_.step(k, x, u, s.A, s.B), here_.x(k + 1));
        report_.max_defect = std::max(report_.max_defect, s.defect.cwiseAbs().maxCoeff());
      }
      if constexpr (ne > 0) forget_equalities(k);
      problem_.cost_model(k, x, u, s.cost);
      report_.cost += problem_.cost(k, x, u);
      if constexpr (ne > 0) add_equalities(k);
      rows.value = problem_.row_values(k, x, u);
      problem_.row_derivatives(k, x, u, rows.C, rows.E);
      rows.lower = problem_.lower(k);
      rows.upper = problem_.upper(k);
      rows.penalty = problem_.penalty(k);
      rows_are_finite = rows_are_finite && all_finite(rows.value);
      for (int i = 0; i < nc; ++i)
        report_.max_violation =
            std::max(report_.max_violation, violation(rows.value(i), rows.lower(i), rows.upper(i)));
    }
    report_.kkt = kkt_residual();
    return rows_are_finite && std::isfinite(report_.kkt) && std::isfinite(report_.cost);
  }

  // The problem need not set again what it set before, but the equalities were added to that.
  void forget_equalities(int k) {
    if (model_has_equalities_[static_cast<std::size_t>(k)]) program_.stage(k).cost = {};
  }
  void add_equalities(int k) {
    const double largest =
        equalities_.add_to_model(problem_, k, here_.x(k), program_.stage(k).cost);
    model_has_equalities_[static_cast<std::size_t>(k)] = equalities_.has(problem_, k);
    report_.max_equality = std::max(report_.max_equality, largest);
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

  // Step 2, with Levenberg damping where a Hessian is not positive definite.
  bool factorise() {
    if (report_.damping > 0.0) report_.damping *= 0.1;
    if (report_.damping < least_damping) report_.damping = 0.0;
    while (!program_.factorise(report_.damping)) {
      report_.damping = std::max(10.0 * report_.damping, least_damping);
      if (!(report_.damping <= largest_damping)) {
        report_.damping = 0.0;
        return false;
      }
    }
    return true;
  }

  [[nodiscard]] std::optional<Clock::time_point> deadline(Clock::time_point start) const {
    if (!std::isfinite(settings_.max_feedback_time)) return std::nullopt;
    return start + std::chrono::duration_cast<Clock::duration>(
                       std::chrono::duration<double>(settings_.max_feedback_time));
  }

  bool solve_program(const Tangent& dx0, std::optional<Clock::time_point> deadline = {}) {
    if (!program_.solve(dx0, deadline)) return false;
    report_.rounds = program_.rounds();
    report_.active_rows = program_.active_rows();
    report_.given_up_rows = program_.given_up_rows();
    report_.left_out_rows = program_.left_out_rows();
    return true;
  }

  // The point `length` of the way along the step of the quadratic program.
  void try_step(double length) {
    for (int k = 0; k <= horizon_; ++k) {
      trial_.x(k) = problem_.retract(here_.x(k), length * program_.dx(k));
      if (k < horizon_) trial_.u(k) = here_.u(k) + length * program_.du(k);
    }
  }

  void accept() { here_.swap(trial_); }

  // Step 5. What is tried first is the accelerated step; it need not lower the merit where that is
  // nearly level or rounding hides it (the merit's norms reject good steps there: Maratos), but
  // then is on trust: unless the next program's step is shorter, the solver goes back.
  SolveStatus search_step() {
    if (!solve_program(Tangent::Zero())) return on_trust_ ? go_back(false) : SolveStatus::failed;
    if (accelerates_) {
      pack_step();
      if (moved_) anderson_.add(move_, base_residual_, residual_);
      if (on_trust_ && !(residual_.norm() < 0.9 * base_residual_.norm())) return go_back(true);
    }
    const double slope = merit_.update(program_, horizon_);
    const double merit = merit_.value_here(problem_, program_, equalities_, here_, report_.cost);
    const bool level = -slope <= 1e-4 * (1.0 + std::abs(merit)) && !searches_;
    const bool hidden = -slope <= 1e-9 * (1.0 + std::abs(merit));
    searches_ = on_trust_ = false;
    attempts_ = 0;
    if (!accelerates_) return search_line(merit, slope, hidden);

    base_ = here_;
    base_residual_ = residual_;
    moved_ = true;
    if (!anderson_.empty()) {
      move_ = anderson_.step(residual_);
      try_move();
      const bool lower = merit_of_trial() <= merit + 1e-4 * slope;
      if (lower || level || hidden) {
        on_trust_ = !lower;
        report_.step = 1.0;
        accept();
        return SolveStatus::iterated;
      }
    }
    on_trust_ = hidden;
    const SolveStatus status = search_line(merit, slope, hidden);
    move_ = report_.step * residual_;
    return status;
  }

  // Along the step of the quadratic program.
  SolveStatus search_line(double merit, double slope, bool hidden) {
    double length = 1.0;
    if (hidden) {  // nothing to go by but what was right before
      if (!accelerates_) length = report_.step;
      try_step(length);
    } else {
      try_step(length);
      double there = merit_of_trial();
      // The parabola through the merit here, its slope and its value at the end: where a
      // Gauss-Newton step goes far beyond the minimum, it does so every time, and only a shorter
      // one converges.
      const double bend = there - merit - slope;
      if (bend > 0.0 && -slope < 1.5 * bend) {
        length = std::max(0.1, -slope / (2.0 * bend));
        try_step(length);
        there = merit_of_trial();
      }
      while (!(there <= merit + 1e-4 * length * slope)) {
        length *= 0.5;
        if (length < settings_.min_step) return SolveStatus::stalled;
        try_step(length);
        there = merit_of_trial();
      }
    }
    report_.step = length;
    accept();
    return SolveStatus::iterated;
  }

  double merit_of_trial() const { return merit_.value(problem_, program_, equalities_, trial_); }

  // Back to where the trusted step started. What was learnt at its end makes for a better one, a
  // few times; then the line search has to find one.
  SolveStatus go_back(bool learnt) {
    here_ = base_;
    if (learnt && ++attempts_ < max_attempts) {
      move_ = anderson_.step(base_residual_);
      try_move();
      accept();
    } else {
      forget_moves();
      searches_ = true;
    }
    return SolveStatus::iterated;
  }

  void forget_moves() {
    anderson_.clear();
    moved_ = on_trust_ = searches_ = false;
    attempts_ = 0;
  }

  // The step of the quadratic program as one vector, scaled by the first Hessians' diagonals.
  void pack_step() {
    for (int k = 0; k <= horizon_; ++k) {
      of_state(residual_, k) = of_state(scale_, k).cwiseProduct(program_.dx(k));
      if (k < horizon_) of_input(residual_, k) = of_input(scale_, k).cwiseProduct(program_.du(k));
    }
  }
  void try_move() {
    for (int k = 0; k <= horizon_; ++k) {
      const Tangent dx = of_state(move_, k).cwiseQuotient(of_state(scale_, k));
      trial_.x(k) = problem_.retract(here_.x(k), dx);
      if (k < horizon_)
        trial_.u(k) = here_.u(k) + of_input(move_, k).cwiseQuotient(of_input(scale_, k));
    }
  }
  void set_scale() {
    for (int k = 0; k <= horizon_; ++k) {
      const auto& cost = program_.stage(k).cost;
      of_state(scale_, k) = cost.lxx.diagonal().cwiseAbs().cwiseMax(1e-6).cwiseSqrt();
      if (k < horizon_)
        of_input(scale_, k) = cost.luu.diagonal().cwiseAbs().cwiseMax(1e-6).cwiseSqrt();
    }
  }
  static auto of_state(Eigen::VectorXd& v, int k) { return v.template segment<nx>((nx + nu) * k); }
  static auto of_input(Eigen::VectorXd& v, int k) {
    return v.template segment<nu>((nx + nu) * k + nx);
  }

  static constexpr double least_damping = 1e-6, largest_damping = 1e12;
  static constexpr int max_attempts = 5;

  Problem problem_;
  SolverSettings settings_;
  int horizon_;
  Program program_;
  Trajectory<Problem> here_, trial_, base_;  // base: where the last step of solve() started
  AugmentedLagrangian<Problem> equalities_;
  Merit<Problem, Program> merit_;
  std::vector<char> model_has_equalities_;  // by node, in the last linearisation
  SolveReport report_;
  bool prepared_ = false;

  // Of solve():
  Anderson<> anderson_;
  // Scaled: step of the program here and at the base, step taken from the base; and the scales.
  Eigen::VectorXd residual_, base_residual_, move_, scale_;
  bool updates_multipliers_ = false, accelerates_ = false;
  bool moved_ = false;     // move_ and base_residual_ are set
  bool on_trust_ = false;  // the last step was accepted without a lower merit
  bool searches_ = false;  // the next step must lower the merit
  int attempts_ = 0;       // trusted steps from the same base
};

}  // namespace tilt_ropter
