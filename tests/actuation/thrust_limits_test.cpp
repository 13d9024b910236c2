#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/thrust_limits.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "support/random.hpp"
#include "support/vehicles.hpp"

namespace {

using namespace tilt_ropter;
using Limits = detail::ThrustLimits<4, double>;

Vehicle<4> with_range(double lower, double upper) {
  Vehicle<4> v = tilt_ropter_vehicle();
  v.servo.min_angle = lower;
  v.servo.max_angle = upper;
  return v;
}

TEST(ThrustLimits, NearestAngleIsEquivalentInRangeAndTheNearestOfThese) {
  test_support::Random random(1);
  for (const auto& [lower, upper] : {std::pair{-pi, pi}, {-10.0, 9.0}, {-1.0, 2.0}, {0.5, 6.0}}) {
    const Limits limits(with_range(lower, upper));
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

/// Whether one rotor can give (lateral, vertical), written the plain way.
bool reachable(const Vehicle<4>& vehicle, double lateral, double vertical, double slack) {
  if (std::hypot(lateral, vertical) > vehicle.rotor.max_thrust + slack) return false;
  const double angle = std::atan2(lateral, vertical);
  for (int turn = -2; turn <= 2; ++turn) {
    const double candidate = angle + 2.0 * pi * turn;
    if (candidate >= vehicle.servo.min_angle && candidate <= vehicle.servo.max_angle) return true;
  }
  return false;
}

TEST(ThrustLimits, ContainsWhatRotorsAndServosCanGive) {
  test_support::Random random(2);
  const AllocationMatrix<4> allocation(tilt_ropter_vehicle());
  for (const auto& [lower, upper] :
       {std::pair{-pi, pi}, {-0.5 * pi, 0.5 * pi}, {-2.0, 2.2}, {0.5, 1.5}, {2.5, 4.0}}) {
    const Vehicle<4> vehicle = with_range(lower, upper);
    const Limits limits(vehicle);
    const Limits::Directions none = Limits::Directions::Zero();
    for (int i = 0; i < 20000; ++i) {
      Limits::Point x = Limits::Point::Zero();
      // The rotors not under test point to the middle of the range.
      for (int k = 0; k < 4; ++k) x.segment<2>(2 * k) = Limits::direction(0.5 * (lower + upper));
      const int rotor = i % 4;
      x(2 * rotor) = random.uniform(-13.0, 13.0);
      x(2 * rotor + 1) = random.uniform(-13.0, 13.0);
      EXPECT_EQ(limits.contains(x, {none, nullptr, 0.0}),
                reachable(vehicle, x(2 * rotor), x(2 * rotor + 1), 0.0));
    }
  }
}

TEST(ThrustLimits, ApproachFindsAPointWheneverAGridDoes) {
  test_support::Random random(3);
  const AllocationMatrix<4> allocation(tilt_ropter_vehicle());
  Limits::Directions directions = Limits::Directions::Zero();
  directions.topLeftCorner<8, 2>() = allocation.null_space;
  int reached = 0;
  for (const auto& [lower, upper] : {std::pair{-pi, pi}, {-0.5 * pi, 0.5 * pi}}) {
    const Vehicle<4> vehicle = with_range(lower, upper);
    const Limits limits(vehicle);
    for (int i = 0; i < 150; ++i) {
      Limits::Point base = Limits::Point::Zero(), x, excess;
      for (int k = 0; k < 4; ++k)
        base.segment<2>(2 * k) << random.uniform(-9.0, 9.0), random.uniform(-4.0, 14.0);
      base.head<8>() -=
          allocation.null_space * (allocation.null_space.transpose() * base.head<8>());
      Limits::Coordinates y = Limits::Coordinates::Zero();
      const bool inside = limits.approach(base, {directions, nullptr, 0.0}, y, x, excess);
      EXPECT_LT((x - base - directions * y).norm(), 1e-12);
      bool grid_inside = false;
      for (double u = -20.0; u <= 20.0 && !grid_inside; u += 0.25) {
        for (double v = -20.0; v <= 20.0 && !grid_inside; v += 0.25) {
          const Limits::Point point = base + directions.leftCols<2>() * Eigen::Vector2d(u, v);
          grid_inside = true;
          for (int k = 0; k < 4; ++k)
            grid_inside = grid_inside && reachable(vehicle, point(2 * k), point(2 * k + 1), 0.0);
        }
      }
      EXPECT_TRUE(inside || !grid_inside);
      if (inside) {
        ++reached;
        EXPECT_LT(excess.norm(), 1e-12);
      }
    }
  }
  EXPECT_GT(reached, 50);
  EXPECT_LT(reached, 250);
}

}  // namespace
