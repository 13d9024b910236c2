// Runs the program stress_flights as a user does: scenarios, output files and options.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cstdlib>
#include <sstream>
#include <string>

namespace stress_flights_test {

using test_support::Directory;
using test_support::Outcome;
using test_support::run;

Outcome fly(const Directory& directory, const std::string& options) {
  return run(STRESS_FLIGHTS_PROGRAM, "--no-pictures -o '" + directory.file("out") + "' " + options);
}

TEST(StressFlights, EveryScenarioRecoversWithinBounds) {
  const Directory directory("stress_flights");
  const int count = test_support::quick_or_full(1, 2);
  for (const char* scenario : {"step", "yaw", "knocked", "thrown", "inverted", "random"}) {
    const Outcome told =
        fly(directory, "--count " + std::to_string(count) + " --seed 5 --scenario " + scenario);
    ASSERT_EQ(told.exit_code, 0) << told.output;
    EXPECT_EQ(told.figures.at("scenario"), scenario);
    EXPECT_EQ(told["flights"], count);
    EXPECT_EQ(told["recovered_fraction"], 1.0) << scenario;
    EXPECT_LE(told["worst_bound_ratio"], 1.0) << scenario;
    EXPECT_GT(told["worst_bound_ratio"], 0.1) << scenario;
    EXPECT_EQ(told["unsolved_called_solved"], 0.0) << scenario;
    EXPECT_EQ(told["solver_failures"], 0.0) << scenario;
    EXPECT_GT(told["median_tick_us"], 0.0);
    EXPECT_GE(told["worst_tick_us"], told["median_tick_us"]);
  }
}

TEST(StressFlights, PrintedCommandRepeatsTheWorstFlight) {
  const Directory directory("stress_flights");
  const Outcome told = fly(directory, "--scenario knocked --size 60 --height 1 --count 4 --seed 2");
  ASSERT_EQ(told.exit_code, 0) << told.output;
  EXPECT_LT(told["recovered_fraction"], 1.0) << "too easy for this test";
  std::string command = told.figures.at("repeat_worst");
  command.erase(0, command.find(" --scenario"));
  const Outcome again = fly(directory, command);
  ASSERT_EQ(again.exit_code, 0) << again.output;
  EXPECT_EQ(again["flights"], 1.0);
  EXPECT_EQ(again["recovered_fraction"], 0.0);
  EXPECT_EQ(again.figures.at("worst_flight"), told.figures.at("worst_flight"));
}

TEST(StressFlights, WritesFlightTableAndLog) {
  const Directory directory("stress_flights");
  const Outcome told = fly(directory, "--scenario yaw --size 90 --count 2 --duration 4");
  ASSERT_EQ(told.exit_code, 0) << told.output;
  std::istringstream table(test_support::read_file(directory.file("out/stress_flights.csv")));
  std::string line;
  std::getline(table, line);
  EXPECT_EQ(line,
            "flight,recovered,recovery_time_s,lowest_m,speed_mps,tilt_deg,rate_radps,worst_tick_us,"
            "most_passes,bound_ratio,approximate_ticks,solver_failures");
  int rows = 0;
  while (std::getline(table, line)) ++rows;
  EXPECT_EQ(rows, 2);
  std::istringstream log(test_support::read_file(directory.file("out/stress_flights_log.csv")));
  for (rows = -1; std::getline(log, line);) ++rows;
  EXPECT_EQ(rows, 80);
}

TEST(StressFlights, RecoversWithOtherVehicleAndTimeLimit) {
  const Directory directory("stress_flights");
  const Outcome told = fly(
      directory, "--scenario step --size 3 --count 1 --time-limit-us 2000 --vehicle " VEHICLES_DIR
                 "/hexacopter.json");
  ASSERT_EQ(told.exit_code, 0) << told.output;
  EXPECT_EQ(told["recovered_fraction"], 1.0);
  EXPECT_LE(told["worst_bound_ratio"], 1.0);
}

TEST(StressFlights, DrawsAPicture) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  const Directory directory("stress_flights");
  const Outcome told =
      run(STRESS_FLIGHTS_PROGRAM, "--count 3 --duration 5 -o '" + directory.file("out") + "'");
  EXPECT_EQ(told.exit_code, 0) << told.output;
  EXPECT_EQ(told.output.find("arning"), std::string::npos) << told.output;
  EXPECT_GT(test_support::read_file(directory.file("out/stress_flights.png")).size(), 30000u);
}

TEST(StressFlights, HelpAndBadArguments) {
  EXPECT_EQ(run(STRESS_FLIGHTS_PROGRAM, "--help").exit_code, 0);
  EXPECT_GT(run(STRESS_FLIGHTS_PROGRAM, "--scenario looping").exit_code, 100);
  EXPECT_GT(run(STRESS_FLIGHTS_PROGRAM, "--count 0").exit_code, 100);
  EXPECT_GT(run(STRESS_FLIGHTS_PROGRAM, "--size -1").exit_code, 100);
  EXPECT_EQ(run(STRESS_FLIGHTS_PROGRAM, "--vehicle nowhere.json").exit_code, 2);
}

}  // namespace stress_flights_test
