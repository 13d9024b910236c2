#include <tilt_ropter/control/detail/plan_in_force.hpp>
#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/benchmark_problem.hpp"
#include "support/patient.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace tilt_ropter {
namespace plan_in_force_test {

using optimal_control::PrepareStatus;
using optimal_control::SolveStatus;

using Solver = optimal_control::MultipleShooting<WheeledFlightProblem<0>>;
using Plan = detail::WrenchPlan<Solver>;

/// Near hover, where no bound is active.
Stated start() {
  Stated x;
  x.wrench.force = test_support::benchmark_hover_force();
  x.body.position << 0.02, -0.01, 1.49;
  return x;
}

/// A plan measured at 3 s.
class PlanInForceTest : public testing::Test {
 protected:
  void SetUp() override {
    solver.reset(start());
    ASSERT_EQ(solver.solve(start()).status, SolveStatus::converged);
    ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
    ASSERT_EQ(solver.feedback(start()).status, SolveStatus::iterated);
    plan.begin(solver, 3.0);
  }

  /// Largest difference of the wrench at `time` from the state of node k, moved by `duration` [s].
  double difference(double time, int k, double duration) const {
    const Wrenchd now = plan.wrench(solver, time);
    const Wrenchd& node = solver.state(k).wrench;
    Plan::Rate error;
    error << now.force - node.force, now.torque - node.torque;
    if (k < solver.horizon()) error -= duration * solver.input(k);
    return error.cwiseAbs().maxCoeff();
  }

  Solver solver{test_support::step_problem(), test_support::patient()};
  Plan plan;
};

TEST_F(PlanInForceTest, WrenchIsLinearInEachInterval) {
  EXPECT_LT(difference(3.0, 0, 0.0), 1e-9);
  EXPECT_LT(difference(3.04, 0, 0.04), 1e-9);
  EXPECT_LT(difference(3.25, 2, 0.05), 1e-9);
  EXPECT_GT(difference(3.25, 2, 0.0), 1e-3);
  EXPECT_LT(difference(2.5, 0, 0.0), 1e-9);                      // before the measurement
  EXPECT_LT(difference(99.0, solver.horizon() - 1, 0.1), 1e-9);  // after the horizon
  EXPECT_EQ(plan.planned_rate(solver, 0.25), solver.input(2));
}

TEST_F(PlanInForceTest, IsInForceUntilItsAgeLimit) {
  EXPECT_TRUE(plan.in_force(3.5, 0.5));
  EXPECT_TRUE(plan.in_force(2.5, 0.5));
  EXPECT_FALSE(plan.in_force(3.51, 0.5));
  EXPECT_FALSE(plan.in_force(2.49, 0.5));
  plan.drop();
  EXPECT_FALSE(plan.exists());
  EXPECT_FALSE(plan.in_force(3.0, 0.5));
}

TEST_F(PlanInForceTest, CorrectionIsGainTimesDeviationAndIsIntegrated) {
  const double time = 3.15;
  Stated expected = solver.problem().step_for(0.05, 1, solver.state(1), solver.input(1));
  EXPECT_LT((plan.correct(solver, time, expected) - solver.input(1)).norm(), 1e-9);

  StateTangentd small = StateTangentd::Zero();
  small.segment<3>(6).setConstant(1e-4);
  const Stated x = solver.problem().retract(expected, small);
  const Plan::Rate rate = plan.correct(solver, time, x);
  const Plan::Rate change = solver.gain(0) * solver.problem().difference(x, expected);
  EXPECT_LT((rate - solver.input(1) - change).norm(), 1e-9);
  EXPECT_GT(change.norm(), 1e-5);

  const Wrenchd later = plan.wrench(solver, time + 0.01);
  EXPECT_LT((later.force - x.wrench.force - 0.01 * rate.head<3>()).norm(), 1e-9);
  plan.begin(solver, 3.2);
  EXPECT_LT(difference(3.2, 0, 0.0), 1e-9);  // a new plan is not corrected
}

TEST_F(PlanInForceTest, KeepsItsFirstStateWhenTheSolverMovesOn) {
  const Stated first = solver.state(0);
  Stated other = first;
  other.body.position.x() += 0.1;
  solver.reset(other);
  EXPECT_EQ(plan.wrench(solver, 3.0).force, first.wrench.force);
  EXPECT_LT((plan.correct(solver, 3.0, first) - solver.input(0)).norm(), 1e-9);
}

TEST_F(PlanInForceTest, WrenchAndRateAreWithinTheBounds) {
  const NmpcBounds& b = solver.problem().settings().bounds;
  StateTangentd large = StateTangentd::Constant(5.0);
  const Stated x = solver.problem().retract(solver.state(0), large);
  const Plan::Rate rate = plan.correct(solver, 3.0, x);
  EXPECT_TRUE((rate.head<3>().cwiseAbs().array() <= b.force_rate.array()).all());
  EXPECT_TRUE((rate.tail<3>().cwiseAbs().array() <= b.torque_rate.array()).all());
  for (const double time : {3.0, 3.5, 30.0}) {
    const Wrenchd w = plan.wrench(solver, time);
    EXPECT_EQ(within(b, w).force, w.force);
    EXPECT_EQ(within(b, w).torque, w.torque);
  }
}

TEST_F(PlanInForceTest, AfterAResetItIsTheWrenchOfTheState) {
  Stated x = start();
  x.wrench.force.x() = 0.1;
  solver.reset(x);
  plan.reset(x);
  EXPECT_EQ(plan.wrench(solver, 3.4).force, x.wrench.force);
}

}  // namespace plan_in_force_test
}  // namespace tilt_ropter
