#pragma once

#include "support/random.hpp"

#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace test_support {

/// Whether the constraints of a RandomProgram are feasible.
enum class Feasibility {
  feasible,    ///< feasible with margin
  tight,       ///< a single point satisfies most constraints
  infeasible,  ///< some constraints contradict each other
};

/// A random convex linear time-varying problem with many ranks, scales and units. The trajectory is
/// drawn first and the bounds are drawn around it, so that the constraints have the requested
/// feasibility. Some constraints occur twice, also in different units.
template <int States, int Inputs, int Constraints>
class RandomProgram {
 public:
  static constexpr int states = States, inputs = Inputs, constraints = Constraints, equalities = 0;
  using D = tilt_ropter::optimal_control::ProblemDimensions<RandomProgram>;
  using Tangent = typename D::Tangent;
  using State = Tangent;
  using Input = typename D::Input;
  using RowVector = typename D::Constraints;

  RandomProgram(Random& random, int horizon, Feasibility feasibility, double penalty)
      : nodes_(static_cast<std::size_t>(horizon) + 1) {
    const auto scale = [&](double decades) {
      return std::pow(10.0, random.uniform(-decades, decades));
    };
    const auto fill = [&](auto&& m, double size) {
      for (Eigen::Index j = 0; j < m.cols(); ++j)
        for (Eigen::Index i = 0; i < m.rows(); ++i) m(i, j) = random.normal(size);
    };
    Tangent unit;  // unit of each state
    for (double& u : unit) u = scale(1.5);
    const double input_weight = scale(3.0), state_weight = scale(1.0);
    const int rank = static_cast<int>(random.uniform(0.0, States + 1.0));
    Tangent x;
    fill(x, 1.0);
    start_ = x.cwiseProduct(unit);
    for (int k = 0; k <= horizon; ++k) {
      Node& n = nodes_[static_cast<std::size_t>(k)];
      typename D::A A;
      typename D::B B;
      fill(A, 0.5 / std::sqrt(1.0 * States));
      A.diagonal().array() += 0.8;
      fill(B, 1.0);
      n.A = unit.asDiagonal() * A * unit.cwiseInverse().asDiagonal();
      n.B = unit.asDiagonal() * B;
      Eigen::Matrix<double, States, States> root;
      fill(root, state_weight);
      for (int i = rank; i < States; ++i) root.row(i).setZero();
      root = (root * unit.cwiseInverse().asDiagonal()).eval();
      n.lxx = root.transpose() * root;
      n.lxx.diagonal() += 1e-9 * unit.cwiseAbs2().cwiseInverse();
      Eigen::Matrix<double, Inputs, Inputs> input_root;
      fill(input_root, 1.0);
      n.luu = input_weight * input_root.transpose() * input_root;
      n.luu.diagonal().array() += 1e-3 * input_weight;
      Tangent lx;
      fill(lx, 1.0);
      n.lx = lx.cwiseQuotient(unit);
      fill(n.lu, 1.0);
      // The trajectory that satisfies the bounds: states and inputs of order one.
      Tangent free;
      Input u;
      fill(free, 1.0);
      fill(u, 1.0);
      if (k == horizon) u.setZero();
      // The trajectory can continue to any next state.
      n.offset = -n.A * start_at(x, unit) - n.B * u;
      fill(n.C, 1.0);
      fill(n.E, 1.0);
      for (int i = 0; i < Constraints; ++i) {
        const double kind = random.uniform(0.0, 1.0);
        if (kind < 0.3) n.C.row(i).setZero();
        if (kind > 0.7 || k == horizon) n.E.row(i).setZero();
        if (kind > 0.7 && kind < 0.85) {  // a bound on one state
          const double c = n.C(i, 0);
          n.C.row(i).setZero();
          n.C(i, i % States) = c;
        }
        n.C.row(i) = (n.C.row(i) * unit.cwiseInverse().asDiagonal()).eval();
        // The previous constraint again, in another unit.
        if (i > 0 && random.uniform(0.0, 1.0) < 0.1) {
          const double other = scale(1.0);
          n.C.row(i) = other * n.C.row(i - 1);
          n.E.row(i) = other * n.E.row(i - 1);
        }
        const double in_units = scale(1.0);
        n.C.row(i) *= in_units;
        n.E.row(i) *= in_units;
        if (k == 0) n.C.row(i).setZero();  // the initial state is fixed
        const double at = n.C.row(i).dot(start_at(x, unit)) + n.E.row(i).dot(u);
        const double room = feasibility == Feasibility::tight ? 1e-3 : random.uniform(0.05, 1.0);
        n.lower(i) = at - in_units * room;
        n.upper(i) = at + in_units * (feasibility == Feasibility::tight ? 0.0 : room);
        const double sides = random.uniform(0.0, 1.0);
        if (sides < 0.4) n.lower(i) = -std::numeric_limits<double>::infinity();
        if (sides > 0.8) n.upper(i) = std::numeric_limits<double>::infinity();
        n.penalty(i) = penalty;
      }
      if (feasibility == Feasibility::infeasible && k > 0 && k % 3 == 1 && Constraints > 1) {
        n.C.row(1) = n.C.row(0);
        n.E.row(1) = n.E.row(0);
        n.upper(0) = 0.0;
        n.lower(1) = n.C.row(0).cwiseAbs().sum() + 1.0;
        n.lower(0) = -std::numeric_limits<double>::infinity();
        n.upper(1) = std::numeric_limits<double>::infinity();
      }
      if (k < horizon) {
        n.offset += free.cwiseProduct(unit);
        x = free;
      }
    }
  }

  [[nodiscard]] const State& start() const { return start_; }

  [[nodiscard]] int horizon() const { return static_cast<int>(nodes_.size()) - 1; }
  [[nodiscard]] State retract(const State& x, const Tangent& dx) const { return x + dx; }
  [[nodiscard]] Tangent difference(const State& y, const State& x) const { return y - x; }
  [[nodiscard]] State step(int k, const State& x, const Input& u) const {
    const Node& n = node(k);
    return n.A * x + n.B * u + n.offset;
  }
  [[nodiscard]] State step(int k, const State& x, const Input& u, typename D::A& A,
                           typename D::B& B) const {
    A = node(k).A;
    B = node(k).B;
    return step(k, x, u);
  }
  [[nodiscard]] double cost(int k, const State& x, const Input& u) const {
    const Node& n = node(k);
    double sum = n.lx.dot(x) + 0.5 * x.dot(n.lxx * x);
    if (k < horizon()) sum += n.lu.dot(u) + 0.5 * u.dot(n.luu * u);
    return sum;
  }
  void cost_model(int k, const State& x, const Input& u,
                  tilt_ropter::optimal_control::QuadraticModel<States, Inputs>& m) const {
    const Node& n = node(k);
    m.lx() = n.lx + n.lxx * x;
    m.lxx() = n.lxx;
    if (k == horizon()) return;
    m.lu() = n.lu + n.luu * u;
    m.luu() = n.luu;
  }
  [[nodiscard]] RowVector constraint_values(int k, const State& x, const Input& u) const {
    return node(k).C * x + node(k).E * u;
  }
  void constraint_derivatives(int k, const State&, const Input&, typename D::ConstraintsX& C,
                              typename D::ConstraintsU& E) const {
    C = node(k).C;
    E = node(k).E;
  }
  [[nodiscard]] const RowVector& lower(int k) const { return node(k).lower; }
  [[nodiscard]] const RowVector& upper(int k) const { return node(k).upper; }
  [[nodiscard]] const RowVector& penalty(int k) const { return node(k).penalty; }

 private:
  struct Node {
    typename D::A A;
    typename D::B B;
    Tangent offset, lx;
    Input lu;
    Eigen::Matrix<double, States, States> lxx;
    Eigen::Matrix<double, Inputs, Inputs> luu;
    typename D::ConstraintsX C;
    typename D::ConstraintsU E;
    RowVector lower, upper, penalty;
  };
  [[nodiscard]] const Node& node(int k) const { return nodes_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] static Tangent start_at(const Tangent& x, const Tangent& unit) {
    return x.cwiseProduct(unit);
  }

  std::vector<Node> nodes_;
  State start_;
};

}  // namespace test_support
