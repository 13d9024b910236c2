#include <tilt_ropter/optimal_control/riccati.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include <algorithm>
#include <optional>

namespace tilt_ropter {
namespace {

using test_support::Random;

constexpr int nx = 4, nu = 2, horizon = 6;
using LinearQuadratic = Riccati<nx, nu>;

LinearQuadratic random_problem(unsigned seed) {
  Random random(seed);
  const auto fill = [&](auto& m) {
    for (Eigen::Index i = 0; i < m.size(); ++i) m.data()[i] = random.normal(1.0);
  };
  LinearQuadratic lq(horizon);
  for (int k = 0; k <= horizon; ++k) {
    auto& s = lq.stage(k);
    fill(s.A);
    fill(s.B);
    fill(s.defect);
    fill(s.cost.lx);
    fill(s.cost.lu);
    Eigen::Matrix<double, nx + nu, nx + nu> root;
    fill(root);
    const Eigen::Matrix<double, nx + nu, nx + nu> hessian = root * root.transpose();
    s.cost.lxx = hessian.topLeftCorner<nx, nx>();
    s.cost.luu = hessian.bottomRightCorner<nu, nu>();
    s.cost.lux = hessian.bottomLeftCorner<nu, nx>();
  }
  return lq;
}

struct Path {
  double cost = 0.0, squares = 0.0;
};

// Cost of an input sequence by plain summation, and |z|^2 of the same sequence.
Path follow(const LinearQuadratic& lq, const Eigen::VectorXd& inputs,
            const Eigen::Matrix<double, nx, 1>& start) {
  Path path;
  Eigen::Matrix<double, nx, 1> dx = start;
  for (int k = 0; k <= horizon; ++k) {
    const auto& s = lq.stage(k);
    path.cost += s.cost.lx.dot(dx) + 0.5 * dx.dot(s.cost.lxx * dx);
    if (k == horizon) break;
    const Eigen::Vector2d du = inputs.segment<nu>(nu * k);
    path.cost += s.cost.lu.dot(du) + du.dot(s.cost.lux * dx) + 0.5 * du.dot(s.cost.luu * du);
    path.squares += (s.L().transpose() * du + s.Y() * dx + s.y).squaredNorm();
    const Eigen::Matrix<double, nx, 1> next = s.A * dx + s.B * du + s.defect;
    dx = next;
  }
  return path;
}

TEST(Riccati, CompletesTheSquare) {
  LinearQuadratic lq = random_problem(31);
  ASSERT_TRUE(lq.factorise());
  Random random(32);
  const Eigen::Matrix<double, nx, 1> start = Eigen::Vector4d(1, -2, 0.5, 3);
  double constant = 0.0;
  for (int trial = 0; trial < 50; ++trial) {
    Eigen::VectorXd inputs(nu * horizon);
    for (Eigen::Index i = 0; i < inputs.size(); ++i) inputs(i) = random.normal(2.0);
    const Path path = follow(lq, inputs, start);
    const double rest = path.cost - 0.5 * path.squares;
    if (trial == 0) constant = rest;
    EXPECT_NEAR(rest, constant, 1e-8 * (1.0 + std::abs(path.cost)));
  }
}

TEST(Riccati, ZeroCoordinatesAreTheOptimalInputs) {
  LinearQuadratic lq = random_problem(33);
  ASSERT_TRUE(lq.factorise());
  Eigen::Matrix<double, nx, 1> dx = Eigen::Vector4d(1, -2, 0.5, 3);
  Eigen::VectorXd inputs(nu * horizon);
  for (int k = 0; k < horizon; ++k) {
    const auto& s = lq.stage(k);
    inputs.segment<nu>(nu * k) = lq.input_step(k, dx, Eigen::Vector2d::Zero());
    const Eigen::Matrix<double, nx, 1> next =
        s.A * dx + s.B * inputs.segment<nu>(nu * k) + s.defect;
    dx = next;
  }
  EXPECT_NEAR(follow(lq, inputs, Eigen::Vector4d(1, -2, 0.5, 3)).squares, 0.0, 1e-16);
}

TEST(Riccati, AdjointStepIsTheTransposeOfTheClosedLoop) {
  LinearQuadratic lq = random_problem(34);
  ASSERT_TRUE(lq.factorise());
  const auto& s = lq.stage(2);
  // dx+ for a change of dx and of z, through input_step().
  const auto next = [&](const Eigen::Vector4d& dx, const Eigen::Vector2d& z) -> Eigen::Vector4d {
    return s.A * dx + s.B * lq.input_step(2, dx, z);
  };
  const Eigen::Vector4d origin = next(Eigen::Vector4d::Zero(), Eigen::Vector2d::Zero());
  // Row i: the function dx+(i). More rows than fit one tile, and not a multiple of it.
  constexpr int count = batch_rows + 3;
  LinearQuadratic::Batch after(2 * batch_rows, nx + nu), before = after;
  after.setZero();
  before.setConstant(7.0);
  for (int i = 0; i < count; ++i) after(i, nu + i % nx) = 1.0;
  lq.step_back(2, after, before, count);
  lq.to_coordinates(2, before, count);
  for (int i = 0; i < count; ++i) {
    for (int j = 0; j < nx; ++j)
      EXPECT_NEAR(before(i, nu + j),
                  (next(Eigen::Vector4d::Unit(j), Eigen::Vector2d::Zero()) - origin)(i % nx), 1e-9);
    for (int j = 0; j < nu; ++j)
      EXPECT_NEAR(before(i, j),
                  (next(Eigen::Vector4d::Zero(), Eigen::Vector2d::Unit(j)) - origin)(i % nx), 1e-9);
  }
}

// x1 + x2 -> x1, x2 -> x2, u -> x2, in blocks of two.
struct HalfTransition {
  static constexpr int size = 2;
  static constexpr bool nonzero(int row, int column) { return row == 0 ? column < 2 : column > 0; }
};

TEST(Riccati, ZeroBlocksChangeNothing) {
  LinearQuadratic full = random_problem(36);
  Riccati<nx, nu, HalfTransition> sparse(horizon);
  for (int k = 0; k <= horizon; ++k) {
    auto& s = full.stage(k);
    s.A.bottomLeftCorner<2, 2>().setZero();
    s.B.topRows<2>().setZero();
    sparse.stage(k) = s;
  }
  ASSERT_TRUE(full.factorise());
  ASSERT_TRUE(sparse.factorise());
  for (int k = 0; k < horizon; ++k) {
    EXPECT_LT((full.stage(k).factor - sparse.stage(k).factor).cwiseAbs().maxCoeff(), 1e-10);
    EXPECT_LT((full.stage(k).y - sparse.stage(k).y).cwiseAbs().maxCoeff(), 1e-10);
  }
}

TEST(Riccati, DampingIsAddedToEveryHessian) {
  LinearQuadratic damped = random_problem(37), by_hand = random_problem(37);
  for (int k = 0; k <= horizon; ++k) {
    by_hand.stage(k).cost.lxx.diagonal().array() += 3.0;
    by_hand.stage(k).cost.luu.diagonal().array() += 3.0;
  }
  ASSERT_TRUE(damped.factorise(3.0));
  ASSERT_TRUE(by_hand.factorise());
  for (int k = 0; k < horizon; ++k)
    EXPECT_LT((damped.stage(k).factor - by_hand.stage(k).factor).cwiseAbs().maxCoeff(), 1e-12);
}

TEST(Riccati, RefusesACostWithoutMinimum) {
  LinearQuadratic lq = random_problem(35);
  lq.stage(horizon).cost.lxx = -1e3 * Eigen::Matrix4d::Identity();
  EXPECT_FALSE(lq.factorise());
}

using Matrix4 = Eigen::Matrix<double, nx, nx>;

TEST(EndlessCost, SolvesTheDiscreteRiccatiEquationByAFeedbackThatStabilises) {
  double fastest = 0.0;  // of the motions without feedback
  for (unsigned seed = 1; seed <= 200; ++seed) {
    const RiccatiStage<nx, nu> stage = random_problem(seed).stage(0);
    const auto& [lx, lu, lxx, lux, luu] = stage.cost;
    const std::optional<Matrix4> found = endless_cost(stage);
    ASSERT_TRUE(found);
    const Matrix4& P = *found;
    EXPECT_EQ(P, P.transpose());
    EXPECT_GT(P.selfadjointView<Eigen::Lower>().eigenvalues().minCoeff(), 0.0);
    const Eigen::Matrix<double, nu, nx> mixed = lux + stage.B.transpose() * P * stage.A;
    const Eigen::Matrix2d by_input = luu + stage.B.transpose() * P * stage.B;
    const Eigen::Matrix<double, nu, nx> feedback = by_input.ldlt().solve(mixed);
    const Matrix4 residual =
        lxx + stage.A.transpose() * P * stage.A - mixed.transpose() * feedback - P;
    EXPECT_LT(residual.cwiseAbs().maxCoeff(), 1e-11 * P.cwiseAbs().maxCoeff());
    const Matrix4 closed = stage.A - stage.B * feedback;
    EXPECT_LT(closed.eigenvalues().cwiseAbs().maxCoeff(), 1.0);
    fastest = std::max(fastest, stage.A.eigenvalues().cwiseAbs().maxCoeff());
  }
  EXPECT_GT(fastest, 2.0);
}

TEST(EndlessCost, IsEmptyWhereThereIsNone) {
  RiccatiStage<2, 1> stage;  // of two integrators in a chain: A, B, lxx, luu
  stage.A << 1.0, 0.1, 0.0, 1.0;
  stage.B << 0.0, 0.1;
  stage.cost.lxx = Eigen::Vector2d(1.0, 0.0).asDiagonal();
  stage.cost.luu << 1.0;
  EXPECT_TRUE(endless_cost(stage));
  EXPECT_FALSE(endless_cost(stage, 10));  // passes, of the hundreds that it takes
  auto changed = stage;
  changed.cost.lxx = Eigen::Vector2d(0.0, 1.0).asDiagonal();  // the first one's value is free
  EXPECT_FALSE(endless_cost(changed));
  changed = stage;
  changed.B.setZero();  // nothing stops it
  EXPECT_FALSE(endless_cost(changed));
  changed.A << 0.5, 0.1, 0.0, 0.5;  // nothing need
  EXPECT_TRUE(endless_cost(changed));
  changed.cost.luu.setZero();  // no one best input
  EXPECT_FALSE(endless_cost(changed));
}

}  // namespace
}  // namespace tilt_ropter
