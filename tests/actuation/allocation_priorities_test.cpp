#include <tilt_ropter/actuation/allocation.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

#include "support/random.hpp"
#include "support/vehicles.hpp"

namespace allocation_priorities_test {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::Random;
using test_support::with_tilt_range;
using Status = AllocationStatus;

/// Returns the fraction of each group that a result keeps, in the order of WrenchGroup. The
/// fraction of a group that is not wanted is NaN.
std::array<double, 4> fractions(const Wrenchd& wanted, const Wrenchd& given) {
  const auto of = [](const auto& a, const auto& b) { return b.dot(a) / a.squaredNorm(); };
  return {of(wanted.torque.head<2>(), given.torque.head<2>()), given.force.z() / wanted.force.z(),
          of(wanted.force.head<2>(), given.force.head<2>()), given.torque.z() / wanted.torque.z()};
}

TEST(AllocationPriorities, KeepLiftIfSidewaysForceIsUnreachable) {
  const Allocation allocation(tilt_ropter_vehicle());
  const auto result = allocation.allocate({Vector3d(0.0, 30.0, 14.7), Vector3d::Zero()}, {});
  EXPECT_EQ(result.status, Status::limited);
  EXPECT_NEAR(result.achieved.force.z(), 14.7, 1e-9);
  EXPECT_LT(result.achieved.torque.norm(), 1e-9);
  // The front and the back arm push sideways with the thrust that the torque balance leaves: 24 N
  // without reaction torque.
  EXPECT_GT(result.achieved.force.y(), 23.8);
  EXPECT_LT(result.achieved.force.y(), 24.0);
}

TEST(AllocationPriorities, KeepLiftIfYawTorqueIsUnreachable) {
  const Allocation allocation(tilt_ropter_vehicle());
  const auto result = allocation.allocate({Vector3d(0.0, 0.0, 14.7), Vector3d(0.0, 0.0, 8.0)}, {});
  EXPECT_EQ(result.status, Status::limited);
  EXPECT_NEAR(result.achieved.force.z(), 14.7, 1e-6);
  EXPECT_LT(result.achieved.torque.head<2>().norm(), 1e-6);
  // All arms tilt alike: T = (lateral, vertical) has a norm of 12 N and vertical = 14.7 / 4 N.
  const double vertical = 14.7 / 4.0, lateral = std::sqrt(144.0 - vertical * vertical);
  EXPECT_NEAR(result.achieved.torque.z(), 4.0 * 0.17 * lateral, 0.3);
  EXPECT_GT(result.achieved.torque.z(), 7.7);
}

TEST(AllocationPriorities, KeepLevelBeforeLift) {
  const Allocation allocation(tilt_ropter_vehicle());
  // The largest total thrust is 48 N.
  const auto result = allocation.allocate({Vector3d(0.0, 0.0, 47.0), Vector3d(0.5, -0.3, 0.0)}, {});
  EXPECT_EQ(result.status, Status::limited);
  EXPECT_NEAR(result.achieved.torque.x(), 0.5, 1e-6);
  EXPECT_NEAR(result.achieved.torque.y(), -0.3, 1e-6);
  EXPECT_GT(result.achieved.force.z(), 42.0);
}

TEST(AllocationPriorities, KeepLightGroundContactIfDrivingForceIsUnreachable) {
  // With a small servo range the forward force of the side arms is limited by their small lift.
  const double half = 0.5;
  const Allocation allocation(with_tilt_range(-half, half));
  for (const double lift : {1.0, 2.0}) {
    const Wrenchd wanted{Vector3d(5.0, 0.0, lift), Vector3d::Zero()};
    const auto result = allocation.allocate(wanted, {});
    EXPECT_EQ(result.status, Status::limited);
    EXPECT_NEAR(result.achieved.force.z(), lift, 1e-6);
    EXPECT_LT(result.achieved.torque.norm(), 1e-6);
    EXPECT_GT(result.achieved.force.x(), 0.4 * lift * std::tan(half));
    EXPECT_LT(result.achieved.force.x(), 1.01 * lift * std::tan(half));
  }
}

TEST(AllocationPriorities, FollowOrderOfSettings) {
  const Wrenchd wanted{Vector3d(20.0, 15.0, 40.0), Vector3d(2.0, 1.5, 4.0)};
  std::array<WrenchGroup, 4> order{WrenchGroup::level, WrenchGroup::lift, WrenchGroup::sideways,
                                   WrenchGroup::yaw};
  std::array<double, 4> best{};
  do {
    AllocationSettings settings;
    settings.priorities = order;
    const Allocation allocation(tilt_ropter_vehicle(), settings);
    const auto kept = fractions(wanted, allocation.allocate(wanted, {}).achieved);
    // Each group alone is reachable, so the first group is kept in full.
    EXPECT_NEAR(kept[static_cast<std::size_t>(order[0])], 1.0, 1e-6);
    for (std::size_t g = 0; g < 4; ++g) {
      EXPECT_GT(kept[g], -1e-6);
      EXPECT_LT(kept[g], 1.0 + 1e-6);
    }
    // The last group is never kept in full.
    EXPECT_LT(kept[static_cast<std::size_t>(order[3])], 0.95);
    best[static_cast<std::size_t>(order[1])] = std::max(best[static_cast<std::size_t>(order[1])],
                                                        kept[static_cast<std::size_t>(order[1])]);
  } while (std::next_permutation(order.begin(), order.end()));
  for (const double fraction : best) EXPECT_GT(fraction, 0.5);
}

// The achieved wrench is reachable. A larger fraction of the first reduced group is not reachable,
// for any fractions of the later groups.
TEST(AllocationPriorities, MaximiseTheFirstReducedGroup) {
  for (const double half : {0.4, 1.0, 0.5 * pi, 2.2, pi}) {
    const Allocation allocation(with_tilt_range(-half, half));
    Random random(41);
    int limited = 0, improvable = 0;
    for (int i = 0; i < 300; ++i) {
      const Wrenchd wanted{random.vector(25.0) + Vector3d(0.0, 0.0, 12.0), random.vector(2.0)};
      const auto result = allocation.allocate(wanted, {});
      if (result.status != Status::limited) continue;
      ++limited;
      const auto kept = fractions(wanted, result.achieved);
      std::size_t first = 0;
      while (first < 4 && kept[first] > 1.0 - 1e-5) ++first;
      ASSERT_LT(first, 4U);
      const auto scaled = [&](const std::array<double, 4>& f) {
        return Wrenchd{wanted.force.cwiseProduct(Vector3d(f[2], f[2], f[1])),
                       wanted.torque.cwiseProduct(Vector3d(f[0], f[0], f[3]))};
      };
      std::array<double, 4> less = kept;
      for (double& f : less) f *= 1.0 - 1e-5;
      const auto again = allocation.allocate(scaled(less), {});
      EXPECT_LT(again.lost.force.norm() + again.lost.torque.norm(), 1e-6);
      for (int trial = 0; trial < 30; ++trial) {
        std::array<double, 4> more = kept;
        more[first] += 0.02;
        for (std::size_t g = first + 1; g < 4; ++g) more[g] = random.uniform(0.0, 1.0);
        if (gives_wrench(allocation.allocate(scaled(more), {}).status)) {
          ++improvable;
          break;
        }
      }
    }
    EXPECT_GT(limited, 30);
    // Only if the set of a rotor's thrusts is not convex may the result be improvable.
    EXPECT_LE(improvable, half > 0.5 * pi && half < pi ? limited / 50 : 0) << half;
  }
}

}  // namespace allocation_priorities_test
