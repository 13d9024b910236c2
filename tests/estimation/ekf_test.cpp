// Order and stamps of the measurements, and status of each.

#include <tilt_ropter/estimation/ekf.hpp>

#include "support/ekf_flights.hpp"
#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <map>
#include <string>

namespace tilt_ropter {
namespace ekf_test {

using test_support::Errors;
using test_support::errors;
using test_support::expect_good;
using test_support::Flight;
using test_support::flipped;
using test_support::fly;
using test_support::Log;
using test_support::noisy;
using test_support::Random;
using test_support::record;
using test_support::same;
using test_support::Unobserved;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinite = std::numeric_limits<double>::infinity();

TEST(Ekf, ResultIsIndependentOfQuaternionSignsBitForBit) {
  Random random(206);
  EkfSettings s;
  s.marker_position_stddev = 0.01;
  s.marker_orientation_stddev = 0.01;
  const Flight flight(1, random.orientation());
  const Log log = record(flight, 10.0, 1, s);
  Log flips = log;
  for (std::size_t i = 1; i < flips.poses.size(); ++i)
    if (random.uniform(0.0, 1.0) < 0.5) flips.poses[i].value = flipped(flips.poses[i].value);
  Ekfd a(s), b(s);
  fly(a, log);
  fly(b, flips);
  EXPECT_TRUE(same(a, b));
  expect_good(b, flight);
}

TEST(Ekf, APoseThatIsSentAgainAfterAnOlderOneIsADuplicate) {
  const Flight flight(1, Random(206).orientation());
  const Log log = record(flight, 0.1, 1);
  Ekfd ekf;
  for (const auto& sample : log.imu) ekf.on_imu(sample.time, sample.value);
  EXPECT_EQ(ekf.on_pose(0.0, flight.pose(0.0)), EkfStatus::started);
  EXPECT_EQ(ekf.on_pose(0.01, flight.pose(0.01)), EkfStatus::updated);
  EXPECT_EQ(ekf.on_pose(0.005, flight.pose(0.005)), EkfStatus::late);
  EXPECT_EQ(ekf.on_pose(0.01, flight.pose(0.01)), EkfStatus::duplicate);
  EXPECT_EQ(ekf.counts().used, 2);
}

TEST(Ekf, SameInputGivesSameOutputBitForBit) {
  const Flight flight(2, Random(207).orientation());
  const Log log = record(flight, 5.0, 2);
  Ekfd a, b;
  fly(a, log);
  fly(b, log, 0.03);
  b.reset();
  EXPECT_FALSE(b.running());
  EXPECT_EQ(b.counts().used, 0);
  EXPECT_EQ(b.time(), 0.0);
  EXPECT_EQ(b.nis(), 0.0);
  fly(b, log);
  EXPECT_TRUE(same(a, b));
  Ekfd copy = a;
  EXPECT_TRUE(same(a, copy));
}

// A delayed pose is compared with the state at its own time.
TEST(Ekf, DelayedPosesGiveSameEstimateAtTheirTimes) {
  EkfSettings s;
  s.marker_position_stddev = 0.01;
  s.marker_orientation_stddev = 0.01;
  Random random(208);
  for (const double stamp_shift : {0.0, 0.0017}) {  // at the times of IMU samples and between them
    const Flight flight(3, random.orientation());
    Log log = record(flight, 10.0, 3, s, random.vector(0.05), random.vector(0.3));
    for (auto& p : log.poses) {
      p.time += stamp_shift;
      p.value = noisy(flight.pose(p.time), s.pose_noise, random);
    }
    log.poses.erase(log.poses.end() - 10, log.poses.end());
    std::map<double, ErrorStateFilterd::Covariance> covariances;
    std::map<double, InertialStated> states;
    Ekfd prompt(s), delayed(s);
    fly(prompt, log, 0.0, Unobserved(), [&] {
      states[prompt.filter_time()] = prompt.filter().state();
      covariances[prompt.filter_time()] = prompt.filter().covariance();
    });
    double worst = 0.0;
    std::size_t compared = 0;
    fly(
        delayed, log, 0.05,
        [&](std::size_t i, EkfStatus status) {
          EXPECT_EQ(status, i == 0 ? EkfStatus::started : EkfStatus::updated);
          const auto there = states.find(delayed.filter_time());
          if (there == states.end()) return;
          ++compared;
          EXPECT_EQ(delayed.filter_time(), log.poses[i].time);
          EXPECT_EQ(difference(there->second, delayed.filter().state()), InertialTangentd::Zero());
          EXPECT_EQ(covariances[there->first], delayed.filter().covariance());
        },
        [&] {
          if (delayed.time() > 5.0) worst = std::max(worst, errors(delayed, flight).position);
        });
    EXPECT_GT(compared, log.poses.size() - 20);
    EXPECT_LT(worst, 0.01);
    RecordProperty("worst_position_error_delayed", std::to_string(worst));
  }
}

TEST(Ekf, CorrectsClockOffsetOfEitherSign) {
  for (const double offset : {0.15, -0.15, 0.0371}) {
    EkfSettings s;
    s.clock_offset = offset;
    const Flight flight(4, Random(209).orientation());
    const Log log = record(flight, 10.0, 4);
    Log shifted = log;
    for (auto& p : shifted.poses) p.time -= offset;  // stamps of the motion capture's clock
    Ekfd same_clock, other_clock(s), uncorrected;
    fly(same_clock, log);
    std::map<EkfStatus, int> statuses;
    // The poses arrive at the true time.
    fly(other_clock, shifted, offset, [&](std::size_t, EkfStatus status) { ++statuses[status]; });
    EXPECT_EQ(statuses[EkfStatus::started], 1);
    EXPECT_EQ(statuses[EkfStatus::updated] + statuses[EkfStatus::waiting], 1000);
    EXPECT_GE(other_clock.counts().used, 1000);  // the last pose may still wait
    const Errors e = errors(other_clock, flight);
    EXPECT_LT(e.position, 0.005);
    EXPECT_LT(e.orientation, 0.01);
    if (std::abs(offset) < 0.1) continue;  // the filter finds this one by itself
    fly(uncorrected, shifted, offset);
    EXPECT_GT(errors(uncorrected, flight).position, 0.02);
  }
}

TEST(Ekf, PosesAheadOfTheImuWait) {
  const Flight flight(5, Random(210).orientation());
  const Log log = record(flight, 10.0, 5);
  Ekfd prompt, ahead;
  fly(prompt, log);
  std::map<EkfStatus, int> statuses;
  ahead.on_imu(log.imu[0].time, log.imu[0].value);
  Log rest = log;
  rest.imu.erase(rest.imu.begin());
  fly(ahead, rest, -0.1, [&](std::size_t, EkfStatus status) { ++statuses[status]; });
  EXPECT_GT(statuses[EkfStatus::waiting], 980);
  EXPECT_TRUE(same(prompt.state(), ahead.state()));
  EXPECT_EQ(prompt.counts().used, ahead.counts().used);
}

// Poses may arrive in any order before the IMU reaches their time.
TEST(Ekf, UsesWaitingPosesInTimeOrder) {
  const Flight flight(6, Random(211).orientation());
  Ekfd in_order, mixed;
  for (Ekfd* ekf : {&in_order, &mixed}) {
    for (int i = 0; i <= 20; ++i) ekf->on_imu(0.005 * i, flight.imu(0.005 * i));
    ekf->on_pose(0.1, flight.pose(0.1));
  }
  for (const double t : {0.11, 0.12, 0.13, 0.14})
    EXPECT_EQ(in_order.on_pose(t, flight.pose(t)), EkfStatus::waiting);
  for (const double t : {0.13, 0.11, 0.14, 0.12})
    EXPECT_EQ(mixed.on_pose(t, flight.pose(t)), EkfStatus::waiting);
  for (Ekfd* ekf : {&in_order, &mixed}) {
    for (int i = 21; i <= 40; ++i) ekf->on_imu(0.005 * i, flight.imu(0.005 * i));
    EXPECT_EQ(ekf->counts().used, 5);
  }
  EXPECT_TRUE(same(in_order, mixed));
  // At most max_waiting poses wait.
  std::size_t waiting = 0;
  for (int i = 1; i <= 50; ++i)
    if (mixed.on_pose(0.2 + 0.001 * i, flight.pose(0.2 + 0.001 * i)) == EkfStatus::waiting)
      ++waiting;
  EXPECT_EQ(waiting, Ekfd::max_waiting);
  EXPECT_EQ(mixed.counts().unused, 50 - static_cast<long>(Ekfd::max_waiting));
}

TEST(Ekf, ToleratesLateDuplicateAndMissingMeasurements) {
  Random random(212);
  const Flight flight(8, random.orientation());
  const Log log = record(flight, 20.0, 8, {}, random.vector(0.05), random.vector(0.3));
  Ekfd clean, ekf;
  long duplicates = 0, late = 0;
  std::size_t j = 0;
  for (std::size_t i = 0; i < log.imu.size(); ++i) {
    const auto& sample = log.imu[i];
    clean.on_imu(sample.time, sample.value);
    ekf.on_imu(sample.time, sample.value);
    if (i > 5 && random.uniform(0.0, 1.0) < 0.1) {
      const BodyStated before = ekf.state();
      EXPECT_EQ(ekf.on_imu(sample.time, sample.value), EkfStatus::duplicate);
      EXPECT_EQ(ekf.on_imu(log.imu[i - 3].time, log.imu[i - 3].value), EkfStatus::late);
      EXPECT_TRUE(same(before, ekf.state()));
    }
    if (i % 2 == 1) continue;
    const auto& pose = log.poses[j];
    clean.on_pose(pose.time, pose.value);
    ekf.on_pose(pose.time, pose.value);
    if (j > 5 && random.uniform(0.0, 1.0) < 0.1) {
      EXPECT_EQ(ekf.on_pose(pose.time, pose.value), EkfStatus::duplicate);
      EXPECT_EQ(ekf.on_pose(log.poses[j - 2].time, log.poses[j - 2].value), EkfStatus::late);
      ++duplicates;
      ++late;
    }
    ++j;
  }
  EXPECT_GT(duplicates, 50);
  EXPECT_EQ(ekf.counts().unused, duplicates + late);
  EXPECT_TRUE(same(clean, ekf));

  // One tenth of all measurements is missing.
  Log holes = log;
  const auto lost = [&random](const auto&) { return random.uniform(0.0, 1.0) < 0.1; };
  holes.imu.erase(std::remove_if(holes.imu.begin() + 1, holes.imu.end() - 1, lost),
                  holes.imu.end() - 1);
  holes.poses.erase(std::remove_if(holes.poses.begin(), holes.poses.end(), lost),
                    holes.poses.end());
  Ekfd with_holes;
  fly(with_holes, holes);
  expect_good(with_holes, flight);
  EXPECT_EQ(with_holes.counts().restarts, 0);
}

TEST(Ekf, ReachesAndCountsEveryStatus) {
  const Flight flight(12);
  Ekfd ekf;
  const auto imu = [&](double t) { return ekf.on_imu(t, flight.imu(t)); };
  const auto pose = [&](double t) { return ekf.on_pose(t, flight.pose(t)); };
  EXPECT_EQ(pose(0.0), EkfStatus::early);  // no IMU yet
  EXPECT_EQ(imu(1.0), EkfStatus::updated);
  EXPECT_EQ(pose(0.9), EkfStatus::late);
  EXPECT_FALSE(ekf.running());
  EXPECT_EQ(pose(1.0), EkfStatus::started);
  EXPECT_TRUE(ekf.running());
  EXPECT_EQ(imu(1.0), EkfStatus::duplicate);
  EXPECT_EQ(imu(0.99), EkfStatus::late);
  for (int i = 1; i <= 4; ++i) EXPECT_EQ(imu(1.0 + 0.005 * i), EkfStatus::updated);
  EXPECT_EQ(pose(1.01), EkfStatus::updated);
  EXPECT_EQ(pose(1.01), EkfStatus::duplicate);
  EXPECT_EQ(pose(1.005), EkfStatus::late);
  EXPECT_EQ(pose(1.03), EkfStatus::waiting);
  EXPECT_EQ(pose(1.5), EkfStatus::early);
  EXPECT_EQ(ekf.counts().used, 2);
  EXPECT_EQ(imu(1.03), EkfStatus::updated);
  EXPECT_EQ(ekf.counts().used, 3);  // the pose that waited
  MarkerPosed far = flight.pose(1.03);
  far.position.x() += 10.0;
  imu(1.04);
  EXPECT_EQ(ekf.on_pose(1.035, far), EkfStatus::gated);
  EXPECT_EQ(ekf.on_pose(1.036, far), EkfStatus::gated);  // no IMU sample between them
  imu(1.045);
  EXPECT_EQ(ekf.on_pose(1.04, far), EkfStatus::frozen);
  EXPECT_EQ(imu(nan), EkfStatus::rejected);
  EXPECT_EQ(pose(nan), EkfStatus::rejected);
  EXPECT_EQ(imu(2.0), EkfStatus::stopped);
  EXPECT_FALSE(ekf.running());
  EXPECT_EQ(pose(2.0), EkfStatus::restarted);
  EXPECT_EQ(ekf.counts().used, 4);
  EXPECT_EQ(ekf.counts().restarts, 1);
  EXPECT_EQ(ekf.counts().gated, 2);
  EXPECT_EQ(ekf.counts().frozen, 1);
  EXPECT_EQ(ekf.counts().unused, 7);
  EXPECT_STREQ(to_string(EkfStatus::updated), "updated");
  EXPECT_STREQ(to_string(EkfStatus::started), "started");
  EXPECT_STREQ(to_string(EkfStatus::restarted), "restarted");
  EXPECT_STREQ(to_string(EkfStatus::waiting), "waiting");
  EXPECT_STREQ(to_string(EkfStatus::stopped), "stopped");
  EXPECT_STREQ(to_string(EkfStatus::gated), "gated");
  EXPECT_STREQ(to_string(EkfStatus::duplicate), "duplicate");
  EXPECT_STREQ(to_string(EkfStatus::late), "late");
  EXPECT_STREQ(to_string(EkfStatus::early), "early");
  EXPECT_STREQ(to_string(EkfStatus::rejected), "rejected");
  EXPECT_STREQ(to_string(EkfStatus::frozen), "frozen");
}

TEST(Ekf, RejectsInvalidMeasurementsWithoutChange) {
  const Flight flight(13, Random(216).orientation());
  Ekfd ekf;
  fly(ekf, record(flight, 5.0, 13));
  const Ekfd before = ekf;
  const double t = 5.001;
  for (const double bad : {nan, infinite, -infinite, 1e300, 1e7}) {
    for (int axis = 0; axis < 3; ++axis) {
      InertialSampled sample = flight.imu(t);
      sample.angular_velocity(axis) = bad;
      EXPECT_EQ(ekf.on_imu(t, sample), EkfStatus::rejected);
      sample = flight.imu(t);
      sample.specific_force(axis) = -bad;
      EXPECT_EQ(ekf.on_imu(t, sample), EkfStatus::rejected);
      MarkerPosed pose = flight.pose(t);
      pose.position(axis) = bad;
      EXPECT_EQ(ekf.on_pose(t, pose), EkfStatus::rejected);
      pose = flight.pose(t);
      pose.orientation.coeffs()(axis) = bad;
      EXPECT_EQ(ekf.on_pose(t, pose), EkfStatus::rejected);
    }
  }
  for (const double length : {0.0, 0.5, 0.89, 1.11, 2.0}) {
    MarkerPosed pose = flight.pose(t);
    pose.orientation.coeffs() *= length;
    EXPECT_EQ(ekf.on_pose(t, pose), EkfStatus::rejected);
  }
  EXPECT_EQ(ekf.on_imu(infinite, flight.imu(t)), EkfStatus::rejected);
  EXPECT_EQ(ekf.on_pose(-infinite, flight.pose(t)), EkfStatus::rejected);
  EXPECT_TRUE(same(before, ekf));
  MarkerPosed rounded = flight.pose(t);  // rounded as in a log with few digits
  rounded.orientation.coeffs() *= 1.01;
  EXPECT_EQ(ekf.on_imu(5.01, flight.imu(5.01)), EkfStatus::updated);
  EXPECT_EQ(ekf.on_pose(t, rounded), EkfStatus::updated);
}

TEST(Ekf, ToleratesImuFasterThanSampleBuffer) {
  const Flight flight(14, Random(217).orientation());
  EkfSettings s;
  s.max_delay = 1.0;  // 1 s at 10 kHz is ten times as many samples as are kept
  s.max_imu_rate = 1000.0;
  Ekfd ekf(s);
  for (int i = 0; i <= 30000; ++i) {
    const double t = 1e-4 * i;
    ekf.on_imu(t, flight.imu(t));
    if (i % 100 == 0 && i < 10000) ekf.on_pose(t, flight.pose(t));
  }
  EXPECT_LE(ekf.time() - ekf.filter_time(), 1.0);
  EXPECT_LT(errors(ekf, flight).position, 0.1);  // two seconds without poses
  EXPECT_EQ(ekf.on_pose(2.5, flight.pose(2.5)), EkfStatus::late);
  EXPECT_EQ(ekf.on_pose(2.95, flight.pose(2.95)), EkfStatus::updated);
}

TEST(Ekf, KeepsMaxDelayWithFastImu) {
  const Flight flight(15, Random(218).orientation());
  EkfSettings s;
  s.max_delay = 0.3;
  Ekfd ekf(s);
  long used = 0;
  for (int i = 0; i <= 16000; ++i) {  // 8 kHz, poses 0.29 s late
    const double t = i / 8000.0, stamp = t - 0.29;
    ekf.on_imu(t, flight.imu(t));
    if (i % 80 == 0 && stamp > 0.0 && ekf.on_pose(stamp, flight.pose(stamp)) <= EkfStatus::started)
      ++used;
  }
  EXPECT_EQ(used, 171);
  EXPECT_LT(errors(ekf, flight).position, 0.01);
}

}  // namespace ekf_test
}  // namespace tilt_ropter
