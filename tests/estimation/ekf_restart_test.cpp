// After a long time without poses the attitude is too uncertain for an update of the filter. It
// then restarts at the next pose.

#include <tilt_ropter/estimation/ekf.hpp>

#include "support/ekf_flights.hpp"
#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace tilt_ropter {
namespace {

using Eigen::Vector3d;
using test_support::Errors;
using test_support::expect_good;
using test_support::Flight;
using test_support::fly;
using test_support::imu_period;
using test_support::Log;
using test_support::Random;
using test_support::record;

constexpr double begin = 100.0;  // [s]; any time but zero

// A filter that uses some poses and is then without poses for a time.
class EkfSilence : public testing::Test {
 protected:
  // Returns the status of the first pose after `silence` [s].
  EkfStatus status_after(double silence, const EkfSettings& settings, int poses = 1) {
    ekf = Ekfd(settings);
    const int samples = poses + static_cast<int>(std::lround(silence / imu_period));
    for (int i = 0; i < samples; ++i) {
      time = begin + imu_period * i;
      ekf.on_imu(time, flight.imu(time));
      if (i < poses) ekf.on_pose(time, flight.pose(time));
    }
    attitude_stddev = ekf.trust(time).orientation_stddev;
    return ekf.on_pose(time, flight.pose(time));
  }

  const Flight flight{1};
  Ekfd ekf;
  double time = 0.0;
  double attitude_stddev = 0.0;  // before that pose [rad]
};

TEST_F(EkfSilence, RestartsIfTheStddevOfTheAttitudeIsAbove0_3Rad) {
  for (const double silence : {0.1, 2.5, 2.9, 3.1, 5.0}) {
    const EkfStatus status = status_after(silence, {});
    SCOPED_TRACE(attitude_stddev);
    EXPECT_EQ(status, attitude_stddev > 0.3 ? EkfStatus::restarted : EkfStatus::updated);
    EXPECT_EQ(ekf.counts().restarts, attitude_stddev > 0.3);
    EXPECT_TRUE(ekf.running());
    EXPECT_LT(ekf.trust(time).orientation_stddev, 0.006);  // the noise of a pose
  }
}

// The unknown acceleration acted since the last pose that was used.
TEST_F(EkfSilence, RestartKnowsTheVelocityFromTheLastUsedPose) {
  EkfSettings settings;
  settings.gyro_bias_stddev = 1.0;
  EXPECT_EQ(status_after(0.5, settings), EkfStatus::restarted);
  const EstimateTrust trust = ekf.trust(time);
  EXPECT_NEAR(trust.velocity_stddev, 0.5 + 10.0 * 0.5, 1e-9);
  EXPECT_EQ(trust.state, EstimateState::starting);  // until poses have confirmed it
  for (int i = 1; i <= 50; ++i) {
    const double t = time + imu_period * i;
    ekf.on_imu(t, flight.imu(t));
    EXPECT_EQ(ekf.on_pose(t, flight.pose(t)), EkfStatus::updated);
  }
  EXPECT_EQ(ekf.trust(ekf.time()).state, EstimateState::good);
}

// A restart is a new start also for a filter that many poses had confirmed.
TEST_F(EkfSilence, RestartNeedsToBeConfirmedAgain) {
  EkfSettings settings;
  settings.imu_noise.gyro_density = 0.5;
  EXPECT_EQ(status_after(1.0, settings, 40), EkfStatus::restarted);
  EXPECT_EQ(ekf.trust(time).state, EstimateState::starting);
}

// An unknown bias of the gyroscope turns the attitude by radians and moves the position by hundreds
// of metres. An update instead of a restart leaves errors of metres for seconds, although running()
// is true.
TEST(EkfRestart, RecoversWithin3sAfterTheAttitudeWasLost) {
  for (const unsigned seed : {2U, 9U}) {  // 22 m and 24 m with an update
    Random random(seed + 1);
    const Flight flight(seed, random.orientation());
    const Vector3d bias = 0.2 * random.vector(1.0).normalized();
    Log log = record(flight, 9.0, seed, {}, bias);
    log.poses.erase(std::remove_if(log.poses.begin() + 1, log.poses.end(),
                                   [](const auto& p) { return p.time < 6.0; }),
                    log.poses.end());
    Ekfd ekf;
    fly(ekf, log);
    EXPECT_EQ(ekf.counts().restarts, 1);
    SCOPED_TRACE(seed);
    expect_good(ekf, flight);
  }
}

}  // namespace
}  // namespace tilt_ropter
