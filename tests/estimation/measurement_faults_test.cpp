// Repetitions of measurements, stamps whose clock jitters or steps, and the noise of poses.

#include <tilt_ropter/estimation/detail/measurement_faults.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <random>
#include <utility>

namespace tilt_ropter::detail {
namespace measurement_faults_test {

using Eigen::Quaterniond;
using Eigen::Vector3d;

const Vector3d level(0.0, 0.0, gravity);

class Repetitions : public testing::Test {
 protected:
  // A sample that differs from all before it.
  void imu_changes() { detector.on_imu({Vector3d(0.01 * ++samples, 0.0, 0.0), level}); }

  // True if the pose repeats the last one after a change of the IMU.
  bool repeats(const MarkerPosed& next) {
    imu_changes();
    return detector.repeats(next);
  }

  const MarkerPosed pose{Vector3d(1.0, 2.0, 3.0), quaternion_exp(Vector3d(0.1, -0.2, 0.3))};
  RepetitionDetector<double> detector;
  int samples = 0;
};

TEST_F(Repetitions, PoseWithTheSameNumbersIsARepetitionIfTheImuChanged) {
  EXPECT_FALSE(repeats(pose));
  EXPECT_TRUE(repeats(pose));
  EXPECT_TRUE(repeats(pose));  // as often as it comes
  MarkerPosed negative = pose;
  negative.orientation.coeffs() *= -1.0;  // the same rotation
  EXPECT_TRUE(repeats(negative));
}

TEST_F(Repetitions, PoseThatDiffersInOneNumberIsNone) {
  EXPECT_FALSE(repeats(pose));
  MarkerPosed moved = pose;
  for (int i = 0; i < 3; ++i) {
    moved.position(i) = std::nextafter(moved.position(i), 10.0);
    EXPECT_FALSE(repeats(moved)) << i;
  }
  for (int i = 0; i < 4; ++i) {
    moved.orientation.coeffs()(i) = std::nextafter(moved.orientation.coeffs()(i), 10.0);
    EXPECT_FALSE(repeats(moved)) << i;
  }
  EXPECT_FALSE(repeats(pose));  // compared with the last pose only
}

TEST_F(Repetitions, PoseMayRepeatWhileTheImuRepeats) {
  EXPECT_FALSE(repeats(pose));
  const InertialSampled still{Vector3d(0.01 * samples, 0.0, 0.0), level};
  detector.on_imu(still);
  EXPECT_FALSE(detector.repeats(pose));
  detector.on_imu({still.angular_velocity, 1.001 * level});  // the force alone
  EXPECT_TRUE(detector.repeats(pose));
}

// The pose of construction is at the origin as well.
TEST_F(Repetitions, FirstPoseMayBeAtTheOrigin) {
  for (int run = 0; run < 2; ++run) {
    EXPECT_FALSE(repeats(MarkerPosed{}));
    EXPECT_TRUE(repeats(MarkerPosed{}));
    detector = {};
  }
}

TEST_F(Repetitions, FilterStartsWithAPoseAtTheOrigin) {
  Ekfd ekf;
  ekf.on_imu(0.0, {Vector3d::Zero(), level});
  ekf.on_imu(0.005, {Vector3d(0.01, 0.0, 0.0), level});
  EXPECT_EQ(ekf.on_pose(0.005, {Vector3d::Zero(), Quaterniond::Identity()}), EkfStatus::started);
  ekf.on_imu(0.01, {Vector3d(0.02, 0.0, 0.0), level});
  EXPECT_EQ(ekf.on_pose(0.01, {Vector3d::Zero(), Quaterniond::Identity()}), EkfStatus::frozen);
}

TEST_F(Repetitions, VectorIsComparedWithTheLastEight) {
  const auto vector = [&](int i) {
    imu_changes();
    return detector.repeats(Vector3d(1.0 + i, -2.0, 0.5));
  };
  for (int i = 0; i < 8; ++i) EXPECT_FALSE(vector(i)) << i;
  EXPECT_TRUE(vector(0));   // its place is now the newest
  EXPECT_FALSE(vector(8));  // replaces the oldest, which is 1
  EXPECT_TRUE(vector(0));
  EXPECT_TRUE(vector(2));
  EXPECT_FALSE(vector(1));
}

TEST_F(Repetitions, ZeroVectorAndVectorWhileTheImuRepeatsAreNone) {
  for (int i = 0; i < 3; ++i) {
    imu_changes();
    EXPECT_FALSE(detector.repeats(Vector3d(0.0, 0.0, 0.0)));
  }
  EXPECT_FALSE(detector.repeats(Vector3d(1.0, 0.0, 0.0)));
  EXPECT_FALSE(detector.repeats(Vector3d(1.0, 0.0, 0.0)));
  imu_changes();
  EXPECT_TRUE(detector.repeats(Vector3d(1.0, 0.0, 0.0)));
}

TEST(StampMonitor, StddevIsTheJitterOfTheStamps) {
  StampMonitor regular, jittering, sparse;
  for (int i = 0; i < 2000; ++i) {
    const double time = 0.01 * i, jitter = 0.002 * (i % 3 - 1);
    regular.on_stamp(time);
    jittering.on_stamp(time + jitter);
    if (i % 7 != 0) sparse.on_stamp(time);  // a step over a missing one is no jitter
  }
  EXPECT_EQ(regular.stddev(), 0.0);
  EXPECT_EQ(sparse.stddev(), 0.0);
  // The steps differ by 2, 2 and -4 ms from the period. The variance is half of their mean square.
  EXPECT_NEAR(jittering.stddev(), 0.002, 0.0003);
}

TEST(StampMonitor, StepOfTheClockIsCorrectedAfterEnoughStrangeLags) {
  StampMonitor monitor;
  for (int i = 0; i < 50; ++i) monitor.on_used(0.02);
  for (int i = 0; i < 50; ++i) EXPECT_FALSE(monitor.on_unused(0.03, 5)) << i;  // a usual lag
  for (int i = 0; i < 4; ++i) EXPECT_FALSE(monitor.on_unused(-1.98, 5)) << i;
  EXPECT_EQ(monitor.clock_step(), 0.0);
  EXPECT_TRUE(monitor.on_unused(-1.98, 5));
  EXPECT_NEAR(monitor.clock_step(), -2.0, 1e-12);
  EXPECT_FALSE(monitor.on_unused(-1.98, 5));  // counts from the start again
}

TEST(StampMonitor, LagsThatDifferOrAnUsedOneBetweenThemDoNotCorrectTheClock) {
  StampMonitor differ, used, unknown;
  for (StampMonitor* monitor : {&differ, &used}) monitor->on_used(0.02);
  for (int i = 0; i < 40; ++i) {
    EXPECT_FALSE(differ.on_unused(2.0 + 0.05 * i, 5));
    EXPECT_FALSE(used.on_unused(2.0, 5));
    if (i % 4 == 3) used.on_used(0.02);
    EXPECT_FALSE(unknown.on_unused(2.0, 5));  // no usual lag to compare with
  }
}

TEST(StampMonitor, SwapsTheClocksIfTheMeasurementIsThenInTime) {
  StampMonitor monitor;
  EXPECT_FALSE(monitor.swap_clocks(0.0, 0.2));  // there was no step
  monitor.on_used(0.02);
  for (int i = 0; i < 5; ++i) (void)monitor.on_unused(-1.98, 5);
  ASSERT_NEAR(monitor.clock_step(), -2.0, 1e-12);
  EXPECT_FALSE(monitor.swap_clocks(0.02, 0.2));  // with the other clock it would be 2 s early
  EXPECT_TRUE(monitor.swap_clocks(2.02, 0.2));
  EXPECT_NEAR(monitor.clock_step(), 0.0, 1e-12);
  EXPECT_TRUE(monitor.swap_clocks(-1.98, 0.2));
  EXPECT_NEAR(monitor.clock_step(), -2.0, 1e-12);
}

// Noise factors after 10 s on a circle that turns with `rate` [rad/s], radius 1 m, at 100 Hz.
std::pair<double, double> noise_factors(double rate, double noise, int outlier_every = 0) {
  const double position = 1e-3, orientation = 2e-3, dt = 0.01;
  std::mt19937 random(1);
  std::normal_distribution<double> normal(0.0, noise);
  const auto vector = [&] { return Vector3d(normal(random), normal(random), normal(random)); };
  PoseContinuity<double> continuity;
  for (int i = 0; i < 1000; ++i) {
    const double angle = rate * dt * i;
    const MarkerPosed truth{Vector3d(std::cos(angle), std::sin(angle), 1.0),
                            quaternion_exp(Vector3d(0.0, 0.0, angle))};
    MarkerPosed measured{truth.position + position * vector(),
                         truth.orientation * quaternion_exp(orientation * vector())};
    if (outlier_every > 0 && i % outlier_every == 0) measured.position.x() += 0.1;
    const double distance = (measured.position - truth.position).norm();
    continuity.on_pose(dt * i, {measured, truth, distance, position, 0.0}, orientation);
    continuity.on_used();
  }
  return {continuity.position_factor(), continuity.orientation_factor()};
}

TEST(PoseContinuity, MeasuresTheNoiseOfPosesBesideTheBelieved) {
  for (const double rate : {0.0, 2.5}) {
    const auto [position, orientation] = noise_factors(rate, 2.0);
    EXPECT_NEAR(position, 4.0, 1.2);
    EXPECT_NEAR(orientation, 4.0, 1.2);
    EXPECT_EQ(noise_factors(rate, 1.0), std::make_pair(1.0, 1.0));
    EXPECT_EQ(noise_factors(rate, 0.5), std::make_pair(1.0, 1.0));
  }
  EXPECT_LT(noise_factors(2.5, 1.0, 50).first, 2.0);
}

}  // namespace measurement_faults_test
}  // namespace tilt_ropter::detail
