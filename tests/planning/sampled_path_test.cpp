#include <tilt_ropter/planning/sampled_path.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace tilt_ropter {
namespace sampled_path_test {

// Samples of a smooth path that starts and ends at rest, at uneven times.
constexpr double whole = 6.0;

PathSample truth(double time) {
  const double x = time / whole, s = x * x * x * (10.0 - x * (15.0 - 6.0 * x));
  return {time, {3.0 * s, std::sin(4.0 * s), 1.0 + 0.5 * s * s}, 7.0 * s};
}

std::vector<PathSample> samples(int count) {
  std::vector<PathSample> all;
  for (int i = 0; i <= count; ++i) {
    const double x = static_cast<double>(i) / count;
    PathSample sample = truth(whole * (x + 0.3 * x * (1.0 - x)));
    sample.yaw = yaw_of(quaternion_from_yaw(sample.yaw));  // in (-pi, pi]
    all.push_back(sample);
  }
  return all;
}

TEST(SampledPath, PassesThroughItsSamples) {
  const std::vector<PathSample> all = samples(20);
  const SampledPath path(all);
  EXPECT_EQ(path.start_time(), all.front().time);
  EXPECT_EQ(path.end_time(), all.back().time);
  for (const PathSample& sample : all) {
    const ReferencePoint point = path(sample.time);
    EXPECT_LT((point.position - sample.position).norm(), 1e-12);
    EXPECT_LT(point.orientation.angularDistance(quaternion_from_yaw(sample.yaw)), 1e-7);
  }
  for (const double end : {path.start_time(), path.end_time()}) {
    EXPECT_LT(path(end).velocity.norm(), 1e-12);
    EXPECT_LT(path(end).angular_velocity.norm(), 1e-12);
  }
}

// A cubic spline converges with the fourth power of the distance of its samples.
TEST(SampledPath, ConvergesToTheSmoothPath) {
  const auto largest_error = [](int count) {
    const SampledPath path(samples(count));
    double largest = 0.0;
    for (double t = 0.0; t <= whole; t += 0.01)
      largest = std::max(largest, (path(t).position - truth(t).position).norm());
    return largest;
  };
  EXPECT_LT(largest_error(40), largest_error(20) / 12.0);
  EXPECT_LT(largest_error(80), largest_error(40) / 12.0);
  EXPECT_LT(largest_error(80), 1e-4);
}

TEST(SampledPath, DerivativesAreThoseOfPositionAndYawAndContinuous) {
  const SampledPath path(samples(20));
  const double h = 1e-6;
  for (double t = 0.01; t < whole - 0.01; t += 0.013) {
    const ReferencePoint before = path(t - h), now = path(t), after = path(t + h);
    EXPECT_LT((now.velocity - (after.position - before.position) / (2.0 * h)).norm(), 1e-7);
    EXPECT_LT((now.acceleration - (after.velocity - before.velocity) / (2.0 * h)).norm(), 1e-4);
    const Eigen::Vector3d turn =
        quaternion_log(Eigen::Quaterniond(before.orientation.conjugate() * after.orientation));
    EXPECT_LT((now.angular_velocity - turn / (2.0 * h)).norm(), 1e-6);
    EXPECT_NEAR(now.angular_acceleration.z(),
                (after.angular_velocity.z() - before.angular_velocity.z()) / (2.0 * h), 1e-4);
    EXPECT_LT((after.acceleration - before.acceleration).norm(), 1e-3);
  }
}

TEST(SampledPath, PartsAndShiftsAreTheSamePath) {
  const SampledPath path(samples(20));
  SampledPath part = path.part(2.0, 3.5);
  EXPECT_EQ(part.start_time(), 2.0);
  EXPECT_DOUBLE_EQ(part.duration(), 1.5);
  EXPECT_LT((part(2.7).position - path(2.7).position).norm(), 1e-12);
  EXPECT_EQ(part(1.0).velocity, path(2.0).velocity);
  EXPECT_LT((part(9.0).velocity - path(3.5).velocity).norm(), 1e-12);
  part.set_start_time(10.0);
  EXPECT_LT((part(10.7).position - path(2.7).position).norm(), 1e-12);
  EXPECT_DOUBLE_EQ(part.end_time(), 11.5);
  EXPECT_LT((part.part(10.5, 11.0)(10.7).position - path(2.7).position).norm(), 1e-12);
}

TEST(SampledPath, IsDefinedForEveryTime) {
  const SampledPath path(samples(5));
  const double infinity = std::numeric_limits<double>::infinity();
  EXPECT_EQ(path(std::nan("")).position, path(path.start_time()).position);
  EXPECT_EQ(path(-infinity).position, path(path.start_time()).position);
  EXPECT_EQ(path(infinity).position, path(path.end_time()).position);
}

}  // namespace sampled_path_test
}  // namespace tilt_ropter
