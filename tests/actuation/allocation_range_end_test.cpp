#include <tilt_ropter/actuation/allocation.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

#include "support/allocation_paths.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

namespace allocation_range_end_test {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::Random;
using test_support::with_tilt_range;
using Status = AllocationStatus;

Wrenchd push(double x, double y, double z) {
  return {Vector3d(x, y, z), Vector3d::Zero()};
}

TEST(AllocationRangeEnd, SmallAlternatingPushesTurnNoArmOver) {
  // The front and the back arm are at +-pi. Half of 0.05 N turns an arm of 2 N by 0.0125 rad.
  const Allocation allocation(tilt_ropter_vehicle());
  ActuatorState<4> last;
  for (int i = 0; i < 100; ++i) {
    const Wrenchd wanted = push(0.0, i % 2 == 0 ? 0.05 : -0.05, -8.0);
    const auto result = allocation.allocate(wanted, last);
    EXPECT_EQ(result.turned_over, 0);
    if (i > 0) {
      EXPECT_LT((result.command.tilt_angle - last.tilt_angle).cwiseAbs().maxCoeff(), 0.02);
      EXPECT_EQ(result.status, i % 2 == 0 ? Status::ok : Status::range_end_held);
      // The reported wrench is the wrench of speeds and angles; `lost` is the missing wrench.
      const Wrenchd given = allocation.wrench(result.command);
      EXPECT_LT((given.force + result.lost.force - wanted.force).norm(), 1e-12);
      EXPECT_NEAR(result.lost.force.norm(), i % 2 == 0 ? 0.0 : 0.05, 1e-3);
    }
    last = result.command;
  }
}

TEST(AllocationRangeEnd, PushesBeyondTheMarginTurnArmsOverOnce) {
  const Allocation allocation(tilt_ropter_vehicle());
  ActuatorState<4> last;
  int turned_over = 0;
  for (int i = 0; i < 100; ++i) {
    const auto result = allocation.allocate(push(0.0, i % 2 == 0 ? 1.5 : -1.5, -8.0), last);
    EXPECT_TRUE(gives_wrench(result.status));
    EXPECT_LT(result.lost.force.norm(), 1e-10);
    const auto turn = (result.command.tilt_angle - last.tilt_angle).cwiseAbs().eval();
    EXPECT_EQ((turn.array() > pi + 1e-5).count(), result.turned_over);
    if (result.turned_over > 0) {
      EXPECT_EQ(result.status, Status::turned_over);
      // From then on the arms are at angles where the null space serves pushes to both sides.
      EXPECT_LT(i, 3);
    }
    turned_over += result.turned_over;
    last = result.command;
  }
  EXPECT_GE(turned_over, 1);
  EXPECT_LE(turned_over, 2);
}

TEST(AllocationRangeEnd, ArmsWaitBelowTheMargin) {
  ActuatorState<4> last;
  last.tilt_angle << pi, pi, -3.1, 3.1;
  constexpr double margin = AllocationSettings::range_end_margin;
  const Allocation allocation(tilt_ropter_vehicle());
  // The 2 N of the front arm would point `beyond` [rad] past the end of the range.
  for (const double beyond : {0.04, 0.06, 0.2, 0.4}) {
    const auto result = allocation.allocate(push(0.0, -4.0 * std::tan(beyond), -8.0), last);
    EXPECT_EQ(result.status == Status::range_end_held, beyond < margin) << beyond;
    EXPECT_EQ(result.turned_over > 0, beyond >= margin);
    if (beyond < margin) {
      EXPECT_NEAR(result.lost.force.norm(), 4.0 * std::tan(beyond), 0.01);
    }
  }
}

TEST(AllocationRangeEnd, UsesMinimumNormThrustsFarFromTheEnd) {
  // With the last angles within a quarter turn of the middle, the minimum-norm thrusts are used.
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  Random random(31);
  for (int i = 0; i < 20000; ++i) {
    const Wrenchd wanted{random.vector(6.0), random.vector(0.3)};
    ActuatorState<4> last;
    for (int k = 0; k < 4; ++k) last.tilt_angle(k) = random.uniform(-1.5, 1.5);
    const auto result = allocation.allocate(wanted, last);
    ASSERT_TRUE(result.status == Status::ok || result.status == Status::turned_over);
    ASSERT_LT(result.lost.force.norm() + result.lost.torque.norm(), 1e-10);
    Eigen::Matrix<double, 6, 1> packed;
    packed << wanted.force, wanted.torque;
    ASSERT_LT(
        (test_support::thrusts_of(vehicle, result.command) - allocation.pseudoinverse() * packed)
            .norm(),
        1e-10);
  }
}

struct Walk {
  int jumps = 0;      ///< changes of an angle by more than half a turn in a tick
  int reported = 0;   ///< jumps reported in turned_over
  double lost = 0.0;  ///< largest loss of force with a status that reports no loss [N]
};

/// Random walk of the wrench through zero thrust. Each component changes by up to `step` [N] per
/// tick.
Walk walk(const Vehicle<4>& vehicle, double step, bool timed) {
  const Allocation allocation(vehicle);
  Random random(32);
  Wrenchd wanted;
  AllocationResult<4> last;
  Walk walk;
  const auto bounded = [](Vector3d& v, double limit) {
    v = v.cwiseMax(-limit).cwiseMin(limit).eval();
  };
  const int ticks = test_support::quick_or_full(40000, 200000);
  for (int i = 0; i < ticks; ++i) {
    wanted.force += random.vector(step);
    wanted.torque += random.vector(0.02 * step);
    bounded(wanted.force, 4.0);
    bounded(wanted.torque, 0.2);
    const auto result = timed ? allocation.allocate(0.01 * i, wanted, {}, last)
                              : allocation.allocate(wanted, last.command);
    const auto turn = (result.command.tilt_angle - last.command.tilt_angle).cwiseAbs().eval();
    walk.jumps += static_cast<int>((turn.array() > pi + 1e-5).count());
    walk.reported += result.turned_over;
    if (gives_wrench(result.status)) walk.lost = std::max(walk.lost, result.lost.force.norm());
    last = result;
  }
  return walk;
}

TEST(AllocationRangeEnd, RandomWalksThroughZeroThrustRarelyTurnArmsOver) {
  const double ticks = test_support::quick_or_full(40000, 200000);
  for (const bool timed : {false, true}) {
    const Walk through = walk(tilt_ropter_vehicle(), 0.05, timed);
    test_support::check_at_most(26, "allocation: whole turns per 200 000 ticks of a random walk",
                                through.jumps * 200000.0 / ticks, 50.0);
    EXPECT_EQ(through.jumps, through.reported);
    EXPECT_LT(through.lost, 1e-10);
  }
  for (const auto& [lower, upper] : {std::pair{-3.1, 3.1}, {-3.5, 3.5}, {-3.0, 3.3}}) {
    const Walk through = walk(with_tilt_range(lower, upper), 0.05, true);
    EXPECT_LT(through.jumps * 200000.0 / ticks, 100.0) << lower << ' ' << upper;
    EXPECT_EQ(through.jumps, through.reported);
  }
}

}  // namespace allocation_range_end_test
