// hybrid_mission with each set of sensors, and with faults of them. What is lost in the air ends in
// a level landing, from any height. What comes back is used again.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <fstream>
#include <string>

namespace sensor_suites_test {

test_support::Outcome fly(const std::string& sensors, const std::string& fault,
                          const std::string& more = "") {
  const test_support::Directory directory("sensor_suites");
  return test_support::run(HYBRID_MISSION_PROGRAM,  // set by CMake
                           "--no-pictures --output '" + directory.file("") + "' --sensors " +
                               sensors + (fault.empty() ? "" : " --fault " + fault) + more);
}

void expect_landing(const test_support::Outcome& flown, double most) {
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_NE(flown.output.find("flight_mode_at_end: stopped"), std::string::npos) << flown.output;
  EXPECT_NE(flown.output.find("actuator_failure: none"), std::string::npos) << flown.output;
  EXPECT_LT(flown["imu_landing_speed_mps"], most);
  EXPECT_LT(flown["touchdown_speed_mps"], 0.7);  // downwards
  EXPECT_LT(flown["imu_landing_lean_deg"], 3.0);
}

TEST(SensorSuites, EachFliesTheMission) {
  struct Case {
    const char* sensors;
    double most;  // RMSE of the mission [m]
  };
  for (const auto& [sensors, most] : {Case{"gps", 0.03}, Case{"vio", 0.25}, Case{"wheels", 0.01}}) {
    const test_support::Outcome flown = fly(sensors, "");
    EXPECT_EQ(flown.exit_code, 0) << sensors;
    EXPECT_LT(flown["mission_rmse_m"], most) << sensors;
  }
}

// Flies two of the combinations; all in a full run.
TEST(SensorSuites, LosingAllPositionsEndsInALanding) {
  int combination = 0;
  for (const char* sensors : {"mocap", "gps", "vio", "wheels"})
    for (const char* fault :
         {"pose_dropout:start=14", "pose_freeze:start=14", "pose_ghost:start=14,size=0.5"}) {
      if (combination++ % 6 != 0 && !test_support::full_run()) continue;
      // The GPS keeps its velocity if only its positions are wrong.
      if (sensors == std::string("gps") && fault[5] == 'g') continue;
      SCOPED_TRACE(std::string(sensors) + ' ' + fault);
      const test_support::Outcome flown = fly(sensors, fault);
      expect_landing(flown, 1.0);
      std::printf("%s, %s: touch-down %.2f m/s, lean %.1f deg\n", sensors, fault,
                  flown["imu_landing_speed_mps"], flown["imu_landing_lean_deg"]);
    }
}

// The IMU alone drifts for 25 s, mostly sideways. Flies one set of sensors; three in a full run.
TEST(SensorSuites, LandsWithoutPositionsFromTenMetres) {
  const test_support::Directory directory("high_flight");
  std::ofstream file(directory.file("high.csv"));
  file << "time_s,x_m,y_m,z_m\n";
  for (int i = 0; i <= 700; ++i) {
    const double t = 0.1 * i, rise = 20.0, s = std::fmin(std::fmin(t, 70.0 - t) / rise, 1.0);
    file << t << ",0,0," << 0.11 + 10.0 * s * s * s * (10.0 - 15.0 * s + 6.0 * s * s) << '\n';
  }
  file.close();
  for (const char* sensors : {"vio", "mocap", "gps"}) {
    if (sensors != std::string("vio") && !test_support::full_run()) break;
    SCOPED_TRACE(sensors);
    const test_support::Outcome flown =
        fly(sensors, "pose_dropout:start=23", " --trajectory '" + directory.file("high.csv") + "'");
    expect_landing(flown, 1.5);
    std::printf("%s from 10 m: touch-down %.2f m/s\n", sensors, flown["imu_landing_speed_mps"]);
  }
}

// After a gap the vehicle returns to its mission. A landing that has begun is not taken back,
// although the positions return. Flies two of six cases; all in a full run.
TEST(SensorSuites, WhatComesBackIsUsedAgainUnlessItLands) {
  int combination = 0;
  for (const char* fault : {"pose_dropout:start=14,duration=2", "pose_freeze:start=14,duration=8",
                            "pose_ghost:start=14,size=1.5,duration=5"})
    for (const char* sensors : {"gps", "vio"}) {
      const bool lands = combination == 2 || combination == 3 || combination == 5;
      if (combination++ % 4 != 1 && !test_support::full_run()) continue;
      SCOPED_TRACE(std::string(sensors) + ' ' + fault);
      const test_support::Outcome flown = fly(sensors, fault);
      if (lands) {
        expect_landing(flown, 0.6);
        continue;
      }
      EXPECT_EQ(flown.exit_code, 0) << flown.output;
      EXPECT_NE(flown.output.find("flight_mode_at_end: mission"), std::string::npos);
      EXPECT_LT(flown["landing_error_m"], 0.3);
    }
}

}  // namespace sensor_suites_test
