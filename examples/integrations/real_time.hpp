#pragma once

#include <malloc.h>
#include <sched.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <time.h>

#include <cerrno>
#include <cstdint>
#include <cstring>
#include <ostream>

/// Linux functions for real-time loops.
namespace loops {

/// Returns the time of the monotonic clock [ns].
[[nodiscard]] inline std::int64_t now_ns() {
  timespec t{};
  clock_gettime(CLOCK_MONOTONIC, &t);
  return std::int64_t{t.tv_sec} * 1000000000 + t.tv_nsec;
}

/// Sleeps until now_ns() is `due`. It uses an absolute time, so errors do not accumulate. Returns
/// false if a signal interrupted the sleep.
inline bool sleep_until(std::int64_t due) {
  timespec t{};
  t.tv_sec = due / 1000000000;
  t.tv_nsec = due % 1000000000;
  return clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, nullptr) == 0;
}

/// Returns how often this program has waited for a memory page so far.
[[nodiscard]] inline std::int64_t page_faults() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return std::int64_t{usage.ru_minflt} + usage.ru_majflt;
}

/// Requests a fixed priority (SCHED_FIFO, 1 to 99; 0: no request), memory locked in RAM, and one
/// processor (negative: any). Prints the result to `out` and continues if a request is refused.
/// Call it after all memory of the loop is allocated.
inline void ask_for_real_time(int priority, int processor, std::ostream& out) {
  sched_param parameters{};
  parameters.sched_priority = priority;
  if (priority == 0)
    out << "scheduling: as any program, no priority asked for\n";
  else if (sched_setscheduler(0, SCHED_FIFO, &parameters) == 0)
    out << "scheduling: SCHED_FIFO, priority " << priority << '\n';
  else
    out << "scheduling: as any program, SCHED_FIFO refused: " << std::strerror(errno) << '\n';

  // Freed memory stays with the program, because a new request would cause page faults.
  mallopt(M_TRIM_THRESHOLD, -1);
  mallopt(M_MMAP_MAX, 0);
  if (mlockall(MCL_CURRENT | MCL_FUTURE) == 0)
    out << "memory: locked\n";
  else
    out << "memory: may be swapped out, mlockall refused: " << std::strerror(errno) << '\n';

  cpu_set_t processors;
  CPU_ZERO(&processors);
  if (processor >= 0) CPU_SET(static_cast<unsigned>(processor), &processors);
  if (processor < 0)
    out << "processor: any\n";
  else if (sched_setaffinity(0, sizeof processors, &processors) == 0)
    out << "processor: " << processor << '\n';
  else
    out << "processor: any, " << processor << " refused: " << std::strerror(errno) << '\n';
}

}  // namespace loops
