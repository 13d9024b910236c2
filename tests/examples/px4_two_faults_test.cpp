// The PX4 node with two faults at once, those that ended badly before.
// CTest: dds flight optimised

#include "support/px4_flight.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace px4_two_faults_test {

using Flight = test_support::Px4Flight;

// Nothing contradicts an accelerometer while there is no odometry: it turned over.
TEST(Px4TwoFaults, VibrationWithoutOdometryDoesNotMoveTheVehicle) {
  for (const char* level : {"wrench", "actuator"}) {
    SCOPED_TRACE(level);
    Flight flight("", level);
    ASSERT_NO_FATAL_FAILURE(flight.take_off());
    flight.px4.vehicle.vibration = 60.0;
    for (int i = 0; i < 5; ++i) {
      flight.fly(0.3);
      flight.px4.vehicle.estimating = false;
      flight.fly(0.38);
      flight.px4.vehicle.estimating = true;
    }
    EXPECT_LT(flight.tilt, 15.0);
    EXPECT_LT(flight.sag, 0.15);
    EXPECT_LT(flight.fastest_fall, 0.5);
  }
}

// While nothing arrives, its age passes through zero.
TEST(Px4TwoFaults, AStampOfTheFutureDoesNotBecomeOneOfNow) {
  Flight flight;
  ASSERT_NO_FATAL_FAILURE(flight.take_off());
  flight.px4.vehicle.stamps_late = -0.15;
  flight.fly(0.6);
  for (int i = 0; i < 10; ++i) {
    flight.px4.vehicle.estimating = false;
    flight.fly(0.09);
    flight.px4.vehicle.estimating = true;
    flight.fly(0.03);
  }
  EXPECT_EQ(flight.px4.blind, 0);
}

// What PX4 says by a clock that went back was ignored until it was as late as before.
TEST(Px4TwoFaults, TheWordOfAClockThatWentBackCounts) {
  for (int phase = 0; phase < 5; ++phase) {  // of the messages at 2 Hz
    Flight flight;
    ASSERT_NO_FATAL_FAILURE(flight.take_off());
    flight.fly(0.1 * phase);
    flight.px4.vehicle.clock_step = 0.9;
    flight.fly(0.25);
    flight.px4.vehicle.clock_step = 0.0;
    flight.px4.wants_offboard = false;
    flight.fly(1.0);
    EXPECT_EQ(flight.px4.unasked, 0) << phase;
  }
}

}  // namespace px4_two_faults_test
