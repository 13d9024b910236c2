#pragma once

#include "mission_loop.hpp"

#include <tilt_ropter/planning/mission.hpp>

#include <functional>

/// The mission loop on the library's plant.
namespace examples {

/// Called every second of the flight with the fraction of the mission that is flown, and its phase.
using FlightProgress = std::function<void(double, tilt_ropter::MissionPhase)>;

/// Flies the mission of `options` with the vehicle of `file`, see fly(). Compiled once for every
/// number of rotors, in simulated_mission.cpp.
[[nodiscard]] FlownMission fly_simulated(const MissionOptions& options, const VehicleFile& file,
                                         const FlightProgress& on_progress);

}  // namespace examples
