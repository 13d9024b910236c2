// The controller's worst tick and worst day: everything that the stress_flights example can begin a
// flight with, with and without a time limit (CHECKS 19 and 20).

#include "../../examples/support/stress_flight.hpp"

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/sanitizer.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace {

using examples::Scenario;
using examples::StressRecord;
using test_support::check_at_least;
using test_support::check_at_most;
using test_support::quick_or_full;

struct Case {
  const char* name;
  Scenario scenario;
  double size;
  int count;
};

std::vector<Case> cases(int random_states) {
  std::vector<Case> all;
  for (const double size : {5.0, 8.0, 12.0, 20.0, 30.0, 40.0})
    all.push_back({"step", Scenario::step, size, quick_or_full(1, 5)});
  all.push_back({"yaw", Scenario::yaw, 180.0, quick_or_full(1, 5)});
  all.push_back({"knocked", Scenario::knocked, examples::usual_size(Scenario::knocked),
                 quick_or_full(2, 20)});
  all.push_back({"thrown", Scenario::thrown, 6.0, quick_or_full(2, 20)});
  all.push_back({"inverted", Scenario::inverted, 180.0, quick_or_full(2, 20)});
  all.push_back({"random", Scenario::random, 1.0, random_states});
  return all;
}

struct Totals {
  int flights = 0, recovered = 0, unsolved_called_solved = 0, most_passes = 0;
  double worst_bound_ratio = 0.0;
  std::vector<double> hover_us, tick_us;
};

// `look` sees every flight.
template <typename Look>
Totals fly_all(double time_limit, int random_states, const Look& look) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  NmpcSettings settings = nmpc_settings(vehicle);
  settings.time_limit = time_limit;
  Totals totals;
  for (const Case& c : cases(random_states))
    for (int i = 0; i < c.count; ++i) {
      SCOPED_TRACE(std::string(c.name) + " of " + std::to_string(c.size) + ", flight " +
                   std::to_string(i));
      const examples::StressStart start = examples::stress_start(
          c.scenario, c.size, examples::usual_height(c.scenario), 7, static_cast<std::uint64_t>(i));
      const StressRecord r = examples::fly_stress(vehicle, settings, start, 15.0);
      EXPECT_TRUE(r.recovered);
      EXPECT_EQ(r.unsolved_called_solved, 0) << r.worst_solved;
      EXPECT_LE(r.worst_bound_ratio, 1.0);
      ++totals.flights;
      totals.recovered += r.recovered;
      totals.unsolved_called_solved += r.unsolved_called_solved;
      totals.most_passes = std::max(totals.most_passes, r.most_passes);
      totals.worst_bound_ratio = std::max(totals.worst_bound_ratio, r.worst_bound_ratio);
      totals.hover_us.insert(totals.hover_us.end(), r.hover_us.begin(), r.hover_us.end());
      look(r, [&] { return examples::fly_stress(vehicle, settings, start, 15.0); });
    }
  return totals;
}

double quantile(std::vector<double> values, double share) {
  const auto at =
      values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

// The longest tick of flights that are the same, each tick the shortest of three: what the machine
// did meanwhile does not repeat itself.
template <typename Repeat>
double worst_tick(const StressRecord& first, const Repeat& repeat) {
  std::vector<double> ticks = first.tick_us;
  for (int again = 0; again < 2; ++again) {
    const StressRecord r = repeat();
    for (std::size_t i = 0; i < std::min(ticks.size(), r.tick_us.size()); ++i)
      ticks[i] = std::min(ticks[i], r.tick_us[i]);
  }
  return *std::max_element(ticks.begin(), ticks.end());
}

TEST(WorstTick, EveryFlightRecoversWithinBoundsInBoundedTime) {
  double worst = 0.0;
  // Deterministic without a limit, so passes say what no noise can hide.
  const Totals t = fly_all(1.0, quick_or_full(10, 1000), [&](const auto& r, const auto& repeat) {
    if (r.worst_us() > worst) worst = std::max(worst, worst_tick(r, repeat));
  });
  check_at_least(19, "flights that recovered, share", 1.0 * t.recovered / t.flights, 1.0);
  check_at_most(19, "largest command or rate over its bound", t.worst_bound_ratio, 1.0);
  check_at_most(19, "unsolved ticks called solved", t.unsolved_called_solved, 0.0);
  check_at_most(19, "Riccati passes in a tick, besides the first", t.most_passes, 10.0);
  if (test_support::under_address_sanitizer()) return;  // its times mean nothing
  check_at_most(19, "worst tick over the median in hover", worst / quantile(t.hover_us, 0.5), 15.0);
}

TEST(WorstTick, WithinThreeTimesTheMedianEveryFlightStillRecovers) {
  if (test_support::under_address_sanitizer())
    GTEST_SKIP() << "a sanitizer takes longer than the limit";
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const StressRecord hover =
      examples::fly_stress(vehicle, nmpc_settings(vehicle),
                           examples::stress_start(Scenario::step, 0.1, 10.0, 1, 0), 5.0);
  const double limit_us = 3.0 * quantile(hover.tick_us, 0.5);
  long ticks = 0, late = 0;
  const Totals t = fly_all(1e-6 * limit_us, quick_or_full(5, 200), [&](const auto& r, const auto&) {
    ticks += static_cast<long>(r.tick_us.size());
    for (const double us : r.tick_us) late += us > 1.2 * limit_us;
  });
  check_at_least(20, "flights that recovered, share", 1.0 * t.recovered / t.flights, 1.0);
  check_at_most(20, "largest command or rate over its bound", t.worst_bound_ratio, 1.0);
  // What the machine does in a tick is measured with it.
  check_at_most(20, "share of ticks longer than the limit and a fifth",
                static_cast<double>(late) / static_cast<double>(ticks), 2e-3);
}

}  // namespace
}  // namespace tilt_ropter
