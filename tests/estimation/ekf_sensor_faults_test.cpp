// Poses and stamps that lie: the estimate stays near the truth, and the filter says when it cannot.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include "support/level_circle.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <functional>
#include <vector>

namespace tilt_ropter {
namespace ekf_sensor_faults_test {

using Eigen::Vector3d;
using Circle = test_support::LevelCircle;

struct Outcome {
  double position = 0.0, velocity = 0.0;  // largest errors after the first two seconds
  double at_end = 0.0;                    // position error at the end
  std::vector<EstimateState> states;      // every 10 ms
  EkfCounts counts;
};

// Flies `duration` [s] with an IMU at 1 kHz and poses at 100 Hz, 20 ms late.
Outcome fly(const Circle& circle, double duration, const std::vector<SensorFault>& faults,
            EkfSettings settings = {}, double imu_start = 0.0) {
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 1000.0;
  imu_parameters.gyro_bias << 0.01, -0.02, 0.015;
  imu_parameters.accelerometer_bias << 0.05, -0.08, 0.1;
  ImuSensor imu(imu_parameters, 1);
  PoseSensorParameters pose_parameters;
  pose_parameters.delay = 0.02;
  pose_parameters.position_noise = 1e-3;
  pose_parameters.orientation_noise = 3e-3;
  PoseSensor poses(pose_parameters, 2);
  for (const SensorFault& fault : faults) {
    imu.add_fault(fault);
    poses.add_fault(fault);
  }
  settings.pose_noise = {1e-3, 3e-3};
  Ekfd ekf(settings);
  Outcome outcome;
  for (int i = 0; i <= static_cast<int>(duration * 1000.0); ++i) {
    const double t = imu_start + 1e-3 * i;
    const BodyStated truth = circle.body(t);
    if (const auto m = imu.sample(t, truth.angular_velocity, circle.specific_force(t)))
      ekf.on_imu(m->time, *m);
    if (const auto m = poses.sample(t, truth)) ekf.on_pose(m->time, *m);
    EXPECT_TRUE(is_finite(ekf.state()));
    if (i % 10 == 9) outcome.states.push_back(ekf.trust(ekf.time()).state);
    outcome.at_end = (ekf.state().position - truth.position).norm();
    if (i < 2000) continue;
    outcome.position = std::max(outcome.position, outcome.at_end);
    outcome.velocity = std::max(outcome.velocity, (ekf.state().velocity - truth.velocity).norm());
  }
  outcome.counts = ekf.counts();
  return outcome;
}

constexpr std::size_t state_at(double time) {
  return static_cast<std::size_t>(time * 100.0);
}

SensorFault fault(SensorFaultKind kind, double start, double duration, double size = 0.0) {
  SensorFault f;
  f.kind = kind;
  f.start = start;
  f.duration = duration;
  f.size = size;
  return f;
}

using Kind = SensorFaultKind;

TEST(EkfSensorFaults, FrozenPosesAreNotUsedAndReported) {
  for (const double duration : {0.3, 0.5, 1.0, 2.0, 5.0}) {
    const Outcome o = fly({}, 15.0, {fault(Kind::pose_freeze, 8.0, duration)});
    EXPECT_EQ(o.counts.restarts, 0) << duration;
    EXPECT_NEAR(static_cast<double>(o.counts.frozen), 100.0 * duration, 1.5);
    if (duration < 4.0) {
      EXPECT_LT(o.position, 0.15) << duration;
    }
    EXPECT_LT(o.position, 0.6) << duration;
    EXPECT_EQ(o.states[state_at(7.9)], EstimateState::good);
    EXPECT_NE(o.states[state_at(8.13)], EstimateState::good) << duration;  // 20 ms of them delay
    EXPECT_LT(o.at_end, 0.01);
    EXPECT_EQ(o.states.back(), EstimateState::good);
  }
}

// A pose that is frozen except for its noise looks alive. It does not move like the IMU.
TEST(EkfSensorFaults, PosesOfAnotherObjectAreNotFollowed) {
  for (const double size : {0.0, 3.0}) {
    const Outcome o = fly({}, 15.0, {fault(Kind::pose_ghost, 8.0, 2.0, size)});
    EXPECT_EQ(o.counts.restarts, 0);
    EXPECT_LT(o.position, 0.15);
    EXPECT_NE(o.states[state_at(8.13)], EstimateState::good);
    EXPECT_LT(o.at_end, 0.01);
  }
}

// The covariance grows until the gate takes any pose. Only poses that come back are used again.
TEST(EkfSensorFaults, PosesOfAnotherObjectAreNeverFollowed) {
  for (const double size : {0.0, 0.5, 3.0}) {
    const Outcome for_good = fly({}, 28.0, {fault(Kind::pose_ghost, 8.0, 20.0, size)});
    EXPECT_EQ(for_good.counts.restarts, 0) << size;
    EXPECT_LT(for_good.counts.used, 850) << size;  // those on the path of the object
    EXPECT_LT(for_good.position, 5.0) << size;     // by the IMU alone, for 20 s
    EXPECT_NE(for_good.states.back(), EstimateState::good);
    const Outcome back = fly({}, 20.0, {fault(Kind::pose_ghost, 8.0, 8.0, size)});
    EXPECT_LE(back.counts.restarts, 1) << size;
    EXPECT_LT(back.at_end, 0.01) << size;
    EXPECT_EQ(back.states.back(), EstimateState::good);
  }
}

TEST(EkfSensorFaults, JumpsThatEndAreIgnored) {
  for (const double size : {0.05, 0.2, 0.5})
    for (const double duration : {0.1, 0.5, 0.9}) {
      const Outcome o = fly({}, 12.0, {fault(Kind::pose_jump, 8.0, duration, size)});
      EXPECT_EQ(o.counts.restarts, 0) << size << ' ' << duration;
      // The gate opens for 5 cm after 0.9 s, because the predicted error has grown.
      EXPECT_LT(o.position, size > 0.1 ? 0.05 : 0.07) << size << ' ' << duration;
      EXPECT_LT(o.velocity, 0.1);
    }
}

// The origin of motion capture was moved: position follows, velocity is not disturbed.
TEST(EkfSensorFaults, JumpThatStaysMovesPositionOnly) {
  for (const double size : {0.05, 0.2, 0.5}) {
    const Outcome o = fly({}, 14.0, {fault(Kind::pose_jump, 8.0, 100.0, size)});
    EXPECT_EQ(o.counts.restarts, size > 0.1 ? 1 : 0);  // the gate opens for 5 cm
    EXPECT_LT(o.velocity, 0.1) << size;
    EXPECT_NEAR(o.at_end, size, 0.01);
    EXPECT_EQ(o.states[state_at(10.0)], EstimateState::good);
  }
}

TEST(EkfSensorFaults, StampJitterIsMeasuredAndTolerated) {
  const Circle fast{6.0, 3.0};
  const Outcome o = fly(fast, 30.0, {fault(Kind::pose_jitter, 3.0, 100.0, 4e-3)});
  EXPECT_EQ(o.counts.restarts, 0);
  EXPECT_LT(o.position, 0.05);
  EXPECT_LT(o.velocity, 0.15);
  EXPECT_EQ(o.states.back(), EstimateState::good);
  // Jitter beyond the period of 10 ms: most poses are late or gated, but they are no other
  // object.
  const Outcome wild = fly({}, 30.0, {fault(Kind::pose_jitter, 5.0, 25.0, 0.015)});
  EXPECT_EQ(wild.counts.restarts, 0);
  EXPECT_LT(wild.position, 0.5);
}

TEST(EkfSensorFaults, ClockStepsAreCorrected) {
  for (const double size : {1.0, -1.0}) {
    const Outcome poses = fly({}, 14.0, {fault(Kind::pose_clock_step, 8.0, 100.0, size)});
    EXPECT_EQ(poses.counts.clock_steps, 1) << size;
    EXPECT_EQ(poses.counts.restarts, 0) << size;
    EXPECT_LT(poses.position, 0.05) << size;
    EXPECT_LT(poses.at_end, 0.01) << size;
    // Both clocks step, as one computer's clock does.
    const Outcome both = fly({}, 14.0,
                             {fault(Kind::pose_clock_step, 8.0, 100.0, size),
                              fault(Kind::imu_clock_step, 8.0, 100.0, size)});
    EXPECT_LT(both.position, 0.15) << size;
    EXPECT_LT(both.at_end, 0.01) << size;
    const Outcome imu = fly({}, 14.0, {fault(Kind::imu_clock_step, 8.0, 100.0, size)});
    EXPECT_LT(imu.at_end, 0.01) << size;
  }
}

TEST(EkfSensorFaults, StartsAtTenMetresPerSecond) {
  const Circle fast{20.0, 10.0};
  const Outcome o = fly(fast, 5.0, {});
  EXPECT_EQ(o.counts.restarts, 0);
  EXPECT_EQ(o.states[0], EstimateState::starting);  // no pose has arrived
  EXPECT_EQ(o.states[20], EstimateState::good);
  EXPECT_LT(o.position, 0.02);
  EXPECT_LT(o.velocity, 0.1);
}

TEST(EkfSensorFaults, ShortSilenceOfTheImuKeepsVelocity) {
  for (const double duration : {0.05, 0.2, 0.3}) {
    const Outcome o = fly({}, 12.0, {fault(Kind::imu_dropout, 8.0, duration)});
    EXPECT_EQ(o.counts.restarts, duration > 0.1 ? 1 : 0);
    EXPECT_LT(o.at_end, 0.01);
    EXPECT_EQ(o.states.back(), EstimateState::good);
  }
}

TEST(EkfSensorFaults, StartsAgainSoonAfterWrongFirstPoses) {
  const Outcome o = fly({}, 6.0, {fault(Kind::pose_ghost, 0.0, 0.1, 5.0)});
  EXPECT_EQ(o.counts.restarts, 1);
  EXPECT_LT(o.position, 0.02);
}

TEST(EkfSensorFaults, TrustNamesReasons) {
  Ekfd ekf;
  EXPECT_EQ(ekf.trust(0.0).state, EstimateState::starting);
  EXPECT_TRUE(std::isinf(ekf.trust(0.0).imu_age));
  const Circle circle;
  test_support::Random random(5);
  double t = 0.0;
  const auto fly_to = [&](double end, bool with_poses, const Vector3d& off) {
    for (; t < end; t += 0.005) {
      ekf.on_imu(t, {random.vector(0.001), circle.specific_force(t) + random.vector(0.01)});
      const BodyStated b = circle.body(t);
      if (with_poses) ekf.on_pose(t, {b.position + off + random.vector(1e-3), b.orientation});
    }
  };
  fly_to(5.0, true, Vector3d::Zero());
  EstimateTrust trust = ekf.trust(t);
  EXPECT_EQ(trust.state, EstimateState::good);
  EXPECT_LT(trust.age_of(MeasurementKind::pose), 0.02);
  EXPECT_TRUE(std::isinf(trust.age_of(MeasurementKind::position)));
  EXPECT_LT(trust.position_stddev, 0.01);

  EXPECT_EQ(ekf.trust(t + 0.09).state, EstimateState::lost);  // the IMU is silent
  EXPECT_TRUE(ekf.trust(t + 0.09).imu_silent);

  fly_to(5.2, true, Vector3d(1.0, 0.0, 0.0));
  trust = ekf.trust(t);
  EXPECT_TRUE(trust.poses_gated);
  EXPECT_TRUE(trust.no_position);
  EXPECT_EQ(trust.state, EstimateState::dead_reckoning);
  fly_to(30.0, false, Vector3d::Zero());
  trust = ekf.trust(t);
  EXPECT_TRUE(trust.position_error);
  EXPECT_EQ(trust.state, EstimateState::position_lost);
  EXPECT_STREQ(to_string(trust.state), "position_lost");
  fly_to(400.0, false, Vector3d::Zero());
  EXPECT_TRUE(ekf.trust(t).orientation_error);
  EXPECT_EQ(ekf.trust(t).state, EstimateState::lost);
}

// Without poses the state passes good, dead reckoning, degraded and lost in this order, and the
// error stays below three predicted standard deviations.
TEST(EkfSensorFaults, PredictedErrorCoversDeadReckoning) {
  const Outcome o = fly({}, 20.0, {fault(Kind::pose_dropout, 8.0, 100.0)});
  EXPECT_LT(o.position, 5.0);
  EXPECT_EQ(o.states[state_at(8.5)], EstimateState::dead_reckoning);
  EXPECT_EQ(o.states.back(), EstimateState::position_lost);
  EXPECT_TRUE(std::is_sorted(o.states.begin() + 300, o.states.end()));
}

TEST(EkfSensorFaults, ImuBesideTheComGivesStateAndForceOfTheCom) {
  const Vector3d lever(0.1, -0.05, 0.03);
  const Eigen::Quaterniond mounting = quaternion_exp(Vector3d(0.3, -0.2, 1.0));
  EkfSettings settings;
  settings.imu_position = lever;
  settings.imu_orientation = mounting;
  Ekfd ekf(settings), at_com;
  test_support::Random random(7);
  // Rotation about z and x, CoM on a circle.
  const Circle circle{2.0, 1.0};
  double worst_position = 0.0, worst_velocity = 0.0, worst_ignored = 0.0;
  Vector3d mean_force_error = Vector3d::Zero();
  Eigen::Quaterniond q = Eigen::Quaterniond::Identity();
  const auto rate = [](double t) {
    return Vector3d(1.5 * std::cos(2.0 * t), std::sin(3.0 * t), 1.0 + std::sin(t));
  };
  const auto rate_change = [](double t) {
    return Vector3d(-3.0 * std::sin(2.0 * t), 3.0 * std::cos(3.0 * t), std::cos(t));
  };
  int count = 0;
  for (int i = 0; i < 8000; ++i) {
    const double t = 1e-3 * i;
    const Vector3d w = rate(t);
    const Vector3d com = q.conjugate() * circle.specific_force(t);
    const Vector3d force = com + rate_change(t).cross(lever) + w.cross(w.cross(lever));
    const InertialSampled raw{mounting.conjugate() * w, mounting.conjugate() * force};
    ekf.on_imu(t, raw);
    at_com.on_imu(t, raw);
    const BodyStated truth = circle.body(t);
    if (i % 10 == 0) {
      const MarkerPosed pose{truth.position + random.vector(1e-3), q};
      ekf.on_pose(t, pose);
      at_com.on_pose(t, pose);
    }
    if (i > 4000) {
      const BodyStated b = ekf.state();
      worst_position = std::max(worst_position, (b.position - truth.position).norm());
      worst_velocity = std::max(worst_velocity, (b.velocity - truth.velocity).norm());
      EXPECT_LT((b.angular_velocity - w).norm(), 0.02);
      mean_force_error += ekf.corrected(raw).specific_force - com;
      worst_ignored = std::max(worst_ignored, (at_com.state().velocity - truth.velocity).norm());
      ++count;
    }
    const Vector3d middle = rate(t + 0.5e-3);
    q = (q * quaternion_exp(Vector3d(middle * 1e-3))).normalized();
  }
  EXPECT_LT(worst_position, 0.005);
  EXPECT_LT(worst_velocity, 0.03);
  EXPECT_LT((mean_force_error / count).norm(), 0.03);
  EXPECT_GT(worst_ignored, 0.1);
}

}  // namespace ekf_sensor_faults_test
}  // namespace tilt_ropter
