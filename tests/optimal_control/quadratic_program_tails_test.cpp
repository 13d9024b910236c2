// The work per node does not grow with the horizon.
// CTest: optimised

#include "benchmark/scenarios.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

namespace {

/// Flies `ticks` real-time iterations. Returns the mean of their passes, without that of prepare().
double passes(const benchmarks::Scenario& scenario, int ticks) {
  benchmarks::ClosedLoop loop(scenario);
  double sum = 0.0;
  for (int tick = 0; tick < ticks; ++tick) {
    loop.iterate();
    sum += loop.report().passes;
  }
  EXPECT_TRUE(loop.sound());  // no tick is unsolved
  return sum / ticks;
}

// A tick changes a fraction of the active constraints: 13 of 748 for N = 500.
TEST(QuadraticProgramTails, PassesDoNotGrowWithTheHorizon) {
  EXPECT_LE(passes(benchmarks::air(500), 40), passes(benchmarks::air(20), 500) + 1.0);
}

}  // namespace
