// Restarts: after a long time without poses, when the attitude is too uncertain for an update of
// the filter, at the next pose; at a given state; and after a reset.

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
namespace ekf_restart_test {

using Eigen::Vector3d;
using test_support::Errors;
using test_support::expect_good;
using test_support::Flight;
using test_support::fly;
using test_support::imu_period;
using test_support::Log;
using test_support::Random;
using test_support::record;
using test_support::same;

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
  for (double t = time + imu_period; t < time + 1.1; t += imu_period) {
    ekf.on_imu(t, flight.imu(t));
    EXPECT_EQ(ekf.on_pose(t, flight.pose(t)), EkfStatus::updated);
    const EstimateState state = ekf.trust(t).state;
    if (t > time + 0.5) {  // the velocity is known, but the restart is not a second ago
      EXPECT_EQ(state, t < time + 1.0 ? EstimateState::degraded : EstimateState::good) << t - time;
    }
  }
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

TEST(EkfRestart, StartsAtAGivenStateAtOnce) {
  const Flight flight(16, Random(219).orientation());
  const Log log = record(flight, 4.0, 16);
  Ekfd ekf;
  fly(ekf, log);
  BodyStated elsewhere = ekf.state();
  elsewhere.position.x() += 20.0;
  ASSERT_TRUE(ekf.start(elsewhere, {0.1, 0.1, 0.1}));
  EXPECT_LT((ekf.state().position - elsewhere.position).norm(), 1e-9);
  EXPECT_LT((ekf.state().velocity - elsewhere.velocity).norm(), 1e-9);
}

// Two filters get the same flight from the start: a new one, and one that was reset after late
// samples, and poses that repeat or are elsewhere.
TEST(EkfRestart, IsLikeNewAfterAReset) {
  const Log log = record(Flight(17, Random(220).orientation()), 4.0, 17);
  Log bad = record(Flight(18, Random(221).orientation()), 6.0, 18);
  const MarkerPosed last = bad.poses.back().value;
  for (auto& pose : bad.poses) {
    if (pose.time > 4.0) pose.value.position.x() += 1.0;
    if (pose.time > 5.0) pose.value = last;
  }
  Ekfd used, fresh;
  fly(used, bad, 0.06);
  for (int i = 0; i < 3; ++i) used.on_imu(5.9 + 0.005 * i, bad.imu.back().value);
  EXPECT_TRUE(used.trust(6.0).poses_frozen);
  used.reset();
  const auto expect_same = [&](double now) {
    EXPECT_TRUE(same(used, fresh)) << now;
    EXPECT_EQ(used.running(), fresh.running()) << now;
    const EstimateTrust a = used.trust(now), b = fresh.trust(now);
    EXPECT_EQ(a.state, b.state) << now;
    EXPECT_EQ(a.age, b.age) << now;
    EXPECT_EQ(a.position_stddev, b.position_stddev) << now;
    EXPECT_EQ(a.poses_frozen, b.poses_frozen) << now;
    EXPECT_EQ(a.poses_gated, b.poses_gated) << now;
    EXPECT_EQ(a.poses_mistimed, b.poses_mistimed) << now;
    EXPECT_EQ(a.unconfirmed, b.unconfirmed) << now;
  };
  const auto both = [&](const auto& call) {
    call(used);
    call(fresh);
  };
  EXPECT_EQ(used.trust(0.0).state, EstimateState::starting);
  EXPECT_FALSE(fresh.trust(0.0).poses_frozen);
  both([&](Ekfd& ekf) { ekf.on_imu(-0.005, log.imu[0].value); });
  both([](Ekfd& ekf) { EXPECT_TRUE(ekf.start({}, {1.0, 1.0, 1.0})); });
  expect_same(0.0);
  both([&](Ekfd& ekf) { fly(ekf, log); });
  expect_same(4.0);
  EXPECT_EQ(used.counts().used, fresh.counts().used);
  EXPECT_EQ(used.counts().gated, fresh.counts().gated);
  EXPECT_EQ(used.counts().unused, fresh.counts().unused);
}

}  // namespace ekf_restart_test
}  // namespace tilt_ropter
