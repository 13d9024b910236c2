// The PX4 node where motors or servos do not obey it: a kill switch, and messages that PX4 does not
// hear.
// CTest: dds flight optimised

#include "support/px4_flight.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <string>

namespace px4_pilot_kill_test {

using Eigen::Vector3d;
using Flight = test_support::Px4Flight;

// As real PX4 1.17 and its simulation have shown: it leapt to 1.8 m, leaning by 49 degrees.
TEST(Px4Kill, OnTheGroundIsNotTakenBack) {
  for (const char* level : {"wrench", "actuator"})
    for (const double seconds : {1.5, 3.0}) {
      Flight flight("", level);
      flight.take_off();
      flight.px4.kills = true;
      flight.fly(seconds);
      const double lain = flight.body().position.z();
      flight.px4.kills = false;
      double highest = 0.0;
      for (int i = 0; i < 50; ++i) {
        flight.fly(0.1);
        highest = std::max(highest, flight.body().position.z() - lain);
      }
      EXPECT_LT(highest, 0.02) << level << ' ' << seconds;
      // What the pilot does next is followed.
      flight.px4.disarm();
      flight.fly(2.0);
      flight.px4.wants_offboard = true;
      ASSERT_TRUE(flight.px4.arm());
      flight.fly(8.0);
      EXPECT_LT((flight.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.05) << level;
    }
}

// The observer takes what the rotors do not lift for a load of twice the weight: they would leap.
TEST(Px4Kill, BeforeTakeOffIsNoTakeOff) {
  for (const char* level : {"wrench", "actuator"})
    for (const double seconds : {0.5, 2.0, 4.0}) {
      Flight flight("", level);
      flight.fly(1.5);
      flight.px4.wants_offboard = flight.px4.kills = true;
      ASSERT_TRUE(flight.px4.arm());
      flight.fly(seconds);
      flight.px4.kills = false;
      double fastest = 0.0;
      for (int i = 0; i < 500; ++i) {
        flight.fly(0.01);
        fastest = std::max(fastest, flight.body().velocity.z());
      }
      EXPECT_LT(fastest, seconds < 1.0 ? 1.2 : 0.2) << level << ' ' << seconds;
      EXPECT_EQ(flight.body().position.z() > 1.4, seconds < 1.0) << level << ' ' << seconds;
    }
}

// PX4 has landed because the node was silent, is armed, and returns to offboard mode by itself.
TEST(Px4Failsafe, LandingIsNotTakenBack) {
  for (const bool restarts : {false, true}) {
    Flight flight;
    flight.take_off();
    flight.hears = false;
    flight.fly(0.6);
    for (flight.px4.stick = flight.body().position; flight.px4.stick.z() > -0.5;
         flight.px4.stick.z() -= 0.05)
      flight.fly(0.1);
    flight.fly(1.0);
    ASSERT_LT(flight.body().position.z(), 0.12);
    if (restarts) flight.start_node();
    flight.hears = true;
    flight.fly(1.5);
    EXPECT_TRUE(flight.px4.is_offboard()) << restarts;
    EXPECT_LT(flight.body().position.z(), 0.12) << restarts;
    EXPECT_STREQ(flight.node->snapshot(0).waits_for, "disarming or another mode");
    flight.px4.wants_offboard = false;
    flight.fly(1.0);
    flight.px4.wants_offboard = true;
    flight.fly(8.0);
    EXPECT_LT((flight.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.05) << restarts;
  }
}

// As when ActuatorServos has another version: the rotors would turn, and the arms stay where they
// are.
TEST(Px4Listeners, AsksForNoOffboardModeWhilePx4DoesNotHearTheActuators) {
  Flight flight;
  flight.node->on_listeners(false);
  flight.fly(1.5);
  flight.px4.wants_offboard = true;
  EXPECT_FALSE(flight.px4.arm());
  EXPECT_NE(std::string(flight.node->snapshot(0).waits_for).find("--px4-message-version"),
            std::string::npos);
  flight.node->on_listeners(true);
  flight.take_off();
  flight.node->on_listeners(false);  // the list of listeners is no reason to give up a flight
  flight.fly(2.0);
  EXPECT_TRUE(flight.px4.is_offboard());
}

TEST(Px4Kill, InTheAirIsTakenBack) {
  for (const char* level : {"wrench", "actuator"})
    for (const double seconds : {0.02, 0.05, 0.1, 0.2, 0.3}) {
      Flight flight("", level);
      flight.take_off();
      flight.px4.kills = true;
      flight.fly(seconds);
      flight.px4.kills = false;
      flight.fly(6.0);
      EXPECT_LT((flight.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.05)
          << level << ' ' << seconds;
    }
}

}  // namespace px4_pilot_kill_test
