// What IMU and poses say in short windows of a log, for motions in closed form.

#include <tilt_ropter/identification/detail/window_model.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <functional>
#include <vector>

namespace tilt_ropter::detail {
namespace flight_windows_test {

using Eigen::Vector3d;
using test_support::Random;
using Motion = std::function<Vector3d(double)>;

constexpr double duration = 3.0;
const Eigen::Quaterniond leaning = quaternion_exp(Vector3d(0.3, -0.2, 0.5));

Vector3d at_rest(double /*time*/) {
  return {0.0, 0.0, 1.0};
}

// A flight along `position` with a constant attitude. The stamps are uneven by `jitter`, a fraction
// of the time between two of them.
VehicleLog<4> fly(const Motion& position, double pose_rate = 100.0, double jitter = 0.3) {
  Random random(1);
  VehicleLog<4> log;
  const auto fill = [&](auto& list, double rate, const auto& value) {
    for (int i = 0; i < duration * rate; ++i) {
      const double time = (i + random.uniform(-jitter, jitter)) / rate;
      list.push_back({time, value(time)});
    }
  };
  fill(log.imu, 400.0, [](double) {
    return InertialSampled{Vector3d::Zero(), leaning.conjugate() * Vector3d(0.0, 0.0, gravity)};
  });
  fill(log.poses, pose_rate, [&](double time) { return MarkerPosed{position(time), leaning}; });
  log.commands.push_back({-1.0, {}});
  log.commands.push_back({duration, {}});
  return log;
}

std::vector<FlightWindow> windows_of(const VehicleLog<4>& log, double min_height = 0.0) {
  return FlightWindows<4>(log, 0.1, min_height, Vector3d::Zero()).windows();
}

bool any_between(const std::vector<FlightWindow>& windows, double from, double to) {
  for (const FlightWindow& w : windows)
    if (w.time > from && w.time < to) return true;
  return false;
}

TEST(FlightWindows, VelocityIsExactForConstantVelocityAndUnevenStamps) {
  const Vector3d velocity(1.5, -0.7, 0.4);
  for (const double rate : {100.0, 360.0}) {
    const auto windows = windows_of(
        fly([&](double time) -> Vector3d { return at_rest(time) + time * velocity; }, rate));
    ASSERT_GT(windows.size(), 100U);
    for (const FlightWindow& w : windows) {
      EXPECT_LT((w.velocity - leaning.conjugate() * velocity).norm(), 1e-9) << w.time;
      EXPECT_TRUE(w.rotation.isApprox(leaning.toRotationMatrix(), 1e-12));
    }
  }
}

// The slope of the positions within 0.05 s reduces a velocity of 10 rad/s by 2.5 %.
TEST(FlightWindows, VelocityFollowsAFastOscillation) {
  const auto windows = windows_of(fly(
      [](double time) -> Vector3d {
        return at_rest(time) + Vector3d(0.1 * std::sin(10.0 * time), 0.0, 0.0);
      },
      200.0, 0.0));
  ASSERT_GT(windows.size(), 100U);
  for (const FlightWindow& w : windows)
    EXPECT_NEAR((w.rotation * w.velocity).x(), std::cos(10.0 * w.time), 0.05) << w.time;
}

TEST(FlightWindows, SlowPosesGiveVelocitiesFromALongerTime) {
  const auto windows = windows_of(
      fly([](double time) -> Vector3d { return at_rest(time) + Vector3d(0.0, 0.8 * time, 0.0); },
          20.0, 0.1));
  EXPECT_GT(windows.size(), 60U);
  for (const FlightWindow& w : windows)
    EXPECT_NEAR((w.rotation * w.velocity).y(), 0.8, 1e-9) << w.time;
}

TEST(FlightWindows, HasNoWindowInAGapOfThePosesOrTheImu) {
  const VehicleLog<4> log = fly(at_rest);
  const auto cut = [](auto list) {
    auto kept = list;
    kept.clear();
    for (const auto& x : list)
      if (x.time < 1.0 || x.time > 1.3) kept.push_back(x);
    return kept;
  };
  VehicleLog<4> no_poses = log, no_imu = log;
  no_poses.poses = cut(log.poses);
  no_imu.imu = cut(log.imu);
  EXPECT_TRUE(any_between(windows_of(log), 1.0, 1.3));
  EXPECT_FALSE(any_between(windows_of(no_poses), 1.0, 1.3));
  EXPECT_FALSE(any_between(windows_of(no_imu), 0.96, 1.34));
  for (const auto& windows : {windows_of(no_poses), windows_of(no_imu)}) {
    EXPECT_TRUE(any_between(windows, 0.8, 0.95));
    EXPECT_TRUE(any_between(windows, 1.35, 1.5));
  }
}

TEST(FlightWindows, LeavesOutWindowsBelowTheMinimumHeight) {
  const VehicleLog<4> log = fly([](double time) { return Vector3d(0.0, 0.0, 0.5 * time); });
  const auto windows = windows_of(log, 0.75);
  EXPECT_FALSE(any_between(windows, 0.0, 1.49));
  EXPECT_TRUE(any_between(windows, 1.5, 1.6));
}

TEST(FlightWindows, MeanAndSlopeOfALinearSignalAreExact) {
  VehicleLog<4> log = fly(at_rest);
  const Vector3d rate(0.5, -1.0, 2.0), acceleration(3.0, 1.0, -2.0);
  std::vector<double> ramp, constant(log.imu.size(), 4.0);
  for (auto& sample : log.imu) {
    sample.value.angular_velocity = rate + sample.time * acceleration;
    ramp.push_back(7.0 * sample.time);
  }
  const FlightWindows<4> flight(log, 0.1, 0.0, Vector3d::Zero());
  ASSERT_GT(flight.windows().size(), 100U);
  for (const FlightWindow& w : flight.windows()) {
    EXPECT_NEAR(flight.mean(w, constant), 4.0, 1e-12);
    EXPECT_NEAR(flight.slope(w, constant), 0.0, 1e-9);
    EXPECT_NEAR(flight.slope(w, ramp), 7.0, 1e-9);
    EXPECT_LT((w.angular_acceleration - acceleration).norm(), 1e-9);
    // The samples are not symmetric about the middle.
    EXPECT_NEAR(flight.mean(w, ramp), 7.0 * w.time, 7.0 * 5e-4);
    EXPECT_LT((w.angular_velocity - rate - w.time * acceleration).norm(), 4.0 * 5e-4);
  }
}

// An accelerometer bias along the vertical is the only acceleration that the poses do not explain.
TEST(FlightWindows, HeightWindowsShowTheBiasOfTheAccelerometer) {
  const Vector3d imu_position(0.1, 0.05, 0.2);
  const double acceleration = 0.6, bias = 0.25;
  VehicleLog<4> log =
      fly([=](double time) { return Vector3d(0.0, 0.0, 1.0 + 0.5 * acceleration * time * time); });
  for (auto& sample : log.imu)
    sample.value.specific_force =
        leaning.conjugate() * Vector3d(0.0, 0.0, gravity + acceleration + bias);
  const FlightWindows<4> flight(log, 0.1, 0.0, imu_position);
  ASSERT_GT(flight.heights().size(), 10U);
  for (const HeightWindow& h : flight.heights()) {
    EXPECT_NEAR(h.excess, bias, 1e-9);
    EXPECT_LT((h.up - leaning.conjugate() * Vector3d::UnitZ()).norm(), 1e-12);
    EXPECT_LT(h.window, flight.windows().size());
  }
}

}  // namespace flight_windows_test
}  // namespace tilt_ropter::detail
