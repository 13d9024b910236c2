// Scripts that spread a run of monte_carlo over jobs, with GNU parallel or Slurm: a job that is
// killed is continued, and the result is that of one run to the bit.
// CTest: flight

#include "support/full_run.hpp"
#include "support/monte_carlo_runs.hpp"
#include "support/program.hpp"
#include "support/vehicle_files.hpp"
#include "support/wait_until.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace monte_carlo_jobs_test {

using namespace test_support::monte_carlo;
using test_support::Outcome;
using test_support::read_file;
using test_support::with;

const std::string scripts = std::string(MISSIONS_DIR) + "/cluster/";

TEST(MonteCarloParts, ScriptsSayWhatIsWrong) {
  for (const std::string script : {"parallel.sh", "slurm.sh"}) {
    const auto told = [&](const std::string& options) {
      return test_support::run(scripts + script, options);
    };
    const Outcome help = told("--help");
    EXPECT_EQ(help.exit_code, 0);
    for (const char* option : {"--jobs", "--chunk", "--program", "--count", "--first", "--output"})
      EXPECT_TRUE(help.says(option)) << option;
    for (const auto& [options, why] : std::vector<std::pair<std::string, std::string>>{
             {"--count 0", "--count 0: must be a whole number, 1 or more"},
             {"--chunk x", "--chunk x: must be a whole number"},
             {"--seed", "--seed: needs a value"},
             {"--threads 3", "--threads: not here"},
             {"results", "results: "},
             {"--program /nowhere", "--program /nowhere: no such program"}}) {
      const Outcome refused = told(options);
      EXPECT_EQ(refused.exit_code, 2) << refused.output;
      EXPECT_TRUE(refused.says(why)) << refused.output;
    }
  }
}

bool works(const std::string& command) {
  return std::system((command + " > /dev/null 2>&1").c_str()) == 0;
}

/// Runs the command of the README with this script, with fewer vehicles.
void expect_readme_command(const std::string& script) {
  std::string command;
  for (const std::string& line : lines_of(read_file(MISSIONS_DIR "/README.md")))
    if (line.rfind("    examples/missions/cluster/" + script, 0) == 0) command = line;
  command = with(command, "--count 1000", "--count 4");
  command = with(command, "results/thousand", "'" + scratch().file("readme_" + script) + "'");
  const Outcome told = test_support::run("env", "-C '" MISSIONS_DIR "/../..' bash -c \"" + command +
                                                    " --program '" + program + "' --no-pictures\"");
  EXPECT_EQ(told.exit_code, 0) << told.output;
}

/// Flies with a script of which a job is killed, then again, and compares with one process.
void expect_script_continues(const std::string& name, const std::string& kill_one) {
  const std::string count = "60";
  const Outcome one = fly("one", of_hexacopter("--count " + count));
  ASSERT_EQ(one.exit_code, 0);
  const std::string output = scratch().file(name);
  const std::string options = of_hexacopter("--count " + count + " --chunk 25 --no-pictures -o '" +
                                            output + "' --program '" + program + "' ");
  const auto run_script = [&] {
    return test_support::run(scripts + name + ".sh",
                             options + (name == "slurm" ? "--wait" : "") + " 2> /dev/null");
  };
  Outcome interrupted;
  std::thread script([&] { interrupted = run_script(); });
  const std::string part = output + "/parts/25/monte_carlo.csv";
  EXPECT_TRUE(test_support::wait_until([&] {
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
    const std::string text = read_file(part);
    return std::count(text.begin(), text.end(), '\n') > 10;
  }));
  EXPECT_TRUE(works(kill_one));
  script.join();
  EXPECT_EQ(interrupted.exit_code, 3) << interrupted.output;
  const Outcome resumed = run_script();
  EXPECT_EQ(resumed.exit_code, 0) << resumed.output;
  EXPECT_TRUE(resumed.says(figures(one))) << resumed.output;
  for (const char* table : {"monte_carlo.csv", "monte_carlo.run"})
    EXPECT_EQ(read_file(output + '/' + table), read_file(file("one", table)));
}

TEST(MonteCarloParts, GnuParallelIsInterruptedAndContinued) {
  if (!test_support::full_run()) GTEST_SKIP() << "takes a minute: --full";
  if (!works("parallel --version | grep '^GNU parallel'")) GTEST_SKIP() << "needs GNU parallel";
  expect_script_continues("parallel", "pkill -KILL -f -- '^[^ ]*monte_carlo .*--first 25 .*" +
                                          scratch().file("parallel") + "/parts/25'");
  expect_readme_command("parallel.sh");
}

TEST(MonteCarloParts, SlurmArrayIsInterruptedAndContinued) {
  if (!test_support::full_run()) GTEST_SKIP() << "takes a minute: --full";
  if (!works("sinfo --noheader --states=idle,mixed | grep .")) GTEST_SKIP() << "needs Slurm nodes";
  expect_script_continues("slurm",
                          "scancel --signal=KILL --batch $(squeue --me --noheader --array "
                          "--format '%i' --name monte_carlo | grep '_1$')");
}

}  // namespace monte_carlo_jobs_test
