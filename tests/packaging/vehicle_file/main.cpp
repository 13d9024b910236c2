// Reads a vehicle file, as a user's program does, and prints its name and number of rotors.

#include <tilt_ropter/vehicle_file.hpp>

#include <iostream>
#include <variant>

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  try {
    const tilt_ropter::VehicleFile file = tilt_ropter::read_vehicle(argv[1]);
    std::visit(
        [&](const auto& vehicle) {
          std::cout << file.name << ": " << vehicle.rotors.size() << " rotors\n";
        },
        file.vehicle);
  } catch (const tilt_ropter::VehicleFileError& error) {
    std::cerr << error.what() << '\n';
    return 1;
  }
  return 0;
}
