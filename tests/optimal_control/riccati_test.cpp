#include <tilt_ropter/optimal_control/riccati.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>
#include <Eigen/Dense>

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
    path.squares += (s.L.transpose() * du + s.Y * dx + s.y).squaredNorm();
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

TEST(Riccati, AdjointIsTheTransposeOfTheClosedLoop) {
  LinearQuadratic lq = random_problem(34);
  ASSERT_TRUE(lq.factorise());
  const auto& s = lq.stage(2);
  // dx+ for a change of dx and of z, through input_step().
  const auto next = [&](const Eigen::Vector4d& dx, const Eigen::Vector2d& z) -> Eigen::Vector4d {
    return s.A * dx + s.B * lq.input_step(2, dx, z);
  };
  const Eigen::Vector4d origin = next(Eigen::Vector4d::Zero(), Eigen::Vector2d::Zero());
  for (int i = 0; i < nx; ++i)
    EXPECT_LT((next(Eigen::Vector4d::Unit(i), Eigen::Vector2d::Zero()) - origin -
               s.adjoint.row(i).transpose())
                  .norm(),
              1e-9);
  for (int i = 0; i < nu; ++i)
    EXPECT_LT((next(Eigen::Vector4d::Zero(), Eigen::Vector2d::Unit(i)) - origin -
               s.adjoint.row(nx + i).transpose())
                  .norm(),
              1e-9);
}

TEST(Riccati, RefusesACostWithoutMinimum) {
  LinearQuadratic lq = random_problem(35);
  lq.stage(horizon).cost.lxx = -1e3 * Eigen::Matrix4d::Identity();
  EXPECT_FALSE(lq.factorise());
}

}  // namespace
}  // namespace tilt_ropter
