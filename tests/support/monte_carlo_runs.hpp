#pragma once

#include "program.hpp"
#include "vehicle_files.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <sstream>
#include <string>
#include <vector>

/// Runs of monte_carlo, in one directory for each test program.
namespace test_support::monte_carlo {

inline const std::string program = MONTE_CARLO_PROGRAM;  // set by CMake

inline const Directory& scratch() {
  static const Directory directory("monte_carlo");
  return directory;
}

inline std::string file(const std::string& directory, const std::string& name = "monte_carlo.csv") {
  return scratch().file(directory + '/' + name);
}

/// The hexacopter has no wheels, so that its mission is short.
inline std::string of_hexacopter(const std::string& options) {
  return "--vehicle '" + shipped("hexacopter") + "' " + options;
}

inline Outcome fly(const std::string& directory, const std::string& options) {
  return run(program, options + " --no-pictures --output '" + scratch().file(directory) + "'");
}

/// Returns the printed figures, without progress and errors.
inline std::string figures(const Outcome& outcome) {
  const std::size_t from = outcome.output.find("vehicles: "), to = outcome.output.find("took ");
  EXPECT_LT(from, to) << outcome.output;
  return from < to ? outcome.output.substr(from, to - from) : "";
}

inline std::vector<std::string> lines_of(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream in(text);
  for (std::string line; std::getline(in, line);) lines.push_back(line);
  return lines;
}

}  // namespace test_support::monte_carlo
