#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>

/// The board of the programs in this folder: a Cortex-M7 with double precision, QEMU's mps2-an500.
/// board.cpp has its start-up code. On another board, replace these functions.
namespace board {

/// Instructions since the start, in steps of 40. QEMU with `-icount shift=0` lets 1 ns pass for
/// each instruction, and SysTick counts 25 MHz of this time. Must be read every 0.6 s. On hardware,
/// take DWT->CYCCNT, which counts cycles.
[[nodiscard]] std::uint64_t instructions();

/// The solver's clock, by TILT_ROPTER_CLOCK: one nanosecond an instruction.
struct Clock {
  using rep = std::int64_t;
  using period = std::nano;
  using duration = std::chrono::nanoseconds;
  using time_point = std::chrono::time_point<Clock>;
  static constexpr bool is_steady = true;
  [[nodiscard]] static time_point now() noexcept {
    return time_point(duration(static_cast<rep>(instructions())));
  }
};

[[nodiscard]] std::size_t heap_bytes();   ///< taken from the region of the heap since the start
[[nodiscard]] std::size_t heap_calls();   ///< calls of malloc() since the start
[[nodiscard]] std::size_t stack_bytes();  ///< the deepest that the stack has been
void print(const char* name, long long value);  ///< a line `name: value` to the host's terminal
[[noreturn]] void end(int status);              ///< ends QEMU with this exit code

/// A file on the host, by semihosting: the emulated board has no other link.
class HostFile {
 public:
  HostFile(const char* name, bool write);
  /// Both wait for all bytes. They return false if the host has closed the file.
  [[nodiscard]] bool read(void* to, std::size_t bytes) const;
  [[nodiscard]] bool write(const void* from, std::size_t bytes) const;

 private:
  int handle_;
};

}  // namespace board
