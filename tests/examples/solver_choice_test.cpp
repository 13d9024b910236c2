// Who solves: the option --solver of programs that fly, and the ticks that they count.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <string>

namespace solver_choice_test {

using test_support::Directory;
using test_support::Outcome;

Outcome run(const std::string& program, const std::string& options) {
  const Directory directory("solver_choice");
  return test_support::run(program, "--no-pictures -o '" + directory.file("out") + "' " + options);
}

void expect_sound_counts(const Outcome& flight) {
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_GT(flight["riccati_ticks"] + flight["nlopt_ticks"] + flight["structured_ticks"], 500);
  EXPECT_GE(flight["nlopt_ticks"] + flight["structured_ticks"] + flight["unsolved_ticks"],
            flight["active_ticks"]);
}

// 20 m steps: up to dozens of active constraints.
TEST(SolverChoice, EachChoiceSolvesByWhatItSays) {
  const auto fly = [](const std::string& solver) {
    return run(STRESS_FLIGHTS_PROGRAM, "--scenario step --count 1 --duration 8 --solver " + solver);
  };
  const Outcome automatic = fly("automatic"), nlopt = fly("nlopt"), structured = fly("structured");
  for (const Outcome* flight : {&automatic, &nlopt, &structured}) {
    expect_sound_counts(*flight);
    EXPECT_EQ((*flight)["recovered_fraction"], 1.0);
    EXPECT_EQ((*flight)["unsolved_called_solved"], 0);
    EXPECT_GT((*flight)["active_ticks"], 20);
  }
  EXPECT_GT(automatic["nlopt_ticks"], 10);
  EXPECT_GT(automatic["structured_ticks"], 0);
  EXPECT_GE(nlopt["nlopt_ticks"], automatic["nlopt_ticks"]);
  EXPECT_EQ(nlopt["structured_ticks"], 0);
  EXPECT_EQ(structured["nlopt_ticks"], 0);
  EXPECT_GT(structured["structured_ticks"], automatic["structured_ticks"]);
}

TEST(SolverChoice, RefusesWhatIsNoChoice) {
  const Outcome unknown = run(HYBRID_MISSION_PROGRAM, "--solver ipopt");
  EXPECT_GT(unknown.exit_code, 100);
  EXPECT_TRUE(unknown.says("--solver: ipopt not in {automatic,nlopt,structured,nlopt_alone}"))
      << unknown.output;
  EXPECT_GT(run(STRESS_FLIGHTS_PROGRAM, "--solver nlopt_alone").exit_code, 100);
  const Outcome level = run(HYBRID_MISSION_PROGRAM, "--level actuator --solver nlopt_alone");
  EXPECT_EQ(level.exit_code, 1);
  EXPECT_TRUE(level.says("nlopt_alone flies at the wrench level only")) << level.output;
}

// The whole problem by SLSQP in every tick takes minutes for a hop.
TEST(SolverChoice, NloptAloneFliesAsWell) {
  const Directory directory("nlopt_alone");
  // The full run also flies and drives through points; a whole mission takes five minutes.
  const std::string way =
                        R"({"type": "way_points", "points_m": [[0.6, 0.3, 0.7], [1.2, 0, 0.5]]},)",
                    drive = R"(, {"type": "turn"},
      {"type": "way_points", "points_m": [[1.8, 0.3], [2.4, 0]]}, {"type": "stop"})";
  const bool full = test_support::full_run();
  directory.write("hop.json",
                  R"({"name": "hop", "start": {"position_m": [0, 0], "yaw_deg": 0}, "segments": [
      {"type": "rest", "duration_s": 0.2}, {"type": "take_off", "height_m": 0.5},)" +
                      (full ? way : "") +
                      R"({"type": "hover", "duration_s": 0.2}, {"type": "land"})" +
                      (full ? drive : "") + "]}");
  const std::string mission = "--mission-file '" + directory.file("hop.json") + "' ";
  const Outcome usual = run(HYBRID_MISSION_PROGRAM, mission),
                alone = run(HYBRID_MISSION_PROGRAM, mission + "--solver nlopt_alone");
  ASSERT_EQ(alone.exit_code, 0) << alone.output;
  EXPECT_EQ(alone["riccati_ticks"], 0);
  EXPECT_EQ(alone["structured_ticks"], 0);
  EXPECT_GT(alone["nlopt_ticks"], 100);
  EXPECT_LE(alone["unsolved_ticks"], 0.01 * alone["nlopt_ticks"]);
  EXPECT_NEAR(alone["mission_rmse_m"], usual["mission_rmse_m"], 0.05 * usual["mission_rmse_m"]);
}

}  // namespace solver_choice_test
