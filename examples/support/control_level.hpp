#pragma once

#include "vehicle_file.hpp"

#include <tilt_ropter/control/actuator_nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <string>

/// The choice of a program between the two levels of control.
namespace examples {

/// Adds the option --level to `app`; parsing fills `level` with "wrench" or "actuator".
inline void add_level(CLI::App& app, std::string& level) {
  app.add_option("--level", level,
                 "what the controller plans: the wrench, which an allocation turns into commands, "
                 "as in the paper; or the thrust and tilt angle of each actuator")
      ->check(CLI::IsMember({"wrench", "actuator"}))
      ->capture_default_str();
}

/// Settings of the actuator level for `vehicle`, with the allowed errors and limits of `file` that
/// both levels have.
template <int Rotors>
[[nodiscard]] tilt_ropter::ActuatorNmpcSettings actuator_level_settings(
    const VehicleFile& file, const tilt_ropter::Vehicle<Rotors>& vehicle) {
  tilt_ropter::AllowedActuatorErrors errors;
  errors.position = file.allowed_errors.position;
  errors.velocity = file.allowed_errors.velocity;
  errors.orientation = file.allowed_errors.orientation;
  errors.angular_velocity = file.allowed_errors.angular_velocity;
  tilt_ropter::ActuatorNmpcSettings settings = tilt_ropter::actuator_nmpc_settings(vehicle, errors);
  settings.problem.bounds.angular_velocity = file.limits.angular_velocity;
  settings.ground.planned_height = 0.0;  // as in the missions
  return settings;
}

}  // namespace examples
