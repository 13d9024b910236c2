// CTest: optimised

#include <tilt_ropter/identification/clock_calibration.hpp>

#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace clock_calibration_test {

using test_support::Flight;
using test_support::flipped;
using test_support::full_run;
using test_support::gone_wrong;
using test_support::noisy;
using test_support::NoisyImu;
using test_support::Random;
using Status = ClockCalibrationStatus;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

struct Logs {
  std::vector<Timed<InertialSampled>> imu;
  std::vector<Timed<MarkerPosed>> poses;
};

struct Recording {
  double duration = 20.0, imu_rate = 200.0, pose_rate = 100.0;
  double offset = 0.0;  // clock offset to add to the stamps of the poses
};

// With the noise and biases of a cheap IMU.
Logs record(const Flight& flight, const Recording& r, unsigned seed) {
  Logs logs;
  Random random(seed + 500);
  NoisyImu imu(flight, {}, 1.0 / r.imu_rate, seed, random.vector(0.05), random.vector(0.3));
  const int samples = static_cast<int>(r.duration * r.imu_rate);
  for (int i = 0; i <= samples; ++i) logs.imu.push_back({i / r.imu_rate, imu(i / r.imu_rate)});
  const int poses = static_cast<int>(r.duration * r.pose_rate);
  const double phase = random.uniform(0.0, 1.0);
  for (int i = 0; i <= poses; ++i) {
    const double t = (i + phase) / r.pose_rate;
    logs.poses.push_back({t - r.offset, noisy(flight.pose(t), {}, random)});
  }
  return logs;
}

Flight any_flight(unsigned seed) {
  Random random(seed);
  const Eigen::Quaterniond start = random.orientation();
  const Eigen::Vector3d arm = random.vector(0.1);
  return Flight(seed, start, arm, random.orientation());
}

double marker_error(const ClockCalibration& c, const Flight& flight) {
  return c.marker_orientation.angularDistance(flight.state(0.0).marker_orientation);
}

TEST(ClockCalibration, FindsClockOffsetAndMarkerOrientation) {
  double worst = 0.0, worst_turn = 0.0;
  unsigned seed = 0;
  for (const double offset : {0.0, 0.004, -0.0123, 0.1, -0.1, 0.2817, -0.2817, 0.45, -0.45})
    for (int i = 0; i < (full_run() ? 10 : 1); ++i) {
      const Flight flight = any_flight(++seed);
      Recording r;
      r.offset = offset;
      const Logs logs = record(flight, r, seed);
      const ClockCalibration c = calibrate_clock(logs.imu, logs.poses);
      EXPECT_EQ(c.status, Status::calibrated);
      EXPECT_GT(c.stddev, 0.0);
      worst = std::max(worst, std::abs(c.offset - offset));
      worst_turn = std::max(worst_turn, marker_error(c, flight));
      EXPECT_GT(c.residual, 2e-3);  // noise of two poses, 5 mrad each, and of the gyro
      EXPECT_LT(c.residual, 2e-2);
    }
  EXPECT_LT(worst, 1e-3);
  EXPECT_LT(worst_turn, pi / 180.0);
  RecordProperty("worst_offset_error", std::to_string(worst));
  RecordProperty("worst_marker_error", std::to_string(worst_turn));
}

TEST(ClockCalibration, WorksAtDifferentRates) {
  double worst = 0.0;
  unsigned seed = 100;
  for (const double imu_rate : {100.0, 200.0, 500.0})
    for (const double pose_rate : {50.0, 100.0, 240.0, 500.0}) {
      const Flight flight = any_flight(++seed);
      Recording r;
      r.duration = 12.0;
      r.imu_rate = imu_rate;
      r.pose_rate = pose_rate;
      r.offset = 0.07;
      const Logs logs = record(flight, r, seed);
      const ClockCalibration c = calibrate_clock(logs.imu, logs.poses);
      EXPECT_EQ(c.status, Status::calibrated) << imu_rate << " " << pose_rate;
      EXPECT_LT(marker_error(c, flight), pi / 180.0);
      worst = std::max(worst, std::abs(c.offset - r.offset));
    }
  EXPECT_LT(worst, 1.5e-3);
  RecordProperty("worst_offset_error", std::to_string(worst));
}

TEST(ClockCalibration, ToleratesGapsOutliersAndQuaternionSigns) {
  double worst = 0.0;
  for (unsigned seed = 200; seed < (full_run() ? 240U : 206U); ++seed) {
    Random random(seed);
    const Flight flight = any_flight(seed);
    Recording r;
    r.offset = random.uniform(-0.3, 0.3);
    Logs logs = record(flight, r, seed);
    for (auto& p : logs.poses) {
      if (random.uniform(0.0, 1.0) < 0.05) p.value = gone_wrong(p.value, random);
      if (random.uniform(0.0, 1.0) < 0.5) p.value = flipped(p.value);
    }
    const auto lost = [&random](const auto& v) {
      return random.uniform(0.0, 1.0) < 0.1 || (v.time > 7.0 && v.time < 9.0);
    };
    logs.poses.erase(std::remove_if(logs.poses.begin(), logs.poses.end(), lost), logs.poses.end());
    const ClockCalibration c = calibrate_clock(logs.imu, logs.poses);
    EXPECT_EQ(c.status, Status::calibrated) << seed;
    EXPECT_LT(marker_error(c, flight), pi / 180.0) << seed;
    worst = std::max(worst, std::abs(c.offset - r.offset));
  }
  EXPECT_LT(worst, 1e-3);
  RecordProperty("worst_offset_error", std::to_string(worst));
}

TEST(ClockCalibration, StandardDeviationIsConsistentWithError) {
  const unsigned runs = full_run() ? 200 : 20;
  unsigned within_one = 0, within_three = 0;
  double squares = 0.0;
  for (unsigned seed = 300; seed < 300 + runs; ++seed) {
    Random random(seed);
    Recording r;
    r.duration = 15.0;
    r.offset = random.uniform(-0.2, 0.2);
    const Logs logs = record(any_flight(seed), r, seed);
    ClockCalibrationSettings s;
    s.max_offset = 0.25;
    const ClockCalibration c = calibrate_clock(logs.imu, logs.poses, s);
    EXPECT_EQ(c.status, Status::calibrated);
    const double fraction = std::abs(c.offset - r.offset) / c.stddev;
    if (fraction < 1.0) ++within_one;
    if (fraction < 3.0) ++within_three;
    squares += fraction * fraction;
  }
  EXPECT_GE(within_three, runs * 19 / 20);
  EXPECT_GT(squares / runs, 0.1 * 0.1);  // the standard deviation is not far too large
  RecordProperty("within_one", std::to_string(1.0 * within_one / runs));
  RecordProperty("within_three", std::to_string(1.0 * within_three / runs));
  RecordProperty("rms", std::to_string(std::sqrt(squares / runs)));
}

// An offset near the end of the search range is found or reported as out_of_range. Samples beyond
// the log are never read.
TEST(ClockCalibration, OffsetAtEndOfSearchRangeIsFoundOrReported) {
  for (const double most : {0.1, 0.123})
    for (const double sign : {-1.0, 1.0})
      for (const double fraction : {0.93, 0.97, 0.99, 0.999, 1.001, 1.03, 1.5}) {
        Recording r;
        r.offset = sign * fraction * most;
        const Logs logs = record(any_flight(7), r, 7);
        ClockCalibrationSettings s;
        s.max_offset = most;
        const ClockCalibration c = calibrate_clock(logs.imu, logs.poses, s);
        if (fraction < 0.94) {
          EXPECT_EQ(c.status, Status::calibrated);
        }
        if (fraction > 1.02) {
          EXPECT_EQ(c.status, Status::out_of_range);
        }
        if (c.status == Status::calibrated) {
          EXPECT_NEAR(c.offset, r.offset, 1.5e-3);
          EXPECT_LE(std::abs(c.offset), most);
        } else {
          EXPECT_EQ(c.status, Status::out_of_range) << to_string(c.status);
        }
      }
}

TEST(ClockCalibration, TooLittleRotationIsUncertain) {
  Random random(20);
  Logs rest, one_axis;
  for (int i = 0; i <= 4000; ++i) {
    const double t = 0.005 * i;
    InertialSampled s;
    s.angular_velocity = test_support::normal_vector(random, 0.03);
    rest.imu.push_back({t, s});
    s.angular_velocity.z() += std::sin(2.0 * t) + std::cos(5.0 * t);
    one_axis.imu.push_back({t, s});
    if (i % 2 == 1) continue;
    const double yaw = (1.0 - std::cos(2.0 * t)) / 2.0 + std::sin(5.0 * t) / 5.0;
    rest.poses.push_back({t, noisy({}, {}, random)});
    one_axis.poses.push_back(
        {t, noisy({Eigen::Vector3d::Zero(), quaternion_from_yaw(yaw)}, {}, random)});
  }
  const Status at_rest = calibrate_clock(rest.imu, rest.poses).status;
  EXPECT_TRUE(at_rest == Status::uncertain || at_rest == Status::out_of_range);
  EXPECT_EQ(calibrate_clock(one_axis.imu, one_axis.poses).status, Status::uncertain);
}

// Motion with a period of 0.8 s: offsets that differ by the period fit equally well, whether the
// true offset is inside the search range or not.
TEST(ClockCalibration, PeriodicMotionIsAmbiguous) {
  bool ambiguous = false;
  for (const double offset : {0.45, 0.1, -0.3, 0.7}) {
    Random random(30);
    Logs logs;
    constexpr double w = 2.0 * pi / 0.8;
    for (int i = 0; i <= 4000; ++i) {
      const double t = 0.005 * i;
      const Eigen::Vector3d turn(0.2 * std::sin(w * t), 0.1 * std::sin(2.0 * w * t), 0.0);
      const Eigen::Vector3d change(0.2 * w * std::cos(w * t), 0.2 * w * std::cos(2.0 * w * t), 0.0);
      InertialSampled s;
      s.angular_velocity =
          right_jacobian(turn) * change + test_support::normal_vector(random, 0.03);
      logs.imu.push_back({t, s});
      if (i % 2 == 0)
        logs.poses.push_back(
            {t - offset, noisy({Eigen::Vector3d::Zero(), quaternion_exp(turn)}, {}, random)});
    }
    const ClockCalibration c = calibrate_clock(logs.imu, logs.poses);
    // Half a period later the motion is the same but for a turn of the marker frame: the best
    // offset may be at the end of the range.
    EXPECT_TRUE(c.status == Status::ambiguous || c.status == Status::out_of_range)
        << to_string(c.status) << ' ' << offset;
    ambiguous = ambiguous || c.status == Status::ambiguous;
  }
  EXPECT_TRUE(ambiguous);
  EXPECT_STREQ(to_string(Status::ambiguous), "ambiguous");
}

// Without noise there must be no division by zero.
TEST(ClockCalibration, ToleratesLogsWithoutNoiseOrMotion) {
  Logs still, exact;
  const Flight flight = any_flight(21);
  for (int i = 0; i <= 4000; ++i) {
    const double t = 0.005 * i;
    still.imu.push_back({t, {}});
    exact.imu.push_back({t, flight.imu(t)});
    still.poses.push_back({t, {}});
    exact.poses.push_back({t - 0.1, flight.pose(t)});
  }
  const ClockCalibration none = calibrate_clock(still.imu, still.poses);
  EXPECT_NE(none.status, Status::calibrated);
  EXPECT_FALSE(std::isnan(none.stddev));
  EXPECT_TRUE(all_finite(none.marker_orientation.coeffs()));
  const ClockCalibration c = calibrate_clock(exact.imu, exact.poses);
  EXPECT_EQ(c.status, Status::calibrated);
  EXPECT_NEAR(c.offset, 0.1, 1e-5);
  EXPECT_LT(marker_error(c, flight), 1e-4);
}

TEST(ClockCalibration, AcceptsFloatLogs) {
  const Flight flight = any_flight(22);
  Recording r;
  r.offset = 0.04;
  const Logs logs = record(flight, r, 22);
  std::vector<Timed<InertialSample<float>>> imu;
  std::vector<Timed<MarkerPose<float>>> poses;
  for (const auto& s : logs.imu)
    imu.push_back(
        {s.time, {s.value.angular_velocity.cast<float>(), s.value.specific_force.cast<float>()}});
  for (const auto& p : logs.poses)
    poses.push_back({p.time, {p.value.position.cast<float>(), p.value.orientation.cast<float>()}});
  const ClockCalibration c = calibrate_clock(imu, poses);
  EXPECT_EQ(c.status, Status::calibrated);
  EXPECT_NEAR(c.offset, calibrate_clock(logs.imu, logs.poses).offset, 1e-5);
}

TEST(ClockCalibration, RejectsInvalidData) {
  const Logs logs = record(any_flight(22), {}, 22);
  ASSERT_EQ(calibrate_clock(logs.imu, logs.poses).status, Status::calibrated);
  const auto refused = [&logs](const auto& change) {
    Logs changed = logs;
    change(changed);
    const ClockCalibration c = calibrate_clock(changed.imu, changed.poses);
    EXPECT_EQ(c.offset, 0.0);
    EXPECT_TRUE(std::isinf(c.stddev));
    return c.status == Status::bad_data;
  };
  EXPECT_TRUE(refused([](Logs& l) { l.imu[100].time = nan; }));
  EXPECT_TRUE(refused([](Logs& l) { l.imu[100].time = l.imu[99].time; }));
  EXPECT_TRUE(refused([](Logs& l) { l.imu.front().time = nan; }));
  EXPECT_TRUE(refused([](Logs& l) { l.imu[100].value.angular_velocity.y() = nan; }));
  EXPECT_TRUE(refused([](Logs& l) { std::swap(l.poses[50], l.poses[51]); }));
  EXPECT_TRUE(
      refused([](Logs& l) { l.poses.back().time = std::numeric_limits<double>::infinity(); }));
  EXPECT_TRUE(refused([](Logs& l) { l.poses[50].value.orientation.x() = nan; }));
  EXPECT_TRUE(refused([](Logs& l) { l.poses[50].value.orientation.coeffs().setZero(); }));
}

TEST(ClockCalibration, RejectsShortLogs) {
  const Logs logs = record(any_flight(23), {}, 23);
  EXPECT_EQ(calibrate_clock({}, {}).status, Status::too_short);
  EXPECT_EQ(calibrate_clock(logs.imu, {}).status, Status::too_short);
  EXPECT_EQ(calibrate_clock({}, logs.poses).status, Status::too_short);
  EXPECT_EQ(calibrate_clock({logs.imu[0]}, logs.poses).status, Status::too_short);
  const auto head = [&logs](std::ptrdiff_t count) {
    return std::vector<Timed<MarkerPosed>>(logs.poses.begin(), logs.poses.begin() + count);
  };
  EXPECT_EQ(calibrate_clock(logs.imu, head(140)).status, Status::too_short);
  EXPECT_NE(calibrate_clock(logs.imu, head(200)).status, Status::too_short);
}

TEST(ClockCalibration, UsesOnlyPosesThatTheImuCovers) {
  const ClockCalibrationSettings s;
  Logs logs = record(any_flight(25), {}, 25);
  logs.imu.erase(logs.imu.begin() + 3000, logs.imu.end());  // 15 s of 20 s
  logs.imu.erase(logs.imu.begin(), logs.imu.begin() + 1000);
  Logs covered = logs;
  const double margin = s.max_offset - 0.02;  // poses less far inside cannot be used at all offsets
  covered.poses.clear();
  for (const auto& pose : logs.poses)
    if (pose.time > logs.imu.front().time + margin && pose.time < logs.imu.back().time - margin)
      covered.poses.push_back(pose);
  ASSERT_LT(covered.poses.size(), logs.poses.size());
  const ClockCalibration all = calibrate_clock(logs.imu, logs.poses, s),
                         some = calibrate_clock(covered.imu, covered.poses, s);
  EXPECT_EQ(all.status, Status::calibrated);
  EXPECT_EQ(all.offset, some.offset);
  EXPECT_EQ(all.residual, some.residual);
  EXPECT_EQ(all.stddev, some.stddev);
}

TEST(ClockCalibration, EachSettingActs) {
  Recording r;
  r.offset = 0.3;
  const Logs logs = record(any_flight(24), r, 24);
  ClockCalibrationSettings s;
  s.max_offset = 0.2;
  EXPECT_EQ(calibrate_clock(logs.imu, logs.poses, s).status, Status::out_of_range);
  s = {};
  const ClockCalibration usual = calibrate_clock(logs.imu, logs.poses, s);
  EXPECT_EQ(usual.status, Status::calibrated);
  s.max_stddev = usual.stddev * 0.99;
  EXPECT_EQ(calibrate_clock(logs.imu, logs.poses, s).status, Status::uncertain);
  s.max_stddev = usual.stddev * 1.01;
  EXPECT_EQ(calibrate_clock(logs.imu, logs.poses, s).status, Status::calibrated);
  s = {};
  s.window = 0.2;  // larger rotations, same noise
  const ClockCalibration wide = calibrate_clock(logs.imu, logs.poses, s);
  EXPECT_EQ(wide.status, Status::calibrated);
  EXPECT_LT(wide.stddev, 0.6 * usual.stddev);
}

TEST(ClockCalibration, StatusHasAName) {
  EXPECT_STREQ(to_string(Status::calibrated), "calibrated");
  EXPECT_STREQ(to_string(Status::bad_data), "bad_data");
  EXPECT_STREQ(to_string(Status::too_short), "too_short");
  EXPECT_STREQ(to_string(Status::out_of_range), "out_of_range");
  EXPECT_STREQ(to_string(Status::uncertain), "uncertain");
}

}  // namespace clock_calibration_test
}  // namespace tilt_ropter
