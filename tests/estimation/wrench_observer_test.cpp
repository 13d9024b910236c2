// Step response, accuracy and bandwidth of the estimate.

#include <tilt_ropter/estimation/wrench_observer.hpp>

#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/random.hpp"
#include "support/wrench_feed.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <stdexcept>

namespace tilt_ropter {
namespace wrench_observer_test {

using Eigen::Vector3d;
using test_support::body;
using test_support::distance;
using test_support::Random;

constexpr double infinity = std::numeric_limits<double>::infinity();

TEST(WrenchObserver, StepResponseMatchesClosedFormForAnyTimeStep) {
  const Eigen::Vector3d force(5.0, -3.0, 1.0), torque(0.3, -0.1, 0.2);
  WrenchObserverSettings settings;
  settings.force_bandwidth << 2.0, 5.0, 20.0;
  settings.torque_bandwidth << 3.0, 6.0, 25.0;
  settings.max_gap = 2.0;
  for (const double dt : {1e-3, 5e-3, 0.02, 0.1, 0.25, 1.0}) {  // dt K up to 25
    WrenchObserverd observer(body(), settings);
    // At rest apart from the step. Torque about several axes would couple through the gyroscopic
    // torque, so each torque axis is tested alone. The force is not affected.
    for (int axis = 0; axis < 3; ++axis) {
      observer.reset();
      const Eigen::Vector3d about = torque(axis) * Eigen::Vector3d::Unit(axis);
      for (int i = 0; i <= 40; ++i) {
        const double t = dt * i;
        const Eigen::Vector3d w = body().inertia.inverse() * about * t;
        (void)observer.update(t, {w, force / body().mass}, {});
        for (int j = 0; j < 3; ++j)
          EXPECT_NEAR(observer.external().force(j),
                      force(j) * (1.0 - std::exp(-settings.force_bandwidth(j) * t)), 1e-12);
        EXPECT_NEAR(observer.external().torque(axis),
                    about(axis) * (1.0 - std::exp(-settings.torque_bandwidth(axis) * t)), 1e-11);
      }
    }
  }
}

TEST(WrenchObserver, IsIndependentOfTimeStepForConstantInput) {
  WrenchObserverSettings settings;
  settings.max_gap = 1.0;
  WrenchObserverd coarse(body(), settings), fine(body(), settings);
  const Eigen::Vector3d a(1.0, 2.0, 9.0), w = Eigen::Vector3d::Zero();
  (void)coarse.update(0.0, {w, a}, {});
  (void)fine.update(0.0, {w, a}, {});
  for (int i = 1; i <= 7; ++i) (void)fine.update(0.1 * i, {w, a}, {});
  (void)coarse.update(0.7, {w, a}, {});
  EXPECT_LT((coarse.external().force - fine.external().force).norm(), 1e-12);
}

TEST(WrenchObserver, EstimatesExternalWrenchOfTumblingBody) {
  Random random(51);
  const RigidBodyd plant(body());
  const Wrenchd truth{Eigen::Vector3d(0.5, -0.3, 0.8), Eigen::Vector3d(0.02, -0.01, 0.03)};
  Stated x;
  x.body.angular_velocity << 1.0, -2.0, 0.5;
  WrenchObserverd observer(body());
  const double dt = 1e-3;
  Wrenchd applied;
  for (int i = 0; i <= 5000; ++i) {
    const double t = dt * i;
    (void)observer.update(t, {x.body.angular_velocity, (applied.force + truth.force) / body().mass},
                          applied);
    applied = {random.vector(2.0), -0.02 * x.body.angular_velocity};
    x.wrench = applied;
    x = plant.step(x, Eigen::Matrix<double, 6, 1>::Zero(), truth, dt);
  }
  EXPECT_LT((observer.external().force - truth.force).norm(), 1e-9);
  EXPECT_LT((observer.external().torque - truth.torque).norm(), 1e-5);
}

TEST(WrenchObserver, GyroscopicTorqueHasSecondOrderAccuracy) {
  const RigidBodyd plant(body());
  WrenchObserverSettings settings;
  settings.torque_bandwidth.setConstant(1e3);  // to see the raw residual
  std::array<double, 2> worst{};
  for (const std::size_t fine : {0U, 1U}) {
    const double dt = fine == 1U ? 0.005 : 0.01;
    WrenchObserverd observer(body(), settings);
    Stated x;
    x.body.angular_velocity << 3.0, -4.0, 5.0;
    for (int i = 0; i <= 100; ++i) {
      (void)observer.update(dt * i, {x.body.angular_velocity, Vector3d::Zero()}, {});
      worst[fine] = std::max(worst[fine], observer.external().torque.norm());
      x = plant.step(x, Eigen::Matrix<double, 6, 1>::Zero(), {}, dt);
    }
  }
  EXPECT_LT(worst[0], 1e-3);
  EXPECT_NEAR(worst[0] / worst[1], 4.0, 0.2);
}

TEST(WrenchObserver, InitialRateIsNotTorque) {
  WrenchObserverd observer(body());
  const Eigen::Vector3d w(0.0, 0.0, 3.0);
  EXPECT_EQ(observer.update(0.0, {w, Eigen::Vector3d::Zero()}, {}).status, ObserverStatus::started);
  EXPECT_EQ(observer.update(0.1, {w, Eigen::Vector3d::Zero()}, {}).status, ObserverStatus::updated);
  EXPECT_LT(observer.external().torque.norm(), 1e-15);
}

TEST(WrenchObserver, DeadBandAndLimitsAreContinuous) {
  WrenchObserverSettings settings;
  settings.force_dead_band << 0.5, 0.0, 0.2;
  settings.torque_dead_band << 0.0, 0.05, 0.1;
  settings.force_limit << 2.0, 3.0, infinity;
  settings.torque_limit << infinity, 0.3, 0.2;
  WrenchObserverd observer(body(), settings), plain(body());
  const auto expected = [](double x, double band, double limit) {
    const double size = std::min(std::max(std::abs(x) - band, 0.0), limit);
    return std::copysign(size, x);
  };
  Vector3d last = Vector3d::Zero();
  for (int i = 0; i <= 4000; ++i) {
    const double t = 0.01 * i;
    const Vector3d a = 4.0 * std::sin(0.5 * t) * Vector3d::Ones();
    const Vector3d w = 5.0 * std::sin(0.3 * t) * Vector3d::Ones();
    (void)observer.update(t, {w, a}, {});
    (void)plain.update(t, {w, a}, {});
    // Dead band and limits do not affect the internal filter.
    ASSERT_EQ(distance(observer.filtered(), plain.external()), 0.0);
    const Wrenchd& f = observer.filtered();
    for (int j = 0; j < 3; ++j) {
      ASSERT_NEAR(observer.external().force(j),
                  expected(f.force(j), settings.force_dead_band(j), settings.force_limit(j)),
                  1e-15);
      ASSERT_NEAR(observer.external().torque(j),
                  expected(f.torque(j), settings.torque_dead_band(j), settings.torque_limit(j)),
                  1e-15);
    }
    ASSERT_LT((observer.external().force - last).norm(), 0.1);
    last = observer.external().force;
  }
}

// Step response of a vehicle in hover in the simulated plant. A linear controller compensates the
// estimated wrench. Rotor speeds are measured with noise; tilt angles come from the servo model.
struct StepResponse {
  double force_time_constant = 0.0, torque_time_constant = 0.0;  // of a first-order lag [s]
  Vector3d force_bias = Vector3d::Zero(), torque_bias = Vector3d::Zero();
  double largest = 0.0;  // estimate [N, N m]
};

// The step comes after 2 s of hover. The area of the response is integrated over 30 time constants
// of 1/15 s. The bias is the mean over the last 10 s.
StepResponse step_response(double dt, const WrenchObserverSettings& settings, const Wrenchd& step) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body, settings);
  Plant<4> plant(vehicle);
  PlantState<4> start;
  start.body.position.z() = 2.0;
  start.actuators.rotor_speed.setConstant(
      speed_from_thrust(vehicle.body.mass * gravity / 4.0, vehicle.rotor));
  plant.reset(start);
  actuators.reset(start.actuators, 0.0);
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 1.0 / dt;
  imu_parameters.accelerometer_bias_walk = imu_parameters.gyro_bias_walk = 0.0;
  ImuSensor imu(imu_parameters, 7);
  RotorSpeedSensorParameters rotor_parameters;
  rotor_parameters.rate = imu_parameters.rate;
  RotorSpeedSensor<4> rotor_sensor(rotor_parameters, 8);

  StepResponse response;
  ActuatorState<4> command = start.actuators;
  const int begin = static_cast<int>(std::lround(2.0 / dt)), area = begin, settled = 3 * begin,
            end = settled + 5 * begin;
  Wrenchd sum;
  for (int i = 0; i < end; ++i) {
    const double time = plant.time();
    const BodyStated& x = plant.body();
    const auto m = imu.sample(time, x.angular_velocity, plant.specific_force());
    const ActuatorState<4> applied{
        rotor_sensor.sample(time, plant.actuators().rotor_speed)->rotor_speed,
        actuators.update(time, command).tilt_angle};
    EXPECT_NE(observer.update(time, *m, allocation.wrench(applied)).status,
              ObserverStatus::rejected);
    const Wrenchd& external = observer.external();
    response.largest = std::max({response.largest, external.force.cwiseAbs().maxCoeff(),
                                 external.torque.cwiseAbs().maxCoeff()});
    if (i > begin && i <= begin + area) {
      response.force_time_constant +=
          dt * (1.0 - external.force.dot(step.force) / step.force.squaredNorm());
      response.torque_time_constant +=
          dt * (1.0 - external.torque.dot(step.torque) / step.torque.squaredNorm());
    }
    if (i >= settled) {
      sum.force += external.force - step.force;
      sum.torque += external.torque - step.torque;
    }
    const Vector3d weight(0.0, 0.0, vehicle.body.mass * gravity);
    const Wrenchd wanted{
        x.orientation.conjugate() *
                Vector3d(weight - 3.0 * (x.position - start.body.position) - 4.0 * x.velocity) -
            external.force,
        -0.5 * quaternion_log(x.orientation) - 0.12 * x.angular_velocity - external.torque};
    command = allocation.allocate(wanted, command).command;
    actuators.update(time, command);
    EXPECT_TRUE(plant.step(command, i >= begin ? step : Wrenchd{}, dt));
  }
  // The sum over the samples after the step lacks half an interval of the trapezoidal rule at the
  // step.
  response.force_time_constant += dt / 2.0;
  response.torque_time_constant += dt / 2.0;
  response.force_bias = sum.force / (end - settled);
  response.torque_bias = sum.torque / (end - settled);
  return response;
}

const Wrenchd check_step{5.0 * Vector3d(2.0, -1.0, 2.0) / 3.0,
                         0.3 * Vector3d(1.0, 2.0, -2.0) / 3.0};

TEST(WrenchObserver, StepResponseHasBandwidthWithActuatorLagAndNoise) {
  double error = 0.0, force = 0.0, torque = 0.0;
  for (const double dt : {1e-3, 2e-3, 5e-3, 0.01, 0.02}) {
    const StepResponse response = step_response(dt, {}, check_step);
    const auto off = [](double constant) {
      return std::abs(constant * WrenchObserverSettings{}.force_bandwidth.x() - 1.0);
    };
    error =
        std::max({error, off(response.force_time_constant), off(response.torque_time_constant)});
    force = std::max(force, response.force_bias.cwiseAbs().maxCoeff());
    torque = std::max(torque, response.torque_bias.cwiseAbs().maxCoeff());
  }
  test_support::check_at_most(9, "observer: time constant's relative error", error, 0.1);
  test_support::check_at_most(9, "observer: bias [N]", force, 0.1);
  test_support::check_at_most(9, "observer: bias [N m]", torque, 0.01);
}

TEST(WrenchObserver, MeansBetweenTwoValuesCancelAVibration) {
  WrenchObserverd observer(body());
  ObservedWrenchd last = observer.observed();
  EXPECT_FALSE(means_between(last, last));
  // A vibration with the period of the tick: a single sample always has the same phase.
  const auto sample = [&](int i, double size) {
    const double a = size * std::sin(2.0 * pi * (i + 2) / 10.0);
    return observer.update(0.001 * i, {Vector3d::Constant(a), Vector3d(a, 0.0, 0.0)}, {});
  };
  for (int i = 0; i <= 1000; ++i) {
    const ObservedWrenchd now = sample(i, 5.0);
    if (i % 10 != 0) continue;
    if (i >= 500) {
      const auto means = means_between(last, now);
      ASSERT_TRUE(means);
      EXPECT_LT(means->external.force.norm(), 0.1 * now.external.force.norm());
      EXPECT_LT(means->raw.force.norm(), 0.1 * now.raw.force.norm());
      EXPECT_FALSE(means_between(now, now));
    }
    last = now;
  }
  const ObservedWrenchd one = sample(1001, 0.0);
  EXPECT_LT(distance(means_between(last, one)->external, one.external), 1e-9);
  EXPECT_LT(distance(means_between(last, one)->raw, one.raw), 1e-9);
  observer.reset();  // keeps the sums
  EXPECT_FALSE(means_between(one, observer.observed()));
  EXPECT_EQ(observer.observed().external.force, Vector3d::Zero());
}

TEST(WrenchObserver, UnfilteredWrenchHasMeansAndRejectsBadNumbers) {
  const auto push = [](double force) { return Wrenchd{{force, 0.0, 0.0}, {0.0, force, 0.0}}; };
  const ObservedWrenchd first = unfiltered_wrench({}, 5.0, push(1.0)),
                        second = unfiltered_wrench(first, 5.1, push(2.0)),
                        third = unfiltered_wrench(second, 5.4, push(4.0));
  EXPECT_EQ(first.status, ObserverStatus::started);
  EXPECT_FALSE(means_between({}, first));
  EXPECT_EQ(third.status, ObserverStatus::updated);
  EXPECT_NEAR(means_between(first, third)->external.force.x(), 3.5, 1e-12);
  EXPECT_NEAR(means_between(first, third)->raw.torque.y(), 3.5, 1e-12);
  for (const double bad : {std::nan(""), 1e7}) {
    const ObservedWrenchd rejected = unfiltered_wrench(third, 5.5, push(bad));
    EXPECT_EQ(rejected.status, ObserverStatus::rejected);
    EXPECT_EQ(rejected.external.force, third.external.force);
    EXPECT_EQ(rejected.duration, third.duration);
  }
  EXPECT_EQ(unfiltered_wrench(third, std::nan(""), push(1.0)).status, ObserverStatus::rejected);
  for (const double time : {5.0, 7.0})
    EXPECT_EQ(unfiltered_wrench(third, time, push(1.0)).duration, third.duration);
}

TEST(WrenchObserver, ObserverSettingsUseOneBandwidthForAllAxes) {
  const WrenchObserverSettings settings = observer_settings(25.0);
  EXPECT_EQ(settings.force_bandwidth, Vector3d::Constant(25.0));
  EXPECT_EQ(settings.torque_bandwidth, Vector3d::Constant(25.0));
  EXPECT_THROW(WrenchObserverd(body(), observer_settings(0.0)), std::invalid_argument);
}

TEST(WrenchObserver, IsStableForAnyBandwidth) {
  for (const double dt : {1e-3, 5e-3, 0.02}) {
    for (const double k_dt : {0.5, 1.0, 2.0, 5.0}) {
      WrenchObserverSettings settings;
      settings.force_bandwidth.setConstant(k_dt / dt);
      settings.torque_bandwidth.setConstant(k_dt / dt);
      const StepResponse response = step_response(dt, settings, check_step);
      // The largest component of the step is 3.33 N.
      EXPECT_LT(response.largest, 4.0) << "dt " << dt << ", K dt " << k_dt;
      EXPECT_LT(response.force_bias.norm(), 0.1) << "dt " << dt << ", K dt " << k_dt;
      EXPECT_LT(response.torque_bias.norm(), 0.01) << "dt " << dt << ", K dt " << k_dt;
    }
  }
}

TEST(WrenchObserver, WorksInSinglePrecision) {
  WrenchObserver<float> observer(body());
  const Eigen::Vector3f a(1.0f, 0.0f, 0.0f), w = Eigen::Vector3f::Zero();
  for (int i = 0; i <= 100; ++i) (void)observer.update(0.05 * i, {w, a}, {});
  EXPECT_NEAR(static_cast<double>(observer.external().force.x()), 1.5, 1e-5);
  // Also after three hours at 1 kHz, with dead band, limit and calibration.
  WrenchObserverSettings settings;
  settings.force_dead_band.setConstant(0.1);
  settings.torque_limit.setConstant(0.2);
  WrenchObserver<float> shaped(body(), settings);
  shaped.begin_calibration();
  const auto run = [&shaped, &a](double from, const Wrench<float>& applied) {
    for (int i = 0; i <= 2000; ++i)
      (void)shaped.update(from + 1e-3 * i, {Eigen::Vector3f::Zero(), a}, applied);
  };
  run(1e4, {});
  EXPECT_EQ(shaped.end_calibration(), CalibrationStatus::calibrated);
  EXPECT_NEAR(static_cast<double>(shaped.offset().force.x()), 1.5, 1e-5);
  run(1.1e4, {Eigen::Vector3f(-1.0f, 0.0f, 0.0f), Eigen::Vector3f(0.0f, 0.0f, 1.0f)});
  EXPECT_NEAR(static_cast<double>(shaped.external().force.x()), 0.9, 1e-3);
  EXPECT_EQ(shaped.external().torque.z(), -0.2f);
  EXPECT_EQ(shaped.trust(1.1e4 + 2.0), WrenchTrust::limited);
  shaped.reset();
  EXPECT_EQ(shaped.filtered().torque.z(), 0.0f);
}

TEST(WrenchObserver, WorksWithAutomaticDifferentiation) {
  using Dual = test_support::Dual<3>;
  WrenchObserverSettings settings;
  settings.force_dead_band.setConstant(0.1);
  settings.torque_limit.z() = 1e-3;
  const double passed = -std::expm1(-15.0 * 0.01);
  // With respect to the specific force the derivative is the mass times the filter's gain. The dead
  // band does not change it.
  const Eigen::Matrix3d by_force = test_support::jacobian_at_zero<3, 3>([&](const auto& step) {
    WrenchObserver<Dual> observer(body(), settings);
    const Vector3<Dual> a = Vector3d(5.0, -5.0, 9.0).cast<Dual>() + step;
    const Vector3<Dual> w = Vector3d::Zero().cast<Dual>();
    (void)observer.update(0.0, {w, a}, {});
    (void)observer.update(0.01, {w, a}, {});
    return observer.external().force;
  });
  EXPECT_LT((by_force - passed * body().mass * Eigen::Matrix3d::Identity()).norm(), 1e-12);
  // With respect to a rate about z the derivative is zero, because the torque is clamped.
  const Eigen::Matrix3d by_rate = test_support::jacobian_at_zero<3, 3>([&](const auto& step) {
    WrenchObserver<Dual> observer(body(), settings);
    const Vector3<Dual> zero = Vector3d::Zero().cast<Dual>();
    (void)observer.update(0.0, {zero, zero}, {});
    (void)observer.update(0.01, {Vector3<Dual>(Vector3d(0, 0, 0.1).cast<Dual>() + step), zero}, {});
    return observer.external().torque;
  });
  EXPECT_NEAR(by_rate(0, 0), passed * body().inertia(0, 0) / 0.01, 1e-3);
  EXPECT_EQ(by_rate.row(2).norm(), 0.0);
}

}  // namespace wrench_observer_test
}  // namespace tilt_ropter
