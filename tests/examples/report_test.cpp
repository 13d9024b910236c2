// The page about a flight: what the programs write. That a browser draws it: report_page.sh.

#include "support/program.hpp"

#include "../../examples/support/report.hpp"

#include <gtest/gtest.h>

#include <filesystem>
#include <regex>
#include <sstream>
#include <string>
#include <vector>

namespace report_test {

using examples::ScriptFile;
using test_support::Directory;
using test_support::Outcome;
using test_support::read_file;

/// The mission as a user flies it, but without gnuplot, which takes longer than the flight.
Outcome fly(const Directory& directory, const std::string& arguments = "") {
  return test_support::run("env", "PATH=/nowhere '" HYBRID_MISSION_PROGRAM "' --output '" +
                                      directory.file("") + "' " + arguments);
}

bool has_page(const Directory& directory) {
  return std::filesystem::exists(directory.file("report.html"));
}

/// A log of `rows` rows, all numbers 1, and as many solve times as `times`.
void write_logs(const Directory& directory, int rows, int times) {
  std::string names = "time_s,phase,on_ground,power_w,orientation_w", row = "1,1,1,1,1";
  const auto add = [&](const std::string& name) {
    names += ',' + name;
    row += ",1";
  };
  for (const char* name : {"wall_force_n", "push_force_n"}) add(name);
  for (const char* axis : {"_x", "_y", "_z"})
    for (const char* name : {"position_m", "reference_m", "velocity_mps", "orientation",
                             "command_force_n", "estimated_force_n", "external_force_n"})
      add(std::string(name) + axis);
  for (const char* name : {"rotor_speed", "wrench", "pose", "load", "battery"})
    add(std::string("residual_") + name);
  for (const char* rotor : {"_1", "_2", "_3", "_4"})
    for (const char* name : {"tilt_true_rad", "rotor_speed_radps"}) add(std::string(name) + rotor);
  std::string log = names + '\n', solve_times = "time_s,prepare_us,feedback_us\n";
  for (int i = 0; i < rows; ++i) log += row + '\n';
  for (int i = 0; i < times; ++i) solve_times += "1,1,1\n";
  directory.write("hybrid_mission.csv", log);
  directory.write("solve_times.csv", solve_times);
}

/// What is said on standard error while the page of write_logs() is written.
std::string complaint(const Directory& directory, const std::vector<ScriptFile>& libraries,
                      const examples::VehicleFile& file = {}) {
  testing::internal::CaptureStderr();
  examples::write_report(directory.file(""), file, "air_rmse_m: 0.0022\n", libraries);
  return testing::internal::GetCapturedStderr();
}

TEST(Report, HoldsTheFlightAndLoadsNothing) {
  for (const ScriptFile& library : examples::report_libraries())
    if (!std::filesystem::exists(library.path))
      GTEST_SKIP() << "not installed: " << library.package;
  const Directory directory("report");
  const Outcome flown = fly(directory);
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  const std::string page = read_file(directory.file("report.html"));
  EXPECT_GT(page.size(), 2000000u);
  EXPECT_LT(page.size(), 5000000u);
  for (const auto& [key, value] : flown.figures) {
    if (key.find('_') == std::string::npos) continue;  // what the shell says of gnuplot
    EXPECT_NE(page.find('"' + key + ": " + value + '"'), std::string::npos) << key;
  }
  for (const char* phase : {"rest", "take_off", "hover", "air", "landing", "ground"})
    EXPECT_NE(page.find('"' + std::string(phase) + '"'), std::string::npos) << phase;
  EXPECT_NE(page.find("default-src 'none'"), std::string::npos);
  EXPECT_EQ(page.find("<!--flight"), std::string::npos);
  EXPECT_EQ(page.find("<!--libraries"), std::string::npos);
  const std::regex loads(
      "<(script|link|img|iframe|object|embed|base)[^>]* (src|href|data)=|@import");
  std::istringstream lines(page);
  for (std::string line; std::getline(lines, line);)  // an expression over all of it is too deep
    EXPECT_FALSE(line.size() < 100000 && std::regex_search(line, loads)) << line;
}

TEST(Report, IsNotWrittenWithoutPictures) {
  const Directory directory("report");
  ASSERT_EQ(fly(directory, "--no-pictures").exit_code, 0);
  EXPECT_FALSE(has_page(directory));
}

TEST(Report, SaysWhatIsMissingAndLeavesNoPageOfAnEarlierFlight) {
  const Directory directory("report");
  write_logs(directory, 3, 3);
  const std::vector<ScriptFile> library = {{directory.write("draw.js", "draw();"), "some-package"}};
  EXPECT_EQ(complaint(directory, library), "");
  EXPECT_TRUE(has_page(directory));
  EXPECT_EQ(complaint(directory, {{"/nowhere/draw.js", "some-package"}}),
            "no page about the flight: cannot read /nowhere/draw.js: install the Debian package "
            "some-package\n");
  EXPECT_FALSE(has_page(directory));
  write_logs(directory, 3, 2);
  EXPECT_NE(complaint(directory, library).find("solve_times.csv does not belong to"),
            std::string::npos);
  EXPECT_FALSE(has_page(directory));
}

TEST(Report, TakesAnyTextAndKeepsALongLogShort) {
  const Directory directory("report");
  write_logs(directory, 30002, 30002);
  examples::VehicleFile file;
  file.name = "</script><b>\xff";
  EXPECT_EQ(complaint(directory, {{directory.write("draw.js", "'</script><i>'"), ""}}, file), "");
  const std::string page = read_file(directory.file("report.html"));
  EXPECT_EQ(page.find("</script><b>"), std::string::npos);
  EXPECT_EQ(page.find("</script><i>"), std::string::npos);
  std::string every_third = R"("power_w":[1.0)";
  for (int i = 3; i < 30002; i += 3) every_third += ",1.0";
  EXPECT_NE(page.find(every_third + ']'), std::string::npos);
}

}  // namespace report_test
