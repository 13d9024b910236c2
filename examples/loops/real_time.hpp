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

/// What Linux has for loops that must not be late.
namespace loops {

/// Of the clock that nobody sets [ns].
[[nodiscard]] inline std::int64_t now_ns() {
  timespec t{};
  clock_gettime(CLOCK_MONOTONIC, &t);
  return std::int64_t{t.tv_sec} * 1000000000 + t.tv_nsec;
}

/// Sleeps until now_ns() is `due`: to a time, not for a time, so that no error adds up. False if a
/// signal came first.
inline bool sleep_until(std::int64_t due) {
  timespec t{};
  t.tv_sec = due / 1000000000;
  t.tv_nsec = due % 1000000000;
  return clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, nullptr) == 0;
}

/// How often this program had to wait for a page of memory so far.
[[nodiscard]] inline std::int64_t page_faults() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return std::int64_t{usage.ru_minflt} + usage.ru_majflt;
}

/// Asks for a fixed priority (SCHED_FIFO, 1 to 99; 0: does not ask), for memory that stays in RAM,
/// and for one processor (negative: any). Says what it got and goes on without the rest. Call it
/// when all memory of the loop has been taken.
inline void ask_for_real_time(int priority, int processor, std::ostream& out) {
  sched_param parameters{};
  parameters.sched_priority = priority;
  if (priority == 0)
    out << "scheduling: as any program, no priority asked for\n";
  else if (sched_setscheduler(0, SCHED_FIFO, &parameters) == 0)
    out << "scheduling: SCHED_FIFO, priority " << priority << '\n';
  else
    out << "scheduling: as any program, SCHED_FIFO refused: " << std::strerror(errno) << '\n';

  // What is freed stays with the program: asking for it again would cost page faults.
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
