// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/detail/subproblem.hpp>
#include <tilt_ropter/optimal_control/detail/trajectory.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace tilt_ropter::optimal_control {

/// Returns the distance of `value` outside its bounds, or zero if it is inside; NaN for NaN.
[[nodiscard]] inline double violation(double value, double lower, double upper) {
  const double over = std::max(value - upper, lower - value);
  return over <= 0.0 ? 0.0 : over;
}

/// Merit function of the line search: cost + weighted 1-norms of defects and violations (Nocedal &
/// Wright, "Numerical Optimization", Sec. 15.4). The weights follow the multipliers (Powell 1978).
template <typename Problem, typename Program>
class Merit {
 public:
  using D = ProblemDimensions<Problem>;
  using Tangent = typename D::Tangent;
  using AllConstraints = ProblemConstraints<Problem>;
  using Constraints = typename AllConstraints::Values;

  /// Allocates; the functions below do not.
  explicit Merit(int horizon)
      : defect_weights_(detail::size(horizon) + 1), constraint_weights_(defect_weights_.size()) {
    forget();
  }

  /// Sets all weights to zero.
  void forget() {
    for (Tangent& w : defect_weights_) w.setZero();
    for (Constraints& w : constraint_weights_) w.setZero();
  }

  /// Sets every weight to `weight`, but that of a soft constraint at most to its penalty.
  void weigh_alike(const Program& program, double weight) {
    for (std::size_t k = 0; k < defect_weights_.size(); ++k) {
      const auto& node = program.node(static_cast<int>(k));
      for (int i = 0; i < D::nx; ++i) defect_weights_[k](i) = weight;
      for (int i = 0; i < AllConstraints::count; ++i)
        constraint_weights_[k](i) =
            node.hard[detail::size(i)] ? weight : std::min(weight, node.penalty(i));
    }
  }

  /// Updates the weights from the multipliers of a solved program. Returns the slope of the merit
  /// function along the step of the program.
  double update(const Program& program, int horizon) {
    double slope = 0.0;
    double largest = 0.0;
    for (int k = 1; k <= horizon; ++k)
      largest = std::max(largest, detail::largest(program.costate(k)));
    const double least = least_share * largest;
    for (int k = horizon; k >= 0; --k) {
      const auto& s = program.riccati.stage(k);
      const auto& node = program.node(k);
      Constraints& constraint_weight = constraint_weights_[detail::size(k)];
      const double* step = program.step(k).data();  // (dx, du)
      for (int i = 0; i < (k < horizon ? D::nx + D::nu : D::nx); ++i)
        slope += s.cost.gradient(i) * step[i];
      for (int i = 0; i < AllConstraints::count; ++i) {
        follow(constraint_weight(i), node.multiplier(i));
        // With a weight above the penalty, the merit would rise towards a solution that relaxes
        // this constraint.
        constraint_weight(i) = std::min(constraint_weight(i), node.penalty(i));
        slope += of_constraint(node, constraint_weight, i, node.predicted(i)) -
                 of_constraint(node, constraint_weight, i, node.value(i));
      }
      if (k < horizon) {
        Tangent& defect_weight = defect_weights_[detail::size(k)];
        for (int i = 0; i < D::nx; ++i)
          follow(defect_weight(i), std::max(least, std::abs(program.costate(k + 1)(i))));
        slope -= weighted_norm(k, s.defect.data());
      }
    }
    return slope;
  }

  /// Returns the merit at the point where `program` was linearised; `cost` is the cost there.
  [[nodiscard]] double value_here(const Problem& problem, const Program& program,
                                  const AugmentedLagrangian<Problem>& equalities,
                                  const Trajectory<Problem>& here, double cost) const {
    double sum = cost;
    for (int k = 0; k <= here.horizon(); ++k) {
      sum += equalities.value(problem, k, here.x(k)) +
             of_constraints(program, k, program.node(k).value);
      if (k < here.horizon()) sum += weighted_norm(k, program.riccati.stage(k).defect.data());
    }
    return sum;
  }

  /// Returns the merit at any other trajectory.
  [[nodiscard]] double value(const Problem& problem, const Program& program,
                             const AugmentedLagrangian<Problem>& equalities,
                             const Trajectory<Problem>& at) const {
    double sum = 0.0;
    for (int k = 0; k <= at.horizon(); ++k) {
      const auto& x = at.x(k);
      const auto& u = at.u(k);
      sum += problem.cost(k, x, u) + equalities.value(problem, k, x);
      sum += of_constraints(program, k, AllConstraints::values(problem, k, x, u));
      if (k < at.horizon()) {
        const Tangent defect = problem.difference(problem.step(k, x, u), at.x(k + 1));
        sum += weighted_norm(k, defect.data());
      }
    }
    return sum;
  }

 private:
  static void follow(double& weight, double multiplier) {
    const double m = 1.1 * std::abs(multiplier);
    weight = std::max(m, 0.5 * (weight + m));
  }

  [[nodiscard]] double weighted_norm(int k, const double* defect) const {
    const Tangent& weight = defect_weights_[detail::size(k)];
    double sum = 0.0;
    for (int i = 0; i < D::nx; ++i) sum += weight(i) * std::abs(defect[i]);
    return sum;
  }

  [[nodiscard]] double of_constraints(const Program& program, int k,
                                      const Constraints& value) const {
    const auto& node = program.node(k);
    const Constraints& weight = constraint_weights_[detail::size(k)];
    double sum = 0.0;
    for (int i = 0; i < AllConstraints::count; ++i) sum += of_constraint(node, weight, i, value(i));
    return sum;
  }
  // Cost of the violation if the stiffness is finite, otherwise the weight times the violation.
  [[nodiscard]] static double of_constraint(const typename Program::Node& node,
                                            const Constraints& weight, int i, double value) {
    const double v = violation(value, node.lower(i), node.upper(i));
    return std::isfinite(node.stiffness(i)) ? violation_cost(node.penalty(i), node.stiffness(i), v)
                                            : weight(i) * v;
  }

  static constexpr double least_share = 0.01;

  std::vector<Tangent> defect_weights_;  // one for each interval, at its first node
  std::vector<Constraints> constraint_weights_;
};

/// The best of a guess and of the ends of several starts from it. The measure is the cost plus
/// defects and violations times the largest multiplier of all starts, at most times their penalty.
/// The weights of the line search do not serve: they are near zero where a multiplier is, so that
/// iterates far from any solution can look good.
template <typename Problem, typename Program>
class BestPlan {
 public:
  using Plan = Trajectory<Problem>;

  /// Allocates; the functions below do not.
  explicit BestPlan(int horizon) : guess_(horizon), plan_(horizon), merit_(horizon) {}

  /// Starts with the guess as the best plan.
  void begin(const Plan& guess) {
    guess_ = plan_ = guess;
    status_ = SolveStatus::stalled;
    weight_ = 0.0;
    is_guess_ = true;
    is_last_ = false;
  }

  /// Takes the end of a start if no plan before it is better. `program` has the multipliers.
  void offer(const Problem& problem, const Program& program,
             const AugmentedLagrangian<Problem>& equalities, const Plan& end, SolveStatus status) {
    for (int k = 1; k <= end.horizon(); ++k)
      weight_ = std::max(weight_, detail::largest(program.costate(k)));
    for (const auto& [k, i] : program.active())
      weight_ = std::max(weight_, std::abs(program.node(k).multiplier(i)));
    if (!(weight_ < detail::infinity)) weight_ = 1e12;
    const auto value = [&](const Plan& plan) {
      return value_of(problem, program, equalities, plan);
    };
    // Rounding decides for a solution.
    const double best = value(plan_), rounding = 1e-6 * std::abs(best);
    is_last_ =
        value(end) <= best + (is_solution(status_) ? -rounding : rounding) || !std::isfinite(best);
    if (!is_last_) return;
    plan_ = end;
    status_ = status;
    is_guess_ = false;
  }

  /// Replaces `plan` by `other` if that is better by the same measure.
  void choose(const Problem& problem, const Program& program,
              const AugmentedLagrangian<Problem>& equalities, Plan& plan, const Plan& other) {
    const double value = value_of(problem, program, equalities, plan);
    if (!(value <= value_of(problem, program, equalities, other))) plan = other;
  }

  [[nodiscard]] const Plan& guess() const { return guess_; }
  [[nodiscard]] const Plan& plan() const { return plan_; }
  /// How the start ended that led to plan(); `stalled` if it is the guess.
  [[nodiscard]] SolveStatus status() const { return status_; }
  [[nodiscard]] bool is_guess() const { return is_guess_; }
  [[nodiscard]] bool is_last() const { return is_last_; }  ///< plan() was offered last

 private:
  [[nodiscard]] double value_of(const Problem& problem, const Program& program,
                                const AugmentedLagrangian<Problem>& equalities, const Plan& plan) {
    merit_.weigh_alike(program, weight_);
    double sum = merit_.value(problem, program, equalities, plan);
    for (int k = 1; k <= plan.horizon(); ++k)
      sum += weight_ * equalities.distance(problem, k, plan.x(k));
    return sum;
  }

  Plan guess_, plan_;
  Merit<Problem, Program> merit_;
  SolveStatus status_ = SolveStatus::stalled;
  double weight_ = 0.0;
  bool is_guess_ = true, is_last_ = false;
};

/// Anderson acceleration (Anderson 1965; Walker & Ni, "Anderson acceleration for fixed-point
/// iterations", 2011) of an iteration x <- x + f(x) that converges slowly, oscillates or diverges.
/// It is a secant method that uses only the visited points and their f. Allocates only in the
/// constructor.
class Anderson {
 public:
  using Vector = Eigen::VectorXd;

  /// For vectors of `size` entries. Stores the last `memory` moves.
  Anderson(Eigen::Index size, int memory)
      : size_(static_cast<int>(size)),
        moves_(size, memory),
        changes_(size, memory),
        step_(size),
        gram_(memory, memory),
        factor_(memory, memory),
        weights_(memory) {}

  [[nodiscard]] bool empty() const { return count_ == 0; }
  void clear() { count_ = next_ = 0; }

  /// Adds a move between two points. `before` and `after` are f at these points. The entries should
  /// be scaled to similar importance.
  void add(const Vector& move, const Vector& before, const Vector& after) {
    const int memory = static_cast<int>(weights_.size());
    for (int i = 0; i < size_; ++i) {
      moves_(i, next_) = move(i);
      changes_(i, next_) = after(i) - before(i);
    }
    count_ = std::min(count_ + 1, memory);
    for (int i = 0; i < count_; ++i)
      gram_(i, next_) = gram_(next_, i) = detail::dot(change(i), change(next_), size_);
    next_ = (next_ + 1) % memory;
  }

  /// Returns the accelerated step from a point with this f. The step combines the stored moves so
  /// that the predicted f is smallest in the 2-norm.
  [[nodiscard]] const Vector& step(const Vector& f) {
    // Least squares by the normal equations. A column that depends linearly on the columns before
    // it gets weight zero.
    for (int j = 0; j < count_; ++j) {
      weights_(j) = detail::dot(change(j), f.data(), size_);
      for (int i = j; i < count_; ++i) factor_(i, j) = gram_(i, j);
      factor_(j, j) *= 1.0 + 1e-10;
    }
    (void)detail::factorise(factor_.data(), factor_.rows(), count_, 1e-11);
    detail::solve_factorised(factor_.data(), factor_.rows(), count_, weights_.data());
    std::copy_n(f.data(), size_, step_.data());
    for (const Matrix* columns : {&changes_, &moves_})
      detail::add_product(-1.0, {columns->data(), size_, count_, size_}, {weights_.data()},
                          step_.data());
    return step_;
  }

 private:
  using Matrix = Eigen::MatrixXd;

  [[nodiscard]] const double* change(int i) const { return &changes_(0, i); }

  int size_;
  Matrix moves_, changes_;  // one column per move
  Vector step_;
  Matrix gram_, factor_;  // changes_' changes_ and its lower Cholesky factor
  Vector weights_;
  int count_ = 0, next_ = 0;
};

/// Finds the next iterate of MultipleShooting::solve() from the step of a quadratic program.
///
/// If the steps have become slow or the merit function is nearly level, the step from Anderson is
/// tried first, up to the first bound that is not active. This step need not lower the merit if the
/// merit is level or if rounding errors hide its change. The norms in the merit function reject
/// good steps there (Maratos effect). Such a step is on trust: if the step of the next program is
/// not shorter, the search goes back to the start of the step on trust. Otherwise, the search is a
/// line search along the step of the program.
template <typename Problem, typename Program>
class StepSearch {
 public:
  using D = ProblemDimensions<Problem>;
  using Points = Trajectory<Problem>;
  static constexpr int nx = D::nx, nu = D::nu;

  /// Allocates; the functions below do not.
  StepSearch(int horizon, const SolverSettings& settings)
      : settings_(settings),
        horizon_(horizon),
        trial_(horizon),
        base_(horizon),
        merit_(horizon),
        anderson_((nx + nu) * (horizon + 1), settings.memory),
        residual_(Eigen::VectorXd::Zero((nx + nu) * (horizon + 1))),
        base_residual_(residual_),
        move_(residual_),
        scale_(residual_) {}

  /// Call this before the first step of a solve. If `accelerated` is false, only line searches are
  /// used.
  void begin(bool accelerated) {
    forget();
    lowest_merit_ = detail::infinity;
    accelerates_ = accelerated && settings_.memory > 0;
    length_ = 1.0;
    first_ = true;
  }

  void forget() {
    merit_.forget();
    forget_moves();
  }
  /// True if the last step was accepted without a lower merit and is not yet confirmed as better.
  [[nodiscard]] bool on_trust() const { return on_trust_; }
  [[nodiscard]] double length() const { return length_; }  ///< length of the last step
  /// Lowest merit of all iterates since begin(); each merit uses the weights of its iterate.
  [[nodiscard]] double lowest_merit() const { return lowest_merit_; }
  [[nodiscard]] bool accelerates() const { return accelerates_; }
  /// Uses only line searches from now on, because the acceleration makes no progress. Discards the
  /// stored moves.
  void stop_accelerating() {
    forget_moves();
    accelerates_ = false;
  }

  /// Moves `here` by the step in `program`, which was linearised there; `cost` is the cost there.
  /// Goes back to the start of the step on trust if this step was not an improvement. Returns
  /// iterated, or stalled if no step is better.
  SolveStatus advance(const Problem& problem, const Program& program,
                      const AugmentedLagrangian<Problem>& equalities, double cost, Points& here) {
    if (accelerates_) {
      if (first_) set_scale(program);
      first_ = false;
      pack_step(program);
      if (moved_) anderson_.add(move_, base_residual_, residual_);
      if (on_trust_ && !(norm(residual_) < 0.9 * norm(base_residual_)))
        return go_back(problem, here, true);
    }
    const double slope = merit_.update(program, horizon_);
    const double merit = merit_.value_here(problem, program, equalities, here, cost);
    lowest_merit_ = std::min(lowest_merit_, merit);
    const bool level = -slope <= 1e-4 * (1.0 + std::abs(merit)) && !searches_;
    const bool hidden = -slope <= 1e-9 * (1.0 + std::abs(merit));
    searches_ = on_trust_ = false;
    attempts_ = 0;
    const auto merit_of_trial = [&] { return merit_.value(problem, program, equalities, trial_); };
    if (!accelerates_)
      return search_line(problem, program, merit, slope, hidden, merit_of_trial, here);

    // Far from the solution and with fast progress, stored moves are soon outdated.
    const bool far = -slope > 1e-3 * (1.0 + std::abs(merit));
    if (far && moved_ && norm(residual_) < 0.6 * norm(base_residual_)) anderson_.clear();
    base_ = here;
    base_residual_ = residual_;
    moved_ = true;
    if (!anderson_.empty()) {
      move_ = anderson_.step(residual_);
      stop_at_bounds(program);
      try_move(problem, here);
      const bool lower = merit_of_trial() <= merit + 1e-4 * slope;
      if (lower || level || hidden) {
        on_trust_ = !lower;
        length_ = 1.0;
        here.swap(trial_);
        return SolveStatus::iterated;
      }
    }
    on_trust_ = hidden;
    const SolveStatus status =
        search_line(problem, program, merit, slope, hidden, merit_of_trial, here);
    for (int i = 0; i < move_.size(); ++i) move_(i) = length_ * residual_(i);
    return status;
  }

  /// Goes back to the start of the step on trust. If `learnt`, the acceleration knows the end of
  /// that step, and tries a better step from the same start (fewer than max_attempts times).
  /// Otherwise the line search must find the next step.
  SolveStatus go_back(const Problem& problem, Points& here, bool learnt) {
    here = base_;
    if (learnt && ++attempts_ < max_attempts) {
      move_ = anderson_.step(base_residual_);
      try_move(problem, here);
      here.swap(trial_);
    } else {
      forget_moves();
      searches_ = true;
    }
    return SolveStatus::iterated;
  }
  /// Goes back to the start of the step on trust, at the end of a solve.
  void give_back(Points& here) { here.swap(base_); }

 private:
  // Line search along the step of the quadratic program.
  template <typename MeritOfTrial>
  SolveStatus search_line(const Problem& problem, const Program& program, double merit,
                          double slope, bool hidden, const MeritOfTrial& merit_of_trial,
                          Points& here) {
    // A hidden merit gives no information: without acceleration, use the last length.
    double length = hidden && !accelerates_ ? length_ : 1.0;
    trial_.set_moved(problem, here, program, length);
    if (!hidden) {
      double there = merit_of_trial();
      // Parabola through the merit here, its slope and its value at the end of the step. If a
      // Gauss-Newton step goes far beyond the minimum, it does so in every iteration, and only a
      // shorter step converges.
      const double bend = there - merit - slope;
      if (bend > 0.0 && -slope < 1.5 * bend) {
        length = std::max(0.1, -slope / (2.0 * bend));
        trial_.set_moved(problem, here, program, length);
        there = merit_of_trial();
      }
      while (!(there <= merit + 1e-4 * length * slope)) {
        length *= 0.5;
        if (length < settings_.min_step) return SolveStatus::stalled;
        trial_.set_moved(problem, here, program, length);
        there = merit_of_trial();
      }
    }
    length_ = length;
    here.swap(trial_);
    return SolveStatus::iterated;
  }

  void forget_moves() {
    anderson_.clear();
    moved_ = on_trust_ = searches_ = false;
    attempts_ = 0;
  }

  // Packs the step of the quadratic program into one vector, scaled by the square roots of the
  // diagonals of the first Hessians.
  void pack_step(const Program& program) {
    for (int k = 0; k <= horizon_; ++k)
      for (int i = 0; i < entries_of(k); ++i)
        residual_(entry(k, i)) = scale_(entry(k, i)) * program.step(k)(i);
  }
  // Shortens move_ towards the step of the program, which keeps all bounds, so that it crosses no
  // bound that is not active. Other constraints are active beyond, and the stored moves do not tell
  // how the steps change there.
  void stop_at_bounds(const Program& program) {
    double share = 1.0;
    for (int k = 0; k <= horizon_; ++k) {
      const auto& n = program.node(k);
      for (int i = 0; i < Merit<Problem, Program>::AllConstraints::count; ++i) {
        if (n.multiplier(i) != 0.0) continue;
        double there = n.value(i);
        for (int j = 0; j < entries_of(k); ++j)
          there += (j < nx ? n.C(i, j) : n.E(i, j - nx)) * move_(entry(k, j)) / scale_(entry(k, j));
        const double from = n.predicted(i), change = std::abs(there - from);
        const double bound = there > from ? n.upper(i) : n.lower(i);
        const double room = std::max(0.0, there > from ? bound - from : from - bound);
        if (change > room + 1e-9 * (1.0 + std::abs(bound))) share = std::min(share, room / change);
      }
    }
    for (int i = 0; share < 1.0 && i < move_.size(); ++i)
      move_(i) = residual_(i) + share * (move_(i) - residual_(i));
  }
  void try_move(const Problem& problem, const Points& here) {
    for (int k = 0; k <= horizon_; ++k) {
      typename D::Tangent dx;
      for (int i = 0; i < nx; ++i) dx(i) = move_(entry(k, i)) / scale_(entry(k, i));
      trial_.x(k) = problem.retract(here.x(k), dx);
      for (int i = nx; i < entries_of(k); ++i)
        trial_.u(k)(i - nx) = here.u(k)(i - nx) + move_(entry(k, i)) / scale_(entry(k, i));
    }
  }
  void set_scale(const Program& program) {
    for (int k = 0; k <= horizon_; ++k) {
      const auto& hessian = program.riccati.stage(k).cost.hessian;
      for (int i = 0; i < entries_of(k); ++i)
        scale_(entry(k, i)) = std::sqrt(std::max(std::abs(hessian(i, i)), 1e-6));
    }
  }
  // Number of entries of (dx, du) of node k, and index of entry i of node k in a vector of all
  // nodes.
  [[nodiscard]] int entries_of(int k) const { return k < horizon_ ? nx + nu : nx; }
  [[nodiscard]] static int entry(int k, int i) { return (nx + nu) * k + i; }

  [[nodiscard]] static double norm(const Eigen::VectorXd& v) {
    return std::sqrt(detail::dot(v.data(), v.data(), static_cast<int>(v.size())));
  }

  static constexpr int max_attempts = 5;

  SolverSettings settings_;
  int horizon_;
  Points trial_, base_;  // base_: start of the last step
  Merit<Problem, Program> merit_;
  Anderson anderson_;
  // Scaled: step of the program at the iterate, step of the program at the base, step taken from
  // the base. Last: the scales.
  Eigen::VectorXd residual_, base_residual_, move_, scale_;
  double length_ = 1.0, lowest_merit_ = 0.0;
  bool accelerates_ = false, first_ = true;
  bool moved_ = false;     // move_ and base_residual_ are set
  bool on_trust_ = false;  // the last step was accepted without a lower merit
  bool searches_ = false;  // the next step must lower the merit
  int attempts_ = 0;       // steps on trust from the same base
};

}  // namespace tilt_ropter::optimal_control
