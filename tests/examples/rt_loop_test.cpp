// Runs the program rt_loop as a user does. Only a full run judges times, as the other work of the
// machine changes them.
// CTest: real_time

#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/sanitizer.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <sstream>
#include <string>
#include <utility>

namespace rt_loop_test {

/// Sums of the two columns of the histogram that rt_loop prints.
std::pair<long, long> histogram_counts(const std::string& output) {
  std::istringstream lines(output.substr(output.find("below_us")));
  std::pair<long, long> sums;
  std::string line;
  std::getline(lines, line);
  while (std::getline(lines, line)) {
    std::istringstream fields(line);
    std::string bound;
    long first = 0, second = 0;
    if (!(fields >> bound >> first >> second)) break;
    sums.first += first;
    sums.second += second;
  }
  return sums;
}

TEST(RtLoop, CountsEveryTick) {
  const test_support::Directory directory("loops");
  const auto flown = test_support::run(
      RT_LOOP_PROGRAM, "--rate 200 --seconds 1.5 --csv '" + directory.file("times.csv") + "'");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_EQ(flown["ticks"] + flown["skipped_ticks"], 300.0);
  EXPECT_GE(flown["missed_deadlines"], flown["skipped_ticks"]);
  const auto counts = histogram_counts(flown.output);
  EXPECT_EQ(static_cast<double>(counts.first), flown["ticks"]);
  EXPECT_EQ(static_cast<double>(counts.second), flown["ticks"]);
  for (const std::string name : {"wake_up", "computing"}) {
    double last = 0.0;
    for (const char* figure : {"_min_us", "_median_us", "_p99_us", "_p99_9_us", "_max_us"}) {
      EXPECT_GE(flown[name + figure], last) << name << figure;
      last = flown[name + figure];
    }
  }
  if (test_support::full_run()) {
    EXPECT_GT(flown["computing_min_us"], 1.0);
  }
  const std::string csv = test_support::read_file(directory.file("times.csv"));
  EXPECT_EQ(csv.substr(0, csv.find('\n')), "wake_up_us,computing_us");
  EXPECT_EQ(static_cast<double>(std::count(csv.begin(), csv.end(), '\n')), flown["ticks"] + 1.0);
  if (flown.says("memory: locked") && flown["ticks"] > 10.0 &&
      !test_support::under_address_sanitizer()) {
    EXPECT_EQ(flown["page_faults_after_tick_10"], 0.0);
  }
}

// By leaning, and without wheels: this vehicle starts in the air.
TEST(RtLoop, HoversOtherVehicles) {
  for (const std::string name : {"tricopter", "octocopter"}) {
    const auto flown = test_support::run(
        RT_LOOP_PROGRAM,
        "--rate 50 --seconds 4 --priority 0 --vehicle '" VEHICLES_DIR "/" + name + ".json'");
    ASSERT_EQ(flown.exit_code, 0) << flown.output;
    EXPECT_EQ(flown["ticks"] + flown["skipped_ticks"], 200.0);
    if (test_support::full_run() || flown["missed_deadlines"] == 0.0) {
      EXPECT_LT(flown["position_error_m"], 0.02) << name;
    }
  }
}

TEST(RtLoop, HoversAndReportsRefusedRealTimeRequests) {
  const auto flown =
      test_support::run(RT_LOOP_PROGRAM, "--rate 50 --seconds 4 --priority 0 --processor 1023");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_TRUE(flown.says("scheduling: as any program, no priority asked for")) << flown.output;
  EXPECT_TRUE(flown.says("processor: any, 1023 refused: ")) << flown.output;
  EXPECT_EQ(flown["ticks"] + flown["skipped_ticks"], 200.0);
  // After a tick that is too late, the vehicle flies with an old command.
  if (test_support::full_run() || flown["missed_deadlines"] == 0.0) {
    EXPECT_LT(flown["position_error_m"], 0.02);
  }

  // Without the permissions, which root must drop.
  const std::string without = geteuid() == 0 ? "setpriv --bounding-set -sys_nice,-ipc_lock " : "";
  const auto asked = test_support::run("/bin/sh", "-c 'ulimit -l 64; ulimit -r 0; exec " + without +
                                                      RT_LOOP_PROGRAM " --seconds 0.1'");
  EXPECT_EQ(asked.exit_code, 0) << asked.output;
  EXPECT_TRUE(asked.says("SCHED_FIFO refused: Operation not permitted")) << asked.output;
  if (!test_support::under_address_sanitizer()) {
    EXPECT_TRUE(asked.says("mlockall refused: ")) << asked.output;
  }
  EXPECT_EQ(asked["ticks"] + asked["skipped_ticks"], 10.0);
}

TEST(RtLoop, HelpAndWrongOptions) {
  const auto help = test_support::run(RT_LOOP_PROGRAM, "--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_TRUE(help.says("--processor"));
  for (const char* wrong : {"--rate 0", "--rate x", "--seconds -1", "--priority 100",
                            "--processor -1", "--nonsense", "nonsense"})
    EXPECT_GT(test_support::run(RT_LOOP_PROGRAM, wrong).exit_code, 100) << wrong;
  const auto unwritable =
      test_support::run(RT_LOOP_PROGRAM, "--seconds 0.1 --csv /nonexistent/times.csv");
  EXPECT_EQ(unwritable.exit_code, 1);
  EXPECT_TRUE(unwritable.says("rt_loop: cannot write /nonexistent/times.csv"));
}

}  // namespace rt_loop_test
