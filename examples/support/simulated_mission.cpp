#include "simulated_mission.hpp"

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <optional>
#include <type_traits>
#include <variant>

namespace examples {

FlownMission fly_simulated(const MissionOptions& options, const VehicleFile& file,
                           const FlightProgress& on_progress) {
  return std::visit(
      [&](const auto& vehicle) {
        const auto both = vehicles(options, vehicle);
        using Vehicle = std::decay_t<decltype(vehicle)>;
        tilt_ropter::Plant plant(both.truth);
        std::optional<ActuatorFailureOption> failure;
        if (!options.failure.empty())
          failure = parse_failure(options.failure, static_cast<int>(vehicle.rotors.size()));
        const auto fail = [&](const tilt_ropter::Mission&) {
          if (!failure || plant.time() < failure->start) return;
          const auto state = plant.state();
          plant = tilt_ropter::Plant(Vehicle(with_failure(both.truth, failure->failure)));
          plant.reset(state);
          failure.reset();
        };
        return fly(
            options, file, both, plant, [] { return tilt_ropter::Wrenchd{}; }, fail, false,
            on_progress);
      },
      file.vehicle);
}

}  // namespace examples
