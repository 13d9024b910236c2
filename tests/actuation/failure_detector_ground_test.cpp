// Failures on the ground, where only motion along x and turning about y and z are free.

#include <tilt_ropter/actuation/failure_detector.hpp>

#include "support/failing_body.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace tilt_ropter {
namespace failure_detector_ground_test {

using test_support::FailingFlight;

// Thrusts as a fraction of those in hover; the ground carries the rest of the weight.
void drive(FailingFlight& flight, double thrust, double duration, const Wrenchd& other = {}) {
  const double weight = tilt_ropter_vehicle().body.mass * gravity;
  flight.body.thrust_factor.setConstant(thrust);
  flight.body.disturbance = other;
  flight.body.disturbance.force.z() += (1.0 - thrust) * weight;
  flight.body.run(flight.detector, duration, false);
}

TEST(FailureDetectorOnGround, ARotorInFrontOrBehindIsFoundBeforeTheTakeOff) {
  for (const std::size_t rotor : {2U, 3U})
    for (const double thrust : {0.3, 0.6, 0.9}) {
      FailingFlight flight;
      drive(flight, 0.05, 1.5);
      drive(flight, thrust, 1.0);
      ASSERT_EQ(flight.detector.failure().kind, FailureKind::none);
      flight.body.fail({FailureKind::rotor, rotor, 0.0, 0.0, 0.0});
      drive(flight, thrust, 0.35);
      EXPECT_EQ(flight.detector.failure().kind, FailureKind::rotor) << thrust;
      EXPECT_EQ(flight.detector.failure().rotor, rotor);
      EXPECT_GT(flight.detector.failure().time, 12.5);  // the flight begins at 10 s
      EXPECT_LE(flight.detector.failure().time, 12.86);
    }
}

// Rotors that push a tenth of a second after the start leave little time to learn what is normal.
TEST(FailureDetectorOnGround, ARotorThatIsDeadFromTheStartIsFound) {
  for (const std::size_t rotor : {2U, 3U}) {
    FailingFlight flight;
    flight.body.fail({FailureKind::rotor, rotor, 0.0, 0.0, 0.0});
    drive(flight, 0.05, 0.2);
    drive(flight, 0.4, 0.4);
    EXPECT_EQ(flight.detector.failure().kind, FailureKind::rotor);
    EXPECT_EQ(flight.detector.failure().rotor, rotor);
  }
}

// The body leans then, and feels a part of the load along x.
TEST(FailureDetectorOnGround, ARotorIsMissedByABodyThatLeans) {
  const double load = 0.4 * tilt_ropter_vehicle().body.mass * gravity;
  for (const double lean : {-0.17, 0.17}) {
    FailingFlight flight;
    drive(flight, 0.05, 1.5);
    flight.body.fail({FailureKind::rotor, 2, 0.0, 0.0, 0.0});
    Wrenchd along;
    along.force.x() = lean * load;
    drive(flight, 0.6, 0.35, along);
    EXPECT_EQ(flight.detector.failure().kind, FailureKind::rotor) << lean;
  }
}

// The ground holds what the rotors push: legs everything, the friction of wheels a pusher.
TEST(FailureDetectorOnGround, WhatTheGroundHoldsIsNoFailure) {
  Vehicle<4> legs = tilt_ropter_vehicle(), pusher = legs;
  legs.wheels.reset();
  legs.legs = LegParameters{};
  pusher.rotors[2].tilts = false;
  pusher.rotors[2].orientation << 0, 0, 1, 0, 1, 0, -1, 0, 0;  // pushes along x
  for (const Vehicle<4>& vehicle : {legs, pusher}) {
    FailureDetector<4> detector(vehicle);
    ActuatorState<4> actuators;
    for (int i = 0; i < 300; ++i) {
      actuators.rotor_speed.setConstant(speed_from_thrust(0.05, vehicle.rotor));
      if (i > 150) actuators.rotor_speed(2) = speed_from_thrust(2.0, vehicle.rotor);
      detector.update(0.01 * i, {Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.0, gravity)},
                      actuators, actuators.rotor_speed, false);
    }
    EXPECT_EQ(detector.failure().kind, FailureKind::none);
  }
}

TEST(FailureDetectorOnGround, AServoOnTheAxleShowsByItsPush) {
  for (const std::size_t rotor : {0U, 1U})
    for (const double angle : {-1.0, 1.0}) {
      FailingFlight flight;
      drive(flight, 0.05, 1.5);
      flight.body.fail({FailureKind::servo, rotor, angle, 1.0, 0.0});
      drive(flight, 0.5, 0.5);
      const ActuatorFailure& found = flight.detector.failure();
      EXPECT_EQ(found.kind, FailureKind::servo);
      EXPECT_EQ(found.rotor, rotor);
      EXPECT_NEAR(found.angle, angle, 0.35) << rotor;
    }
}

// A slope, wind, a CoM beside the axle in proportion to the load, and a rotor of 80 % thrust.
TEST(FailureDetectorOnGround, WhatOtherCausesExplainIsNoFailure) {
  for (const double push : {-3.0, 0.0, 3.0})
    for (const double torque : {-0.6, -0.15, 0.0, 0.15, 0.6}) {
      FailingFlight flight;
      Wrenchd other;
      other.force.x() = push;
      other.torque.y() = torque;
      drive(flight, 0.05, 1.5, other);
      flight.body.fail({FailureKind::rotor, 2, 0.0, 0.8, 0.0});
      for (const double thrust : {0.05, 0.3, 0.6, 0.9}) {
        Wrenchd now = other;
        now.torque *= 1.0 - thrust;
        drive(flight, thrust, 1.0, now);
      }
      EXPECT_EQ(flight.detector.failure().kind, FailureKind::none) << push << ' ' << torque;
    }
}

}  // namespace failure_detector_ground_test
}  // namespace tilt_ropter
