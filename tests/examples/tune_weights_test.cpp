// Runs the program tune_weights as a user does, with few points in short flights.
// CTest: flight

#include "../../examples/support/vehicle_choice.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <string>
#include <type_traits>
#include <vector>

namespace tune_weights_test {

using test_support::Directory;
using test_support::Outcome;
using test_support::read_file;

/// Few points on the figure eight in the air.
Outcome tune(const Directory& directory, const std::string& output, const std::string& options) {
  return test_support::run(TUNE_WEIGHTS_PROGRAM,
                           "--mission air --minimise air_rmse_m --spread 0.2 "
                           "--no-pictures --output '" +
                               directory.file(output) + "' " + options);
}

/// Writes the Tilt-Ropter with weights that are wrong by 10 and 0.1 alternately.
std::string wrong_vehicle(const Directory& directory) {
  examples::VehicleFile file;
  double factor = std::sqrt(10.0);
  tilt_ropter::for_allowed_errors(file.allowed_errors, [&](const char*, const char*, auto& error) {
    error *= factor;
    factor = 1.0 / factor;
  });
  examples::write_vehicle(file, directory.file("wrong.json"));
  return directory.file("wrong.json");
}

TEST(TuneWeights, ImprovesWrongWeights) {
  const Directory directory("tune_weights");
  const std::string wrong = wrong_vehicle(directory);
  const Outcome found =
      tune(directory, "out", "--vehicles 1 --evaluations 20 --vehicle '" + wrong + '\'');
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found["evaluations"], 20);
  EXPECT_EQ(found["flights"], 20 + 2);  // and both with another seed
  EXPECT_EQ(found["objective_after"], found["air_rmse_m_after"]);
  EXPECT_LT(found["objective_after"], 0.7 * found["objective_before"]);
  EXPECT_LT(found["other_seed_objective_after"], 0.7 * found["other_seed_objective_before"]);
  EXPECT_TRUE(found.says("mujoco_command_after: mission_mujoco"));
  if (found.says("mujoco_air_rmse_m_after"))  // where MuJoCo is installed
    EXPECT_LT(found["mujoco_air_rmse_m_after"], 0.7 * found["mujoco_air_rmse_m_before"]);

  // The file has the printed errors; those of the other level are as they were.
  const examples::VehicleFile before = examples::read_vehicle(wrong),
                              after = examples::read_vehicle(found.figures.at("vehicle_file"));
  EXPECT_NEAR(after.allowed_errors.force.x(), found["best_force_per_weight"], 1e-5);
  EXPECT_NE(after.allowed_errors.force, before.allowed_errors.force);
  EXPECT_EQ(after.allowed_errors.tilt_rate, before.allowed_errors.tilt_rate);
  EXPECT_EQ(found.figures.count("best_tilt_rate_radps"), 0U);
}

TEST(TuneWeights, ResumedRunIsTheSameAsOneRun) {
  const Directory directory("tune_weights");
  const std::string options =
      "--level actuator --limit flight_power_w=600 --algorithm sbplx --vehicles 2 --no-mujoco ";
  ASSERT_EQ(tune(directory, "parts", options + "--evaluations 2").exit_code, 0);
  const std::string first = read_file(directory.file("parts/tune_weights.csv"));
  // A killed run leaves a line without an end.
  (void)directory.write("parts/tune_weights.csv", first + "0.1,0.2");
  const Outcome parts = tune(directory, "parts", options + "--evaluations 4 --resume"),
                whole = tune(directory, "whole", options + "--evaluations 4");
  ASSERT_EQ(parts.exit_code, 0) << parts.output;
  EXPECT_EQ(parts["flights"], 2 * 2 + 4);
  EXPECT_EQ(read_file(directory.file("parts/tune_weights.csv")),
            read_file(directory.file("whole/tune_weights.csv")));
  for (const char* key : {"objective_after", "best_position_m", "best_tilt_rate_radps"})
    EXPECT_EQ(parts.figures.at(key), whole.figures.at(key)) << key;
  EXPECT_EQ(whole["flight_power_w_limit"], 600);
  EXPECT_EQ(whole.figures.count("best_force_per_weight"), 0U);

  const Outcome other = tune(directory, "parts", options + "--seed 2 --resume");
  EXPECT_EQ(other.exit_code, 1);
  EXPECT_TRUE(other.says("is of another run")) << other.output;
}

// One search of bobyqa ends after 40 points here. A run that goes on in the second search is the
// same as one run.
TEST(TuneWeights, SearchesAgainFromTheBestPoint) {
  const Directory directory("tune_weights");
  const std::string mission = directory.write("short.json", R"({"name": "short",
      "start": {"position_m": [0, 0, 1]},
      "segments": [{"type": "hover", "duration_s": 1}, {"type": "go_to", "position_m": [0.1, 0, 1]}]})");
  const auto tune_short = [&](const std::string& output, const std::string& options) {
    return test_support::run(TUNE_WEIGHTS_PROGRAM,
                             "--mission-file '" + mission +
                                 "' --minimise mission_rmse_m --spread 0.2 --vehicles 1 " +
                                 "--range 1.2 --no-mujoco --no-pictures --output '" +
                                 directory.file(output) + "' " + options);
  };
  const Outcome whole = tune_short("whole", "");
  ASSERT_EQ(whole.exit_code, 0) << whole.output;
  EXPECT_GT(whole["evaluations"], 60);
  EXPECT_LT(whole["objective_after"], whole["objective_before"]);
  ASSERT_EQ(tune_short("parts", "--evaluations 50").exit_code, 0);
  ASSERT_EQ(tune_short("parts", "--resume").exit_code, 0);
  EXPECT_EQ(read_file(directory.file("parts/tune_weights.csv")),
            read_file(directory.file("whole/tune_weights.csv")));
}

TEST(TuneWeights, RefusesWrongOptions) {
  const Directory directory("tune_weights");
  const std::vector<std::vector<std::string>> wrong = {
      {"--range 1", "--range", "not in range 1.1"},
      {"--vehicles 0", "--vehicles", "not in range 1 to 1000"},
      {"--time-limit 0", "--time-limit", "not in range 1"},
      {"--algorithm newton", "--algorithm", "bobyqa"},
      {"--minimise rmse", "--minimise", "rmse: must be one of air_rmse_m"},
      {"--limit touchdown_speed_mps", "--limit", "must be KEY=VALUE with a finite number"},
      {"--limit speed=1", "--limit", "speed: must be one of air_rmse_m"},
      {"--limit nmpc_max_us=1", "--limit", "nmpc_max_us: must be one of"},
      {"--vehicle none.json", "none.json", "cannot read"}};
  for (const std::vector<std::string>& w : wrong) {
    const Outcome told = tune(directory, "out", w[0]);
    EXPECT_EQ(told.exit_code, 2) << told.output;
    EXPECT_TRUE(told.says(w[1]) && told.says(w[2])) << w[0] << ": " << told.output;
  }
  const Outcome missing = tune(directory, "out", "--minimise ground_rmse_m");
  EXPECT_EQ(missing.exit_code, 1);
  EXPECT_TRUE(missing.says("the flights of this mission have no ground_rmse_m"));
}

}  // namespace tune_weights_test
