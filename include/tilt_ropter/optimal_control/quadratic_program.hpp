// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/entries.hpp>
#include <tilt_ropter/optimal_control/active_set.hpp>
#include <tilt_ropter/optimal_control/dual_method.hpp>
#include <tilt_ropter/optimal_control/interior_point.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>
#include <tilt_ropter/optimal_control/subproblem.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

/// Solves the quadratic program of one SQP step, by whichever method suits it.
namespace tilt_ropter {

/// How a solve of a quadratic program ended.
enum class ProgramStatus {
  solved,       ///< the residual is below the tolerance
  interrupted,  ///< by the deadline or a limit: the step is the best one so far
  failed,       ///< no factorisation or a number that is not finite; there is no step
};

/// prepare() does what needs no measurement, solve() the rest. Allocates in its constructor; later
/// only NLopt does.
template <int States, int Inputs, int Rows, typename Pattern = FullTransition>
class QuadraticProgram : public Subproblem<States, Inputs, Rows, Pattern> {
 public:
  using Program = Subproblem<States, Inputs, Rows, Pattern>;
  using Tangent = typename Program::Tangent;

  /// For `horizon` intervals; settings must be valid.
  QuadraticProgram(int horizon, const QuadraticProgramSettings& settings)
      : Program(horizon),
        settings_(settings),
        dual_(horizon, dual_capacity(settings, horizon), settings.dual),
        active_set_(horizon),
        interior_point_(horizon),
        saved_steps_(static_cast<std::size_t>(horizon) + 1, detail::Filled()),
        saved_multipliers_(saved_steps_.size()),
        saved_prices_(saved_steps_.size()) {}

  /// Factorises with `damping` on the Hessians' diagonals, for the constraints that have
  /// multipliers. False if the cost has no minimum.
  [[nodiscard]] bool prepare(double damping = 0.0) {
    goes_on_ = false;
    const auto start = SolverClock::now();
    damping_ = damping;
    this->collect_active();
    const bool few_rows =
        static_cast<int>(this->active().size()) <= std::max(1, settings_.max_dual_rows);
    by_dual_ = settings_.method == ProgramMethod::dual ||
               (settings_.method == ProgramMethod::automatic && few_rows && !unsolved_);
    bool good;
    assumes_ = !by_dual_ && settings_.method == ProgramMethod::automatic && !unsolved_;
    if (assumes_) {
      active_set_.assume(*this);
      good = active_set_.factorise(*this, damping);
    } else {
      good = active_set_.factorise_free(*this, damping);
    }
    const auto factorised = SolverClock::now();
    pass_time_ = 2 * (factorised - start);  // with the sweep after it
    if (good && by_dual_) by_dual_ = dual_.prepare(*this);
    rows_time_ = SolverClock::now() - factorised;
    return good;
  }
  /// What the last prepare() took for the gradients of the dual's first working set.
  [[nodiscard]] SolverClock::duration rows_time() const { return rows_time_; }
  [[nodiscard]] double damping() const { return damping_; }  ///< of the last prepare()
  /// True if the last solve() was cut off by its deadline: the next one goes on with the same
  /// program, for another initial step, instead of a new one after prepare().
  [[nodiscard]] bool goes_on() const { return goes_on_; }
  /// False where it was cut off before the first pass that takes all constraints into account.
  [[nodiscard]] bool has_step() const { return !goes_on_ || passes_ > 0; }
  void forget() { goes_on_ = unsolved_ = false; }  ///< it shall not

  /// The step and multipliers for the initial step dx0; after prepare(). A pass that would end
  /// after the deadline, by what the last ones took, is not begun. In `real_time` NLopt's working
  /// set does not grow beyond the constraints that it begins with at most, which bounds the time
  /// that is lost where another method has to take over.
  ProgramStatus solve(const Tangent& dx0, std::optional<SolverClock::time_point> deadline = {},
                      bool real_time = false) {
    most_dual_rows_ = real_time && settings_.method != ProgramMethod::dual
                          ? std::max(1, settings_.max_dual_rows)
                          : dual_.capacity();
    deadline_ = deadline;
    late_ = false;
    if (!goes_on_) {
      passes_ = 0;
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

  /// Takes the input step du of node k at this dx into its hard bounds: those of constraints that
  /// see one input (and the state).
  void clamp_input(int k, const double* dx, double* du) const {
    if constexpr (Rows > 0) {
      const auto& n = this->node(k);
      for (int i = 0; i < Rows; ++i) {
        if (!n.hard[static_cast<std::size_t>(i)] || n.stiffness(i) < infinity) continue;
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

  /// Takes the first input into its hard bounds; the inputs after it follow by the gains, also what
  /// is rounding, as a horizon can make a thousand times as much of it. The residual counts what is
  /// more than that. Returns what solve() does.
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
          this->step(k)(i) += saved_steps_[static_cast<std::size_t>(k)](i);
      this->predict();
      if (largest > 1e-12 * (1.0 + size)) (void)solved();
    }
    return residual_ <= settings_.tolerance ? ProgramStatus::solved : ProgramStatus::interrupted;
  }

  [[nodiscard]] double residual() const { return residual_; }  ///< of the last solve
  [[nodiscard]] bool late() const { return late_; }            ///< it ended at the deadline
  /// Of the last solve, besides prepare()'s, and of those that it went on from.
  [[nodiscard]] int passes() const { return passes_; }
  [[nodiscard]] int rounds() const { return dual_.rounds(); }  ///< of the working set

 private:
  // Room for twice the constraints that it begins with at most: in a solve to convergence most that
  // join leave again, and giving up halfway costs more than finishing.
  static int dual_capacity(const QuadraticProgramSettings& settings, int horizon) {
    const int all = 2 * Rows * (horizon + 1);
    const int wanted = settings.method == ProgramMethod::dual ? 1000 : 2 * settings.max_dual_rows;
    return std::max(1, std::min(wanted, all));
  }
  // If a pass that takes so long would be late, with what follows it, or one too many. What it
  // takes may have been something else that the machine did, so the next time it counts as a little
  // less.
  [[nodiscard]] bool out_of_time(SolverClock::duration& needed) {
    if (!late_ && deadline_ && SolverClock::now() + needed + pass_time_ / 2 > *deadline_) {
      late_ = true;
      needed -= needed / 8;
    }
    return late_ || passes_ >= settings_.max_passes;
  }
  [[nodiscard]] bool solved() {
    residual_ = Program::residual(damping_).largest();
    return residual_ <= settings_.tolerance;
  }

  void solve_by_method(const Tangent& dx0) {
    if (by_dual_) {
      using Outcome = typename DualMethod<States, Inputs, Rows, Pattern>::Outcome;
      const Outcome outcome = dual_.solve(*this, dx0, deadline_, most_dual_rows_);
      if (outcome == Outcome::solved && solved()) return;
      if (settings_.method == ProgramMethod::dual) {
        late_ = dual_.late();
        return make_do(dx0);
      }
    } else if (assumes_) {
      const int contradictions = active_set_.solve(*this, dx0);
      if (contradictions == 0 && solved()) return;
      if (contradictions <= few && settle(dx0, contradictions)) return;
    } else {
      sweep(dx0);
      if (this->excess() <= 0.0) {
        for (int k = 0; k <= this->horizon(); ++k) detail::fill(this->node(k).multiplier, 0.0);
        if (solved()) return;
      }
    }
    solve_by_interior_point(dx0);
  }

  // Passes of the active set, as long as each has clearly fewer contradictions than the one before.
  bool settle(const Tangent& dx0, int contradictions) {
    for (int tries = 0; tries < 8 && !out_of_time(pass_time_); ++tries) {
      const auto start = SolverClock::now();
      ++passes_;
      if (contradictions == 0) active_set_.stiffen();
      if (!active_set_.factorise(*this, damping_)) return false;
      const int next = active_set_.solve(*this, dx0);
      pass_time_ = SolverClock::now() - start;
      if (next == 0 && solved()) return true;
      if (next > few || (tries > 1 && next > 0 && next >= contradictions)) return false;
      contradictions = next;
    }
    return false;
  }

  void solve_by_interior_point(const Tangent& dx0) {
    auto start = SolverClock::now();
    if (!begin_interior_point(1e4)) {
      for (int k = 0; k <= this->horizon(); ++k) detail::fill(this->node(k).multiplier, 0.0);
      active_set_.assume(*this);
      (void)settle(dx0, few);
      return;
    }
    iterate_interior_point(dx0, start, false);
    goes_on_ = cut_off();
    if (residual_ > settings_.tolerance || !hard_given_up()) return;
    // Their price may have been too low: once more with a higher one, if there is time.
    save();
    if (out_of_time(interior_time_) || !plain_pass(dx0)) return restore();
    start = SolverClock::now();
    if (!begin_interior_point(1e8)) return restore();
    iterate_interior_point(dx0, start, false);
    if (residual_ > settings_.tolerance) restore();
  }

  // Goes on with iterations that were cut off.
  [[nodiscard]] bool go_on(const Tangent& dx0) {
    goes_on_ = false;
    const auto start = SolverClock::now();
    if (!interior_point_.go_on(*this, dx0)) return false;
    iterate_interior_point(dx0, start, true);
    goes_on_ = cut_off();
    return true;
  }
  // After half the passes a program is old: linearised anew, it is worth more than when solved.
  [[nodiscard]] bool cut_off() const {
    return late_ && residual_ > settings_.tolerance && 2 * passes_ < settings_.max_passes;
  }

  [[nodiscard]] bool begin_interior_point(double far_above) {
    return interior_point_.start(*this, damping_, far_above, [this](int k, const auto& row) {
      return active_set_.curvature(k, row);
    });
  }

  // With `one`, there is always time for one iteration, or nothing would ever come of it.
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
      if (mu < next_try && interior_point_.undecided() <= few) {
        next_try = 1e-2 * mu;
        interior_point_.finish(*this, true);
        active_set_.assume(*this);
        if (settle(dx0, few + 1)) return;
        start = SolverClock::now();
      }
      if (mu < 1e-10 * first) {
        interior_point_.finish(*this, false);
        if (solved() || mu < 1e-18 * first) return;
      }
    }
    // Cut off, its best use is a guess of what holds.
    interior_point_.finish(*this, true);
    (void)solved();
  }

  // The step where there is no time to solve anything: inputs that follow the gains of the last
  // pass as far as hard bounds allow, or those of the plan that was linearised, whichever costs
  // less. Multipliers stay what they are.
  void make_do(const Tangent& dx0) {
    this->set_first(dx0);
    const auto clamp = [this](int k, auto& w) {
      this->clamp_input(k, w.data(), w.data() + States);
    };
    this->riccati.sweep_with(this->steps(), clamp);
    this->predict();
    const double following = this->price_of_step(damping_);
    std::swap(saved_steps_, this->steps());
    for (auto& w : this->steps()) detail::fill(w, 0.0);
    this->set_first(dx0);
    this->riccati.sweep_with(this->steps(), [&](int k, auto& w) {
      std::fill_n(w.data() + States, Inputs, 0.0);
      clamp(k, w);
    });
    this->predict();
    if (!(this->price_of_step(damping_) < following)) {
      std::swap(saved_steps_, this->steps());
      this->predict();
    }
    (void)solved();
  }

  [[nodiscard]] bool hard_given_up() const {
    for (const auto& [k, i] : this->active()) {
      const auto& n = this->node(k);
      if (n.hard[static_cast<std::size_t>(i)] && std::abs(n.multiplier(i)) >= 0.99 * n.price(i))
        return true;
    }
    return false;
  }

  void save() {
    for (int k = 0; k <= this->horizon(); ++k) {
      saved_steps_[static_cast<std::size_t>(k)] = this->step(k);
      saved_multipliers_[static_cast<std::size_t>(k)] = this->node(k).multiplier;
      saved_prices_[static_cast<std::size_t>(k)] = this->node(k).price;
    }
  }
  void restore() {
    for (int k = 0; k <= this->horizon(); ++k) {
      this->step(k) = saved_steps_[static_cast<std::size_t>(k)];
      this->node(k).multiplier = saved_multipliers_[static_cast<std::size_t>(k)];
      auto& n = this->node(k);
      n.price = saved_prices_[static_cast<std::size_t>(k)];
      for (int i = 0; i < Rows; ++i)
        if (n.hard[static_cast<std::size_t>(i)]) n.stand_in(i) = n.price(i);
    }
    this->predict();
    (void)solved();
  }

  // The step that is optimal without constraints, by a pass without them.
  void sweep(const Tangent& dx0) {
    this->set_first(dx0);
    this->riccati.sweep(this->steps());
    this->predict();
  }
  bool plain_pass(const Tangent& dx0) {
    if (!active_set_.factorise_free(*this, damping_)) return false;
    sweep(dx0);
    return true;
  }

  static constexpr double infinity = std::numeric_limits<double>::infinity();
  static constexpr int few = 10;  // contradictions that an active set gets over

  QuadraticProgramSettings settings_;
  DualMethod<States, Inputs, Rows, Pattern> dual_;
  ActiveSet<States, Inputs, Rows, Pattern> active_set_;
  InteriorPoint<States, Inputs, Rows, Pattern> interior_point_;
  std::vector<typename Program::Vector> saved_steps_;
  std::vector<typename Program::Values> saved_multipliers_, saved_prices_;
  int most_dual_rows_ = 0;  // of this solve
  std::optional<SolverClock::time_point> deadline_;
  // What a pass and an iteration of the interior point last took.
  SolverClock::duration pass_time_{}, interior_time_{}, rows_time_{};
  double damping_ = 0.0, residual_ = 0.0;
  int passes_ = 0;
  bool by_dual_ = true, late_ = false;
  bool assumes_ = false;   // the last factorisation holds what had a multiplier
  bool unsolved_ = false;  // the last program was cut off: its multipliers are no guess
  bool goes_on_ = false;
};

}  // namespace tilt_ropter
