// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <Eigen/Core>

#include <nlopt.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

/// The dual of a quadratic program with identity Hessian, solved by NLopt:
///
///     min over z of 1/2 |z|^2 + elastic penalty of the constraints G z + b <= 0
///     dual:  min_{0 <= lambda <= penalty}  1/2 lambda' (G G' + I/stiffness) lambda - b' lambda,
///     z = -G' lambda.
///
/// The upper bound of a multiplier is the exact L1 penalty on its constraint, so a solution exists
/// for every b (Nocedal & Wright, "Numerical Optimization", Sec. 17.2).
namespace tilt_ropter::optimal_control {

/// Minimiser of the dual above for up to `capacity` constraints. NLopt starts from the given
/// multipliers and solves until the residual is a thousandth of that at the start, or within the
/// tolerance. Projected Newton steps polish its result; where they do not suffice, NLopt goes on
/// from there.
///
/// After construction only NLopt allocates. A solve makes at most 20 calls of NLopt. A call with n
/// constraints allocates 2 blocks and frees them before it returns. Together these have at most 256
/// (n + 1) bytes (220 n in NLopt 2.7.1 for n >= 8). The first call with a new n also allocates 3
/// blocks that are kept. Together these have at most 32 n + 512 bytes (16 n + 248). These bounds
/// hold for the default algorithm. lbfgs, variable_metric and ccsa need less. For n = 150, slsqp
/// needs 1.6 MB per call.
class DualSolver {
 public:
  explicit DualSolver(int capacity, DualAlgorithm algorithm = DualAlgorithm::truncated_newton)
      : algorithm_(algorithm),
        optimizers_(detail::size(capacity) + 1),
        hessian_(Eigen::MatrixXd::Zero(capacity, capacity)),
        factor_(hessian_),
        linear_(Vector::Zero(capacity)),
        upper_(linear_),
        scale_(linear_),
        iterate_(linear_),
        gradient_(linear_),
        gradient_before_(linear_),
        candidate_(linear_),
        step_(linear_),
        reduced_(linear_),
        free_(detail::size(capacity)) {}

  /// Solves for the first `size` entries of `lambda` (in: warm start; out: solution) with the lower
  /// triangle of H = G G' + I/stiffness, offsets b and penalties, of `size` rows or more. Returns
  /// false if no finite solution was found, or none before `deadline`, which is checked between
  /// steps; lambda is then unchanged. Never throws.
  [[nodiscard]] bool solve(int size, const Eigen::MatrixXd& H, const Eigen::VectorXd& b,
                           const Eigen::VectorXd& penalty, Eigen::VectorXd& lambda,
                           std::optional<SolverClock::time_point> deadline = {}) noexcept {
    deadline_ = deadline;
    size_ = size;
    if (size_ == 0) return true;
    // Jacobi scaling: unit diagonal; each multiplier is in the unit of its constraint.
    for (int i = 0; i < size_; ++i) {
      scale_(i) = 1.0 / std::sqrt(std::max(H.coeff(i, i), 1e-300));
      linear_(i) = b.coeff(i) * scale_(i);
      upper_(i) = penalty.coeff(i) / scale_(i);
      iterate_(i) = clamped(lambda.coeff(i) / scale_(i), i);
    }
    for (int j = 0; j < size_; ++j)
      for (int i = j; i < size_; ++i)
        hessian(i, j) = hessian(j, i) = H.coeff(i, j) * scale_(i) * scale_(j);
    if (!minimise()) return false;
    for (int i = 0; i < size_; ++i)  // rounding must not hide a relaxed constraint
      lambda.coeffRef(i) = iterate_(i) >= upper_(i)
                               ? penalty.coeff(i)
                               : std::min(iterate_(i) * scale_(i), penalty.coeff(i));
    return true;
  }

  /// From now on, NLopt evaluates at most `most` gradients, and some more to end a line search.
  /// Without any left, Newton steps alone solve. Sets the two numbers below to zero.
  void begin(int most) {
    most_evaluations_ = most;
    evaluations_ = polishing_steps_ = 0;
  }
  [[nodiscard]] int evaluations() const { return evaluations_; }          ///< gradients, by NLopt
  [[nodiscard]] int polishing_steps() const { return polishing_steps_; }  ///< Newton's, after NLopt

  /// True if the deadline of the last solve() has passed.
  [[nodiscard]] bool late() const { return deadline_ && SolverClock::now() > *deadline_; }

 private:
  struct Destroy {
    void operator()(nlopt_opt optimizer) const { nlopt_destroy(optimizer); }
  };
  /// NLopt's object for one size. A copy gets its own at first use.
  struct Optimizer : std::unique_ptr<nlopt_opt_s, Destroy> {
    Optimizer() = default;
    Optimizer(const Optimizer&) noexcept : Optimizer() {}
    Optimizer(Optimizer&&) noexcept = default;
    Optimizer& operator=(const Optimizer&) noexcept {
      this->reset();
      return *this;
    }
    Optimizer& operator=(Optimizer&&) noexcept = default;
    ~Optimizer() = default;
  };
  using Vector = Eigen::VectorXd;
  static constexpr int max_rounds = 20, max_passes = 20;
  static constexpr int max_evaluations = 40;           // in one call of NLopt, between Newton steps
  static constexpr double gradient_tolerance = 1e-11;  // relative; on the scaled projected gradient
  static constexpr unsigned vector_storage = 8;        // NLopt's default needs 21 MB per call

  static nlopt_algorithm algorithm(DualAlgorithm name) {
    switch (name) {
      case DualAlgorithm::lbfgs:
        return NLOPT_LD_LBFGS;
      case DualAlgorithm::variable_metric:
        return NLOPT_LD_VAR2;
      case DualAlgorithm::ccsa:
        return NLOPT_LD_CCSAQ;
      case DualAlgorithm::slsqp:
        return NLOPT_LD_SLSQP;
      case DualAlgorithm::truncated_newton:
        break;
    }
    return NLOPT_LD_TNEWTON_PRECOND_RESTART;
  }

  /// Entry (i, j) of a matrix of the current size, stored without gaps.
  [[nodiscard]] double& hessian(int i, int j) {
    return hessian_.data()[static_cast<std::ptrdiff_t>(size_) * j + i];
  }
  [[nodiscard]] double clamped(double x, int i) const {
    return std::min(std::max(x, 0.0), upper_(i));  // NaN stays NaN
  }
  [[nodiscard]] bool finite(const Vector& numbers) const {
    detail::FiniteCheck<detail::packet_width> check;
    check.add(numbers.data(), size_);
    return check.passed();
  }

  /// Returns the objective of the dual at x and sets gradient_ to its gradient.
  double evaluate(const double* x) {
    double* g = gradient_.data();
    for (int i = 0; i < size_; ++i) g[i] = -linear_(i);
    detail::add_product(1.0, {hessian_.data(), size_, size_, size_}, {x}, g);
    return 0.5 * (detail::dot(x, g, size_) - detail::dot(x, linear_.data(), size_));
  }
  /// Largest entry of the projected gradient at x. Requires evaluate() at the same x.
  [[nodiscard]] double residual(const double* x) const {
    double largest = 0.0;
    for (int i = 0; i < size_; ++i) {
      const double entry = std::abs(clamped(x[i] - gradient_(i), i) - x[i]);
      if (entry > largest || std::isnan(entry)) largest = entry;
    }
    return largest;
  }

  static double objective(unsigned /*n*/, const double* x, double* gradient, void* self_pointer) {
    DualSolver& self = *static_cast<DualSolver*>(self_pointer);
    ++self.evaluations_;
    const double value = self.evaluate(x);
    if (gradient != nullptr) {
      std::copy_n(self.gradient_.data(), self.size_, gradient);
      // Stop NLopt: a solution within the tolerance needs no further evaluation.
      if (self.residual(x) <= self.stop_) {
        std::copy_n(x, self.size_, self.iterate_.data());
        self.solved_ = true;
        nlopt_force_stop(self.optimizer().get());
      }
    }
    return value;
  }

  /// Minimises the scaled dual from iterate_. Returns false if there is no finite solution, or none
  /// before the deadline.
  [[nodiscard]] bool minimise() {
    if (!finite(linear_) || !finite(iterate_)) return false;
    const double tolerance = gradient_tolerance * (1.0 + detail::largest(linear_.head(size_)));
    bool solved = false;
    for (int round = 0; round < max_rounds && !solved && !late(); ++round) {
      optimize(tolerance);
      solved = polish(tolerance);
    }
    return (solved || !late()) && finite(iterate_);
  }

  [[nodiscard]] Optimizer& optimizer() { return optimizers_[detail::size(size_)]; }

  /// One call of NLopt from iterate_. It ends when the residual has become a thousand times
  /// smaller, or is within the tolerance: Newton steps do the rest with fewer evaluations.
  void optimize(double tolerance) {
    if (!optimizer()) {
      optimizer().reset(nlopt_create(algorithm(algorithm_), static_cast<unsigned>(size_)));
      if (!optimizer()) return;
      nlopt_set_lower_bounds1(optimizer().get(), 0.0);
      nlopt_set_vector_storage(optimizer().get(), vector_storage);
      nlopt_set_ftol_rel(optimizer().get(), 1e-15);
    }
    nlopt_set_min_objective(optimizer().get(), objective, this);
    nlopt_set_upper_bounds(optimizer().get(), upper_.data());
    const int allowed = std::min(max_evaluations, most_evaluations_ - evaluations_);
    if (allowed <= 0) return;  // zero is no limit for NLopt
    nlopt_set_maxeval(optimizer().get(), allowed);
    evaluate(iterate_.data());
    stop_ = std::max(tolerance, 1e-3 * residual(iterate_.data()));
    solved_ = false;
    std::copy_n(iterate_.data(), size_, candidate_.data());
    double value = 0.0;
    // NLopt's return code is not reliable (positive even if all numbers were NaN), so the point
    // itself is checked.
    nlopt_optimize(optimizer().get(), candidate_.data(), &value);
    if (!solved_ && finite(candidate_))
      for (int i = 0; i < size_; ++i) iterate_(i) = clamped(candidate_(i), i);
  }

  /// Projected Newton steps (Bertsekas 1982) from iterate_. Each step computes a Cholesky
  /// factorisation for the multipliers that are not at a bound. NLopt's result is correct to a few
  /// digits; these steps improve it to rounding accuracy. Never increases the objective of the
  /// dual. Returns true if the dual is then solved within the tolerance.
  [[nodiscard]] bool polish(double tolerance) {
    evaluate(iterate_.data());
    for (int pass = 0; pass < max_passes && residual(iterate_.data()) > tolerance && !late();
         ++pass) {
      ++polishing_steps_;
      if (find_newton_step() && search_line()) continue;
      evaluate(iterate_.data());
      break;
    }
    return residual(iterate_.data()) <= tolerance;
  }

  /// Computes the Newton step step_ from iterate_ and its gradient. Returns false if the Hessian is
  /// singular.
  [[nodiscard]] bool find_newton_step() {
    int free = 0;
    for (int i = 0; i < size_; ++i) {
      const double next = iterate_(i) - gradient_(i);
      if (next <= 0.0 || next >= upper_(i))
        step_(i) = -gradient_(i);
      else
        free_[detail::size(free++)] = i;
    }
    for (int j = 0; j < free; ++j) {
      const int column = free_[detail::size(j)];
      reduced_(j) = -gradient_(column);
      double* entries = factor_.data() + static_cast<std::ptrdiff_t>(free) * j;
      for (int i = j; i < free; ++i) entries[i] = hessian(free_[detail::size(i)], column);
    }
    if (detail::factorise(factor_.data(), free, free) > 0) return false;
    detail::solve_factorised(factor_.data(), free, free, reduced_.data());
    for (int i = 0; i < free; ++i) step_(free_[detail::size(i)]) = reduced_(i);
    return true;
  }

  /// Moves iterate_ along step_ to a point with a lower objective. Returns false if it finds none.
  [[nodiscard]] bool search_line() {
    std::copy_n(gradient_.data(), size_, gradient_before_.data());
    for (double length = 1.0; length > 1e-4; length *= 0.5) {
      for (int i = 0; i < size_; ++i) candidate_(i) = clamped(iterate_(i) + length * step_(i), i);
      evaluate(candidate_.data());
      if (!(change_to_candidate() < 0.0)) continue;
      std::copy_n(candidate_.data(), size_, iterate_.data());
      return true;
    }
    return false;
  }
  /// Change of the objective to candidate_, from its gradients at both ends. Near the solution, the
  /// difference of the two objective values is smaller than their rounding errors.
  [[nodiscard]] double change_to_candidate() const {
    double change = 0.0;
    for (int i = 0; i < size_; ++i)
      change += 0.5 * (candidate_(i) - iterate_(i)) * (gradient_(i) + gradient_before_(i));
    return change;
  }

  DualAlgorithm algorithm_;
  std::vector<Optimizer> optimizers_;  // one for each size, created at first use
  Eigen::MatrixXd hessian_, factor_;   // stored without gaps, see hessian()
  Vector linear_, upper_, scale_, iterate_, gradient_, gradient_before_, candidate_, step_;
  Vector reduced_;
  std::vector<int> free_;
  int size_ = 0;
  std::optional<SolverClock::time_point> deadline_;
  double stop_ = 0.0;
  bool solved_ = false;
  int evaluations_ = 0, polishing_steps_ = 0;
  int most_evaluations_ = std::numeric_limits<int>::max();
};

}  // namespace tilt_ropter::optimal_control
