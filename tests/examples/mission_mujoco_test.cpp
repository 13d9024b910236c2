// Runs the program mission_mujoco as a user does.
// CTest: flight one_process mujoco

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <cstdlib>
#include <filesystem>
#include <string>
#include <vector>

namespace mission_mujoco_test {

namespace fs = std::filesystem;

struct Flight : test_support::Outcome {
  int films = 0;
};

/// The number of pixels with the orange of the vehicle's shell. ffmpeg reads pictures and films.
int orange_pixels(const std::string& picture) {
  const std::string raw = picture + ".rgb";
  if (std::system(("ffmpeg -v error -i '" + picture +
                   "' -frames:v 20 -f rawvideo -pix_fmt rgb24 '" + raw + '\'')
                      .c_str()) != 0)
    return 0;
  const std::string bytes = test_support::read_file(raw);
  int count = 0;
  for (std::size_t i = 0; i + 2 < bytes.size(); i += 3) {
    const auto red = static_cast<unsigned char>(bytes[i]),
               blue = static_cast<unsigned char>(bytes[i + 2]);
    if (red > 150 && blue < red / 2) ++count;
  }
  return count;
}

Flight run(const std::string& arguments) {
  const test_support::Directory directory("mission_mujoco");
  Flight result{
      test_support::run(MISSION_MUJOCO_PROGRAM,  // set by CMake
                        "--no-pictures --output '" + directory.file("") + "' " + arguments),
      0};
  for (const char* name : {"mission.mp4", "mission.gif", "air.png", "ground.png"})
    if (fs::exists(directory.file(name)) && orange_pixels(directory.file(name)) > 1000)
      ++result.films;
  return result;
}

/// The flight without options, which has seed 1.
const Flight& plain_flight() {
  static const Flight flight = run("");
  return flight;
}

// Flies one seed; five in a full run.
TEST(MissionMujoco, TracksWithHybridMissionSettings) {
  const int seeds = test_support::quick_or_full(1, 5);
  for (int seed = 1; seed <= seeds; ++seed) {
    const Flight flight = seed == 1 ? plain_flight() : run("--seed " + std::to_string(seed));
    ASSERT_EQ(flight.exit_code, 0) << flight.output;
    EXPECT_LE(flight["air_rmse_m"], 0.003) << flight.output;
    EXPECT_LE(flight["ground_rmse_m"], 0.006) << flight.output;
    EXPECT_LE(flight["mission_rmse_m"], 0.008) << flight.output;
    EXPECT_GE(flight["power_saved_percent"], 94.4) << flight.output;
    EXPECT_EQ(flight["solver_failures"], 0) << flight.output;
    EXPECT_EQ(flight["tipped_over"], 0) << flight.output;
    EXPECT_LT(flight["lean_max_deg"], 10.0) << flight.output;
    EXPECT_EQ(flight["contact_mode_changes"], 4) << flight.output;
    EXPECT_LE(flight["touchdown_speed_mps"], 0.3) << flight.output;
  }
}

// The battery gives power, voltage and current as in our plant.
TEST(MissionMujoco, FliesAMissionFromAFile) {
  EXPECT_EQ(run("--mission-file nowhere.json").exit_code, 2);
  if (!test_support::full_run()) GTEST_SKIP() << "like the other missions: --full";
  Flight flight = run("--mission-file '" MISSIONS_DIR "/tour.json'");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LE(flight["air_rmse_m"], 0.005) << flight.output;
  EXPECT_LE(flight["ground_rmse_m"], 0.010) << flight.output;
  EXPECT_EQ(flight["contact_mode_changes"], 4) << flight.output;
  EXPECT_EQ(flight["solver_failures"], 0) << flight.output;
  EXPECT_GT(flight["endurance_ground_min"], 10.0 * flight["endurance_air_min"]);
  EXPECT_GT(flight["min_voltage_V"], 15.0);
  EXPECT_GT(flight["max_current_A"], 653.64 / 16.8);
}

TEST(MissionMujoco, InspectsAWall) {
  const Flight flight = run("--mission inspect --level actuator");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_NEAR(flight["force_mean_n"], 5.0, 0.15) << flight.output;
  EXPECT_LT(flight["force_stddev_n"], 0.15) << flight.output;
  EXPECT_LT(flight["force_max_n"], 6.0) << flight.output;
  EXPECT_LT(flight["slide_error_m"], 0.02) << flight.output;
}

// Flies seven rotors that do not tilt; every vehicle file in a full run.
TEST(MissionMujoco, FliesVehiclesOfAnyNumberOfRotors) {
  std::vector<std::string> names = {"coaxial_octocopter"};
  if (test_support::full_run()) {
    names.clear();
    for (const auto& entry : fs::directory_iterator(VEHICLES_DIR))
      if (entry.path().extension() == ".json") names.push_back(entry.path().stem().string());
    EXPECT_GE(names.size(), 11u);
  }
  for (const std::string& name : names) {
    Flight flight = run("--vehicle '" VEHICLES_DIR "/" + name + ".json'");
    ASSERT_EQ(flight.exit_code, 0) << name << '\n' << flight.output;
    EXPECT_LE(flight["air_rmse_m"], 0.010) << name;
    // A pusher does not brake: on the ground, this vehicle rolls 60 mm ahead where the eight slows.
    EXPECT_LE(flight["mission_rmse_m"], name == "quadrotor_with_pusher" ? 0.025 : 0.020) << name;
    EXPECT_LE(flight["touchdown_speed_mps"], 0.2) << name;
    EXPECT_EQ(flight["solver_failures"], 0) << name;
    EXPECT_EQ(flight["tipped_over"], 0) << name;
  }
  const Flight refused = run("--slow-servo 5");
  EXPECT_NE(refused.exit_code, 0);
  EXPECT_TRUE(refused.says("--slow-servo = 5")) << refused.output;
}

TEST(MissionMujoco, EveryOptionTakesEffect) {
  EXPECT_NE(run("--slope 99").exit_code, 0);
  if (!test_support::full_run()) GTEST_SKIP() << "flies six missions: --full";
  const Flight& plain = plain_flight();
  for (const char* option : {"--wind 1.5", "--friction 0.2", "--payload 0.1", "--step 0.01",
                             "--step 0.02", "--slow-servo 3"}) {
    Flight flight = run(option);
    EXPECT_EQ(flight.exit_code, 0) << option << '\n' << flight.output;
    EXPECT_EQ(flight["solver_failures"], 0) << option;
    EXPECT_EQ(flight["tipped_over"], 0) << option;
    EXPECT_TRUE(flight["mission_rmse_m"] != plain["mission_rmse_m"] ||
                flight["air_rmse_m"] != plain["air_rmse_m"])
        << option;
    EXPECT_EQ(flight["contact_mode_changes"], 4) << option;
    EXPECT_LT(flight["mission_rmse_m"], 0.10) << option;  // 67 mm in wind
  }
}

// With all its weight on the wheels, a vehicle is turned by up to 80 degrees at the edges.
TEST(MissionMujoco, CrossesAPlank) {
  std::vector<std::string> cases = {"--step 0.02"};
  if (test_support::full_run())
    for (const char* more : {"--step 0.02 --seed 2", "--step 0.02 --seed 3", "--step 0.03",
                             "--step 0.02 --level actuator", "--step 0.03 --level actuator"})
      cases.emplace_back(more);
  for (const std::string& plank : cases) {
    Flight flight = run("--mission ground " + plank);
    ASSERT_EQ(flight.exit_code, 0) << plank << '\n' << flight.output;
    EXPECT_LT(flight["ground_rmse_m"], 0.08) << plank;
    EXPECT_LT(flight["ground_power_w"], 120.0) << plank;  // 34 W without a plank
  }
}

// One of ground, height, mass, thrust and tyre scrub at a time differs from what the controller
// assumes: one case, all in a full run.
TEST(MissionMujoco, LandsDrivesAndTakesOffWithWrongGroundOrVehicle) {
  std::vector<std::string> cases = {"--slope 7"};
  if (test_support::full_run())
    for (const char* more :
         {"--ground-height -0.5", "--height-drift 0.1", "--mass-error 0.15", "--ground-height 0.5",
          "--ground-height 0.1", "--ground-height -0.1", "--height-offset 0.1",
          "--height-offset -0.1", "--height-drift -0.1", "--mass-error 0.2", "--mass-error -0.2",
          "--thrust-error -0.15", "--tyre-scrub 2", "--slope 5", "--slope -8 --slope-direction 60"})
      cases.emplace_back(more);
  for (const std::string& arguments : cases) {
    Flight flight = run(arguments);
    ASSERT_EQ(flight.exit_code, 0) << arguments << '\n' << flight.output;
    // Half a metre above the assumed ground, it counts as in the air until it feels the ground.
    EXPECT_EQ(flight["contact_mode_changes"], arguments == "--ground-height 0.5" ? 5 : 4)
        << arguments;
    EXPECT_EQ(flight["solver_failures"], 0) << arguments;
    test_support::check_at_most(24, "MuJoCo: touch-down [m/s]", flight["touchdown_speed_mps"], 0.2);
    test_support::check_at_most(24, "MuJoCo: RMSE on the ground [m]", flight["ground_rmse_m"],
                                0.03);
    test_support::check_at_least(24, "MuJoCo: power saved [%]", flight["power_saved_percent"],
                                 90.0);
  }
}

TEST(MissionMujoco, RecordsFilmIfRenderingIsAvailable) {
  if (!test_support::full_run()) GTEST_SKIP() << "takes a minute: --full";
  const Flight flight = run("--film");
  EXPECT_EQ(flight.exit_code, 0);
  if (flight.output.find("no film: ") != std::string::npos)
    GTEST_SKIP() << flight.output.substr(flight.output.find("no film: "), 80);
  EXPECT_EQ(flight.films, 4);
}

}  // namespace mission_mujoco_test
