#pragma once

#include <gtest/gtest.h>

#include <valgrind/callgrind.h>

#include <fstream>
#include <string>

/// Counts instructions, which other programs on the machine do not change, as they change times.
/// Tests that count are in a file with the word "counted" in its line "// CTest:": it runs under
/// callgrind.
namespace test_support {

/// Returns how many instructions call() takes. The first call of a function takes more than the
/// later ones, because the loader searches for it.
template <typename Call>
[[nodiscard]] double instructions(const Call& call) {
  static int dumps = 0;
  CALLGRIND_START_INSTRUMENTATION;
  CALLGRIND_ZERO_STATS;
  call();
  CALLGRIND_DUMP_STATS;
  CALLGRIND_STOP_INSTRUMENTATION;
  std::ifstream dump(std::string(CALLGRIND_FILE) + "." + std::to_string(++dumps));
  double count = 0.0;
  for (std::string word; dump >> word && word != "totals:";) continue;
  dump >> count;
  EXPECT_GT(count, 0.0) << "no callgrind?";
  return count;
}

}  // namespace test_support
