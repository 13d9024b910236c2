// The filter with sensors other than motion capture: it converges, and its errors are as large as
// its covariance says.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>

#include "support/ekf_flights.hpp"
#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <functional>
#include <string>

namespace tilt_ropter {
namespace ekf_measurements_test {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using test_support::Flight;
using test_support::imu_period;
using test_support::NoisyImu;
using test_support::normal_vector;
using test_support::Random;

// What a sensor sees: the true state and angular velocity, and the filter to tell.
struct View {
  double time;
  InertialStated x;
  Vector3d rate;
  Random& random;
  Ekfd& ekf;
};

struct Result {
  double nees = 0.0, nis = 0.0;                              // means per degree of freedom
  double position = 0.0, velocity = 0.0, orientation = 0.0;  // rms errors in the second half
  long used = 0, gated = 0;
};

// Adds the status of a measurement of `rows` rows to the result.
void count(Result& r, EkfStatus status, const Ekfd& ekf, int rows) {
  if (status == EkfStatus::updated) {
    ++r.used;
    r.nis += ekf.nis() / rows;
  } else {
    ++r.gated;
  }
}

// Flights over all attitudes, 3 m above the origin, from a start with a known error. `sense` is
// called every IMU sample and passes measurements to the filter.
Result fly(const std::function<void(const View&, int, Result&)>& sense, bool level = true,
           int runs = 20) {
  Result r;
  long instants = 0;
  EkfSettings s;
  s.imu_noise.gyro_bias_walk = 2e-4;
  s.imu_noise.accelerometer_bias_walk = 3e-3;
  s.gyro_bias_stddev = 0.02;
  s.accelerometer_bias_stddev = 0.1;
  const StartStddev stddev{0.3, 0.3, 0.05};
  for (int run = 0; run < runs; ++run) {
    const auto seed = static_cast<unsigned>(run);
    Random random(seed + 4000);
    const Flight flight(seed, level ? Eigen::Quaterniond::Identity() : random.orientation());
    NoisyImu imu(flight, s.imu_noise, imu_period, seed, normal_vector(random, s.gyro_bias_stddev),
                 normal_vector(random, s.accelerometer_bias_stddev));
    Ekfd ekf(s);
    for (int i = 0; i <= 4000; ++i) {
      const double t = imu_period * i;
      ekf.on_imu(t, imu(t));
      InertialStated truth = imu.state(t);
      const View view{t, truth, flight.imu(t).angular_velocity, random, ekf};
      if (i == 0) {
        BodyStated start;
        start.position = truth.position + normal_vector(random, stddev.position);
        start.velocity = truth.velocity + normal_vector(random, stddev.velocity);
        start.orientation =
            truth.orientation * quaternion_exp(normal_vector(random, stddev.orientation));
        EXPECT_TRUE(ekf.start(start, stddev));
      }
      sense(view, i, r);
      if (i % 40 != 39) continue;
      ++instants;
      const InertialTangentd all = difference(truth, ekf.filter().state());
      const Eigen::Matrix<double, 15, 1> e = all.head<15>();
      const Eigen::Matrix<double, 15, 15> p = ekf.filter().covariance().topLeftCorner<15, 15>();
      if (ekf.filter_time() == t) r.nees += e.dot(p.llt().solve(e)) / 15.0;
      if (i < 2000) continue;
      r.position += e.segment<3>(0).squaredNorm();
      r.velocity += e.segment<3>(3).squaredNorm();
      r.orientation += e.segment<3>(6).squaredNorm();
    }
  }
  const auto n = static_cast<double>(instants);
  r.nees /= n;
  r.nis /= static_cast<double>(r.used);
  for (double* sum : {&r.position, &r.velocity, &r.orientation}) *sum = std::sqrt(*sum / (n / 2.0));
  return r;
}

void expect_consistent(const Result& r) {
  EXPECT_GT(r.nees, 0.8);
  EXPECT_LT(r.nees, 1.25);
  EXPECT_NEAR(r.nis, 1.0, 0.1);
  EXPECT_LT(static_cast<double>(r.gated), 0.002 * static_cast<double>(r.used) + 2.0);
}

const Vector3d antenna(0.1, -0.05, 0.2);

Vector3d at(const InertialStated& x, const Vector3d& place) {
  return x.position + x.orientation * place;
}
Vector3d velocity_at(const View& v, const Vector3d& place) {
  return v.x.velocity + v.x.orientation * Vector3d(v.rate.cross(place));
}

PositionMeasurement<double> gps(const View& v, double stddev) {
  return {at(v.x, antenna) + normal_vector(v.random, stddev),
          stddev * stddev * Matrix3d::Identity(), antenna};
}

TEST(EkfMeasurements, GpsWithHeadingIsConsistent) {
  const Result r = fly([](const View& v, int i, Result& result) {
    if (i % 20 != 19) return;
    count(result, v.ekf.on_measurement(v.time, gps(v, 0.05)), v.ekf, 3);
    WorldVelocityMeasurement<double> velocity;
    velocity.velocity = velocity_at(v, antenna) + normal_vector(v.random, 0.05);
    velocity.covariance = 0.05 * 0.05 * Matrix3d::Identity();
    velocity.antenna = antenna;
    count(result, v.ekf.on_measurement(v.time, velocity), v.ekf, 3);
    const HeadingMeasurement<double> heading{yaw_of(v.x.orientation) + v.random.normal(0.02), 0.02};
    count(result, v.ekf.on_measurement(v.time, heading), v.ekf, 1);
  });
  expect_consistent(r);
  EXPECT_LT(r.position, 0.05);
  EXPECT_LT(r.velocity, 0.06);
  EXPECT_LT(r.orientation, 0.03);
}

TEST(EkfMeasurements, OdometryPosesAndVelocitiesAreConsistent) {
  const Vector3d camera(0.15, 0.0, -0.05);
  const Eigen::Quaterniond mounting = quaternion_exp(Vector3d(0.1, 0.5, -0.2));
  const Result r = fly(
      [&](const View& v, int i, Result& result) {
        if (i % 8 != 7) return;
        PoseMeasurement<double> pose;
        pose.sensor = camera;
        pose.sensor_orientation = mounting;
        pose.position = at(v.x, camera) + normal_vector(v.random, 0.01);
        pose.orientation =
            v.x.orientation * mounting * quaternion_exp(normal_vector(v.random, 0.01));
        pose.covariance = 1e-4 * Eigen::Matrix<double, 6, 6>::Identity();
        count(result, v.ekf.on_measurement(v.time, pose), v.ekf, 6);
        BodyVelocityMeasurement<double> twist;
        twist.sensor = camera;
        twist.velocity =
            v.x.orientation.conjugate() * velocity_at(v, camera) + normal_vector(v.random, 0.05);
        twist.covariance = 0.05 * 0.05 * Matrix3d::Identity();
        count(result, v.ekf.on_measurement(v.time, twist), v.ekf, 3);
      },
      false);
  expect_consistent(r);
  EXPECT_LT(r.position, 0.02);
  EXPECT_LT(r.orientation, 0.02);
}

// Without position only velocity, height and attitude stay bounded.
TEST(EkfMeasurements, FlowRangeAndHeadingAreConsistent) {
  const MeasuredPlane<double> ground{Vector3d::UnitZ(), -3.0};
  const Result r = fly([&](const View& v, int i, Result& result) {
    if (i % 4 != 3) return;
    const Vector3d up = v.x.orientation.conjugate() * Vector3d::UnitZ();
    if (up.z() < 0.5) return;
    const double distance = (v.x.position.z() + 3.0) / up.z();
    const Vector3d velocity = v.x.orientation.conjugate() * v.x.velocity;
    FlowMeasurement<double> flow;
    flow.ground = ground;
    flow.stddev = 0.06;
    flow.flow << v.rate.y() - velocity.x() / distance + v.random.normal(0.06),
        -v.rate.x() - velocity.y() / distance + v.random.normal(0.06);
    count(result, v.ekf.on_measurement(v.time, flow), v.ekf, 2);
    RangeMeasurement<double> range;
    range.ground = ground;
    range.range = distance + v.random.normal(0.03);
    range.stddev = 0.03;
    count(result, v.ekf.on_measurement(v.time, range), v.ekf, 1);
    const HeightMeasurement<double> height{v.x.position.z() + v.random.normal(0.3), 0.3,
                                           Vector3d::Zero()};
    count(result, v.ekf.on_measurement(v.time, height), v.ekf, 1);
    const HeadingMeasurement<double> heading{yaw_of(v.x.orientation) + v.random.normal(0.03), 0.03};
    count(result, v.ekf.on_measurement(v.time, heading), v.ekf, 1);
  });
  // The noise of the gyro sample in the flow is not white beside the prediction: NEES may be lower
  // or higher by a quarter.
  EXPECT_GT(r.nees, 0.7);
  EXPECT_LT(r.nees, 1.4);
  EXPECT_NEAR(r.nis, 1.0, 0.15);
  EXPECT_LT(r.velocity, 0.15);
  EXPECT_LT(r.orientation, 0.05);
}

// The wheels bound velocity, height and roll while the vehicle drives a circle on the ground.
TEST(EkfMeasurements, WheelsCarryOnForTenSecondsWithoutPoses) {
  constexpr double speed = 0.8, radius = 2.0, wheel_radius = 0.11, half_track = 0.25;
  constexpr double turn = speed / radius;
  Random random(60);
  double with_wheels = 0.0, without = 0.0;
  for (const bool use : {true, false}) {
    Ekfd ekf;
    const auto body = [&](double t) {
      BodyStated b;
      b.position << radius * std::sin(turn * t), radius * (1.0 - std::cos(turn * t)), wheel_radius;
      b.orientation = quaternion_from_yaw(turn * t);
      b.velocity << speed * std::cos(turn * t), speed * std::sin(turn * t), 0.0;
      b.angular_velocity << 0.0, 0.0, turn;
      return b;
    };
    for (int i = 0; i <= 25000; ++i) {
      const double t = 1e-3 * i;
      const Vector3d force(0.05, speed * turn - 0.08, gravity + 0.1);  // with biases
      ekf.on_imu(
          t, {body(t).angular_velocity + Vector3d(0.01, -0.02, 0.015) + normal_vector(random, 6e-3),
              force + normal_vector(random, 6e-2)});
      if (t < 10.0 && i % 10 == 0)
        ekf.on_pose(t, {body(t).position + normal_vector(random, 1e-3),
                        body(t).orientation * quaternion_exp(normal_vector(random, 3e-3))});
      if (!use || i % 20 != 5) continue;
      for (const double side : {1.0, -1.0}) {
        WheelSpeedMeasurement<double> encoder;
        encoder.wheel << 0.0, side * half_track, 0.0;
        encoder.speed = (speed - side * half_track * turn) / wheel_radius + random.normal(0.1);
        EXPECT_NE(ekf.on_measurement(t, encoder), EkfStatus::rejected);
        WheelHeightMeasurement<double> height;
        height.wheel = encoder.wheel;
        (void)ekf.on_measurement(t, height);
      }
      (void)ekf.on_measurement(t, NoSlipMeasurement<double>());
    }
    const double error = (ekf.state().position - body(25.0).position).norm();
    (use ? with_wheels : without) = error;
    if (use) {
      EXPECT_LT((ekf.state().velocity - body(25.0).velocity).norm(), 0.05);
      EXPECT_LT(ekf.trust(25.0).age_of(MeasurementKind::wheel), 0.05);
      EXPECT_EQ(ekf.trust(25.0).age_of(MeasurementKind::pose), 15.01);
    }
  }
  RecordProperty("with_wheels", std::to_string(with_wheels));
  RecordProperty("without", std::to_string(without));
  EXPECT_LT(with_wheels, 0.3);
  EXPECT_GT(without, 3.0 * with_wheels);
}

// A callable is a measurement, too: here the distance to a beacon.
TEST(EkfMeasurements, CallableGivesAnyMeasurement) {
  const Vector3d beacons[4] = {
      {8.0, 0.0, 3.0}, {0.0, 8.0, -2.0}, {-8.0, 0.0, 1.0}, {0.0, -8.0, 5.0}};
  const Result r = fly([&](const View& v, int i, Result& result) {
    if (i % 4 != 3) return;
    const Vector3d beacon = beacons[(i / 4) % 4];
    const double distance = (v.x.position - beacon).norm() + v.random.normal(0.02);
    const auto range = [beacon, distance](const InertialMotiond& motion) {
      Linearised<double, 1> h;
      const Vector3d line = motion.state.position - beacon;
      h.residual(0) = distance - line.norm();
      h.by(InertialIndex::position) = line.normalized().transpose();
      h.noise(0) = 0.02 * 0.02;
      return h;
    };
    count(result, v.ekf.on_measurement(v.time, range), v.ekf, 1);
  });
  expect_consistent(r);
  EXPECT_LT(r.position, 0.03);
}

// Sensors with different delays are used in the order of their stamps with a fusion delay.
TEST(EkfMeasurements, FusionDelayOrdersSensors) {
  const Flight flight(1);
  for (const double delay : {0.0, 0.15}) {
    EkfSettings s;
    s.fusion_delay = delay;
    Ekfd ekf(s);
    Random random(1);
    long late = 0, waiting = 0;
    ekf.on_imu(0.0, flight.imu(0.0));
    for (int i = 1; i <= 4000; ++i) {
      const double t = imu_period * i;
      ekf.on_imu(t, flight.imu(t));
      const InertialStated x = flight.state(t);
      const HeightMeasurement<double> height{x.position.z() + random.normal(0.05), 0.05,
                                             Vector3d::Zero()};
      if (i % 4 == 0 && ekf.on_measurement(t, height) == EkfStatus::waiting) ++waiting;
      const double then = t - 0.14;
      if (i % 20 == 0 && then > 0.0 && ekf.on_pose(then, flight.pose(then)) == EkfStatus::late)
        ++late;
    }
    if (delay == 0.0) {
      EXPECT_GT(late, 100);
    } else {
      EXPECT_EQ(late, 0);
      EXPECT_EQ(waiting, 1000);
      EXPECT_EQ(ekf.counts().gated, 0);
      EXPECT_LT(test_support::errors(ekf, flight).position, 0.02);
    }
  }
}

TEST(EkfMeasurements, StatusesAndGate) {
  Ekfd ekf;
  const HeightMeasurement<double> height{0.0, 0.1, Vector3d::Zero()};
  EXPECT_EQ(ekf.on_measurement(0.0, height), EkfStatus::early);
  EXPECT_FALSE(ekf.start({}, {}));  // no IMU yet
  const auto imu = [&](double t) { ekf.on_imu(t, {Vector3d::Zero(), Vector3d(0, 0, gravity)}); };
  imu(1.0);
  EXPECT_EQ(ekf.on_measurement(1.0, height), EkfStatus::early);  // not started
  EXPECT_FALSE(ekf.start({}, {0.0, 1.0, 1.0}));
  BodyStated bad;
  bad.position.x() = std::nan("");
  EXPECT_FALSE(ekf.start(bad, {}));
  EXPECT_TRUE(ekf.start({}, {}));
  EXPECT_TRUE(ekf.running());
  imu(1.005);
  EXPECT_EQ(ekf.on_measurement(1.005, height), EkfStatus::updated);
  EXPECT_EQ(ekf.on_measurement(1.001, height), EkfStatus::late);
  EXPECT_EQ(ekf.on_measurement(1.01, height), EkfStatus::waiting);
  EXPECT_EQ(ekf.on_measurement(2.0, height), EkfStatus::early);
  EXPECT_EQ(ekf.on_measurement(std::nan(""), height), EkfStatus::rejected);
  EXPECT_EQ(ekf.on_measurement(1.005, HeightMeasurement<double>{std::nan(""), 0.1, {}}),
            EkfStatus::rejected);
  const BodyStated before = ekf.state();
  EXPECT_EQ(ekf.on_measurement(1.005, HeightMeasurement<double>{50.0, 0.1, Vector3d::Zero()}),
            EkfStatus::gated);
  EXPECT_EQ(ekf.on_measurement(1.005, HeightMeasurement<double>{1e300, 0.1, Vector3d::Zero()}),
            EkfStatus::gated);
  EXPECT_TRUE(std::isfinite(ekf.nis()));
  EXPECT_EQ(ekf.state().position, before.position);
  imu(1.01);
  EXPECT_NEAR(ekf.trust(1.02).age_of(MeasurementKind::height), 0.01, 1e-9);  // the one that waited
}

TEST(EkfMeasurements, WhatIsNoCovarianceIsRejected) {
  Eigen::Matrix3d one_zero = Eigen::Matrix3d::Identity(), indefinite = one_zero;
  one_zero(1, 1) = 0.0;
  indefinite(0, 1) = indefinite(1, 0) = 2.0;
  const Eigen::Matrix3d unit = Eigen::Matrix3d::Identity();
  for (const Eigen::Matrix3d& covariance :
       {Eigen::Matrix3d(0.0 * unit), Eigen::Matrix3d(-unit), one_zero, indefinite,
        Eigen::Matrix3d(1e12 * unit), Eigen::Matrix3d(std::nan("") * unit)}) {
    Ekfd ekf;
    ekf.on_imu(1.0, {Vector3d::Zero(), Vector3d(0, 0, gravity)});
    EXPECT_TRUE(ekf.start({}, {}));
    ekf.on_imu(1.01, {Vector3d::Zero(), Vector3d(0, 0, gravity)});
    const Vector3d place(0.1, 0.0, 0.0);
    const BodyStated before = ekf.state();
    EXPECT_EQ(ekf.on_measurement(1.01, PositionMeasurement<double>{place, covariance}),
              EkfStatus::rejected);
    EXPECT_EQ(ekf.on_measurement(1.01, WorldVelocityMeasurement<double>{place, covariance}),
              EkfStatus::rejected);
    EXPECT_EQ(ekf.state().position, before.position);
    EXPECT_EQ(ekf.on_measurement(1.01, PositionMeasurement<double>{place, unit}),
              EkfStatus::updated);
  }
}

}  // namespace ekf_measurements_test
}  // namespace tilt_ropter
