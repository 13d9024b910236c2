// Servo: step response of a first-order lag with dead time, rate limit and range.

#include <tilt_ropter/actuation/servo.hpp>

#include <cmath>
#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: servo    prints two step responses; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  ServoParameters small;
  small.time_constant = 0.08;             // [s]
  small.dead_time = 0.02;                 // [s]
  small.max_rate = 8.0;                   // [rad/s]
  for (const double step : {0.3, 1.5}) {  // [rad]: the second step meets the rate limit
    Servod servo(small);
    std::printf("step of %.1f rad\n", step);
    for (int tick = 0; tick <= 6; ++tick) {
      const double time = 0.05 * tick;
      // The command acts from now on. Time comes from your clock: calls need not be periodic.
      const double angle = servo.update(time, step);
      const double late = time - small.dead_time;
      const double lag = late > 0.0 ? step * (1.0 - std::exp(-late / small.time_constant)) : 0.0;
      std::printf("  t %.2f s  angle %.3f rad  without rate limit %.3f rad\n", time, angle, lag);
    }
  }
}
