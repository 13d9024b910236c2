// Runs of monte_carlo that are interrupted, continued, spread over jobs and merged: no vehicle is
// lost or flown twice, and the result is that of one run to the bit. With any vehicle.
// CTest: flight one_process

#include "support/full_run.hpp"
#include "support/monte_carlo_runs.hpp"
#include "support/program.hpp"
#include "support/vehicle_files.hpp"
#include "support/wait_until.hpp"

#include <gtest/gtest.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <cstddef>
#include <filesystem>
#include <sstream>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace monte_carlo_parts_test {

namespace fs = std::filesystem;
using namespace test_support::monte_carlo;
using test_support::Outcome;
using test_support::read_file;
using test_support::shipped;
using test_support::with;

constexpr int vehicles = 5;

/// One run with all vehicles.
const Outcome& whole() {
  static const Outcome result =
      fly("whole", of_hexacopter("--threads 2 --count " + std::to_string(vehicles)));
  return result;
}

/// Makes a part with vehicles `first` to first + count - 1, of which the rows `rows` are there,
/// from the whole run.
std::string make_part(const std::string& directory, int first, int count,
                      const std::vector<int>& rows) {
  EXPECT_EQ(whole().exit_code, 0) << whole().output;
  fs::create_directories(scratch().file(directory));
  const std::vector<std::string> lines = lines_of(read_file(file("whole")));
  std::string text = lines.at(0) + '\n';
  for (const int row : rows) text += lines.at(static_cast<std::size_t>(row) + 1) + '\n';
  std::string asked = read_file(file("whole", "monte_carlo.run"));
  asked = with(asked, "first: 0", "first: " + std::to_string(first));
  asked = with(asked, "count: " + std::to_string(vehicles), "count: " + std::to_string(count));
  scratch().write(directory + "/monte_carlo.run", asked);
  return scratch().write(directory + "/monte_carlo.csv", text);
}

void expect_as_whole(const std::string& directory) {
  EXPECT_EQ(read_file(file(directory)), read_file(file("whole"))) << directory;
  EXPECT_EQ(read_file(file(directory, "monte_carlo.run")),
            read_file(file("whole", "monte_carlo.run")));
}

/// Starts monte_carlo and waits until its table has this number of rows.
pid_t start(const std::string& directory, const std::string& count, std::ptrdiff_t rows) {
  const std::string vehicle = shipped("hexacopter"), output = scratch().file(directory);
  const pid_t child = fork();
  if (child == 0) {
    execl(program.c_str(), program.c_str(), "--vehicle", vehicle.c_str(), "--count", count.c_str(),
          "--threads", "1", "--no-pictures", "--output", output.c_str(), nullptr);
    _exit(127);
  }
  EXPECT_TRUE(test_support::wait_until([&] {
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
    const std::string text = read_file(file(directory));
    return std::count(text.begin(), text.end(), '\n') > rows;
  }));
  return child;
}

void end(pid_t child) {
  kill(child, SIGKILL);
  waitpid(child, nullptr, 0);
}

TEST(MonteCarloParts, KilledRunIsContinuedToTheSameTable) {
  ASSERT_EQ(whole().exit_code, 0) << whole().output;
  end(start("killed", std::to_string(vehicles), 2));
  const auto there = lines_of(read_file(file("killed"))).size() - 1;
  ASSERT_GE(there, 2u);
  fs::resize_file(file("killed"), fs::file_size(file("killed")) - 20);  // within the last row
  const std::string options =
      of_hexacopter("--resume --threads 2 --count " + std::to_string(vehicles));
  const Outcome resumed = fly("killed", options);
  EXPECT_EQ(resumed.exit_code, 0) << resumed.output;
  EXPECT_TRUE(resumed.says("monte_carlo.csv:" + std::to_string(there + 1) +
                           ": the last line is cut off; its vehicle is flown again"))
      << resumed.output;
  EXPECT_TRUE(resumed.says(std::to_string(there - 1) + " of 5 vehicles are in")) << resumed.output;
  expect_as_whole("killed");
  const Outcome again = fly("killed", options);
  EXPECT_EQ(figures(again), figures(whole()));  // nothing to fly
  expect_as_whole("killed");
}

TEST(MonteCarloParts, TableBelongsToOneProcess) {
  const pid_t child = start("shared", "1000", 0);
  const Outcome second = fly("shared", of_hexacopter("--resume --count 1000"));
  const Outcome third = fly("shared", of_hexacopter("--count 1"));
  end(child);
  for (const Outcome& refused : {second, third}) {
    EXPECT_EQ(refused.exit_code, 1);
    EXPECT_TRUE(refused.says("monte_carlo.csv: another process is writing it")) << refused.output;
  }
}

TEST(MonteCarloParts, MergedPartsAreTheWholeRun) {
  make_part("parts/later", 2, 3, {4, 2, 3});  // unsorted, as while it is flown
  make_part("parts/earlier", 0, 2, {0, 1});
  const Outcome merged = fly("merged", "--merge '" + scratch().file("parts") + "'");
  EXPECT_EQ(merged.exit_code, 0);
  EXPECT_EQ(figures(merged), figures(whole()));
  expect_as_whole("merged");
}

TEST(MonteCarloParts, MergeNamesMissingVehiclesAndResumeFliesThem) {
  const std::string earlier = make_part("gaps/earlier", 0, 2, {0, 1});
  make_part("gaps/later", 3, 2, {3, 4});
  fs::resize_file(file("gaps/later"), fs::file_size(file("gaps/later")) - 1);  // the end of line
  const Outcome merged = fly("filled", "--count 5 --merge '" + scratch().file("gaps") + "'");
  EXPECT_EQ(merged.exit_code, 3) << merged.output;
  EXPECT_TRUE(merged.says("vehicles: 3\n")) << merged.output;
  EXPECT_TRUE(merged.says("gaps/later/monte_carlo.csv:3: the last line is cut off"))
      << merged.output;
  EXPECT_TRUE(merged.says("missing vehicles: 2 of 5\n    2 to 2\n    4 to 4\n")) << merged.output;
  const Outcome filled = fly("filled", of_hexacopter("--resume --count 5"));
  EXPECT_EQ(filled.exit_code, 0);
  EXPECT_EQ(figures(filled), figures(whole()));
  expect_as_whole("filled");

  const Outcome shorter = fly("shorter", "--merge '" + earlier + "'");
  EXPECT_EQ(shorter.exit_code, 0) << shorter.output;  // all that this file was asked for
  EXPECT_EQ(fly("longer", "--count 3 --merge '" + earlier + "'").exit_code, 3);
}

TEST(MonteCarloParts, OtherRunsAreRefusedByNameAndReason) {
  const std::string part = make_part("ours", 0, 2, {0, 1});
  const std::string asked = read_file(file("ours", "monte_carlo.run"));
  const auto refused = [&](const std::string& find, const std::string& replace,
                           const std::string& why) {
    make_part("other", 2, 3, {2, 3, 4});
    scratch().write("other/monte_carlo.run",
                    with(read_file(file("other", "monte_carlo.run")), find, replace));
    const Outcome merged = fly("refused", "--merge '" + part + "' '" + file("other") + "'");
    EXPECT_EQ(merged.exit_code, 1) << merged.output;
    EXPECT_TRUE(merged.says("other/monte_carlo")) << merged.output;
    EXPECT_TRUE(merged.says(why)) << merged.output;
    EXPECT_FALSE(fs::exists(file("refused")));
  };
  refused("seed: 1", "seed: 2", "seed is 2, but 1 in");
  refused("version: 0.", "version: 9.", "version is 9.");
  refused("build: ", "build: another ", "build is another");
  refused("vehicle_contents: ", "vehicle_contents: 0", "vehicle_contents is 0");
  refused("level: ", "level: actuator", "level is actuator, but none in");
  refused("seed: 1\n", "", "no line seed");
  refused("count: 3", "count: -3", "count = '-3': must be a whole number");
  refused("level: \n", "level: \nlevel: wrench\n", "level is wrench");

  const auto not_resumed = [&](const std::string& options, const std::string& why) {
    const std::string before = read_file(part);
    const Outcome resumed = fly("ours", options + " --resume --count 2");
    EXPECT_EQ(resumed.exit_code, 1) << resumed.output;
    EXPECT_TRUE(resumed.says("ours/monte_carlo")) << resumed.output;
    EXPECT_TRUE(resumed.says(why)) << resumed.output;
    EXPECT_EQ(read_file(part), before);
    EXPECT_EQ(read_file(file("ours", "monte_carlo.run")), asked);
  };
  not_resumed(of_hexacopter("--seed 2"), "seed is 1, but 2 in this run");
  not_resumed("", "the vehicles are '" + shipped("hexacopter") + "' and ''");
  not_resumed(of_hexacopter("--first 1"), "vehicle 0 of seed 1 is not in this run");
  EXPECT_TRUE(fly("refused", "--seed 2 --merge '" + part + "'").says("but 2 in the options"));
  EXPECT_TRUE(fly("refused", "--first 1 --merge '" + part + "'").says("vehicle 0 is in the files"));
  EXPECT_TRUE(fly("refused", "--merge /nowhere.csv").says("cannot read /nowhere.run"));
  EXPECT_TRUE(
      fly("refused", "--merge '" + fs::path(VEHICLES_DIR).string() + "'").says("no monte_"));

  // A damaged last line is flown again, any other is an error.
  const std::string good = read_file(part);
  const auto lines = lines_of(good);
  scratch().write("ours/monte_carlo.csv", lines[0] + "\n1,0,x\n" + lines[2] + '\n');
  EXPECT_TRUE(fly("ours", of_hexacopter("--resume --count 2")).says("monte_carlo.csv:2: 3 fields"));
  scratch().write("ours/monte_carlo.csv", good + lines[2] + '\n');
  EXPECT_TRUE(
      fly("ours", of_hexacopter("--resume --count 2")).says("monte_carlo.csv:4: vehicle 1"));
  scratch().write("ours/monte_carlo.csv", good + std::string(50, '\0') + '\n');
  const Outcome resumed = fly("ours", of_hexacopter("--resume --count 2"));
  EXPECT_EQ(resumed.exit_code, 0) << resumed.output;
  EXPECT_TRUE(resumed.says("monte_carlo.csv:4: 1 fields")) << resumed.output;
  EXPECT_EQ(read_file(part), good);
  fs::remove(file("ours", "monte_carlo.run"));
  EXPECT_TRUE(fly("ours", of_hexacopter("--resume --count 2")).says("ours/monte_carlo.run"));
}

/// Runs the printed command that repeats the worst vehicle, and compares each number with its row.
void expect_same_replay(const std::string& directory, const Outcome& flown) {
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  std::string command;
  for (const std::string& line : lines_of(flown.output))
    if (command.empty() && line.find(" --replay ") != std::string::npos) command = line;
  ASSERT_FALSE(command.empty()) << flown.output;
  const std::string index = command.substr(command.rfind(' ') + 1);
  const std::string output = scratch().file(directory + "_replayed");
  // run() quotes the program, the printed command quotes itself.
  const Outcome again =
      test_support::run("env", "bash -c \"" + command + " --no-pictures -o '" + output + "'\"");
  EXPECT_EQ(again.exit_code, 0) << again.output;
  const std::vector<std::string> lines = lines_of(read_file(file(directory)));
  std::istringstream names(lines.at(0));
  std::string row;
  for (const std::string& line : lines)
    if (line.rfind("1," + index + ',', 0) == 0) row = line;
  std::istringstream values(row);
  for (std::string name, value; std::getline(names, name, ',');) {
    ASSERT_TRUE(std::getline(values, value, ','));
    EXPECT_TRUE(again.says('\n' + name + ": " + value + '\n')) << command << '\n' << name;
  }
  EXPECT_GT(fs::file_size(output + "/hybrid_mission.csv"), 100000u);
}

TEST(MonteCarloParts, PrintedCommandRepeatsAnyVehicleToTheBit) {
  const bool full = test_support::full_run();
  for (const std::string name :
       {"bicopter", "coaxial_octocopter", "hexacopter", "octocopter", "quadrotor", "tricopter",
        "five_kilograms", "quadrotor_with_pusher", "hexacopter_with_pusher"})
    if (full || name == "bicopter" || name == "octocopter") {
      const int count = full ? 2 : 1;
      const Outcome flown =
          fly(name, "--vehicle '" + shipped(name) + "' --count " + std::to_string(count));
      expect_same_replay(name, flown);
    }
  // All options are in the command, and a path that a shell would split.
  fs::create_directories(scratch().file("my vehicles"));
  const std::string vehicle =
      scratch().write("my vehicles/it's mine.json", read_file(shipped("hexacopter")));
  const Outcome flown =
      fly("actuator", "--level actuator --first 7 --count 1 --vehicle \"" + vehicle + '"');
  EXPECT_TRUE(flown.says(" --level actuator --vehicle ")) << flown.output;
  expect_same_replay("actuator", flown);
}

TEST(MonteCarloParts, EverySettingOfTheVehicleFileChangesTheFlight) {
  const std::string base = read_file(shipped("hexacopter"));
  const auto row = [&](const std::string& name, const std::string& text) {
    const std::string vehicle = scratch().write(name + ".json", text);
    const Outcome flown = fly(name, "--count 1 --vehicle '" + vehicle + "'");
    EXPECT_EQ(flown.exit_code, 0) << name << flown.output;
    const auto lines = lines_of(read_file(file(name)));
    return lines.size() == 2 ? lines[1] : std::string();
  };
  const std::string unchanged = row("unchanged", base);
  const std::string last = "\"battery_wh\": 178";
  std::vector<std::pair<std::string, std::string>> changed = {
      {"products",
       with(base, "[0.08, 0.08, 0.15]", "[[0.08, 0.005, 0], [0.005, 0.08, 0], [0, 0, 0.15]]")},
      {"servo_power",
       with(base, "\"hover_w\": 750", "\"hover_w\": 750, \"servo_move_j_per_rad\": 0.3")},
      {"battery", with(base, last,
                       "\"battery_nominal_v\": 22, \"battery_capacity_ah\": 1, "
                       "\"battery_full_v\": 16, \"battery_empty_v\": 13, "
                       "\"battery_resistance_ohm\": 0.05")},
      {"errors",
       with(base, last, last + ", \"allowed_errors\": {\"position_m\": [0.3, 0.3, 0.3]}")},
      {"limits", with(base, last, last + ", \"limits\": {\"force_rate_nps\": [2, 2, 4]}")}};
  if (test_support::full_run()) {
    changed.emplace_back("idle", with(base, "\"min_thrust_n\": 0.2", "\"min_thrust_n\": 6"));
    changed.emplace_back("dead_time", with(base, "\"dead_time_s\": 0.01", "\"dead_time_s\": 0.03"));
    changed.emplace_back("legs", with(base, last,
                                      last + ", \"legs\": {\"height_m\": 0.2, "
                                             "\"half_length_m\": 0.2, \"half_width_m\": 0.2}"));
  }
  for (const auto& [name, text] : changed) EXPECT_NE(row(name, text), unchanged) << name;
}

}  // namespace monte_carlo_parts_test
