// IMU and poses contradict each other: poses that continue each other are followed.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace ekf_contradiction_test {

using Eigen::Vector3d;
using Kind = SensorFaultKind;

// A motion in closed form, with derivatives by differences: position and attitude oscillate.
struct Motion {
  double size = 1.0;  // 0: at rest, in hover

  [[nodiscard]] Vector3d position(double t) const {
    return {size * std::sin(1.1 * t), size * std::cos(0.8 * t),
            1.5 + 0.3 * size * std::sin(0.6 * t)};
  }
  [[nodiscard]] Eigen::Quaterniond orientation(double t) const {
    return quaternion_exp(Vector3d(size * Vector3d(0.2 * std::sin(1.3 * t), 0.2 * std::cos(0.9 * t),
                                                   0.5 * std::sin(0.4 * t))));
  }
  [[nodiscard]] BodyStated body(double t) const {
    constexpr double h = 1e-4;
    BodyStated b;
    b.position = position(t);
    b.velocity = (position(t + h) - position(t - h)) / (2.0 * h);
    b.orientation = orientation(t);
    b.angular_velocity =
        quaternion_log(Eigen::Quaterniond(orientation(t - h).conjugate() * orientation(t + h))) /
        (2.0 * h);
    return b;
  }
  [[nodiscard]] Vector3d specific_force(double t) const {
    constexpr double h = 1e-3;
    const Vector3d acceleration = (position(t + h) - 2.0 * position(t) + position(t - h)) / (h * h);
    return orientation(t).conjugate() * (acceleration + Vector3d(0.0, 0.0, gravity));
  }
};

struct Outcome {
  double position = 0.0, orientation = 0.0;  // largest errors after 5 s [m], [rad]
  double at_end = 0.0;                       // position error at the end [m]
  double longest = 0.0;                      // longest time without a used pose [s]
  EstimateState state = EstimateState::lost;
  EkfCounts counts;
  double latency = 0.0;       // found [s]
  int good = 0;               // samples after 5 s
  double contradicted = 1e9;  // first time of EstimateTrust::imu_contradicted [s]
};

struct Given {
  double size = 1.0;      // of the motion
  double imu_rate = 1e3;  // [Hz]
  double duration = 16.0;
  double drift = 0.0;    // of the clock of the poses
  double heading = 0.0;  // error of the marker frame [rad]
  double noise = 1.0;    // of the poses, over that which is believed
};

Outcome fly(const SensorFault& fault, const Given& given = {}) {
  const Motion motion{given.size};
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = given.imu_rate;
  imu_parameters.gyro_bias << 0.01, -0.02, 0.015;
  imu_parameters.accelerometer_bias << 0.05, -0.08, 0.1;
  ImuSensor imu(imu_parameters, 1);
  PoseSensorParameters pose_parameters;
  pose_parameters.delay = 0.02;
  pose_parameters.position_noise = 1e-3 * given.noise;
  pose_parameters.orientation_noise = 3e-3 * given.noise;
  PoseSensor poses(pose_parameters, 2);
  imu.add_fault(fault);
  poses.add_fault(fault);
  EkfSettings settings;
  settings.pose_noise = {1e-3, 3e-3};
  settings.marker_orientation = quaternion_from_yaw(given.heading);
  Ekfd ekf(settings);
  Outcome o;
  for (int i = 0; i <= static_cast<int>(given.duration * 1e3); ++i) {
    const double t = 1e-3 * i;
    const BodyStated truth = motion.body(t);
    if (const auto m = imu.sample(t, truth.angular_velocity, motion.specific_force(t)))
      ekf.on_imu(m->time, *m);
    if (const auto m = poses.sample(t, truth)) ekf.on_pose(m->time * (1.0 + given.drift), *m);
    EXPECT_TRUE(is_finite(ekf.state()));
    if (ekf.trust(t).imu_contradicted) o.contradicted = std::min(o.contradicted, t);
    if (t < 5.0 || given.imu_rate * (t - ekf.time()) > 0.5) continue;
    o.good += ekf.trust(t).state == EstimateState::good;
    const BodyStated body = ekf.state();
    o.at_end = (body.position - truth.position).norm();
    o.position = std::max(o.position, o.at_end);
    o.orientation = std::max(o.orientation, body.orientation.angularDistance(truth.orientation));
    o.longest = std::max(o.longest, ekf.trust(t).age_of(MeasurementKind::pose));
  }
  o.state = ekf.trust(ekf.time()).state;
  o.counts = ekf.counts();
  o.latency = ekf.trust(ekf.time()).latency;
  return o;
}

SensorFault fault_of(Kind kind, double size, double frequency = 97.0) {
  SensorFault f;
  f.kind = kind;
  f.start = 8.0;
  f.size = size;
  f.frequency = frequency;
  return f;
}

// `longest`: time without a pose that is used [s].
void expect_followed(const Outcome& o, double at_end = 0.02, double longest = 0.3,
                     int restarts = 0) {
  EXPECT_LT(o.position, 0.15);
  EXPECT_LT(o.at_end, at_end);
  EXPECT_LT(o.longest, longest);
  EXPECT_LE(o.counts.restarts, restarts);
}

TEST(EkfContradiction, BiasStepsOfTheAccelerometerAreLearned) {
  for (const double motion : {0.0, 1.0})
    for (const double size : {0.2, 0.5, 1.0, 2.0, 3.0}) {
      SCOPED_TRACE(size);
      expect_followed(fly(fault_of(Kind::accelerometer_step, size), {motion}));
    }
}

TEST(EkfContradiction, BiasStepsOfTheGyroscopeAreLearned) {
  for (const double motion : {0.0, 1.0})
    for (const double size : {0.02, 0.1, 0.3, 0.5}) {
      SCOPED_TRACE(size);
      const Outcome o = fly(fault_of(Kind::gyro_step, size), {motion});
      expect_followed(o);
      EXPECT_LT(o.orientation, 0.1);
      EXPECT_GT(o.contradicted, 8.0);
      EXPECT_LT(o.contradicted, size < 0.2 ? 1e10 : 8.3);
    }
}

// The accelerations are measured along other axes than those of the body.
TEST(EkfContradiction, AWrongHeadingOfTheMarkerFrameIsNotGoodInMotion) {
  SensorFault none;
  none.start = 1e9;
  for (const double heading : {0.8, 1.5, -2.5}) {
    Given given;
    given.heading = heading;
    EXPECT_LT(fly(none, given).good, 100) << heading;
  }
}

TEST(EkfContradiction, PosesNoisierThanBelievedDoNotConvictTheImu) {
  for (const double motion : {0.0, 1.0}) {
    Given given{motion, 1e3, 60.0};
    given.noise = 2.0;
    SensorFault none;
    none.start = 1e9;
    const Outcome o = fly(none, given);
    EXPECT_LT(o.counts.gated, 20);  // of 6000: their noise is measured
    EXPECT_EQ(o.contradicted, 1e9);
  }
}

TEST(EkfContradiction, BurstsOfPosesAreUsed) {
  for (const double size : {2.0, 5.0, 10.0}) {
    SCOPED_TRACE(size);
    expect_followed(fly(fault_of(Kind::pose_burst, size)));
  }
}

// An alias of 3 Hz moves the estimate by 0.3 to 0.4 m.
TEST(EkfContradiction, VibrationThatIsAliasedIsNoise) {
  for (const double rate : {100.0, 500.0})
    for (const double alias : {3.4, 8.0, 20.0})
      for (const double size : {0.08, 0.3, 1.0})
        for (const double start : {0.0, 8.0}) {
          SCOPED_TRACE(rate);
          SCOPED_TRACE(alias);
          SCOPED_TRACE(size);
          SCOPED_TRACE(start);
          SensorFault fault = fault_of(Kind::imu_vibration, size, rate + alias);
          fault.start = start;
          expect_followed(fly(fault, {1.0, rate}), 0.15, 0.4, start > 0.0 ? 0 : 2);
        }
}

// From the start, the error swings back before a series of poses above the gate is long.
TEST(EkfContradiction, AQuickAliasIsContradictedByManyShortSeries) {
  struct Case {
    double rate, alias, size;
  };
  for (const Case& c : {Case{400.0, 12.5, 0.638}, {400.0, 20.0, 1.0}, {500.0, 6.0, 1.0}}) {
    SCOPED_TRACE(c.alias);
    SensorFault fault = fault_of(Kind::imu_vibration, c.size, c.rate + c.alias);
    fault.start = 0.0;
    const Outcome o = fly(fault, {1.0, c.rate});
    EXPECT_LT(o.position, 0.05);
    EXPECT_LT(o.contradicted, 2.0);
    EXPECT_LT(o.counts.gated, 60);  // of 1600
    EXPECT_EQ(o.good, 0);
  }
}

TEST(EkfContradiction, AnAccelerometerThatIsCutIsNotBelieved) {
  for (const double motion : {0.0, 1.0})
    for (const double size : {9.0, 9.7}) {
      SCOPED_TRACE(size);
      expect_followed(fly(fault_of(Kind::accelerometer_clip, size), {motion}), 0.05);
    }
}

// Motion capture defines the rigid body again: its orientation steps, its positions go on.
TEST(EkfContradiction, TheOrientationOfTheRigidBodyMayStep) {
  for (const double motion : {0.0, 1.0})
    for (const double size : {2.0, 5.0, 20.0, 90.0, 180.0}) {
      SCOPED_TRACE(size);
      const Outcome o = fly(fault_of(Kind::orientation_step, size), {motion});
      expect_followed(o);
      EXPECT_LT(o.orientation, 0.03);
      EXPECT_EQ(o.state, EstimateState::good);
    }
}

// A unit, sign or axis of the IMU that is wrong is never a good estimate, at rest or in motion.
TEST(EkfContradiction, AWrongImuIsNeverGood) {
  const Eigen::DiagonalMatrix<double, 3> to_frd(1.0, -1.0, -1.0);
  struct Lie {
    const char* name;
    Eigen::Matrix3d force, rate;
  };
  const Eigen::Matrix3d same = Eigen::Matrix3d::Identity(), frd = to_frd;
  Eigen::Matrix3d exchanged;
  exchanged << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  const std::vector<Lie> lies{{"in g", same / gravity, same},
                              {"force reversed", -same, same},
                              {"forward-right-down", frd, frd},
                              {"force forward-right-down", frd, same},
                              {"axes exchanged", exchanged, exchanged},
                              {"no gravity", Eigen::Matrix3d::Zero(), same},
                              {"degrees per second", same, same * 180.0 / pi}};
  const auto good = [](const Lie& lie, double size, double from) {
    const Motion motion{size};
    ImuSensorParameters parameters;
    parameters.rate = 500.0;
    ImuSensor imu(parameters, 1);
    PoseSensor poses(PoseSensorParameters{}, 2);
    Ekfd ekf;
    int ticks = 0;
    for (int i = 0; i <= 6000; ++i) {
      const double t = 2e-3 * i;
      const BodyStated truth = motion.body(t);
      if (const auto m = imu.sample(t, truth.angular_velocity, motion.specific_force(t)))
        ekf.on_imu(m->time, {lie.rate * m->angular_velocity, lie.force * m->specific_force});
      if (const auto m = poses.sample(t, truth)) ekf.on_pose(m->time, *m);
      ticks += t > from && ekf.trust(t).state == EstimateState::good;
    }
    return ticks;
  };
  for (const double size : {0.0, 1.0}) {
    EXPECT_GT(good({"right", same, same}, size, 1.0), 5490);
    for (const Lie& lie : lies) {
      if (size == 0.0 && lie.rate != same && lie.force == same) continue;  // nothing turns
      SCOPED_TRACE(lie.name);
      EXPECT_EQ(good(lie, size, 3.0), 0) << "motion " << size;
    }
  }
}

// Poses that are late from the start, or from a moment on.
TEST(EkfContradiction, LatencyOfThePosesIsFoundInMotion) {
  for (const double start : {0.0, 8.0})
    for (const double size : {0.01, 0.03, 0.05, 0.1, 0.12}) {
      SCOPED_TRACE(start);
      SCOPED_TRACE(size);
      SensorFault fault = fault_of(Kind::pose_late, size);
      fault.start = start;
      const Outcome o = fly(fault);
      expect_followed(o, 0.02, 0.4);
      EXPECT_NEAR(o.latency, size, 0.008);
      EXPECT_EQ(o.state, EstimateState::good);
    }
}

// A slow drift of the poses' clock is a latency that grows.
TEST(EkfContradiction, DriftOfTheClockIsFollowed) {
  for (const double drift : {5e-5, 2e-4, -2e-4}) {
    SCOPED_TRACE(drift);
    Given given;
    given.duration = 120.0;
    given.drift = drift;
    const Outcome o = fly(fault_of(Kind::pose_late, 1e-9), given);
    EXPECT_LT(o.position, 0.03);
    EXPECT_NEAR(o.latency, 120.0 * drift, 0.012);
    EXPECT_EQ(o.state, EstimateState::good);
  }
}

// On a straight path, poses that jump ahead look early. The next turn shows that they are not.
TEST(EkfContradiction, ALatencyThatDoesNotServeIsTakenBack) {
  const auto position = [](double t) {
    const double turned = std::max(0.0, t - 8.4);
    return Vector3d(20.0 * std::sin(0.1 * t), 1.0 - std::cos(1.5 * turned), 1.5);
  };
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 500.0;
  ImuSensor imu(imu_parameters, 1);
  PoseSensor poses(PoseSensorParameters{}, 2);
  SensorFault jump = fault_of(Kind::pose_jump, 0.05);
  poses.add_fault(jump);
  Ekfd ekf;
  double largest = 0.0, error = 0.0;
  for (int i = 0; i <= 7000; ++i) {
    constexpr double h = 1e-3;
    const double t = 2.0 * h * i;
    const Vector3d before = position(t - h), now = position(t), after = position(t + h);
    BodyStated truth;
    truth.position = now;
    truth.velocity = (after - before) / (2.0 * h);
    const Vector3d force = (after - 2.0 * now + before) / (h * h) + Vector3d(0.0, 0.0, gravity);
    if (const auto m = imu.sample(t, Vector3d::Zero(), force)) ekf.on_imu(m->time, *m);
    if (const auto m = poses.sample(t, truth)) ekf.on_pose(m->time, *m);
    largest = std::max(largest, std::abs(ekf.trust(t).latency));
    error = (ekf.state().position - now).norm();
  }
  EXPECT_GT(largest, 0.03);
  EXPECT_LT(std::abs(ekf.trust(ekf.time()).latency), 0.01);
  EXPECT_LT(error, 0.06);  // the origin has moved by 0.05 m
  EXPECT_EQ(ekf.trust(ekf.time()).state, EstimateState::good);
}

TEST(EkfContradiction, AWrongAccelerometerIsNoLatency) {
  for (const double size : {0.2, 0.3, 0.5, 1.0, 3.0}) {
    SCOPED_TRACE(size);
    EXPECT_NEAR(fly(fault_of(Kind::accelerometer_step, size)).latency, 0.0, 0.005);
  }
}

}  // namespace ekf_contradiction_test
}  // namespace tilt_ropter
