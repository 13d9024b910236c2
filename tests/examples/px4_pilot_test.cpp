// The PX4 node with a pilot and faults against a strict stand-in. A full run flies 200 sequences.
// CTest: dds flight optimised

#include "../../examples/integrations/px4_node.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/px4_flight.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <functional>
#include <iterator>
#include <random>
#include <string>

namespace loops {
namespace px4_pilot_test {

using Eigen::Vector3d;

using Flight = test_support::Px4Flight;

TEST(Px4Pilot, TakesOverAndGivesBack) {
  Flight flight;
  flight.take_off();
  for (const double seconds : {0.1, 0.6, 3.0}) {
    flight.px4.wants_offboard = false;
    flight.px4.stick = flight.body().position + Vector3d(2.0, -1.0, 0.5);
    flight.fly(seconds);
    flight.px4.wants_offboard = true;
    flight.fly(5.5);
    EXPECT_LT((flight.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.05) << seconds;
  }
  EXPECT_EQ(flight.px4.unasked, 0);
  EXPECT_LT(flight.tilt, 15.0);
  EXPECT_LT(flight.sag, 0.15);
}

// The pilot takes over in the eight, on the way back and on the ground; then a flight begins anew.
TEST(Px4Pilot, GivesBackAMissionThatGoesOn) {
  const test_support::Directory directory("px4_mission");
  Flight flight(
      directory.write("mission.json", R"({"name": "tour", "start": {"position_m": [0.5, 0]},
    "segments": [{"type": "rest", "duration_s": 0.5}, {"type": "take_off", "height_m": 0.8},
      {"type": "figure_eight", "amplitude_m": [0.5, 0.3, 0.1], "laps": 1, "max_speed_mps": 1},
      {"type": "land"}, {"type": "rest", "duration_s": 0.5},
      {"type": "go_to", "position_m": [1.5, 0]}, {"type": "rest", "duration_s": 0.5}]})"));
  const auto activity = [&] { return std::string(flight.node->snapshot(0).activity); };
  const auto fly_until = [&](const std::string& wanted) {
    while (activity() != wanted && flight.px4.time() < 120.0) flight.fly(0.05);
    ASSERT_EQ(activity(), wanted);
  };
  const auto hands = [&](double seconds, const Vector3d& by) {
    Vector3d before = flight.node->snapshot(0).reference.position;
    flight.px4.wants_offboard = false;
    flight.fly(0.01);
    flight.px4.stick += by;
    flight.fly(seconds);
    flight.px4.wants_offboard = true;
    flight.fly(0.3);
    return before;
  };
  // Before the flight, PX4 finds its place in the frame of the mission.
  const Vector3d origin(0.3, -0.2, 0.0);
  flight.fly(1.0);
  flight.px4.vehicle.reset_estimate(-origin, 0.0);
  flight.fly(0.5);
  flight.px4.wants_offboard = true;
  ASSERT_TRUE(flight.px4.arm());
  flight.fly(0.1);
  EXPECT_EQ(activity(), "way");
  fly_until("air");
  flight.fly(3.0);
  const auto reference = [&] { return flight.node->snapshot(0).reference.position; };
  Vector3d left = hands(2.0, {1.5, -1.0, 0.5});
  EXPECT_EQ(activity(), "way");
  hands(0.5, {0.0, 1.0, 0.3});
  EXPECT_EQ(activity(), "way");
  fly_until("air");
  EXPECT_LT((reference() - left).norm(), 0.05);
  fly_until("ground");
  flight.fly(1.0);
  left = hands(2.0, {0.0, 1.0, 0.7});
  EXPECT_EQ(activity(), "way");
  fly_until("ground");
  EXPECT_LT((reference() - left).norm(), 0.05);
  fly_until("mission is over");
  flight.fly(1.0);
  EXPECT_LT((flight.body().position - origin - Vector3d(1.5, 0.0, 0.11)).norm(), 0.05);
  EXPECT_EQ(flight.px4.unasked + flight.px4.blind, 0);
  EXPECT_LT(flight.tilt, 15.0);
  EXPECT_LT(flight.sag, 0.15);
  flight.px4.disarm();
  flight.fly(1.0);
  ASSERT_TRUE(flight.px4.arm());
  fly_until("take_off");
  EXPECT_LT((flight.body().position - origin - Vector3d(0.5, 0.0, 0.11)).norm(), 0.1);
}

// PX4 says at 2 Hz who flies. A node that no longer hears it sends nothing.
TEST(Px4Pilot, IsNotBelievedForEverWhenTheStatusStops) {
  Flight flight;
  flight.take_off();
  flight.px4.tells = false;
  flight.fly(0.6);
  EXPECT_TRUE(flight.px4.is_offboard());
  flight.fly(0.8);
  const int commands = flight.px4.vehicle.commands, heartbeats = flight.px4.vehicle.heartbeats;
  flight.fly(0.6);
  EXPECT_EQ(flight.px4.vehicle.commands, commands);
  EXPECT_EQ(flight.px4.vehicle.heartbeats, heartbeats);
  EXPECT_STREQ(flight.node->snapshot(0).mode, "not told who flies");
  EXPECT_FALSE(flight.px4.is_offboard());
  flight.px4.tells = true;
  flight.fly(6.0);
  EXPECT_TRUE(flight.px4.is_offboard());
  EXPECT_LT((flight.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.05);
}

// The node stops its OffboardControlMode at once, and flies on until PX4 takes over.
TEST(Px4Pilot, Px4TakesOverSoonAfterOdometryIsLost) {
  Flight flight;
  flight.take_off();
  flight.heard = false;
  flight.fly(0.35);
  EXPECT_TRUE(flight.px4.is_offboard());
  const int commands = flight.px4.vehicle.commands;
  flight.fly(0.02);
  EXPECT_GT(flight.px4.vehicle.commands, commands);
  flight.fly(0.27);
  EXPECT_FALSE(flight.px4.is_offboard());
  flight.fly(1.0);
  EXPECT_EQ(flight.px4.blind, 0);
  EXPECT_LT(flight.tilt, 15.0);
}

TEST(Px4Pilot, FliesSlowlyToAHoverPointOfATopic) {
  Flight flight;
  flight.take_off();
  geometry_msgs::msg::PoseStamped m{};
  m.pose = {{4.3, 0.6, 2.5}, {0.0, 0.0, std::sin(0.5), std::cos(0.5)}};
  flight.node->on_hover_point(m);
  flight.fly(3.0);
  m.pose.position.x = std::nan("");  // ignored
  flight.node->on_hover_point(m);
  flight.fly(7.0);
  EXPECT_LT((flight.body().position - Vector3d(4.3, 0.6, 2.5)).norm(), 0.05);
  EXPECT_NEAR(tilt_ropter::yaw_of(flight.body().orientation), 1.0, 0.02);
  EXPECT_LT(flight.tilt, 5.0);
  EXPECT_LT(flight.sag, 0.05);
}

// An accelerometer that says that it clips is not used.
TEST(Px4Pilot, ClippedAccelerometerDoesNotMoveTheVehicle) {
  Flight flight;
  flight.take_off();
  for (int i = 0; i < 10; ++i) {
    flight.px4.vehicle.clipping = i % 2 == 0 ? 157.0 : 0.0;
    flight.fly(0.2);
    EXPECT_LT((flight.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.05);
  }
}

// That sender is on the ground: a node that believed it would stop the rotors after the failsafe.
TEST(Px4Pilot, ASecondSenderAfterASilenceIsNotBelieved) {
  Flight flight;
  flight.take_off();
  flight.heard = false;
  flight.fly(1.5);
  EXPECT_FALSE(flight.px4.is_offboard());
  flight.heard = true;
  for (int i = 0; i < 50; ++i) {
    px4_msgs::msg::VehicleOdometry other = flight.px4.vehicle.odometry();
    other.position[2] += 1.4F;
    flight.fly(0.009);
    flight.node->on_odometry(other);  // after that of PX4, before the tick
    flight.fly(0.001);
  }
  flight.fly(3.0);
  EXPECT_TRUE(flight.px4.is_offboard());
  EXPECT_LT((flight.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.05);
  EXPECT_LT(flight.tilt, 15.0);
  EXPECT_LT(flight.sag, 0.15);
}

/// What can happen, for a random time.
struct Event {
  const char* name;
  double longest;  ///< [s]
  std::function<void(Flight&, double seconds, std::mt19937&)> happen;
  bool alone = false;  ///< the pilot lets it fall or land: not beside another one
};

double between(double low, double high, std::mt19937& random) {
  return std::uniform_real_distribution<double>(low, high)(random);
}
Vector3d somewhere(double far, double high, std::mt19937& random) {
  const double x = between(-far, far, random), y = between(-far, far, random);
  return {x, y, between(-high, high, random)};
}

const Event events[] = {
    {"the pilot flies", 3.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.wants_offboard = false;
       f.px4.stick = f.body().position + somewhere(2.0, 0.5, random);
       f.fly(seconds);
       f.px4.wants_offboard = true;
     }},
    {"the pilot lands, disarms and arms again", 1.0,
     [](Flight& f, double seconds, std::mt19937&) {
       f.px4.wants_offboard = false;
       f.px4.stick = f.body().position;
       while (f.px4.stick.z() > 0.0) {
         f.px4.stick.z() -= 0.05;
         f.fly(0.1);
       }
       f.fly(1.0);
       f.px4.disarm();
       f.fly(0.5 + seconds);
       f.px4.wants_offboard = true;
       f.fly(0.5);
       ASSERT_TRUE(f.px4.arm());
       f.fly(2.0);
     },
     true},
    {"kill switch", 0.25,
     [](Flight& f, double seconds, std::mt19937&) {
       f.px4.kills = true;
       f.fly(seconds);
       f.px4.kills = false;
       f.fly(2.0);
     },
     true},
    {"PX4 does not estimate", 1.0,
     [](Flight& f, double seconds, std::mt19937&) {
       f.px4.vehicle.estimating = false;
       f.fly(seconds);
       f.px4.vehicle.estimating = true;
     }},
    {"silence to the node", 1.5,
     [](Flight& f, double seconds, std::mt19937&) {
       f.heard = false;
       f.fly(seconds);
       f.heard = true;
     }},
    {"silence from the node", 1.5,
     [](Flight& f, double seconds, std::mt19937&) {
       f.hears = false;
       f.fly(seconds);
       f.hears = true;
     }},
    {"nobody says who flies", 2.0,
     [](Flight& f, double seconds, std::mt19937&) {
       f.px4.tells = false;
       f.fly(seconds);
       f.px4.tells = true;
     }},
    {"reset of the estimate", 0.5,
     [](Flight& f, double seconds, std::mt19937& random) {
       const double heading = between(-0.4, 0.4, random);  // PX4 mends it by its next reset
       f.px4.vehicle.reset_estimate(somewhere(5.0, 0.0, random), heading - f.heading_error);
       f.heading_error = heading;
       f.fly(seconds);
     }},
    {"the estimate slides", 2.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.slide = somewhere(0.5, 0.1, random);
       f.fly(seconds);
       f.px4.vehicle.slide.setZero();
       if (random() % 2 == 0) f.px4.vehicle.reset_velocity();
     }},
    {"PX4 loses its receiver", 3.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.deviation_rate = between(0.0, 2.0, random);
       f.px4.vehicle.slide = somewhere(0.3, 0.1, random);
       f.fly(seconds);
       f.px4.vehicle.slide.setZero();
       f.px4.vehicle.deviation_rate = f.px4.vehicle.deviation = 0.0;
     }},
    {"the voltage falls or rises", 3.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.voltage =
           std::clamp(f.px4.vehicle.voltage + between(-0.5, 0.5, random), 12.0, 16.8);
       f.fly(seconds);
     }},
    {"the clocks drift", 3.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.clock_drift = between(-0.03, 0.03, random);
       f.fly(seconds);
       f.px4.vehicle.clock_drift = f.px4.vehicle.stamps_late = 0.0;
     }},
    {"PX4's clock steps", 2.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.clock_step = between(-1.0, 1.0, random);
       f.fly(seconds);
       f.px4.vehicle.clock_step = 0.0;
     }},
    {"old stamps", 2.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.stamps_late = between(-0.2, 1.0, random);
       f.fly(seconds);
       f.px4.vehicle.stamps_late = 0.0;
     }},
    {"a slow line", 2.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.delay = between(0.0, random() % 2 == 0 ? 0.1 : 1.0, random);
       f.fly(seconds);
       f.px4.vehicle.delay = 0.0;
     }},
    {"clipping", 1.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.clipping = between(-160.0, 160.0, random);
       f.fly(seconds);
       f.px4.vehicle.clipping = 0.0;
     }},
    {"vibration", 1.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       f.px4.vehicle.vibration = between(0.0, 70.0, random);
       f.fly(seconds);
       f.px4.vehicle.vibration = 0.0;
     }},
    {"a second sender", 1.0,
     [](Flight& f, double seconds, std::mt19937& random) {
       const Vector3d where = somewhere(3.0, 3.0, random) + Vector3d(1.0, 0.0, 0.0);
       for (int i = 0; i < std::lround(100.0 * seconds); ++i) {
         px4_msgs::msg::VehicleOdometry other = f.px4.vehicle.odometry();
         for (int k = 0; k < 3; ++k) other.position[k] += static_cast<float>(where(k));
         f.node->on_odometry(other);
         f.fly(0.01);
       }
     }},
    {"the node starts again", 1.0,
     [](Flight& f, double seconds, std::mt19937&) {
       f.start_node();
       f.fly(seconds);
     }},
};

void fly_sequence(unsigned seed, const char* level, std::array<double, 3>& worst) {
  std::mt19937 random(seed);
  Flight flight("", level);
  flight.px4.vehicle.voltage = between(13.0, 16.0, random);
  std::string story;
  ASSERT_NO_FATAL_FAILURE(flight.take_off());
  for (const double end = flight.px4.time() + 10.0; flight.px4.time() < end;) {
    flight.fly(between(0.0, 1.5, random));
    const Event& event = events[random() % std::size(events)];
    const double seconds = between(0.02, event.longest, random);
    const Event& other = events[random() % std::size(events)];
    const bool overlap = random() % 2 == 0 && !event.alone && !other.alone;
    if (overlap)
      flight.meanwhile = [&flight, &random, &other] {
        other.happen(flight, between(0.02, other.longest, random), random);
      };
    char line[200];
    std::snprintf(line, sizeof line, "\n%.2f s: %s for %.2f s, meanwhile %s", flight.px4.time(),
                  event.name, seconds, overlap ? other.name : "nothing");
    story += line;
    SCOPED_TRACE(story);
    ASSERT_NO_FATAL_FAILURE(event.happen(flight, seconds, random));
  }
  flight.fly(5.0);
  while (flight.body().velocity.norm() > 0.1 && flight.px4.time() < 60.0) flight.fly(1.0);
  SCOPED_TRACE("seed " + std::to_string(seed) + ":" + story);
  EXPECT_TRUE(flight.px4.is_offboard());
  EXPECT_FALSE(flight.px4.disarmed_by_land_detector());
  const auto shown = flight.node->snapshot(0);
  EXPECT_LT((shown.body.position - shown.reference.position).norm(), 0.1);
  EXPECT_EQ(flight.px4.blind + flight.px4.unasked, 0);
  EXPECT_EQ(flight.px4.vehicle.wrong_modes + flight.px4.vehicle.wrong_outputs, 0);
  EXPECT_LT(flight.tilt, 15.0);
  EXPECT_LT(flight.sag, 0.15);
  EXPECT_LT(flight.fastest_fall, 1.7);  // of a free fall by 0.15 m
  worst = {std::max(worst[0], flight.tilt), std::max(worst[1], flight.sag),
           std::max(worst[2], flight.fastest_fall)};
}

TEST(Px4Pilot, RandomSequencesOfHandsAndFaults) {
  for (const char* level : {"wrench", "actuator"}) {
    std::array<double, 3> worst{};
    const int count = test_support::quick_or_full(3, 200);
    for (int seed = 0; seed < count; ++seed)
      ASSERT_NO_FATAL_FAILURE(fly_sequence(static_cast<unsigned>(seed), level, worst));
    std::printf("%d sequences at the %s level: tilt %.1f deg, sag %.3f m, fall %.2f m/s\n", count,
                level, worst[0], worst[1], worst[2]);
  }
}

}  // namespace px4_pilot_test
}  // namespace loops
