#include <tilt_ropter/planning/figure_eight.hpp>

#include "support/figure_eights.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <stdexcept>

namespace figure_eight_test {

using namespace tilt_ropter;

using test_support::cases;
using test_support::ground_parameters;
using test_support::random_parameters;

constexpr double two_pi = 6.28318530717958647692;

struct Peaks {
  double speed = 0.0, acceleration = 0.0, yaw_rate = 0.0;
};

Peaks peaks_of(const FigureEight& eight, int samples) {
  Peaks peaks;
  for (int i = 0; i <= samples; ++i) {
    const ReferencePoint r = eight(eight.start_time() + eight.duration() * i / samples);
    peaks.speed = std::max(peaks.speed, r.velocity.norm());
    peaks.acceleration = std::max(peaks.acceleration, r.acceleration.norm());
    peaks.yaw_rate = std::max(peaks.yaw_rate, std::abs(r.angular_velocity.z()));
  }
  return peaks;
}

TEST(FigureEight, KeepsAllLimitsAndReachesTheTightest) {
  for (const FigureEightSettings& p : cases()) {
    const FigureEight eight(p);
    const Peaks peaks = peaks_of(eight, 50021);
    const double speed = peaks.speed / p.max_speed;
    const double acceleration = peaks.acceleration / p.max_acceleration;
    const double yaw_rate = peaks.yaw_rate / p.max_yaw_rate;
    EXPECT_LE(speed, 1.0);
    EXPECT_LE(acceleration, 1.0);
    EXPECT_LE(yaw_rate, 1.0);
    EXPECT_GE(std::max({speed, acceleration, yaw_rate}), 0.99)
        << "amplitude " << p.amplitude.transpose() << ", ramp " << p.ramp_laps;
  }
}

TEST(FigureEight, EveryLimitActs) {
  const FigureEightSettings defaults = ground_parameters();
  for (const int limit : {0, 1, 2}) {
    FigureEightSettings p = defaults;
    (limit == 0 ? p.max_speed : limit == 1 ? p.max_acceleration : p.max_yaw_rate) = 0.2;
    const Peaks peaks = peaks_of(FigureEight(p), 5000);
    const double reached = limit == 0   ? peaks.speed
                           : limit == 1 ? peaks.acceleration
                                        : peaks.yaw_rate;
    EXPECT_GT(reached, 0.99 * 0.2);
    EXPECT_GT(FigureEight(p).duration(), FigureEight(defaults).duration());
  }
  // In the fixed mode the body does not rotate, so the limit on the yaw rate must not slow it down.
  FigureEightSettings fixed;
  const double duration = FigureEight(fixed).duration();
  fixed.max_yaw_rate = 1e-3;
  EXPECT_DOUBLE_EQ(FigureEight(fixed).duration(), duration);
}

TEST(FigureEight, DefaultsReachPaperLimitsInAirAndPaperSpeedOnGround) {
  const Peaks air = peaks_of(FigureEight{}, 20000);
  EXPECT_NEAR(air.speed, 1.5, 0.015);
  EXPECT_NEAR(air.acceleration, 1.5, 0.015);
  const Peaks ground = peaks_of(FigureEight(ground_parameters()), 20000);
  EXPECT_NEAR(ground.speed, 1.5, 0.015);
  EXPECT_GT(ground.acceleration, 1.1);
  EXPECT_LT(ground.yaw_rate, 1.5);
}

TEST(FigureEight, MatchesLemniscateOfSettings) {
  FigureEightSettings p;
  p.center << 1.0, -2.0, 3.0;
  p.direction = 0.25 * two_pi;  // the long axis along world y
  p.laps = 1;
  const FigureEight eight(p);
  Eigen::Vector3d low = p.center, high = p.center;
  const int samples = 20000;
  for (int i = 0; i <= samples; ++i) {
    const Eigen::Vector3d position = eight(eight.duration() * i / samples).position;
    low = low.cwiseMin(position);
    high = high.cwiseMax(position);
    // Rotated back to its own axes: y^2 = 4 (b/a)^2 x^2 (1 - (x/a)^2) and z = c x / a.
    const Eigen::Vector3d d = position - p.center;
    const double x = d.y() / p.amplitude.x(), y = -d.x() / p.amplitude.y();
    ASSERT_NEAR(y * y, 4.0 * x * x * (1.0 - x * x), 1e-12);
    ASSERT_NEAR(d.z(), p.amplitude.z() * x, 1e-12);
  }
  const Eigen::Vector3d half_extent(p.amplitude.y(), p.amplitude.x(), p.amplitude.z());
  EXPECT_LT((low - (p.center - half_extent)).norm(), 1e-6);
  EXPECT_LT((high - (p.center + half_extent)).norm(), 1e-6);
}

TEST(FigureEight, PassesTheCrossingTwicePerLap) {
  for (const int laps : {1, 2, 3}) {
    FigureEightSettings p;
    p.laps = laps;
    const FigureEight eight(p);
    int crossings = 0;  // of the plane x = 0, without the ends
    double last = 0.0;
    for (int i = 1; i < 5000; ++i) {
      const double x = eight(eight.duration() * i / 5000).position.x();
      if (x * last < 0.0) ++crossings;
      last = x;
    }
    EXPECT_EQ(crossings, 2 * laps - 1);
  }
}

TEST(FigureEight, RestsAtTheCrossingBeforeStartAndAfterEnd) {
  const double infinity = std::numeric_limits<double>::infinity();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (const FigureEightSettings& p : cases()) {
    FigureEight eight(p);
    eight.set_start_time(-7.3);
    const double start = eight.start_time(), end = eight.end_time();
    EXPECT_DOUBLE_EQ(start, -7.3);
    for (const double time :
         {start, start - 1.0, -infinity, nan, end + 1e-9, end + 1.0, infinity}) {
      const ReferencePoint r = eight(time);
      EXPECT_LT((r.position - p.center).norm(), 1e-12);
      EXPECT_EQ(r.velocity.norm(), 0.0);
      EXPECT_EQ(r.acceleration.norm(), 0.0);
      EXPECT_EQ(r.angular_velocity.norm(), 0.0);
      EXPECT_EQ(r.angular_acceleration.norm(), 0.0);
      EXPECT_NEAR(r.orientation.norm(), 1.0, 1e-12);
      EXPECT_LT(r.orientation.angularDistance(eight(start).orientation), 1e-9);
    }
  }
}

TEST(FigureEight, GroundReferenceRollsAlongBodyXAndStaysLevel) {
  const FigureEight eight(ground_parameters());
  int moving = 0;
  for (double time = 0.0; time < eight.duration(); time += 0.01) {
    const ReferencePoint r = eight(time);
    const Eigen::Vector3d body_velocity = r.orientation.conjugate() * r.velocity;
    ASSERT_LT(std::abs(body_velocity.y()), 1e-9);
    ASSERT_LT(std::abs(body_velocity.z()), 1e-9);
    ASSERT_GE(body_velocity.x(), 0.0);
    if (body_velocity.x() > 0.1) ++moving;
    ASSERT_DOUBLE_EQ(r.position.z(), 0.11);
    ASSERT_LT((r.orientation * Eigen::Vector3d::UnitZ() - Eigen::Vector3d::UnitZ()).norm(), 1e-12);
    // Lateral acceleration of a wheeled vehicle: speed times yaw rate.
    const Eigen::Vector3d body_acceleration = r.orientation.conjugate() * r.acceleration;
    ASSERT_NEAR(body_acceleration.y(), body_velocity.x() * r.angular_velocity.z(), 1e-9);
  }
  EXPECT_GT(moving, 1500);
}

TEST(FigureEight, SetStartTimeShiftsTheWholeReference) {
  FigureEight eight(ground_parameters());
  const ReferencePoint before = eight(5.0);
  eight.set_start_time(3.0);
  EXPECT_LT((eight(8.0).position - before.position).norm(), 1e-12);
  EXPECT_LT((eight(8.0).velocity - before.velocity).norm(), 1e-12);
  EXPECT_DOUBLE_EQ(eight.end_time(), 3.0 + eight.duration());
  EXPECT_DOUBLE_EQ(eight.start_time(), 3.0);
  EXPECT_THROW(eight.set_start_time(std::numeric_limits<double>::quiet_NaN()),
               std::invalid_argument);
}

// Without a ramp the motion passes the crossing with the constant rate. In between it is the same
// motion, only earlier.
TEST(FigureEight, StartsAndEndsMoving) {
  for (const HeadingMode heading : {HeadingMode::fixed, HeadingMode::along_velocity}) {
    FigureEightSettings p;
    p.heading = heading;
    const FigureEight with_ramps(p);
    const double ramp = 2.0 * p.ramp_laps * with_ramps.duration() / (p.laps + 2.0 * p.ramp_laps);
    for (const bool starts : {false, true})
      for (const bool ends : {false, true}) {
        p.starts_moving = starts;
        p.ends_moving = ends;
        const FigureEight eight(p);
        EXPECT_NEAR(eight.duration(), with_ramps.duration() - 0.5 * ramp * (starts + ends), 1e-3);
        const ReferencePoint first = eight(0.0), last = eight(eight.end_time());
        EXPECT_LT((first.position - p.center).norm() + (last.position - p.center).norm(), 1e-12);
        EXPECT_EQ(first.velocity.norm() > 1.0, starts);
        EXPECT_EQ(last.velocity.norm() > 1.0, ends);
        EXPECT_LT(first.acceleration.norm() + last.acceleration.norm(), 1e-12);
        EXPECT_LT((eight(-1.0).velocity - first.velocity).norm(), 1e-12);
        EXPECT_LT((eight(1e9).velocity - last.velocity).norm(), 1e-12);
        const Peaks peaks = peaks_of(eight, 20000);
        EXPECT_LE(peaks.speed, 1.0001 * p.max_speed);
        EXPECT_LE(peaks.acceleration, 1.0001 * p.max_acceleration);
        if (heading == HeadingMode::along_velocity) {
          EXPECT_LE(peaks.yaw_rate, 1.0001 * p.max_yaw_rate);
        }
        const double h = 1e-6;
        for (double x = 0.01; x < 1.0; x += 0.07) {
          const double t = x * eight.duration();
          EXPECT_LT(
              (eight(t).velocity - (eight(t + h).position - eight(t - h).position) / (2.0 * h))
                  .norm(),
              1e-7);
        }
        if (!starts) continue;
        const double later = 0.5 * ramp;  // the ramp covers half of the distance
        EXPECT_LT((eight(3.0).position - with_ramps(3.0 + later).position).norm(), 2e-3);
      }
  }
}

}  // namespace figure_eight_test
