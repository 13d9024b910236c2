#pragma once

#include "../../cmake/vehicle_file/tilt_ropter/vehicle_file.hpp"
#include "wrench_level.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <limits>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>

/// Which vehicle a program flies, and whether it can.
namespace examples {

using tilt_ropter::AnyVehicle;
using tilt_ropter::read_vehicle;
using tilt_ropter::VehicleFile;
using tilt_ropter::VehicleFileError;
using tilt_ropter::write_vehicle;

/// Returns the same settings without a time limit: in a simulation, time stands still while the
/// controller computes, and the results are the same on every machine.
[[nodiscard]] inline tilt_ropter::NmpcSettings in_simulated_time(
    tilt_ropter::NmpcSettings settings) {
  settings.time_limit = std::numeric_limits<double>::infinity();
  return settings;
}

/// Returns the Tilt-Ropter if `path` is empty, otherwise the vehicle in this file.
[[nodiscard]] inline VehicleFile vehicle_or_default(const std::string& path) {
  return path.empty() ? VehicleFile{} : read_vehicle(path);
}

/// Returns why the wrench level cannot control this vehicle, or an empty text: the programs contain
/// it for 4, 6 and 8 rotors, and the allocation must have rank 6.
[[nodiscard]] std::string reason_against_wrench_level(const VehicleFile& file);

/// Throws VehicleFileError if the wrench level cannot control this vehicle.
void require_wrench_level(const VehicleFile& file);

/// For programs that need four rotors and the wrench level. Throws VehicleFileError for any other
/// vehicle.
[[nodiscard]] tilt_ropter::Vehicle<4> quadrotor(const VehicleFile& file);

/// For programs that need the wrench level: returns action(vehicle). Throws VehicleFileError if the
/// wrench level cannot control this vehicle.
template <typename Action>
auto with_wrench_level(const VehicleFile& file, Action&& action) {
  require_wrench_level(file);
  using Result = decltype(action(std::declval<const tilt_ropter::Vehicle<4>&>()));
  return std::visit(
      [&](const auto& vehicle) -> Result {
        if constexpr (HasWrenchLevel<std::decay_t<decltype(vehicle)>>::value)
          return action(vehicle);
        else
          throw VehicleFileError(reason_against_wrench_level(file));
      },
      file.vehicle);
}

}  // namespace examples
