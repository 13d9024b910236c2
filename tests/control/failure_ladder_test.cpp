// Every step of the failure handling that Nmpc documents, on the plant: the controller's output,
// how long this output lasts, and how the vehicle recovers (check 5).

#include "support/check_table.hpp"
#include "support/control_loop.hpp"
#include "support/hovering.hpp"

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <limits>
#include <optional>
#include <string>

namespace tilt_ropter {
namespace failure_ladder_test {

using Loop = test_support::ControlLoop<Plant<4>>;
using test_support::check_at_most;
using test_support::expect_within_bounds;
using test_support::hover;
using Measured = std::optional<BodyStated>;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

ReferencePoint lost(double time) {
  ReferencePoint point = hover(time);
  point.position.y() = nan;
  return point;
}

void untouched(Wrenchd&, Measured&) {}
void blind(Wrenchd&, Measured& measured) {
  measured->velocity.x() = nan;
}
void nothing(Wrenchd&, Measured& measured) {
  measured.reset();
}
void no_observer(Wrenchd& external, Measured&) {
  external.torque.y() = nan;
}

double distance(const Loop& loop) {
  return (loop.plant().body().position - hover(0.0).position).norm();
}

// A settled hover against an external force and torque that the observer must estimate.
Loop settled() {
  Loop loop(1);
  loop.disturbance.force << 0.5, -0.3, -1.5;
  loop.disturbance.torque << 0.03, -0.1, 0.02;
  loop.start(1.39, Eigen::Vector3d::Zero(), 0.3);
  loop.run(3.0, hover);
  EXPECT_LT(distance(loop), 0.02);
  return loop;
}

struct Outcome {
  int continued = 0, safe = 0;  // number of ticks with the last plan and with the safe wrench
  double error = 0.0;           // position error at the end of the failure [m]
  double worst = 0.0;           // largest position error in the second after the failure [m]
  double after = 0.0;           // position error one second after the failure [m]
};

template <typename Reference, typename Tamper>
Outcome fail_for(int ticks, const Reference& reference, const Tamper& tamper, NmpcStatus status) {
  Loop loop = settled();
  Outcome outcome;
  for (int i = 0; i < ticks; ++i) {
    const NmpcResult& result = loop.tick(reference, tamper);
    expect_within_bounds(result, loop.nmpc().settings().problem.bounds);
    if (result.status == status)
      ++outcome.continued;
    else if (result.status == NmpcStatus::no_plan)
      ++outcome.safe;
  }
  outcome.error = distance(loop);
  for (int i = 0; i < 100; ++i) {
    EXPECT_TRUE(has_plan(loop.tick(hover).status));  // from the first good tick on
    outcome.worst = std::max(outcome.worst, distance(loop));
  }
  outcome.after = distance(loop);
  return outcome;
}

// Expects the last plan for max_plan_age (20 ticks), then the safe wrench.
template <typename Reference, typename Tamper>
void goes_down_the_ladder(const Reference& reference, const Tamper& tamper, NmpcStatus status) {
  for (const int ticks : {1, 5, 50}) {
    SCOPED_TRACE(ticks);
    const Outcome outcome = fail_for(ticks, reference, tamper, status);
    if (ticks <= 5) {
      EXPECT_EQ(outcome.continued, ticks);
    } else {
      EXPECT_NEAR(outcome.continued, 20, 1);  // rounding of the plan's age, 0.2 s
    }
    EXPECT_EQ(outcome.continued + outcome.safe, ticks);
    EXPECT_LT(outcome.worst, ticks <= 5 ? 0.03 : 0.3);
    const std::string what = "after " + std::to_string(ticks) + " failed ticks [m]";
    check_at_most(5, "error " + what, outcome.error, ticks <= 5 ? 0.03 : 0.2);
    check_at_most(5, "error a second " + what, outcome.after, 0.05);
  }
}

TEST(FailureLadder, BadMeasurement) {
  goes_down_the_ladder(hover, blind, NmpcStatus::bad_state);
}

TEST(FailureLadder, StaleEstimate) {
  goes_down_the_ladder(hover, nothing, NmpcStatus::bad_state);
}

TEST(FailureLadder, FailedSolve) {
  goes_down_the_ladder(lost, untouched, NmpcStatus::solver_failed);
}

TEST(FailureLadder, LostObserver) {
  Loop loop = settled();
  double worst = 0.0;
  for (int i = 0; i < 300; ++i) {
    ASSERT_EQ(loop.tick(hover, no_observer).status, NmpcStatus::solved);
    worst = std::max(worst, distance(loop));
  }
  EXPECT_LT(worst, 0.03);  // the disturbance has not changed
}

TEST(FailureLadder, FliesWhenFeedbackExceedsItsTimeLimit) {
  NmpcSettings settings;
  settings.solver.max_feedback_time = 1e-9;
  settings.problem.bounds.force_max.z() = 15.5;  // weight 14.7: active during the whole climb
  Loop loop(1, settings);
  loop.start(0.89, Eigen::Vector3d::Zero(), 0.0);
  int late = 0;
  for (int i = 0; i < 50; ++i) {
    const NmpcResult& result = loop.tick(hover);
    expect_within_bounds(result, settings.problem.bounds);
    if (result.status == NmpcStatus::solved) continue;  // no active set to find
    ++late;
    EXPECT_EQ(result.status, NmpcStatus::approximate);
    EXPECT_EQ(result.report.status, optimal_control::SolveStatus::time_limit);
  }
  EXPECT_GT(late, 5);
  loop.run(3.0, hover);  // one pass per tick is enough
  EXPECT_LT(distance(loop), 0.05);
}

TEST(FailureLadder, RelaxesBoundsThatContradictTheState) {
  Loop loop(1);
  BodyStated body;
  loop.start(1.39, Eigen::Vector3d::Zero(), 0.0);
  int relaxed = 0;
  for (int i = 0; i < 50; ++i) {
    // The yaw rate is six times the bound: no plan can satisfy the bound.
    const NmpcResult& result = loop.tick(hover, [&](Wrenchd&, Measured& measured) {
      measured->angular_velocity.z() =
          6.0 * loop.nmpc().settings().problem.bounds.angular_velocity.z();
    });
    ASSERT_TRUE(has_plan(result.status));
    expect_within_bounds(result, loop.nmpc().settings().problem.bounds);
    relaxed += result.report.relaxed_constraints > 0;
  }
  EXPECT_GT(relaxed, 0);
}

TEST(FailureLadder, CommandsSafeWrenchUntilFirstGoodMeasurement) {
  Loop loop(1);
  loop.start(1.39, Eigen::Vector3d::Zero(), 0.0);
  for (int i = 0; i < 10; ++i) {
    const NmpcResult& result = loop.tick(hover, nothing);
    EXPECT_EQ(result.status, NmpcStatus::no_plan);
    expect_within_bounds(result, loop.nmpc().settings().problem.bounds);
  }
  for (int i = 0; i < 200; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  EXPECT_LT(distance(loop), 0.05);
}

}  // namespace failure_ladder_test
}  // namespace tilt_ropter
