#pragma once

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

/// Independent check of the residual of a quadratic program in a real-time iteration: it is
/// recomputed from the functions of the problem. It uses nothing computed by the solver but its
/// plan and multipliers.
namespace examples {

/// For problems without active equalities.
template <typename Problem>
class ProgramAudit {
 public:
  using Solver = tilt_ropter::optimal_control::MultipleShooting<Problem>;
  using D = tilt_ropter::optimal_control::ProblemDimensions<Problem>;
  using State = typename Problem::State;

  /// Stores the problem and the plan at which `solver` has linearised. Call it between prepare()
  /// and feedback().
  void before(const Solver& solver) {
    if (solver.goes_on()) return;  // continues with the program of the tick before
    problem_ = solver.problem();
    states_.clear();
    inputs_.clear();
    for (int k = 0; k <= solver.horizon(); ++k) {
      states_.push_back(solver.state(k));
      inputs_.push_back(solver.input(k));
    }
  }

  /// Call this after feedback(). Returns the largest of stationarity (relative to its largest
  /// term), continuity, violation (relative to the bound, unless a multiplier at its price explains
  /// it) and complementarity. A residual of 1e-3 or more can result from a cold start of the
  /// solver. The function then also checks from the first state of the solver and returns the
  /// smaller value.
  [[nodiscard]] double after(const Solver& solver) {
    const double warm = residual(solver);
    if (warm < 1e-3) return warm;
    for (std::size_t k = 0; k < states_.size(); ++k) {
      states_[k] = solver.state(0);
      inputs_[k].setZero();
    }
    return std::min(warm, residual(solver));
  }

 private:
  // Steps are computed from the inputs: a difference of states does not represent rotations above
  // half a turn.
  [[nodiscard]] double residual(const Solver& solver) {
    const Problem& problem = *problem_;
    const int horizon = solver.horizon();
    double worst = 0.0, largest_term = 0.0, stationarity = 0.0, largest_multiplier = 0.0;
    steps_.assign(states_.size(), problem.difference(solver.state(0), states_[0]));
    derivatives_.resize(states_.size());
    for (int k = 0; k <= horizon; ++k) {
      const auto i = static_cast<std::size_t>(k);
      largest_multiplier =
          std::max(largest_multiplier, solver.constraint_multipliers(k).cwiseAbs().maxCoeff());
      worst = std::max(worst,
                       problem.difference(solver.state(k), problem.retract(states_[i], steps_[i]))
                           .cwiseAbs()
                           .maxCoeff());
      if (k == horizon) break;
      auto& [A, B] = derivatives_[i];
      const State end = problem.step(k, states_[i], inputs_[i], A, B);
      steps_[i + 1] = problem.difference(end, states_[i + 1]) + A * steps_[i] +
                      B * (solver.input(k) - inputs_[i]);
    }
    typename D::Tangent adjoint = D::Tangent::Zero();
    for (int k = horizon; k >= 0; --k) {
      const auto i = static_cast<std::size_t>(k);
      const typename D::Tangent& dx = steps_[i];
      const typename D::Input du = solver.input(k) - inputs_[i];
      typename Solver::Constraints multipliers = solver.constraint_multipliers(k);
      tilt_ropter::optimal_control::QuadraticModel<D::nx, D::nu> model;
      problem.cost_model(k, states_[i], inputs_[i], model);
      typename D::ConstraintsX C = D::ConstraintsX::Zero();
      typename D::ConstraintsU E = D::ConstraintsU::Zero();
      problem.constraint_derivatives(k, states_[i], inputs_[i], C, E);
      const typename D::Constraints value = problem.constraint_values(k, states_[i], inputs_[i]);
      typename D::Constraints predicted = value + C * dx;
      if (k < horizon) {
        predicted += E * du;
        const auto& [A, B] = derivatives_[i];
        const typename D::Input cost = model.lu() + model.lux() * dx + model.luu() * du;
        const typename D::Input by_rows = E.transpose() * multipliers,
                                by_continuity = B.transpose() * adjoint;
        for (const auto* term : {&cost, &by_rows, &by_continuity})
          largest_term = std::max(largest_term, term->cwiseAbs().maxCoeff());
        stationarity =
            std::max(stationarity, (cost + by_rows + by_continuity).cwiseAbs().maxCoeff());
        adjoint = (A.transpose() * adjoint).eval();
        adjoint += model.lux().transpose() * du;
      }
      adjoint += model.lx() + model.lxx() * dx + C.transpose() * multipliers;
      for (int r = 0; r < D::nc; ++r) {
        const double over = predicted(r) - problem.upper(k)(r),
                     under = problem.lower(k)(r) - predicted(r), m = multipliers(r);
        const double outside = std::max(over, under);
        const double unit =
            1.0 + std::abs(over > under ? problem.upper(k)(r) : problem.lower(k)(r));
        if (outside > 0.0 && !solver.relaxed(k, r)) worst = std::max(worst, outside / unit);
        if (m != 0.0)
          worst = std::max(worst, std::min(std::abs(m) / (1.0 + largest_multiplier),
                                           -(m > 0.0 ? over : under) / unit));
      }
    }
    const double all = std::max(worst, stationarity / (1.0 + largest_term));
    return worst + stationarity < std::numeric_limits<double>::infinity()
               ? all
               : std::numeric_limits<double>::infinity();
  }

  std::optional<Problem> problem_;
  std::vector<State> states_;
  std::vector<typename D::Input> inputs_;
  std::vector<typename D::Tangent> steps_;
  std::vector<std::pair<typename D::A, typename D::B>> derivatives_;
};

}  // namespace examples
