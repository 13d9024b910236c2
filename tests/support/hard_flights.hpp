#pragma once

#include "../../examples/support/stress_flight.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <string>
#include <vector>

/// The largest disturbances: all scenarios of the program stress_flights.
namespace test_support {

using examples::Scenario;
using examples::StressRecord;
using examples::StressStart;
using tilt_ropter::NmpcSettings;
using tilt_ropter::Vehicle;

struct Case {
  const char* name;
  Scenario scenario;
  double size;
  int count;
};

inline std::vector<Case> cases(int random_states) {
  std::vector<Case> all;
  for (const double size : {5.0, 8.0, 12.0, 20.0, 30.0, 40.0})
    all.push_back({"step", Scenario::step, size, quick_or_full(1, 5)});
  all.push_back({"yaw", Scenario::yaw, 180.0, quick_or_full(1, 5)});
  all.push_back({"knocked", Scenario::knocked, examples::usual_size(Scenario::knocked),
                 quick_or_full(1, 20)});
  all.push_back({"thrown", Scenario::thrown, 6.0, quick_or_full(1, 20)});
  all.push_back({"inverted", Scenario::inverted, 180.0, quick_or_full(1, 20)});
  all.push_back({"random", Scenario::random, 1.0, random_states});
  return all;
}

struct Totals {
  int flights = 0, recovered = 0, unsolved_called_solved = 0;
  int most_passes = 0, most_rounds = 0, most_evaluations = 0;
  double worst_bound_ratio = 0.0;
};

/// Flies all cases: fly(start) returns the record of one flight.
template <typename Fly>
Totals fly_all(int random_states, const Fly& fly) {
  Totals totals;
  for (const Case& c : cases(random_states))
    for (int i = 0; i < c.count; ++i) {
      SCOPED_TRACE(std::string(c.name) + " of " + std::to_string(c.size) + ", flight " +
                   std::to_string(i));
      const StressRecord r =
          fly(examples::stress_start(c.scenario, c.size, examples::usual_height(c.scenario), 7,
                                     static_cast<std::uint64_t>(i)));
      EXPECT_TRUE(r.recovered);
      EXPECT_EQ(r.unsolved_called_solved, 0) << r.worst_solved;
      EXPECT_LE(r.worst_bound_ratio, 1.0);
      ++totals.flights;
      totals.recovered += r.recovered;
      totals.unsolved_called_solved += r.unsolved_called_solved;
      totals.most_passes = std::max(totals.most_passes, r.most_passes);
      totals.most_rounds = std::max(totals.most_rounds, r.most_rounds);
      totals.most_evaluations = std::max(totals.most_evaluations, r.most_evaluations);
      totals.worst_bound_ratio = std::max(totals.worst_bound_ratio, r.worst_bound_ratio);
    }
  return totals;
}

/// Check 19, as far as it counts: `most_evaluations` is the limit of NLopt's gradient evaluations
/// in a tick. The median tick, in hover, has one pass, no round and no evaluation.
inline void check_worst_tick(const Totals& t, int most_evaluations) {
  check_at_least(19, "flights that recovered, fraction", 1.0 * t.recovered / t.flights, 1.0);
  check_at_most(19, "largest command or rate over its bound", t.worst_bound_ratio, 1.0);
  check_at_most(19, "unsolved ticks called solved", t.unsolved_called_solved, 0.0);
  check_at_most(19, "Riccati passes in a tick, besides the first", t.most_passes, 10.0);
  check_at_most(19, "rounds of NLopt in a tick, two sweeps each", t.most_rounds, 5.0);
  check_at_most(19, "gradient evaluations by NLopt in a tick", t.most_evaluations,
                most_evaluations);
}

/// Settings of the flights. `time_limit` [s] is large: flights are then deterministic.
inline NmpcSettings stress_settings(const Vehicle<4>& vehicle, double time_limit = 1.0) {
  NmpcSettings settings = nmpc_settings(vehicle);
  settings.time_limit = time_limit;
  return settings;
}

}  // namespace test_support
