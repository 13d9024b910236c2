// What the filter returns: mean rates since the last tick, and measurements without biases.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>

#include "support/ekf_flights.hpp"
#include "support/flights.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <limits>

namespace tilt_ropter {
namespace ekf_outputs_test {

using test_support::Flight;
using test_support::Log;
using test_support::record;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

TEST(Ekf, TakeStateReturnsMeanRateSinceLastCall) {
  Ekfd ekf;
  const Eigen::Vector3d level(0.0, 0.0, gravity);
  const auto sample = [&](int i, double rate) {
    return ekf.on_imu(0.001 * i, {Eigen::Vector3d(0.0, 0.0, rate), level});
  };
  EXPECT_EQ(ekf.take_state().angular_velocity.z(), 0.0);  // no sample yet
  (void)sample(0, 0.3);
  ekf.on_pose(0.0, {Eigen::Vector3d::Zero(), Eigen::Quaterniond::Identity()});
  ASSERT_TRUE(ekf.running());
  EXPECT_DOUBLE_EQ(ekf.take_state().angular_velocity.z(), 0.3);
  EXPECT_DOUBLE_EQ(ekf.take_state().angular_velocity.z(), 0.3);  // no new sample: as state()
  // Vibration of a rotor with the period of the tick: a single sample always has the same phase.
  for (int i = 1; i <= 100; ++i) {
    (void)sample(i, 0.1 + 0.2 * std::sin(2.0 * pi * (i + 2) / 10.0));
    if (i % 10 != 0) continue;
    EXPECT_GT(ekf.state().angular_velocity.z(), 0.25);
    const BodyStated taken = ekf.take_state();
    EXPECT_NEAR(taken.angular_velocity.z(), 0.1, 1e-12);
    EXPECT_EQ(taken.position, ekf.state().position);
  }
  (void)sample(101, nan);
  (void)sample(102, 0.7);
  EXPECT_DOUBLE_EQ(ekf.take_state().angular_velocity.z(), 0.7);
  (void)sample(103, 5.0);
  (void)sample(10000, 0.4);  // after a gap
  EXPECT_DOUBLE_EQ(ekf.take_state().angular_velocity.z(), 0.4);
}

TEST(Ekf, SaysThatThePositionsAreMistimed) {
  Ekfd ekf;
  const Eigen::Vector3d level(0.0, 0.0, gravity);
  const MarkerPosed pose{Eigen::Vector3d::Zero(), Eigen::Quaterniond::Identity()};
  for (int i = 0; i <= 2000; ++i) {
    (void)ekf.on_imu(0.001 * i, {Eigen::Vector3d::Zero(), level});
    if (i % 10 == 0) (void)ekf.on_pose(0.001 * i, pose);
  }
  EXPECT_FALSE(ekf.trust(2.0).poses_mistimed);
  (void)ekf.on_measurement(1.2, PositionMeasurement<double>{});
  EXPECT_TRUE(ekf.trust(2.0).poses_mistimed);
  (void)ekf.on_pose(2.0005, pose);
  (void)ekf.on_imu(2.001, {Eigen::Vector3d::Zero(), level});
  EXPECT_FALSE(ekf.trust(2.001).poses_mistimed);
}

TEST(Ekf, SubtractsBiasesFromRatesAndSamples) {
  const Eigen::Vector3d gyro_bias(0.02, -0.01, 0.03), accelerometer_bias(0.1, -0.2, 0.15);
  const Flight flight(5);
  const Log log = record(flight, 20.0, 5, {}, gyro_bias, accelerometer_bias);
  Ekfd ekf;
  std::size_t pose = 0;
  for (const auto& s : log.imu) {
    ekf.on_imu(s.time, s.value);
    while (pose < log.poses.size() && log.poses[pose].time <= s.time) {
      ekf.on_pose(log.poses[pose].time, log.poses[pose].value);
      ++pose;
    }
  }
  const InertialStated& x = ekf.filter().state();
  EXPECT_LT((x.gyro_bias - gyro_bias).norm(), 0.01);
  const InertialSampled raw{Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d(4.0, 5.0, 6.0)};
  const InertialSampled corrected = ekf.corrected(raw);
  EXPECT_EQ(corrected.angular_velocity, raw.angular_velocity - x.gyro_bias);
  EXPECT_EQ(corrected.specific_force, raw.specific_force - x.accelerometer_bias);
  EXPECT_LT((ekf.take_state().angular_velocity - ekf.state().angular_velocity).norm(), 20.0);
}

}  // namespace ekf_outputs_test
}  // namespace tilt_ropter
