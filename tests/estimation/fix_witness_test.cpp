// Which of IMU, receiver and compass is wrong, if they contradict each other in flight.

#include <tilt_ropter/estimation/detail/fix_witness.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <functional>

namespace tilt_ropter {
namespace fix_witness_test {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr double degree = pi / 180.0;

/// What the sensors say; `after` is the time since the fault began [s].
struct Words {
  double after;
  InertialSampled& imu;
  Vector3d& position;
  Vector3d& velocity;
  double& heading;
};
using Fault = std::function<void(const Words&)>;

struct Given {
  double noise = 0.02;  // of the receiver [m], [m/s]
  bool moves = true;
  double start_heading = 0.0;  // error [rad]
  bool has_compass = true;
  bool has_velocity = true;
};

struct Outcome {
  double position = 0.0, orientation = 0.0;  // largest errors from 10 s on
  double off = 0.0, turned = 0.0;            // position and orientation error at the end
  EstimateState state;
  bool contradicted;
};

// For 60 s. The fault begins at 15 s.
Outcome fly(const Fault& fault, const Given& given = {}) {
  const test_support::Flight flight(1);
  EkfSettings s;
  s.accelerometer_bias_stddev = 0.1;
  s.trust.position_error = 3.0;
  s.trust.lost_position_error = 6.0;
  test_support::NoisyImu imu(flight, s.imu_noise, 0.01, 2);
  test_support::Random random(3);
  const auto noise = [&random](double stddev) {
    return test_support::normal_vector(random, stddev);
  };
  Ekfd ekf(s);
  Outcome o{};
  for (int i = 0; i <= 6000; ++i) {
    const double t = 0.01 * i;
    InertialStated x = flight.state(given.moves ? t : 0.0);
    InertialSampled sample = imu(t);
    if (!given.moves) {
      x.velocity.setZero();
      const Vector3d up = x.orientation.conjugate() * Vector3d(0.0, 0.0, gravity);
      sample = {noise(0.002), up + noise(0.02)};
    }
    Vector3d position = x.position + noise(given.noise), velocity = x.velocity + noise(given.noise);
    double heading = yaw_of(x.orientation) + random.normal(0.02);
    if (t > 15.0) fault({t - 15.0, sample, position, velocity, heading});
    ekf.on_imu(t, sample);
    if (i == 0) {
      EXPECT_TRUE(
          ekf.start({x.position, x.velocity,
                     quaternion_from_yaw(given.start_heading) * x.orientation, Vector3d::Zero()},
                    {0.1, 0.1, 0.1}));
    }
    if (i % 10 == 5) {
      const Matrix3d covariance = given.noise * given.noise * Matrix3d::Identity();
      ekf.on_measurement(t, PositionMeasurement<double>{position, covariance, Vector3d::Zero()});
      if (given.has_velocity)
        ekf.on_measurement(
            t, WorldVelocityMeasurement<double>{velocity, covariance, Vector3d::Zero()});
      if (given.has_compass) ekf.on_measurement(t, HeadingMeasurement<double>{heading, 0.02});
    }
    if (t < 10.0) continue;
    const BodyStated y = ekf.state();
    o.off = (y.position - x.position).norm();
    o.position = std::max(o.position, o.off);
    o.turned = y.orientation.angularDistance(x.orientation);
    o.orientation = std::max(o.orientation, o.turned);
  }
  o.state = ekf.trust(ekf.time()).state;
  o.contradicted = ekf.trust(ekf.time()).imu_contradicted;
  return o;
}

TEST(HeadingNoise, IsThatOfWhiteNoiseUntilTheMeanIsFarFromZero) {
  detail::HeadingNoise noise;
  test_support::Random random(1);
  for (int i = 0; i < 10000; ++i) {
    noise.add(random.normal(1.0));
    ASSERT_LT(noise.factor(), 1.5) << i;
  }
  for (int i = 0; i < 100; ++i) noise.add(1.0 + random.normal(1.0));
  EXPECT_TRUE(noise.contradicts());
  EXPECT_GT(noise.factor(), 30.0);
  for (int i = 0; i < 100; ++i) noise.add(random.normal(1.0));
  EXPECT_FALSE(noise.contradicts());
}

TEST(FixWitness, CompassThatTurnsAwayIsNotFollowed) {
  for (const bool moves : {true, false})
    for (const double receiver : {0.02, 0.3})
      for (const double rate : {1.0, 3.0}) {  // [deg/s]
        const Outcome o =
            fly([&](const Words& w) { w.heading += rate * degree * w.after; }, {receiver, moves});
        EXPECT_LT(o.orientation, (moves ? 5.0 : 12.0) * degree) << receiver << ' ' << rate;
        EXPECT_LT(o.position, 3.0 * receiver);
        EXPECT_EQ(o.state, EstimateState::degraded);
        EXPECT_FALSE(o.contradicted);  // the IMU
      }
}

TEST(FixWitness, CompassThatComesBackIsUsedAgain) {
  const Outcome o = fly([](const Words& w) { w.heading += w.after < 10.0 ? 0.7 : 0.0; });
  EXPECT_LT(o.orientation, 2.0 * degree);
  EXPECT_EQ(o.state, EstimateState::good);
}

// start() is told 0.1 rad.
TEST(FixWitness, ReceiverFindsAnyWrongHeadingInMotion) {
  for (const double error : {0.5, -1.0, 1.6, -2.4, 3.1})
    for (const double noise : {0.02, 0.3})
      for (const bool has_velocity : {true, false}) {
        const Outcome o = fly([](const Words&) {}, {noise, true, error, false, has_velocity});
        EXPECT_LT(o.turned, (noise < 0.1    ? 1.0
                             : has_velocity ? 5.0
                                            : 12.0) *
                                degree)
            << error << ' ' << noise;
        EXPECT_LT(o.position, noise < 0.1 ? 0.5 : 2.0) << error << ' ' << noise << has_velocity;
        if (noise < 0.1 || has_velocity) {
          EXPECT_LE(o.state, EstimateState::degraded) << error << ' ' << noise;
        }
      }
}

TEST(FixWitness, CompassFindsAWrongHeading) {
  for (const bool moves : {true, false})
    for (const double error : {0.5, -1.0, 1.6, 3.1}) {
      const Outcome o = fly([](const Words&) {}, {0.02, moves, error});
      EXPECT_LT(o.turned, 1.0 * degree) << error;
      if (std::abs(error) < 1.5) {
        EXPECT_EQ(o.state, EstimateState::good) << error;
      }
    }
}

// Position and velocity contradict the accelerometer; with the heading, the gyroscope.
TEST(FixWitness, ReceiverAndCompassConvictTheImu) {
  for (const bool moves : {true, false})
    for (const double size : {0.5, 1.0, 3.0}) {
      const Outcome accelerometer =
          fly([&](const Words& w) { w.imu.specific_force.x() += size; }, {0.02, moves});
      EXPECT_LT(accelerometer.position, 0.5) << size;
      EXPECT_LT(accelerometer.turned, 1.0 * degree) << size;
      if (size < 1.0) continue;
      const Outcome gyroscope =
          fly([&](const Words& w) { w.imu.angular_velocity.z() += 2.0 * size * degree; },
              {0.02, moves});
      EXPECT_LT(gyroscope.position, 0.2) << size;
      EXPECT_LT(gyroscope.turned, 4.0 * degree) << size;
    }
}

// One receiver gives both, and the velocity of one that has lost its satellites may be zero.
TEST(FixWitness, ReceiverThatStandsStillDoesNotConvictTheImu) {
  const InertialStated last = test_support::Flight(1).state(15.0);
  for (const bool holds_velocity : {true, false}) {
    test_support::Random random(8);
    const Outcome o = fly([&](const Words& w) {
      w.position = last.position + test_support::normal_vector(random, 0.02);
      w.velocity = test_support::normal_vector(random, 0.02);
      if (holds_velocity) w.velocity += last.velocity;
    });
    EXPECT_FALSE(o.contradicted) << holds_velocity;
    EXPECT_EQ(o.state, EstimateState::position_lost) << holds_velocity;
  }
}

// Six seconds later: without positions, the estimate errs without limit.
TEST(FixWitness, PositionsAloneOverruleTheEstimateInMotion) {
  for (const bool has_compass : {true, false})
    for (const double size : {0.5, 1.0, 3.0}) {
      const Outcome o = fly([&](const Words& w) { w.imu.specific_force.x() += size; },
                            {0.02, true, 0.0, has_compass, false});
      EXPECT_LT(o.off, 0.1) << size;
      EXPECT_LT(o.turned, 1.0 * degree) << size;
      EXPECT_LT(o.position, 20.0 * size) << size;
      EXPECT_LE(o.state, EstimateState::degraded) << size;
    }
}

// The other one tells.
TEST(FixWitness, PositionsThatDriftOrVelocitiesThatStepDoNotConvictTheImu) {
  const Outcome drift = fly([](const Words& w) { w.position.x() += std::min(w.after, 5.0); });
  EXPECT_FALSE(drift.contradicted);
  const Outcome both = fly([](const Words& w) {
    w.position.x() += 2.0;
    w.velocity.x() += 1.0;
  });
  EXPECT_FALSE(both.contradicted);
  const Outcome step = fly([](const Words& w) { w.velocity.x() += 1.0; }, {0.02, false});
  EXPECT_FALSE(step.contradicted);
  EXPECT_LT(step.position, 0.1);
  EXPECT_EQ(step.state, EstimateState::good);
}

}  // namespace fix_witness_test
}  // namespace tilt_ropter
