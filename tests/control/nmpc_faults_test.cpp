// Bad measurements, references and estimates, and interruptions: what the command is and how the
// controller recovers.

#include <tilt_ropter/control/nmpc.hpp>

#include "support/hovering.hpp"
#include "support/ideal_loop.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace nmpc_faults_test {

using test_support::expect_within_bounds;
using test_support::hover;
using test_support::hovering;
using test_support::IdealLoop;
using test_support::in_simulated_time;

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const RigidBodyParameters body = vehicle.body;

TEST(Nmpc, BadMeasurementContinuesLastPlanWithinBounds) {
  IdealLoop loop;
  loop.state.body.position.x() = 0.5;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  const Wrenchd before = loop.state.wrench;
  for (int i = 0; i < 10; ++i) {
    const NmpcResult& result = loop.tick(hover, {}, true);
    EXPECT_EQ(result.status, NmpcStatus::bad_state);
    expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
  }
  EXPECT_GT((loop.state.wrench.force - before.force).norm(), 1e-6);  // the plan continued
  for (int i = 0; i < 300; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 5e-3);
}

TEST(Nmpc, TooOldPlanIsReplacedBySafeWrench) {
  IdealLoop loop;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  NmpcStatus status = NmpcStatus::solved;
  for (int i = 0; i < 30; ++i) status = loop.tick(hover, {}, true).status;
  EXPECT_EQ(status, NmpcStatus::no_plan);
  EXPECT_NEAR(loop.state.wrench.force.z(), body.mass * gravity, 0.1);
  for (int i = 0; i < 300; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
}

TEST(Nmpc, BadReferenceOrEstimateGivesFiniteCommandAndRecovers) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  IdealLoop loop;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  const auto lost = [&](double t) {
    ReferencePoint point = hover(t);
    point.position.y() = nan;
    return point;
  };
  for (int i = 0; i < 5; ++i) {
    const NmpcResult& result = loop.tick(lost);
    EXPECT_EQ(result.status, NmpcStatus::solver_failed);
    expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
  }
  EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  // An estimate that is not finite is not used.
  EXPECT_EQ(loop.tick(hover, {Eigen::Vector3d(nan, 0, 0), Eigen::Vector3d::Zero()}).status,
            NmpcStatus::solved);
}

// A trajectory that ends, or is known only so far: the plan follows what there is.
TEST(Nmpc, ReferenceThatIsNotFiniteFarAheadShortensTheHorizon) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (const bool turn : {false, true}) {
    IdealLoop loop, whole;
    const auto along = [](double t) {
      ReferencePoint point = hover(t);
      point.position.x() += 0.5 * t;
      point.velocity.x() = 0.5;
      return point;
    };
    const auto ends = [&](double t) {
      ReferencePoint point = along(t);
      if (t > 3.0 && turn) point.orientation.coeffs().setZero();
      if (t > 3.0 && !turn) point.position.y() = nan;
      return point;
    };
    double off = 0.0;
    int approximate = 0;
    for (int i = 0; i <= 300; ++i) {  // to 3 s
      const NmpcStatus status = loop.tick(ends).status;
      EXPECT_TRUE(status == NmpcStatus::solved || status == NmpcStatus::approximate) << i;
      approximate += status == NmpcStatus::approximate;
      (void)whole.tick(along);
      off = std::max(off, (loop.state.body.position - whole.state.body.position).norm());
    }
    EXPECT_GT(approximate, 100);
    EXPECT_LT(off, 1e-3);
    for (int i = 0; i < 3; ++i) EXPECT_EQ(loop.tick(ends).status, NmpcStatus::solver_failed);
  }
}

TEST(Nmpc, BadFirstMeasurementGivesSafeWrench) {
  Nmpc nmpc(vehicle, in_simulated_time());
  (void)nmpc.prepare(0.0, hover, {});
  BodyStated bad = hovering();
  bad.orientation.coeffs().setZero();
  const NmpcResult& result = nmpc.feedback(0.0, bad);
  EXPECT_EQ(result.status, NmpcStatus::no_plan);
  expect_within_bounds(result, nmpc.settings().problem.bounds);
}

TEST(Nmpc, SafeWrenchIsLimitedToTheBounds) {
  // A plan may violate a bound if it must, but the command may not. Here there is no plan, and the
  // safe wrench is beyond a bound.
  NmpcSettings settings;
  settings.problem.bounds.force_min.z() = 0.0;
  settings.problem.bounds.force_max.z() = 10.0;  // below the weight: limits the safe wrench
  Nmpc nmpc(vehicle, in_simulated_time(settings));
  BodyStated bad = hovering();
  bad.position.x() = std::nan("");
  (void)nmpc.prepare(0.0, hover, {});
  const NmpcResult cut = nmpc.feedback(0.0, bad);
  EXPECT_EQ(cut.status, NmpcStatus::no_plan);
  EXPECT_DOUBLE_EQ(cut.wrench.force.z(), 10.0);
}

// The vehicle did not follow the old plan during the interruption and is at another place.
TEST(Nmpc, PlanFromBeforeAnInterruptionIsDropped) {
  IdealLoop loop;
  loop.state.body.position.x() -= 3.0;
  for (int i = 0; i < 40; ++i) loop.tick(hover);
  const Wrenchd before = loop.nmpc.feedback(loop.time, loop.state.body).wrench;
  EXPECT_GT(before.force.head<2>().norm() + before.torque.norm(), 0.5);  // in motion
  loop.time += 0.3;
  loop.state.body = hovering();
  const NmpcResult& resumed = loop.tick(hover);
  EXPECT_EQ(resumed.status, NmpcStatus::solved);
  EXPECT_NEAR(resumed.wrench.force.z(), body.mass * gravity, 1e-9);
  EXPECT_LT(resumed.wrench.force.head<2>().norm() + resumed.wrench.torque.norm(), 1e-9);
  for (int i = 0; i < 100; ++i) loop.tick(hover);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 1e-3);
  // After an interruption of half of max_plan_age, the next tick still succeeds.
  loop.time += 0.5 * loop.nmpc.settings().max_plan_age;
  EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
}

TEST(Nmpc, ConsecutiveFailuresDropTheWarmStart) {
  const auto iterate_after_failures = [](int failures_before_reset) {
    NmpcSettings settings;
    settings.failures_before_reset = failures_before_reset;
    settings.max_plan_age = 1.0;
    IdealLoop loop(settings);
    loop.state.body.position.x() = 0.5;
    for (int i = 0; i < 30; ++i) (void)loop.tick(hover);
    for (int i = 0; i < 3; ++i) (void)loop.tick(hover, {}, true);
    (void)loop.tick(hover);
    return loop.nmpc.solver().report().kkt;  // of the iterate at the start of the tick
  };
  // A cold start has all nodes at the measured state. This is far from optimal.
  EXPECT_GT(iterate_after_failures(3), 10.0 * iterate_after_failures(4));
}

}  // namespace nmpc_faults_test
}  // namespace tilt_ropter
