// The work of an iteration grows linearly with the length of the horizon (check 21): instructions.
// CTest: counted optimised

#include "support/check_table.hpp"
#include "support/instructions.hpp"
#include "support/masses.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

namespace linear_work_counted_test {

using test_support::check_at_most;

struct Work : test_support::MeanWork {
  double instructions = 0.0;  // of the last iteration
};

Work iterate(int horizon, bool flips) {
  const int count = flips ? 3 : 9;  // callgrind takes its time
  Work work;
  int i = 0;
  static_cast<test_support::MeanWork&>(work) =
      test_support::iterate_masses(horizon, flips, count, [&](const auto& iterate) {
        if (++i < count)
          iterate();
        else
          work.instructions = test_support::instructions(iterate);
      });
  return work;
}

TEST(LinearWork, InstructionsPerNodeAreTheSameForAnyHorizon) {
  std::vector<double> costs;
  for (const int horizon : {20, 50, 100, 200}) {
    const Work work = iterate(horizon, false);
    EXPECT_GT(work.active, 1.2);
    EXPECT_LE(work.passes, 2.0);
    costs.push_back(work.instructions / (horizon * (1.0 + work.last_passes)));
  }
  const auto [least, most] = std::minmax_element(costs.begin(), costs.end());
  check_at_most(21, "instructions per node from N = 20 to 200, largest over smallest",
                *most / *least, 1.3);
}

TEST(LinearWork, TenTimesTheHorizonWithAllConstraintsFlipping) {
  const Work shorter = iterate(50, true), longer = iterate(500, true);
  EXPECT_GT(longer.active, 1.2);
  EXPECT_LE(longer.passes, 1.6 * shorter.passes + 5.0);
  check_at_most(21, "instructions, N = 500 over N = 50, all constraints flipping",
                longer.instructions / shorter.instructions, 15.0);
}

}  // namespace linear_work_counted_test
