// Prints a vehicle file as URDF, for robot_state_publisher and rviz2.

#include "../support/run_program.hpp"
#include "../support/urdf.hpp"
#include "../support/vehicle_check.hpp"

#include <CLI/CLI.hpp>

#include <iostream>
#include <string>
#include <variant>

namespace {

constexpr const char* footer = R"(
Prints links and joints: base_link at the centre of mass, tilt_1 and rotor_1 and so on, with names
and signs of the JointState messages in MCAP files; wheels. Show it where the nodes publish /tf:

    build/examples/vehicle_urdf vehicle.json > vehicle.urdf
    ros2 run robot_state_publisher robot_state_publisher vehicle.urdf

Exit code: 0, 2 an invalid vehicle file, above 100 wrong options.)";

int print(const std::string& path) {
  const examples::VehicleFile file = examples::vehicle_to_fly(path);
  std::visit([&](const auto& vehicle) { examples::write_urdf(vehicle, file.name, std::cout); },
             file.vehicle);
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Prints a vehicle as URDF."};
  std::string vehicle;
  app.add_option("vehicle", vehicle, "path of a vehicle file; default: the Tilt-Ropter");
  app.footer(footer);
  return examples::run_program(app, "vehicle_urdf", argc, argv, [&] { return print(vehicle); });
}
