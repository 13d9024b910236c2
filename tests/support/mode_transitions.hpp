#pragma once

#include "check_table.hpp"
#include "control_loop.hpp"
#include "full_run.hpp"
#include "random.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <string>

namespace test_support {

/// Landings and take-offs with small errors. At landing, the vehicle starts 3 to 5 cm too high and
/// drifts sideways. At take-off, the reference starts too high and drifts too. Each one must change
/// the contact mode once and not bounce. Runs `few` cases, or 200 in a full run.
template <typename PlantType>
void land_and_take_off(const std::string& plant, int few) {
  using namespace tilt_ropter;
  Random random(14);
  const int cases = quick_or_full(few, 200);
  double worst_bounce = 0.0, worst_force = 0.0;
  for (int i = 0; i < cases; ++i) {
    SCOPED_TRACE(i);
    const double yaw = random.uniform(-pi, pi), drift = random.uniform(-pi, pi);
    const Eigen::Vector3d way(std::cos(drift), std::sin(drift), 0.0);
    const double error = random.uniform(0.03, 0.05), speed = random.uniform(0.0, 1.0);
    ControlLoop<PlantType> loop(static_cast<unsigned>(i));

    // Landing: the reference rests on the ground, the vehicle starts too high and drifts.
    loop.start(error, speed * way, yaw);
    const double radius = tilt_ropter_vehicle().wheels->radius;
    const auto rest = [&](double) {
      ReferencePoint point;
      point.position << 0.0, 0.0, radius;
      point.orientation = quaternion_from_yaw(yaw);
      return point;
    };
    loop.run(3.0, rest);
    if (testing::Test::HasFatalFailure()) return;
    EXPECT_TRUE(loop.touched());
    EXPECT_TRUE(loop.contact().estimate().on_ground);
    EXPECT_EQ(loop.contact().mode_changes(), 1);
    worst_bounce = std::max(worst_bounce, loop.highest());
    worst_force = std::max(worst_force, loop.peak_force() / loop.weight());

    // Take-off: the reference starts too high and drifts from the start.
    const double begin = loop.plant().time();
    const Eigen::Vector3d from = loop.plant().body().position;
    const Transition climb = take_off({Eigen::Vector3d(0.0, 0.0, radius), yaw}, 1.0);
    const auto up = [&](double time) {
      ReferencePoint point = climb(climb.start_time() + time - begin);
      point.position.head<2>() = (from + speed * std::max(0.0, time - begin) * way).head<2>();
      point.velocity += speed * way;
      point.position.z() += error;
      return point;
    };
    loop.run(4.0, up);
    if (testing::Test::HasFatalFailure()) return;
    EXPECT_FALSE(loop.contact().estimate().on_ground);
    EXPECT_EQ(loop.contact().mode_changes(), 2);
    EXPECT_LT(loop.peak_force(), 4.0 * loop.weight());
    EXPECT_LT((loop.plant().body().position - up(begin + 4.0).position).norm(), 0.05);
  }
  check_at_most(14, plant + ": highest bounce [m]", worst_bounce, 0.05);
  check_at_most(14, plant + ": contact force / weight", worst_force, 4.0);
}

}  // namespace test_support
