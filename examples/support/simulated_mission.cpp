#include "simulated_mission.hpp"

#include <tilt_ropter/simulation/plant.hpp>

#include <variant>

namespace examples {

FlownMission fly_simulated(const MissionOptions& options, const VehicleFile& file,
                           const FlightProgress& on_progress) {
  return std::visit(
      [&](const auto& vehicle) {
        const auto both = vehicles(options, vehicle);
        tilt_ropter::Plant plant(both.truth);
        return fly(
            options, file, both, plant, [] { return tilt_ropter::Wrenchd{}; },
            [](const tilt_ropter::Mission&) {}, false, on_progress);
      },
      file.vehicle);
}

}  // namespace examples
