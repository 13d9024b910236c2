#include <tilt_ropter/estimation/wrench_observer.hpp>

#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/random.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/wrench.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

namespace tilt_ropter {
namespace {

using Eigen::Vector3d;
using test_support::Random;

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double nan = std::numeric_limits<double>::quiet_NaN();

RigidBodyParameters body() {
  return tilt_ropter_vehicle().body;
}

TEST(WrenchObserver, StepResponseIsTheClosedFormForAnyStep) {
  const Eigen::Vector3d force(5.0, -3.0, 1.0), torque(0.3, -0.1, 0.2);
  WrenchObserverSettings settings;
  settings.force_bandwidth << 2.0, 5.0, 20.0;
  settings.torque_bandwidth << 3.0, 6.0, 25.0;
  settings.max_gap = 2.0;
  for (const double dt : {1e-3, 5e-3, 0.02, 0.1, 0.25, 1.0}) {  // dt K up to 25
    WrenchObserver<> observer(body(), settings);
    // At rest apart from the step: w(t) = J^-1 M t about each axis in turn would couple, so each
    // torque axis is tried alone; the force does not care.
    for (int axis = 0; axis < 3; ++axis) {
      observer.reset();
      const Eigen::Vector3d about = torque(axis) * Eigen::Vector3d::Unit(axis);
      for (int i = 0; i <= 40; ++i) {
        const double t = dt * i;
        const Eigen::Vector3d w = body().inertia.inverse() * about * t;
        observer.update(t, {w, force / body().mass}, {});
        for (int j = 0; j < 3; ++j)
          EXPECT_NEAR(observer.external().force(j),
                      force(j) * (1.0 - std::exp(-settings.force_bandwidth(j) * t)), 1e-12);
        EXPECT_NEAR(observer.external().torque(axis),
                    about(axis) * (1.0 - std::exp(-settings.torque_bandwidth(axis) * t)), 1e-11);
      }
    }
  }
}

TEST(WrenchObserver, DoesNotDependOnHowTimeIsDivided) {
  WrenchObserverSettings settings;
  settings.max_gap = 1.0;
  WrenchObserver<> coarse(body(), settings), fine(body(), settings);
  const Eigen::Vector3d a(1.0, 2.0, 9.0), w = Eigen::Vector3d::Zero();
  coarse.update(0.0, {w, a}, {});
  fine.update(0.0, {w, a}, {});
  for (int i = 1; i <= 7; ++i) fine.update(0.1 * i, {w, a}, {});
  coarse.update(0.7, {w, a}, {});
  EXPECT_LT((coarse.external().force - fine.external().force).norm(), 1e-12);
}

TEST(WrenchObserver, FindsTheExternalWrenchOfATumblingBody) {
  Random random(51);
  const RigidBody<> plant(body());
  const Wrench<> truth{Eigen::Vector3d(0.5, -0.3, 0.8), Eigen::Vector3d(0.02, -0.01, 0.03)};
  State<> x;
  x.body.angular_velocity << 1.0, -2.0, 0.5;
  WrenchObserver<> observer(body());
  const double dt = 1e-3;
  Wrench<> applied;
  for (int i = 0; i <= 5000; ++i) {
    const double t = dt * i;
    observer.update(t, {x.body.angular_velocity, (applied.force + truth.force) / body().mass},
                    applied);
    applied = {random.vector(2.0), -0.02 * x.body.angular_velocity};
    x.wrench = applied;
    x = plant.step(x, Eigen::Matrix<double, 6, 1>::Zero(), truth, dt);
  }
  EXPECT_LT((observer.external().force - truth.force).norm(), 1e-9);
  EXPECT_LT((observer.external().torque - truth.torque).norm(), 1e-5);
}

TEST(WrenchObserver, GyroscopicTorqueIsOfSecondOrderInTheStep) {
  const RigidBody<> plant(body());
  WrenchObserverSettings settings;
  settings.torque_bandwidth.setConstant(1e3);  // to see the raw residual
  std::array<double, 2> worst{};
  for (const std::size_t fine : {0U, 1U}) {
    const double dt = fine == 1U ? 0.005 : 0.01;
    WrenchObserver<> observer(body(), settings);
    State<> x;
    x.body.angular_velocity << 3.0, -4.0, 5.0;
    for (int i = 0; i <= 100; ++i) {
      observer.update(dt * i, {x.body.angular_velocity, Vector3d::Zero()}, {});
      worst[fine] = std::max(worst[fine], observer.external().torque.norm());
      x = plant.step(x, Eigen::Matrix<double, 6, 1>::Zero(), {}, dt);
    }
  }
  EXPECT_LT(worst[0], 1e-3);
  EXPECT_NEAR(worst[0] / worst[1], 4.0, 0.2);
}

TEST(WrenchObserver, AnInitialRateIsNotATorque) {
  WrenchObserver<> observer(body());
  const Eigen::Vector3d w(0.0, 0.0, 3.0);
  EXPECT_EQ(observer.update(0.0, {w, Eigen::Vector3d::Zero()}, {}), ObserverStatus::started);
  EXPECT_EQ(observer.update(0.1, {w, Eigen::Vector3d::Zero()}, {}), ObserverStatus::updated);
  EXPECT_LT(observer.external().torque.norm(), 1e-15);
}

TEST(WrenchObserver, BadSamplesAreRejectedAndChangeNothing) {
  WrenchObserver<> observer(body());
  const Eigen::Vector3d a(1.0, 0.0, 9.0), w(0.1, 0.0, 0.0);
  observer.update(0.0, {w, a}, {});
  observer.update(0.1, {w, a}, {});
  const Wrench<> before = observer.external();
  const Eigen::Vector3d bad(0.0, nan, 0.0), huge = Eigen::Vector3d::Constant(1e300);
  EXPECT_EQ(observer.update(nan, {w, a}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(infinity, {w, a}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.1, {w, a}, {}), ObserverStatus::rejected);  // time stands
  EXPECT_EQ(observer.update(0.05, {w, a}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, {w, bad}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, {bad, a}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, {huge, a}, {}), ObserverStatus::rejected);  // overflows
  EXPECT_EQ(observer.update(0.2, {w, a}, {bad, w}), ObserverStatus::rejected);
  EXPECT_EQ(observer.external().force, before.force);
  EXPECT_EQ(observer.external().torque, before.torque);
  EXPECT_EQ(observer.update(0.2, {w, a}, {}), ObserverStatus::updated);
}

// Feeds an observer with a body on which a wrench acts and no actuator, at 100 Hz.
class Feed {
 public:
  explicit Feed(WrenchObserver<>& observer) : observer_(observer) {}

  ObserverStatus operator()(const Wrench<>& wrench, double dt = 0.01) {
    time_ += dt;
    // About x alone there is no gyroscopic torque.
    rate_.x() += wrench.torque.x() / body().inertia(0, 0) * dt;
    return observer_.update(time_, {rate_, wrench.force / body().mass}, {});
  }
  void operator()(const Wrench<>& wrench, int samples) {
    for (int i = 0; i < samples; ++i) (*this)(wrench);
  }
  [[nodiscard]] double time() const { return time_; }

 private:
  WrenchObserver<>& observer_;
  double time_ = 0.0;
  Vector3d rate_ = Vector3d::Zero();
};

double distance(const Wrench<>& a, const Wrench<>& b) {
  return (a.force - b.force).norm() + (a.torque - b.torque).norm();
}

const Wrench<> pushed{Vector3d(2.0, -1.0, 0.5), Vector3d(0.2, 0.0, 0.0)};

TEST(WrenchObserver, NothingIsConcludedOverAGap) {
  WrenchObserver<> observer(body());
  Feed feed(observer);
  feed(pushed, 300);
  const Wrench<> before = observer.filtered();
  EXPECT_LT(distance(before, pushed), 1e-5);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  // Meanwhile something else pushed: neither its force nor its momentum is believed.
  EXPECT_EQ(feed({Vector3d(50, 0, 0), Vector3d(3, 0, 0)}, 0.11), ObserverStatus::gap);
  EXPECT_EQ(distance(observer.filtered(), before), 0.0);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  EXPECT_EQ(feed(pushed), ObserverStatus::updated);
  EXPECT_LT(distance(observer.filtered(), pushed), 1e-5);

  WrenchObserverSettings patient;
  patient.max_gap = 0.12;
  WrenchObserver<> other(body(), patient);
  Feed feed_other(other);
  feed_other(pushed, 2);
  EXPECT_EQ(feed_other(pushed, 0.11), ObserverStatus::updated);
}

TEST(WrenchObserver, AClockThatJumpsBackDoesNotLockIt) {
  WrenchObserver<> observer(body());
  const Vector3d a(1.0, 0.0, 0.0), w = Vector3d::Zero();
  observer.update(100.0, {w, a}, {});
  observer.update(100.01, {w, a}, {});
  const Wrench<> before = observer.external();
  EXPECT_EQ(observer.update(99.95, {w, a}, {}), ObserverStatus::rejected);  // late
  EXPECT_EQ(observer.update(5.0, {w, a}, {}), ObserverStatus::gap);
  EXPECT_EQ(distance(observer.external(), before), 0.0);
  EXPECT_EQ(observer.update(5.01, {w, a}, {}), ObserverStatus::updated);
}

TEST(WrenchObserver, SaysWhetherItCanBeTrusted) {
  WrenchObserverSettings settings;
  settings.force_bandwidth << 10.0, 6.0, 10.0;
  settings.torque_bandwidth << 7.0, 8.0, 9.0;
  settings.force_limit.y() = 2.0;
  settings.torque_limit.x() = 0.3;
  WrenchObserver<> observer(body(), settings);
  EXPECT_EQ(observer.trust(0.0), WrenchTrust::not_started);
  Feed feed(observer);
  // 3 / K of the slowest axis is half a second.
  feed(pushed, 50);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  EXPECT_GT(std::abs(observer.filtered().force.y() + 1.0), 0.04);
  feed(pushed, 2);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  EXPECT_LT(std::abs(observer.filtered().force.y() + 1.0), 0.05);

  EXPECT_EQ(observer.trust(feed.time() + 0.09), WrenchTrust::trusted);
  EXPECT_EQ(observer.trust(feed.time() + 0.11), WrenchTrust::stale);
  EXPECT_EQ(observer.trust(feed.time() - 0.11), WrenchTrust::stale);
  EXPECT_EQ(observer.trust(nan), WrenchTrust::stale);
  EXPECT_EQ(observer.update(feed.time() + 0.2, {Vector3d::Zero(), Vector3d(nan, 0, 0)}, {}),
            ObserverStatus::rejected);
  EXPECT_EQ(observer.trust(feed.time() + 0.2), WrenchTrust::stale);

  Wrench<> more = pushed;
  more.force.y() = -2.5;
  feed(more, 100);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::limited);
  feed(pushed, 100);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  more = pushed;
  more.torque.x() = 0.35;
  feed(more, 100);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::limited);
  feed(pushed, 100);

  observer.reset();
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::not_started);
  feed(pushed);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  feed(pushed, 60);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  observer.set_offset(pushed);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  feed(pushed, 60);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  observer.reset();
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::not_started);
  EXPECT_EQ(distance(observer.external(), {}), 0.0);
  EXPECT_EQ(distance(observer.filtered(), {}), 0.0);
}

TEST(WrenchObserver, TheSlowestAxisOfTorqueIsWaitedForToo) {
  WrenchObserverSettings settings;
  settings.torque_bandwidth.z() = 2.0;
  WrenchObserver<> observer(body(), settings);
  Feed feed(observer);
  feed(pushed, 150);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  feed(pushed, 3);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
}

TEST(WrenchObserver, DeadBandAndLimitsShapeTheOutputWithoutJumps) {
  WrenchObserverSettings settings;
  settings.force_dead_band << 0.5, 0.0, 0.2;
  settings.torque_dead_band << 0.0, 0.05, 0.1;
  settings.force_limit << 2.0, 3.0, infinity;
  settings.torque_limit << infinity, 0.3, 0.2;
  WrenchObserver<> observer(body(), settings), plain(body());
  const auto expected = [](double x, double band, double limit) {
    const double size = std::min(std::max(std::abs(x) - band, 0.0), limit);
    return std::copysign(size, x);
  };
  Vector3d last = Vector3d::Zero();
  for (int i = 0; i <= 4000; ++i) {
    const double t = 0.01 * i;
    const Vector3d a = 4.0 * std::sin(0.5 * t) * Vector3d::Ones();
    const Vector3d w = 5.0 * std::sin(0.3 * t) * Vector3d::Ones();
    observer.update(t, {w, a}, {});
    plain.update(t, {w, a}, {});
    // What is not seen goes on inside.
    ASSERT_EQ(distance(observer.filtered(), plain.external()), 0.0);
    const Wrench<>& f = observer.filtered();
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

TEST(WrenchObserver, CalibrationOnTheGroundFindsTheAccelerometersBias) {
  const double weight = body().mass * gravity;
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 1000.0;
  imu_parameters.accelerometer_bias << 0.2, -0.1, 0.3;
  imu_parameters.gyro_bias << 0.05, -0.02, 0.03;
  imu_parameters.accelerometer_bias_walk = imu_parameters.gyro_bias_walk = 0.0;
  ImuSensor imu(imu_parameters, 5);
  WrenchObserver<> observer(body());
  const Wrench<> ground{Vector3d(0, 0, weight), Vector3d::Zero()};
  const Vector3d bias = body().mass * imu_parameters.accelerometer_bias;
  const auto stand = [&](double from, double to) {
    for (double time = from; time < to; time += 1e-3) {
      // None where one stretch ends and the next begins within rounding.
      if (const auto m = imu.sample(time, Vector3d::Zero(), ground.force / body().mass))
        observer.update(time, *m, {});
    }
  };
  stand(0.0, 1.0);
  observer.begin_calibration();
  stand(1.0, 3.0);
  const Wrench<> before = observer.external();
  EXPECT_NEAR((before.force - ground.force - bias).norm(), 0.0, 0.1);
  EXPECT_EQ(observer.end_calibration(ground), CalibrationStatus::calibrated);
  EXPECT_EQ(distance(observer.external(), before), 0.0);  // no jump
  EXPECT_LT((observer.offset().force - bias).norm(), 0.02);
  EXPECT_LT(observer.offset().torque.norm(), 1e-3);
  stand(3.0, 6.0);
  EXPECT_LT((observer.external().force - ground.force).norm(), 0.05);

  // Sensors keep their faults when an estimate is forgotten, and a second calibration measures the
  // raw residual, not what the first one left.
  observer.reset();
  EXPECT_LT((observer.offset().force - bias).norm(), 0.02);
  stand(7.0, 7.5);
  observer.begin_calibration();
  stand(7.5, 9.5);
  EXPECT_EQ(observer.end_calibration(ground), CalibrationStatus::calibrated);
  EXPECT_LT((observer.offset().force - bias).norm(), 0.02);
}

TEST(WrenchObserver, CalibrationTakesTheResidualLessWhatIsKnown) {
  // Samples come unevenly; each counts for its time.
  WrenchObserver<> observer(body());
  Feed feed(observer);
  Random random(52);
  feed({}, 10);
  observer.begin_calibration();
  double time = 0.0;
  Wrench<> sum;
  while (time < 20.0) {
    const double dt = random.uniform(1e-3, 0.05);
    // Less where samples are dense, so that counting them would give another mean.
    const Wrench<> wrench{dt < 0.02 ? Vector3d(0.1, 0.2, 0.3) : Vector3d(0.3, 0.2, 0.1),
                          Vector3d(dt < 0.02 ? 0.01 : 0.03, 0, 0)};
    EXPECT_EQ(feed(wrench, dt), ObserverStatus::updated);
    time += dt;
    sum.force += dt * wrench.force;
    sum.torque += dt * wrench.torque;
  }
  const Wrench<> known{Vector3d(0.1, 0.0, -0.1), Vector3d(0.02, 0.0, 0.0)};
  EXPECT_EQ(observer.end_calibration(known), CalibrationStatus::calibrated);
  EXPECT_LT((observer.offset().force + known.force - sum.force / time).norm(), 1e-3);
  EXPECT_LT((observer.offset().torque + known.torque - sum.torque / time).norm(), 1e-4);
  const Wrench<> more{observer.offset().force + pushed.force,
                      observer.offset().torque + pushed.torque};
  feed(more, 400);
  EXPECT_LT(distance(observer.external(), pushed), 1e-6);
}

TEST(WrenchObserver, CalibrationIsRefusedForAReason) {
  WrenchObserver<> observer(body());
  Feed feed(observer);
  const Wrench<> old{Vector3d(0.1, 0.2, 0.3), Vector3d(0.01, 0.02, 0.03)};
  observer.set_offset(old);
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::not_begun);
  feed({}, 10);
  observer.begin_calibration();
  feed({}, 95);
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::too_short);
  EXPECT_EQ(observer.end_calibration(), CalibrationStatus::not_begun);

  // A push half of the time: of 1.2 N the deviation is 0.6 N, of 0.8 N 0.4 N.
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

  // One that was forgotten, or begun anew.
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

TEST(WrenchObserver, SettingsOfTheCalibrationAct) {
  const auto calibrate = [](const WrenchObserverSettings& settings) {
    WrenchObserver<> observer(body(), settings);
    Feed feed(observer);
    feed({}, 10);
    observer.begin_calibration();
    feed({}, 100);
    feed({Vector3d(0.8, 0, 0), Vector3d(0.08, 0, 0)}, 100);
    return observer.end_calibration();
  };
  EXPECT_EQ(calibrate({}), CalibrationStatus::calibrated);
  WrenchObserverSettings settings;
  settings.min_calibration_time = 2.1;
  EXPECT_EQ(calibrate(settings), CalibrationStatus::too_short);
  settings = {};
  settings.max_force_deviation = 0.3;
  EXPECT_EQ(calibrate(settings), CalibrationStatus::moved);
  settings = {};
  settings.max_torque_deviation = 0.03;
  EXPECT_EQ(calibrate(settings), CalibrationStatus::moved);
}

TEST(WrenchObserver, OffsetsComeBackFromAFile) {
  WrenchObserver<> observer(body());
  observer.set_offset(pushed);
  observer.set_offset({Vector3d(nan, 0, 0), Vector3d::Zero()});
  observer.set_offset({Vector3d(0, 1e7, 0), Vector3d::Zero()});
  EXPECT_EQ(distance(observer.offset(), pushed), 0.0);
  EXPECT_EQ(distance(observer.external(), {}), 0.0);
  Feed feed(observer);
  feed(pushed, 10);
  EXPECT_LT(distance(observer.external(), {}), 1e-12);
}

// A vehicle hovers in the simulated plant, by a plain linear controller that makes up for the
// estimated wrench; rotor speeds are measured with noise, tilt angles come from the servos' model.
struct StepResponse {
  double force_time_constant = 0.0, torque_time_constant = 0.0;  // of a first-order lag [s]
  Vector3d force_bias = Vector3d::Zero(), torque_bias = Vector3d::Zero();
  double largest = 0.0;  // estimate [N, N m]
};

// The step comes after two seconds of hover; its area is taken over thirty time constants of 1/15 s
// and the bias over the last ten seconds.
StepResponse step_response(double dt, const WrenchObserverSettings& settings,
                           const Wrench<>& step) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserver<> observer(vehicle.body, settings);
  Plant<4> plant(vehicle);
  PlantState<4> start;
  start.body.position.z() = 2.0;
  start.actuators.rotor_speed.setConstant(
      speed_from_thrust(vehicle.body.mass * gravity / 4.0, vehicle.rotor.thrust_coefficient));
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
  Wrench<> sum;
  for (int i = 0; i < end; ++i) {
    const double time = plant.time();
    const BodyState<>& x = plant.body();
    const auto m = imu.sample(time, x.angular_velocity, plant.specific_force());
    const ActuatorState<4> applied{
        rotor_sensor.sample(time, plant.actuators().rotor_speed)->rotor_speed,
        actuators.update(time, command).tilt_angle};
    EXPECT_NE(observer.update(time, *m, allocation.wrench(applied)), ObserverStatus::rejected);
    const Wrench<>& external = observer.external();
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
    const Wrench<> wanted{
        x.orientation.conjugate() *
                Vector3d(weight - 3.0 * (x.position - start.body.position) - 4.0 * x.velocity) -
            external.force,
        -0.5 * quaternion_log(x.orientation) - 0.12 * x.angular_velocity - external.torque};
    command = allocation.allocate(wanted, command).command;
    actuators.update(time, command);
    EXPECT_TRUE(plant.step(command, i >= begin ? step : Wrench<>{}, dt));
  }
  // The sum over samples after the step misses half an interval of the trapezoid at the step.
  response.force_time_constant += dt / 2.0;
  response.torque_time_constant += dt / 2.0;
  response.force_bias = sum.force / (end - settled);
  response.torque_bias = sum.torque / (end - settled);
  return response;
}

const Wrench<> check_step{5.0 * Vector3d(2.0, -1.0, 2.0) / 3.0,
                          0.3 * Vector3d(1.0, 2.0, -2.0) / 3.0};

TEST(WrenchObserver, StepUnderActuatorLagAndNoiseIsSeenWithItsBandwidth) {
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

TEST(WrenchObserver, TakenEstimatesAreTheMeanSinceTheLast) {
  WrenchObserver<> observer(body());
  EXPECT_EQ(observer.take_external().force, Vector3d::Zero());
  // A vibration whose period is the tick: a single sample always sees the same phase.
  const auto sample = [&](int i, double size) {
    const double a = size * std::sin(2.0 * pi * (i + 2) / 10.0);
    return observer.update(0.001 * i, {Vector3d::Constant(a), Vector3d(a, 0.0, 0.0)}, {});
  };
  for (int i = 0; i <= 1000; ++i) {
    (void)sample(i, 5.0);
    if (i % 10 != 0) continue;
    const Vector3d one = observer.external().force, mean = observer.take_external().force;
    if (i < 500) continue;
    EXPECT_LT(mean.norm(), 0.1 * one.norm());
    EXPECT_EQ(observer.take_external().force, one);  // no new sample
  }
  (void)sample(1001, 0.0);
  EXPECT_EQ(observer.take_external().torque, observer.external().torque);  // the mean of one
  (void)sample(1002, 9.0);
  observer.reset();
  EXPECT_EQ(observer.take_external().force, Vector3d::Zero());
}

TEST(WrenchObserver, OneBandwidthIsForAllAxes) {
  const WrenchObserverSettings settings = observer_settings(25.0);
  EXPECT_EQ(settings.force_bandwidth, Vector3d::Constant(25.0));
  EXPECT_EQ(settings.torque_bandwidth, Vector3d::Constant(25.0));
  EXPECT_THROW(WrenchObserver<>(body(), observer_settings(0.0)), std::invalid_argument);
}

TEST(WrenchObserver, IsStableForAnyBandwidth) {
  for (const double dt : {1e-3, 5e-3, 0.02}) {
    for (const double k_dt : {0.5, 1.0, 2.0, 5.0}) {
      WrenchObserverSettings settings;
      settings.force_bandwidth.setConstant(k_dt / dt);
      settings.torque_bandwidth.setConstant(k_dt / dt);
      const StepResponse response = step_response(dt, settings, check_step);
      // The step's largest part is 3.33 N.
      EXPECT_LT(response.largest, 4.0) << "dt " << dt << ", K dt " << k_dt;
      EXPECT_LT(response.force_bias.norm(), 0.1) << "dt " << dt << ", K dt " << k_dt;
      EXPECT_LT(response.torque_bias.norm(), 0.01) << "dt " << dt << ", K dt " << k_dt;
    }
  }
}

TEST(WrenchObserver, AnyNumbersAreSurvived) {
  Random random(53);
  const auto pick = [&random](const std::array<double, 9>& values) {
    return values[static_cast<std::size_t>(random.uniform(0.0, 9.0))];
  };
  const double denormal = std::numeric_limits<double>::denorm_min();
  const std::array<double, 9> bad = {nan,   infinity, -infinity, 0.0, denormal,
                                     1e300, -1e300,   1.0,       1e6};
  // Mostly harmless, so that every argument's check is seen alone too.
  const auto number = [&] { return random.uniform(0.0, 1.0) < 0.1 ? pick(bad) : 0.1; };
  const auto vector = [&] {
    const double x = number(), y = number();
    return Vector3d(x, y, number());
  };
  const auto wrench = [&] {
    const Vector3d force = vector();
    return Wrench<>{force, vector()};
  };
  WrenchObserverSettings settings;
  settings.force_limit.setConstant(20.0);
  settings.torque_limit.setConstant(2.0);
  WrenchObserver<> observer(body(), settings);
  std::array<int, 4> statuses{};
  std::array<int, 5> calibrations{};
  const Vector3d none = Vector3d::Zero();
  double good_time = 1000.0;
  const auto expect_finite = [&] {
    ASSERT_TRUE(is_finite(observer.filtered()) && is_finite(observer.offset()));
    ASSERT_LE(observer.external().force.cwiseAbs().maxCoeff(), 20.0);
    ASSERT_LE(observer.external().torque.cwiseAbs().maxCoeff(), 2.0);
  };
  for (int i = 0; i < 1000000; ++i) {
    const std::array<double, 9> times = {
        nan,       infinity,        -infinity, 0.0, denormal, 1e300, good_time - 0.01,
        good_time, good_time + 10.0};
    const double time = pick(times);
    const Vector3d a = vector(), w = vector();
    const Wrench<> applied = wrench();
    const Wrench<> before = observer.filtered(), shown = observer.external();
    const ObserverStatus status = observer.update(time, {w, a}, applied);
    ++statuses[static_cast<std::size_t>(status)];
    if (status != ObserverStatus::updated) {
      ASSERT_EQ(distance(observer.filtered(), before), 0.0);
      ASSERT_EQ(distance(observer.external(), shown), 0.0);
    }
    if (!std::isfinite(time) || !all_finite(a) || !all_finite(w) || !is_finite(applied)) {
      ASSERT_EQ(status, ObserverStatus::rejected);
    }
    ASSERT_NO_FATAL_FAILURE(expect_finite());
    if (i % 11 == 0) observer.set_offset(wrench());
    if (i % 13 == 0) observer.begin_calibration();
    if (i % 17 == 0) ++calibrations[static_cast<std::size_t>(observer.end_calibration(wrench()))];
    ASSERT_NO_FATAL_FAILURE(expect_finite());
    if (!std::isfinite(time)) {
      ASSERT_NE(observer.trust(time), WrenchTrust::trusted);
    }
    if (i % 100 != 99) continue;
    // The next good samples do what they should.
    observer.set_offset({});
    observer.reset();
    good_time += 0.01;
    ASSERT_NE(observer.update(good_time, {none, none}, {}), ObserverStatus::rejected);
    for (int k = 0; k < 3; ++k) {
      good_time += 0.01;
      ASSERT_EQ(observer.update(good_time, {none, Vector3d::UnitX()}, {}), ObserverStatus::updated);
    }
    ASSERT_NEAR(observer.external().force.x(), body().mass * -std::expm1(-0.45), 1e-9);
    ASSERT_EQ(observer.external().torque.norm(), 0.0);
  }
  EXPECT_GT(statuses[static_cast<std::size_t>(ObserverStatus::updated)], 0);
  EXPECT_EQ(statuses[static_cast<std::size_t>(ObserverStatus::started)], 1);
  EXPECT_GT(statuses[static_cast<std::size_t>(ObserverStatus::gap)], 0);
  EXPECT_GT(statuses[static_cast<std::size_t>(ObserverStatus::rejected)], 0);
  EXPECT_GT(calibrations[static_cast<std::size_t>(CalibrationStatus::too_short)], 0);
}

TEST(WrenchObserver, FiniteNumbersThatNoSensorMeansAreNotKept) {
  WrenchObserver<> observer(body());
  const Vector3d none = Vector3d::Zero(), huge(0.0, 1e100, 0.0);
  EXPECT_EQ(observer.update(0.0, {huge, none}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.0, {none, none}, {}), ObserverStatus::started);
  EXPECT_EQ(observer.update(0.01, {none, huge}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.01, {none, none}, {huge, none}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.01, {none, none}, {none, huge}), ObserverStatus::rejected);
  // A time step of next to nothing.
  EXPECT_EQ(observer.update(1e-300, {Vector3d::Ones(), none}, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.01, {none, none}, {}), ObserverStatus::updated);
  EXPECT_EQ(distance(observer.external(), {}), 0.0);
}

TEST(WrenchObserver, WorksInSinglePrecision) {
  WrenchObserver<float> observer(body());
  const Eigen::Vector3f a(1.0f, 0.0f, 0.0f), w = Eigen::Vector3f::Zero();
  for (int i = 0; i <= 100; ++i) observer.update(0.05 * i, {w, a}, {});
  EXPECT_NEAR(static_cast<double>(observer.external().force.x()), 1.5, 1e-5);
  // After three hours at 1 kHz too, and with all that shapes and calibrates.
  WrenchObserverSettings settings;
  settings.force_dead_band.setConstant(0.1);
  settings.torque_limit.setConstant(0.2);
  WrenchObserver<float> shaped(body(), settings);
  shaped.begin_calibration();
  const auto run = [&shaped, &a](double from, const Wrench<float>& applied) {
    for (int i = 0; i <= 2000; ++i)
      shaped.update(from + 1e-3 * i, {Eigen::Vector3f::Zero(), a}, applied);
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

TEST(WrenchObserver, WorksWithDerivatives) {
  using Dual = test_support::Dual<3>;
  WrenchObserverSettings settings;
  settings.force_dead_band.setConstant(0.1);
  settings.torque_limit.z() = 1e-3;
  const double passed = -std::expm1(-15.0 * 0.01);
  // By the specific force the mass comes through the filter, the dead band changes nothing.
  const Eigen::Matrix3d by_force = test_support::jacobian_at_zero<3, 3>([&](const auto& step) {
    WrenchObserver<Dual> observer(body(), settings);
    const Vector3<Dual> a = Vector3d(5.0, -5.0, 9.0).cast<Dual>() + step;
    const Vector3<Dual> w = Vector3d::Zero().cast<Dual>();
    observer.update(0.0, {w, a}, {});
    observer.update(0.01, {w, a}, {});
    return observer.external().force;
  });
  EXPECT_LT((by_force - passed * body().mass * Eigen::Matrix3d::Identity()).norm(), 1e-12);
  // By a rate about z the torque is cut: no derivative there.
  const Eigen::Matrix3d by_rate = test_support::jacobian_at_zero<3, 3>([&](const auto& step) {
    WrenchObserver<Dual> observer(body(), settings);
    const Vector3<Dual> zero = Vector3d::Zero().cast<Dual>();
    observer.update(0.0, {zero, zero}, {});
    observer.update(0.01, {Vector3<Dual>(Vector3d(0, 0, 0.1).cast<Dual>() + step), zero}, {});
    return observer.external().torque;
  });
  EXPECT_NEAR(by_rate(0, 0), passed * body().inertia(0, 0) / 0.01, 1e-3);
  EXPECT_EQ(by_rate.row(2).norm(), 0.0);
}

TEST(WrenchObserver, SettingsOutOfRangeAreRefused) {
  const auto message = [](const auto& change) {
    WrenchObserverSettings settings;
    change(settings);
    try {
      WrenchObserver<> observer(body(), settings);
    } catch (const std::invalid_argument& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  const auto expect_refused = [&message](const std::string& field, auto WrenchObserverSettings::*m,
                                         const std::vector<double>& values) {
    for (const double value : values) {
      const std::string text = message([&](WrenchObserverSettings& s) {
        if constexpr (std::is_same_v<decltype(s.*m), double&>)
          s.*m = value;
        else
          (s.*m).y() = value;
      });
      EXPECT_NE(text.find("WrenchObserverSettings." + field + " ["), std::string::npos)
          << field << " = " << value << ": " << text;
    }
  };
  using S = WrenchObserverSettings;
  const std::vector<double> not_positive = {0.0, -1.0, nan, infinity};
  expect_refused("force_bandwidth", &S::force_bandwidth, not_positive);
  expect_refused("torque_bandwidth", &S::torque_bandwidth, not_positive);
  expect_refused("force_dead_band", &S::force_dead_band, {-1.0, nan, infinity});
  expect_refused("torque_dead_band", &S::torque_dead_band, {-1.0, nan, infinity});
  expect_refused("force_limit", &S::force_limit, {0.0, -1.0, nan});
  expect_refused("torque_limit", &S::torque_limit, {0.0, -1.0, nan});
  expect_refused("max_gap", &S::max_gap, not_positive);
  expect_refused("min_calibration_time", &S::min_calibration_time, not_positive);
  expect_refused("max_force_deviation", &S::max_force_deviation, not_positive);
  expect_refused("max_torque_deviation", &S::max_torque_deviation, not_positive);
  EXPECT_EQ(message([](S&) {}), "");
  RigidBodyParameters b = body();
  b.mass = std::nan("");
  EXPECT_THROW(WrenchObserver<>{b}, std::invalid_argument);
}

}  // namespace
}  // namespace tilt_ropter
