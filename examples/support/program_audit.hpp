#pragma once

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

/// Independent check of the residual of a quadratic program in a real-time iteration: it is
/// recomputed from the functions of the problem. It uses nothing computed by the solver but its
/// plan and multipliers.
namespace examples {

namespace detail {

/// A node of the quadratic program and the step that the solver took there. The sizes are known at
/// run time only: the residual is then compiled once, and not for each problem.
struct AuditNode {
  Eigen::MatrixXd A, B, C, E, hessian;
  Eigen::VectorXd dx, du, gap, gradient, value, multipliers, lower, upper;
  std::vector<bool> relaxed;
};

template <typename Matrix>
[[nodiscard]] Eigen::Map<const Eigen::MatrixXd> entries(const Matrix& m) {
  return {m.data(), m.rows(), m.cols()};
}
template <typename Vector>
[[nodiscard]] double largest(const Vector& v) {
  return entries(v).cwiseAbs().maxCoeff();
}

/// Returns the residual of a program whose steps differ from those of its equations by `worst`.
[[nodiscard]] inline double program_residual(const std::vector<AuditNode>& nodes, double worst) {
  double largest_term = 0.0, stationarity = 0.0, largest_multiplier = 0.0;
  for (const AuditNode& node : nodes)
    largest_multiplier = std::max(largest_multiplier, largest(node.multipliers));
  const Eigen::Index nx = nodes[0].dx.size(), nu = nodes[0].du.size();
  Eigen::VectorXd adjoint = Eigen::VectorXd::Zero(nx);
  for (std::size_t i = nodes.size(); i-- > 0;) {
    const AuditNode& n = nodes[i];
    const auto lxx = n.hessian.topLeftCorner(nx, nx), lxu = n.hessian.block(0, nx, nx, nu),
               luu = n.hessian.block(nx, nx, nu, nu);
    Eigen::VectorXd predicted = n.value + n.C * n.dx;
    if (i + 1 < nodes.size()) {
      predicted += n.E * n.du;
      const Eigen::VectorXd cost = n.gradient.segment(nx, nu) + lxu.transpose() * n.dx + luu * n.du;
      const Eigen::VectorXd by_rows = n.E.transpose() * n.multipliers,
                            by_continuity = n.B.transpose() * adjoint;
      largest_term =
          std::max({largest_term, largest(cost), largest(by_rows), largest(by_continuity)});
      stationarity = std::max(stationarity, (cost + by_rows + by_continuity).cwiseAbs().maxCoeff());
      adjoint = (n.A.transpose() * adjoint).eval();
      adjoint += lxu * n.du;
    }
    adjoint += n.gradient.head(nx) + lxx * n.dx + n.C.transpose() * n.multipliers;
    for (Eigen::Index r = 0; r < predicted.size(); ++r) {
      const double over = predicted(r) - n.upper(r), under = n.lower(r) - predicted(r),
                   m = n.multipliers(r);
      const double outside = std::max(over, under);
      const double unit = 1.0 + std::abs(over > under ? n.upper(r) : n.lower(r));
      if (outside > 0.0 && !n.relaxed[static_cast<std::size_t>(r)])
        worst = std::max(worst, outside / unit);
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

}  // namespace detail

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
    if (solver.interrupted()) return;  // continues with the program of the tick before
    problem_ = solver.problem();
    states_.clear();
    inputs_.clear();
    multipliers_.clear();
    for (int k = 0; k <= solver.horizon(); ++k) {
      states_.push_back(solver.state(k));
      inputs_.push_back(solver.input(k));
      multipliers_.push_back(solver.constraint_multipliers(k));
    }
  }

  /// Call this after feedback(). Returns the largest of stationarity (relative to its largest
  /// term), continuity, violation (relative to the bound, unless a multiplier at its penalty
  /// explains it) and complementarity. A residual of 1e-3 or more can result from a cold start of
  /// the solver. The function then also checks from the first state of the solver and returns the
  /// smaller value.
  [[nodiscard]] double after(const Solver& solver) {
    const double warm = residual(solver);
    if (warm < 1e-3) return warm;
    for (std::size_t k = 0; k < states_.size(); ++k) {
      states_[k] = solver.state(0);
      inputs_[k].setZero();
      multipliers_[k].setZero();
    }
    return std::min(warm, residual(solver));
  }

 private:
  // Steps are computed from the inputs: a difference of states does not represent rotations above
  // half a turn.
  [[nodiscard]] double residual(const Solver& solver) {
    using detail::entries;
    const Problem& problem = *problem_;
    double worst = 0.0;
    nodes_.resize(states_.size());
    nodes_[0].dx = entries(problem.difference(solver.state(0), states_[0]).eval());
    for (int k = 0; k <= solver.horizon(); ++k) {
      const auto i = static_cast<std::size_t>(k);
      detail::AuditNode& node = nodes_[i];
      const typename D::Tangent dx = D::Tangent::Map(node.dx.data());
      const typename D::Tangent difference =
          problem.difference(solver.state(k), problem.retract(states_[i], dx));
      worst = std::max(worst, detail::largest(difference));
      const typename D::Input du = solver.input(k) - inputs_[i];
      typename D::ConstraintsX C = D::ConstraintsX::Zero();
      typename D::ConstraintsU E = D::ConstraintsU::Zero();
      problem.constraint_derivatives(k, states_[i], inputs_[i], C, E);
      tilt_ropter::optimal_control::QuadraticModel<D::nx, D::nu> model;
      problem.cost_model(k, states_[i], inputs_[i], model);
      const typename D::Constraints value = problem.constraint_values(k, states_[i], inputs_[i]),
                                    lower = problem.lower(k), upper = problem.upper(k);
      node.du = entries(du);
      node.C = entries(C);
      node.E = entries(E);
      node.hessian = entries(model.hessian);
      node.gradient = entries(model.gradient);
      node.value = entries(value);
      node.lower = entries(lower);
      node.upper = entries(upper);
      node.multipliers = entries(solver.constraint_multipliers(k));
      node.relaxed.resize(D::nc);
      for (int r = 0; r < D::nc; ++r)
        node.relaxed[static_cast<std::size_t>(r)] = solver.relaxed(k, r);
      if (k == solver.horizon()) break;
      typename D::A A;
      typename D::B B;
      const State end = problem.step(k, states_[i], inputs_[i], A, B);
      const typename D::Tangent gap = problem.difference(end, states_[i + 1]);
      node.A = entries(A);
      node.B = entries(B);
      node.gap = entries(gap);
      nodes_[i + 1].dx = node.gap + node.A * node.dx + node.B * node.du;
    }
    if constexpr (tilt_ropter::optimal_control::HasCurvature<Problem>::value) add_curvature();
    return detail::program_residual(nodes_, worst);
  }

  // With the multipliers of the program before, and the costates that follow from them.
  void add_curvature() {
    typename D::Tangent costate = D::Tangent::Zero();
    for (std::size_t i = nodes_.size(); i-- > 0;) {
      detail::AuditNode& node = nodes_[i];
      const int k = static_cast<int>(i);
      tilt_ropter::optimal_control::QuadraticModel<D::nx, D::nu> model;
      problem_->cost_model(k, states_[i], inputs_[i], model);
      problem_->add_curvature(k, states_[i], inputs_[i], multipliers_[i], costate, model);
      node.hessian = detail::entries(model.hessian);
      const Eigen::VectorXd multipliers = detail::entries(multipliers_[i]);
      Eigen::VectorXd gradient = node.gradient.head(D::nx) + node.C.transpose() * multipliers;
      if (i + 1 < nodes_.size()) gradient += node.A.transpose() * costate;
      costate = D::Tangent::Map(gradient.data());
    }
  }

  std::optional<Problem> problem_;
  std::vector<State> states_;
  std::vector<typename D::Input> inputs_;
  std::vector<typename D::Constraints> multipliers_;
  std::vector<detail::AuditNode> nodes_;
};

}  // namespace examples
