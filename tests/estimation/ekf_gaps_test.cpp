// Gaps of the IMU, and clocks that are set back.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>

#include "support/ekf_flights.hpp"
#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>

namespace tilt_ropter {
namespace ekf_gaps_test {

using Eigen::Vector3d;
using test_support::Errors;
using test_support::errors;
using test_support::expect_good;
using test_support::Flight;
using test_support::fly;
using test_support::imu_period;
using test_support::Log;
using test_support::normal_vector;
using test_support::Random;
using test_support::record;

TEST(EkfGaps, RestartsAtNextPoseAfterImuGapAndKeepsBiases) {
  Random random(213);
  const Flight flight(9, random.orientation());
  const Log log = record(flight, 40.0, 9, {}, random.vector(0.05), random.vector(0.3));
  Log before = log, after = log;
  const auto cut = [](auto& values, double from, double to) {
    values.erase(std::remove_if(values.begin(), values.end(),
                                [=](const auto& v) { return v.time < from || v.time > to; }),
                 values.end());
  };
  cut(before.imu, 0.0, 30.0);
  cut(before.poses, 0.0, 30.0);
  cut(after.imu, 30.5, 40.0);
  cut(after.poses, 30.52, 40.0);
  Ekfd ekf;
  fly(ekf, before);
  const InertialStated known = ekf.filter().state();
  const BodyStated frozen = ekf.state();
  EXPECT_EQ(ekf.on_imu(after.imu[0].time, after.imu[0].value), EkfStatus::stopped);
  EXPECT_FALSE(ekf.running());
  EXPECT_EQ(ekf.state().position, frozen.position);
  after.imu.erase(after.imu.begin());
  bool first = true;
  fly(ekf, after, 0.0, [&](std::size_t, EkfStatus status) {
    EXPECT_EQ(status, first ? EkfStatus::restarted : EkfStatus::updated);
    if (first) {
      EXPECT_LT((ekf.filter().state().gyro_bias - known.gyro_bias).norm(), 1e-9);
      EXPECT_LT((ekf.filter().state().accelerometer_bias - known.accelerometer_bias).norm(), 1e-9);
    }
    first = false;
  });
  EXPECT_EQ(ekf.counts().restarts, 1);
  expect_good(ekf, flight);
}

TEST(EkfGaps, RestartsIfTheClockIsSetBackAndTheVehicleIsElsewhere) {
  const Flight flight(10, Random(214).orientation());
  const Log log = record(flight, 20.0, 10);
  Log again = log;
  for (auto& s : again.imu) s.time -= 1e5;
  for (auto& p : again.poses) p.time -= 1e5;
  for (const bool wild : {false, true}) {  // wild: one stamp far in the future instead
    Ekfd ekf;
    fly(ekf, log);
    if (wild) {
      EXPECT_EQ(ekf.on_imu(1e300, log.imu[0].value), EkfStatus::stopped);
    }
    if (!wild) {  // a pose whose time the IMU never reaches
      EXPECT_EQ(ekf.on_pose(ekf.time() + 0.1, flight.pose(0.0)), EkfStatus::waiting);
    }
    const long room = static_cast<long>(Ekfd::max_waiting);
    int late = 0, stopped = 0;
    for (const auto& s : again.imu) {
      const EkfStatus status = ekf.on_imu(s.time, s.value);
      if (status == EkfStatus::late) ++late;
      if (status == EkfStatus::stopped) ++stopped;
      ekf.on_pose(s.time, flight.pose(s.time + 1e5));
    }
    EXPECT_EQ(late, 4);
    EXPECT_EQ(stopped, wild ? 1 : 0);
    EXPECT_EQ(ekf.counts().restarts, 1);
    EXPECT_TRUE(ekf.running());
    long waiting = 0;
    for (int i = 1; i <= 50; ++i)
      if (ekf.on_pose(ekf.time() + 1e-3 * i, flight.pose(0.0)) == EkfStatus::waiting) ++waiting;
    EXPECT_EQ(waiting, room);
    EXPECT_LT((ekf.state().position - flight.state(ekf.time() + 1e5).position).norm(), 0.01);
  }
}

// Without poses nothing would restart the filter.
TEST(EkfGaps, GoesOnWithoutPosesAfterTheClockWasSetBack) {
  const Flight flight(10, Random(216).orientation());
  const Log log = record(flight, 20.5, 10);
  Ekfd ekf, undisturbed;
  double back = 0.0;
  for (std::size_t i = 0, pose = 0; i < log.imu.size(); ++i) {
    const double time = log.imu[i].time;
    if (time > 20.2) back = -1e3;
    (void)ekf.on_imu(time + back, log.imu[i].value);
    (void)undisturbed.on_imu(time, log.imu[i].value);
    for (; pose < log.poses.size() && log.poses[pose].time <= std::min(time, 20.0); ++pose)
      for (Ekfd* filter : {&ekf, &undisturbed})
        (void)filter->on_pose(log.poses[pose].time, log.poses[pose].value);
    EXPECT_TRUE(!undisturbed.running() || ekf.running());
  }
  EXPECT_EQ(ekf.counts().restarts, 0);
  // The first sample after the step has no duration.
  EXPECT_LT((ekf.state().position - undisturbed.state().position).norm(), 0.02);
  EXPECT_LT((ekf.state().velocity - undisturbed.state().velocity).norm(), 0.05);
  // The pose is as old as it was.
  const double now = log.imu.back().time;
  const EstimateTrust trust = ekf.trust(now + back), same = undisturbed.trust(now);
  EXPECT_NEAR(trust.age_of(MeasurementKind::pose), same.age_of(MeasurementKind::pose), 0.01);
  EXPECT_EQ(trust.state, same.state);
}

// A flight with an antenna and a compass only, in which the IMU is silent from 10 s on for `gap`
// [s]. If `wild`, one sample has a wrong stamp instead.
struct WithoutPoses {
  explicit WithoutPoses(unsigned seed, double gap, bool wild = false) : flight(seed) {
    const Log log = record(flight, 20.0, seed);
    Random random(seed + 7);
    for (std::size_t i = 0; i < log.imu.size(); ++i) {
      const double t = log.imu[i].time;
      if (t > 10.0 && t < 10.0 + gap - 1e-9) continue;
      ekf.on_imu(wild && i == 2000 ? 1e6 : t, log.imu[i].value);
      const InertialStated truth = log.truth[i];
      if (i == 0) {
        BodyStated start;
        start.position = truth.position;
        start.velocity = truth.velocity;
        start.orientation = truth.orientation;
        EXPECT_TRUE(ekf.start(start, {0.1, 0.1, 0.02}));
      }
      if (t > 10.0) stopped += ekf.running() ? 0 : 1;
      worst = std::max(worst, t > 10.0 && ekf.running() ? errors(ekf, flight).position : 0.0);
      if (i % 10 != 5) continue;
      const double stddev = 0.05;
      PositionMeasurement<double> position;
      position.position = truth.position + normal_vector(random, stddev);
      position.covariance = stddev * stddev * Eigen::Matrix3d::Identity();
      ekf.on_measurement(t, position);
      WorldVelocityMeasurement<double> velocity;
      velocity.velocity = truth.velocity + normal_vector(random, stddev);
      velocity.covariance = position.covariance;
      ekf.on_measurement(t, velocity);
      ekf.on_measurement(
          t, HeadingMeasurement<double>{yaw_of(truth.orientation) + random.normal(0.02), 0.02});
    }
  }

  Flight flight;
  Ekfd ekf;
  int stopped = 0;     // samples after the gap without an estimate
  double worst = 0.0;  // position error after the gap [m]
};

TEST(EkfGaps, GoesOnWithoutPosesAfterAShortGap) {
  for (unsigned seed = 0; seed < 25; ++seed)
    for (const double gap : {0.12, 0.25, 0.39}) {
      SCOPED_TRACE(gap);
      const WithoutPoses f(seed, gap);
      EXPECT_LE(f.stopped, 10);  // until the next measurement
      EXPECT_LT(f.worst, 0.5);
      const Errors e = errors(f.ekf, f.flight);
      EXPECT_LT(e.position, 0.1);
      EXPECT_LT(e.velocity, 0.15);
      EXPECT_LT(e.orientation, 0.05);
      EXPECT_EQ(f.ekf.trust(f.ekf.time()).state, EstimateState::good);
    }
}

// The attitude is lost after a long gap. Without poses only the user can start the filter again.
TEST(EkfGaps, StaysStoppedWithoutPosesAfterALongGap) {
  const WithoutPoses f(1, 0.5);
  EXPECT_FALSE(f.ekf.running());
  EXPECT_EQ(f.ekf.trust(f.ekf.time()).state, EstimateState::lost);
  EXPECT_TRUE(f.ekf.trust(f.ekf.time()).imu_stopped);
}

TEST(EkfGaps, RestartsAtAPoseElsewhereAfterABridgedGap) {
  WithoutPoses f(3, 0.25);
  const MarkerPosed truth = f.flight.pose(f.ekf.time());
  const double time = f.ekf.time();
  MarkerPosed aside = truth;
  aside.position.x() += 2.0;
  EXPECT_EQ(f.ekf.on_pose(time, aside), EkfStatus::restarted);
  f.ekf.on_imu(time + imu_period, {});
  EXPECT_EQ(f.ekf.on_pose(time + imu_period, truth), EkfStatus::gated);
}

TEST(EkfGaps, OneWrongStampIsAShortGap) {
  const WithoutPoses f(2, 0.0, true);
  EXPECT_LE(f.stopped, 15);
  EXPECT_LT(f.worst, 0.5);
  EXPECT_LT(errors(f.ekf, f.flight).position, 0.1);
  EXPECT_EQ(f.ekf.trust(f.ekf.time()).state, EstimateState::good);
}

}  // namespace ekf_gaps_test
}  // namespace tilt_ropter
