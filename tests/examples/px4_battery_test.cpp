// The PX4 node with a battery that PX4 reports: motors turn as fast as its voltage lets them.
// CTest: dds flight optimised

#include "support/px4_flight.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

namespace px4_battery_test {

using Flight = test_support::Px4Flight;

// By 25 % in 30 s, which takes 44 % of the thrust from an output that stays. Without compensation
// the observer reports 5 N for it.
TEST(Px4Battery, HoversWhileTheVoltageFalls) {
  for (const char* level : {"wrench", "actuator"}) {
    SCOPED_TRACE(level);
    Flight flight("", level);
    flight.px4.vehicle.voltage = 16.0;
    ASSERT_NO_FATAL_FAILURE(flight.take_off());
    flight.fly(2.0);
    const float before = flight.px4.vehicle.last_motors.control[0];
    const double weight_error = flight.node->external().force.z();
    double farthest = 0.0;
    for (int i = 0; i < 300; ++i) {
      flight.px4.vehicle.voltage -= 4.0 / 300.0;
      flight.fly(0.1);
      farthest = std::max(farthest, std::abs(flight.body().position.z() - 1.5));
    }
    EXPECT_LT(farthest, 0.01);
    EXPECT_NEAR(flight.node->external().force.z(), weight_error, 0.5);
    EXPECT_GT(flight.px4.vehicle.last_motors.control[0], 1.25F * before);
    EXPECT_NE(flight.node->snapshot(0).line().find("; battery 1 Hz"), std::string::npos)
        << flight.node->snapshot(0).line();
  }
}

// Outputs for a wrong voltage would be wrong by as much as the battery is full.
TEST(Px4Battery, DoesNotFlyBeforeItKnowsTheVoltage) {
  Flight flight;
  flight.px4.vehicle.voltage = 0.0;
  const auto say = [&](bool connected, float voltage) {
    px4_msgs::msg::BatteryStatus m{};
    m.connected = connected;
    m.voltage_v = voltage;
    flight.node->on_battery(m);
  };
  say(false, 14.0F);
  for (const float wrong : {0.0F, -1.0F, 1000.0F, std::numeric_limits<float>::quiet_NaN()})
    say(true, wrong);
  flight.px4.wants_offboard = true;
  flight.fly(2.0);
  EXPECT_EQ(flight.px4.vehicle.heartbeats, 0);
  EXPECT_STREQ(flight.node->snapshot(0).waits_for, "battery_status, for voltage_compensation");
  say(true, 13.2F);
  flight.fly(1.0);
  EXPECT_GT(flight.px4.vehicle.heartbeats, 90);
}

}  // namespace px4_battery_test
