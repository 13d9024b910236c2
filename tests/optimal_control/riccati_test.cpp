#include <tilt_ropter/optimal_control/detail/riccati.hpp>

#include "support/linear_quadratic.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

namespace tilt_ropter::optimal_control {
namespace riccati_test {

using test_support::horizon;
using test_support::LinearQuadratic;
using test_support::Random;
using test_support::random_matrix;

template <int nx, int nu, typename Pattern = FullTransition>
void expect_the_dense_optimum(unsigned seed) {
  SCOPED_TRACE(testing::Message() << nx << " states, " << nu << " inputs");
  LinearQuadratic<nx, nu, Pattern> lq(seed);
  for (const double damping : {0.0, 0.3}) {
    ASSERT_TRUE(lq.pass.factorise(damping));
    const Eigen::VectorXd expected = lq.dense_optimum(damping);
    EXPECT_LT((lq.optimum() - expected).norm(), 1e-7 * expected.norm());
  }
}

TEST(Riccati, OptimumMatchesDenseKktSystemForSizesOfEveryRemainder) {
  expect_the_dense_optimum<1, 1>(1);
  expect_the_dense_optimum<4, 4>(4);
  expect_the_dense_optimum<5, 3>(5);
  expect_the_dense_optimum<7, 2>(6);
  expect_the_dense_optimum<9, 2>(7);
  expect_the_dense_optimum<18, 6>(9);
}

struct Staircase {  // A: upper triangle, B: last three rows
  static constexpr bool nonzero(int row, int column) {
    return column >= 6 ? row >= 3 : column >= row;
  }
};

TEST(Riccati, KnownZerosDoNotChangeTheResult) {
  expect_the_dense_optimum<6, 2, Staircase>(36);
  LinearQuadratic<6, 2, Staircase> sparse(37);
  LinearQuadratic<6, 2> full(37);
  for (int k = 0; k < horizon; ++k)
    ASSERT_TRUE(full.pass.set_transition(k, sparse.A[static_cast<std::size_t>(k)],
                                         sparse.B[static_cast<std::size_t>(k)]));
  ASSERT_TRUE(full.pass.factorise());
  ASSERT_TRUE(sparse.pass.factorise());
  EXPECT_LT((full.pass.initial_cost() - sparse.pass.initial_cost()).norm(),
            1e-9 * full.pass.initial_cost().norm());
}

TEST(Riccati, CostIsConstantPlusHalfTheSquareOfCoordinates) {
  constexpr int nx = 5, nu = 3;
  LinearQuadratic<nx, nu> lq(31);
  ASSERT_TRUE(lq.pass.factorise());
  Random random(32);
  double constant = 0.0;
  std::vector<double> z(nu * horizon);
  for (int trial = 0; trial < 50; ++trial) {
    double half_square = 0.0, cost = 0.0;
    for (double& number : z) {
      number = random.normal(2.0);
      half_square += 0.5 * number * number;
    }
    lq.steps[0].head<nx>() = lq.start;
    lq.pass.sweep(lq.steps, z.data());
    for (int k = 0; k <= horizon; ++k) {
      const auto& c = lq.pass.stage(k).cost;
      const Eigen::Matrix<double, nx, 1> dx = lq.steps[static_cast<std::size_t>(k)].head<nx>();
      cost += c.lx().dot(dx) + 0.5 * dx.dot(c.lxx() * dx);
      if (k == horizon) break;
      const Eigen::Matrix<double, nu, 1> du = lq.steps[static_cast<std::size_t>(k)].segment<nu>(nx);
      cost += c.lu().dot(du) + du.dot(c.lux() * dx) + 0.5 * du.dot(c.luu() * du);
    }
    if (trial == 0) constant = cost - half_square;
    EXPECT_NEAR(cost - half_square, constant, 1e-8 * (1.0 + std::abs(cost)));
  }
}

// One more solve with the same factorisation gives the change of the optimum with the gradient.
TEST(Riccati, SolvesForOtherGradientsWithoutRefactorising) {
  constexpr int nx = 7, nu = 2;
  using Problem = LinearQuadratic<nx, nu>;
  Problem lq(33);
  Random random(34);
  ASSERT_TRUE(lq.pass.factorise());
  const Eigen::VectorXd before = lq.optimum();
  std::vector<Problem::Vector> change(horizon + 1), moved(horizon + 1, Problem::Vector::Zero());
  for (auto& g : change) {
    g.setZero();
    g.head<nx + nu>() = random_matrix(random, nx + nu, 1);
  }
  lq.pass.solve(change);
  lq.pass.sweep_change(moved);
  for (int k = 0; k <= horizon; ++k) {
    auto& gradient = lq.pass.stage(k).cost.gradient;
    gradient += change[static_cast<std::size_t>(k)];
    if (k == horizon) gradient.tail(gradient.size() - nx).setZero();
  }
  ASSERT_TRUE(lq.pass.factorise());
  const Eigen::VectorXd after = lq.optimum();
  for (int k = 0; k < horizon; ++k)
    EXPECT_LT(((after - before).segment<nx + nu>((nx + nu) * k) -
               moved[static_cast<std::size_t>(k)].head<nx + nu>())
                  .norm(),
              1e-8 * (1.0 + after.norm()));
}

TEST(Riccati, AddsTermsToTheHessianAndGradientOfTheirNode) {
  constexpr int nx = 5, nu = 2;
  LinearQuadratic<nx, nu> lq(35), by_hand(35);
  Random random(36);
  std::vector<Eigen::Matrix<double, nx + nu, 1>> rows;
  for (int k = 0; k <= horizon; ++k) {
    rows.push_back(random_matrix(random, nx + nu, 1));
    auto& cost = by_hand.pass.stage(k).cost;
    const auto& c = rows.back();
    cost.lxx() += 2.0 * c.head<nx>() * c.head<nx>().transpose();
    cost.lx() += 3.0 * c.head<nx>();
    if (k == horizon) continue;
    cost.luu() += 2.0 * c.tail<nu>() * c.tail<nu>().transpose();
    cost.lux() += 2.0 * c.tail<nu>() * c.head<nx>().transpose();
    cost.lu() += 3.0 * c.tail<nu>();
  }
  constexpr int stride = decltype(lq.pass)::rows;
  ASSERT_TRUE(lq.pass.factorise(0.0, [&](int k, double* hessian, double* gradient) {
    const auto& c = rows[static_cast<std::size_t>(k)];
    const int last = k < horizon ? nx + nu : nx;
    for (int j = 0; j < last; ++j) {
      gradient[j] += 3.0 * c(j);
      for (int i = j < nx ? j : 0; i < (j < nx ? nx : last); ++i)
        hessian[stride * j + i] += 2.0 * c(i) * c(j);
    }
  }));
  ASSERT_TRUE(by_hand.pass.factorise());
  EXPECT_LT((lq.optimum() - by_hand.optimum()).norm(), 1e-9 * lq.optimum().norm());
}

TEST(Riccati, GainAndFeedforwardGiveTheOptimalInputs) {
  constexpr int nx = 6, nu = 3;
  LinearQuadratic<nx, nu> lq(38);
  ASSERT_TRUE(lq.pass.factorise());
  (void)lq.optimum();
  for (int k = 0; k < horizon; ++k) {
    const auto& w = lq.steps[static_cast<std::size_t>(k)];
    EXPECT_LT((w.segment<nu>(nx) - lq.pass.feedforward(k) - lq.pass.gain(k) * w.head<nx>()).norm(),
              1e-9 * (1.0 + w.norm()));
  }
}

// All sweeps follow the same linear dynamics and differ in the inputs.
TEST(Riccati, SweepsDifferInTheirInputsOnly) {
  constexpr int nx = 6, nu = 3;
  using Problem = LinearQuadratic<nx, nu>;
  Problem lq(39);
  ASSERT_TRUE(lq.pass.factorise());
  const auto check = [&](const auto& input) {
    for (int k = 0; k < horizon; ++k) {
      const auto i = static_cast<std::size_t>(k);
      const Problem::Tangent dx = lq.steps[i].head<nx>();
      const Problem::Input du = lq.steps[i].segment<nu>(nx);
      EXPECT_LT((du - input(k, dx)).norm(), 1e-9 * (1.0 + du.norm()));
      EXPECT_LT((lq.steps[i + 1].head<nx>() - lq.A[i] * dx - lq.B[i] * du - lq.defect[i]).norm(),
                1e-9 * (1.0 + dx.norm()));
    }
  };
  lq.steps[0].head<nx>() = lq.start;
  lq.pass.sweep_plan(lq.steps);
  check([&](int k, const Problem::Tangent& dx) -> Problem::Input { return lq.pass.gain(k) * dx; });
  for (auto& w : lq.steps) w.segment<nu>(nx).setConstant(0.3);
  lq.pass.roll_out(lq.steps);
  check(
      [](int, const Problem::Tangent&) -> Problem::Input { return Problem::Input::Constant(0.3); });
  const auto limited = [](double input) { return std::min(std::max(input, -0.1), 0.1); };
  lq.pass.sweep_with(lq.steps, [&](int, Problem::Vector& w) {
    for (int j = 0; j < nu; ++j) w(nx + j) = limited(w(nx + j));
  });
  check([&](int k, const Problem::Tangent& dx) -> Problem::Input {
    Problem::Input du = lq.pass.feedforward(k) + lq.pass.gain(k) * dx;
    for (double& input : du) input = limited(input);
    return du;
  });
}

TEST(Riccati, AdjointStepIsTheTransposeOfTheClosedLoop) {
  constexpr int nx = 5, nu = 2;
  LinearQuadratic<nx, nu> lq(34);
  ASSERT_TRUE(lq.pass.factorise());
  // d dx_3 / d (dx_2, z_2): more matrix rows than one packet, and no multiple of its size.
  constexpr int count = 19, room = detail::padded(count);
  using Adjoint = AdjointBatch<nx, nu>;
  Adjoint::Gradients after(room, nx + nu), before = after;
  after.setZero();
  before.setConstant(7.0);
  for (int i = 0; i < count; ++i) after(i, i % nx) = 1.0;
  Adjoint::step_back(lq.pass.stage(2), after, before, count);
  Adjoint::to_coordinates(lq.pass.stage(2), before, count);
  const auto& s = lq.pass.stage(2);
  Eigen::Matrix<double, nu, nu> by_z;  // du for a unit of each coordinate
  for (int j = 0; j < nu; ++j) {
    Eigen::Matrix<double, nu, 1> du = Eigen::Matrix<double, nu, 1>::Zero();
    for (int i = nu - 1; i >= 0; --i) {
      du(i) = (i == j ? std::sqrt(s.inverse_pivot(i)) : 0.0);
      for (int l = i + 1; l < nu; ++l) du(i) -= s.factor(nx + l, i) * du(l);
    }
    by_z.col(j) = du;
  }
  const Eigen::Matrix<double, nx, nx> by_state = lq.A[2] + lq.B[2] * lq.pass.gain(2);
  const Eigen::Matrix<double, nx, nu> by_coordinates = lq.B[2] * by_z;
  for (int i = 0; i < count; ++i) {
    EXPECT_LT((before.row(i).head<nx>() - by_state.row(i % nx)).norm(), 1e-9);
    EXPECT_LT((before.row(i).tail<nu>() - by_coordinates.row(i % nx)).norm(), 1e-9);
  }
}

TEST(Riccati, TransitionsInLanesEqualSingleTransitions) {
  constexpr int nx = 6, nu = 3;
  LinearQuadratic<nx, nu> lq(40);
  Eigen::Matrix<Lanes, nx, nx> A;
  Eigen::Matrix<Lanes, nx, nu> B;
  gather_into(
      A, 3, [&](int lane) -> const auto& { return lq.A[static_cast<std::size_t>(lane)]; });
  gather_into(
      B, 3, [&](int lane) -> const auto& { return lq.B[static_cast<std::size_t>(lane)]; });
  Riccati<nx, nu> pass(horizon);
  EXPECT_TRUE(pass.set_transitions(0, 3, A, B));
  for (int k = 0; k < 3; ++k) {
    const auto& transition = pass.stage(k).transition;
    EXPECT_EQ(transition, lq.pass.stage(k).transition);
    EXPECT_EQ((transition.topLeftCorner<nx, nx>()), lq.A[static_cast<std::size_t>(k)].transpose());
    EXPECT_EQ((transition.block<nu, nx>(nx, 0)), lq.B[static_cast<std::size_t>(k)].transpose());
  }
  EXPECT_TRUE(pass.stage(3).transition.isZero(0.0));
}

TEST(Riccati, ReportsNonFiniteTransitions) {
  constexpr int nx = 5, nu = 3;
  LinearQuadratic<nx, nu> lq(41);
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    for (int i = 0; i < nx; ++i)
      for (int j = 0; j < nx + nu; ++j) {
        auto A = lq.A[0];
        auto B = lq.B[0];
        (j < nx ? A(i, j) : B(i, j - nx)) = bad;
        EXPECT_FALSE(lq.pass.set_transition(0, A, B)) << i << ' ' << j;
        for (int lane = 0; lane < 4; ++lane) {
          Eigen::Matrix<Lanes, nx, nx> lanes_A;
          Eigen::Matrix<Lanes, nx, nu> lanes_B;
          gather_into(
              lanes_A, Lanes::count, [&](int l) -> const auto& { return l == lane ? A : lq.A[0]; });
          gather_into(
              lanes_B, Lanes::count, [&](int l) -> const auto& { return l == lane ? B : lq.B[0]; });
          EXPECT_FALSE(lq.pass.set_transitions(0, 4, lanes_A, lanes_B)) << i << ' ' << j;
        }
      }
  }
}

TEST(Riccati, RejectsACostWithoutMinimum) {
  LinearQuadratic<4, 2> lq(35);
  lq.pass.stage(horizon).cost.lxx() = -1e3 * Eigen::Matrix4d::Identity();
  EXPECT_FALSE(lq.pass.factorise());
  lq.pass.stage(horizon).cost.lxx().setConstant(std::numeric_limits<double>::quiet_NaN());
  EXPECT_FALSE(lq.pass.factorise());
}

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

}  // namespace riccati_test
}  // namespace tilt_ropter::optimal_control
