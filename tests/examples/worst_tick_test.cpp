// The most work of the controller in a tick and the largest disturbances, without and with a limit
// (checks 19 and 20), counted. The long form, which is also measured, is in
// worst_tick_time_test.cpp.
// CTest: flight optimised

#include "support/check_table.hpp"
#include "support/clock_that_counts.hpp"
#include "support/hard_flights.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

namespace tilt_ropter {
namespace worst_tick_test {

using test_support::check_at_least;
using test_support::check_at_most;
using test_support::clock_readings;
using test_support::quick_or_full;
using test_support::stress_settings;

TEST(WorstTick, EveryFlightRecoversWithinBoundsInBoundedWork) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const test_support::Totals t =
      test_support::fly_all(quick_or_full(5, 1000), [&](const examples::StressStart& start) {
        return examples::fly_stress(vehicle, stress_settings(vehicle), start, 15.0);
      });
  // 87; 275 in the long form, of at most 16 multipliers each
  test_support::check_worst_tick(t, quick_or_full(100, 300));
}

/// The wrench level, with the number of clock readings in every tick.
template <int Rotors>
class Counting : public examples::WrenchLevel<Rotors> {
 public:
  using Level = examples::WrenchLevel<Rotors>;

  Counting(const Vehicle<Rotors>& vehicle, const NmpcSettings& settings)
      : Level(vehicle, settings) {
    readings.clear();
    late = 0;
  }
  void prepare(double time, const ReferencePoint& reference, const Wrenchd& external) {
    before_ = clock_readings();
    Level::prepare(time, reference, external);
  }
  const NmpcResult& feedback(double time, const BodyStated& body,
                             const ActuatorState<Rotors>& actuators) {
    const NmpcResult& result = Level::feedback(time, body, actuators);
    readings.push_back(static_cast<int>(clock_readings() - before_));
    late += result.report.status == optimal_control::SolveStatus::time_limit;
    return result;
  }

  static inline std::vector<int> readings;  // of the last flight
  static inline int late = 0;               // ticks whose program the limit interrupted

 private:
  long before_ = 0;
};

// A clock that advances by a microsecond whenever it is read makes the limit a number of readings:
// three for each pass, so that the limit leaves time for two passes. The readings after the last
// pass that fits take as long as two passes.
TEST(WorstTick, EveryFlightRecoversWithALimitOfTwoPasses) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const auto hover = examples::stress_start(examples::Scenario::step, 0.1, 10.0, 1, 0);
  (void)examples::fly_stress<Counting>(vehicle, stress_settings(vehicle), hover, 2.0);
  std::vector<int> usual = Counting<4>::readings;
  std::nth_element(usual.begin(), usual.begin() + static_cast<long>(usual.size() / 2), usual.end());
  const int limit = usual[usual.size() / 2] + 6;
  int most = 0, late = 0;
  const test_support::Totals t =
      test_support::fly_all(quick_or_full(3, 200), [&](const examples::StressStart& start) {
        examples::StressRecord r = examples::fly_stress<Counting>(
            vehicle, stress_settings(vehicle, 1e-6 * limit), start, 15.0);
        for (const int readings : Counting<4>::readings) most = std::max(most, readings);
        late += Counting<4>::late;
        return r;
      });
  check_at_least(20, "flights that recovered, fraction, of a limit in readings of the clock",
                 1.0 * t.recovered / t.flights, 1.0);
  check_at_most(20, "readings of the clock in a tick beyond the limit", most - limit,
                quick_or_full(8, 10));
  EXPECT_LE(t.worst_bound_ratio, 1.0);
  EXPECT_GT(late, 10);  // or the limit says nothing
}

}  // namespace worst_tick_test
}  // namespace tilt_ropter
