// Calibration of the offset.

#include <tilt_ropter/estimation/wrench_observer.hpp>

#include "support/random.hpp"
#include "support/wrench_feed.hpp"

#include <tilt_ropter/simulation/sensors.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <limits>

namespace tilt_ropter {
namespace wrench_observer_calibration_test {

using Eigen::Vector3d;
using test_support::body;
using test_support::distance;
using test_support::Feed;
using test_support::pushed;
using test_support::Random;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

TEST(WrenchObserver, CalibrationOnTheGroundFindsAccelerometerBias) {
  const double weight = body().mass * gravity;
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 1000.0;
  imu_parameters.accelerometer_bias << 0.2, -0.1, 0.3;
  imu_parameters.gyro_bias << 0.05, -0.02, 0.03;
  imu_parameters.accelerometer_bias_walk = imu_parameters.gyro_bias_walk = 0.0;
  ImuSensor imu(imu_parameters, 5);
  WrenchObserverd observer(body());
  const Wrenchd ground{Vector3d(0, 0, weight), Vector3d::Zero()};
  const Vector3d bias = body().mass * imu_parameters.accelerometer_bias;
  const auto stand = [&](double from, double to) {
    for (double time = from; time < to; time += 1e-3) {
      // There is no sample where one stretch ends and the next begins at almost the same time.
      if (const auto m = imu.sample(time, Vector3d::Zero(), ground.force / body().mass))
        (void)observer.update(time, *m, {});
    }
  };
  stand(0.0, 1.0);
  observer.begin_calibration();
  stand(1.0, 3.0);
  const Wrenchd before = observer.external();
  EXPECT_NEAR((before.force - ground.force - bias).norm(), 0.0, 0.1);
  EXPECT_EQ(observer.end_calibration(ground), CalibrationStatus::calibrated);
  EXPECT_EQ(distance(observer.external(), before), 0.0);  // no jump
  EXPECT_LT((observer.offset().force - bias).norm(), 0.02);
  EXPECT_LT(observer.offset().torque.norm(), 1e-3);
  stand(3.0, 6.0);
  EXPECT_LT((observer.external().force - ground.force).norm(), 0.05);

  // A reset of the estimate keeps the offset, because the sensor's error remains. A second
  // calibration measures the raw residual, not the residual after the first calibration.
  observer.reset();
  EXPECT_LT((observer.offset().force - bias).norm(), 0.02);
  stand(7.0, 7.5);
  observer.begin_calibration();
  stand(7.5, 9.5);
  EXPECT_EQ(observer.end_calibration(ground), CalibrationStatus::calibrated);
  EXPECT_LT((observer.offset().force - bias).norm(), 0.02);
}

TEST(WrenchObserver, CalibrationOffsetIsResidualMinusKnownWrench) {
  // Samples come at uneven intervals. Each sample is weighted by its interval.
  WrenchObserverd observer(body());
  Feed feed(observer);
  Random random(52);
  feed({}, 10);
  observer.begin_calibration();
  double time = 0.0;
  Wrenchd sum;
  while (time < 20.0) {
    const double dt = random.uniform(1e-3, 0.05);
    // The wrench is smaller at short intervals, so that the unweighted mean would differ.
    const Wrenchd wrench{dt < 0.02 ? Vector3d(0.1, 0.2, 0.3) : Vector3d(0.3, 0.2, 0.1),
                         Vector3d(dt < 0.02 ? 0.01 : 0.03, 0, 0)};
    EXPECT_EQ(feed(wrench, dt), ObserverStatus::updated);
    time += dt;
    sum.force += dt * wrench.force;
    sum.torque += dt * wrench.torque;
  }
  const Wrenchd known{Vector3d(0.1, 0.0, -0.1), Vector3d(0.02, 0.0, 0.0)};
  EXPECT_EQ(observer.end_calibration(known), CalibrationStatus::calibrated);
  EXPECT_LT((observer.offset().force + known.force - sum.force / time).norm(), 1e-3);
  EXPECT_LT((observer.offset().torque + known.torque - sum.torque / time).norm(), 1e-4);
  const Wrenchd more{observer.offset().force + pushed.force,
                     observer.offset().torque + pushed.torque};
  feed(more, 400);
  EXPECT_LT(distance(observer.external(), pushed), 1e-6);
}

TEST(WrenchObserver, CalibrationReportsReasonOfRejection) {
  WrenchObserverd observer(body());
  Feed feed(observer);
  const Wrenchd old{Vector3d(0.1, 0.2, 0.3), Vector3d(0.01, 0.02, 0.03)};
  observer.set_offset(old);
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::not_begun);
  feed({}, 10);
  observer.begin_calibration();
  feed({}, 95);
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::too_short);
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::not_begun);

  // A push during half of the time. Its standard deviation is 0.6 N for 1.2 N and 0.4 N for 0.8 N.
  const auto push = [&](const Vector3d& force, const Vector3d& torque) {
    observer.begin_calibration();
    feed({}, 100);
    feed({force, torque}, 100);
    return observer.end_calibration();
  };
  const Vector3d none = Vector3d::Zero();
  for (int axis = 0; axis < 3; ++axis)
    EXPECT_EQ(push(1.2 * Vector3d::Unit(axis), none), CalibrationStatus::moved);
  EXPECT_EQ(push(none, Vector3d(0.12, 0, 0)), CalibrationStatus::moved);
  observer.begin_calibration();
  feed({}, 200);
  EXPECT_EQ(observer.end_calibration({Vector3d(0, nan, 0), none}), CalibrationStatus::rejected);
  EXPECT_EQ(distance(observer.offset(), old), 0.0);
  EXPECT_EQ(push(Vector3d(0.8, 0, 0), Vector3d(0.08, 0, 0)), CalibrationStatus::calibrated);
  EXPECT_NEAR(observer.offset().force.x(), 0.4, 0.01);

  // Calibrations that are discarded by reset() or begun anew.
  observer.begin_calibration();
  observer.reset();
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::not_begun);
  feed({}, 10);
  observer.begin_calibration();
  feed(pushed, 200);
  observer.begin_calibration();
  feed({}, 200);
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::calibrated);
  EXPECT_LT(distance(observer.offset(), {}), 1e-12);
}

// What contradicts the weight is not an offset: on the ground and in hover, on every axis.
TEST(WrenchObserver, CalibrationNamesUnitsAndAxesThatContradictTheWeight) {
  const Vector3d up(0.0, 0.0, gravity);
  const double weight = body().mass * gravity;
  const auto calibrate = [&](const Vector3d& measured, bool in_hover,
                             const Vector3d& torque = Vector3d(0.0, 0.0, 0.0)) {
    WrenchObserverd observer(body());
    const Wrenchd carried{Vector3d(0.0, 0.0, weight), Vector3d::Zero()};
    const Wrenchd applied{in_hover ? carried.force : Vector3d::Zero(), -torque};
    observer.begin_calibration();
    for (int i = 0; i <= 200; ++i)
      (void)observer.update(0.01 * i, {Vector3d::Zero(), measured}, applied);
    const CalibrationStatus status = observer.end_calibration(in_hover ? Wrenchd{} : carried);
    if (status != CalibrationStatus::calibrated) {
      EXPECT_EQ(distance(observer.offset(), {}), 0.0);
    }
    return status;
  };
  for (const bool in_hover : {false, true}) {
    EXPECT_EQ(calibrate(up, in_hover), CalibrationStatus::calibrated);
    EXPECT_EQ(calibrate(1.3 * up, in_hover), CalibrationStatus::calibrated);  // a wrong mass
    EXPECT_EQ(calibrate(up / gravity, in_hover), CalibrationStatus::in_g);
    EXPECT_EQ(calibrate(Vector3d(0.1, 0.1, 0.05), in_hover), CalibrationStatus::without_gravity);
    EXPECT_EQ(calibrate(-up, in_hover), CalibrationStatus::reversed);
    EXPECT_EQ(calibrate(Vector3d(-gravity, 0, 0), in_hover), CalibrationStatus::along_x);
    EXPECT_EQ(calibrate(Vector3d(0, gravity, 0.3), in_hover), CalibrationStatus::along_y);
    EXPECT_EQ(calibrate(3.0 * up, in_hover), CalibrationStatus::implausible);
    EXPECT_EQ(calibrate(-up / gravity, in_hover), CalibrationStatus::without_gravity);
    EXPECT_EQ(calibrate(up, in_hover, Vector3d(0.12 * weight, 0, 0)),
              CalibrationStatus::implausible);
    EXPECT_EQ(calibrate(up, in_hover, Vector3d(0.05 * weight, 0, 0)),
              CalibrationStatus::calibrated);
  }
}

TEST(WrenchObserver, CalibrationNeedsTimeAndRest) {
  const auto calibrate = [](int samples, double force, double torque) {
    WrenchObserverd observer(body());
    Feed feed(observer);
    feed({}, 10);
    observer.begin_calibration();
    feed({}, samples);
    feed({Vector3d(force, 0, 0), Vector3d(torque, 0, 0)}, samples);
    return observer.end_calibration();
  };
  EXPECT_EQ(calibrate(100, 0.8, 0.08), CalibrationStatus::calibrated);
  EXPECT_EQ(calibrate(45, 0.8, 0.08), CalibrationStatus::too_short);
  EXPECT_EQ(calibrate(100, 1.2, 0.08), CalibrationStatus::moved);
  EXPECT_EQ(calibrate(100, 0.8, 0.12), CalibrationStatus::moved);
}

TEST(WrenchObserver, SetOffsetRestoresStoredOffset) {
  WrenchObserverd observer(body());
  observer.set_offset(pushed);
  observer.set_offset({Vector3d(nan, 0, 0), Vector3d::Zero()});
  observer.set_offset({Vector3d(0, 1e7, 0), Vector3d::Zero()});
  EXPECT_EQ(distance(observer.offset(), pushed), 0.0);
  EXPECT_EQ(distance(observer.external(), {}), 0.0);
  Feed feed(observer);
  feed(pushed, 10);
  EXPECT_LT(distance(observer.external(), {}), 1e-12);
}

}  // namespace wrench_observer_calibration_test
}  // namespace tilt_ropter
