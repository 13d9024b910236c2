// Plans that are not credible, after a measurement that cannot be true.

#include <tilt_ropter/control/nmpc.hpp>

#include "support/hovering.hpp"
#include "support/ideal_loop.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace tilt_ropter {
namespace receding_horizon_test {

using test_support::expect_within_bounds;
using test_support::hover;
using test_support::hovering;
using test_support::IdealLoop;
using test_support::Random;

NmpcSettings settings_with(int max_passes) {
  NmpcSettings settings;
  settings.solver.program.max_passes = max_passes;
  return settings;
}

// On the way to the hover, so that its plan changes the wrench.
IdealLoop on_the_way(int max_passes) {
  IdealLoop loop(settings_with(max_passes));
  loop.state.body.position += Eigen::Vector3d(0.3, -0.2, 0.1);
  for (int i = 0; i < 20; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  return loop;
}

BodyStated spinning(const IdealLoop& loop) {  // at ten times the largest credible rate
  BodyStated wrong = loop.state.body;
  wrong.angular_velocity.setConstant(
      100.0 * loop.nmpc.settings().problem.bounds.angular_velocity.maxCoeff());
  return wrong;
}

const NmpcResult& tick_with(IdealLoop& loop, const BodyStated& measured) {
  (void)loop.nmpc.prepare(loop.time, hover, in_the_air({}));
  return loop.nmpc.feedback(loop.time, measured);
}

// There is no time for another plan if the first took more than a quarter of the allowed passes.
TEST(RecedingHorizon, LastPlanContinuesIfThePlanIsNotCredibleAndThereIsNoTimeForAnother) {
  IdealLoop wrong = on_the_way(3), blind = on_the_way(3);
  const NmpcResult result = tick_with(wrong, spinning(wrong));
  EXPECT_EQ(result.status, NmpcStatus::solver_failed);
  EXPECT_GT(4 * result.report.passes, 3);
  (void)blind.nmpc.prepare(blind.time, hover, in_the_air({}));
  const NmpcResult last = blind.nmpc.hold(blind.time);
  EXPECT_EQ(result.wrench.force, last.wrench.force);
  EXPECT_EQ(result.wrench.torque, last.wrench.torque);
  EXPECT_EQ(result.rate.force, last.rate.force);
  EXPECT_EQ(result.rate.torque, last.rate.torque);
  EXPECT_GT(last.rate.force.norm(), 0.01);
  // The solver, too, has its last plan.
  for (int k = 0; k <= wrong.nmpc.solver().horizon(); ++k)
    EXPECT_EQ(wrong.nmpc.solver().state(k).body.position,
              blind.nmpc.solver().state(k).body.position);
  // It goes on from there.
  EXPECT_EQ(tick_with(wrong, wrong.state.body).status, NmpcStatus::solved);
}

// A state far from the plan in every respect. The plan from the last linearisation has body rates
// above 47 rad/s, beyond the 40 rad/s that are credible; that from a cold start stays below 27
// rad/s.
TEST(RecedingHorizon, PlanFromAColdStartIsUsedIfOnlyTheFirstIsNotCredible) {
  for (const unsigned seed : {319U, 337U, 587U}) {
    Random random(seed);
    IdealLoop loop(settings_with(1000));
    for (int i = 0; i < 2; ++i) (void)loop.tick(hover);
    BodyStated tumbling = hovering();
    tumbling.orientation = random.orientation();
    tumbling.angular_velocity = random.vector(28.0);
    tumbling.velocity = random.vector(30.0);
    tumbling.position += random.vector(100.0);
    const NmpcResult& result = tick_with(loop, tumbling);
    EXPECT_EQ(result.status, NmpcStatus::solved) << seed;
    expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
    for (int k = 1; k <= loop.nmpc.solver().horizon(); ++k)
      EXPECT_LT(loop.nmpc.solver().state(k).body.angular_velocity.norm(), 40.0) << seed;
  }
}

// Within the horizon of 2 s, together with the reference.
TEST(RecedingHorizon, PlanThatLeavesByMoreThanAKilometreIsNotCredible) {
  for (const double speed : {-450.0, 450.0, 550.0}) {
    IdealLoop loop(settings_with(1000));
    BodyStated fast = hovering();
    fast.velocity.x() = speed;
    const auto reference = [&fast](double time) {
      ReferencePoint point = hover(time);
      point.position += time * fast.velocity;
      point.velocity = fast.velocity;
      return point;
    };
    (void)loop.nmpc.prepare(0.0, reference, in_the_air({}));
    EXPECT_EQ(loop.nmpc.feedback(0.0, fast).status,
              speed < 500.0 ? NmpcStatus::solved : NmpcStatus::no_plan);
  }
}

TEST(RecedingHorizon, SafeWrenchFollowsIfTheSecondPlanIsNotCredibleEither) {
  IdealLoop loop = on_the_way(1000);
  const NmpcResult& result = tick_with(loop, spinning(loop));
  EXPECT_EQ(result.status, NmpcStatus::no_plan);
  EXPECT_EQ(result.report.status, optimal_control::SolveStatus::failed);
  EXPECT_NEAR(result.wrench.force.z(), tilt_ropter_vehicle().body.mass * gravity, 1e-9);
  EXPECT_LT(result.wrench.torque.norm(), 1e-12);
  EXPECT_EQ(tick_with(loop, loop.state.body).status, NmpcStatus::solved);
}

}  // namespace receding_horizon_test
}  // namespace tilt_ropter
