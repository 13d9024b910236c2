// The main job flown by the example program as a user runs it, judged by what it prints.

#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <string>

namespace {

namespace fs = std::filesystem;

const std::string program = HYBRID_MISSION_PROGRAM;  // set by CMake

struct Flight {
  int exit_code = -1;
  std::map<std::string, double> figures;
  std::string output, csv;
  int pictures = 0;
};

Flight run(const std::string& arguments) {
  Flight result;
  const fs::path directory =
      fs::path(testing::TempDir()) / ("hybrid_mission_" + std::to_string(getpid()));
  const std::string command =
      "'" + program + "' --output '" + directory.string() + "' " + arguments + " 2>&1";
  FILE* pipe = popen(command.c_str(), "r");
  if (pipe == nullptr) return result;
  char buffer[4096];
  while (std::fgets(buffer, sizeof buffer, pipe) != nullptr) {
    const std::string line = buffer;
    result.output += line;
    const auto colon = line.find(": ");
    if (colon != std::string::npos)
      result.figures[line.substr(0, colon)] = std::atof(line.c_str() + colon + 2);
  }
  result.exit_code = pclose(pipe);
  if (!fs::exists(directory)) return result;
  std::ifstream csv(directory / "hybrid_mission.csv", std::ios::binary);
  std::ostringstream text;
  text << csv.rdbuf();
  result.csv = text.str();
  for (const auto& entry : fs::directory_iterator(directory))
    if (entry.path().extension() == ".png" && entry.file_size() > 10000) ++result.pictures;
  fs::remove_all(directory);
  return result;
}

const Flight& flown() {
  static const Flight result = run("--no-pictures --seed 1");
  return result;
}

double figure(const std::string& key) {
  const auto found = flown().figures.find(key);
  EXPECT_NE(found, flown().figures.end()) << key << " is missing in\n" << flown().output;
  return found == flown().figures.end() ? std::nan("") : found->second;
}

TEST(HybridMission, TracksBetterThanAskedAndThanThePaper) {
  ASSERT_EQ(flown().exit_code, 0) << flown().output;
  EXPECT_LE(figure("air_rmse_m"), 0.015);
  EXPECT_LE(figure("ground_rmse_m"), 0.020);
  EXPECT_LE(figure("mission_rmse_m"), 0.025);
  EXPECT_DOUBLE_EQ(figure("paper_air_rmse_m"), 0.052);
  EXPECT_DOUBLE_EQ(figure("paper_ground_rmse_m"), 0.145);
  EXPECT_DOUBLE_EQ(figure("paper_mission_rmse_m"), 0.125);
}

TEST(HybridMission, SavesThePowerThatThePaperSaves) {
  EXPECT_GE(figure("power_saved_percent"), 92.8);
  EXPECT_NEAR(figure("flight_power_w"), 653.64, 20.0);
  EXPECT_GT(figure("ground_power_w"), 20.0);  // the electronics at least
}

TEST(HybridMission, LandsAndTakesOffOnceEachAndGently) {
  EXPECT_LE(figure("touchdown_speed_mps"), 0.3);
  EXPECT_GT(figure("touchdown_speed_mps"), 0.0);
  EXPECT_LE(figure("takeoff_overshoot_m"), 0.05);
  EXPECT_EQ(figure("contact_mode_changes"), 4);  // two take-offs, two landings
}

TEST(HybridMission, NeverFailsToSolve) {
  EXPECT_EQ(figure("solver_failures"), 0);
  EXPECT_GT(figure("nmpc_median_us"), 0.0);
}

// What is asked of the servos: the tilt rate of the commanded wrench, and the speed at which they
// have to start towards their commands.
TEST(HybridMission, AsksTheServosForNoMoreThanTheyCanAndTracksAsWell) {
  EXPECT_LE(figure("planned_tilt_rate_max_radps"), 0.85 * 8.0 + 0.005);
  EXPECT_LE(figure("tilt_rate_max_radps"), figure("servo_speed_radps"));
  EXPECT_EQ(figure("tilt_rate_exceeded_share"), 0.0);

  Flight boxes = run("--no-pictures --no-actuator-rows");
  ASSERT_EQ(boxes.exit_code, 0) << boxes.output;
  EXPECT_GT(boxes.figures["planned_tilt_rate_max_radps"], 12.0);
  // Estimated states are calm enough for these servos to follow all the same; slower ones are not.
  EXPECT_GT(boxes.figures["tilt_rate_max_radps"], figure("tilt_rate_max_radps"));
  for (const char* rmse : {"air_rmse_m", "ground_rmse_m", "mission_rmse_m"})
    EXPECT_LE(figure(rmse), 1.05 * boxes.figures[rmse]) << rmse;
}

TEST(HybridMission, AsksSlowerServosForNoMoreEither) {
  Flight rows = run("--no-pictures --servo-speed 6");
  Flight boxes = run("--no-pictures --servo-speed 6 --no-actuator-rows");
  EXPECT_LE(rows.figures["tilt_rate_max_radps"], 6.0);
  EXPECT_EQ(rows.figures["tilt_rate_exceeded_share"], 0.0);
  EXPECT_GT(boxes.figures["tilt_rate_max_radps"], 1.2 * 6.0);
  EXPECT_GT(boxes.figures["tilt_rate_exceeded_share"], 0.01);
  EXPECT_LE(rows.figures["ground_rmse_m"], 0.012);  // the price: 0.0088 without the rows
}

TEST(HybridMission, VerySlowServosCanStillDriveWithTheRowsAndNotWithout) {
  Flight rows = run("--no-pictures --servo-speed 2 --ground-thrust 1");
  Flight boxes = run("--no-pictures --servo-speed 2 --ground-thrust 1 --no-actuator-rows");
  EXPECT_LE(rows.figures["planned_tilt_rate_max_radps"], 0.85 * 2.0 + 0.005);
  EXPECT_LE(rows.figures["ground_rmse_m"], 0.07);
  EXPECT_EQ(rows.figures["contact_mode_changes"], 4);
  EXPECT_EQ(rows.figures["solver_failures"], 0);
  EXPECT_GT(boxes.figures["ground_rmse_m"], 0.5);  // lost
}

TEST(HybridMission, SameSeedGivesTheSameLogBitForBitAndAnotherSeedDoesNot) {
  EXPECT_GT(flown().csv.size(), 1000000u);
  EXPECT_TRUE(run("--no-pictures --seed 1").csv == flown().csv);
  EXPECT_FALSE(run("--no-pictures --seed 2").csv == flown().csv);
}

TEST(HybridMission, LeavesItsPicturesWithoutAWarning) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  const Flight drawn = run("");
  EXPECT_EQ(drawn.pictures, 8);
  EXPECT_EQ(drawn.output.find("arning"), std::string::npos) << drawn.output;
}

TEST(HybridMission, HelpAndBadArguments) {
  const Flight help = run("--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_NE(help.output.find("--mass-error"), std::string::npos);
  const Flight bad = run("--mass-error -3");
  EXPECT_NE(bad.exit_code, 0);
  EXPECT_NE(bad.output.find("--mass-error"), std::string::npos);
  const Flight unwritable = run("--output /proc/nowhere --no-pictures");
  EXPECT_NE(unwritable.exit_code, 0);
}

}  // namespace
