// Start-up code of the emulated Cortex-M7, and the system calls of newlib: the heap, and texts to
// the host. All others fail.

#include "board.hpp"

#include <algorithm>
#include <cstring>

extern "C" {
// From mps2_an500.ld.
extern std::uint32_t data_source[], data_start[], data_end[], bss_start[], bss_end[];
extern char heap_start[], heap_end[], stack_start[], stack_end[];
extern void (*init_start[])();
extern void (*init_end[])();

int main();
void* __real_malloc(std::size_t bytes);
void* __wrap_malloc(std::size_t bytes);
void reset();
}

namespace {

constexpr std::uint32_t painted = 0xC0FFEE42;
std::size_t calls = 0;
char* heap = heap_start;

int semihost(int operation, const void* argument) {
  register int r0 asm("r0") = operation;
  register const void* r1 asm("r1") = argument;
  asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}
constexpr int sys_open = 0x01, sys_write0 = 0x04, sys_write = 0x05, sys_read = 0x06,
              sys_exit_extended = 0x20;

volatile std::uint32_t& device(std::uintptr_t address) {
  return *reinterpret_cast<volatile std::uint32_t*>(address);
}

void fault() {
  semihost(sys_write0, "fault\n");
  board::end(3);
}

// The first word is the stack's end. The others are reset, NMI and the faults.
[[gnu::section(".vectors"), gnu::used]] const void* const vectors[] = {
    stack_end,
    reinterpret_cast<const void*>(reset),
    reinterpret_cast<const void*>(fault),
    reinterpret_cast<const void*>(fault),
    reinterpret_cast<const void*>(fault),
    reinterpret_cast<const void*>(fault),
    reinterpret_cast<const void*>(fault),
};

}  // namespace

extern "C" void reset() {
  device(0xE000ED88) |= 0xFu << 20;  // CPACR: the floating-point unit is on
  asm volatile("dsb\n isb");
  std::copy_n(data_source, data_end - data_start, data_start);
  std::fill(bss_start, bss_end, 0u);
  // The stack is painted below this function's frame; what is still painted at the end is unused.
  const auto here = reinterpret_cast<std::uintptr_t>(__builtin_frame_address(0)) - 256;
  std::fill(reinterpret_cast<std::uint32_t*>(stack_start), reinterpret_cast<std::uint32_t*>(here),
            painted);
  device(0xE000E014) = 0xFFFFFF;  // SysTick: the longest period, of the processor's clock
  device(0xE000E018) = 0;
  device(0xE000E010) = 5;
  for (auto* init = init_start; init != init_end; ++init) (*init)();
  board::end(main());
}

namespace board {

std::uint64_t instructions() {
  static std::uint64_t ticks = 0;
  static std::uint32_t last = 0xFFFFFF;
  const std::uint32_t now = device(0xE000E018);  // counts down
  ticks += (last - now) & 0xFFFFFF;
  last = now;
  return 40 * ticks;
}

std::size_t heap_bytes() {
  return static_cast<std::size_t>(heap - heap_start);
}
std::size_t heap_calls() {
  return calls;
}
std::size_t stack_bytes() {
  const char* unused = stack_start;
  for (std::uint32_t word = painted; word == painted; unused += sizeof word)
    std::memcpy(&word, unused, sizeof word);
  return static_cast<std::size_t>(stack_end - unused) + sizeof painted;
}

void print(const char* name, long long value) {
  char text[24];
  char* first = text + sizeof text;
  *--first = '\0';
  *--first = '\n';
  const bool negative = value < 0;
  for (long long rest = negative ? -value : value; rest > 0 || *first == '\n'; rest /= 10)
    *--first = static_cast<char>('0' + rest % 10);
  if (negative) *--first = '-';
  semihost(sys_write0, name);
  semihost(sys_write0, ": ");
  semihost(sys_write0, first);
}

void end(int status) {
  const int block[] = {0x20026, status};  // the application ended
  semihost(sys_exit_extended, block);
  for (;;) {
  }
}

HostFile::HostFile(const char* name, bool write) {
  const std::uintptr_t block[] = {reinterpret_cast<std::uintptr_t>(name), write ? 5u : 1u,
                                  std::strlen(name)};  // as "wb" and "rb" of fopen()
  handle_ = semihost(sys_open, block);
}

bool HostFile::read(void* to, std::size_t bytes) const {
  char* next = static_cast<char*>(to);
  while (bytes > 0) {
    const std::uintptr_t block[] = {static_cast<std::uintptr_t>(handle_),
                                    reinterpret_cast<std::uintptr_t>(next), bytes};
    const auto missing = static_cast<std::size_t>(semihost(sys_read, block));
    if (handle_ < 0 || missing >= bytes) return false;
    next += bytes - missing;
    bytes = missing;
  }
  return true;
}

bool HostFile::write(const void* from, std::size_t bytes) const {
  const std::uintptr_t block[] = {static_cast<std::uintptr_t>(handle_),
                                  reinterpret_cast<std::uintptr_t>(from), bytes};
  return handle_ >= 0 && semihost(sys_write, block) == 0;
}

}  // namespace board

extern "C" {
void* __wrap_malloc(std::size_t bytes) {
  ++calls;
  return __real_malloc(bytes);
}
void* _sbrk(std::ptrdiff_t bytes) {
  char* const old = heap;
  if (heap_end - heap < bytes) return reinterpret_cast<void*>(-1);
  heap += bytes;
  return old;
}
int _write(int /*file*/, const char* text, int length) {
  for (int i = 0; i < length; ++i) {
    const char letter[] = {text[i], '\0'};
    semihost(sys_write0, letter);
  }
  return length;
}
int _read(int /*file*/, char* /*to*/, int /*length*/) {
  return 0;
}
int _close(int /*file*/) {
  return -1;
}
int _lseek(int /*file*/, int /*offset*/, int /*from*/) {
  return -1;
}
int _fstat(int /*file*/, void* /*status*/) {
  return -1;
}
int _isatty(int /*file*/) {
  return 1;
}
int _getpid() {
  return 1;
}
int _kill(int /*process*/, int /*signal*/) {
  board::end(4);
}
void _exit(int status) {
  board::end(status);
}
}
