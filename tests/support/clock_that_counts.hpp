#pragma once

#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <atomic>

/// A monotonic clock that advances by a microsecond whenever it is read. A limit on time is then a
/// limit on work, the same on every machine. Include it in one source file of a program only.
namespace test_support {

inline std::atomic<long>& readings_of_the_clock() {
  static std::atomic<long> count{0};
  return count;
}

/// Number of readings of the monotonic clock since the start of the program.
[[nodiscard]] inline long clock_readings() {
  return readings_of_the_clock();
}

}  // namespace test_support

/// Instead of the function of the C library, also for the standard library.
extern "C" int clock_gettime(clockid_t clock, timespec* now) noexcept {
  if (clock != CLOCK_MONOTONIC) return static_cast<int>(syscall(SYS_clock_gettime, clock, now));
  const long readings = ++test_support::readings_of_the_clock();
  now->tv_sec = readings / 1000000;
  now->tv_nsec = readings % 1000000 * 1000;
  return 0;
}
