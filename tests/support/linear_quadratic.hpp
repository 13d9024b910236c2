#pragma once

#include <tilt_ropter/optimal_control/detail/riccati.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/LU>

#include <cstddef>
#include <vector>

/// Random linear-quadratic problems for tests of the Riccati passes.
namespace test_support {

/// Number of intervals of every LinearQuadratic.
inline constexpr int horizon = 6;

/// Returns a matrix with independent entries of standard deviation 1.
template <typename Matrix>
Matrix random_matrix(Random& random) {
  Matrix m;
  for (Eigen::Index i = 0; i < m.size(); ++i) m.data()[i] = random.normal(1.0);
  return m;
}

/// One node of a linear-quadratic problem. Matrices of dynamic size compile once for all sizes.
struct DenseNode {
  Eigen::MatrixXd A, B, hessian;     ///< hessian: of (dx, du)
  Eigen::VectorXd defect, gradient;  ///< gradient: of (dx, du)
};

/// Returns a matrix with independent entries of standard deviation 1.
inline Eigen::MatrixXd random_matrix(Random& random, int rows, int columns) {
  Eigen::MatrixXd m(rows, columns);
  for (Eigen::Index i = 0; i < m.size(); ++i) m.data()[i] = random.normal(1.0);
  return m;
}

/// Returns a random node with nx states and nu inputs. `nonzero` says which entries of [A B] may
/// differ from zero.
inline DenseNode random_node(Random& random, int nx, int nu, bool (*nonzero)(int, int)) {
  DenseNode node;
  node.A = random_matrix(random, nx, nx);
  node.B = random_matrix(random, nx, nu);
  for (int i = 0; i < nx; ++i) {
    for (int j = 0; j < nx; ++j)
      if (!nonzero(i, j)) node.A(i, j) = 0.0;
    for (int j = 0; j < nu; ++j)
      if (!nonzero(i, nx + j)) node.B(i, j) = 0.0;
  }
  node.defect = random_matrix(random, nx, 1);
  const Eigen::MatrixXd root = random_matrix(random, nx + nu, nx + nu);
  node.hessian = root * root.transpose();
  node.gradient = random_matrix(random, nx + nu, 1);
  return node;
}

/// Returns the optimal (dx_0, du_0, dx_1, ..) from the first-order conditions of the whole problem,
/// with a dense factorisation.
inline Eigen::VectorXd dense_optimum(const std::vector<DenseNode>& nodes,
                                     const Eigen::VectorXd& start, double damping) {
  const Eigen::Index nx = start.size(), width = nodes[0].hessian.rows();
  const auto last = static_cast<Eigen::Index>(nodes.size()) - 1;
  const Eigen::Index variables = width * last + nx, conditions = nx * (last + 1);
  Eigen::MatrixXd kkt = Eigen::MatrixXd::Zero(variables + conditions, variables + conditions);
  Eigen::VectorXd right = Eigen::VectorXd::Zero(variables + conditions);
  for (Eigen::Index k = 0; k <= last; ++k) {
    const DenseNode& node = nodes[static_cast<std::size_t>(k)];
    const Eigen::Index at = width * k, size = k < last ? width : nx, row = variables + nx * k;
    kkt.block(at, at, size, size) = node.hessian.topLeftCorner(size, size);
    right.segment(at, size) = -node.gradient.head(size);
    kkt.block(row, at, nx, nx).setIdentity();
    if (k == 0) {
      right.segment(row, nx) = start;
      continue;
    }
    const DenseNode& before = nodes[static_cast<std::size_t>(k - 1)];
    kkt.block(row, at - width, nx, nx) = -before.A;
    kkt.block(row, at - width + nx, nx, width - nx) = -before.B;
    right.segment(row, nx) = before.defect;
  }
  kkt.diagonal().head(variables).array() += damping;
  kkt.topRightCorner(variables, conditions) =
      kkt.bottomLeftCorner(conditions, variables).transpose();
  return kkt.partialPivLu().solve(right).head(variables);
}

/// A random linear-quadratic problem, as nodes and in a Riccati pass.
template <int nx, int nu, typename Pattern = tilt_ropter::optimal_control::FullTransition>
struct LinearQuadratic {
  using Pass = tilt_ropter::optimal_control::Riccati<nx, nu, Pattern>;
  using Tangent = typename Pass::Tangent;
  using Input = typename Pass::Input;
  using Vector = typename Pass::Vector;

  explicit LinearQuadratic(unsigned seed) : pass(horizon), steps(horizon + 1, Vector::Zero()) {
    Random random(seed);
    for (int k = 0; k <= horizon; ++k) {
      const DenseNode node = random_node(random, nx, nu, &Pattern::nonzero);
      A.push_back(node.A);
      B.push_back(node.B);
      defect.push_back(node.defect);
      if (k < horizon) {
        EXPECT_TRUE(pass.set_transition(k, A.back(), B.back()));
        pass.set_defect(k, defect.back());
      }
      auto& cost = pass.stage(k).cost;
      for (int j = 0; j < nx + nu; ++j)
        for (int i = 0; i < nx + nu; ++i)
          if (j >= nx || i < nx) cost.hessian(i, j) = node.hessian(i, j);
      for (int i = 0; i < nx + nu; ++i) cost.gradient(i) = node.gradient(i);
      nodes.push_back(node);
    }
    start = random_matrix(random, nx, 1);
  }

  /// Returns the optimum without the Riccati pass.
  [[nodiscard]] Eigen::VectorXd dense_optimum(double damping = 0.0) const {
    return test_support::dense_optimum(nodes, start, damping);
  }

  /// Returns the optimal (dx_0, du_0, dx_1, ..) of the factorised pass.
  [[nodiscard]] Eigen::VectorXd optimum() {
    steps[0].template head<nx>() = start;
    pass.sweep(steps);
    Eigen::VectorXd all((nx + nu) * horizon + nx);
    for (int k = 0; k < horizon; ++k)
      all.segment<nx + nu>((nx + nu) * k) =
          steps[static_cast<std::size_t>(k)].template head<nx + nu>();
    all.tail<nx>() = steps.back().template head<nx>();
    return all;
  }

  Pass pass;
  std::vector<DenseNode> nodes;
  std::vector<typename Pass::StateMatrix> A;
  std::vector<typename Pass::InputMatrix> B;
  std::vector<Tangent> defect;
  std::vector<Vector> steps;
  Tangent start;
};

}  // namespace test_support
