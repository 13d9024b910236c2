#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/audit.hpp"
#include "support/benchmark_problem.hpp"
#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/patient.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>

namespace tilt_ropter {
namespace {

using test_support::air_plant;
using test_support::air_position;
using test_support::air_problem;
using test_support::air_start;
using test_support::patient;
using test_support::Random;
using test_support::set_air_reference;
using test_support::step_problem;
using test_support::step_start;

using test_support::Contradiction;
using test_support::DoubleIntegrator;

using Solver = MultipleShooting<WheeledFlightProblem<>>;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

template <typename AnySolver>
bool plan_is_finite(const AnySolver& solver) {
  for (int k = 0; k <= solver.horizon(); ++k)
    if (!all_finite(solver.problem().difference(solver.state(k), solver.state(0))) ||
        !all_finite(solver.input(k)))
      return false;
  return true;
}

template <typename AnySolver>
std::set<std::pair<int, int>> rows_given_up(const AnySolver& solver) {
  std::set<std::pair<int, int>> rows;
  for (int k = 0; k <= solver.horizon(); ++k)
    for (int i = 0; i < AnySolver::nc; ++i)
      if (solver.given_up(k, i)) rows.insert({k, i});
  return rows;
}

TEST(MultipleShooting, ReachesTheKnownOptimumOfStep) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  const SolveReport report = solver.solve(step_start());
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_LE(report.kkt, 1e-6);
  // With the homogeneous R(q) of the stages and the quaternion renormalised: 2074.1813 by IPOPT.
  EXPECT_NEAR(report.cost, 2074.1813, 1e-6 * 2074.1813);
  EXPECT_NEAR(report.cost, 2074.17, 1e-4 * 2074.17);
}

// More constraints matter on the way than it begins with at most. A real-time iteration goes on by
// passes, whose number is bounded.
TEST(MultipleShooting, TheFirstProgramOfStepIsLeftToNloptByASolveToConvergence) {
  SolverSettings settings = patient();
  settings.max_iterations = 1;
  Solver solver(step_problem(), settings);
  solver.reset(step_start());
  SolveReport report = solver.solve(step_start());
  EXPECT_LE(report.program_residual, 1e-6);
  EXPECT_GT(report.active_rows, 10);
  EXPECT_EQ(report.passes, 0);
  solver.reset(step_start());
  ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
  report = solver.feedback(step_start());
  EXPECT_LE(report.program_residual, 1e-6);
  EXPECT_GT(report.passes, 0);
}

TEST(MultipleShooting, NothingIsFactorisedAtASolutionButForTheFirstGains) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  SolverSettings settings = patient();
  settings.max_iterations = solver.report().iterations - 1;
  Solver before(step_problem(), settings);
  before.reset(step_start());
  ASSERT_EQ(before.solve(step_start()).status, SolveStatus::iteration_limit);
  EXPECT_EQ(solver.gain(0), before.gain(0));

  State<> hover;
  hover.wrench.force = test_support::benchmark_hover_force();
  hover.body.position.z() = 1.5;
  Solver there(step_problem(), patient());
  there.reset(hover);
  ASSERT_EQ(there.solve(hover).status, SolveStatus::converged);
  EXPECT_EQ(there.report().iterations, 0);
  EXPECT_GT(there.gain(0).norm(), 1.0);
}

TEST(MultipleShooting, ReachesTheKnownOptimumOfAirAtTickZero) {
  Solver solver(air_problem(), patient());
  set_air_reference(solver.problem(), 0.0);
  solver.reset(air_start());
  const SolveReport report = solver.solve(air_start());
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_NEAR(report.cost, 6.208551513, 1e-5);
  EXPECT_GT(report.active_rows, 20);
}

TEST(MultipleShooting, RealTimeIterationTracksAirLikeTheReferenceSolvers) {
  Solver solver(air_problem(), patient());
  set_air_reference(solver.problem(), 0.0);
  State<> x = air_start();
  solver.reset(x);
  ASSERT_EQ(solver.solve(x).status, SolveStatus::converged);
  double squares = 0.0;
  for (int i = 0; i < 500; ++i) {
    set_air_reference(solver.problem(), 0.02 * i);
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    ASSERT_EQ(solver.feedback(x).status, SolveStatus::iterated);
    x = air_plant(x, solver.input(0));
    squares += (x.body.position - air_position(0.02 * (i + 1))).squaredNorm();
  }
  EXPECT_NEAR(std::sqrt(squares / 500), 0.0410, 0.0002);
}

TEST(MultipleShooting, ReportAgreesWithAnIndependentAudit) {
  Random random(11);
  for (int i = 0; i < 30; ++i) {
    Solver solver(step_problem(), patient());
    State<> x = step_start();
    x.body.position = Eigen::Vector3d(0, 0, 1.5) + random.vector(1.0);
    x.body.velocity = random.vector(0.8);
    x.body.orientation = quaternion_exp(random.vector(0.5));
    x.body.angular_velocity = random.vector(1.0);
    solver.reset(x);
    const SolveReport report = solver.solve(x);
    ASSERT_EQ(report.status, SolveStatus::converged) << "start " << i;
    const test_support::Audit a = test_support::audit(solver);
    EXPECT_NEAR(a.cost, report.cost, 1e-9 * (1.0 + a.cost));
    EXPECT_NEAR(a.defect, report.max_defect, 1e-12);
    EXPECT_NEAR(a.violation, report.max_violation, 1e-12);
    EXPECT_LT(a.violation, 1e-6);
    EXPECT_LT(a.defect, 1e-6);
  }
}

TEST(MultipleShooting, OptimumCannotBeImprovedByFeasibleChanges) {
  // Multipliers or not: no feasible input sequence near the optimum costs less.
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  const SolveReport report = solver.solve(step_start());
  const WheeledFlightProblem<>& problem = solver.problem();
  Random random(12);
  int feasible = 0;
  for (int trial = 0; trial < 2000; ++trial) {
    State<> x = step_start();
    double cost = 0.0;
    bool inside = true;
    const double size = std::pow(10.0, random.uniform(-4.0, -1.0));
    for (int k = 0; k <= problem.horizon(); ++k) {
      Eigen::Matrix<double, 6, 1> u = Eigen::Matrix<double, 6, 1>::Zero();
      if (k < problem.horizon()) {
        u = solver.input(k);
        u.head<3>() += random.vector(size);
        u.tail<3>() += random.vector(size);
        u = u.cwiseMax(problem.lower(k).tail<6>()).cwiseMin(problem.upper(k).tail<6>());
      }
      cost += problem.cost(k, x, u);
      const auto rows = problem.row_values(k, x, u);
      inside = inside && (rows - problem.upper(k)).maxCoeff() < 1e-9 &&
               (problem.lower(k) - rows).maxCoeff() < 1e-9;
      if (k < problem.horizon()) x = problem.step(k, x, u);
    }
    if (!inside) continue;
    ++feasible;
    EXPECT_GT(cost, report.cost - 1e-6);
  }
  EXPECT_GT(feasible, 100);
}

TEST(MultipleShooting, ThePenaltyIsThePriceAtWhichABoundIsGivenUp) {
  const auto violation_at = [](double row_penalty) {
    WheeledFlightSettings settings;
    settings.penalties = {row_penalty, row_penalty, row_penalty, row_penalty};
    WheeledFlightProblem<> problem(test_support::benchmark_body(), settings);
    for (int k = 0; k <= problem.horizon(); ++k) problem.node(k) = step_problem().node(k);
    Solver solver(problem, patient());
    solver.reset(step_start());
    EXPECT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
    double largest = 0.0;
    for (int k = 0; k <= problem.horizon(); ++k)
      largest = std::max(largest, solver.row_multipliers(k).cwiseAbs().maxCoeff());
    EXPECT_LE(largest, row_penalty);
    return solver.report().max_violation;
  };
  EXPECT_LT(violation_at(1e4), 1e-6);
  EXPECT_GT(violation_at(1.0), 1e-2);  // cheaper than keeping it
}

TEST(MultipleShooting, NonFiniteStartIsRejectedAndChangesNothing) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  const auto plan = solver.input(0);
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    State<> x = step_start();
    x.body.velocity.y() = bad;
    EXPECT_EQ(solver.solve(x).status, SolveStatus::rejected);
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    EXPECT_EQ(solver.feedback(x).status, SolveStatus::rejected);
    EXPECT_EQ(solver.input(0), plan);
  }
}

TEST(MultipleShooting, NonFiniteProblemFailsAndKeepsThePlan) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  ASSERT_EQ(solver.solve(step_start()).status, SolveStatus::converged);
  const auto plan = solver.input(0);
  solver.problem().node(5).reference.position.x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_EQ(solver.prepare(), PrepareStatus::failed);
  EXPECT_EQ(solver.feedback(step_start()).status, SolveStatus::failed);
  EXPECT_EQ(solver.input(0), plan);
}

TEST(MultipleShooting, FeedbackWithoutPrepareFails) {
  Solver solver(step_problem(), patient());
  solver.reset(step_start());
  EXPECT_EQ(solver.feedback(step_start()).status, SolveStatus::failed);
}

TEST(MultipleShooting, LimitsOnIterationsAndTimeAreKept) {
  SolverSettings settings = patient();
  settings.max_iterations = 2;
  Solver few(step_problem(), settings);
  few.reset(step_start());
  EXPECT_EQ(few.solve(step_start()).status, SolveStatus::iteration_limit);
  EXPECT_EQ(few.report().iterations, 2);

  settings.max_iterations = 50;
  settings.max_time = 1e-9;
  Solver hurried(step_problem(), settings);
  hurried.reset(step_start());
  EXPECT_EQ(hurried.solve(step_start()).status, SolveStatus::time_limit);
}

TEST(MultipleShooting, ToleranceDecidesWhenItStops) {
  SolverSettings loose = patient();
  loose.tolerance = 1.0;
  Solver early(step_problem(), loose), late(step_problem(), patient());
  early.reset(step_start());
  late.reset(step_start());
  EXPECT_LT(early.solve(step_start()).iterations, late.solve(step_start()).iterations);
  EXPECT_LE(early.report().kkt, 1.0);
}

TEST(MultipleShooting, MultipliersMeetTheGroundConditionsCloserThanWeights) {
  const auto largest_error = [](bool update_multipliers) {
    SolverSettings settings = patient();
    settings.update_multipliers = update_multipliers;
    settings.max_iterations = 25;
    settings.tolerance = 1e-9;
    WheeledFlightProblem<> problem = step_problem();
    for (int k = 0; k <= problem.horizon(); ++k) {
      problem.node(k).on_ground = k >= 10;  // late enough for the vehicle to get there
      problem.node(k).reference.position << 0.0, 0.0, 0.3;
    }
    State<> x;
    x.wrench.force = test_support::benchmark_hover_force();
    x.body.position << 0.1, 0.0, 0.25;
    Solver solver(problem, settings);
    solver.reset(x);
    return solver.solve(x).max_equality;
  };
  const double by_weights = largest_error(false);
  EXPECT_LT(by_weights, 0.1);
  EXPECT_LT(largest_error(true), by_weights / 10.0);
}

// Pushes that are rewarded in every other interval, so that the Hessians the problem gives are not
// positive definite and only the bounds make a minimum.
struct Saddle : DoubleIntegrator {
  Saddle() : DoubleIntegrator({7, 0.0, 1.0}) {}

  double cost(int k, const State& x, const Input& u) const {
    return DoubleIntegrator::cost(k, x, u) - (is_rewarded(k) ? u.squaredNorm() : 0.0);
  }
  void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 1>& model) const {
    DoubleIntegrator::cost_model(k, x, u, model);
    if (!is_rewarded(k)) return;
    model.lu() -= 2.0 * u;
    model.luu()(0, 0) -= 2.0;
  }

 private:
  bool is_rewarded(int k) const { return k % 2 == 1 && k < intervals; }
};

TEST(MultipleShooting, HessiansThatAreNotPositiveDefiniteAreDampedToALocalMinimum) {
  Random random(13);
  const Saddle problem;
  for (int start = 0; start < 10; ++start) {
    const Eigen::Vector2d x0 = random.vector(2.0).head<2>();
    MultipleShooting<Saddle> solver(problem);
    solver.reset(x0);
    const SolveReport report = solver.solve(x0);
    ASSERT_EQ(report.status, SolveStatus::converged) << "start " << start;
    EXPECT_GT(report.damping, 0.0);
    const test_support::Audit a = test_support::audit(solver);
    EXPECT_LT(std::max(a.defect, a.violation), 1e-6);
    for (int trial = 0; trial < 200; ++trial) {  // no push nearby costs less
      Eigen::Vector2d x = x0;
      double cost = 0.0;
      for (int k = 0; k <= 7; ++k) {
        Saddle::Input u = solver.input(k);
        if (k < 7) u(0) = std::min(std::max(u(0) + random.uniform(-1e-3, 1e-3), -1.0), 1.0);
        cost += problem.cost(k, x, u);
        if (k < 7) x = problem.step(k, x, u);
      }
      EXPECT_GT(cost, a.cost - 1e-8);
    }
  }
}

TEST(MultipleShooting, FeedbackWorksWithDampingAndResetClearsIt) {
  MultipleShooting<Saddle> solver{Saddle()};
  const Eigen::Vector2d x0(1.0, 1.0);
  solver.reset(x0);
  EXPECT_EQ(solver.report().damping, 0.0);
  for (int i = 0; i < 20; ++i) {
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    EXPECT_GT(solver.report().damping, 0.0);
    EXPECT_EQ(solver.feedback(x0).status, SolveStatus::iterated);
    ASSERT_TRUE(plan_is_finite(solver));
    EXPECT_LT(test_support::audit(solver).violation, 1e-6);
  }
  solver.reset(x0);
  EXPECT_EQ(solver.report().damping, 0.0);
}

TEST(MultipleShooting, SaysOfEveryRowWhetherItWasGivenUp) {
  const auto solve = [](double weight) {
    MultipleShooting<Contradiction> solver(Contradiction({4, weight}));
    solver.reset(Contradiction::State(0.3));
    solver.solve(Contradiction::State(0.3));
    auto rows = rows_given_up(solver);
    EXPECT_EQ(solver.report().given_up_rows, static_cast<int>(rows.size()));
    return rows;
  };
  // Both rows of every input, and then only the cheaper one.
  EXPECT_EQ(solve(2.0), (std::set<std::pair<int, int>>{
                            {0, 0}, {0, 1}, {1, 0}, {1, 1}, {2, 0}, {2, 1}, {3, 0}, {3, 1}}));
  EXPECT_EQ(solve(0.75), (std::set<std::pair<int, int>>{{0, 1}, {1, 1}, {2, 1}, {3, 1}}));
}

TEST(MultipleShooting, InfeasibleStartGivesUpTheRowsThatItMust) {
  State<> x;
  x.body.position << 0.0, 0.0, 1.5;
  x.wrench.force << 9.0, 0.0, 14.7;  // the box ends at 6, and F_x falls by 2 an interval
  Solver solver(step_problem(), patient());
  solver.reset(x);
  SolveReport report = solver.solve(x);
  EXPECT_EQ(report.status, SolveStatus::converged);
  EXPECT_EQ(rows_given_up(solver), (std::set<std::pair<int, int>>{{1, 0}}));
  EXPECT_EQ(report.given_up_rows, 1);
  EXPECT_NEAR(report.max_violation, 1.0, 1e-6);

  x.body.angular_velocity << 6.0, 0.0, 0.0;  // the bound is 4, and M takes time to build up
  solver.reset(x);
  report = solver.solve(x);
  EXPECT_EQ(report.status, SolveStatus::converged);
  const auto rows = rows_given_up(solver);
  EXPECT_EQ(report.given_up_rows, static_cast<int>(rows.size()));
  EXPECT_EQ(rows, (std::set<std::pair<int, int>>{{1, 0}, {1, 6}}));
  for (int k = 0; k <= solver.horizon(); ++k) {  // given up is what is violated
    const auto value = solver.problem().row_values(k, solver.state(k), solver.input(k));
    for (int i = 0; i < Solver::nc; ++i)
      EXPECT_EQ(
          violation(value(i), solver.problem().lower(k)(i), solver.problem().upper(k)(i)) > 1e-6,
          rows.count({k, i}) == 1)
          << "node " << k << " row " << i;
  }
}

TEST(MultipleShooting, MemorySavesIterationsAndDoesNotChangeTheOptimum) {
  Random random(131);
  int with = 0, without = 0;
  for (int i = 0; i < 40; ++i) {
    State<> x = step_start();
    x.body.position = Eigen::Vector3d(0, 0, 1.5) + random.vector(1.0);
    x.body.velocity = random.vector(1.0);
    x.body.orientation = quaternion_exp(random.vector(0.6));
    x.body.angular_velocity = random.vector(1.0);
    SolverSettings settings = patient();
    settings.memory = 0;
    Solver forgetful(step_problem(), settings), learning(step_problem(), patient());
    forgetful.reset(x);
    learning.reset(x);
    ASSERT_EQ(forgetful.solve(x).status, SolveStatus::converged) << "start " << i;
    ASSERT_EQ(learning.solve(x).status, SolveStatus::converged) << "start " << i;
    const double cost = forgetful.report().cost;
    EXPECT_NEAR(learning.report().cost, cost, 1e-6 * cost) << "start " << i;
    without += forgetful.report().iterations;
    with += learning.report().iterations;
  }
  EXPECT_LT(with, without);  // measured: 385 and 470
}

// Knows nothing of speeds beyond `fence`.
struct Fenced : DoubleIntegrator {
  enum class Unknown { step, cost, rows };

  Fenced(Unknown what, double where)
      : DoubleIntegrator({7, 30.0, 1.0}), unknown(what), fence(where) {}

  State step(int k, const State& x, const Input& u) const {
    return is_unknown(Unknown::step, x) ? State::Constant(nan) : DoubleIntegrator::step(k, x, u);
  }
  State step(int k, const State& x, const Input& u, D::A& A, D::B& B) const {
    const State end = DoubleIntegrator::step(k, x, u, A, B);
    return is_unknown(Unknown::step, x) ? State::Constant(nan) : end;
  }
  double cost(int k, const State& x, const Input& u) const {
    return is_unknown(Unknown::cost, x) ? nan : DoubleIntegrator::cost(k, x, u);
  }
  Rows row_values(int k, const State& x, const Input& u) const {
    return is_unknown(Unknown::rows, x) ? Rows(nan) : DoubleIntegrator::row_values(k, x, u);
  }

 private:
  bool is_unknown(Unknown what, const State& x) const {
    return what == unknown && std::abs(x(1)) > fence;
  }
  Unknown unknown;
  double fence;
};

TEST(MultipleShooting, NonFiniteNumbersOnTheWayEndInAFinitePlanThatIsNotCalledConverged) {
  const Eigen::Vector2d rest = Eigen::Vector2d::Zero();
  for (const auto unknown : {Fenced::Unknown::step, Fenced::Unknown::cost, Fenced::Unknown::rows})
    for (const double fence : {0.5, 2.0, 100.0})
      for (const int memory : {0, 16}) {
        SolverSettings settings = patient();
        settings.memory = memory;
        MultipleShooting<Fenced> solver(Fenced(unknown, fence), settings);
        solver.reset(rest);
        const SolveReport report = solver.solve(rest);
        EXPECT_TRUE(plan_is_finite(solver));
        EXPECT_TRUE(std::isfinite(report.cost) && std::isfinite(report.kkt));
        if (fence > 10.0) {
          EXPECT_EQ(report.status, SolveStatus::converged);
        } else {  // the optimum is on the other side
          EXPECT_EQ(report.status, SolveStatus::stalled);
          EXPECT_GT(report.kkt, 1.0);
        }
        EXPECT_TRUE(std::isfinite(test_support::audit(solver).cost));
      }
}

// Far away, upside down and tumbling.
State<> wild_start(Random& random) {
  State<> x = step_start();
  x.body.position = Eigen::Vector3d(0, 0, 1.5) + random.vector(2.0);
  x.body.velocity = random.vector(2.0);
  x.body.orientation = quaternion_exp(150.0 * pi / 180.0 * random.vector(1.0).normalized());
  x.body.angular_velocity = random.vector(3.0);
  return x;
}

double penalised_cost(const Solver& solver, double price) {
  const WheeledFlightProblem<>& problem = solver.problem();
  double sum = 0.0;
  for (int k = 0; k <= problem.horizon(); ++k) {
    sum += problem.cost(k, solver.state(k), solver.input(k));
    const auto value = problem.row_values(k, solver.state(k), solver.input(k));
    for (int i = 0; i < Solver::nc; ++i)
      sum += price * violation(value(i), problem.lower(k)(i), problem.upper(k)(i));
    if (k < problem.horizon())
      sum +=
          price *
          problem.difference(problem.step(k, solver.state(k), solver.input(k)), solver.state(k + 1))
              .lpNorm<1>();
  }
  return sum;
}

void expect_better_than_the_guess(int max_iterations) {
  Random random(132);
  for (int i = 0; i < 60; ++i) {
    const State<> x = wild_start(random);
    SolverSettings settings = patient();
    settings.max_iterations = max_iterations;
    Solver solver(step_problem(), settings);
    solver.reset(x);
    const double before = penalised_cost(solver, 1e4);
    solver.solve(x);
    EXPECT_TRUE(plan_is_finite(solver));
    EXPECT_LE(penalised_cost(solver, 1e4), before) << "start " << i;
  }
}

TEST(MultipleShooting, ThirtyIterationsFromAWildStartAreBetterThanTheGuess) {
  expect_better_than_the_guess(30);
}

// What is learnt far away does not mislead nearby.
TEST(MultipleShooting, WildStartsConvergeInFewIterations) {
  Random random(134);
  int iterations = 0;
  for (int i = 0; i < 60; ++i) {
    const State<> x = wild_start(random);
    Solver solver(step_problem(), patient());
    solver.reset(x);
    EXPECT_EQ(solver.solve(x).status, SolveStatus::converged) << "start " << i;
    iterations += solver.report().iterations;
  }
  EXPECT_LT(iterations, 1700);  // measured: 1465, and 1937 where no move was forgotten
}

TEST(MultipleShooting, SettingsOutOfRangeAreRefusedByName) {
  const auto message = [](const SolverSettings& settings) -> std::string {
    try {
      Solver solver(step_problem(), settings);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "accepted";
  };
  SolverSettings s;
  s.max_iterations = 0;
  EXPECT_NE(message(s).find("SolverSettings.max_iterations = 0: must be > 0"), std::string::npos);
  s = {};
  s.tolerance = std::numeric_limits<double>::quiet_NaN();
  EXPECT_NE(message(s).find("SolverSettings.tolerance"), std::string::npos);
  s = {};
  s.program.max_dual_rows = -1;
  EXPECT_NE(message(s).find("QuadraticProgramSettings.max_dual_rows = -1"), std::string::npos);
  s = {};
  s.program.dual.max_evaluations = 0;
  EXPECT_NE(message(s).find("DualSettings.max_evaluations"), std::string::npos);
}

}  // namespace
}  // namespace tilt_ropter
