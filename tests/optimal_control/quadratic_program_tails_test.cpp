// The worst tick of a flight takes a bounded number of passes, and the work per node does not grow
// with the horizon.
// CTest: optimised

#include "benchmark/scenarios.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <algorithm>

namespace quadratic_program_tails_test {

struct Passes {
  double mean = 0.0;  ///< of a tick, without the pass of prepare()
  int most = 0;
};

/// Flies `ticks` real-time iterations.
Passes fly(const benchmarks::Scenario& scenario, int ticks) {
  benchmarks::ClosedLoop loop(scenario);
  Passes passes;
  for (int tick = 0; tick < ticks; ++tick) {
    loop.iterate();
    passes.mean += static_cast<double>(loop.report().passes) / ticks;
    passes.most = std::max(passes.most, loop.report().passes);
  }
  EXPECT_TRUE(loop.sound());  // no tick is unsolved
  return passes;
}

// From the step of the failed active set: 39 at most, 4.5 on average.
TEST(QuadraticProgramTails, StepOf20mTakesFewPasses) {
  const Passes passes = fly(benchmarks::steps<20>(tilt_ropter::paper_bounds()), 500);
  EXPECT_LE(passes.most, 24);
  EXPECT_LE(passes.mean, 4.1);
}

// Likewise: 56 at most, 22.7 on average.
TEST(QuadraticProgramTails, StepOf100mTakesFewPasses) {
  const Passes passes = fly(benchmarks::steps<100>(tilt_ropter::paper_bounds()), 500);
  EXPECT_LE(passes.most, 28);
  EXPECT_LE(passes.mean, 13.0);
}

// A tick changes a fraction of the active constraints: 13 of 748 for N = 500.
TEST(QuadraticProgramTails, PassesDoNotGrowWithTheHorizon) {
  EXPECT_LE(fly(benchmarks::air(500), 40).mean, fly(benchmarks::air(20), 500).mean + 1.0);
}

}  // namespace quadratic_program_tails_test
