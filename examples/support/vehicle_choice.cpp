#include "vehicle_choice.hpp"

#include <tilt_ropter/actuation/allocation_matrix.hpp>

#include <string>
#include <type_traits>
#include <variant>

namespace examples {

using tilt_ropter::Vehicle;

std::string reason_against_wrench_level(const VehicleFile& file) {
  return std::visit(
      [](const auto& vehicle) -> std::string {
        const int rank = allocation_rank(vehicle);
        if (rank < 6)
          return "its rotors do not give every wrench: the allocation has rank " +
                 std::to_string(rank) + ", must be 6";
        if (!HasWrenchLevel<std::decay_t<decltype(vehicle)>>::value)
          return "the programs have the wrench level for 4, 6 and 8 rotors, this vehicle has " +
                 std::to_string(vehicle.rotors.size());
        return "";
      },
      file.vehicle);
}

void require_wrench_level(const VehicleFile& file) {
  const std::string reason = reason_against_wrench_level(file);
  if (!reason.empty())
    throw VehicleFileError(file.name + ": the wrench level cannot control this vehicle: " + reason);
}

Vehicle<4> quadrotor(const VehicleFile& file) {
  const auto* vehicle = std::get_if<Vehicle<4>>(&file.vehicle);
  if (vehicle == nullptr)
    throw VehicleFileError(file.name +
                           ": this program needs a vehicle of 4 rotors; hybrid_mission takes any");
  require_wrench_level(file);
  return *vehicle;
}

}  // namespace examples
