// The controller as a microcontroller may compile it: no NLopt, exceptions or RTTI, and a clock of
// its own. without_nlopt.sh compiles and runs it.

#include <chrono>

struct BoardClock {  // a microsecond later whenever it is read
  using rep = long long;
  using period = std::nano;
  using duration = std::chrono::nanoseconds;
  using time_point = std::chrono::time_point<BoardClock>;
  static constexpr bool is_steady = true;
  static inline long long readings = 0;
  static time_point now() noexcept { return time_point(duration(1000 * ++readings)); }
};
#define TILT_ROPTER_CLOCK BoardClock

#include <tilt_ropter/tilt_ropter.hpp>

#include <cstdio>

using namespace tilt_ropter;
using optimal_control::ProgramSolver;

#ifdef NLOPT_H
#error "nlopt.h was included"
#endif

int main() {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  NmpcSettings settings = nmpc_settings(vehicle);
  settings.problem.intervals = 10;
  Nmpc nmpc(vehicle, settings);
  ReferencePoint hover;
  hover.position << 0.0, 0.0, 1.5;
  BodyStated state;
  state.position << -1.0, 0.0, 1.5;  // a step that meets bounds
  bool good = true, bounded = false;
  for (int i = 0; i < 5; ++i) {
    const double time = 0.01 * i;
    (void)nmpc.prepare(time, [&](double) { return hover; }, {});
    const long long before = BoardClock::readings;
    const NmpcResult& result = nmpc.feedback(time, state);
    // Read at the start and the end of the last call of feedback(), and in between.
    const double read = static_cast<double>(BoardClock::readings - before);
    good = good && result.status == NmpcStatus::solved && result.report.rounds == 0 &&
           result.report.solved_by != ProgramSolver::nlopt && result.report.feedback_us >= 1.0 &&
           result.report.feedback_us < read;
    bounded = bounded || result.report.solved_by == ProgramSolver::active_set;
    state.velocity += 0.01 * result.wrench.force / vehicle.body.mass;
    state.velocity.z() -= 0.01 * gravity;
  }
  std::printf("solved %d, with active constraints %d\n", good, bounded);
  settings.solver.program.method = optimal_control::ProgramMethod::nlopt;
  if (!good || !bounded) return 1;
  Nmpc refused(vehicle, settings);  // prints why, and aborts: without_nlopt.sh reads the message
  return 2;
}
