// Calibration from a log: values and intervals on simulated flights whose truth is known, poses
// that are wrong, and motion that does not show an unknown.

#include <tilt_ropter/identification/log_calibration.hpp>

#include "support/flights.hpp"
#include "support/full_run.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <limits>
#include <string>
#include <vector>

namespace log_calibration_test {

using namespace tilt_ropter;
using test_support::Flight;
using test_support::normal_vector;
using test_support::Random;

constexpr double clock_offset = 0.083;  // [s]
const Eigen::Vector3d marker_position(0.07, -0.03, -0.12);
const Eigen::Quaterniond marker_orientation(Eigen::AngleAxisd(2.9, Eigen::Vector3d(2, 1, 2) / 3.0));

struct Log {
  std::vector<Timed<InertialSampled>> imu;
  std::vector<Timed<MarkerPosed>> poses;
  InertialStated last;
};

struct Conditions {
  double duration = 16.0;  // [s]
  InertialNoise imu_noise;
  MarkerPoseNoise pose_noise;
  double outliers = 0.0;                              // fraction of the poses
  Eigen::Vector2d gravity = Eigen::Vector2d::Zero();  // horizontal part [m/s^2]
  bool constant_biases = false;
};

/// The log of a random flight with random biases; IMU at 100 Hz, poses at 25 Hz.
Log fly(unsigned seed, const Conditions& conditions = {}) {
  const double period = 0.01;
  const Flight flight(seed, Random(seed).orientation(), marker_position, marker_orientation);
  Random random(seed + 1000);
  InertialNoise noise = conditions.imu_noise;
  if (conditions.constant_biases) noise.gyro_bias_walk = noise.accelerometer_bias_walk = 0.0;
  test_support::NoisyImu imu(flight, noise, period, seed + 2000, normal_vector(random, 0.05),
                             normal_vector(random, 0.3));
  const Eigen::Vector3d lean(conditions.gravity.x(), conditions.gravity.y(), 0.0);
  Log log;
  for (int i = 0; i * period < conditions.duration; ++i) {
    const double t = period * i;
    InertialSampled sample = imu(t);
    sample.specific_force -= flight.state(t).orientation.conjugate() * lean;
    log.imu.push_back({t, sample});
    log.last = imu.state(t);
    // A millisecond apart from the samples; the last pose is before the last sample.
    const double taken = t + 0.0037;
    if (i % 4 != 0 || t < 0.6 || t > conditions.duration - 0.6) continue;
    MarkerPosed pose = test_support::noisy(flight.pose(taken), conditions.pose_noise, random);
    if (random.uniform(0.0, 1.0) < conditions.outliers)
      pose = test_support::gone_wrong(pose, random);
    log.poses.push_back({taken - clock_offset, pose});
  }
  return log;
}

/// Errors in units of the half width: clock, marker's position and orientation, biases.
std::vector<double> relative_errors(const LogCalibration& found, const InertialStated& truth) {
  std::vector<double> errors = {(found.clock_offset - clock_offset) / found.clock_offset_95};
  const auto add = [&errors](const Eigen::Vector3d& error, const Eigen::Vector3d& half_width) {
    for (int i = 0; i < 3; ++i) errors.push_back(error(i) / half_width(i));
  };
  add(found.marker_position - marker_position, found.marker_position_95);
  add(quaternion_log(Eigen::Quaterniond(found.marker_orientation.conjugate() * marker_orientation)),
      found.marker_orientation_95);
  add(found.gyro_bias - truth.gyro_bias, found.gyro_bias_95);
  add(found.accelerometer_bias - truth.accelerometer_bias, found.accelerometer_bias_95);
  return errors;
}

/// Fraction of the values inside their intervals, over `runs` flights.
double coverage(int runs, const Conditions& conditions, const LogCalibrationSettings& settings) {
  int inside = 0, count = 0;
  for (int run = 0; run < runs; ++run) {
    const Log log = fly(static_cast<unsigned>(run), conditions);
    const LogCalibration found = calibrate_log(log.imu, log.poses, settings);
    EXPECT_EQ(found.status, LogCalibrationStatus::calibrated)
        << run << ' ' << to_string(found.status) << ' ' << to_string(found.clock) << ' '
        << found.uncertain;
    for (const double error : relative_errors(found, log.last)) {
      inside += std::abs(error) <= 1.0 ? 1 : 0;
      ++count;
    }
  }
  std::printf("inside the intervals: %.4f\n", static_cast<double>(inside) / count);
  return static_cast<double>(inside) / count;
}

TEST(LogCalibration, IntervalsHoldIn95Of100) {
  const double inside = coverage(test_support::quick_or_full(15, 200), {}, {});
  EXPECT_GE(inside, 0.92);
  EXPECT_LE(inside, 0.985);
}

TEST(LogCalibration, IntervalsHoldIfTheNoiseIsNotAsAssumed) {
  Conditions quieter;
  quieter.imu_noise = {5e-4, 5e-3, 5e-6, 2.5e-4};
  quieter.pose_noise = {5e-4, 1.25e-3};
  const int runs = test_support::quick_or_full(8, 100);
  const double with_less = coverage(runs, quieter, {});
  EXPECT_GE(with_less, 0.90);
  EXPECT_LE(with_less, 0.99);
  Conditions louder;
  louder.imu_noise = {6e-3, 6e-2, 6e-5, 3e-3};
  louder.pose_noise = {6e-3, 0.015};
  LogCalibrationSettings wide;
  wide.clock.max_stddev = 0.01;
  wide.max_marker_position_stddev = wide.max_marker_orientation_stddev = 1.0;
  wide.max_gyro_bias_stddev = wide.max_accelerometer_bias_stddev = 1.0;
  const double with_more = coverage(runs, louder, wide);
  EXPECT_GE(with_more, 0.90);
  EXPECT_LE(with_more, 0.99);
}

TEST(LogCalibration, FindsMillimetresInThirtySeconds) {
  Conditions conditions;
  conditions.duration = 30.0;
  const Log log = fly(3, conditions);
  const LogCalibration found = calibrate_log(log.imu, log.poses);
  ASSERT_EQ(found.status, LogCalibrationStatus::calibrated);
  EXPECT_NEAR(found.clock_offset, clock_offset, 5e-4);
  EXPECT_LT((found.marker_position - marker_position).norm(), 2e-3);
  EXPECT_LT(found.marker_orientation.angularDistance(marker_orientation), 2e-3);
  EXPECT_LT((found.gyro_bias - log.last.gyro_bias).norm(), 3e-3);
  EXPECT_NEAR(found.position_residual, 2e-3, 3e-4);
  EXPECT_NEAR(found.orientation_residual, 5e-3, 5e-4);
  EXPECT_NEAR(found.poses, static_cast<double>(log.poses.size()), 1);  // the filter starts
  EXPECT_LE(found.outliers, 5);
  // The trajectory is that of the flight.
  const Flight flight(3, Random(3).orientation());
  double square = 0.0;
  for (const Timed<InertialStated>& x : found.trajectory)
    square += (x.value.position - flight.state(x.time).position).squaredNorm();
  EXPECT_LT(std::sqrt(square / static_cast<double>(found.trajectory.size())), 3e-3);
}

TEST(LogCalibration, OutliersDoNotMoveIt) {
  Conditions conditions;
  conditions.duration = 30.0;
  const Log clean = fly(3, conditions);
  conditions.outliers = 0.05;
  const Log log = fly(3, conditions);
  const LogCalibration found = calibrate_log(log.imu, log.poses);
  ASSERT_EQ(found.status, LogCalibrationStatus::calibrated) << to_string(found.status);
  EXPECT_NEAR(found.outliers, 0.05 * static_cast<double>(log.poses.size()), 20);
  EXPECT_NEAR(found.clock_offset, clock_offset, 1e-3);
  EXPECT_LT((found.marker_position - marker_position).norm(), 3e-3);
  EXPECT_LT(found.marker_orientation.angularDistance(marker_orientation), 3e-3);
  for (const double error : relative_errors(found, log.last)) EXPECT_LT(std::abs(error), 2.0);
}

TEST(LogCalibration, FindsTheDirectionOfGravity) {
  Conditions conditions;
  conditions.duration = 30.0;
  conditions.gravity << 0.08, -0.05;
  const Log log = fly(5, conditions);
  LogCalibrationSettings settings;
  settings.gravity_stddev = 0.02;
  const LogCalibration found = calibrate_log(log.imu, log.poses, settings);
  ASSERT_EQ(found.status, LogCalibrationStatus::calibrated);
  for (int i = 0; i < 2; ++i) {
    EXPECT_NEAR(found.gravity_tilt(i), conditions.gravity(i) / gravity,
                1.5 * found.gravity_tilt_95(i));
    EXPECT_LT(found.gravity_tilt_95(i), 0.003);
  }
  const LogCalibration level = calibrate_log(log.imu, log.poses);
  EXPECT_EQ(level.gravity_tilt, Eigen::Vector2d::Zero());
  EXPECT_EQ(level.gravity_tilt_95, Eigen::Vector2d::Zero());
}

TEST(LogCalibration, BiasesWithoutWalkAreConstant) {
  Conditions conditions;
  conditions.constant_biases = true;
  const Log log = fly(7, conditions);
  LogCalibrationSettings settings;
  settings.imu_noise.gyro_bias_walk = settings.imu_noise.accelerometer_bias_walk = 0.0;
  const LogCalibration found = calibrate_log(log.imu, log.poses, settings);
  ASSERT_EQ(found.status, LogCalibrationStatus::calibrated);
  for (const double error : relative_errors(found, log.last)) EXPECT_LT(std::abs(error), 1.8);
  EXPECT_NEAR((found.trajectory.front().value.gyro_bias - found.gyro_bias).norm(), 0.0, 1e-9);
  EXPECT_NEAR((found.trajectory.front().value.accelerometer_bias - found.accelerometer_bias).norm(),
              0.0, 1e-9);
}

/// A log whose body rotates about `axis` by angle(t), at one place, with a level world.
template <typename Angle, typename Rate>
Log turning(const Eigen::Vector3d& axis, const Angle& angle, const Rate& rate) {
  Random random(1);
  Log log;
  for (int i = 0; i < 2000; ++i) {
    const double t = 0.01 * i;
    const Eigen::Quaterniond q(Eigen::AngleAxisd(angle(t), axis));
    log.imu.push_back(
        {t,
         {rate(t) * axis + normal_vector(random, 0.002),
          q.conjugate() * Eigen::Vector3d(0.0, 0.0, gravity) + normal_vector(random, 0.02)}});
    if (i % 4 != 0 || i < 80 || i > 1920) continue;
    const MarkerPosed pose{q * marker_position, q * marker_orientation};
    log.poses.push_back({t - clock_offset, test_support::noisy(pose, {}, random)});
  }
  return log;
}

TEST(LogCalibration, RefusesWhatTheMotionDoesNotShow) {
  const auto refused = [](const Log& log) {
    const LogCalibration found = calibrate_log(log.imu, log.poses);
    EXPECT_EQ(found.status, LogCalibrationStatus::no_clock) << to_string(found.status);
    EXPECT_NE(found.clock, ClockCalibrationStatus::calibrated);
  };
  refused(turning(
      Eigen::Vector3d::UnitX(), [](double) { return 0.0; }, [](double) { return 0.0; }));
  refused(turning(
      Eigen::Vector3d::UnitZ(), [](double t) { return t; }, [](double) { return 1.0; }));
  // About one axis, at a changing rate.
  refused(turning(
      Eigen::Vector3d::UnitZ(), [](double t) { return std::sin(t) + 0.5 * std::sin(2.3 * t); },
      [](double t) { return std::cos(t) + 1.15 * std::cos(2.3 * t); }));
}

TEST(LogCalibration, NamesWhatIsUncertain) {
  const Log log = fly(3);
  LogCalibrationSettings strict;
  strict.max_marker_position_stddev = 1e-6;
  LogCalibration found = calibrate_log(log.imu, log.poses, strict);
  EXPECT_EQ(found.status, LogCalibrationStatus::uncertain);
  EXPECT_EQ(found.uncertain, "marker_position");
  strict.max_marker_orientation_stddev = strict.max_gyro_bias_stddev = 1e-6;
  strict.max_accelerometer_bias_stddev = 1e-6;
  found = calibrate_log(log.imu, log.poses, strict);
  EXPECT_EQ(found.uncertain, "marker_position marker_orientation gyro_bias accelerometer_bias");
  // The clock shows by rotations; the accelerometer is too noisy for a lever arm.
  Conditions rough;
  rough.imu_noise.accelerometer_density = 1.0;
  const Log noisy = fly(4, rough);
  found = calibrate_log(noisy.imu, noisy.poses);
  EXPECT_EQ(found.status, LogCalibrationStatus::uncertain) << to_string(found.status);
  EXPECT_NE(found.uncertain.find("marker_position"), std::string::npos) << found.uncertain;
}

TEST(LogCalibration, BadLogsAreRefused) {
  const Log log = fly(3);
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  Log bad = log;
  bad.imu[500].value.specific_force.y() = nan;
  EXPECT_EQ(calibrate_log(bad.imu, bad.poses).status, LogCalibrationStatus::bad_data);
  bad = log;
  bad.poses[100].value.position.z() = nan;
  EXPECT_EQ(calibrate_log(bad.imu, bad.poses).status, LogCalibrationStatus::bad_data);
  bad = log;
  bad.imu[500].time = bad.imu[499].time;
  EXPECT_EQ(calibrate_log(bad.imu, bad.poses).status, LogCalibrationStatus::bad_data);
  bad = log;
  bad.imu.erase(bad.imu.begin() + 500, bad.imu.begin() + 510);
  EXPECT_EQ(calibrate_log(bad.imu, bad.poses).status, LogCalibrationStatus::imu_gap);
  bad.poses.resize(50);
  const LogCalibration found = calibrate_log(bad.imu, bad.poses);
  EXPECT_EQ(found.status, LogCalibrationStatus::no_clock);
  EXPECT_EQ(found.clock, ClockCalibrationStatus::too_short);
  EXPECT_EQ(calibrate_log({}, {}).status, LogCalibrationStatus::no_clock);
  LogCalibrationSettings once;
  once.max_iterations = 1;
  EXPECT_EQ(calibrate_log(log.imu, log.poses, once).status, LogCalibrationStatus::not_converged);
  EXPECT_STREQ(to_string(LogCalibrationStatus::not_converged), "not_converged");
}

}  // namespace log_calibration_test
