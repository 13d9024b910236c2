// Runs the program solve_instances as a user does.

#include "../../examples/support/instances.hpp"

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/instance_files.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace solve_instances_test {

namespace fs = std::filesystem;
using examples::Instance;
using examples::instance_columns;
using examples::instance_header;
using examples::InstanceBounds;
using examples::InstanceFile;
using examples::to_csv;
using test_support::at_rest;
using test_support::file_of;
using test_support::line_with;
using test_support::read;
using test_support::split;
using test_support::step_instance;

const std::string program = SOLVE_INSTANCES_PROGRAM;  // set by CMake

class SolveInstances : public testing::Test {
 protected:
  struct Run {
    int exit_code = -1;
    std::string out, err;
    std::vector<std::map<std::string, std::string>> rows;  // of out, by column

    [[nodiscard]] double number(std::size_t row, const std::string& column) const {
      return std::atof(rows.at(row).at(column).c_str());
    }
    /// The number after "name: " in err; NaN if there is none.
    [[nodiscard]] double summary(const std::string& name) const {
      const std::size_t at = ('\n' + err).find('\n' + name + ": ");
      return at == std::string::npos ? std::nan("") : std::atof(err.c_str() + at + name.size() + 2);
    }
  };

  void SetUp() override {
    directory_ = fs::path(testing::TempDir()) / ("solve_instances_" + std::to_string(getpid()));
    fs::create_directories(directory_);
  }
  void TearDown() override { fs::remove_all(directory_); }

  [[nodiscard]] std::string path(const std::string& name) const {
    return (directory_ / name).string();
  }
  void write(const std::string& name, const std::string& text) const {
    std::ofstream(path(name), std::ios::binary) << text;
  }
  [[nodiscard]] std::string text(const std::string& name) const {
    std::ostringstream text;
    text << std::ifstream(path(name), std::ios::binary).rdbuf();
    return text.str();
  }

  [[nodiscard]] Run run(const std::string& arguments) const {
    const std::string command = "cd '" + directory_.string() + "' && '" + program + "' " +
                                arguments + " >out.txt 2>err.txt";
    const int status = std::system(command.c_str());
    Run result;
    result.exit_code = WIFEXITED(status) ? WEXITSTATUS(status) : -1;
    result.out = text("out.txt");
    result.err = text("err.txt");
    result.rows = rows(result.out);
    return result;
  }

  static std::vector<std::map<std::string, std::string>> rows(const std::string& csv) {
    std::vector<std::map<std::string, std::string>> rows;
    std::istringstream in(csv);
    std::string line;
    std::getline(in, line);
    if (line.rfind("id,status,", 0) != 0) return rows;
    const std::vector<std::string> names = split(line);
    while (std::getline(in, line)) {
      const std::vector<std::string> fields = split(line);
      EXPECT_EQ(fields.size(), names.size()) << line;
      auto& row = rows.emplace_back();
      for (std::size_t i = 0; i < std::min(fields.size(), names.size()); ++i)
        row[names[i]] = fields[i];
    }
    return rows;
  }

  fs::path directory_;
};

TEST_F(SolveInstances, StepReachesItsKnownOptimum) {
  write("in.csv", file_of({to_csv(step_instance())}));
  const Run result = run("in.csv --repeat 3");
  ASSERT_EQ(result.exit_code, 0) << result.err;
  EXPECT_EQ(result.out.substr(0, result.out.find('\n')),
            "id,status,cost,u0_1,u0_2,u0_3,u0_4,u0_5,u0_6,iterations,kkt,max_violation,max_defect,"
            "median_us");
  ASSERT_EQ(result.rows.size(), 1u);
  EXPECT_EQ(result.rows[0].at("id"), "step");
  EXPECT_EQ(result.rows[0].at("status"), "converged");
  EXPECT_NEAR(result.number(0, "cost"), 2074.18, 1e-4 * 2074.18);
  EXPECT_LE(result.number(0, "kkt"), 1e-6);
  EXPECT_LE(result.number(0, "max_violation"), 1e-6);
  EXPECT_LE(result.number(0, "max_defect"), 1e-6);
  EXPECT_GT(result.number(0, "iterations"), 3);
  EXPECT_GT(result.number(0, "median_us"), 0.0);
  EXPECT_LE(std::abs(result.number(0, "u0_3")), 40.0 + 1e-6);
  EXPECT_GT(std::abs(result.number(0, "u0_3")), 1.0);
}

TEST_F(SolveInstances, EveryInstanceColumnAffectsTheCost) {
  // At rest on the reference the cost is zero; a change of any column makes it positive.
  std::vector<std::string> lines = {to_csv(at_rest("rest"))};
  for (std::size_t i = 2; i < instance_columns.size(); ++i) {
    std::vector<std::string> fields = split(lines[0]);
    const double value = std::atof(fields[i].c_str());
    // For a quaternion along its first component, w only scales it: change w and x together.
    const bool scale = instance_columns[i] == "q_w" || instance_columns[i] == "ref_q_w";
    if (scale) fields[i + 1] = "1";
    fields[0] = instance_columns[i];
    fields[i] = to_csv(scale ? 0.5 * value : value + 0.3);
    std::string line;
    for (const std::string& field : fields) line += (line.empty() ? "" : ",") + field;
    lines.push_back(line);
  }
  write("in.csv", file_of(lines));
  const Run result = run("in.csv");
  ASSERT_EQ(result.exit_code, 0) << result.err;
  ASSERT_EQ(result.rows.size(), lines.size());
  EXPECT_LT(result.number(0, "cost"), 1e-12);
  for (std::size_t i = 1; i < lines.size(); ++i)
    EXPECT_GT(result.number(i, "cost"), 1e-3) << result.rows[i].at("id");
}

TEST_F(SolveInstances, AppliesThePaperAndWideBounds) {
  Instance far = at_rest("wide");
  far.start.body.position << 2.0, 0.0, 0.0;
  Instance paper = far;
  paper.id = "paper";
  paper.bounds = InstanceBounds::paper;
  write("in.csv", file_of({to_csv(far), to_csv(paper)}));
  const Run result = run("in.csv");
  ASSERT_EQ(result.rows.size(), 2u) << result.err;
  EXPECT_NEAR(result.number(0, "u0_1"), -20.0, 1e-6);
  EXPECT_LE(std::abs(result.number(1, "u0_1")), 2.0 + 1e-6);
  EXPECT_NEAR(std::abs(result.number(1, "u0_5")), 2.0, 1e-6);
}

TEST_F(SolveInstances, ReportsMalformedLinesAndSolvesTheOthers) {
  write("in.csv", file_of({to_csv(at_rest("first")), line_with("Fe_y", "zero"), "two,fields",
                           to_csv(at_rest("last"))}));
  const Run result = run("in.csv");
  EXPECT_EQ(result.exit_code, 1);
  EXPECT_NE(result.err.find("in.csv:3:13: error: Fe_y = \"zero\" is not a number"),
            std::string::npos)
      << result.err;
  EXPECT_NE(result.err.find("in.csv:4:11: error: 2 fields, must be 37"), std::string::npos);
  ASSERT_EQ(result.rows.size(), 2u);
  EXPECT_EQ(result.rows[0].at("id"), "first");
  EXPECT_EQ(result.rows[1].at("id"), "last");
  EXPECT_EQ(result.rows[1].at("status"), "converged");
}

TEST_F(SolveInstances, ResultsDoNotDependOnEarlierInstances) {
  Instance impossible = at_rest("impossible");
  impossible.start.body.position.x() = 1e200;
  Instance hard = at_rest("hard");
  hard.start.body.angular_velocity << 5.0, 0.0, 0.0;
  hard.start.wrench.force << 9.0, 0.0, 14.7;
  const std::string step = to_csv(step_instance());
  write("in.csv", file_of({step, to_csv(hard), step, to_csv(impossible), step}));
  const Run result = run("in.csv");
  ASSERT_EQ(result.rows.size(), 5u) << result.err;
  EXPECT_EQ(result.exit_code, 0);
  EXPECT_EQ(result.rows[3].at("status"), "failed");
  std::map<std::string, std::string> first = result.rows[0];
  first.erase("median_us");
  for (const std::size_t again : {2u, 4u})
    for (const auto& [column, value] : first)
      EXPECT_EQ(result.rows[again].at(column), value) << column;
}

TEST_F(SolveInstances, ReportsUnavoidableViolation) {
  Instance beyond = at_rest("beyond");
  beyond.start.wrench.force.x() = 9.0;  // bound 6 N, rate 20 N/s: 7 N after 0.1 s
  write("in.csv", file_of({to_csv(beyond)}));
  const Run result = run("in.csv");
  ASSERT_EQ(result.rows.size(), 1u) << result.err;
  EXPECT_NEAR(result.number(0, "max_violation"), 1.0, 1e-3);
  EXPECT_LT(result.number(0, "max_defect"), 1e-6);
}

TEST_F(SolveInstances, OptionsTakeEffect) {
  write("in.csv", file_of({to_csv(step_instance())}));
  const Run exact = run("in.csv"), rough = run("in.csv --tolerance 10"),
            few = run("in.csv --max-iterations 2");
  ASSERT_EQ(rough.rows.size(), 1u) << rough.err;
  ASSERT_EQ(few.rows.size(), 1u) << few.err;
  EXPECT_LT(rough.number(0, "iterations"), exact.number(0, "iterations"));
  EXPECT_EQ(few.rows[0].at("status"), "iteration_limit");
  EXPECT_EQ(few.number(0, "iterations"), 2);
  // The recomputed defect shows that the iterate is not yet a feasible plan.
  EXPECT_GT(few.number(0, "max_defect"), 1e-3);
  const Run to_file = run("in.csv --output written.csv");
  EXPECT_EQ(to_file.exit_code, 0);
  EXPECT_TRUE(to_file.out.empty());
  EXPECT_EQ(rows(text("written.csv")).size(), 1u);
  const Run piped = run("- < in.csv");
  EXPECT_EQ(piped.rows.size(), 1u);
}

TEST_F(SolveInstances, GeneratedInstancesLieWithinDocumentedRanges) {
  ASSERT_EQ(run("--generate 300 --seed 7 -o seven.csv").exit_code, 0);
  const InstanceFile file = read(text("seven.csv"));
  ASSERT_TRUE(file.errors.empty());
  ASSERT_EQ(file.instances.size(), 300u);
  double farthest = 0.0, fastest = 0.0, widest = 0.0, spin = 0.0;
  for (const Instance& instance : file.instances) {
    const auto& body = instance.start.body;
    farthest = std::max(farthest, (body.position - instance.reference.position).norm());
    fastest = std::max(fastest, body.velocity.norm());
    widest = std::max(widest, body.orientation.angularDistance(instance.reference.orientation));
    spin = std::max(spin, body.angular_velocity.norm());
  }
  const auto near_below = [](double value, double limit) {
    return value <= limit * (1.0 + 1e-12) && value > 0.9 * limit;
  };
  EXPECT_TRUE(near_below(farthest, 2.0)) << farthest;
  EXPECT_TRUE(near_below(fastest, 2.0)) << fastest;
  EXPECT_TRUE(near_below(widest, 150.0 * tilt_ropter::pi / 180.0)) << widest;
  EXPECT_TRUE(near_below(spin, 3.0)) << spin;

  EXPECT_EQ(run("--generate 300 --seed 7").out, text("seven.csv"));
  EXPECT_NE(run("--generate 300 --seed 8").out, text("seven.csv"));
}

TEST_F(SolveInstances, RandomInstancesConvergeAndReportsMatchRecomputation) {
  const bool full = test_support::full_run();
  const int count = full ? 10000 : 300;
  ASSERT_EQ(run("--generate " + std::to_string(count) + " -o in.csv").exit_code, 0);
  const Run result = run("in.csv --histogram");
  EXPECT_EQ(result.exit_code, 0);
  ASSERT_EQ(result.rows.size(), static_cast<std::size_t>(count)) << result.err;
  int converged = 0;
  for (std::size_t i = 0; i < result.rows.size(); ++i) {
    const auto& row = result.rows[i];
    EXPECT_EQ(row.at("id"), std::to_string(i + 1));
    EXPECT_EQ(row.at("status") == "converged", result.number(i, "kkt") <= 1e-6) << row.at("id");
    if (row.at("status") != "converged") continue;
    ++converged;
    EXPECT_LE(result.number(i, "max_defect"), 1e-6) << row.at("id");
    EXPECT_LE(result.number(i, "max_violation"), 1e-6) << row.at("id");
  }
  test_support::check_at_least(6, "solver: fraction of wild instances that converge",
                               static_cast<double>(converged) / count, full ? 0.995 : 0.99);

  // The summary must agree. Report and recomputation differ by rounding of one step at most, since
  // the solver computes a step together with its derivative.
  EXPECT_EQ(result.summary("instances"), count);
  EXPECT_EQ(result.summary("converged"), converged);
  test_support::check_at_most(6, "solver: violation, report against recomputation",
                              result.summary("violation, report against recomputation"), 1e-12);
  test_support::check_at_most(6, "solver: defect, report against recomputation",
                              result.summary("defect, report against recomputation"), 1e-12);
  EXPECT_EQ(result.summary("worse than the guess"), 0.0) << result.err;
  std::istringstream lines(result.err);
  std::string line;
  std::getline(lines, line);
  EXPECT_EQ(line, "iterations  instances that converged");
  int iterations = 0, instances = 0, total = 0;
  for (; std::getline(lines, line) && line.find(':') == std::string::npos; total += instances) {
    std::istringstream(line) >> iterations >> instances;
    EXPECT_GT(instances, 0) << line;
  }
  EXPECT_EQ(total, converged) << result.err;
}

TEST_F(SolveInstances, CountsAndNamesPlansWorseThanTheInitialGuess) {
  // A first iteration may accept larger defects for a lower cost: their penalty is not known yet.
  ASSERT_EQ(run("--generate 100 -o in.csv").exit_code, 0);
  const Run first = run("in.csv --max-iterations 1");
  EXPECT_EQ(first.exit_code, 0);
  EXPECT_EQ(first.summary("converged"), 0.0);
  EXPECT_EQ(first.summary("iteration_limit"), 100.0);
  const double worse = first.summary("worse than the guess");
  EXPECT_GT(worse, 0.0) << first.err;
  EXPECT_LT(worse, 50.0) << first.err;
  const std::string names = first.err.substr(first.err.find("worse than the guess"));
  EXPECT_EQ(static_cast<double>(std::count(names.begin(), names.end(), '\n')), 1.0 + worse);
}

TEST_F(SolveInstances, ErrorsNameUnusableFiles) {
  write("in.csv", file_of({to_csv(at_rest("rest"))}));
  const Run missing = run("nowhere.csv");
  EXPECT_EQ(missing.exit_code, 2);
  EXPECT_NE(missing.err.find("cannot read nowhere.csv"), std::string::npos) << missing.err;
  EXPECT_EQ(run(".").exit_code, 2);
  const Run unwritable = run("in.csv --output nowhere/out.csv");
  EXPECT_EQ(unwritable.exit_code, 2);
  EXPECT_NE(unwritable.err.find("cannot write nowhere/out.csv"), std::string::npos);
  EXPECT_EQ(run("in.csv --output /dev/full").exit_code, 2);
  write("headless.csv", to_csv(at_rest("rest")) + '\n');
  const Run headless = run("headless.csv");
  EXPECT_EQ(headless.exit_code, 1);
  EXPECT_NE(headless.err.find("headless.csv:1:1: error: "), std::string::npos) << headless.err;
  EXPECT_TRUE(headless.rows.empty());
}

TEST_F(SolveInstances, HelpNamesEveryColumnAndBadOptionsAreRejected) {
  const Run help = run("--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_NE(help.out.find(instance_header()), std::string::npos);
  EXPECT_NE(help.out.find("id,status,cost,u0_1"), std::string::npos);
  for (const char* wrong : {"", "--repeat 0", "--tolerance -1", "--generate 0", "--no-such-option",
                            "in.csv --generate 3"})
    EXPECT_GT(run(wrong).exit_code, 100) << wrong;
}

}  // namespace solve_instances_test
