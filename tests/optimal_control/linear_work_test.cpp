// The time of an iteration grows linearly with the length of the horizon (check 21), measured. The
// counted form is in linear_work_counted_test.cpp.
// CTest: long real_time

#include "../../examples/support/statistics.hpp"
#include "support/check_table.hpp"
#include "support/masses.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <ctime>
#include <vector>

namespace linear_work_test {

using test_support::check_at_most;

double thread_seconds() {
  std::timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

struct Work : test_support::MeanWork {
  double seconds = 0.0;  // median time of an iteration [s]
};

Work iterate(int horizon, bool flips) {
  std::vector<double> seconds;
  Work work;
  static_cast<test_support::MeanWork&>(work) =
      test_support::iterate_masses(horizon, flips, 31, [&](const auto& iterate) {
        const double start = thread_seconds();
        iterate();
        seconds.push_back(thread_seconds() - start);
      });
  work.seconds = examples::percentile(seconds, 0.5);
  return work;
}

TEST(LinearTime, CostPerNodeIsTheSameForAnyHorizon) {
  // The speed of the machine changes in the course of seconds: each round compares all horizons,
  // and the median of the rounds counts.
  const std::vector<int> horizons = {20, 50, 100, 200};
  std::vector<double> ratios;
  for (int round = 0; round < 11; ++round) {
    std::vector<double> cost;
    for (const int horizon : horizons) {
      const Work work = iterate(horizon, false);
      EXPECT_GT(work.active, 1.2);
      EXPECT_LE(work.passes, 2.0);
      cost.push_back(work.seconds / (horizon * (1.0 + work.passes)));
    }
    const auto [least, most] = std::minmax_element(cost.begin(), cost.end());
    ratios.push_back(*most / *least);
  }
  check_at_most(21, "cost per node from N = 20 to 200, largest over smallest",
                examples::percentile(ratios, 0.5), 1.3);
}

TEST(LinearTime, TenTimesTheHorizonWithAllConstraintsFlipping) {
  Work shorter = iterate(50, true), longer = iterate(500, true);
  for (int again = 0; again < 3; ++again) {
    shorter.seconds = std::min(shorter.seconds, iterate(50, true).seconds);
    longer.seconds = std::min(longer.seconds, iterate(500, true).seconds);
  }
  EXPECT_GT(longer.active, 1.2);
  EXPECT_LE(longer.passes, 1.6 * shorter.passes + 5.0);
  check_at_most(21, "N = 500 over N = 50, all constraints flipping",
                longer.seconds / shorter.seconds, 15.0);
}

}  // namespace linear_work_test
