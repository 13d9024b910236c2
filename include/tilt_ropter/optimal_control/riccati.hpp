#pragma once

#include <tilt_ropter/optimal_control/block_product.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <cmath>
#include <cstddef>
#include <optional>
#include <vector>

/// The linear-quadratic problem of one SQP step without its inequalities, and its factorisation by
/// one backward Riccati pass.
///
/// With w = (du, dx) and M = [B A], the cost to go of node k is 1/2 w' H w + g' w with
///
///     H = [luu lux; lux' lxx] + M' P M,    g = (lu, lx) + M' (p + P defect),
///
/// P and p being those of node k + 1. The first columns [L; Y'] of the Cholesky factor of H, those
/// of du, give the coordinates
///
///     z_k = L' du_k + Y dx_k + y_k,    y_k = L^-1 g_u,
///
/// (the distance from the unconstrained optimal input), and what they leave of H and g is the P and
/// p of node k. Completing the square in this way turns the whole cost into 1/2 |z|^2 + const, with
/// continuity eliminated (Rao, Wright & Rawlings, "Application of interior-point methods to model
/// predictive control", 1998, for the recursion; Frison & Jorgensen, "Efficient implementation of
/// the Riccati recursion", 2013, for its form as one Cholesky factorisation).
namespace tilt_ropter {

/// One interval of the linear-quadratic problem: dx_{k+1} = A dx_k + B du_k + defect.
template <int States, int Inputs>
struct RiccatiStage {
  static constexpr int width = States + Inputs;

  Eigen::Matrix<double, States, States> A = Eigen::Matrix<double, States, States>::Identity();
  Eigen::Matrix<double, States, Inputs> B = Eigen::Matrix<double, States, Inputs>::Zero();
  Eigen::Matrix<double, States, 1> defect = Eigen::Matrix<double, States, 1>::Zero();
  QuadraticModel<States, Inputs> cost;

  // Written by factorise(); rows of du before those of dx, then zeros.
  using Transition = Eigen::Matrix<double, padded(width), States>;
  using Factor = Eigen::Matrix<double, padded(width), Inputs>;
  Transition transition = Transition::Zero();  ///< [B A]'
  Factor factor = Factor::Zero();              ///< [L; Y'], L lower triangular
  Eigen::Matrix<double, Inputs, 1> y = Eigen::Matrix<double, Inputs, 1>::Zero();

  [[nodiscard]] auto L() const { return factor.template topRows<Inputs>(); }
  [[nodiscard]] auto Y() const { return factor.template middleRows<States>(Inputs).transpose(); }
};

/// The horizon: stage(0) to stage(N), of the last one only the cost is used. Of the Hessians
/// only the lower triangles are used. `Blocks` says which blocks of [A B] can be non-zero: see
/// TransitionBlocks.
template <int States, int Inputs, typename Blocks = FullTransition<States, Inputs>>
class Riccati {
 public:
  using Stage = RiccatiStage<States, Inputs>;
  using Tangent = Eigen::Matrix<double, States, 1>;
  using Input = Eigen::Matrix<double, Inputs, 1>;
  using Hessian = Eigen::Matrix<double, States, States>;

  /// Allocates once for `horizon` intervals.
  explicit Riccati(int horizon) : stages_(static_cast<std::size_t>(horizon) + 1) {}

  [[nodiscard]] int horizon() const { return static_cast<int>(stages_.size()) - 1; }
  [[nodiscard]] Stage& stage(int k) { return stages_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Stage& stage(int k) const { return stages_[static_cast<std::size_t>(k)]; }

  /// Backward pass, with `damping` added to the diagonals of all Hessians. False if H_uu of some
  /// node is not positive definite (then the problem has no unique minimum). No allocation.
  [[nodiscard]] [[gnu::flatten]] bool factorise(double damping = 0.0) {
    const auto& last = stages_.back().cost;
    hessian_.template block<States, States>(Inputs, Inputs) = last.lxx;
    hessian_.diagonal().array() += damping;
    gradient_.template segment<States>(Inputs) = last.lx;
    for (int k = horizon() - 1; k >= 0; --k) {
      Stage& s = stage(k);
      set_transition(s);

      product_.setZero();
      add_product<FullColumns, States, States>(s.transition, cost_to_go(), product_);
      const Tangent p = gradient_.template segment<States>(Inputs);
      gradient_.template head<width>() << s.cost.lu, s.cost.lx;
      gradient_.noalias() += s.transition * p;
      gradient_.noalias() += product_ * s.defect;

      hessian_.template topLeftCorner<Inputs, Inputs>() = s.cost.luu;
      hessian_.template block<States, Inputs>(Inputs, 0) = s.cost.lux.transpose();
      hessian_.template block<States, States>(Inputs, Inputs) = s.cost.lxx;
      hessian_.template topRightCorner<Inputs, States>().setZero();
      hessian_.diagonal().array() += damping;
      const auto transition = [&s](int i, int j) { return s.transition(j, i); };
      add_lower_product<Columns, States, width, 0>(product_, transition, hessian_);

      if (!eliminate_inputs(s)) return false;
    }
    return true;
  }

  /// P of node 0, symmetric, after factorise(): the Hessian of what the whole horizon costs.
  [[nodiscard]] Hessian initial_cost() const {
    Hessian P;
    for (int j = 0; j < States; ++j)
      for (int i = 0; i < States; ++i) P(i, j) = cost_to_go()(i, j);
    return P;
  }

  /// Input step at node k for the state step dx and the coordinates z.
  [[nodiscard]] Input input_step(int k, const Tangent& dx, const Input& z) const {
    const Stage& s = stage(k);
    Eigen::Matrix<double, rows, 1> w = Eigen::Matrix<double, rows, 1>::Zero();  // (du, dx)
    w.template segment<States>(Inputs) = dx;
    for (int j = Inputs - 1; j >= 0; --j)
      w(j) = (z(j) - s.y(j) - s.factor.col(j).dot(w)) / s.factor(j, j);
    return w.template head<Inputs>();
  }

  /// A batch of linear functions of the trajectory, one a row: its derivative by du_k, then by
  /// dx_k. Room for a multiple of batch_rows.
  using Batch = Eigen::Matrix<double, Eigen::Dynamic, States + Inputs>;

  /// Adjoint step through interval k: from derivatives by dx_{k+1} (last columns of `after`) to
  /// derivatives by (du_k, dx_k), for the first `count` rows.
  void step_back(int k, const Batch& after, Batch& before, Eigen::Index count) const {
    const Stage& s = stage(k);
    const auto x = after.template rightCols<States>();
    const auto transition = [&s](int i, int j) { return s.transition(j, i); };
    before.topRows(count).setZero();
    add_batch<Columns, States, width>(x, transition, before, count);
  }

  /// From derivatives by (du_k, dx_k) to those by (z_k, dx_k), for the first `count` rows.
  void to_coordinates(int k, Batch& batch, Eigen::Index count) const {
    const Stage& s = stage(k);
    for (int j = 0; j < Inputs; ++j) {
      auto column = batch.col(j).head(count);
      for (int i = 0; i < j; ++i) column -= s.factor(j, i) * batch.col(i).head(count);
      column /= s.factor(j, j);
    }
    auto by_state = batch.template rightCols<States>();
    const auto minus_y = [&s](int i, int j) { return -s.factor(Inputs + j, i); };
    add_batch<FullColumns, Inputs, States>(batch, minus_y, by_state, count);
  }

 private:
  static constexpr int width = States + Inputs, rows = padded(width);
  using FullColumns = FullBlocks<Blocks::size>;
  /// Blocks of [B A].
  struct Columns {
    static constexpr int size = Blocks::size;
    static constexpr bool nonzero(int row, int column) {
      return Blocks::nonzero(row, (column + States / size) % (width / size));
    }
  };
  static_assert(States % Blocks::size == 0 && Inputs % Blocks::size == 0);

  // The blocks that stay zero are zero from the beginning.
  static void set_transition(Stage& s) {
    constexpr int size = Blocks::size;
    for (int row = 0; row < States / size; ++row) {
      for (int column = 0; column < width / size; ++column) {
        if (!Columns::nonzero(row, column)) continue;
        auto block = s.transition.template block<size, size>(size * column, size * row);
        if (size * column < Inputs)
          block = s.B.template block<size, size>(size * row, size * column).transpose();
        else
          block = s.A.template block<size, size>(size * row, size * column - Inputs).transpose();
      }
    }
  }

  // P: symmetric, kept as the lower triangle that the last elimination left.
  [[nodiscard]] auto cost_to_go() const {
    return [this](int i, int j) {
      return i >= j ? hessian_(Inputs + i, Inputs + j) : hessian_(Inputs + j, Inputs + i);
    };
  }

  // The first columns of the Cholesky factorisation of H, and what they leave of H and g.
  [[nodiscard]] bool eliminate_inputs(Stage& s) {
    for (int j = 0; j < Inputs; ++j) {
      auto column = s.factor.col(j);
      column = hessian_.col(j);
      for (int i = 0; i < j; ++i) column -= s.factor(j, i) * s.factor.col(i);
      column.head(j).setZero();
      if (!(column(j) > 0.0)) return false;
      column *= 1.0 / std::sqrt(column(j));
      s.y(j) = gradient_(j) / column(j);
      gradient_ -= s.y(j) * column;
    }
    auto remainder = hessian_.template rightCols<States>();
    const auto minus_y = [&s](int i, int j) { return -s.factor(Inputs + j, i); };
    add_lower_product<FullColumns, Inputs, States, Inputs>(s.factor, minus_y, remainder);
    return true;
  }

  std::vector<Stage> stages_;
  typename Stage::Transition product_;  // M' P
  Eigen::Matrix<double, rows, width> hessian_ = Eigen::Matrix<double, rows, width>::Zero();
  Eigen::Matrix<double, rows, 1> gradient_ = Eigen::Matrix<double, rows, 1>::Zero();
};

/// P of a horizon without end that has the interval and the cost of `stage` throughout: the
/// solution that stabilises of the discrete algebraic Riccati equation
///
///     P = lxx + A' P A - (A' P B + lux') (luu + B' P B)^-1 (B' P A + lux),
///
/// by passes of Riccati from the identity, until none of its entries moves by more than 1e-12 of
/// sqrt(P_ii P_jj) in a pass. Empty if `max_passes` do not get there: it does not exist where some
/// motion that does not die out costs nothing or cannot be stopped. Allocates; takes about a
/// microsecond a pass for an NMPC, and as many passes as the slowest motion takes intervals to
/// decay by 1e-6, since the cost is its square.
template <int States, int Inputs, typename Blocks = FullTransition<States, Inputs>>
[[nodiscard]] std::optional<Eigen::Matrix<double, States, States>> endless_cost(
    const RiccatiStage<States, Inputs>& stage, int max_passes = 20000) {
  using Hessian = Eigen::Matrix<double, States, States>;
  Riccati<States, Inputs, Blocks> pass(1);
  pass.stage(0) = stage;
  Hessian P = Hessian::Identity();
  for (int i = 0; i < max_passes; ++i) {
    pass.stage(1).cost.lxx = P;
    if (!pass.factorise()) return std::nullopt;
    const Hessian last = P;
    P = pass.initial_cost();
    const Eigen::Matrix<double, States, 1> scale = P.diagonal().cwiseSqrt();
    const auto moved = (P - last).cwiseAbs().array();
    if ((moved <= 1e-12 * (scale * scale.transpose()).array()).all()) return P;
  }
  return std::nullopt;
}

}  // namespace tilt_ropter
