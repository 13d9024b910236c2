// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/detail/quadratic_program.hpp>
#include <tilt_ropter/optimal_control/detail/scaled_problem.hpp>
#include <tilt_ropter/optimal_control/detail/step_search.hpp>
#include <tilt_ropter/optimal_control/detail/trajectory.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <optional>
#include <utility>

#if defined(__GNUC__) && !defined(__OPTIMIZE__) && !defined(TILT_ROPTER_NOT_OPTIMISED)
#pragma message( \
    "tilt_ropter: without optimisation the solver takes hundreds of times as long. \
Compile with -O2, as CMAKE_BUILD_TYPE=Release does; to do without, define TILT_ROPTER_NOT_OPTIMISED.")
#endif

/// Sequential quadratic programming on a multiple-shooting problem (Bock & Plitt 1984) with a
/// Gauss-Newton Hessian, and the curvature that the problem adds to it (sequential convex quadratic
/// programming; Verschueren, van Duijkeren, Quirynen & Diehl 2016): linearise, solve the quadratic
/// program by Riccati passes and NLopt, step. One such iteration is the real-time iteration (Diehl,
/// Bock & Schlöder 2005). It is split into prepare(), before the measurement, and feedback(), after
/// it.
namespace tilt_ropter::optimal_control {

/// Solver that owns the problem, the trajectory and the workspace. Two solvers share no data.
template <typename Problem>
class MultipleShooting {
 public:
  using Dimensions = ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Tangent = typename Dimensions::Tangent;
  using Input = typename Dimensions::Input;
  using AllConstraints = ProblemConstraints<ScaledProblem<Problem>>;
  /// Constraints of a node; also of the last node, if it has separate constraints.
  using Constraints = typename AllConstraints::Values;
  static constexpr int nx = Dimensions::nx, nu = Dimensions::nu, nc = AllConstraints::count,
                       ne = Dimensions::ne;
  using Gain = Eigen::Matrix<double, nu, nx>;
  using Clock = SolverClock;

  /// Allocates all memory. The loop functions below allocate only inside NLopt. Throws
  /// std::invalid_argument if settings are out of range or the horizon is below 1.
  explicit MultipleShooting(Problem problem, const SolverSettings& settings = {});

  [[nodiscard]] Problem& problem() { return problem_; }
  [[nodiscard]] const Problem& problem() const { return problem_; }
  [[nodiscard]] int horizon() const { return horizon_; }
  [[nodiscard]] const State& state(int k) const { return here_.x(k); }
  [[nodiscard]] const Input& input(int k) const { return here_.u(k); }
  /// Multipliers of the constraints of node k: > 0 at the upper bound, < 0 at the lower.
  [[nodiscard]] const Constraints& constraint_multipliers(int k) const {
    return program_.node(k).multiplier;
  }
  /// Returns true if the last quadratic program relaxed constraint i of node k, because
  /// satisfying it would cost more than its penalty.
  [[nodiscard]] bool relaxed(int k, int i) const {
    const auto& n = program_.node(k);
    const double multiplier = std::abs(n.multiplier(i));
    return (multiplier > 0.0 && multiplier >= n.penalty(i)) ||
           (n.crossed && n.crosses[detail::size(i)]);
  }
  /// Violation of constraint i of node k in the last quadratic program, at least zero.
  [[nodiscard]] double slack(int k, int i) const {
    const auto& n = program_.node(k);
    return n.violation(i, n.predicted(i));
  }

  /// Gain of the feedback u = input(k) + gain(k) difference(x, state(k)) for an interval k < N,
  /// from the last factorisation. The feedback is optimal to first order while the active
  /// constraints stay the same. Active constraints enter with the weights that solved the last
  /// quadratic program. The feedback itself respects no bounds.
  [[nodiscard]] Gain gain(int k) const { return program_.riccati.gain(k); }
  /// Feed-forward for gain(): the change of the input of interval k in the last quadratic program
  /// for a state that stays on the previous plan.
  [[nodiscard]] Input feedforward(int k) const { return program_.du(k) - gain(k) * program_.dx(k); }

  /// Cold start: every state x0, every input zero, no multipliers.
  void reset(const State& x0);

  /// Sets the guess of the state and input at node k. The input of the last node is ignored.
  void set_guess(int k, const State& x, const Input& u) {
    here_.x(k) = x;
    if (k < horizon_) here_.u(k) = u;
    program_.forget();
    prepared_ = false;
  }

  /// Moves the plan ahead in time, for nodes that moved with the clock. `intervals` is the elapsed
  /// time divided by the length of an interval. The multipliers move by the total shift since the
  /// last solve, rounded to whole nodes. Does nothing unless `intervals` > 0.
  void shift(double intervals) noexcept;

  /// Returns true if the deadline interrupted the last feedback(). The next prepare() then has no
  /// work, and feedback() continues the same quadratic program from the new measured state.
  /// reset(), set_guess() and shift() cancel this.
  [[nodiscard]] bool interrupted() const { return program_.interrupted(); }
  /// Returns false if the interruption came so early that the plan is still the previous plan.
  [[nodiscard]] bool has_step() const { return program_.has_step(); }

  /// Linearises and factorises: all work that needs no measurement. Fails if the problem returned a
  /// non-finite number, or if no damping makes the Hessians positive definite.
  [[nodiscard]] PrepareStatus prepare() noexcept;

  /// Computes the step from the measured initial state. Needs a prepare() before. If that failed,
  /// or the last plan is out of range, this starts cold and prepares itself. If has_plan() of the
  /// report's status is true, state(k) and input(k) are then the new plan, else the old plan. Work
  /// that would end after `deadline` or SolverSettings.max_feedback_time is not started. The plan
  /// is then the best plan so far, and the next call continues from its multipliers.
  const SolveReport& feedback(const State& x0,
                              std::optional<Clock::time_point> deadline = {}) noexcept;

  /// Restores the previous plan, without multipliers, after a feedback() whose plan is not usable.
  void restore_previous() noexcept {
    here_.swap(trial_);
    for (int k = 0; k <= horizon_; ++k) detail::fill(program_.node(k).multiplier, 0.0);
    program_.forget();
    prepared_ = false;
  }

  /// Iterates to convergence from the current guess, with the initial state fixed to x0. A step is
  /// accelerated, full or shorter, so that the merit decreases enough. See StepSearch for
  /// accelerated steps that do not decrease the merit. Where this does not converge, it starts
  /// again from the guess, with damping, or from the states that the inputs of the guess lead to.
  /// The result is never worse than the guess: if it has not converged, it is the best of the guess
  /// and of the ends of all starts, by the merit with the largest multiplier as the only weight.
  /// Where hard constraints have to give way, up to max_iterations more keep single inputs within
  /// their bounds.
  const SolveReport& solve(const State& x0) noexcept;
  /// The same, with a log: calls watch(report) at each iterate. `step` and `damping` of this report
  /// are those that led to the iterate. `watch` must not throw.
  template <typename Watch>
  const SolveReport& solve(const State& x0, const Watch& watch) noexcept;

  [[nodiscard]] const SolveReport& report() const { return report_; }

 private:
  using Scaled = ScaledProblem<Problem>;
  using Program = QuadraticProgram<nx, nu, nc, typename TransitionPatternOf<Problem>::type>;

  static int checked_horizon(int horizon) {
    require(horizon >= 1, "Problem.horizon()", horizon, ">= 1");
    return horizon;
  }
  static double since(Clock::time_point start) {
    return std::chrono::duration<double, std::micro>(Clock::now() - start).count();
  }
  // Largest violation of node k in the problem's own units.
  [[nodiscard]] double violation_of(int k) const;

  // True if prepare() failed, perhaps because a measurement led the plan too far away, or if the
  // step to x0 is so long that rounding alone would lead away. feedback() then starts cold.
  [[nodiscard]] bool cannot_go_on_from(const State& x0) const;

  // Computes the end state and derivative of every interval, and the quadratic model and
  // constraints of every node. Returns false if a number is not finite.
  bool linearise(bool real_time);
  bool linearise_intervals();

  // Largest defect relative to how far the state moves, by the last node and every fourth. Defects
  // up to 1e-14 are rounding errors.
  [[nodiscard]] double relative_defect() const;
  // Largest violation of the first-order conditions at the iterate with the current multipliers.
  // The multipliers of continuity follow from the adjoint recursion.
  double kkt_residual(bool real_time) {
    const ProgramResidual residual = program_.residual_here(report_.max_violation);
    if (real_time) return detail::larger(residual.largest(), report_.max_defect);
    return detail::larger(residual.largest(), relative_defect());
  }

  // Adds Levenberg damping if a Hessian is not positive definite.
  bool factorise(bool real_time);

  // Solves the quadratic program and writes the result into the report.
  SolveStatus solve_program(const Tangent& dx0, std::optional<Clock::time_point> deadline,
                            bool real_time);

  [[nodiscard]] bool hard_constraints_relaxed() const {
    return report_.relaxed_hard_constraints > 0;
  }

  // Returns true if neither residual nor merit has decreased for `patience` iterations.
  // Acceleration may cycle, so it is switched off first.
  [[nodiscard]] bool stalls(int iteration);

  // Chooses units at the first iterate, and changes those of what the last solve left. Returns true
  // if this has to be linearised again.
  [[nodiscard]] bool choose_units();
  void natural_units() {
    equalities_.change_unit(1.0 / problem_.cost_unit());
    for (int k = 0; !problem_.natural() && k <= horizon_; ++k)
      program_.change_units(k, 1.0 / problem_.cost_unit(), problem_.row_units(k).cwiseInverse());
    problem_.forget_units();
  }
  // Iterates from here_ until a status ends it.
  template <typename Watch>
  void iterate(Clock::time_point end, const Watch& watch);

  void start_again(int attempt);
  void forget_multipliers() {
    for (int k = 0; k <= horizon_; ++k) detail::fill(program_.node(k).multiplier, 0.0);
    equalities_.forget_multipliers();
  }
  // Where hard constraints had to give way, and wherever the bounds of single inputs have: iterates
  // once more, and keeps these bounds.
  template <typename Watch>
  void hand_out_the_best(Clock::time_point end, const Watch& watch);

  // True if here_ violates no hard bound of a single input.
  [[nodiscard]] bool inputs_are_within_bounds();
  // Clamps the inputs of here_ to their hard bounds. The states follow, with the gains.
  void clamp_inputs();

  // Computes the next iterate of solve().
  SolveStatus advance(bool prepared, Clock::time_point end);

  static constexpr int patience = 40;  // iterations
  static constexpr double least_damping = 1e-6, largest_damping = 1e12;

  Scaled problem_;
  SolverSettings settings_;
  int horizon_;
  Program program_;
  Trajectory<Scaled> here_, trial_;
  struct Work {
    int iterations = 0;
    double prepare_us = 0.0, feedback_us = 0.0;
  } work_;
  static constexpr int attempts = 6;
  int most_iterations_ = 0;
  AugmentedLagrangian<Scaled> equalities_;
  StepSearch<Scaled, Program> search_;
  BestPlan<Scaled, Program> best_;
  Eigen::Matrix<Lanes, nx, nx> lanes_A_;
  Eigen::Matrix<Lanes, nx, nu> lanes_B_;
  SolveReport report_;
  // Lowest residual and merit of solve() so far, and the iteration of the last decrease.
  struct Progress {
    double kkt = detail::infinity, merit = detail::infinity;
    int iteration = 0;
  } progress_;
  double shifted_ = 0.0;  // intervals by which the plan is ahead of the multipliers
  bool prepared_ = false, prepare_failed_ = false, updates_multipliers_ = false, has_units_ = false;
};

template <typename Problem>
MultipleShooting<Problem>::MultipleShooting(Problem problem, const SolverSettings& settings)
    : problem_(std::move(problem)),
      settings_(validated(settings)),
      horizon_(checked_horizon(problem_.horizon())),
      program_(horizon_, settings.program),
      here_(horizon_),
      trial_(horizon_),
      equalities_(horizon_, settings.max_multiplier),
      search_(horizon_, settings),
      best_(horizon_) {
  lanes_A_.setIdentity();
  detail::fill(lanes_B_, 0.0);
}

template <typename Problem>
void MultipleShooting<Problem>::reset(const State& x0) {
  for (int k = 0; k <= horizon_; ++k) {
    here_.x(k) = x0;
    detail::fill(here_.u(k), 0.0);
  }
  forget_multipliers();
  program_.forget();
  report_.damping = 0.0;
  shifted_ = 0.0;
  prepared_ = false;
}

template <typename Problem>
void MultipleShooting<Problem>::shift(double intervals) noexcept {
  const detail::FlushSubnormals flush;
  if (!(intervals > 0.0)) return;
  here_.shift(problem_, intervals);
  shifted_ = std::min(shifted_ + intervals, 2.0 * horizon_);
  const int whole = static_cast<int>(std::min(std::floor(shifted_ + 0.5), 1.0 * horizon_));
  shifted_ -= whole;
  equalities_.shift(whole);
  program_.forget();
  for (int k = 0; whole > 0 && k <= horizon_; ++k)
    program_.node(k).multiplier = program_.node(std::min(k + whole, horizon_)).multiplier;
  prepared_ = false;
}

template <typename Problem>
PrepareStatus MultipleShooting<Problem>::prepare() noexcept {
  const detail::FlushSubnormals flush;
  const auto start = Clock::now();
  report_.linearise_us = report_.factorise_us = report_.gradients_us = 0.0;
  prepared_ = program_.interrupted() || (linearise(true) && factorise(true));
  prepare_failed_ = !prepared_;
  report_.prepare_us = since(start);
  return prepared_ ? PrepareStatus::prepared : PrepareStatus::failed;
}

template <typename Problem>
const SolveReport& MultipleShooting<Problem>::feedback(
    const State& x0, std::optional<Clock::time_point> deadline) noexcept {
  const detail::FlushSubnormals flush;
  const auto start = Clock::now();
  report_.iterations = 1;
  report_.step = 1.0;
  if (cannot_go_on_from(x0)) {
    trial_ = here_;
    reset(x0);
    if (prepare() != PrepareStatus::prepared) here_ = trial_;
  }
  // An interrupted program was linearised at the plan before the last one.
  const bool interrupted = program_.interrupted();
  const Trajectory<Scaled>& base = interrupted ? trial_ : here_;
  Trajectory<Scaled>& next = interrupted ? here_ : trial_;
  const Tangent dx0 = problem_.difference(x0, base.x(0));
  if (!all_finite(dx0)) {
    report_.status = SolveStatus::rejected;
  } else if (!prepared_) {
    report_.status = SolveStatus::failed;
  } else {
    const double seconds = settings_.max_feedback_time;
    if (std::isfinite(seconds)) {
      const auto end = start + std::chrono::duration_cast<Clock::duration>(
                                   std::chrono::duration<double>(seconds));
      if (!deadline || end < *deadline) deadline = end;
    }
    report_.status = solve_program(dx0, deadline, true);
    if (!program_.has_step()) {
      if (!interrupted) trial_ = here_;
    } else if (has_plan(report_.status)) {
      report_.kkt = std::max(report_.kkt, detail::largest(dx0));
      next.set_moved(problem_, base, program_, 1.0);
      if (!all_finite(problem_.difference(next.x(horizon_), base.x(horizon_)))) {
        report_.status = SolveStatus::failed;
        if (interrupted) here_.swap(trial_);
      } else if (!interrupted) {
        here_.swap(trial_);
      }
      shifted_ = 0.0;
    }
  }
  prepared_ = prepare_failed_ = false;
  report_.feedback_us = since(start);
  return report_;
}

template <typename Problem>
const SolveReport& MultipleShooting<Problem>::solve(const State& x0) noexcept {
  return solve(x0, [](const SolveReport&) {});
}

template <typename Problem>
template <typename Watch>
const SolveReport& MultipleShooting<Problem>::solve(const State& x0, const Watch& watch) noexcept {
  const detail::FlushSubnormals flush;
  const auto start = Clock::now();
  const auto end = start + std::chrono::duration_cast<Clock::duration>(
                               std::chrono::duration<double>(std::min(settings_.max_time, 1e6)));
  prepared_ = false;
  if (!all_finite(problem_.difference(x0, here_.x(0)))) {
    report_.status = SolveStatus::rejected;
    return report_;
  }
  here_.x(0) = x0;
  shifted_ = 0.0;
  work_ = {};
  most_iterations_ = settings_.max_iterations;
  program_.inputs_last = false;  // an input beyond its bounds for some iterations leads further
  has_units_ = false;
  best_.begin(here_);
  for (int attempt = 0;; ++attempt) {
    iterate(end, watch);
    if (report_.status == SolveStatus::converged) break;
    best_.offer(problem_, program_, equalities_, here_, report_.status);
    if (attempt + 1 == attempts || work_.iterations >= most_iterations_ || Clock::now() > end) {
      hand_out_the_best(end, watch);
      break;
    }
    start_again(attempt);
  }
  program_.inputs_last = true;
  natural_units();
  report_.iterations = work_.iterations;
  report_.prepare_us = work_.prepare_us;
  report_.feedback_us = work_.feedback_us;
  report_.step = search_.length();
  prepared_ = false;
  program_.forget();
  equalities_.forget_scale();
  return report_;
}

template <typename Problem>
double MultipleShooting<Problem>::violation_of(int k) const {
  if (problem_.natural()) return program_.violation_here(k);
  const auto& node = program_.node(k);
  double largest = 0.0;
  for (int i = 0; i < nc; ++i)
    largest = detail::larger(largest, problem_.row_units(k)(i) * node.violation(i, node.value(i)));
  return largest;
}

template <typename Problem>
bool MultipleShooting<Problem>::cannot_go_on_from(const State& x0) const {
  if (prepare_failed_) return all_finite(problem_.difference(x0, here_.x(0)));
  if (!prepared_) return false;
  constexpr double too_far = 1e8;
  const double move =
      detail::largest(problem_.difference(x0, (program_.interrupted() ? trial_ : here_).x(0)));
  return move > too_far && std::isfinite(move);
}

template <typename Problem>
bool MultipleShooting<Problem>::linearise(bool real_time) {
  const auto start = Clock::now();
  report_.cost = report_.max_defect = report_.max_violation = report_.max_equality = 0.0;
  bool finite = linearise_intervals();
  for (int k = 0; k <= horizon_; ++k) {
    const State& x = here_.x(k);
    const Input& u = here_.u(k);
    auto& model = program_.riccati.stage(k).cost;
    equalities_.take_from_model(k, model);  // the problem need not set all entries again
    problem_.cost_model(k, x, u, model);
    report_.cost += problem_.cost(k, x, u);
    if constexpr (ne > 0)
      report_.max_equality =
          detail::larger(report_.max_equality, equalities_.add_to_model(problem_, k, x, model));
    auto& node = program_.node(k);
    node.value = AllConstraints::values(problem_, k, x, u);
    AllConstraints::derivatives(problem_, k, x, u, node.C, node.E);
    AllConstraints::bounds(problem_, k, node.lower, node.upper, node.penalty, node.stiffness);
    for (int i = 0; k == horizon_ && i < nc; ++i)
      if (!AllConstraints::applies(problem_, k, node.E, i)) {
        node.lower(i) = -detail::infinity;
        node.upper(i) = detail::infinity;
      }
    finite = program_.check_node(k) && finite;
    report_.max_violation = detail::larger(report_.max_violation, violation_of(k));
  }
  program_.cost_here = report_.cost;
  report_.cost *= problem_.cost_unit();
  report_.kkt = kkt_residual(real_time);
  finite = finite && std::isfinite(report_.kkt) && std::isfinite(report_.cost) &&
           std::isfinite(report_.max_equality);
  if (!finite) report_.kkt = detail::infinity;
  if constexpr (HasCurvature<Problem>::value)
    for (int k = 0; k <= horizon_; ++k)
      problem_.add_curvature(k, here_.x(k), here_.u(k),
                             problem_.per_constraint(k, program_.node(k).multiplier),
                             k < horizon_ ? program_.costate(k + 1) : Tangent(detail::Filled()),
                             program_.riccati.stage(k).cost);
  report_.linearise_us = since(start);
  return finite;
}

template <typename Problem>
bool MultipleShooting<Problem>::linearise_intervals() {
  bool finite = true;
  const auto set_defect = [&](int k, const State& end) {
    const Tangent defect = problem_.difference(end, here_.x(k + 1));
    program_.riccati.set_defect(k, defect);
    const double most = all_finite(defect) ? detail::largest(defect) : detail::infinity;
    finite = finite && std::isfinite(most);
    report_.max_defect = std::max(report_.max_defect, most);
  };
  int k = 0;
  if constexpr (HasLanes<Problem>::value) {
    State ends[Lanes::count];
    for (; k < horizon_; k += Lanes::count) {
      const int first = k, count = std::min(Lanes::count, horizon_ - k);
      bool sound = true;
      const auto step = [&](auto) __attribute__((always_inline)) {
        problem_.step_lanes(first, count, &here_.x(first), &here_.u(first), ends, lanes_A_,
                            lanes_B_);
        sound = program_.riccati.set_transitions(first, count, lanes_A_, lanes_B_);
      };
      if (!detail::vectorised_or_not(step)) break;
      finite = finite && sound;
      for (int i = 0; i < count; ++i) set_defect(k + i, ends[i]);
    }
  }
  typename Dimensions::A A;
  typename Dimensions::B B;
  for (; k < horizon_; ++k) {
    set_defect(k, problem_.step(k, here_.x(k), here_.u(k), A, B));
    finite = program_.riccati.set_transition(k, A, B) && finite;
  }
  return finite;
}

template <typename Problem>
double MultipleShooting<Problem>::relative_defect() const {
  Tangent moved = detail::Filled{std::max(1e-8, 1e-14 / settings_.tolerance)},
          most = detail::Filled();
  for (int k = 1; k <= horizon_; ++k) {
    const auto& defect = program_.riccati.stage(k - 1).defect;
    for (int i = 0; i < nx; ++i) most(i) = detail::larger(most(i), std::abs(defect(i)));
    if ((horizon_ - k) % 4 > 0) continue;
    const Tangent far = problem_.difference(here_.x(k), here_.x(0));
    for (int i = 0; i < nx; ++i) moved(i) = std::max(moved(i), std::abs(far(i)));
  }
  double largest = 0.0;
  for (int i = 0; i < nx; ++i) largest = detail::larger(largest, most(i) / moved(i));
  return largest;
}

template <typename Problem>
bool MultipleShooting<Problem>::factorise(bool real_time) {
  const auto start = Clock::now();
  if (report_.damping > 0.0) report_.damping *= 0.1;
  if (report_.damping < least_damping) report_.damping = 0.0;
  while (!program_.prepare(report_.damping, real_time)) {
    report_.damping = std::max(10.0 * report_.damping, least_damping);
    if (!(report_.damping <= largest_damping)) {
      report_.damping = 0.0;
      return false;
    }
  }
  report_.gradients_us =
      std::chrono::duration<double, std::micro>(program_.gradients_time()).count();
  report_.factorise_us = since(start) - report_.gradients_us;
  return true;
}

template <typename Problem>
SolveStatus MultipleShooting<Problem>::solve_program(const Tangent& dx0,
                                                     std::optional<Clock::time_point> deadline,
                                                     bool real_time) {
  ProgramStatus status = program_.solve(dx0, deadline);
  if (real_time && status != ProgramStatus::failed) status = program_.clamp_first_input();
  report_.rounds = program_.rounds();
  report_.passes = program_.passes();
  report_.evaluations = program_.evaluations();
  report_.polishing_steps = program_.polishing_steps();
  report_.solved_by = program_.solved_by();
  report_.program_residual = program_.residual();
  if (status == ProgramStatus::failed) return SolveStatus::failed;
  report_.active_constraints = static_cast<int>(program_.active().size());
  report_.relaxed_constraints = report_.relaxed_hard_constraints = 0;
  report_.largest_relaxation = report_.largest_hard_relaxation = 0.0;
  const auto note = [this](int k, int i) {
    const bool hard = program_.node(k).hard[detail::size(i)];
    ++report_.relaxed_constraints;
    report_.relaxed_hard_constraints += hard;
    double& largest = hard ? report_.largest_hard_relaxation : report_.largest_relaxation;
    largest = std::max(largest, problem_.row_units(k)(i) * slack(k, i));
  };
  for (const auto& [k, i] : program_.active())
    if (relaxed(k, i)) note(k, i);
  for (int k = 0; k <= horizon_; ++k)
    for (int i = 0; program_.node(k).crossed && i < nc; ++i)
      if (relaxed(k, i) && program_.node(k).multiplier(i) == 0.0) note(k, i);
  if (status == ProgramStatus::interrupted)
    return program_.late() ? SolveStatus::time_limit : SolveStatus::iteration_limit;
  if (hard_constraints_relaxed()) return SolveStatus::infeasible;
  return real_time && report_.damping > 0.0 ? SolveStatus::damped : SolveStatus::iterated;
}

template <typename Problem>
bool MultipleShooting<Problem>::stalls(int iteration) {
  const double merit = search_.lowest_merit();
  if (report_.kkt < 0.9 * progress_.kkt) {
    progress_.kkt = report_.kkt;
    progress_.iteration = iteration;
  }
  if (merit < progress_.merit - 1e-5 * (1.0 + std::abs(merit))) {
    progress_.merit = merit;
    progress_.iteration = iteration;
  }
  if (iteration - progress_.iteration < patience || search_.on_trust()) return false;
  progress_.iteration = iteration;
  if (!search_.accelerates()) return true;
  search_.stop_accelerating();
  return false;
}

template <typename Problem>
bool MultipleShooting<Problem>::choose_units() {
  has_units_ = true;
  double cost = program_.cost_here;
  const bool free = cost == 0.0;  // then that of states and inputs of 1 instead
  for (int k = 0; free && k <= horizon_; ++k)
    cost += 0.5 * program_.riccati.stage(k).cost.hessian.diagonal().cwiseAbs().sum();
  if (!problem_.choose_units(
          cost, [this](int k) -> const auto& { return program_.node(k); }))
    return false;
  equalities_.change_unit(problem_.cost_unit());
  for (int k = 0; k <= horizon_; ++k)
    program_.change_units(k, problem_.cost_unit(), problem_.row_units(k));
  return true;
}

template <typename Problem>
template <typename Watch>
void MultipleShooting<Problem>::iterate(Clock::time_point end, const Watch& watch) {
  program_.forget();
  equalities_.forget_scale();
  updates_multipliers_ = settings_.update_multipliers && equalities_.any(problem_);
  search_.begin(!updates_multipliers_);
  progress_ = {};
  for (int iteration = 0;; ++iteration, ++work_.iterations) {
    const auto begun_at = Clock::now();
    bool prepared = linearise(false);
    if (!has_units_ && prepared && choose_units()) prepared = linearise(false);
    if (updates_multipliers_) report_.kkt = std::max(report_.kkt, report_.max_equality);
    report_.iterations = work_.iterations;
    report_.step = search_.length();
    watch(report_);
    const bool converged = prepared && report_.kkt <= settings_.tolerance;
    // A converged iterate needs no step, but gain() needs at least one factorisation.
    if (!converged || iteration == 0) prepared = prepared && factorise(false);
    work_.prepare_us += since(begun_at);
    report_.status =
        converged ? (hard_constraints_relaxed() ? SolveStatus::infeasible : SolveStatus::converged)
        : work_.iterations >= most_iterations_ ? SolveStatus::iteration_limit
        : Clock::now() > end                   ? SolveStatus::time_limit
        : prepared && stalls(iteration)        ? SolveStatus::stalled
        : !prepared && !search_.on_trust()     ? SolveStatus::failed
                                               : SolveStatus::iterated;
    if (report_.status != SolveStatus::iterated) break;
    const auto prepared_at = Clock::now();
    report_.status = advance(prepared, end);
    work_.feedback_us += since(prepared_at);
    if (report_.status != SolveStatus::iterated) break;
    if (updates_multipliers_)
      equalities_.update(problem_, here_, report_.max_equality, search_.length() == 1.0);
  }
  if (search_.on_trust() && !is_solution(report_.status)) {  // the last step is not confirmed
    search_.give_back(here_);
    (void)linearise(false);
  }
}

template <typename Problem>
void MultipleShooting<Problem>::start_again(int attempt) {
  here_ = best_.guess();
  forget_multipliers();
  if (attempt % 2 == 0) {
    for (int k = 0; k < horizon_; ++k) here_.x(k + 1) = problem_.step(k, here_.x(k), here_.u(k));
    if (!all_finite(problem_.difference(here_.x(horizon_), here_.x(0)))) here_ = best_.guess();
  }
  report_.damping = attempt < 1 ? 0.0 : std::pow(10.0, attempt - 1);
}

template <typename Problem>
template <typename Watch>
void MultipleShooting<Problem>::hand_out_the_best(Clock::time_point end, const Watch& watch) {
  SolveStatus status = best_.is_guess() && report_.status != SolveStatus::infeasible
                           ? report_.status
                           : best_.status();
  bool is_here = best_.is_last();
  here_ = best_.plan();
  const bool within = inputs_are_within_bounds();
  if (!within || (status == SolveStatus::infeasible && !is_here)) {
    forget_multipliers();  // with their penalties
    program_.inputs_last = true;
    report_.damping = 0.0;
    most_iterations_ = work_.iterations + settings_.max_iterations;
    iterate(end, watch);
    if (is_solution(report_.status)) return;
    status = report_.status;
    is_here = false;
    if (!inputs_are_within_bounds()) clamp_inputs();
    best_.choose(problem_, program_, equalities_, here_, best_.guess());
  }
  if (is_here) return;
  forget_multipliers();
  if (linearise(false)) (void)factorise(false);
  report_.status = status;
}

template <typename Problem>
bool MultipleShooting<Problem>::inputs_are_within_bounds() {
  (void)linearise(false);
  for (int k = 0; k < horizon_; ++k)
    for (int i = 0; i < nc; ++i) {
      const auto& node = program_.node(k);
      if (node.hard[detail::size(i)] && program_.single_input(k, i) &&
          !(node.violation(i, node.value(i)) <= settings_.tolerance))
        return false;
    }
  return true;
}

template <typename Problem>
void MultipleShooting<Problem>::clamp_inputs() {
  trial_ = here_;
  const bool has_gains = factorise(false);
  for (int k = 0; k < horizon_; ++k) {
    const Tangent dx = problem_.difference(here_.x(k), trial_.x(k));
    Input du = detail::Filled();
    if (has_gains) du = gain(k) * dx;
    program_.clamp_input(k, dx.data(), du.data());
    here_.u(k) = trial_.u(k) + du;
    here_.x(k + 1) = problem_.step(k, here_.x(k), here_.u(k));
    if (!all_finite(problem_.difference(here_.x(k + 1), here_.x(0))))
      here_.x(k + 1) = trial_.x(k + 1);
  }
}

template <typename Problem>
SolveStatus MultipleShooting<Problem>::advance(bool prepared, Clock::time_point end) {
  SolveStatus status = prepared ? solve_program(detail::Filled(), end, false) : SolveStatus::failed;
  if (status == SolveStatus::failed)
    return search_.on_trust() ? search_.go_back(problem_, here_, false) : status;
  if (status == SolveStatus::time_limit) return status;
  status = search_.advance(problem_, program_, equalities_, program_.cost_here, here_);
  if (status != SolveStatus::stalled) return status;
  search_.forget();  // weights of far iterates
  return search_.advance(problem_, program_, equalities_, program_.cost_here, here_);
}

}  // namespace tilt_ropter::optimal_control
