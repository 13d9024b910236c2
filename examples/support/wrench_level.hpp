#pragma once

#include <tilt_ropter/model/vehicle.hpp>

#include <type_traits>

/// Which vehicles the programs control at the wrench level.
namespace examples {

/// True if the programs contain the wrench level for this number of rotors. They fly 2, 3, 5 and 7
/// rotors at the actuator level only.
template <int Rotors>
inline constexpr bool has_wrench_level = Rotors == 4 || Rotors == 6 || Rotors == 8;

/// The same for the type of a vehicle.
template <typename AnyVehicle>
struct HasWrenchLevel;
template <int Rotors>
struct HasWrenchLevel<tilt_ropter::Vehicle<Rotors>> : std::bool_constant<has_wrench_level<Rotors>> {
};

}  // namespace examples
