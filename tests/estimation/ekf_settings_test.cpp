// Each setting acts.

#include <tilt_ropter/estimation/ekf.hpp>

#include "support/ekf_flights.hpp"
#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <cstddef>

namespace tilt_ropter {
namespace ekf_settings_test {

using test_support::errors;
using test_support::expect_good;
using test_support::Flight;
using test_support::fly;
using test_support::Log;
using test_support::Random;
using test_support::record;

// Standard deviations of the filter per part of the state: after the first pose and 2 s later.
struct Deviations {
  InertialTangentd at_start, later;
};

Deviations stddevs(const EkfSettings& s) {
  const Flight flight(15, Random(218).orientation());
  const Log log = record(flight, 2.0, 15);
  Ekfd ekf(s);
  Deviations d;
  fly(ekf, log, 0.0, [&](std::size_t i, EkfStatus) {
    if (i == 0) d.at_start = ekf.filter().covariance().diagonal().cwiseSqrt();
  });
  d.later = ekf.filter().covariance().diagonal().cwiseSqrt();
  return d;
}

TEST(EkfSettings, EachNoiseSettingActs) {
  const InertialTangentd usual = stddevs({}).later;
  const auto ratio = [&usual](const EkfSettings& s, int part) {
    return stddevs(s).later(part) / usual(part);
  };
  using I = InertialIndex;
  EkfSettings s;
  s.imu_noise.gyro_density *= 10.0;
  EXPECT_GT(ratio(s, I::orientation), 1.5);
  s = {};
  s.imu_noise.accelerometer_density *= 10.0;
  EXPECT_GT(ratio(s, I::velocity), 1.5);
  s = {};
  s.imu_noise.gyro_bias_walk *= 1000.0;
  EXPECT_GT(ratio(s, I::gyro_bias), 1.5);
  s = {};
  s.imu_noise.accelerometer_bias_walk *= 1000.0;
  EXPECT_GT(ratio(s, I::accelerometer_bias), 1.5);
  s = {};
  s.pose_noise.position *= 3.0;
  EXPECT_GT(ratio(s, I::position), 1.5);
  s = {};
  s.pose_noise.orientation *= 3.0;
  EXPECT_GT(ratio(s, I::orientation), 1.5);
}

TEST(EkfSettings, InitialStandardDeviationsMatchSettings) {
  using I = InertialIndex;
  EkfSettings s;
  s.velocity_stddev = 0.7;
  s.gyro_bias_stddev = 0.011;
  s.accelerometer_bias_stddev = 0.13;
  s.marker_position_stddev = 0.017;
  s.marker_orientation_stddev = 0.019;
  const InertialTangentd d = stddevs(s).at_start;
  EXPECT_NEAR(d(I::velocity), 0.7, 1e-12);
  EXPECT_NEAR(d(I::gyro_bias), 0.011, 1e-12);
  EXPECT_NEAR(d(I::accelerometer_bias), 0.13, 1e-12);
  EXPECT_NEAR(d(I::marker_position), 0.017, 1e-5);
  EXPECT_NEAR(d(I::marker_orientation), 0.019, 1e-5);
  // The uncertainty of the marker frame adds to the uncertainty of the body's pose.
  EXPECT_NEAR(d(I::position), std::hypot(0.017, s.pose_noise.position), 1e-4);
  EXPECT_NEAR(d(I::orientation), std::hypot(0.019, s.pose_noise.orientation), 1e-4);
  const InertialTangentd known = stddevs({}).at_start;
  EXPECT_NEAR(known(I::position), EkfSettings().pose_noise.position, 1e-5);
  EXPECT_NEAR(known(I::orientation), EkfSettings().pose_noise.orientation, 1e-4);
  EXPECT_EQ(known.tail<6>(), (Eigen::Matrix<double, 6, 1>::Zero()));
}

TEST(EkfSettings, StartsWithGivenBiases) {
  EkfSettings s;
  s.gyro_bias << 0.01, -0.02, 0.03;
  s.accelerometer_bias << 0.1, 0.2, -0.3;
  s.gyro_bias_stddev = s.accelerometer_bias_stddev = 0.0;
  Ekfd filter(s);
  EXPECT_EQ(filter.filter().state().gyro_bias, s.gyro_bias);
  EXPECT_EQ(filter.filter().state().accelerometer_bias, s.accelerometer_bias);
  filter.on_imu(0.0, {});
  filter.on_pose(0.0, {});
  filter.on_imu(0.01, {});
  ASSERT_TRUE(filter.running());
  EXPECT_EQ(filter.filter().state().gyro_bias, s.gyro_bias);
  EXPECT_EQ(filter.filter().state().accelerometer_bias, s.accelerometer_bias);
}

TEST(EkfSettings, MarkerFrameIsApplied) {
  EkfSettings s;
  Random random(219);
  s.marker_position = random.vector(0.3);
  s.marker_orientation = random.orientation();
  const Flight flight(16, random.orientation(), s.marker_position, s.marker_orientation);
  const Log log = record(flight, 10.0, 16);
  Ekfd ekf(s), without;
  fly(ekf, log);
  fly(without, log);
  expect_good(ekf, flight);
  EXPECT_EQ(ekf.filter().state().marker_position, s.marker_position);
  EXPECT_GT(errors(without, flight).orientation, 0.1);
  EXPECT_GT(errors(without, flight).position, 0.1);
}

TEST(EkfSettings, GateActsOnNis) {
  const Flight flight(17, Random(220).orientation());
  const Log log = record(flight, 10.0, 17);
  for (const double gate : {3.0, 6.0, 12.0, 27.9}) {
    EkfSettings s;
    s.gate = gate;
    s.max_rejections = 1000;
    Ekfd ekf(s);
    int gated = 0;
    fly(ekf, log, 0.0, [&](std::size_t i, EkfStatus status) {
      if (i > 0) {
        EXPECT_EQ(status, ekf.nis() > gate ? EkfStatus::gated : EkfStatus::updated);
      }
      if (status == EkfStatus::gated) ++gated;
    });
    if (gate < 10.0) {
      EXPECT_GT(gated, 100);
    }
    if (gate > 20.0) {
      EXPECT_LT(gated, 5);
    }
  }
}

TEST(EkfSettings, RestartsAfterMaxRejectionsInARow) {
  const Flight flight(18, Random(221).orientation());
  for (const int most : {1, 2, 7}) {
    EkfSettings s;
    s.max_rejections = most;
    s.restart_time = 0.0;
    s.restart_distance = 10.0;  // so soon no motion confirms the poses
    Ekfd ekf(s);
    fly(ekf, record(flight, 5.0, 18));
    const auto far = [&](int i) {  // the origin of motion capture is 7 m higher
      const double t = 5.0 + 0.005 * i;
      ekf.on_imu(t, flight.imu(t));
      MarkerPosed pose = flight.pose(t);
      pose.position.z() += 7.0;
      return ekf.on_pose(t, pose);
    };
    for (int i = 1; i < most; ++i) EXPECT_EQ(far(i), EkfStatus::gated);
    if (most > 1) {  // a consistent pose resets the count
      const double t = 5.0 + 0.005 * most;
      ekf.on_imu(t, flight.imu(t));
      EXPECT_EQ(ekf.on_pose(t, flight.pose(t)), EkfStatus::updated);
      for (int i = 1; i < most; ++i) EXPECT_EQ(far(most + i), EkfStatus::gated);
    }
    EXPECT_EQ(far(2 * most), EkfStatus::restarted);
    EXPECT_NEAR(ekf.state().position.z(), flight.state(ekf.time()).position.z() + 7.0, 0.01);
  }
}

TEST(EkfSettings, RestartTimeBoundsJumpsThatAreIgnored) {
  const Flight flight(18, Random(221).orientation());
  for (const double time : {0.3, 1.0}) {
    EkfSettings s;
    s.restart_time = time;
    Log log = record(flight, 8.0, 18);
    for (auto& p : log.poses)
      if (p.time > 4.0) p.value.position.x() += 1.0;
    double restart = 0.0;
    Ekfd ekf(s);
    fly(ekf, log, 0.0, [&](std::size_t i, EkfStatus status) {
      if (status == EkfStatus::restarted) restart = log.poses[i].time;
    });
    EXPECT_NEAR(restart, 4.01 + time, 0.015);
    EXPECT_EQ(ekf.counts().restarts, 1);
  }
}

// Poses that do not move like the IMU are used only when nothing else is left.
TEST(EkfSettings, FullRestartTimeBoundsDeadReckoningBesidePoses) {
  const Flight flight(18, Random(221).orientation()), other(21);
  for (const double time : {2.0, 4.0}) {
    EkfSettings s;
    s.full_restart_time = time;
    Log log = record(flight, 12.0, 18);
    for (auto& p : log.poses)
      if (p.time > 4.0) {
        p.value = other.pose(p.time);
        p.value.position.x() += 3.0;
      }
    double restart = 0.0;
    Ekfd ekf(s);
    fly(ekf, log, 0.0, [&](std::size_t i, EkfStatus status) {
      if (status == EkfStatus::restarted && restart == 0.0) restart = log.poses[i].time;
    });
    EXPECT_NEAR(restart, 4.0 + time, 0.015);
  }
}

TEST(EkfSettings, MaxDelayBoundsLateAndEarlyPoses) {
  const Flight flight(19, Random(222).orientation());
  for (const double most : {0.05, 0.3}) {
    EkfSettings s;
    s.max_delay = most;
    Ekfd ekf(s);
    ekf.on_imu(0.0, flight.imu(0.0));
    ekf.on_pose(0.0, flight.pose(0.0));
    for (int i = 1; i <= 200; ++i) ekf.on_imu(0.005 * i, flight.imu(0.005 * i));
    EXPECT_NEAR(ekf.filter_time(), 1.0 - most, 1e-12);
    const auto at = [&](double t) { return ekf.on_pose(t, flight.pose(t)); };
    EXPECT_EQ(at(1.0 - most - 1e-3), EkfStatus::late);
    EXPECT_EQ(at(1.0 - most + 1e-3), EkfStatus::updated);
    EXPECT_EQ(at(1.0 + most + 1e-3), EkfStatus::early);
    EXPECT_EQ(at(1.0 + most - 1e-3), EkfStatus::waiting);
  }
}

TEST(EkfSettings, MaxImuGapBoundsPausesOfTheImu) {
  const Flight flight(20, Random(223).orientation());
  for (const double most : {0.02, 0.5}) {
    EkfSettings s;
    s.max_imu_gap = most;
    Ekfd ekf(s);
    ekf.on_imu(0.0, flight.imu(0.0));
    EXPECT_EQ(ekf.on_imu(most * 0.99, flight.imu(most * 0.99)), EkfStatus::updated);
    EXPECT_EQ(ekf.on_imu(most * 2.01, flight.imu(most * 2.01)), EkfStatus::stopped);
  }
}

}  // namespace ekf_settings_test
}  // namespace tilt_ropter
