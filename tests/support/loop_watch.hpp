#pragma once

#include "support/allocation_counter.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <sstream>
#include <string>

/// Checks which functions of the loop use the heap, and how much of it NLopt uses. Like
/// allocation_counter.hpp, include it in one source file of a program only.
namespace test_support {

/// Number of ticks before the heap is watched.
inline constexpr int warm_up = 5;

/// Largest number of allocations of one call of nlopt_optimize, from DualSolver's documentation.
inline constexpr long call_allocations = 2;

/// Largest number of bytes allocated by such a call with `rows` constraints.
constexpr long call_bytes(long rows) {
  return 256 * (rows + 1);
}

/// Returns the number of ticks of a test.
inline int ticks() {
  return quick_or_full(1000, 10000);
}

/// Calls functions of the loop and records which functions use the heap after the warm-up. NLopt's
/// heap use is not counted.
class LoopWatch {
 public:
  void next_tick() { ++tick_; }

  template <typename Call>
  decltype(auto) operator()(const char* function, const Call& call) {
    const Look look(*this, function);
    return call();
  }

  /// Number of functions that have used the heap.
  [[nodiscard]] double functions() const {
    return static_cast<double>(std::count_if(
        notes_.begin(), notes_.end(), [](const Note& note) { return note.function != nullptr; }));
  }

  /// One line per function that has used the heap.
  [[nodiscard]] std::string notes() const {
    std::ostringstream text;
    for (const Note& note : notes_)
      if (note.function != nullptr)
        text << note.function << ": " << note.use.allocations << " allocations (" << note.use.bytes
             << " bytes), " << note.use.releases << " releases, first in tick " << note.tick
             << "\n";
    return text.str();
  }

 private:
  struct Note {
    const char* function = nullptr;
    HeapUse use;
    int tick = 0;
  };

  class Look {
   public:
    Look(LoopWatch& watch, const char* function)
        : watch_(watch), function_(function), before_(heap_use(HeapUser::other)) {}
    ~Look() { watch_.note(function_, heap_use(HeapUser::other) - before_); }
    Look(const Look&) = delete;
    Look& operator=(const Look&) = delete;

   private:
    LoopWatch& watch_;
    const char* function_;
    HeapUse before_;
  };

  void note(const char* function, const HeapUse& use) {
    if (use.none() || tick_ <= warm_up) return;
    for (Note& note : notes_) {
      if (note.function == nullptr) note = {function, {}, tick_};
      if (note.function != function) continue;
      note.use = note.use + use;
      return;
    }
  }

  int tick_ = 0;
  std::array<Note, 30> notes_;
};

/// After each test no function called through `watch` may have used the heap.
class HeapInTheLoop : public testing::Test {
 protected:
  void SetUp() override {
    if (!heap_can_be_counted)
      GTEST_SKIP() << "a sanitizer or another C library has the heap: it cannot be counted";
    nlopt_calls = {};
  }
  void TearDown() override {
    EXPECT_EQ(watch.notes(), "");
    if (heap_can_be_counted)
      check_at_most(1, "functions of the loop that use the heap", watch.functions(), 0);
  }

  LoopWatch watch;
};

/// Expects that no call of NLopt has leaked, or used more of the heap than documented.
inline void expect_nlopt_within_documented_bounds() {
  EXPECT_EQ(nlopt_calls.sum.allocations, nlopt_calls.sum.releases);  // no leak
  for (std::size_t rows = 1; rows < nlopt_calls.largest.size(); ++rows) {
    const HeapUse& use = nlopt_calls.largest[rows];
    EXPECT_LE(use.allocations, call_allocations) << rows << " rows";
    EXPECT_LE(use.bytes, call_bytes(static_cast<long>(rows))) << rows << " rows";
  }
}

/// Largest number of NLopt calls and largest heap use of NLopt [bytes] in one tick.
struct NloptInTicks {
  template <typename Tick>
  void operator()(const Tick& tick) {
    const HeapUse before = heap_use(HeapUser::nlopt);
    const long calls_before = nlopt_calls.count;
    tick();
    calls = std::max(calls, nlopt_calls.count - calls_before);
    bytes = std::max(bytes, (heap_use(HeapUser::nlopt) - before).bytes);
  }
  long calls = 0, bytes = 0;
};

}  // namespace test_support
