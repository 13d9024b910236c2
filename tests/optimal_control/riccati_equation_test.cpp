#include <tilt_ropter/optimal_control/detail/riccati_equation.hpp>

#include "support/linear_quadratic.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <optional>

namespace tilt_ropter::optimal_control {
namespace {

using test_support::LinearQuadratic;

// Returns the spectral radius of m, from the growth of the powers m^(2^k). Eigen's eigenvalue
// solvers take as long to compile as the rest of this file.
double spectral_radius(Eigen::Matrix4d m) {
  double exponent = 0.0, weight = 1.0;
  for (int k = 0; k < 40; ++k, weight /= 2.0) {
    const double size = m.norm();
    exponent += weight * std::log(size);
    m /= size;
    m = (m * m).eval();
  }
  return std::exp(exponent);
}

TEST(SolveDare, SolvesTheEquationWithAStabilisingFeedback) {
  constexpr int nx = 4, nu = 2;
  using Matrix4 = Eigen::Matrix<double, nx, nx>;
  double fastest = 0.0;  // largest spectral radius without feedback
  for (unsigned seed = 1; seed <= 200; ++seed) {
    const LinearQuadratic<nx, nu> lq(seed);
    const auto& cost = lq.pass.stage(0).cost;
    const auto& A = lq.A[0];
    const auto& B = lq.B[0];
    const std::optional<Matrix4> found = solve_dare<nx, nu>(A, B, cost);
    ASSERT_TRUE(found);
    const Matrix4& P = *found;
    EXPECT_EQ(P, P.transpose());
    EXPECT_EQ(P.llt().info(), Eigen::Success);
    const Eigen::Matrix<double, nu, nx> mixed = cost.lux() + B.transpose() * P * A;
    const Eigen::Matrix2d by_input = cost.luu() + B.transpose() * P * B;
    const Eigen::Matrix<double, nu, nx> feedback = by_input.ldlt().solve(mixed);
    const Matrix4 residual = cost.lxx() + A.transpose() * P * A - mixed.transpose() * feedback - P;
    EXPECT_LT(residual.cwiseAbs().maxCoeff(), 1e-11 * P.cwiseAbs().maxCoeff());
    EXPECT_LT(spectral_radius(A - B * feedback), 1.0);
    fastest = std::max(fastest, spectral_radius(A));
  }
  EXPECT_GT(fastest, 2.0);
}

TEST(SolveDare, IsEmptyIfThereIsNoSolution) {
  Eigen::Matrix2d A;  // two integrators in a chain
  Eigen::Vector2d B(0.0, 0.1);
  QuadraticModel<2, 1> cost;
  A << 1.0, 0.1, 0.0, 1.0;
  cost.lxx() = Eigen::Vector2d(1.0, 0.0).asDiagonal();
  cost.luu() << 1.0;
  const auto exists = [&](int max_passes = 20000) {
    return solve_dare<2, 1>(A, B, cost, max_passes).has_value();
  };
  EXPECT_TRUE(exists());
  EXPECT_FALSE(exists(10));                             // 10 passes; hundreds are needed
  cost.lxx() = Eigen::Vector2d(0.0, 1.0).asDiagonal();  // the first state has no cost
  EXPECT_FALSE(exists());
  cost.lxx() = Eigen::Vector2d(1.0, 0.0).asDiagonal();
  B.setZero();  // no input can stop the motion
  EXPECT_FALSE(exists());
  A << 0.5, 0.1, 0.0, 0.5;  // stable without input
  EXPECT_TRUE(exists());
  cost.luu().setZero();  // the best input is not unique
  EXPECT_FALSE(exists());
}

}  // namespace
}  // namespace tilt_ropter::optimal_control
