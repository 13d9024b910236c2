#pragma once

#include "vehicle_choice.hpp"

#include <iostream>
#include <string>
#include <vector>

/// What is wrong with a vehicle that can be told without flying it.
namespace examples {

struct VehicleFinding {
  bool is_error = false;  ///< it does not fly; otherwise a warning
  std::string text;

  [[nodiscard]] std::string line() const { return (is_error ? "error: " : "warning: ") + text; }
};

/// Numbers of the file that contradict each other: rotors in one place, spins that cancel no yaw, a
/// servo range that looks like radians, an inertia or a rotor that no vehicle of this size has.
[[nodiscard]] std::vector<VehicleFinding> file_findings(const VehicleFile& file);

/// The same, and whether the rotors carry the weight and turn the vehicle about all axes. Programs
/// that fly print these first; check_vehicle checks more.
[[nodiscard]] std::vector<VehicleFinding> static_findings(const VehicleFile& file);

/// For programs that fly: vehicle_or_default(path), whose static_findings() go to stderr.
[[nodiscard]] inline VehicleFile vehicle_to_fly(const std::string& path) {
  VehicleFile file = vehicle_or_default(path);
  for (const VehicleFinding& finding : static_findings(file)) std::cerr << finding.line() << '\n';
  return file;
}

}  // namespace examples
