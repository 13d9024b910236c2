// The whole loop on the emulated microcontroller: reads what the sensors give, answers with the
// command, until the flight is over. fly.cpp is the other end.

#include "board.hpp"

#define TILT_ROPTER_CLOCK board::Clock

#include "control_loop.hpp"

#include <memory>

using namespace microcontroller;

struct Counter {
  static std::uint64_t instructions() { return board::instructions(); }
};

int main() {
  const board::HostFile in("to_board", false), out("from_board", true);
  Setup setup;
  if (!in.read(&setup, sizeof setup)) return 1;
  const auto loop = std::make_unique<ControlLoop<Counter>>(setup);
  const std::size_t calls = board::heap_calls();
  Sensed sensed;
  while (in.read(&sensed, sizeof sensed) && sensed.time >= 0.0) {
    (void)board::instructions();  // keeps up with the counter
    const Answer answer = loop->update(sensed);
    if (!out.write(&answer, sizeof answer)) return 1;
  }
  Totals totals;
  totals.heap_bytes = static_cast<double>(board::heap_bytes());
  totals.objects_bytes = sizeof *loop;
  totals.heap_calls_in_flight = static_cast<double>(board::heap_calls() - calls);
  totals.stack_bytes = static_cast<double>(board::stack_bytes());
  return out.write(&totals, sizeof totals) ? 0 : 1;
}
