// The filter finds the place of the IMU in the body from poses or from an antenna, if the places of
// marker and antenna are known.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>

#include "support/ekf_flights.hpp"
#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <functional>

namespace tilt_ropter {
namespace ekf_imu_position_test {

using Eigen::Vector3d;
using test_support::Flight;
using test_support::imu_period;
using test_support::NoisyImu;
using test_support::normal_vector;
using test_support::Random;

constexpr double place_stddev = 0.05;
const Vector3d marker(0.05, 0.02, 0.15), antenna(-0.1, 0.05, 0.2);

// The flight is that of the IMU. The body's origin is -place from there.
struct View {
  double time;
  InertialStated imu;
  Vector3d rate, place;
  Random& random;

  Vector3d position_of(const Vector3d& point) const {
    return imu.position + imu.orientation * Vector3d(point - place);
  }
  Vector3d velocity_of(const Vector3d& point) const {
    return imu.velocity + imu.orientation * Vector3d(rate.cross(point - place));
  }
};

struct Found {
  double place_nees = 0.0, body_nees = 0.0;  // means of e' P^-1 e over the runs
  double place = 0.0, body = 0.0;            // largest errors at the end [m]
  double given = 0.0;                        // largest error of the given place [m]
};

EkfSettings unknown_place() {
  EkfSettings s;
  s.imu_noise.gyro_bias_walk = 2e-4;
  s.imu_noise.accelerometer_bias_walk = 3e-3;
  s.gyro_bias_stddev = 0.02;
  s.accelerometer_bias_stddev = 0.1;
  s.imu_position << 0.03, -0.02, 0.01;
  s.imu_position_stddev = place_stddev;
  s.marker_position = marker;
  return s;
}

// `sense` is called every IMU sample and passes measurements to the filter.
Found fly(int runs, const std::function<void(const View&, int, Ekfd&)>& sense) {
  Found found;
  const EkfSettings s = unknown_place();
  for (int run = 0; run < runs; ++run) {
    const auto seed = static_cast<unsigned>(run);
    Random random(seed + 500);
    const Vector3d place = s.imu_position + normal_vector(random, place_stddev);
    const Flight flight(seed);
    NoisyImu imu(flight, s.imu_noise, imu_period, seed, normal_vector(random, s.gyro_bias_stddev),
                 normal_vector(random, s.accelerometer_bias_stddev));
    Ekfd ekf(s);
    for (int i = 0; i <= 5000; ++i) {
      const double t = imu_period * i;
      ekf.on_imu(t, imu(t));
      sense({t, flight.state(t), flight.imu(t).angular_velocity, place, random}, i, ekf);
    }
    using I = InertialIndex;
    const double end = ekf.filter_time();
    const Vector3d error = ekf.imu_position() - place;
    const Eigen::Matrix3d p =
        ekf.filter().covariance().block<3, 3>(I::marker_position, I::marker_position);
    found.place_nees += error.dot(p.llt().solve(error)) / runs;
    found.place = std::max(found.place, error.norm());
    found.given = std::max(found.given, (s.imu_position - place).norm());
    EXPECT_EQ(end, ekf.time());
    const InertialStated at_end = flight.state(end);
    const Vector3d off = ekf.state().position - (at_end.position - at_end.orientation * place);
    found.body_nees += off.squaredNorm() / std::pow(ekf.trust(end).position_stddev, 2) / runs;
    found.body = std::max(found.body, off.norm());
  }
  return found;
}

// The mean of 30 values of chi-square with 3 degrees of freedom is 2.2 to 3.9 in 95 of 100 cases.
void expect_consistent(const Found& found) {
  EXPECT_GT(found.place_nees, 2.0);
  EXPECT_LT(found.place_nees, 4.2);
  EXPECT_LT(found.body_nees, 3.8);  // trust() gives the stddev of the worst axis
  EXPECT_GT(found.body_nees, 1.0);
  EXPECT_GT(found.given, 0.1);
}

TEST(EkfImuPosition, IsFoundFromPoses) {
  const MarkerPoseNoise noise;
  const Found found = fly(30, [&](const View& v, int i, Ekfd& ekf) {
    if (i % 2 != 0) return;
    const MarkerPosed pose{v.position_of(marker), v.imu.orientation};
    EXPECT_NE(ekf.on_pose(v.time, test_support::noisy(pose, noise, v.random)), EkfStatus::rejected);
  });
  expect_consistent(found);
  EXPECT_LT(found.place, 0.006);
  EXPECT_LT(found.body, 0.004);
}

// Without poses: every measurement model contains the place of the IMU.
TEST(EkfImuPosition, IsFoundFromAnAntenna) {
  const Found found = fly(30, [&](const View& v, int i, Ekfd& ekf) {
    if (i == 0) {
      BodyStated start;
      start.orientation = v.imu.orientation * quaternion_exp(normal_vector(v.random, 0.02));
      start.angular_velocity = v.rate;
      start.position = v.position_of(Vector3d::Zero()) + normal_vector(v.random, 0.1);
      start.velocity = v.velocity_of(Vector3d::Zero()) + normal_vector(v.random, 0.1);
      EXPECT_TRUE(ekf.start(start, {0.1, 0.1, 0.02}));
    }
    if (i % 4 != 0) return;
    PositionMeasurement<double> position;
    position.antenna = antenna;
    position.position = v.position_of(antenna) + normal_vector(v.random, 0.01);
    position.covariance = 1e-4 * Eigen::Matrix3d::Identity();
    EXPECT_NE(ekf.on_measurement(v.time, position), EkfStatus::rejected);
    WorldVelocityMeasurement<double> velocity;
    velocity.antenna = antenna;
    velocity.velocity = v.velocity_of(antenna) + normal_vector(v.random, 0.05);
    velocity.covariance = 0.05 * 0.05 * Eigen::Matrix3d::Identity();
    EXPECT_NE(ekf.on_measurement(v.time, velocity), EkfStatus::rejected);
  });
  expect_consistent(found);
  EXPECT_LT(found.place, 0.03);
  EXPECT_LT(found.body, 0.03);
}

// The marker shows where the body is, wherever the IMU is.
TEST(EkfImuPosition, UnknownPlaceDoesNotMakeTheBodyUncertain) {
  EkfSettings s = unknown_place();
  s.imu_position_stddev = 0.2;
  const Flight flight(1, Eigen::Quaterniond::Identity(), marker);
  Ekfd ekf(s);
  for (int i = 0; i < 100; ++i) {
    const double t = imu_period * i;
    ekf.on_imu(t, flight.imu(t));
    ekf.on_pose(t, flight.pose(t));
  }
  const double t = ekf.time();
  EXPECT_LT(ekf.trust(t).position_stddev, 0.01);
  EXPECT_EQ(ekf.trust(t).state, EstimateState::good);
  EXPECT_GT(ekf.filter().covariance()(0, 0), 0.02 * 0.02);  // the IMU's
}

// The estimated marker frame is relative to the IMU. Its error must not move the IMU or the body.
TEST(EkfImuPosition, StaysAsGivenWhileTheMarkerIsEstimated) {
  EkfSettings s;
  s.imu_position << 0.15, -0.1, 0.05;
  s.marker_position = marker;
  s.marker_position_stddev = 0.1;
  const Vector3d error(0.05, -0.03, 0.04);  // of the marker's position in the settings
  const Flight flight(3, Eigen::Quaterniond::Identity(), marker + error - s.imu_position);
  Random random(4);
  NoisyImu imu(flight, s.imu_noise, imu_period, 3);
  Ekfd ekf(s);
  for (int i = 0; i <= 3000; ++i) {
    const double t = imu_period * i;
    ekf.on_imu(t, imu(t));
    if (i % 2 == 0) ekf.on_pose(t, test_support::noisy(flight.pose(t), s.pose_noise, random));
    ASSERT_EQ(ekf.imu_position(), s.imu_position) << i;
  }
  const Vector3d found = ekf.filter().state().marker_position + s.imu_position;
  EXPECT_LT((found - marker - error).norm(), 0.01);
  const double t = ekf.time();
  const InertialStated truth = flight.state(t);
  const Vector3d rate = flight.imu(t).angular_velocity, lever = truth.orientation * s.imu_position,
                 lever_velocity = truth.orientation * rate.cross(s.imu_position);
  EXPECT_LT((ekf.state().position - truth.position + lever).norm(), 0.01);
  EXPECT_LT((ekf.state().velocity - truth.velocity + lever_velocity).norm(), 0.05);
}

}  // namespace ekf_imu_position_test
}  // namespace tilt_ropter
