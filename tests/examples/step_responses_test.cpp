// Runs the program step_responses as a user does and checks the effect of tuning.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cstdlib>
#include <sstream>
#include <string>

namespace step_responses_test {

/// One line of the printed table: rise time [s], overshoot [%] and largest lean [deg].
struct Row {
  double rise, overshoot, lean;
};

/// Returns the rows of `field`: halved, unchanged and doubled.
std::array<Row, 3> rows(const std::string& table, const std::string& field) {
  std::array<Row, 3> found{};
  std::istringstream lines(table);
  std::size_t i = 0;
  for (std::string line; std::getline(lines, line);) {
    if (line.rfind(field + "  ", 0) != 0) continue;
    std::istringstream numbers(line.substr(field.size()));
    std::string shown_by;
    double factor = 0.0;
    Row& row = found.at(i++);
    numbers >> shown_by >> factor >> row.rise >> row.overshoot >> row.lean;
  }
  EXPECT_EQ(i, 3u) << field << " in\n" << table;
  return found;
}

TEST(StepResponses, AllowedErrorsAndLimitsChangeTheResponse) {
  const test_support::Directory directory("step_responses");
  const auto told =
      test_support::run(STEP_RESPONSES_PROGRAM, "--no-pictures -o '" + directory.file("") + "'");
  ASSERT_EQ(told.exit_code, 0) << told.output;
  for (const char* field : {"allowed position", "allowed orientation"}) {
    const auto r = rows(told.output, field);
    EXPECT_LT(1.2 * r[0].rise, r[1].rise) << field;
    EXPECT_LT(1.2 * r[1].rise, r[2].rise) << field;
    EXPECT_LT(r[1].overshoot, 2.0) << field;
  }
  for (const char* field : {"allowed velocity", "allowed angular velocity"}) {
    const auto r = rows(told.output, field);
    EXPECT_GT(r[0].rise, 1.2 * r[1].rise) << field;
    EXPECT_GT(r[1].rise, 1.1 * r[2].rise) << field;
  }
  // With a lower limit of the force rate the vehicle leans more.
  const auto force_rate = rows(told.output, "limit of force rate");
  EXPECT_GT(force_rate[0].lean, force_rate[1].lean + 1.0);
  const auto turn = rows(told.output, "limit of angular velocity");
  EXPECT_GE(turn[0].rise, turn[1].rise);  // a turn of 60 degrees does not reach the limit
}

TEST(StepResponses, DrawsPictureOfAnotherVehicle) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  if (!test_support::full_run()) GTEST_SKIP() << "readme_commands draws one: --full";
  const test_support::Directory directory("step_responses");
  const auto told =
      test_support::run(STEP_RESPONSES_PROGRAM, "--vehicle " VEHICLES_DIR "/hexacopter.json -o '" +
                                                    directory.file("") + "'");
  EXPECT_EQ(told.exit_code, 0) << told.output;
  EXPECT_EQ(told.output.find("arning"), std::string::npos) << told.output;
  EXPECT_GT(test_support::read_file(directory.file("step_responses.png")).size(), 50000u);
}

TEST(StepResponses, HelpAndBadArguments) {
  EXPECT_EQ(test_support::run(STEP_RESPONSES_PROGRAM, "--help").exit_code, 0);
  EXPECT_GT(test_support::run(STEP_RESPONSES_PROGRAM, "--step 0").exit_code, 100);
  EXPECT_EQ(test_support::run(STEP_RESPONSES_PROGRAM, "--vehicle nowhere.json").exit_code, 2);
}

}  // namespace step_responses_test
