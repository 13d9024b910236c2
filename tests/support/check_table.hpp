#pragma once

#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <string>

/// Checks whose measured values tests/run.sh --full lists at its end. The script passes the file of
/// the table in TILT_ROPTER_CHECKS. Without this variable the checks are plain assertions.
namespace test_support {

inline void add_to_table(int check, const std::string& what, const std::string& asked,
                         double measured, bool kept) {
  const char* path = std::getenv("TILT_ROPTER_CHECKS");
  if (path == nullptr) return;
  // A single write of one line, which stays complete if tests run in parallel.
  std::ofstream(path, std::ios::app)
      << (std::to_string(check) + '\t' + what + '\t' + asked + '\t' +
          testing::PrintToString(measured) + '\t' + (kept ? "kept" : "BROKEN") + '\n')
      << std::flush;
}

/// `what` is the name of the measured value and its unit.
inline void check_at_most(int check, const std::string& what, double measured, double limit) {
  add_to_table(check, what, "<= " + testing::PrintToString(limit), measured, measured <= limit);
  EXPECT_LE(measured, limit) << "check " << check << ": " << what;
}

inline void check_at_least(int check, const std::string& what, double measured, double limit) {
  add_to_table(check, what, ">= " + testing::PrintToString(limit), measured, measured >= limit);
  EXPECT_GE(measured, limit) << "check " << check << ": " << what;
}

}  // namespace test_support
