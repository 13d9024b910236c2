// Repeats the mission without a break, with one controller and one clock, to find drift, growing
// memory and overflow. Five minutes of flight and driving; one hour in a full run.
// CTest: flight long

#include "../../examples/support/flight_controller.hpp"
#include "../../examples/support/mission_sensors.hpp"
#include "../../examples/support/vehicle_choice.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/sanitizer.hpp"

#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <string>
#include <vector>

namespace examples {
namespace long_run_test {

using namespace tilt_ropter;

/// Resident memory of this program [kB].
double resident_memory() {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);)
    if (line.rfind("VmRSS:", 0) == 0) return std::atof(line.c_str() + 6);
  return 0.0;
}

TEST(LongRun, LastMissionMatchesTheSecondInRmseAndMemory) {
  constexpr double step = 1e-3;
  const Mission mission = hybrid_mission(tilt_ropter_vehicle());
  const double lap = mission.duration() + 2.0;  // plus a rest between missions
  const int asked = test_support::quick_or_full(300, 3600);
  const int laps = static_cast<int>(std::ceil(asked / lap));
  const examples::Reference reference = [&](double time) { return mission(std::fmod(time, lap)); };

  Vehicle<4> truth = tilt_ropter_vehicle();
  truth.body.mass *= 1.03;
  truth.body.inertia *= 1.1;
  Plant<4> plant(truth);
  MissionSensors<4> sensors(1);
  FlightController<4> controller(tilt_ropter_vehicle(), in_simulated_time(NmpcSettings{}),
                                 MissionSensors<4>::estimation());
  ActuatorState<4> command;
  std::vector<double> rmse, memory;
  int failures = 0;
  long i = 0;
  for (int k = 0; k < laps; ++k) {
    double squares = 0.0;
    long count = 0;
    for (; plant.time() < (k + 1) * lap - 0.5 * step; ++i) {
      const double time = plant.time();
      sensors.sense(plant, controller);
      if (i % 10 == 0 && controller.started()) {
        controller.prepare(time, reference);
        command = controller.control(time);
        failures += !has_plan(controller.result().status);
        squares += (plant.body().position - reference(time).position).squaredNorm();
        ++count;
      }
      ASSERT_TRUE(plant.step(command, {}, step));
    }
    rmse.push_back(std::sqrt(squares / static_cast<double>(count)));
    memory.push_back(resident_memory());
  }
  const double grown = memory.back() - memory[1];  // the first lap has allocations that occur once
  test_support::check_at_most(0, "long run: RMSE of the last mission / of the second",
                              rmse.back() / rmse[1], 1.1);
  if (!test_support::under_address_sanitizer())
    test_support::check_at_most(0, "long run: memory grown since the second mission [kB]", grown,
                                256.0);
  test_support::check_at_most(0, "long run: ticks without a solution", failures, 0.0);
  EXPECT_EQ(controller.contact().mode_changes(), 4 * laps);
  EXPECT_LT(rmse.back(), 0.02);
}

}  // namespace long_run_test
}  // namespace examples
