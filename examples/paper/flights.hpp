#pragma once

#include "../support/mission_loop.hpp"
#include "../support/progress.hpp"
#include "../support/vehicle_choice.hpp"
#ifdef REPRODUCE_PAPER_MUJOCO  // set by CMake if MuJoCo is found
#include "../mujoco/plant.hpp"
#endif

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <exception>
#include <memory>
#include <mutex>
#include <numeric>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

/// Many flights of the Tilt-Ropter, in any plant, on several threads.
namespace examples::paper {

#ifdef REPRODUCE_PAPER_MUJOCO
inline constexpr bool has_mujoco = true;
#else
inline constexpr bool has_mujoco = false;
#endif

enum class PlantKind { own, mujoco };

/// Part of the names of results.
[[nodiscard]] inline const char* to_string(PlantKind plant) {
  return plant == PlantKind::own ? "plant" : "mujoco";
}

/// One flight. Its logs go to the directory `name` in the output directory.
struct FlightCase {
  std::string name;
  MissionOptions options;
  PlantKind plant = PlantKind::own;
  bool mcap = false;  ///< also write flight.mcap
};

struct FlightResult {
  FlownMission flown;
  std::string error;  ///< empty if the mission was flown to its end
};

/// Calls do(plant) with the plant of `kind`. Throws std::runtime_error without MuJoCo.
template <typename Do>
void with_plant(PlantKind kind, const tilt_ropter::Vehicle<4>& truth, const Do& act) {
  if (kind == PlantKind::own) {
    tilt_ropter::Plant<4> plant(truth);
    act(plant);
    return;
  }
#ifdef REPRODUCE_PAPER_MUJOCO
  static std::mutex loading;  // MuJoCo reads one model at a time
  std::unique_lock<std::mutex> lock(loading);
  MujocoParameters parameters;
  parameters.seen = false;
  MujocoPlant plant(truth, parameters);
  lock.unlock();
  act(plant);
#else
  throw std::runtime_error("built without MuJoCo (Debian: libmujoco-dev)");
#endif
}

/// Flies one case. `on_progress(fraction)` is called every second of the flight. An error ends up
/// in the result.
template <typename OnProgress>
[[nodiscard]] FlightResult fly_case(const FlightCase& flight, const std::string& output,
                                    const OnProgress& on_progress) {
  FlightResult result;
  try {
    MissionOptions options = flight.options;
    options.output = output + '/' + flight.name;
    if (flight.mcap) options.mcap = options.output + "/flight.mcap";
    const VehicleFile file = vehicle_or_default(options.vehicle_path);
    const auto both = vehicles(options, quadrotor(file));
    with_plant(flight.plant, both.truth, [&](auto& plant) {
      result.flown = fly(
          options, file, both, plant, [] { return tilt_ropter::Wrenchd{}; },
          [](const tilt_ropter::Mission&) {}, false,
          [&](double fraction, tilt_ropter::MissionPhase) { on_progress(fraction); });
    });
  } catch (const std::exception& error) {
    result.error = error.what();
  }
  return result;
}

/// Flies all cases, `threads` at a time, and shows the progress. The results are in the order of
/// the cases and do not depend on the number of threads.
[[nodiscard]] inline std::vector<FlightResult> fly_all(const std::vector<FlightCase>& cases,
                                                       const std::string& output, int threads) {
  std::vector<FlightResult> results(cases.size());
  std::vector<double> done(cases.size(), 0.0);
  std::atomic<std::size_t> next{0};
  std::mutex showing;
  std::string newest;  // case
  Progress progress;
  const auto work = [&] {
    for (std::size_t i = next++; i < cases.size(); i = next++) {
      const auto show = [&](double fraction) {
        const std::lock_guard<std::mutex> lock(showing);
        if (done[i] == 0.0 && fraction == 0.0) newest = cases[i].name;
        done[i] = fraction;
        progress.show(
            std::accumulate(done.begin(), done.end(), 0.0) / static_cast<double>(cases.size()),
            cases[i].name);
      };
      results[i] = fly_case(cases[i], output, show);
      show(1.0);
    }
  };
  std::vector<std::thread> others;
  for (int i = 1; i < threads; ++i) others.emplace_back(work);
  work();
  for (std::thread& other : others) other.join();
  progress.finish();
  return results;
}

}  // namespace examples::paper
