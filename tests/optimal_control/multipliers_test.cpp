#include <tilt_ropter/optimal_control/detail/multipliers.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <limits>

namespace tilt_ropter::optimal_control {
namespace multipliers_test {

using test_support::Random;

struct Dual {
  Eigen::MatrixXd H;
  Eigen::VectorXd b, rho;
};

Dual random_dual(Random& random, int size) {
  Eigen::MatrixXd G(size, size + 3);
  Dual d;
  d.b.resize(size);
  d.rho.resize(size);
  for (int i = 0; i < size; ++i) {
    for (int j = 0; j < G.cols(); ++j) G(i, j) = random.normal(1.0);
    G.row(i) *= std::pow(10.0, random.uniform(-2.0, 2.0));  // constraints in very different units
    d.b(i) = random.normal(1.0) * G.row(i).norm();
    d.rho(i) = std::pow(10.0, random.uniform(-2.0, 4.0));
  }
  d.H = G * G.transpose();
  return d;
}

// Error of the first-order conditions of the bound-constrained minimum, in each constraint's units.
double optimality_error(const Dual& d, const Eigen::VectorXd& lambda) {
  const Eigen::VectorXd gradient = d.H * lambda - d.b;
  double error = 0.0;
  for (int i = 0; i < lambda.size(); ++i) {
    const double unit = std::sqrt(d.H(i, i));
    const double step =
        std::min(std::max(lambda(i) * unit - gradient(i) / unit, 0.0), d.rho(i) * unit);
    error = std::max(error, std::abs(step - lambda(i) * unit));
  }
  return error;
}

bool solve(DualSolver& solver, const Dual& d, Eigen::VectorXd& lambda) {
  return solver.solve(static_cast<int>(d.b.size()), d.H, d.b, d.rho, lambda);
}

TEST(DualSolver, SolutionSatisfiesTheFirstOrderConditions) {
  Random random(21);
  for (int i = 0; i < 200; ++i) {
    const int size = 1 + i % 40;
    const Dual d = random_dual(random, size);
    DualSolver solver(40);
    Eigen::VectorXd lambda = Eigen::VectorXd::Zero(size);
    ASSERT_TRUE(solve(solver, d, lambda));
    EXPECT_LT(optimality_error(d, lambda), 1e-7) << "size " << size;
    EXPECT_GE(lambda.minCoeff(), 0.0);
    EXPECT_TRUE((lambda.array() <= d.rho.array()).all());
  }
}

// Newton steps do the rest.
TEST(DualSolver, NloptEvaluatesNoMoreThanAllowed) {
  Random random(25);
  int most = 0, steps = 0;
  for (int i = 0; i < 50; ++i) {
    const Dual d = random_dual(random, 30);
    DualSolver solver(40);
    for (const int allowed : {0, 7}) {
      solver.begin(allowed);
      Eigen::VectorXd lambda = Eigen::VectorXd::Zero(30);
      ASSERT_TRUE(solve(solver, d, lambda));
      EXPECT_LT(optimality_error(d, lambda), 1e-7);
      // NLopt looks at its limit between line searches.
      EXPECT_LE(solver.evaluations(), allowed > 0 ? allowed + 8 : 0);
      most = std::max(most, solver.evaluations());
      steps += solver.polishing_steps();
    }
  }
  EXPECT_GE(most, 7);
  EXPECT_GT(steps, 0);
}

TEST(DualSolver, EveryAlgorithmReachesTheSamePoint) {
  Random random(22);
  for (int i = 0; i < 10; ++i) {
    const Dual d = random_dual(random, 12);
    Eigen::VectorXd first;
    for (const DualAlgorithm algorithm :
         {DualAlgorithm::truncated_newton, DualAlgorithm::lbfgs, DualAlgorithm::variable_metric,
          DualAlgorithm::ccsa, DualAlgorithm::slsqp}) {
      DualSolver solver(12, algorithm);
      Eigen::VectorXd lambda = Eigen::VectorXd::Zero(12);
      ASSERT_TRUE(solve(solver, d, lambda));
      EXPECT_GE(solver.evaluations(), 3);  // NLopt has solved it
      if (first.size() == 0) first = lambda;
      const Eigen::VectorXd unit = d.H.diagonal().cwiseSqrt();
      EXPECT_LT((lambda - first).cwiseProduct(unit).cwiseAbs().maxCoeff(), 1e-6);
    }
  }
}

TEST(DualSolver, WarmStartAtTheSolutionCostsOneEvaluation) {
  Random random(23);
  const Dual d = random_dual(random, 30);
  DualSolver solver(30);
  Eigen::VectorXd lambda = Eigen::VectorXd::Zero(30);
  ASSERT_TRUE(solve(solver, d, lambda));
  const int cold = solver.evaluations();
  ASSERT_TRUE(solve(solver, d, lambda));
  EXPECT_EQ(solver.evaluations() - cold, 1);
}

TEST(DualSolver, RedundantConstraintsShareTheMultiplier) {
  Dual d;
  d.H = Eigen::MatrixXd::Ones(3, 3) + 1e-9 * Eigen::MatrixXd::Identity(3, 3);
  d.b = Eigen::VectorXd::Ones(3);
  d.rho = Eigen::VectorXd::Constant(3, 1e4);
  DualSolver solver(3);
  Eigen::VectorXd lambda = Eigen::VectorXd::Zero(3);
  ASSERT_TRUE(solve(solver, d, lambda));
  EXPECT_NEAR(lambda.sum(), 1.0, 1e-6);
}

TEST(DualSolver, NonFiniteInputFailsAndLeavesTheMultipliers) {
  Random random(24);
  Dual d = random_dual(random, 5);
  d.b(2) = std::numeric_limits<double>::quiet_NaN();
  DualSolver solver(5);
  Eigen::VectorXd lambda = Eigen::VectorXd::Constant(5, 0.25);
  EXPECT_FALSE(solve(solver, d, lambda));
  EXPECT_EQ(lambda, Eigen::VectorXd::Constant(5, 0.25));
}

}  // namespace multipliers_test
}  // namespace tilt_ropter::optimal_control
