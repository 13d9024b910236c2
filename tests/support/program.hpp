#pragma once

#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <string>
#include <utility>

/// Runs the example programs as a user does.
namespace test_support {

/// Exit code and text on standard output and error of a run.
struct Outcome {
  int exit_code = -1;
  std::string output;
  std::map<std::string, std::string> figures;  // from lines "key: value"

  [[nodiscard]] double operator[](const std::string& key) const {
    const auto found = figures.find(key);
    EXPECT_NE(found, figures.end()) << key << " is missing in\n" << output;
    return found == figures.end() ? std::nan("") : std::atof(found->second.c_str());
  }
  [[nodiscard]] bool says(const std::string& text) const {
    return output.find(text) != std::string::npos;
  }
};

inline Outcome run(const std::string& program, const std::string& arguments) {
  Outcome result;
  FILE* pipe = popen(("'" + program + "' " + arguments + " 2>&1").c_str(), "r");
  if (pipe == nullptr) return result;
  char buffer[4096];
  while (std::fgets(buffer, sizeof buffer, pipe) != nullptr) {
    std::string line = buffer;
    result.output += line;
    line.erase(line.find_last_not_of('\n') + 1);
    const auto colon = line.find(": ");
    if (colon != std::string::npos) result.figures[line.substr(0, colon)] = line.substr(colon + 2);
  }
  const int status = pclose(pipe);
  result.exit_code = WIFEXITED(status) ? WEXITSTATUS(status) : -1;
  return result;
}

inline std::string read_file(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  std::ostringstream text;
  text << in.rdbuf();
  return text.str();
}

/// A temporary directory for this process, which the destructor removes.
class Directory {
 public:
  explicit Directory(const std::string& name)
      : path_(std::filesystem::path(testing::TempDir()) / (name + '_' + std::to_string(getpid()))) {
    std::filesystem::create_directories(path_);
  }
  ~Directory() { std::filesystem::remove_all(path_); }
  Directory(const Directory&) = delete;
  Directory& operator=(const Directory&) = delete;

  [[nodiscard]] std::string file(const std::string& name) const { return (path_ / name).string(); }
  std::string write(const std::string& name, const std::string& text) const {
    std::ofstream(file(name)) << text;
    return file(name);
  }

 private:
  std::filesystem::path path_;
};

/// For tests of a program that fits a model to a log, and that generates a log with --generate.
class FittingProgram : public testing::Test {
 protected:
  FittingProgram(const std::string& name, std::string path_of_program)
      : program(std::move(path_of_program)), directory_(name) {}

  [[nodiscard]] std::string path(const std::string& name) const { return directory_.file(name); }
  [[nodiscard]] std::string write(const std::string& name, const std::string& text) const {
    return directory_.write(name, text);
  }
  [[nodiscard]] std::string generate(const std::string& name, const std::string& options = "") {
    const Outcome made = run(program, "--generate '" + path(name) + "' " + options);
    EXPECT_EQ(made.exit_code, 0) << made.output;
    return path(name);
  }
  [[nodiscard]] Outcome fit(const std::string& log, const std::string& options = "") {
    return run(program, "'" + log + "' --no-pictures --output '" + path("out") + "' " + options);
  }
  [[nodiscard]] Outcome fit_text(const std::string& text) { return fit(write("text.csv", text)); }

  const std::string program;

 private:
  Directory directory_;
};

}  // namespace test_support
