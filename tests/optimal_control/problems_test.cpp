// Problems from other fields whose solution is known.
// CTest: long

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/patient.hpp"
#include "support/pendulum.hpp"
#include "support/quadrotor.hpp"
#include "support/refusals.hpp"
#include "support/same_optimum.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>
#include <Eigen/QR>

#include <algorithm>
#include <cmath>

namespace tilt_ropter::optimal_control {
namespace problems_test {

using test_support::Contradiction;
using test_support::DoubleIntegrator;
using test_support::expect_same_optimum;
using test_support::is_active;
using test_support::patient;
using test_support::Pendulum;
using test_support::Quadrotor;
using test_support::Unicycle;

TEST(Problems, LinearQuadraticOptimumMatchesDenseLeastSquares) {
  const DoubleIntegrator problem({7});
  const Eigen::Vector2d x0(3.0, 1.0);
  // All residuals are a linear function of all inputs. Its matrix comes from one simulation without
  // input and one simulation for each unit input.
  const auto residuals = [&](const Eigen::VectorXd& u) {
    Eigen::VectorXd all(24);
    Eigen::Vector2d x = x0;
    for (int k = 0; k <= 7; ++k) {
      const Eigen::Matrix<double, 1, 1> input(k < 7 ? u(k) : 0.0);
      all.segment<3>(3 * k) = problem.residual<double>(k, x, input);
      if (k < 7) x = problem.step(k, x, input);
    }
    return all;
  };
  const Eigen::VectorXd free = residuals(Eigen::VectorXd::Zero(7));
  Eigen::MatrixXd by_input(24, 7);
  for (int k = 0; k < 7; ++k) by_input.col(k) = residuals(Eigen::VectorXd::Unit(7, k)) - free;
  const Eigen::VectorXd optimum = by_input.householderQr().solve(-free);

  MultipleShooting<DoubleIntegrator> solver(problem, patient());
  solver.reset(x0);
  const SolveReport report = solver.solve(x0);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_EQ(report.iterations, 1);
  EXPECT_NEAR(report.cost, residuals(optimum).squaredNorm(), 1e-12);
  for (int k = 0; k < 7; ++k) EXPECT_NEAR(solver.input(k)(0), optimum(k), 1e-12);
}

TEST(Problems, FarTargetWithAStopGivesBangBangInputs) {
  // The input is first 1 and then -1. It is 0 in the middle because the number of intervals is odd.
  const DoubleIntegrator problem({7, 30.0, 1.0, true, 0.3, 0.1});
  MultipleShooting<DoubleIntegrator> solver(problem, patient());
  solver.reset(Eigen::Vector2d::Zero());
  const SolveReport report = solver.solve(Eigen::Vector2d::Zero());
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_EQ(report.active_constraints, 6);
  EXPECT_EQ(report.relaxed_constraints, 0);
  for (int k = 0; k < 7; ++k)
    EXPECT_NEAR(solver.input(k)(0), k < 3 ? 1.0 : k == 3 ? 0.0 : -1.0, 1e-6);
}

TEST(Problems, ContradictoryConstraintsAreWeighedByTheirPenalties) {
  for (const double weight : {4.0, 2.0, 1.25}) {  // both constraints violated
    MultipleShooting<Contradiction> solver(Contradiction({4, weight}), patient());
    solver.reset(Contradiction::State(0.3));
    const SolveReport report = solver.solve(Contradiction::State(0.3));
    EXPECT_EQ(report.status, SolveStatus::converged);
    EXPECT_EQ(report.relaxed_constraints, 8);
    EXPECT_NEAR(report.max_violation, 1.0 + 1.0 / weight, 1e-7);
    for (int k = 0; k < 4; ++k) {
      EXPECT_NEAR(solver.input(k)(0), 1.0 / weight, 1e-7);
      EXPECT_DOUBLE_EQ(solver.constraint_multipliers(k)(0), -5.0);
      EXPECT_DOUBLE_EQ(solver.constraint_multipliers(k)(1), 3.0);
    }
  }
  // The constraint with the higher penalty is met exactly: 2 weight u = multiplier - 3 at u = 1.
  MultipleShooting<Contradiction> solver(Contradiction({4, 0.75}), patient());
  solver.reset(Contradiction::State(0.3));
  const SolveReport report = solver.solve(Contradiction::State(0.3));
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_EQ(report.relaxed_constraints, 4);
  for (int k = 0; k < 4; ++k) {
    EXPECT_NEAR(solver.input(k)(0), 1.0, 1e-7);
    EXPECT_NEAR(solver.constraint_multipliers(k)(0), -4.5, 1e-6);
    EXPECT_DOUBLE_EQ(solver.constraint_multipliers(k)(1), 3.0);
  }
}

TEST(Problems, PendulumSwingsUpWithAThirdOfTheGravityTorque) {
  const Pendulum problem({50});
  const Eigen::Vector2d hanging(pi, 0.0);
  MultipleShooting<Pendulum> solver(problem, patient());
  solver.reset(hanging);
  const SolveReport report = solver.solve(hanging);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_LT(report.max_defect, 1e-6);
  EXPECT_LT(report.max_violation, 1e-6);
  EXPECT_GT(report.active_constraints, 10);
  EXPECT_LT(solver.state(50).cwiseAbs().maxCoeff(), 0.1);
  double highest_back = 0.0;  // it must swing the other way first
  for (int k = 0; k <= 50; ++k) highest_back = std::max(highest_back, solver.state(k)(0) - pi);
  EXPECT_GT(highest_back, 0.3);
}

TEST(Problems, UnicycleParksBehindTheObstacle) {
  const Unicycle problem({40});
  const Eigen::Vector3d start(-2.0, 0.0, 0.3);
  MultipleShooting<Unicycle> solver(problem, patient());
  solver.reset(start);
  const SolveReport report = solver.solve(start);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_LT(solver.state(40).cwiseAbs().maxCoeff(), 0.05);
  double nearest = 1e9;
  for (int k = 1; k <= 40; ++k)
    nearest = std::min(nearest, (solver.state(k).head<2>() - problem.obstacle).norm());
  EXPECT_NEAR(nearest, problem.radius, 1e-6);
}

TEST(Problems, QuadrotorRecoversFromItsSide) {
  const Quadrotor problem({30});
  Quadrotor::State start;
  start.position << 1.0, -0.5, 0.0;
  start.orientation = quaternion_exp(Eigen::Vector3d(1.6, 0.3, 0.0));
  start.angular_velocity << 1.0, 0.0, 0.0;
  MultipleShooting<Quadrotor> solver(problem, patient());
  for (int k = 0; k <= 30; ++k)
    solver.set_guess(k, start, Eigen::Vector4d::Constant(Quadrotor::hover_thrust()));
  const SolveReport report = solver.solve(start);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_GT(report.active_constraints, 2);
  EXPECT_LT(problem.difference(solver.state(30), Quadrotor::State{}).cwiseAbs().maxCoeff(), 0.05);
}

Quadrotor::State thrown_quadrotor() {
  Quadrotor::State x;
  x.position << 0.3, -0.2, 0.1;
  x.velocity << 0.5, 0.0, -0.2;
  x.orientation = quaternion_exp(Eigen::Vector3d(0.6, -0.4, 0.8));
  x.angular_velocity << 0.5, -1.0, 0.3;
  return x;
}

TEST(SingleShooting, AgreesWithMultipleShootingOnTheQuadrotor) {
  const auto oracle = expect_same_optimum(Quadrotor({5}), thrown_quadrotor());
  EXPECT_TRUE(is_active(oracle, 0) || is_active(oracle, 1));
}

TEST(SingleShooting, AgreesWithMultipleShootingOnThePendulum) {
  for (const double angle : {0.4, pi}) {
    Pendulum problem({8});
    const auto oracle = expect_same_optimum(problem, Eigen::Vector2d(angle, 0.3));
    EXPECT_TRUE(is_active(oracle, 0));
  }
}

TEST(SingleShooting, AgreesWithMultipleShootingOnTheDoubleIntegrator) {
  expect_same_optimum(DoubleIntegrator({7}), Eigen::Vector2d(3.0, 1.0));
}

TEST(SingleShooting, AgreesWithMultipleShootingOnBoundsWithAnEquality) {
  DoubleIntegrator problem({7, 30.0, 1.0, true, 0.3, 0.1});
  const auto oracle = expect_same_optimum(problem, Eigen::Vector2d::Zero());
  for (int k = 0; k < 7; ++k)
    EXPECT_NEAR(oracle.input(k)(0), k < 3 ? 1.0 : k == 3 ? 0.0 : -1.0, 1e-9);
}

TEST(MultipleShooting, NeedsAHorizonOfOneNodeOrMore) {
  test_support::expect_range("Problem.horizon()", {{1.0, 2.0}, {0.0, -1.0}}, true,
                             [](double horizon) {
                               const Contradiction problem({static_cast<int>(horizon), 0.75});
                               MultipleShooting<Contradiction>{problem};
                             });
}

}  // namespace problems_test
}  // namespace tilt_ropter::optimal_control
