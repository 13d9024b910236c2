#include <tilt_ropter/optimal_control/single_shooting.hpp>

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/audit.hpp"
#include "support/benchmark_problem.hpp"
#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/mass.hpp"
#include "support/patient.hpp"
#include "support/pendulum.hpp"
#include "support/quadrotor.hpp"
#include "support/refusals.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

// Problems from other fields, and short problems of the Tilt-Ropter: two solvers that share only
// the problem must agree.
namespace tilt_ropter::optimal_control {
namespace {

using test_support::Audit;
using test_support::audit;
using test_support::Contradiction;
using test_support::DoubleIntegrator;
using test_support::patient;
using test_support::Pendulum;
using test_support::Quadrotor;
using test_support::Unicycle;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

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
SingleShooting<Problem> expect_same_optimum(const Problem& problem,
                                            const typename Problem::State& x0,
                                            double tolerance = 1e-8) {
  SolverSettings exact = patient();
  exact.tolerance = 1e-10;
  SingleShooting<Problem> oracle(problem, exact);
  oracle.reset(x0);
  const SolveReport truth = oracle.solve(x0);
  EXPECT_EQ(truth.status, SolveStatus::converged)
      << truth.max_violation << " " << truth.max_equality;
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

WheeledFlightProblem<0> short_flight(const NmpcBounds& bounds = {}) {
  WheeledFlightSettings settings = test_support::benchmark_settings();
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
  WheeledFlightSettings settings = test_support::benchmark_settings();
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

TEST(SingleShooting, AgreesWithMultipleShootingOnTheUnicycle) {
  const auto around = expect_same_optimum(Unicycle({6}), Eigen::Vector3d(-2.0, 0.0, 0.3));
  EXPECT_TRUE(is_active(around, 0));  // at the obstacle's edge
  EXPECT_TRUE(is_active(around, 1));  // at the speed limit near the obstacle
  // Starts with a heading beyond a right angle, drives backwards and turns across the heading pi.
  expect_same_optimum(Unicycle({8}), Eigen::Vector3d(-1.5, 0.5, 3.1));
}

TEST(SingleShooting, AgreesWithMultipleShootingOnTheQuadrotor) {
  const auto oracle = expect_same_optimum(Quadrotor({5}), thrown_quadrotor());
  EXPECT_TRUE(is_active(oracle, 0) || is_active(oracle, 1));
}

#ifdef TILT_ROPTER_FULL_TESTS
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
#endif

TEST(SingleShooting, AgreesWithMultipleShootingInFlightWithinWideBounds) {
  const auto oracle = expect_same_optimum(short_flight({}), displaced_flight());
  for (int i = 0; i < 15; ++i) EXPECT_FALSE(is_active(oracle, i));
}

TEST(SingleShooting, AgreesWithMultipleShootingInFlightAtThePapersBounds) {
  const auto oracle = expect_same_optimum(short_flight(paper_bounds()), displaced_flight());
  EXPECT_TRUE(is_active(oracle, 0) && is_active(oracle, 9));  // F_x and dF_x
}

TEST(SingleShooting, AgreesWithMultipleShootingAtTouchDown) {
  const auto oracle = expect_same_optimum(short_landing(4, 1e5), above_the_ground());
  EXPECT_LT(oracle.report().max_equality, 1e-9);
}

TEST(SingleShooting, AgreesWithMultipleShootingOnTwoGroundNodes) {
  expect_same_optimum(short_landing(3, 1e5), above_the_ground(), 1e-9);
}

TEST(SingleShooting, AgreesWithMultipleShootingOnGroundWithTheDefaultWeights) {
  expect_same_optimum(short_landing(3, NmpcWeights{}.ground.x()), above_the_ground());
}

TEST(SingleShooting, ReportAgreesWithAnIndependentAudit) {
  Unicycle problem({6});
  const Eigen::Vector3d x0(-2.0, 0.0, 0.3);
  for (const int calls : {1, 2, 200}) {
    SolverSettings settings = patient();
    settings.max_iterations = calls;
    SingleShooting<Unicycle> solver(problem, settings);
    solver.reset(x0);
    const SolveReport report = solver.solve(x0);
    EXPECT_EQ(report.status, calls == 200 ? SolveStatus::converged : SolveStatus::iteration_limit);
    const Audit a = audit(solver);
    EXPECT_DOUBLE_EQ(report.cost, a.cost);
    EXPECT_LT(a.defect, 1e-12);
    EXPECT_DOUBLE_EQ(report.max_violation, a.violation);
  }
}

TEST(SingleShooting, FindsTheOptimumFromAnyGuess) {
  const Quadrotor problem({5});
  const Quadrotor::State x0 = thrown_quadrotor();
  SingleShooting<Quadrotor> cold(problem), warm(problem);
  cold.reset(x0);
  const SolveReport from_cold = cold.solve(x0);
  // A guess with an orientation that differs by 1.5 rad.
  Quadrotor::State turned = x0;
  turned.orientation = x0.orientation * quaternion_exp(Eigen::Vector3d(0.9, -1.2, 0.0));
  const Eigen::Vector4d hover = Eigen::Vector4d::Constant(Quadrotor::hover_thrust());
  for (int k = 0; k <= 5; ++k) warm.set_guess(k, turned, hover);
  const SolveReport from_turned = warm.solve(x0);
  EXPECT_EQ(from_turned.status, SolveStatus::converged);
  EXPECT_NEAR(from_turned.cost, from_cold.cost, 1e-12 * from_cold.cost);
  // A start at the optimum needs one call of NLopt, which evaluates the optimum and one step.
  const SolveReport again = warm.solve(x0);
  EXPECT_EQ(again.status, SolveStatus::converged);
  EXPECT_EQ(again.iterations, 1);
  EXPECT_LE(again.evaluations, 2);
}

TEST(SingleShooting, PaysThePriceOfAContradiction) {
  SingleShooting<Contradiction> solver(Contradiction({4}));
  MultipleShooting<Contradiction> other(Contradiction({4}), patient());
  const Contradiction::State x0(0.3);
  solver.reset(x0);
  other.reset(x0);
  EXPECT_EQ(solver.solve(x0).status, SolveStatus::converged);
  EXPECT_EQ(other.solve(x0).status, SolveStatus::converged);
  EXPECT_NEAR(solver.report().cost, other.report().cost, 1e-6);
  EXPECT_NEAR(solver.report().max_violation, other.report().max_violation, 1e-6);
  EXPECT_GE(solver.report().max_violation, 1.0);
}

TEST(SingleShooting, SoftBoundsAreRelaxedAboveTheirPrice) {
  for (const double penalty : {0.01, 1e3})
    for (const double stiffness : {std::numeric_limits<double>::infinity(), 5.0}) {
      test_support::Mass mass;
      mass.high(1) = 0.2;
      mass.penalties(1) = penalty;
      mass.stiffnesses(1) = stiffness;
      const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
      using Problem = AutoDiffProblem<test_support::Mass>;
      SingleShooting<Problem> solver{Problem(mass)};
      MultipleShooting<Problem> other(Problem(mass), patient());
      solver.reset(rest);
      other.reset(rest);
      EXPECT_EQ(solver.solve(rest).status, SolveStatus::converged) << penalty << ' ' << stiffness;
      EXPECT_EQ(other.solve(rest).status, SolveStatus::converged);
      EXPECT_NEAR(solver.report().cost, other.report().cost, 1e-6 * other.report().cost);
      EXPECT_EQ(solver.report().max_violation > 1e-3, penalty < 1.0 || stiffness < 10.0);
    }
}

TEST(SingleShooting, StallsWhereHardConstraintsContradict) {
  test_support::Mass mass;
  mass.low(0) = 0.5;  // must accelerate
  mass.penalties(1) = std::numeric_limits<double>::infinity();
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  SingleShooting<AutoDiffProblem<test_support::Mass>> solver{
      AutoDiffProblem<test_support::Mass>(mass)};
  solver.reset(rest);
  EXPECT_EQ(solver.solve(rest).status, SolveStatus::stalled);
  EXPECT_GT(solver.report().max_violation, 0.1);
}

TEST(SingleShooting, ConvergesAtOnceFromAnExactOptimum) {
  SingleShooting<Quadrotor> solver(Quadrotor({5}));
  const Quadrotor::State hovering;
  for (int k = 0; k <= 5; ++k)
    solver.set_guess(k, hovering, Eigen::Vector4d::Constant(Quadrotor::hover_thrust()));
  const SolveReport report = solver.solve(hovering);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_LT(report.cost, 1e-15);
}

TEST(SingleShooting, SolvesAgainAsTheFirstTime) {
  WheeledFlightProblem<0> problem = short_flight();
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.node(k).on_ground = true;
    problem.node(k).com_plane.height = 0.1;
    problem.node(k).reference.position << 0.1, 0.0, 0.1;
  }
  SingleShooting<WheeledFlightProblem<0>> solver(problem);
  Stated x = displaced_flight();
  x.body = {};
  x.body.position.z() = 0.1;
  solver.reset(x);
  const SolveReport first = solver.solve(x);
  EXPECT_EQ(first.status, SolveStatus::converged);
  solver.reset(x);
  const SolveReport second = solver.solve(x);
  EXPECT_EQ(second.status, first.status);
  EXPECT_EQ(second.evaluations, first.evaluations);
  EXPECT_EQ(second.cost, first.cost);
}

TEST(SingleShooting, NonFiniteStartIsRejectedAndChangesNothing) {
  SingleShooting<WheeledFlightProblem<0>> solver(short_flight());
  solver.reset(displaced_flight());
  solver.solve(displaced_flight());
  const auto plan = solver.input(0);
  for (const double bad : {nan, std::numeric_limits<double>::infinity()}) {
    Stated x = displaced_flight();
    x.body.velocity.y() = bad;
    EXPECT_EQ(solver.solve(x).status, SolveStatus::rejected);
    EXPECT_EQ(solver.input(0), plan);
  }
  EXPECT_EQ(solver.solve(displaced_flight()).status, SolveStatus::converged);
}

TEST(SingleShooting, NonFiniteProblemFailsAtOnceAndKeepsThePlan) {
  SingleShooting<WheeledFlightProblem<0>> solver(short_flight());
  solver.reset(displaced_flight());
  solver.solve(displaced_flight());
  const auto plan = solver.input(0);
  solver.problem().node(2).reference.position.x() = nan;
  const SolveReport in_cost = solver.solve(displaced_flight());
  EXPECT_EQ(in_cost.status, SolveStatus::failed);
  EXPECT_LE(in_cost.evaluations, 1);
  EXPECT_EQ(solver.input(0), plan);
  solver.problem().node(2).reference.position.x() = 0.0;
  solver.problem().node(1).external.force.x() = nan;
  const SolveReport in_step = solver.solve(displaced_flight());
  EXPECT_EQ(in_step.status, SolveStatus::failed);
  EXPECT_LE(in_step.evaluations, 1);
  EXPECT_EQ(solver.input(0), plan);
}

TEST(SingleShooting, LimitsAreKept) {
  const Eigen::Vector3d x0(-2.0, 0.0, 0.3);
  const auto solve = [&](const SolverSettings& settings) {
    SingleShooting<Unicycle> solver(Unicycle({6}), settings);
    solver.reset(x0);
    return solver.solve(x0);
  };
  SolverSettings s = patient();
  s.max_iterations = 1;
  EXPECT_EQ(solve(s).status, SolveStatus::iteration_limit);
  EXPECT_EQ(solve(s).iterations, 1);
  EXPECT_EQ(solve(s).solved_by, ProgramSolver::nlopt);
  s.max_iterations = 200;
  s.max_time = 1e-9;
  EXPECT_EQ(solve(s).status, SolveStatus::time_limit);
  EXPECT_LE(solve(s).evaluations, 2);
  s = patient();
  s.tolerance = 1.0;
  EXPECT_LT(solve(s).evaluations, solve(patient()).evaluations);
}

TEST(SingleShooting, FeedbackSolvesFromTheLastPlanWithinItsLimit) {
  const Eigen::Vector3d x0(-2.0, 0.0, 0.3);
  SingleShooting<Unicycle> solver(Unicycle({6}), patient());
  solver.reset(x0);
  const SolveReport cold = solver.feedback(x0);
  EXPECT_EQ(cold.status, SolveStatus::converged);
  const Eigen::Vector2d plan = solver.input(0);
  const SolveReport warm = solver.feedback(x0 + Eigen::Vector3d(0.01, 0.0, 0.0));
  EXPECT_EQ(warm.status, SolveStatus::converged);
  EXPECT_LT((solver.input(0) - plan).norm(), 0.1);
  EXPECT_NE(solver.input(0), plan);
  solver.restore_previous();
  EXPECT_EQ(solver.input(0), plan);
  EXPECT_EQ(solver.feedback(x0, SolverClock::now()).status, SolveStatus::time_limit);
}

TEST(SingleShooting, ChecksSettingsAndHorizon) {
  SolverSettings bad;
  bad.max_iterations = 0;
  test_support::expect_refused("SolverSettings.max_iterations",
                               [&] { SingleShooting<Unicycle>(Unicycle({6}), bad); });
  test_support::expect_range(
      "Problem.horizon()", {{1.0, 6.0}, {0.0, -1.0}}, true,
      [](double horizon) { SingleShooting<Unicycle>(Unicycle({static_cast<int>(horizon)})); });
}

}  // namespace
}  // namespace tilt_ropter::optimal_control
