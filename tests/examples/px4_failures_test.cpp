// The PX4 node with a vehicle whose actuators fail, of which PX4 says nothing.
// CTest: dds flight optimised

#include "support/px4_flight.hpp"

#include <tilt_ropter/actuation/failure_detector.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <string>

namespace px4_failures_test {

using Flight = test_support::Px4Flight;
using tilt_ropter::FailureKind;

struct Landing {
  double found = 1e9;      ///< after its start [s]
  double touchdown = 0.0;  ///< fastest below 0.4 m [m/s]
};

/// Flies until PX4 has disarmed the vehicle, for 20 s at most.
Landing land(Flight& flight) {
  Landing landing;
  const double start = flight.px4.time();
  while (flight.px4.armed() && flight.px4.time() < start + 20.0) {
    flight.fly(0.01);
    if (flight.node->snapshot(0).failure.kind != FailureKind::none)
      landing.found = std::min(landing.found, flight.px4.time() - start);
    if (flight.body().position.z() < 0.4)
      landing.touchdown = std::max(landing.touchdown, -flight.body().velocity.z());
  }
  return landing;
}

TEST(Px4Failures, LandsWithoutARotorAndDoesNotTakeOffAgain) {
  for (const char* level : {"wrench", "actuator"})
    for (std::size_t rotor = 0; rotor < 4; ++rotor) {
      SCOPED_TRACE(level + (", rotor " + std::to_string(rotor)));
      Flight flight("", level);
      ASSERT_NO_FATAL_FAILURE(flight.take_off());
      flight.px4.vehicle.stopped_rotor = static_cast<int>(rotor);
      const Landing landing = land(flight);
      EXPECT_LT(landing.found, 0.15);
      EXPECT_LT(landing.touchdown, 0.5);
      EXPECT_TRUE(flight.px4.disarmed_by_land_detector());
      const loops::Snapshot shown = flight.node->snapshot(0);
      EXPECT_EQ(shown.failure.kind, FailureKind::rotor);
      EXPECT_EQ(shown.failure.rotor, rotor);
      EXPECT_NE(shown.line().find("rotor " + std::to_string(rotor + 1) + " gives 0 %"),
                std::string::npos)
          << shown.line();
      ASSERT_TRUE(flight.px4.arm());
      flight.fly(4.0);
      EXPECT_LT(flight.body().position.z(), 0.12);
      EXPECT_STREQ(flight.node->snapshot(0).waits_for, "a repair; start the node again then");
    }
}

// It shows when the vehicle has to accelerate across its arm.
TEST(Px4Failures, LandsWithAServoThatIsStuck) {
  for (const char* level : {"wrench", "actuator"})
    for (std::size_t servo = 0; servo < 4; ++servo) {
      SCOPED_TRACE(level + (", servo " + std::to_string(servo)));
      Flight flight("", level);
      ASSERT_NO_FATAL_FAILURE(flight.take_off());
      const auto found = [&] { return flight.node->snapshot(0).failure; };
      for (int i = 0; i < 8 && found().kind == FailureKind::none; ++i) {
        geometry_msgs::msg::PoseStamped there{};
        there.pose = {{i % 2 == 0 ? 2.3 : 0.3, i % 4 < 2 ? 2.6 : 0.6, 1.5}, {0.0, 0.0, 0.0, 1.0}};
        flight.node->on_hover_point(there);
        flight.fly(1.0);
        flight.px4.vehicle.stuck_servo = static_cast<int>(servo);
        flight.fly(3.0);
      }
      const Landing landing = land(flight);
      EXPECT_LT(landing.touchdown, 0.5);
      EXPECT_LT(flight.tilt, 30.0);
      EXPECT_TRUE(flight.px4.disarmed_by_land_detector());
      EXPECT_EQ(found().kind, FailureKind::servo);
      EXPECT_EQ(found().rotor, servo);
    }
}

}  // namespace px4_failures_test
