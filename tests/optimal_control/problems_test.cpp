#include <tilt_ropter/control/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/full_space.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/benchmark_problem.hpp"
#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/patient.hpp"
#include "support/pendulum.hpp"
#include "support/quadrotor.hpp"
#include "support/refusals.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>
#include <Eigen/QR>

#include <algorithm>
#include <cmath>
#include <string>

// Problems from other fields, and short problems of the Tilt-Ropter. Either two solvers that share
// only the problem must agree, or the solution is known.
namespace tilt_ropter::optimal_control {
namespace {

using test_support::Contradiction;
using test_support::DoubleIntegrator;
using test_support::patient;
using test_support::Pendulum;
using test_support::Quadrotor;
using test_support::Unicycle;

// Returns true if the constraint `component` is at its bound at any node of the solution.
template <typename Solver>
bool is_active(const Solver& solver, int component) {
  const auto& problem = solver.problem();
  for (int k = 0; k <= problem.horizon(); ++k) {
    const double value = problem.constraint_values(k, solver.state(k), solver.input(k))(component);
    if (std::min(std::abs(value - problem.upper(k)(component)),
                 std::abs(value - problem.lower(k)(component))) < 1e-7)
      return true;
  }
  return false;
}

// Solves with NLopt's SLSQP and with MultipleShooting for each algorithm of the dual, all from a
// cold start, and compares the optima. Returns the SLSQP solver for further checks.
template <typename Problem>
FullSpace<Problem> expect_same_optimum(const Problem& problem, const typename Problem::State& x0,
                                       double tolerance = 1e-8) {
  FullSpace<Problem> oracle(problem);
  oracle.reset(x0);
  const FullSpaceReport truth = oracle.solve(x0);
  EXPECT_EQ(truth.status, FullSpaceStatus::converged)
      << truth.max_defect << " " << truth.max_violation << " " << truth.max_equality;
  for (const DualAlgorithm algorithm :
       {DualAlgorithm::truncated_newton, DualAlgorithm::lbfgs, DualAlgorithm::variable_metric,
        DualAlgorithm::ccsa, DualAlgorithm::slsqp}) {
    SCOPED_TRACE("algorithm " + std::to_string(static_cast<int>(algorithm)));
    SolverSettings settings = patient();
    settings.max_iterations = 200;
    settings.tolerance = tolerance;
    settings.program.dual.algorithm = algorithm;
    MultipleShooting<Problem> solver(problem, settings);
    solver.reset(x0);
    const SolveReport report = solver.solve(x0);
    if (report.status != SolveStatus::converged) {
      ADD_FAILURE() << "status " << static_cast<int>(report.status) << ", KKT residual "
                    << report.kkt << " after " << report.iterations << " iterations";
      continue;
    }
    EXPECT_NEAR(report.cost, truth.cost, 1e-8 * truth.cost);
    for (int k = 0; k < problem.horizon(); ++k)
      EXPECT_LT((solver.input(k) - oracle.input(k)).cwiseAbs().maxCoeff(), 1e-6) << "node " << k;
  }
  return oracle;
}

Quadrotor::State thrown_quadrotor() {
  Quadrotor::State x;
  x.position << 0.3, -0.2, 0.1;
  x.velocity << 0.5, 0.0, -0.2;
  x.orientation = quaternion_exp(Eigen::Vector3d(0.6, -0.4, 0.8));
  x.angular_velocity << 0.5, -1.0, 0.3;
  return x;
}

WheeledFlightProblem<0> short_flight(const NmpcBounds& bounds) {
  WheeledFlightSettings settings;
  settings.intervals = 4;
  settings.bounds = bounds;
  WheeledFlightProblem<0> problem(test_support::benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.node(k).reference.position << 0.0, 0.0, 1.0;
    problem.node(k).wrench_reference.force = test_support::benchmark_hover_force();
  }
  return problem;
}

Stated displaced_flight() {
  Stated x;
  x.wrench.force = test_support::benchmark_hover_force();
  x.body.position << 0.1, -0.2, 0.9;
  x.body.velocity << 0.1, 0.0, 0.2;
  x.body.orientation = quaternion_exp(Eigen::Vector3d(0.2, -0.1, 0.4));
  x.body.angular_velocity << 0.3, -0.2, 0.1;
  return x;
}

// The wheels touch the ground at `touch_down` and stay there.
WheeledFlightProblem<0> short_landing(int touch_down, double ground_weight) {
  WheeledFlightSettings settings;
  settings.intervals = 4;
  settings.weights.ground.setConstant(ground_weight);
  WheeledFlightProblem<0> problem(test_support::benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    WheeledFlightNode& node = problem.node(k);
    node.wrench_reference.force = test_support::benchmark_hover_force();
    node.on_ground = k >= touch_down;
    node.com_plane.height = 0.1;
    node.reference.position << 0.05 * k, 0.02, 0.11;
    node.reference.orientation = quaternion_from_yaw(0.4);
  }
  return problem;
}

Stated above_the_ground() {
  Stated x;
  x.wrench.force = test_support::benchmark_hover_force();
  x.body.position << 0.0, 0.0, 0.115;
  x.body.velocity << 0.3, 0.05, -0.02;
  x.body.orientation = quaternion_exp(Eigen::Vector3d(0.05, -0.1, 0.3));
  return x;
}

TEST(Problems, BothSolversAgreeOnThePendulum) {
  for (const double angle : {0.4, pi}) {
    Pendulum problem({8});
    const auto oracle = expect_same_optimum(problem, Eigen::Vector2d(angle, 0.3));
    EXPECT_TRUE(is_active(oracle, 0));
  }
}

TEST(Problems, BothSolversAgreeOnTheUnicycle) {
  const auto around = expect_same_optimum(Unicycle({6}), Eigen::Vector3d(-2.0, 0.0, 0.3));
  EXPECT_TRUE(is_active(around, 0));  // at the obstacle's edge
  EXPECT_TRUE(is_active(around, 1));  // at the speed limit near the obstacle
  // Starts with a heading beyond a right angle, drives backwards and turns across the heading pi.
  expect_same_optimum(Unicycle({8}), Eigen::Vector3d(-1.5, 0.5, 3.1));
}

TEST(Problems, BothSolversAgreeOnTheQuadrotor) {
  const auto oracle = expect_same_optimum(Quadrotor({5}), thrown_quadrotor());
  EXPECT_TRUE(is_active(oracle, 0) || is_active(oracle, 1));
}

TEST(Problems, BothSolversAgreeOnTheDoubleIntegrator) {
  expect_same_optimum(DoubleIntegrator({7}), Eigen::Vector2d(3.0, 1.0));
}

TEST(Problems, BothSolversAgreeOnBoundsWithAnEquality) {
  DoubleIntegrator problem({7, 30.0, 1.0, true, 0.3, 0.1});
  const auto oracle = expect_same_optimum(problem, Eigen::Vector2d::Zero());
  for (int k = 0; k < 7; ++k)
    EXPECT_NEAR(oracle.input(k)(0), k < 3 ? 1.0 : k == 3 ? 0.0 : -1.0, 1e-9);
}

TEST(Problems, BothSolversAgreeInFlightWithinWideBounds) {
  const auto oracle = expect_same_optimum(short_flight({}), displaced_flight());
  for (int i = 0; i < 15; ++i) EXPECT_FALSE(is_active(oracle, i));
}

TEST(Problems, BothSolversAgreeInFlightAtThePapersBounds) {
  const auto oracle = expect_same_optimum(short_flight(paper_bounds()), displaced_flight());
  EXPECT_TRUE(is_active(oracle, 0) && is_active(oracle, 9));  // F_x and dF_x
}

TEST(Problems, BothSolversAgreeAtTouchDown) {
  const auto oracle = expect_same_optimum(short_landing(4, 1e5), above_the_ground());
  EXPECT_LT(oracle.report().max_equality, 1e-9);
}

TEST(Problems, BothSolversAgreeOnTwoGroundNodes) {
  expect_same_optimum(short_landing(3, 1e5), above_the_ground(), 1e-9);
}

TEST(Problems, BothSolversAgreeOnGroundWithTheDefaultWeights) {
  expect_same_optimum(short_landing(3, NmpcWeights{}.ground.x()), above_the_ground());
}

TEST(Problems, LinearQuadraticOptimumMatchesDenseLeastSquares) {
  const DoubleIntegrator problem({7});
  const Eigen::Vector2d x0(3.0, 1.0);
  // All residuals are a linear function of all inputs. Its matrix comes from one simulation without
  // input and one simulation for each unit input.
  const auto residuals = [&](const Eigen::Matrix<double, 7, 1>& u) {
    Eigen::Matrix<double, 24, 1> all;
    Eigen::Vector2d x = x0;
    for (int k = 0; k <= 7; ++k) {
      const Eigen::Matrix<double, 1, 1> input(k < 7 ? u(k) : 0.0);
      all.segment<3>(3 * k) = problem.residual<double>(k, x, input);
      if (k < 7) x = problem.step(k, x, input);
    }
    return all;
  };
  using Inputs = Eigen::Matrix<double, 7, 1>;
  const Eigen::Matrix<double, 24, 1> free = residuals(Inputs::Zero());
  Eigen::Matrix<double, 24, 7> by_input;
  for (int k = 0; k < 7; ++k) by_input.col(k) = residuals(Inputs::Unit(k)) - free;
  const Eigen::Matrix<double, 7, 7> normal = by_input.transpose() * by_input;
  const Inputs optimum = normal.ldlt().solve(-by_input.transpose() * free);

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

TEST(MultipleShooting, NeedsAHorizonOfOneNodeOrMore) {
  test_support::expect_range("Problem.horizon()", {{1.0, 2.0}, {0.0, -1.0}}, true,
                             [](double horizon) {
                               const Contradiction problem({static_cast<int>(horizon), 0.75});
                               MultipleShooting<Contradiction>{problem};
                             });
}

}  // namespace
}  // namespace tilt_ropter::optimal_control
