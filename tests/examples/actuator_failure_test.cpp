// Runs hybrid_mission with an actuator that fails at 4 m. The controller has to find the failure,
// with the noise of all sensors and a model that is wrong by 3 % of the mass and 10 % of the
// inertia, and to land without the actuator.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <fstream>
#include <string>
#include <vector>

namespace actuator_failure_test {

struct Failure {
  std::string kind, field;
  double value;
  int rotor;
  double start;  // in hover until 3 s, then in the figure eight [s]
  std::string level;
  int seed;
};

test_support::Outcome fly(const Failure& failure) {
  const test_support::Directory directory("actuator_failure");
  const std::string mission = directory.file("mission.json");
  std::ofstream(mission) << R"({"name": "four metres", "start": {"position_m": [0, 0, 4]},
      "segments": [{"type": "hover", "duration_s": 3},
                   {"type": "figure_eight", "amplitude_m": [1.5, 0.5, 0.5], "laps": 2},
                   {"type": "hover", "duration_s": 20}]})";
  return test_support::run(
      HYBRID_MISSION_PROGRAM,  // set by CMake
      "--no-pictures --output '" + directory.file("") + "' --mission-file '" + mission +
          "' --level " + failure.level + " --seed " + std::to_string(failure.seed) + " --failure " +
          failure.kind + ":rotor=" + std::to_string(failure.rotor) +
          (failure.field.empty() ? "" : "," + failure.field + "=" + std::to_string(failure.value)) +
          ",start=" + std::to_string(failure.start));
}

void expect_found_and_landed(const Failure& failure) {
  const std::string name = failure.kind + " " + std::to_string(failure.rotor) + ", " +
                           failure.field + " " + std::to_string(failure.value) + ", " +
                           failure.level + ", seed " + std::to_string(failure.seed);
  const test_support::Outcome flown = fly(failure);
  ASSERT_EQ(flown.exit_code, 0) << name << flown.output;
  EXPECT_LE(flown["emergency_landing_speed_mps"], 0.5) << name << flown.output;
  EXPECT_LE(flown["emergency_landing_lean_deg"], 20.0) << name;
  EXPECT_EQ(flown["failed_rotor"], failure.rotor) << name;
  const std::string kind = failure.kind == "servo" ? "servo" : "rotor";
  EXPECT_NE(flown.output.find("actuator_failure: " + kind), std::string::npos) << name;
  EXPECT_NE(flown.output.find("flight_mode_at_end: stopped"), std::string::npos) << name;
  if (failure.kind == "servo") {
    // One that sticks upright acts only when it is asked to turn; until then it changes nothing.
    if (failure.value != 0.0) {
      EXPECT_NEAR(flown["stuck_at_deg"], failure.value, 5.0) << name;
      EXPECT_LE(flown["failure_found_at_s"] - failure.start, 0.3) << name;
    }
  } else {
    EXPECT_NEAR(flown["thrust_left"], failure.value, 0.06) << name;
    // The speed of a motor that stops is the faster witness.
    const double longest = failure.kind == "motor" ? 0.03 : 0.3;
    EXPECT_LE(flown["failure_found_at_s"] - failure.start, longest) << name;
  }
}

// The servos follow four times later than the model says.
TEST(ActuatorFailure, SlowServosAreFoundAndTheMissionGoesOn) {
  for (const std::string level : {"wrench", "actuator"}) {
    const test_support::Directory directory("slow_servos");
    const test_support::Outcome flown = test_support::run(
        HYBRID_MISSION_PROGRAM, "--no-pictures --servo-time-constant 0.02 --output '" +
                                    directory.file("") + "' --level " + level);
    ASSERT_EQ(flown.exit_code, 0) << level << flown.output;
    EXPECT_NE(flown.output.find("actuator_failure: slow_servos"), std::string::npos) << level;
    EXPECT_NEAR(flown["servo_time_constant_s"], 0.08, 0.01) << level;  // the vehicle's
    EXPECT_LT(flown["air_rmse_m"], 0.005) << level;
    EXPECT_LT(flown["ground_rmse_m"], 0.01) << level;
  }
}

TEST(ActuatorFailure, IsFoundAndTheVehicleLandsSoftAndLevel) {
  std::vector<Failure> failures;
  const int seeds = test_support::quick_or_full(1, 2);
  for (int seed = 1; seed <= seeds; ++seed)
    for (const int rotor : {1, 2, 3, 4})
      for (const double start : {2.0, 4.0 + 0.7 * ((7 * seed + 3 * rotor) % 11)}) {
        const std::string level = (rotor + seed) % 2 == 0 ? "wrench" : "actuator";
        for (const double angle : {0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0})
          failures.push_back({"servo", "angle", angle, rotor, start, level, seed});
        for (const double left : {0.0, 0.5})
          failures.push_back({"blade", "effectiveness", left, rotor, start, level, seed});
      }
  // A plain run flies some of them.
  const std::size_t step = test_support::full_run() ? 1 : 14;
  for (std::size_t i = step / 2; i < failures.size(); i += step)
    expect_found_and_landed(failures[i]);
}

// In hover and in the figure eight, with telemetry that shows it and with telemetry that does not.
TEST(ActuatorFailure, AMotorThatStopsIsFoundAndTheVehicleLands) {
  const int seeds = test_support::quick_or_full(1, 10);
  for (int seed = 1; seed <= seeds; ++seed)
    for (const int rotor : {1, 2, 3, 4}) {
      const std::string level = (rotor + seed) % 2 == 0 ? "wrench" : "actuator";
      expect_found_and_landed({"motor", "", 0.0, rotor, 5.1, level, seed});
      if (rotor == 1 + seed % 4)
        expect_found_and_landed({"motor_silent", "", 0.0, rotor, 2.0, level, seed});
    }
}

// Without telemetry. A rotor in front or behind is missed before the take-off, one on the axle as
// soon as its wheel should leave the ground.
TEST(ActuatorFailure, ARotorThatIsDeadBeforeTheTakeOffIsFound) {
  for (const int rotor : {1, 2, 3, 4})
    for (const std::string level : {"wrench", "actuator"}) {
      if (!test_support::full_run() && rotor % 2 == (level == "wrench")) continue;
      const test_support::Directory directory("dead_rotor");
      const test_support::Outcome flown =
          test_support::run(HYBRID_MISSION_PROGRAM,
                            "--no-pictures --output '" + directory.file("") + "' --level " + level +
                                " --failure motor_silent:start=0,rotor=" + std::to_string(rotor));
      ASSERT_EQ(flown.exit_code, 0) << rotor << level << flown.output;
      EXPECT_EQ(flown["failed_rotor"], rotor) << level;
      EXPECT_EQ(flown["thrust_left"], 0.0) << rotor << level;
      EXPECT_LE(flown["touchdown_speed_mps"], 0.2) << rotor << level;
      EXPECT_LE(flown["failure_found_at_s"], rotor > 2 ? 1.0 : 2.5) << rotor << level;
    }
}

TEST(ActuatorFailure, OptionNamesWhatIsWrong) {
  const auto expect_refused = [](const std::string& option, const std::string& reason) {
    const auto refused =
        test_support::run(HYBRID_MISSION_PROGRAM, "--no-pictures --failure '" + option + "'");
    EXPECT_NE(refused.exit_code, 0) << option;
    EXPECT_NE(refused.output.find(reason), std::string::npos) << refused.output;
  };
  expect_refused("wing:rotor=1",
                 "--failure wing: must be motor, motor_silent, blade, servo or limp");
  expect_refused("motor:rotor=1,angle=3", "unknown field angle, must be rotor or start");
  expect_refused("servo:rotor=5,angle=10", "rotor = 5: must be a whole number from 1 to 4");
  expect_refused("servo:rotor=1.5", "a whole number from 1 to 4");
  expect_refused("servo:rotor=1,angle=270", "angle [deg] = 270");
  expect_refused("rotor:rotor=1,effectiveness=2", "effectiveness = 2");
  expect_refused("rotor:rotor=1,start=soon", "start = soon: must be a number");
  expect_refused("servo:rotor=1,effectiveness=0",
                 "unknown field effectiveness, must be rotor, start or angle");
}

}  // namespace actuator_failure_test
