// Flies the hybrid mission with rotors that turn slower or faster than commanded, as with a low
// battery, open-loop speed controllers or a wrong throttle map.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <string>
#include <vector>

namespace rotor_speed_test {

test_support::Outcome fly(const std::string& options) {
  const test_support::Directory directory("rotor_speed");
  return test_support::run(HYBRID_MISSION_PROGRAM,  // set by CMake
                           "--no-pictures --output '" + directory.file("") + "' " + options);
}

bool says(const test_support::Outcome& flown, const std::string& text) {
  return flown.output.find(text) != std::string::npos;
}

void expect_as_healthy(const std::string& options, double air_rmse = 0.0028) {
  const test_support::Outcome flown = fly(options);
  ASSERT_EQ(flown.exit_code, 0) << options << flown.output;
  EXPECT_LE(flown["air_rmse_m"], air_rmse) << options;
  EXPECT_LE(flown["ground_rmse_m"], 0.0055) << options;
  EXPECT_LE(flown["touchdown_speed_mps"], 0.2) << options;
  EXPECT_TRUE(says(flown, "actuator_failure: none")) << options;
}

TEST(RotorSpeed, SlowRotorsFlyAsWellAsHealthyOnes) {
  expect_as_healthy("--rotor-speed 0.8");
  if (!test_support::full_run()) return;
  for (const char* ratio : {"0.85", "0.9", "0.95", "0.98", "1.05"})
    for (const char* level : {"wrench", "actuator"})
      expect_as_healthy(std::string("--rotor-speed ") + ratio + " --level " + level);
  for (int rotor = 1; rotor <= 4; ++rotor)
    expect_as_healthy("--rotor-speed ratio=0.8,rotor=" + std::to_string(rotor));
}

TEST(RotorSpeed, FollowsASpeedThatFallsOverTheMission) {
  expect_as_healthy("--rotor-speed ratio=0.85,start=5,end=75");
  if (test_support::full_run())
    expect_as_healthy("--level actuator --rotor-speed rotor=2,ratio=0.8,start=5,end=75");
}

TEST(RotorSpeed, IsNamedAboveThreePercent) {
  const test_support::Outcome flown =
      fly("--rotor-speed rotor=3,ratio=0.88,start=12 --rotor-speed rotor=1,ratio=0.98");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_TRUE(says(flown, "rotor 3 turns 12 % slower than commanded")) << flown.output;
  EXPECT_FALSE(says(flown, "rotor 1 turns")) << flown.output;
  EXPECT_NEAR(flown["rotor_speed_ratio_min"], 0.88, 0.01);
  EXPECT_LE(flown["air_rmse_m"], 0.012);  // the step itself is felt
  EXPECT_TRUE(says(flown, "actuator_failure: none"));
}

// The vehicle that remains has the same battery: what was learnt holds for it, too.
TEST(RotorSpeed, IsKeptWhenAnActuatorFails) {
  const test_support::Outcome flown =
      fly("--rotor-speed 0.85 --failure rotor:rotor=2,effectiveness=0,start=12");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_EQ(flown["failed_rotor"], 2.0);
  EXPECT_LE(flown["emergency_landing_speed_mps"], 0.5);
}

// Without telemetry a slow rotor is a weak one: the observer sees the missing thrust.
TEST(RotorSpeed, WithoutTelemetryTheMissingThrustIsADisturbance) {
  const test_support::Outcome flown = fly("--rotor-speed 0.9 --no-telemetry");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LE(flown["air_rmse_m"], 0.015);
  EXPECT_LE(flown["touchdown_speed_mps"], 0.2);
}

TEST(RotorSpeed, RefusesWrongOptions) {
  for (const char* wrong : {"0.4", "1.3", "x", "rotor=1.5,ratio=0.9", "rotor=9", "speed=1"})
    EXPECT_NE(fly(std::string("--rotor-speed ") + wrong).exit_code, 0) << wrong;
}

}  // namespace rotor_speed_test
