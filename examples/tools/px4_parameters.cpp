// Prints PX4's parameters for a vehicle file: geometry, output functions, failsafe.

#include "../support/px4_geometry.hpp"
#include "../support/run_program.hpp"
#include "../support/vehicle_check.hpp"

#include <CLI/CLI.hpp>

#include <cmath>
#include <iostream>
#include <string>
#include <variant>

namespace {

constexpr const char* footer = R"(
Prints a line "param set NAME VALUE" for each parameter: paste them into PX4's console, or save them
and load them with "sh FILE" there. Then look at the result in the ground station before anything
turns: motor 1 is the first rotor of the file, servo 1 the first rotor that tilts, as px4_node sends
them. What PX4's own modes cannot do with this vehicle is on standard error.

Exit code: 0, 2 an invalid vehicle file, above 100 wrong options.)";

int print(const std::string& path) {
  const examples::VehicleFile file = examples::vehicle_to_fly(path);
  const examples::Px4Parameters parameters = std::visit(
      [](const auto& vehicle) { return examples::px4_parameters(vehicle); }, file.vehicle);
  std::cout.precision(6);
  for (const auto& [name, value] : parameters.values)
    std::cout << "param set " << name << ' ' << (std::abs(value) < 1e-9 ? 0.0 : value) << '\n';
  for (const std::string& warning : parameters.warnings)
    std::cerr << "warning: " << warning << '\n';
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Prints the parameters of PX4 for a vehicle."};
  std::string vehicle;
  app.add_option("vehicle", vehicle, "path of a vehicle file; default: the Tilt-Ropter");
  app.footer(footer);
  return examples::run_program(app, "px4_parameters", argc, argv, [&] { return print(vehicle); });
}
