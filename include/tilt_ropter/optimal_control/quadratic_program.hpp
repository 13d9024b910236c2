#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/active_set.hpp>
#include <tilt_ropter/optimal_control/dual_method.hpp>
#include <tilt_ropter/optimal_control/interior_point.hpp>
#include <tilt_ropter/optimal_control/subproblem.hpp>

#include <algorithm>
#include <chrono>
#include <optional>
#include <utility>
#include <vector>

/// Solves the quadratic program of one SQP step, by whichever method suits it.
namespace tilt_ropter {

/// How a quadratic program is solved.
enum class ProgramMethod {
  automatic,       ///< by the dual where few constraints hold, else by Riccati passes
  dual,            ///< by NLopt: DualMethod
  interior_point,  ///< by InteriorPoint as soon as a constraint is violated
};

/// How a solve of a quadratic program ended.
enum class ProgramStatus {
  solved,       ///< the residual is below the tolerance
  interrupted,  ///< by the deadline or a limit: the step is the best one so far
  failed,       ///< no factorisation or a number that is not finite; there is no step
};

/// Limits and tolerances of one SQP step.
struct QuadraticProgramSettings {
  ProgramMethod method = ProgramMethod::automatic;
  /// Residual of a solved program (see ProgramResidual), relative.
  double tolerance = 1e-6;
  /// Constraints up to which the method `automatic` leaves them to NLopt.
  int max_dual_rows = 16;
  int max_passes = 40;  ///< Riccati passes in one solve, besides that of prepare()
  DualSettings dual;
};

inline void validate(const QuadraticProgramSettings& s) {
  require_positive("QuadraticProgramSettings.tolerance", s.tolerance);
  require(s.max_dual_rows >= 0 && s.max_dual_rows <= 1000, "QuadraticProgramSettings.max_dual_rows",
          s.max_dual_rows, "in [0, 1000]");
  require(s.max_passes >= 1, "QuadraticProgramSettings.max_passes", s.max_passes, ">= 1");
  validate(s.dual);
}

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
        saved_steps_(static_cast<std::size_t>(horizon) + 1),
        saved_multipliers_(saved_steps_.size()),
        saved_prices_(saved_steps_.size()) {}

  /// Factorises with `damping` on the Hessians' diagonals, for the constraints that have
  /// multipliers. False if the cost has no minimum.
  [[nodiscard]] bool prepare(double damping = 0.0) {
    damping_ = damping;
    this->collect_active();
    by_dual_ = settings_.method == ProgramMethod::dual ||
               (settings_.method == ProgramMethod::automatic && static_cast<int>(this->active().size()) <= dual_.capacity());
    if (!by_dual_ && settings_.method == ProgramMethod::automatic) {
      active_set_.assume(*this);
      return active_set_.factorise(*this, damping);
    }
    if (!active_set_.factorise_free(*this, damping)) return false;
    if (by_dual_) by_dual_ = dual_.prepare(*this);
    return true;
  }
  [[nodiscard]] double damping() const { return damping_; }  ///< of the last prepare()

  /// The step and multipliers for the initial step dx0; after prepare().
  ProgramStatus solve(const Tangent& dx0, std::optional<SolverClock::time_point> deadline = {}) {
    deadline_ = deadline;
    passes_ = 0;
    late_ = false;
    solve_by_method(dx0);
    bool finite = true;
    for (const auto& w : this->steps()) finite = finite && all_finite(w);
    if (!finite) return ProgramStatus::failed;
    return residual_ <= settings_.tolerance ? ProgramStatus::solved : ProgramStatus::interrupted;
  }

  /// Takes the first input, which was `before` at the point of linearisation, into its hard bounds:
  /// those of node 0 that see one input and the state, which is known.
  template <typename Input>
  void clamp_first_input(const Input& before, Input& after) const {
    const auto& n = this->node(0);
    for (int i = 0; i < Rows; ++i) {
      int j = -1, entries = 0;
      for (int l = 0; l < Inputs; ++l)
        if (n.E(i, l) != 0.0) {
          j = l;
          ++entries;
        }
      if (entries != 1 || !n.hard[static_cast<std::size_t>(i)]) continue;
      const double at_rest = n.value(i) + n.C.row(i).dot(this->dx(0)), slope = n.E(i, j);
      double low = (n.lower(i) - at_rest) / slope, high = (n.upper(i) - at_rest) / slope;
      if (low > high) std::swap(low, high);
      after(j) = before(j) + std::min(std::max(after(j) - before(j), low), high);
    }
  }

  [[nodiscard]] double residual() const { return residual_; }  ///< of the last solve
  [[nodiscard]] bool late() const { return late_; }            ///< it ended at the deadline
  [[nodiscard]] int passes() const { return passes_; }         ///< of it, besides prepare()'s
  [[nodiscard]] int rounds() const { return dual_.rounds(); }  ///< of the working set

 private:
  static int dual_capacity(const QuadraticProgramSettings& settings, int horizon) {
    const int all = 2 * Rows * (horizon + 1);
    const int wanted =
        settings.method == ProgramMethod::dual ? 1000 : settings.max_dual_rows;
    return std::max(1, std::min(wanted, all));
  }
  [[nodiscard]] bool out_of_time() {
    late_ = late_ || (deadline_ && SolverClock::now() > *deadline_);
    return late_ || passes_ >= settings_.max_passes;
  }
  [[nodiscard]] bool solved() {
    residual_ = Program::residual(damping_).largest();
    return residual_ <= settings_.tolerance;
  }

  void solve_by_method(const Tangent& dx0) {
    if (by_dual_) {
      using Outcome = typename DualMethod<States, Inputs, Rows, Pattern>::Outcome;
      const Outcome outcome = dual_.solve(*this, dx0, deadline_);
      if ((outcome == Outcome::solved && solved()) || settings_.method == ProgramMethod::dual) {
        if (outcome != Outcome::solved) (void)solved();
        return;
      }
    } else {
      const int contradictions = active_set_.solve(*this, dx0);
      if (contradictions == 0 && solved()) return;
      if (contradictions <= few && settle(dx0, contradictions)) return;
    }
    solve_by_interior_point(dx0);
  }

  // Passes of the active set, as long as each has clearly fewer contradictions than the one before.
  bool settle(const Tangent& dx0, int contradictions) {
    for (int tries = 0; tries < 8 && !out_of_time(); ++tries) {
      ++passes_;
      if (contradictions == 0) active_set_.stiffen();
      if (!active_set_.factorise(*this, damping_)) return false;
      const int next = active_set_.solve(*this, dx0);
      if (next == 0 && solved()) return true;
      if (next > few || (tries > 1 && next > 0 && next >= contradictions)) return false;
      contradictions = next;
    }
    return false;
  }

  void solve_by_interior_point(const Tangent& dx0) {
    iterate_interior_point(dx0, 1e4);
    if (residual_ > settings_.tolerance || !hard_given_up()) return;
    // Their price may have been too low: once more with a higher one, if there is time.
    save();
    if (!plain_pass(dx0)) return restore();
    iterate_interior_point(dx0, 1e8);
    if (residual_ > settings_.tolerance) restore();
  }

  void iterate_interior_point(const Tangent& dx0, double far_above) {
    interior_point_.start(*this, damping_, far_above, [this](int k, const auto& row) {
      return active_set_.curvature(k, row);
    });
    const double first = interior_point_.mu();
    double next_try = 1e-2 * first;
    while (!out_of_time()) {
      ++passes_;
      if (!interior_point_.iterate(*this)) break;
      const double mu = interior_point_.mu();
      if (mu < next_try && interior_point_.undecided() <= few) {
        next_try = 1e-2 * mu;
        interior_point_.finish(*this, true);
        active_set_.assume(*this);
        if (settle(dx0, few + 1)) return;
      }
      if (mu < 1e-10 * first) {
        interior_point_.finish(*this, false);
        if (solved() || mu < 1e-18 * first) return;
      }
    }
    interior_point_.finish(*this, false);
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
      this->node(k).price = saved_prices_[static_cast<std::size_t>(k)];
    }
    this->predict();
    (void)solved();
  }

  // The step that is optimal without constraints.
  bool plain_pass(const Tangent& dx0) {
    if (!active_set_.factorise_free(*this, damping_)) return false;
    this->step(0).template head<States>() = dx0;
    this->riccati.sweep(this->steps());
    this->predict();
    return true;
  }

  static constexpr int few = 10;  // contradictions that an active set gets over

  QuadraticProgramSettings settings_;
  DualMethod<States, Inputs, Rows, Pattern> dual_;
  ActiveSet<States, Inputs, Rows, Pattern> active_set_;
  InteriorPoint<States, Inputs, Rows, Pattern> interior_point_;
  std::vector<typename Program::Vector> saved_steps_;
  std::vector<typename Program::Values> saved_multipliers_, saved_prices_;
  std::optional<SolverClock::time_point> deadline_;
  double damping_ = 0.0, residual_ = 0.0;
  int passes_ = 0;
  bool by_dual_ = true, late_ = false;
};

}  // namespace tilt_ropter
