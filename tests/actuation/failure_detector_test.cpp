#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>

#include "support/failing_body.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

namespace tilt_ropter {
namespace failure_detector_test {

constexpr double degree = pi / 180.0;

using test_support::FailingBody;
using test_support::FailingFlight;

TEST(FailureDetector, FindsEveryFailureAtAnyRate) {
  for (const double rate : {50.0, 100.0, 1000.0})
    for (std::size_t rotor = 0; rotor < 4; ++rotor)
      for (const ActuatorFailure& failure :
           {ActuatorFailure{FailureKind::servo, rotor, 90.0 * degree, 1.0, 0.0},
            ActuatorFailure{FailureKind::servo, rotor, -35.0 * degree, 1.0, 0.0},
            ActuatorFailure{FailureKind::servo, rotor, 180.0 * degree, 1.0, 0.0},
            ActuatorFailure{FailureKind::rotor, rotor, 0.0, 0.0, 0.0},
            ActuatorFailure{FailureKind::rotor, rotor, 0.0, 0.5, 0.0}}) {
        const std::string name = std::string(to_string(failure.kind)) + " " +
                                 std::to_string(rotor) + " at " + std::to_string(rate) + " Hz";
        FailureDetector<4> detector(tilt_ropter_vehicle());
        FailingBody body(tilt_ropter_vehicle(), rate);
        body.disturbance.force << 1.0, -0.5, -1.5;
        body.disturbance.torque << 0.05, -0.08, 0.02;
        body.run(detector, 2.0);
        ASSERT_EQ(detector.failure().kind, FailureKind::none) << name;
        body.fail(failure);
        body.run(detector, 0.3);
        const ActuatorFailure& found = detector.failure();
        EXPECT_EQ(found.kind, failure.kind) << name;
        EXPECT_EQ(found.rotor, rotor) << name;
        EXPECT_NEAR(std::remainder(found.angle - failure.angle, 2.0 * pi), 0.0, 1.0 * degree)
            << name;
        EXPECT_NEAR(found.effectiveness, failure.effectiveness, 0.03) << name;
        EXPECT_LE(body.since_failure(found.time), rate < 60.0 ? 0.22 : 0.13) << name;
      }
}

TEST(FailureDetector, FindsSlowServosInTheAirAndOnTheGround) {
  for (const bool airborne : {true, false})
    for (const double slowness : {4.0, 8.0}) {
      FailureDetector<4> detector(tilt_ropter_vehicle());
      FailingBody body(tilt_ropter_vehicle(), 1000.0);
      body.slowness = slowness;
      body.gain = 0.8;
      body.run(detector, 6.0, airborne);
      EXPECT_EQ(detector.failure().kind, FailureKind::slow_servos) << slowness << airborne;
      const double lag =
          with_failure(tilt_ropter_vehicle(), detector.failure()).servo.time_constant;
      const double factor = lag / (slowness * tilt_ropter_vehicle().servo.time_constant);
      EXPECT_TRUE(factor > 0.49 && factor < 2.01) << factor;  // the next finding halves the error
    }
}

// Otherwise findings in a row would end at a lag that no vehicle may have.
TEST(FailureDetector, NoLagAboveTenSecondsIsReported) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.servo.time_constant = 4.0;
  FailureDetector<4> detector(vehicle);
  FailingBody body(vehicle, 1000.0);
  body.slowness = 8.0;
  body.run(detector, 6.0);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
}

// A healthy vehicle may differ by that.
TEST(FailureDetector, ServosOfHalfTheSpeedAreNoFailureInTheAir) {
  FailureDetector<4> detector(tilt_ropter_vehicle());
  FailingBody body(tilt_ropter_vehicle(), 1000.0);
  body.slowness = 2.0;
  body.run(detector, 10.0);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
}

// What is proportional to the modelled wrench is no lag.
TEST(FailureDetector, AWrongMassIsNoSlowServo) {
  for (const bool airborne : {true, false})
    for (const double gain : {0.5, 0.8, 1.25, 1.5}) {
      FailureDetector<4> detector(tilt_ropter_vehicle());
      FailingBody body(tilt_ropter_vehicle(), 1000.0);
      body.gain = gain;
      body.run(detector, 10.0, airborne);
      EXPECT_EQ(detector.failure().kind, FailureKind::none) << gain << airborne;
    }
}

TEST(FailureDetector, LearnsConstantDisturbancesAndSurvivesGusts) {
  auto [detector, body] = FailingFlight();
  test_support::Random random(1);
  for (int i = 0; i < 200; ++i) {  // a gust hits the whole body
    body.disturbance.force = random.vector(1.5);
    body.run(detector, 0.3);
    ASSERT_EQ(detector.failure().kind, FailureKind::none) << i;
  }
}

// Only its telemetry shows a rotor that a motor controller has stopped: the modelled wrench
// follows the measured speed.
TEST(FailureDetector, FindsAStoppedRotorByItsSpeed) {
  auto [detector, body] = FailingFlight();
  body.run(detector, 1.0);
  body.speed_factor(2) = 0.3;
  body.fail({});
  body.run(detector, 0.3);
  EXPECT_EQ(detector.failure().kind, FailureKind::rotor);
  EXPECT_EQ(detector.failure().rotor, 2U);
  EXPECT_EQ(detector.failure().effectiveness, 0.0);
  EXPECT_LE(body.since_failure(detector.failure().time), 0.15);
}

/// Ticks at 1 kHz whose wrench is as modelled: only the telemetry shows what happens. `telemetry`
/// returns the reading of rotor 3 at a time since the start.
template <typename Reading>
ActuatorFailure by_telemetry(const Reading& telemetry, bool airborne, double duration = 2.0,
                             bool others_change = true,
                             double commanded = std::sqrt(0.25 * 1.5 * gravity / 1.4e-6)) {
  FailureDetector<4> detector(tilt_ropter_vehicle());
  const ActuatedBody<4> body(tilt_ropter_vehicle());
  ActuatorState<4> modelled;
  modelled.rotor_speed.setConstant(commanded);
  const Wrenchd wrench = body.wrench(modelled);
  test_support::Random random(5);
  for (int tick = 0; tick < 1000.0 * duration; ++tick) {
    ActuatorState<4> measured = modelled;
    if (others_change) measured.rotor_speed.head<3>() += random.vector(3.0);
    measured.rotor_speed(2) = telemetry(1e-3 * tick, commanded);
    detector.update(5.0 + 1e-3 * tick, {Eigen::Vector3d::Zero(), wrench.force / 1.5}, measured,
                    modelled.rotor_speed, airborne);
  }
  return detector.failure();
}

double stopping(double time, double speed) {
  return time < 1.0 ? speed : speed * std::exp(-(time - 1.0) / 0.03);
}

TEST(FailureDetector, FindsAStoppingMotorIn20ms) {
  for (const bool airborne : {true, false})
    for (const double thrust : {0.3, 1.0, 2.0}) {
      const ActuatorFailure found =
          by_telemetry(stopping, airborne, 1.5, true, 1621.0 * std::sqrt(thrust));
      ASSERT_EQ(found.kind, FailureKind::rotor) << airborne << thrust;
      EXPECT_EQ(found.rotor, 2U);
      EXPECT_EQ(found.effectiveness, 0.0);
      EXPECT_LE(found.time, 6.0 + (thrust < 1.0 ? 0.03 : 0.02)) << airborne << thrust;
    }
  const auto coarse = [](double time, double speed) {  // 100 Hz, steps of 60 rad/s
    return 60.0 * std::floor(stopping(0.01 * std::floor(100.0 * time), speed) / 60.0);
  };
  EXPECT_LE(by_telemetry(coarse, true).time, 6.05);
  EXPECT_EQ(by_telemetry(coarse, true).rotor, 2U);
}

TEST(FailureDetector, WrongTelemetryIsNoFailure) {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  using Reading = double (*)(double, double);
  for (const bool airborne : {true, false})
    for (const Reading reading : {
             Reading([](double, double w) { return 0.8 * w; }),
             Reading([](double, double w) { return 100.0 * std::floor(w / 100.0); }),
             // one wrong reading of 50 a second, of different sizes
             Reading([](double t, double w) { return t > 1.0 && t < 1.02 ? 0.0 : w; }),
             Reading([](double t, double w) { return t > 1.0 && t < 1.02 ? 0.3 * w : w; }),
             Reading([](double t, double w) { return t > 1.0 && t < 1.02 ? nan : w; }),
             Reading([](double t, double w) { return t > 1.0 && t < 1.02 ? 1e6 : w; }),
             Reading([](double t, double w) {  // four falling readings in 4 ms
               return t > 1.0005 && t < 1.0045 ? (0.6 - 100.0 * (t - 1.0)) * w : w;
             }),
             // for good: frozen, not a number, too fast
             Reading([](double t, double w) { return t > 1.0 ? 0.6 * w : w; }),
             Reading([](double t, double w) { return t > 1.0 ? nan : w; }),
             Reading([](double t, double w) { return t > 1.0 ? 1e6 : w; }),
             // it starts to turn late, and slowly
             Reading([](double t, double w) { return w * std::min(1.0, std::max(0.0, t - 0.3)); }),
             Reading([](double t, double w) { return w * std::min(1.0, t); }),
             Reading([](double t, double w) {
               return (t < 1.0 ? 0.5 + 0.5 * t : 1.0) * w +
                      (std::sin(1e5 * t) > 0.0 ? 25.0 : -25.0);
             }),
         })
      EXPECT_EQ(by_telemetry(reading, airborne).kind, FailureKind::none)
          << airborne << ", reading at 1.01 s: " << reading(1.01, 1.0);
  EXPECT_EQ(by_telemetry([](double t, double w) { return t > 1.0 ? 0.0 : w; }, true).kind,
            FailureKind::none)
      << "a channel without signal in flight";
}

// On the ground this costs no more than a take-off.
TEST(FailureDetector, AMotorThatDoesNotStartIsLostOnTheGround) {
  const auto dead = [](double, double) { return 0.0; };
  EXPECT_EQ(by_telemetry(dead, true).kind, FailureKind::none);
  EXPECT_EQ(by_telemetry(dead, false).kind, FailureKind::rotor);
  EXPECT_EQ(by_telemetry(dead, false).rotor, 2U);
  EXPECT_NEAR(by_telemetry(dead, false).time, 5.43, 0.05);
  EXPECT_EQ(by_telemetry(dead, false, 2.0, false).kind, FailureKind::none) << "frozen telemetry";
}

// A switch or a battery stops all motors; no vehicle remains for which one is lost.
TEST(FailureDetector, RotorsThatStopTogetherWereSwitchedOff) {
  FailureDetector<4> detector(tilt_ropter_vehicle());
  const Eigen::Vector4d modelled = Eigen::Vector4d::Constant(1621.0);
  for (int tick = 0; tick < 1200; ++tick)
    detector.update(1e-3 * tick, {Eigen::Vector3d::Zero(), {0.0, 0.0, gravity}},
                    {modelled * stopping(1e-3 * tick, 1.0), Eigen::Vector4d::Zero()}, modelled,
                    false);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
}

// No time in the air has shown what is normal, so the whole residual is judged.
TEST(FailureDetector, AFailureFromBeforeTheFlightIsNotNormal) {
  for (const double angle : {-37.0, 73.0})
    for (std::size_t rotor = 0; rotor < 4; ++rotor) {
      auto [detector, body] = FailingFlight();
      body.disturbance.force << 0.4, 0.2, -0.3;
      body.fail({FailureKind::servo, rotor, angle * degree, 1.0, 0.0});
      body.run(detector, 1.0, false);
      body.run(detector, 0.3);
      const ActuatorFailure& found = detector.failure();
      ASSERT_EQ(found.kind, FailureKind::servo) << angle << rotor;
      EXPECT_EQ(found.rotor, rotor);
      EXPECT_NEAR(found.angle, angle * degree, 2.0 * found.stddev) << angle;
      EXPECT_LT(found.stddev, 20.0 * degree) << angle;
    }
}

// An asymmetric load hides a stuck servo at the start. When it is found, its angle is uncertain.
TEST(FailureDetector, AnAngleIsUncertainByWhatWasNormal) {
  const auto stddev_with = [](double sideways) {
    auto [detector, body] = FailingFlight();
    body.disturbance.force << 0.0, sideways, 0.0;
    body.run(detector, 2.0);
    body.fail({FailureKind::servo, 2, 60.0 * degree, 1.0, 0.0});
    body.run(detector, 0.3);
    EXPECT_EQ(detector.failure().kind, FailureKind::servo);
    return detector.failure().stddev;
  };
  EXPECT_LT(stddev_with(0.0), 4.0 * degree);
  EXPECT_GT(stddev_with(2.0), 8.0 * degree);
}

// A servo that is stuck stays where it is; one without torque does not, and its rotor has to stop.
TEST(FailureDetector, AnArmThatMovesOnIsLimp) {
  for (std::size_t rotor = 0; rotor < 4; ++rotor) {
    auto [detector, body] = FailingFlight();
    body.disturbance.force << 0.4, 0.2, -0.3;
    body.run(detector, 2.0);
    body.fail({FailureKind::servo, rotor, 30.0 * degree, 1.0, 0.0});
    body.run(detector, 2.0);
    const ActuatorFailure& found = detector.failure();
    EXPECT_TRUE(found.kind == FailureKind::servo && !found.limp && found.rotor == rotor);
    const ActuatorFailure other{FailureKind::rotor, (rotor + 1) % 4, 0.0, 0.0, 0.0};
    body.fail({FailureKind::servo, rotor, 30.0 * degree, 1.0, 0.0}, other);
    body.run(detector, 0.3);
    EXPECT_FALSE(found.limp);  // another rotor fails as well
    body.fail({FailureKind::servo, rotor, 60.0 * degree, 1.0, 0.0});
    body.run(detector, 0.2);
    EXPECT_TRUE(found.kind == FailureKind::servo && found.limp && found.rotor == rotor);
  }
}

// A blade that loses more of itself, or a rotor that only seemed weak while a wheel stood.
TEST(FailureDetector, AWeakRotorMayGetWeaker) {
  for (std::size_t rotor = 0; rotor < 4; ++rotor) {
    auto [detector, body] = FailingFlight();
    body.run(detector, 2.0);
    body.fail({FailureKind::rotor, rotor, 0.0, 0.5, 0.0});
    body.run(detector, 2.0);
    const ActuatorFailure& found = detector.failure();
    EXPECT_TRUE(found.kind == FailureKind::rotor && found.rotor == rotor);
    EXPECT_NEAR(found.effectiveness, 0.5, 0.05);
    const ActuatorFailure other{FailureKind::rotor, (rotor + 1) % 4, 0.0, 0.0, 0.0};
    body.fail({FailureKind::rotor, rotor, 0.0, 0.5, 0.0}, other);
    body.run(detector, 0.3);
    EXPECT_NEAR(found.effectiveness, 0.5, 0.05);  // another rotor fails as well
    body.fail({FailureKind::rotor, rotor, 0.0, 0.0, 0.0});
    body.run(detector, 0.3);
    EXPECT_TRUE(found.rotor == rotor && found.effectiveness == 0.0);
  }
}

// Neither a mass nor a centre of mass that is a little wrong is a rotor.
TEST(FailureDetector, WrongMassAndWindAreNoFailureAtTheStart) {
  test_support::Random random(3);
  for (int i = 0; i < 100; ++i) {
    auto [detector, body] = FailingFlight();
    body.disturbance.force = random.vector(2.0) - Eigen::Vector3d(0.0, 0.0, random.uniform(0, 3));
    body.disturbance.torque = random.vector(0.1);
    body.run(detector, 1.0);
    EXPECT_EQ(detector.failure().kind, FailureKind::none)
        << body.disturbance.force.transpose() << ", " << body.disturbance.torque.transpose();
  }
}

// Near zero thrust the model of a rotor and its speed may differ by any factor.
TEST(FailureDetector, ASlowRotorWithoutThrustIsNotStopped) {
  auto [detector, body] = FailingFlight();
  body.thrust_factor(1) = 0.1;
  body.speed_factor(1) = 0.3;
  body.run(detector, 2.0);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
}

TEST(FailureDetector, IsSilentOnTheGroundAndReportsUntilReset) {
  auto [detector, body] = FailingFlight();
  body.run(detector, 1.0);
  body.fail({FailureKind::rotor, 1, 0.0, 0.0, 0.0});
  body.run(detector, 5.0, false);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);

  detector.reset();
  for (const double effectiveness : {1.0, 0.0, 1.0}) {
    body.fail({FailureKind::rotor, 1, 0.0, effectiveness, 0.0});
    body.run(detector, 1.0);
  }
  EXPECT_EQ(detector.failure().kind, FailureKind::rotor);
  detector.reset();
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
}

// What an obstacle does to the body looks like a failure; a speed does not.
TEST(FailureDetector, ConvictsByMotionNobodyThatTouchesAnObstacle) {
  for (const bool touches : {true, false}) {
    auto [detector, body] = FailingFlight();
    body.run(detector, 1.0);
    body.touches = touches;
    body.fail({FailureKind::rotor, 1, 0.0, 0.0, 0.0});
    body.run(detector, 2.0);
    EXPECT_EQ(detector.failure().kind == FailureKind::none, touches);
    body.speed_factor(1) = 0.2;
    body.run(detector, 1.0);
    EXPECT_EQ(detector.failure().kind, FailureKind::rotor);
  }
}

TEST(FailureDetector, IgnoresInvalidInput) {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  auto [detector, body] = FailingFlight();
  body.run(detector, 1.0);
  ActuatorState<4> actuators;
  const auto& speed = actuators.rotor_speed;
  for (int i = 0; i < 100; ++i) {
    detector.update(i % 2 == 0 ? nan : 11.0, {}, actuators, speed, true);
    for (const double bad : {nan, 1e300})
      detector.update(11.0, {Eigen::Vector3d::Constant(bad), {}}, actuators, speed, true);
    detector.update(11.0, {}, actuators, Eigen::Vector4d::Constant(nan), true);
    actuators.tilt_angle(1) = nan;
    detector.update(11.0, {}, actuators, speed, true);
    actuators.tilt_angle(1) = 0.0;
  }
  body.run(detector, 1.0);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
  body.fail({FailureKind::rotor, 0, 0.0, 0.0, 0.0});
  body.run(detector, 0.3);
  EXPECT_EQ(detector.failure().kind, FailureKind::rotor);
}

}  // namespace failure_detector_test
}  // namespace tilt_ropter
