// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/active_set.hpp>
#include <tilt_ropter/optimal_control/detail/interior_point.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>
#ifndef TILT_ROPTER_WITHOUT_NLOPT
#include <tilt_ropter/optimal_control/detail/dual_method.hpp>
#endif

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

/// Solves the quadratic program of one SQP step. Without active constraints a Riccati pass is the
/// solution. With few, NLopt solves the dual (DualMethod). With many, methods that use the
/// structure of the program are faster: ActiveSet from the last solution, InteriorPoint where much
/// changed.
namespace tilt_ropter::optimal_control {

/// How a solve of a quadratic program ended.
enum class ProgramStatus {
  solved,       ///< the residual is at most the tolerance
  interrupted,  ///< stopped by the deadline or a limit: the step is the best one so far
  failed,       ///< the factorisation failed or a number is not finite: there is no step
};

#ifdef TILT_ROPTER_WITHOUT_NLOPT
/// In the place of DualMethod: there is no NLopt, so nothing here runs.
template <int States, int Inputs, int Constraints, typename Pattern>
struct DualMethod {
  DualMethod(int /*horizon*/, int /*capacity*/, DualAlgorithm /*algorithm*/) {}
  [[nodiscard]] static constexpr int capacity() { return 0; }
  [[nodiscard]] static constexpr bool late() { return false; }
  [[nodiscard]] static constexpr int rounds() { return 0; }
  [[nodiscard]] static constexpr int evaluations() { return 0; }
  static constexpr void begin(int /*most_evaluations*/) {}
  [[nodiscard]] static constexpr int polishing_steps() { return 0; }
  template <typename Program>
  [[nodiscard]] static constexpr bool prepare(const Program& /*program*/) {
    return false;
  }
  template <typename Program, typename Deadline>
  [[nodiscard]] static constexpr bool solve(Program& /*program*/,
                                            const typename Program::Tangent& /*dx0*/,
                                            const Deadline& /*deadline*/, int /*most*/) {
    return false;
  }
};
#endif

/// prepare() does the work that needs no measurement, solve() does the rest. Allocates in the
/// constructor; later only NLopt allocates.
template <int States, int Inputs, int Constraints, typename Pattern = FullTransition>
class QuadraticProgram : public Subproblem<States, Inputs, Constraints, Pattern> {
 public:
  using Program = Subproblem<States, Inputs, Constraints, Pattern>;
  using Tangent = typename Program::Tangent;

  /// For `horizon` intervals. The settings must be valid.
  QuadraticProgram(int horizon, const QuadraticProgramSettings& settings)
      : Program(horizon),
        settings_(without_dual(settings)),
        dual_(horizon, dual_capacity(settings, horizon), settings.algorithm),
        active_set_(horizon),
        interior_point_(horizon),
        few_(std::max(10, horizon / 2)),
        saved_steps_(detail::size(horizon) + 1, detail::Filled()),
        saved_multipliers_(saved_steps_.size(), detail::Filled()),
        saved_penalties_(saved_steps_.size(), detail::Filled()) {}

  /// As Subproblem::change_units(), with what the last solves have learnt.
  void change_units(int k, double cost, const typename Program::Values& units) {
    Program::change_units(k, cost, units);
    active_set_.change_unit(k, cost);
  }

  /// Factorises with `damping` on the diagonals of the Hessians, for the constraints that have
  /// multipliers. Returns false if the cost has no minimum. With `real_time`, NLopt is used for
  /// fewer constraints, see QuadraticProgramSettings.max_dual_constraints.
  [[nodiscard]] bool prepare(double damping = 0.0, bool real_time = false) {
    interrupted_ = false;
    const auto start = SolverClock::now();
    damping_ = damping;
    this->collect_active();
    const bool limited = real_time && settings_.method != ProgramMethod::nlopt;
    most_dual_constraints_ =
        limited ? std::min(std::max(1, 3 * settings_.max_dual_constraints / 2), dual_.capacity())
                : dual_.capacity();
    by_dual_ = settings_.method == ProgramMethod::nlopt ||
               (settings_.method == ProgramMethod::automatic && !unsolved_ &&
                static_cast<int>(this->active().size()) <= settings_.max_dual_constraints);
    assumes_ = !by_dual_ && !unsolved_;
    if (assumes_) active_set_.assume(*this);
    const bool good = assumes_ ? active_set_.factorise(*this, damping)
                               : active_set_.factorise_free(*this, damping);
    const auto factorised = SolverClock::now();
    pass_time_ = 2 * (factorised - start);  // with the sweep after it
    if (good && by_dual_) by_dual_ = dual_.prepare(*this);
    gradients_time_ = SolverClock::now() - factorised;
    return good;
  }
  /// Time that the last prepare() needed for the gradients of the dual's first working set.
  [[nodiscard]] SolverClock::duration gradients_time() const { return gradients_time_; }
  /// True if the deadline interrupted the last solve(). The next solve() then continues the same
  /// program for another initial step; it needs no new program and no prepare().
  [[nodiscard]] bool interrupted() const { return interrupted_; }
  /// False if the last solve() was interrupted before the first pass that includes all constraints.
  [[nodiscard]] bool has_step() const { return !interrupted_ || passes_ > 0; }
  /// The next solve() does not continue the last one.
  void forget() { interrupted_ = unsolved_ = false; }

  /// Computes the step and multipliers for the initial step dx0. Requires prepare(). A pass does
  /// not start if it would end after the deadline, as estimated from the duration of the last
  /// passes.
  ProgramStatus solve(const Tangent& dx0, std::optional<SolverClock::time_point> deadline = {}) {
    deadline_ = deadline;
    late_ = false;
    rounds_ = 0;
    constexpr int enough = 80;  // then Newton steps take over: a tick must not take much longer
    dual_.begin(settings_.method == ProgramMethod::automatic ? enough
                                                             : std::numeric_limits<int>::max());
    if (!interrupted_) {
      passes_ = passes_of_nlopt_ = 0;
      solve_by_method(dx0);
    } else if (!go_on(dx0)) {
      return ProgramStatus::failed;
    }
    bool finite = true;
    for (const auto& w : this->steps()) finite = finite && all_finite(w);
    unsolved_ = late_ && residual_ > settings_.tolerance;
    if (!finite) return ProgramStatus::failed;
    return residual_ <= settings_.tolerance ? ProgramStatus::solved : ProgramStatus::interrupted;
  }

  /// Clamps the input step du of node k, for this dx, to its hard bounds: the bounds of hard
  /// constraints that depend on a single input (and the state).
  void clamp_input(int k, const double* dx, double* du) const {
    if constexpr (Constraints > 0) {
      const auto& n = this->node(k);
      for (int i = 0; i < Constraints; ++i) {
        if (!n.hard[detail::size(i)] || n.stiffness(i) < detail::infinity) continue;
        int j = -1, entries = 0;
        for (int l = 0; l < Inputs; ++l)
          if (n.E(i, l) != 0.0) {
            j = l;
            ++entries;
          }
        if (entries != 1) continue;
        double at_rest = n.value(i);
        for (int l = 0; l < States; ++l) at_rest += n.C(i, l) * dx[l];
        const double slope = n.E(i, j);
        double low = (n.lower(i) - at_rest) / slope, high = (n.upper(i) - at_rest) / slope;
        if (low > high) std::swap(low, high);
        du[j] = std::min(std::max(du[j], low), high);
      }
    }
  }

  /// Clamps the first input to its hard bounds. The later inputs follow the change by the gains.
  /// This also applies to a change by rounding errors, because a horizon can amplify it a thousand
  /// times. The residual is recomputed only for larger changes. Returns the same as solve().
  ProgramStatus clamp_first_input() {
    auto &change = saved_steps_[0], &here = this->step(0);
    double size = 0.0;
    for (int i = 0; i < States + Inputs; ++i) change(i) = i < States ? 0.0 : -here(i);
    clamp_input(0, here.data(), here.data() + States);
    for (int i = States; i < States + Inputs; ++i) {
      size = std::max(size, std::abs(change(i)));
      change(i) += here(i);
    }
    const double largest = detail::largest(change);
    if (largest > 0.0) {
      this->riccati.sweep_deviation(saved_steps_, 1);
      for (int k = 1; k <= this->horizon(); ++k)
        for (int i = 0; i < States + Inputs; ++i)
          this->step(k)(i) += saved_steps_[detail::size(k)](i);
      this->predict();
      if (largest > 1e-12 * (1.0 + size)) (void)solved();
    }
    return residual_ <= settings_.tolerance ? ProgramStatus::solved : ProgramStatus::interrupted;
  }

  [[nodiscard]] double residual() const { return residual_; }  ///< residual of the last solve()
  /// What found the solution of the last solve(); of an unsolved program, what was tried last.
  [[nodiscard]] ProgramSolver solved_by() const { return solved_by_; }
  [[nodiscard]] bool late() const { return late_; }  ///< the last solve() ended at the deadline
  /// Passes of the last solve() and of the solves that it continued, without the pass of prepare().
  [[nodiscard]] int passes() const { return passes_; }
  /// Rounds of the working set in the dual method, zero if the last solve() did not use it.
  [[nodiscard]] int rounds() const { return rounds_; }
  /// Gradient evaluations by NLopt in the last solve().
  [[nodiscard]] int evaluations() const { return dual_.evaluations(); }
  /// Newton steps that polished NLopt's results in the last solve().
  [[nodiscard]] int polishing_steps() const { return dual_.polishing_steps(); }

 private:
  static QuadraticProgramSettings without_dual(QuadraticProgramSettings settings) {
    if (!with_nlopt) settings.method = ProgramMethod::structured;
    return settings;
  }
  static int dual_capacity(const QuadraticProgramSettings& settings, int horizon) {
    const int all = 2 * Constraints * (horizon + 1);
    const int wanted =
        settings.method == ProgramMethod::nlopt ? 1000 : 2 * settings.max_dual_constraints;
    return std::max(1, std::min(wanted, all));
  }
  // True if a pass of duration `needed` and the work after it would end after the deadline, or if
  // the limit of passes is reached. Other work of the machine can increase the measured duration,
  // so it counts as slightly shorter the next time.
  [[nodiscard]] bool out_of_time(SolverClock::duration& needed) {
    if (!late_ && deadline_ && SolverClock::now() + needed + pass_time_ / 2 > *deadline_) {
      late_ = true;
      needed -= needed / 8;
    }
    return late_ || passes_ + passes_of_nlopt_ >= settings_.max_passes;
  }
  [[nodiscard]] bool solved() {
    const ProgramResidual residual = Program::residual(damping_);
    residual_ = residual.largest();
    rounded_ = residual.stationarity >= residual_;
    return residual_ <= settings_.tolerance;
  }

  void solve_by_method(const Tangent& dx0) {
    if (by_dual_) {
      if (solve_by_nlopt(dx0)) return;
      passes_of_nlopt_ = std::min(evaluations() / evaluations_per_pass, settings_.max_passes / 2);
      if (settings_.method == ProgramMethod::nlopt) {
        late_ = dual_.late();
        return fallback_step(dx0);
      }
    }
    solve_by_structure(dx0);
    leave_few_to_nlopt(dx0);
  }

  // If few constraints are active after the structured methods, NLopt solves, from their result.
  void leave_few_to_nlopt(const Tangent& dx0) {
    if (residual_ > settings_.tolerance && !last_is_for_nlopt()) return;
    this->collect_active();
    if (!few_for_nlopt(static_cast<int>(this->active().size())) || out_of_time(pass_time_)) return;
    save();
    ++passes_;
    const ProgramSolver before = solved_by_;
    if (active_set_.factorise_free(*this, damping_) && dual_.prepare(*this) && solve_by_nlopt(dx0))
      return;
    solved_by_ = before;
    restore();
  }
  [[nodiscard]] bool few_for_nlopt(int count) const {
    return settings_.method == ProgramMethod::automatic && count > 0 &&
           count <= settings_.max_dual_constraints;
  }
  // True if one pass is left, and so few constraints are assumed active that NLopt gets it.
  [[nodiscard]] bool last_is_for_nlopt() const {
    return passes_ + passes_of_nlopt_ + 1 == settings_.max_passes &&
           few_for_nlopt(active_set_.assumed());
  }

  [[nodiscard]] bool solve_by_nlopt(const Tangent& dx0) {
    const bool reached = dual_.solve(*this, dx0, deadline_, most_dual_constraints_);
    rounds_ = dual_.rounds();
    if (!reached || !solved()) return false;
    solved_by_ = evaluations() > 0 ? ProgramSolver::nlopt : ProgramSolver::riccati;
    return true;
  }

  void solve_by_structure(const Tangent& dx0) {
    if (assumes_) {
      const int contradictions = active_set_.solve(*this, dx0);
      if ((contradictions == 0 && solved()) ||
          (contradictions <= few_ && settle(dx0, contradictions))) {
        solved_by_ = this->active().empty() ? ProgramSolver::riccati : ProgramSolver::active_set;
        return;
      }
      if (last_is_for_nlopt()) {
        solved_by_ = ProgramSolver::active_set;
        return (void)solved();
      }
      // The interior point starts from the optimum without constraints: the step that the active
      // set leaves is far from any optimum.
      if (!out_of_time(pass_time_)) {
        ++passes_;
        (void)plain_pass(dx0);
      }
    } else if (!by_dual_) {
      this->sweep(dx0);
      if (this->excess() <= 0.0) {
        for (int k = 0; k <= this->horizon(); ++k) detail::fill(this->node(k).multiplier, 0.0);
        solved_by_ = ProgramSolver::riccati;
        if (solved()) return;
      }
    }
    solved_by_ = ProgramSolver::interior_point;
    solve_by_interior_point(dx0);
  }

  // Up to eight passes of the active set. From the third pass on, the number of contradictions must
  // decrease in each pass. Returns true if the program is solved.
  bool settle(const Tangent& dx0, int contradictions) {
    for (int tries = 0; tries < 8 && !out_of_time(pass_time_) && !last_is_for_nlopt(); ++tries) {
      const auto start = SolverClock::now();
      ++passes_;
      if (contradictions == 0 && rounded_)
        active_set_.soften();
      else if (contradictions == 0)
        active_set_.stiffen();
      if (!active_set_.factorise(*this, damping_)) return false;
      const int next = active_set_.solve(*this, dx0);
      pass_time_ = SolverClock::now() - start;
      if (next == 0 && solved()) return true;
      if (next > few_ || (tries > 1 && next > 0 && next >= contradictions)) return false;
      contradictions = next;
    }
    return false;
  }

  void solve_by_interior_point(const Tangent& dx0) {
    auto start = SolverClock::now();
    if (!begin_interior_point(1e4)) {
      for (int k = 0; k <= this->horizon(); ++k) detail::fill(this->node(k).multiplier, 0.0);
      active_set_.assume(*this);
      solved_by_ = ProgramSolver::active_set;
      (void)settle(dx0, few_);
      return;
    }
    iterate_interior_point(dx0, start, false);
    interrupted_ = cut_off();
    if (residual_ > settings_.tolerance || !hard_relaxed()) return;
    // The penalty of the hard constraints may have been too low: solve again with a higher penalty
    // if there is time.
    save();
    if (out_of_time(interior_time_) || !plain_pass(dx0)) return restore();
    start = SolverClock::now();
    if (!begin_interior_point(1e8)) return restore();
    iterate_interior_point(dx0, start, false);
    if (residual_ > settings_.tolerance) restore();
  }

  // Continues iterations that the deadline interrupted.
  [[nodiscard]] bool go_on(const Tangent& dx0) {
    interrupted_ = false;
    const auto start = SolverClock::now();
    if (!interior_point_.go_on(*this, dx0)) return false;
    iterate_interior_point(dx0, start, true);
    interrupted_ = cut_off();
    leave_few_to_nlopt(dx0);
    return true;
  }
  // After half of the allowed passes the program is outdated: a new linearisation is worth more
  // than its solution.
  [[nodiscard]] bool cut_off() const {
    return late_ && residual_ > settings_.tolerance && 2 * passes_ < settings_.max_passes;
  }

  [[nodiscard]] bool begin_interior_point(double far_above) {
    return interior_point_.start(*this, damping_, far_above, [this](int k, const auto& row) {
      return active_set_.curvature(k, row);
    });
  }

  // With `one`, one iteration runs even if there is no time; otherwise the solve would never make
  // progress.
  void iterate_interior_point(const Tangent& dx0, SolverClock::time_point start, bool one) {
    const double first = interior_point_.first_mu();
    double next_try = 1e-2 * interior_point_.mu();
    for (; one || !out_of_time(interior_time_); one = false) {
      ++passes_;
      if (!interior_point_.iterate(*this)) break;
      const auto end = SolverClock::now();
      interior_time_ = end - start;
      start = end;
      const double mu = interior_point_.mu();
      if (mu < next_try && interior_point_.decided(few_)) {
        next_try = 1e-2 * mu;
        interior_point_.finish(*this, true);
        active_set_.assume(*this);
        if (settle(dx0, few_ + 1)) return;
        if (last_is_for_nlopt()) return (void)solved();
        start = SolverClock::now();
      }
      if (mu < 1e-10 * first) {
        interior_point_.finish(*this, false);
        if (solved() || mu < 1e-18 * first) return;
      }
    }
    // The iterations were interrupted: use their result as a guess of the active constraints.
    interior_point_.finish(*this, true);
    (void)solved();
  }

  // Step for the case that there is no time to solve the program. Compares inputs that follow the
  // gains of the last pass with the inputs of the linearised plan, both clamped to the hard bounds.
  // Uses the inputs with the lower cost. The multipliers do not change.
  void fallback_step(const Tangent& dx0) {
    const auto cost_of_clamped = [&](bool follows) {
      this->set_first(dx0);
      this->riccati.sweep_with(this->steps(), [&](int k, auto& w) {
        if (!follows) std::fill_n(w.data() + States, Inputs, 0.0);
        this->clamp_input(k, w.data(), w.data() + States);
      });
      this->predict();
      return this->cost_of_step(damping_);
    };
    const double following = cost_of_clamped(true);
    std::swap(saved_steps_, this->steps());
    if (!(cost_of_clamped(false) < following)) {
      std::swap(saved_steps_, this->steps());
      this->predict();
    }
    (void)solved();
  }

  [[nodiscard]] bool hard_relaxed() const {
    for (const auto& [k, i] : this->active()) {
      const auto& n = this->node(k);
      if (n.hard[detail::size(i)] && std::abs(n.multiplier(i)) >= 0.99 * n.penalty(i)) return true;
    }
    return false;
  }

  void save() {
    for (int k = 0; k <= this->horizon(); ++k) {
      saved_steps_[detail::size(k)] = this->step(k);
      saved_multipliers_[detail::size(k)] = this->node(k).multiplier;
      saved_penalties_[detail::size(k)] = this->node(k).penalty;
    }
  }
  void restore() {
    for (int k = 0; k <= this->horizon(); ++k) {
      this->step(k) = saved_steps_[detail::size(k)];
      this->node(k).multiplier = saved_multipliers_[detail::size(k)];
      auto& n = this->node(k);
      n.penalty = saved_penalties_[detail::size(k)];
      for (int i = 0; i < Constraints; ++i)
        if (n.hard[detail::size(i)]) n.finite_penalty(i) = n.penalty(i);
    }
    this->predict();
    (void)solved();
  }

  // The optimal step without constraints, by a pass without constraints.
  bool plain_pass(const Tangent& dx0) {
    if (!active_set_.factorise_free(*this, damping_)) return false;
    this->sweep(dx0);
    return true;
  }

  QuadraticProgramSettings settings_;
  DualMethod<States, Inputs, Constraints, Pattern> dual_;
  ActiveSet<States, Inputs, Constraints, Pattern> active_set_;
  InteriorPoint<States, Inputs, Constraints, Pattern> interior_point_;
  int few_;  // contradictions from which the active set usually recovers: one in two nodes
  std::vector<typename Program::Vector> saved_steps_;
  std::vector<typename Program::Values> saved_multipliers_, saved_penalties_;
  int most_dual_constraints_ = 0;  // set by the last prepare()
  std::optional<SolverClock::time_point> deadline_;
  // Duration of the last pass, of the last interior-point iteration, and of computing the gradients
  // in the last prepare().
  SolverClock::duration pass_time_{}, interior_time_{}, gradients_time_{};
  double damping_ = 0.0, residual_ = 0.0;
  int passes_ = 0, rounds_ = 0;
  // An attempt of NLopt before the passes that found no solution counts towards their limit: so
  // many gradient evaluations take about as long as a pass.
  static constexpr int evaluations_per_pass = 40;
  int passes_of_nlopt_ = 0;
  ProgramSolver solved_by_ = ProgramSolver::riccati;
  bool by_dual_ = true, late_ = false;
  bool assumes_ = false;   // the last factorisation includes the constraints that had a multiplier
  bool unsolved_ = false;  // the last program was interrupted: its multipliers are a bad guess
  bool interrupted_ = false;
  bool rounded_ = false;  // the last residual is of the inputs' stationarity: of rounding errors
};

}  // namespace tilt_ropter::optimal_control
