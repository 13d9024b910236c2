// Flies the vehicles of examples/vehicles as a user does: at the level that suits them, with
// default weights.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <cstdlib>
#include <filesystem>
#include <set>
#include <sstream>
#include <string>
#include <vector>

namespace vehicles_test {

std::string file_of(const std::string& vehicle) {
  return std::string(VEHICLES_DIR) + '/' + vehicle + ".json";
}

struct Expected {
  const char* name;
  const char* level;
  double air, ground;  // largest RMSE [m]; ground 0: it does not drive
  int mode_changes;
  bool always = true;  // false: only in the full run, because other tests fly it or one like it
};

const std::vector<Expected>& vehicles() {
  static const std::vector<Expected> all{
      {"tilt_ropter", "wrench", 0.0025, 0.005, 4, false},
      {"five_kilograms", "wrench", 0.003, 0.012, 4, false},
      {"hexacopter", "wrench", 0.005, 0.0, 0, false},
      {"octocopter", "wrench", 0.01, 0.0, 0, false},
      {"tilting_x_quadrotor", "wrench", 0.003, 0.012, 4},
      {"quadrotor", "actuator", 0.005, 0.03, 4, false},
      {"bicopter", "actuator", 0.005, 0.03, 4},
      {"tricopter", "actuator", 0.005, 0.03, 4, false},
      {"quadrotor_with_pusher", "actuator", 0.005, 0.04, 4, false},
      {"hexacopter_with_pusher", "actuator", 0.005, 0.0, 2, false},
      {"coaxial_octocopter", "actuator", 0.005, 0.0, 2, false},
  };
  return all;
}

TEST(Vehicles, EveryVehicleFliesItsMissionWithDefaultWeights) {
  const test_support::Directory directory("vehicles");
  std::set<std::string> flown;
  for (const Expected& vehicle : vehicles()) {
    flown.insert(vehicle.name);
    if (!vehicle.always && !test_support::full_run()) continue;
    const auto told = test_support::run(
        HYBRID_MISSION_PROGRAM, "--no-pictures --vehicle '" + file_of(vehicle.name) + "' -o '" +
                                    directory.file(vehicle.name) + "'");
    ASSERT_EQ(told.exit_code, 0) << told.output;
    EXPECT_TRUE(told.says(std::string("level: ") + vehicle.level)) << told.output;
    EXPECT_LT(told["air_rmse_m"], vehicle.air) << vehicle.name;
    if (vehicle.ground > 0.0) {
      EXPECT_LT(told["ground_rmse_m"], vehicle.ground) << vehicle.name;
    }
    EXPECT_LT(told["mission_rmse_m"], 0.03) << vehicle.name;
    EXPECT_EQ(told["solver_failures"], 0) << vehicle.name;
    EXPECT_EQ(told["contact_mode_changes"], vehicle.mode_changes) << vehicle.name;
    EXPECT_LT(told["touchdown_speed_mps"], 0.4) << vehicle.name;
  }
  for (const auto& entry : std::filesystem::directory_iterator(VEHICLES_DIR))
    if (entry.path().extension() == ".json") {
      EXPECT_EQ(flown.count(entry.path().stem()), 1u) << entry.path();
    }
}

TEST(Vehicles, RefusesTheWrenchLevelWhereTheRotorsDoNotGiveEveryWrench) {
  for (const char* name : {"quadrotor", "bicopter", "coaxial_octocopter"}) {
    const auto told = test_support::run(
        HYBRID_MISSION_PROGRAM, "--no-pictures --level wrench --vehicle '" + file_of(name) + "'");
    EXPECT_EQ(told.exit_code, 2) << told.output;
    EXPECT_TRUE(told.says("the allocation has rank 4, must be 6")) << told.output;
  }
  const auto chosen = test_support::run(STEP_RESPONSES_PROGRAM,
                                        "--no-pictures --vehicle '" + file_of("tricopter") + "'");
  EXPECT_EQ(chosen.exit_code, 2) << chosen.output;
  EXPECT_TRUE(chosen.says("the wrench level cannot control this vehicle")) << chosen.output;
}

// The tests of check_vehicle check vehicles of full rank.
TEST(Vehicles, CheckSaysWhatLeaningVehiclesCannotDo) {
  const test_support::Directory directory("check_vehicles");
  for (const char* name : {"bicopter", "tricopter", "quadrotor"}) {
    const bool flies = test_support::full_run();
    const auto told = test_support::run(CHECK_VEHICLE_PROGRAM,
                                        file_of(name) + (flies ? "" : " --no-flight") +
                                            " --no-pictures -o '" + directory.file("") + "'");
    EXPECT_EQ(told.exit_code, 0) << told.output;
    EXPECT_TRUE(told.says("level: actuator")) << told.output;
    EXPECT_TRUE(told.says("leans to accelerate forward")) << told.output;
    EXPECT_TRUE(told.says("leans to accelerate sideways")) << told.output;
    EXPECT_EQ(told.says("cannot hover level"), std::string(name) == "tricopter") << told.output;
    EXPECT_EQ(told["warnings"], 0) << told.output;
    if (!flies) continue;
    EXPECT_LT(told["flown_ground_rmse_m"], 0.03) << told.output;
    EXPECT_TRUE(told.says("verdict: flies")) << told.output;
  }
  // Without the servos, the bicopter can neither pitch nor yaw.
  std::string text = test_support::read_file(file_of("bicopter"));
  for (std::size_t at = 0; (at = text.find("\"tilts\": true", at)) != std::string::npos;)
    text.replace(at, 13, "\"tilts\": false");
  for (std::size_t at = 0; (at = text.find("\"arm_axis\"", at)) != std::string::npos;)
    text.erase(at, text.find('\n', at) - at + 1);
  const auto fixed = test_support::run(CHECK_VEHICLE_PROGRAM,
                                       directory.write("fixed.json", text) + " --no-pictures");
  EXPECT_EQ(fixed.exit_code, 1) << fixed.output;
  EXPECT_TRUE(fixed.says("it cannot pitch")) << fixed.output;
  EXPECT_TRUE(fixed.says("verdict: does not fly")) << fixed.output;
}

// The vehicle of the paper, with locked servos, and the bicopter. The full vehicle does not lean
// and needs less power on the ground.
TEST(Vehicles, ComparesFullActuationWithLeaning) {
  const test_support::Directory directory("compare_vehicles");
  const bool draws = std::system("gnuplot --version > /dev/null 2>&1") == 0;
  const auto told =
      test_support::run(COMPARE_VEHICLES_PROGRAM, std::string(draws ? "" : "--no-pictures ") +
                                                      "-o '" + directory.file("") + "'");
  ASSERT_EQ(told.exit_code, 0) << told.output;
  EXPECT_TRUE(told.says("Tilt-Ropter with locked servos")) << told.output;
  EXPECT_EQ(told.output.find("arning"), std::string::npos) << told.output;
  std::istringstream table(test_support::read_file(directory.file("compare_vehicles.csv")));
  std::string line;
  std::vector<double> lean, ground, power;
  std::getline(table, line);
  while (std::getline(table, line)) {
    std::istringstream fields(line.substr(line.rfind('"') + 2));
    std::vector<std::string> columns;
    for (std::string field; std::getline(fields, field, ',');) columns.push_back(field);
    ASSERT_EQ(columns.size(), 16u) << line;
    ground.push_back(std::stod(columns[3]));
    lean.push_back(std::stod(columns[5]));
    power.push_back(std::stod(columns[7]));
  }
  ASSERT_EQ(lean.size(), 3u);
  EXPECT_LT(lean[0], 3.0);
  EXPECT_GT(lean[1], 8.0);
  EXPECT_GT(lean[2], 8.0);
  for (const std::size_t other : {1u, 2u}) {
    EXPECT_LT(ground[0], ground[other]);
    EXPECT_LT(power[0], power[other]);
  }
  if (draws) {
    EXPECT_GT(test_support::read_file(directory.file("compare_vehicles.png")).size(), 10000u);
  }
}

}  // namespace vehicles_test
