#include <tilt_ropter/actuation/detail/thrust_limits.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>

#include "support/random.hpp"
#include "support/vehicles.hpp"

namespace thrust_limits_test {

using namespace tilt_ropter;
using Limits = detail::ThrustLimits<4, double>;

TEST(ThrustLimits, NearestAngleIsNearestEquivalentInRange) {
  test_support::Random random(1);
  for (const auto& [lower, upper] : {std::pair{-pi, pi}, {-10.0, 9.0}, {-1.0, 2.0}, {0.5, 6.0}}) {
    const Limits limits(test_support::with_tilt_range(lower, upper));
    for (int i = 0; i < 20000; ++i) {
      const double angle = random.uniform(-pi, pi), last = random.uniform(lower, upper);
      const double nearest = limits.nearest_angle(angle, last);
      EXPECT_GE(nearest, lower);
      EXPECT_LE(nearest, upper);
      double best = 1e9, to_end = 1e9;
      for (int turn = -4; turn <= 4; ++turn) {
        const double candidate = angle + 2.0 * pi * turn;
        if (candidate >= lower && candidate <= upper)
          best = std::min(best, std::abs(candidate - last));
        to_end = std::min({to_end, std::abs(candidate - lower), std::abs(candidate - upper)});
      }
      if (best < 1e9) {
        EXPECT_NEAR(std::remainder(nearest - angle, 2.0 * pi), 0.0, 1e-14);
        EXPECT_NEAR(std::abs(nearest - last), best, 1e-12);
      } else {
        EXPECT_NEAR(std::abs(std::remainder(nearest - angle, 2.0 * pi)), to_end, 1e-12);
      }
    }
  }
}

/// Returns true if one rotor can give the thrust (lateral, vertical), computed by brute force.
bool reachable(const Vehicle<4>& vehicle, double lateral, double vertical, double slack) {
  if (std::hypot(lateral, vertical) > vehicle.rotor.max_thrust + slack) return false;
  const double angle = std::atan2(lateral, vertical);
  for (int turn = -2; turn <= 2; ++turn) {
    const double candidate = angle + 2.0 * pi * turn;
    if (candidate >= vehicle.servo.min_angle && candidate <= vehicle.servo.max_angle) return true;
  }
  return false;
}

TEST(ThrustLimits, ContainsExactlyTheReachableThrusts) {
  test_support::Random random(2);
  for (const auto& [lower, upper] :
       {std::pair{-pi, pi}, {-0.5 * pi, 0.5 * pi}, {-2.0, 2.2}, {0.5, 1.5}, {2.5, 4.0}}) {
    const Vehicle<4> vehicle = test_support::with_tilt_range(lower, upper);
    const Limits limits(vehicle);
    for (int i = 0; i < 20000; ++i) {
      const Eigen::Vector2d thrust(random.uniform(-13.0, 13.0), random.uniform(-13.0, 13.0));
      EXPECT_EQ(limits.contains(i % 4, thrust), reachable(vehicle, thrust.x(), thrust.y(), 0.0));
    }
  }
}

/// Returns true if thrust `t`, in units of max_thrust, is inside the region by at least `margin`.
bool inside(const detail::ThrustRegion& region, const Eigen::Vector2d& t, double margin) {
  bool in = region.radius <= 0.0 || t.norm() <= region.radius - margin;
  for (std::size_t p = 0; p < static_cast<std::size_t>(region.half_planes); ++p)
    in = in && region.normal[p].dot(t) >= region.offset[p] + margin;
  return in;
}

TEST(ThrustLimits, PartsLieInTheSetAndCoverRangesUpToAWholeTurn) {
  test_support::Random random(4);
  for (const auto& [lower, upper] : {std::pair{-pi, pi},
                                     {-0.5 * pi, 0.5 * pi},
                                     {-2.0, 2.2},
                                     {0.5, 1.5},
                                     {2.5, 7.0},
                                     {-4.0, 4.0},
                                     {-0.2, 0.2}}) {
    const Vehicle<4> vehicle = test_support::with_tilt_range(lower, upper);
    const Limits limits(vehicle);
    const auto region = [&](detail::AnglePart part) {
      return limits.region(0, part, false, 0.0, 0.0);
    };
    const auto whole = region(detail::AnglePart::whole);
    const auto low = region(detail::AnglePart::lower), high = region(detail::AnglePart::upper);
    for (const auto& each : {whole, low, high}) EXPECT_TRUE(inside(each, each.center, 0.04));
    for (int i = 0; i < 20000; ++i) {
      const Eigen::Vector2d t(random.uniform(-1.1, 1.1), random.uniform(-1.1, 1.1));
      const bool can = reachable(vehicle, 12.0 * t.x(), 12.0 * t.y(), 0.0);
      const bool in_part = inside(low, t, 0.0) || inside(high, t, 0.0);
      EXPECT_TRUE(can || !in_part);
      EXPECT_TRUE(in_part || !can || upper - lower > 2.0 * pi);
      EXPECT_TRUE(inside(whole, t, 0.0) || !can);
      if (limits.convex()) {
        EXPECT_EQ(inside(whole, t, 0.0), can);
      }
    }
  }
}

TEST(ThrustLimits, FloorKeepsMinThrustAndReachability) {
  test_support::Random random(5);
  for (const auto& [lower, upper] : {std::pair{-pi, pi}, {-1.0, 0.3}, {-2.0, 2.2}}) {
    for (const double min_thrust : {0.01, 3.0, 11.5}) {
      Vehicle<4> vehicle = test_support::with_tilt_range(lower, upper);
      vehicle.rotor.min_thrust = min_thrust;
      const Limits limits(vehicle);
      for (int i = 0; i < 2000; ++i) {
        const double angle = i % 10 == 0 ? lower : random.uniform(lower, upper);
        const auto region = limits.region(0, limits.nearest_part(angle), true, angle, 0.0);
        EXPECT_TRUE(inside(region, region.center, 1e-7)) << angle << ' ' << min_thrust;
        const Eigen::Vector2d t(random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0));
        if (inside(region, t, 0.0)) {
          EXPECT_GE(12.0 * t.norm(), min_thrust - 1e-12);
          EXPECT_TRUE(reachable(vehicle, 12.0 * t.x(), 12.0 * t.y(), 1e-9));
        }
      }
    }
  }
}

}  // namespace thrust_limits_test
