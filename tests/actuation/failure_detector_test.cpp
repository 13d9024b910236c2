#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>

#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <limits>
#include <string>

namespace tilt_ropter {
namespace {

constexpr double degree = pi / 180.0;

/// A body whose actuators do what is asked, except the failed one. Nothing but this wrench, a
/// constant disturbance and gravity acts on it.
class Body {
 public:
  Body(const Vehicle<4>& vehicle, double rate) : vehicle_(vehicle), rate_(rate), truth_(vehicle) {}

  /// Hover with small motions of all speeds and angles, as a controller commands them.
  void run(FailureDetector<4>& detector, double duration, bool airborne = true) {
    for (const double end = time_ + duration; time_ < end; time_ += 1.0 / rate_) {
      ActuatorState<4> believed;
      for (int i = 0; i < 4; ++i) {
        believed.rotor_speed(i) =
            speed_from_thrust(thrust_factor(i) * (0.25 + 0.02 * std::sin(7.0 * time_ + i)) *
                                  vehicle_.body.mass * gravity,
                              vehicle_.rotor);
        believed.tilt_angle(i) = 0.1 * std::sin(5.0 * time_ + 2.0 * i);
      }
      ActuatorState<4> telemetry = believed;
      for (int i = 0; i < 4; ++i) telemetry.rotor_speed(i) *= speed_factor(i);
      Wrenchd wrench = truth_.wrench(telemetry);
      wrench.force += disturbance.force;
      wrench.torque += disturbance.torque;
      for (int n = 0; n < 20; ++n) {
        const Eigen::Vector3d& w = rate_of_turn_;
        rate_of_turn_ += vehicle_.body.inertia.inverse() *
                         (wrench.torque - w.cross(vehicle_.body.inertia * w)) / (20.0 * rate_);
      }
      detector.update(time_, {rate_of_turn_, wrench.force / vehicle_.body.mass}, telemetry,
                      believed.rotor_speed, airborne);
    }
  }

  void fail(const ActuatorFailure& failure) {
    truth_ = ActuatedBody<4>(with_failure(vehicle_, failure));
    failed_at_ = time_;
  }
  [[nodiscard]] double since_failure(double time) const { return time - failed_at_; }

  Wrenchd disturbance;
  Eigen::Vector4d speed_factor = Eigen::Vector4d::Ones();   ///< measured / commanded speed
  Eigen::Vector4d thrust_factor = Eigen::Vector4d::Ones();  ///< commanded / hover thrust

 private:
  Vehicle<4> vehicle_;
  double rate_, time_ = 10.0, failed_at_ = 0.0;
  ActuatedBody<4> truth_;
  Eigen::Vector3d rate_of_turn_ = Eigen::Vector3d::Zero();
};

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
        Body body(tilt_ropter_vehicle(), rate);
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

TEST(FailureDetector, LearnsConstantDisturbancesAndSurvivesGusts) {
  FailureDetector<4> detector(tilt_ropter_vehicle());
  Body body(tilt_ropter_vehicle(), 100.0);
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
  FailureDetector<4> detector(tilt_ropter_vehicle());
  Body body(tilt_ropter_vehicle(), 100.0);
  body.run(detector, 1.0);
  body.speed_factor(2) = 0.3;
  body.fail({});
  body.run(detector, 0.3);
  EXPECT_EQ(detector.failure().kind, FailureKind::rotor);
  EXPECT_EQ(detector.failure().rotor, 2U);
  EXPECT_EQ(detector.failure().effectiveness, 0.0);
  EXPECT_LE(body.since_failure(detector.failure().time), 0.15);
}

// Near zero thrust the model of a rotor and its speed may differ by any factor.
TEST(FailureDetector, ASlowRotorWithoutThrustIsNotStopped) {
  FailureDetector<4> detector(tilt_ropter_vehicle());
  Body body(tilt_ropter_vehicle(), 100.0);
  body.thrust_factor(1) = 0.1;
  body.speed_factor(1) = 0.3;
  body.run(detector, 2.0);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
}

TEST(FailureDetector, IsSilentOnTheGroundAndReportsUntilReset) {
  FailureDetector<4> detector(tilt_ropter_vehicle());
  Body body(tilt_ropter_vehicle(), 100.0);
  body.run(detector, 1.0);
  body.fail({FailureKind::rotor, 1, 0.0, 0.0, 0.0});
  body.run(detector, 1.0, false);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);

  Body other(tilt_ropter_vehicle(), 100.0);
  detector.reset();
  other.run(detector, 1.0);
  other.fail({FailureKind::rotor, 1, 0.0, 0.0, 0.0});
  other.run(detector, 0.3);
  ASSERT_EQ(detector.failure().kind, FailureKind::rotor);
  other.fail({});
  other.run(detector, 1.0);
  EXPECT_EQ(detector.failure().kind, FailureKind::rotor);
  detector.reset();
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
}

TEST(FailureDetector, IgnoresInvalidInput) {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  FailureDetector<4> detector(tilt_ropter_vehicle());
  Body body(tilt_ropter_vehicle(), 100.0);
  body.run(detector, 1.0);
  ActuatorState<4> actuators;
  for (int i = 0; i < 100; ++i) {
    detector.update(i % 2 == 0 ? nan : 11.0, {}, actuators, actuators.rotor_speed, true);
    detector.update(11.0, {Eigen::Vector3d::Constant(nan), {}}, actuators, actuators.rotor_speed,
                    true);
    detector.update(11.0, {Eigen::Vector3d::Constant(1e300), {}}, actuators, actuators.rotor_speed,
                    true);
    detector.update(11.0, {}, actuators, Eigen::Vector4d::Constant(nan), true);
    actuators.tilt_angle(1) = nan;
    detector.update(11.0, {}, actuators, actuators.rotor_speed, true);
    actuators.tilt_angle(1) = 0.0;
  }
  body.run(detector, 1.0);
  EXPECT_EQ(detector.failure().kind, FailureKind::none);
  body.fail({FailureKind::rotor, 0, 0.0, 0.0, 0.0});
  body.run(detector, 0.3);
  EXPECT_EQ(detector.failure().kind, FailureKind::rotor);
}

}  // namespace
}  // namespace tilt_ropter
