#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <nlopt.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

/// The dual of a quadratic program with identity Hessian, solved by NLopt:
///
///     min over z of 1/2 |z|^2 + elastic penalty of the rows G z + b <= 0
///     dual:  min_{0 <= lambda <= rho}  1/2 lambda' (G G' + I/sigma) lambda - b' lambda,
///     z = -G' lambda.
///
/// The upper bound rho on a multiplier is the exact L1 penalty on its row, so a solution exists for
/// every b (Nocedal & Wright, "Numerical Optimization", Sec. 17.2).
namespace tilt_ropter {

/// NLopt's algorithms that can solve the dual; all reach the same point.
enum class DualAlgorithm { truncated_newton, lbfgs, variable_metric, ccsa, slsqp };

/// The clock of all time limits.
using SolverClock = std::chrono::steady_clock;

/// How the dual of the rows is solved, and how well.
struct DualSettings {
  DualAlgorithm algorithm = DualAlgorithm::truncated_newton;
  int max_evaluations = 40;  ///< of the dual's gradient in one call of NLopt, between Newton steps
  double tolerance = 1e-11;  ///< on the scaled projected gradient of an accepted solution
  double row_tolerance = 1e-9;  ///< violation that makes a constraint join the working set
  int max_rounds = 20;          ///< of adding constraints
};

inline void validate(const DualSettings& s) {
  require(s.max_evaluations > 0, "DualSettings.max_evaluations", s.max_evaluations, "> 0");
  require_positive("DualSettings.tolerance", s.tolerance);
  require_positive("DualSettings.row_tolerance", s.row_tolerance);
  require(s.max_rounds > 0, "DualSettings.max_rounds", s.max_rounds, "> 0");
}

/// Minimiser of the dual above, with room for `capacity` rows. With a `Capacity` known to the
/// compiler (of up to 128, Eigen's limit) the matrices are part of the object; and those who only
/// include this do not wait for a Cholesky factorisation. From cold NLopt finds the rows that hold,
/// in short calls with projected Newton steps between them; from the last multipliers those steps
/// come first, and NLopt confirms the result or goes on from it.
///
/// After construction only NLopt allocates (with a capacity beyond 300, Eigen's Cholesky
/// factorisation does, too). A solve makes at most 20 calls of NLopt; one with n rows takes 2
/// blocks of together at most 256 (n + 1) bytes (NLopt 2.7.1: 220 n from n = 8 on) and gives them
/// back before it returns. For every n met for the first time 3 blocks of together at most 32 n +
/// 512 bytes (16 n + 248) are taken and kept. These bounds are those of the default algorithm:
/// lbfgs, variable_metric and ccsa take less, slsqp 1.6 MB a call at n = 150.
template <int Capacity = Eigen::Dynamic>
class DualSolver {
 public:
  /// Allocates; `capacity` is not more than Capacity.
  explicit DualSolver(int capacity, const DualSettings& settings = {})
      : settings_(settings),
        optimizers_(static_cast<std::size_t>(capacity) + 1),
        hessian_(capacity, capacity),
        factor_(capacity, capacity),
        linear_(capacity),
        upper_(capacity),
        scale_(capacity),
        iterate_(capacity),
        gradient_(capacity),
        candidate_(capacity),
        step_(capacity),
        lower_(Vector::Zero(capacity)),
        reduced_(capacity),
        free_(static_cast<std::size_t>(capacity)) {}

  /// Solves for `lambda` (in: warm start; out: solution) with the lower triangle of H = G G' +
  /// I/sigma (size x size), offsets b and bounds rho. Returns false if no finite solution was
  /// found, or none before `deadline`, which is looked at between steps; lambda is then what it
  /// was. Never throws.
  template <typename Hessian, typename Offset, typename Bound, typename Multiplier>
  [[nodiscard]] bool solve(const Eigen::MatrixBase<Hessian>& H, const Eigen::MatrixBase<Offset>& b,
                           const Eigen::MatrixBase<Bound>& rho,
                           Eigen::MatrixBase<Multiplier>& lambda,
                           std::optional<SolverClock::time_point> deadline = {}) noexcept {
    deadline_ = deadline;
    size_ = static_cast<int>(b.size());
    if (size_ == 0) return true;
    // Jacobi scaling: unit diagonal, multipliers in units of their row.
    scale_.head(size_) = H.diagonal().array().max(1e-300).sqrt().inverse();
    for (int j = 0; j < size_; ++j)
      for (int i = j; i < size_; ++i) {
        hessian_(i, j) = H(i, j) * scale_(i) * scale_(j);
        hessian_(j, i) = hessian_(i, j);
      }
    linear_.head(size_) = b.cwiseProduct(scale_.head(size_));
    upper_.head(size_) = rho.cwiseQuotient(scale_.head(size_));
    iterate_.head(size_) =
        lambda.cwiseQuotient(scale_.head(size_)).cwiseMax(0.0).cwiseMin(upper_.head(size_));
    if (!all_finite(linear_.head(size_)) || !all_finite(iterate_.head(size_))) return false;

    const double tolerance =
        settings_.tolerance * (1.0 + linear_.head(size_).cwiseAbs().maxCoeff());
    // The last multipliers are nearly right; without any, NLopt finds the rows that hold first.
    if (iterate_.head(size_).maxCoeff() > 0.0) refine(tolerance);
    bool solved = false;
    for (int round = 0; round < max_rounds && !solved && !late(); ++round) {
      solved = optimize(tolerance);
      if (!solved) refine(tolerance);
    }
    if (!solved && late()) return false;
    if (!all_finite(iterate_.head(size_))) return false;
    lambda = iterate_.head(size_).cwiseProduct(scale_.head(size_)).cwiseMin(rho);
    for (int i = 0; i < size_; ++i)
      if (iterate_(i) >= upper_(i)) lambda(i) = rho(i);  // rounding must not hide a row given up
    return true;
  }

  /// Gradient evaluations that NLopt asked for since construction.
  [[nodiscard]] long evaluations() const { return evaluations_; }

  /// True if the deadline of the last solve() has passed.
  [[nodiscard]] bool late() const { return deadline_ && SolverClock::now() > *deadline_; }

 private:
  struct Destroy {
    void operator()(nlopt_opt optimizer) const { nlopt_destroy(optimizer); }
  };
  using Optimizer = std::unique_ptr<nlopt_opt_s, Destroy>;
  using Vector = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, Capacity, 1>;
  using Matrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, Capacity, Capacity>;
  static constexpr int max_rounds = 20, max_passes = 20;
  static constexpr unsigned vector_storage = 8;  // NLopt's own choice takes 21 MB a call

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

  static double objective(unsigned n, const double* x, double* gradient, void* self_pointer) {
    DualSolver& self = *static_cast<DualSolver*>(self_pointer);
    const Eigen::Map<const Eigen::VectorXd> lambda(x, static_cast<Eigen::Index>(n));
    ++self.evaluations_;
    self.gradient_.head(n).noalias() = self.hessian_.topLeftCorner(n, n).lazyProduct(lambda);
    const double value = lambda.dot(0.5 * self.gradient_.head(n) - self.linear_.head(n));
    if (gradient != nullptr) {
      Eigen::Map<Eigen::VectorXd> g(gradient, static_cast<Eigen::Index>(n));
      g = self.gradient_.head(n) - self.linear_.head(n);
      // A solution to tolerance needs no further evaluation.
      if (self.projected_gradient(lambda, g) <= self.stop_) {
        self.iterate_.head(n) = lambda;
        self.solved_ = true;
        nlopt_force_stop(self.optimizers_[n].get());
      }
    }
    return value;
  }

  template <typename Point, typename Gradient>
  double projected_gradient(const Point& x, const Gradient& g) const {
    const auto step = (x - g).cwiseMax(0.0).cwiseMin(upper_.head(x.size())) - x;
    return step.cwiseAbs().maxCoeff();
  }

  /// One call of NLopt from iterate_. True if the dual is then solved to tolerance.
  bool optimize(double tolerance) {
    Optimizer& optimizer = optimizers_[static_cast<std::size_t>(size_)];
    if (!optimizer) {
      optimizer.reset(nlopt_create(algorithm(settings_.algorithm), static_cast<unsigned>(size_)));
      if (!optimizer) return false;
      nlopt_set_lower_bounds(optimizer.get(), lower_.data());
      nlopt_set_maxeval(optimizer.get(), settings_.max_evaluations);
      nlopt_set_vector_storage(optimizer.get(), vector_storage);
      nlopt_set_ftol_rel(optimizer.get(), 1e-15);
    }
    nlopt_set_min_objective(optimizer.get(), objective, this);
    nlopt_set_upper_bounds(optimizer.get(), upper_.data());
    stop_ = tolerance;
    solved_ = false;
    candidate_.head(size_) = iterate_.head(size_);
    double value = 0.0;
    // NLopt's return code says little (positive even if all was NaN): the point itself is judged.
    nlopt_optimize(optimizer.get(), candidate_.data(), &value);
    if (solved_) return true;
    if (all_finite(candidate_.head(size_)))
      iterate_.head(size_) = candidate_.head(size_).cwiseMax(0.0).cwiseMin(upper_.head(size_));
    return residual() <= tolerance;
  }

  double residual() {
    gradient_.head(size_).noalias() =
        hessian_.topLeftCorner(size_, size_).lazyProduct(iterate_.head(size_));
    gradient_.head(size_) -= linear_.head(size_);
    return projected_gradient(iterate_.head(size_), gradient_.head(size_));
  }

  /// Projected Newton steps (Bertsekas 1982) from iterate_, each with its own Cholesky
  /// factorisation of the rows that are not held at a bound: what NLopt finds to a few digits, and
  /// what the last multipliers are off by, this finishes to rounding. Never increases the dual's
  /// objective.
  void refine(double tolerance) {
    for (int pass = 0; pass < max_passes && residual() > tolerance && !late(); ++pass) {
      const double before = objective_at(iterate_, gradient_);
      int free = 0;
      step_.head(size_).setZero();
      for (int i = 0; i < size_; ++i) {
        const double next = iterate_(i) - gradient_(i);
        if (next <= 0.0 || next >= upper_(i))
          step_(i) = -gradient_(i);
        else
          free_[static_cast<std::size_t>(free++)] = i;
      }
      for (int j = 0; j < free; ++j) {
        const int column = free_[static_cast<std::size_t>(j)];
        reduced_(j) = -gradient_(column);
        for (int i = j; i < free; ++i)
          factor_(i, j) = hessian_(free_[static_cast<std::size_t>(i)], column);
      }
      if (free > 0) {
        Eigen::Ref<Matrix> block = factor_.topLeftCorner(free, free);
        const Eigen::LLT<Eigen::Ref<Matrix>> cholesky(block);
        if (cholesky.info() != Eigen::Success) return;
        cholesky.matrixL().solveInPlace(reduced_.head(free));
        cholesky.matrixU().solveInPlace(reduced_.head(free));
        for (int i = 0; i < free; ++i) step_(free_[static_cast<std::size_t>(i)]) = reduced_(i);
      }
      bool better = false;
      for (double length = 1.0; length > 1e-4 && !better; length *= 0.5) {
        candidate_.head(size_) = (iterate_.head(size_) + length * step_.head(size_))
                                     .cwiseMax(0.0)
                                     .cwiseMin(upper_.head(size_));
        gradient_.head(size_).noalias() =
            hessian_.topLeftCorner(size_, size_).lazyProduct(candidate_.head(size_));
        gradient_.head(size_) -= linear_.head(size_);
        better = objective_at(candidate_, gradient_) < before;
      }
      if (!better) return;
      iterate_.head(size_).swap(candidate_.head(size_));
    }
  }

  /// The dual's objective where its gradient is known.
  [[nodiscard]] double objective_at(const Vector& x, const Vector& g) const {
    return 0.5 * x.head(size_).dot(g.head(size_) - linear_.head(size_));
  }

  DualSettings settings_;
  std::vector<Optimizer> optimizers_;  // by size, made when first needed
  Matrix hessian_, factor_;
  Vector linear_, upper_, scale_, iterate_, gradient_, candidate_, step_, lower_, reduced_;
  std::vector<int> free_;
  int size_ = 0;
  std::optional<SolverClock::time_point> deadline_;
  double stop_ = 0.0;
  bool solved_ = false;
  long evaluations_ = 0;
};

}  // namespace tilt_ropter
