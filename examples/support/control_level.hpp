#pragma once

#include "vehicle_choice.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <string>

/// The choice of a program between the two levels of control.
namespace examples {

/// Adds the option --level to `app`; parsing fills `level` with "wrench" or "actuator". Without the
/// option it stays empty.
inline void add_level(CLI::App& app, std::string& level) {
  app.add_option("--level", level,
                 "what the controller plans: the wrench, which an allocation turns into commands, "
                 "as in the paper; or the thrust and tilt angle of each actuator; default: wrench "
                 "if the rotors give every wrench, otherwise actuator")
      ->check(CLI::IsMember({"wrench", "actuator"}));
}

/// Returns the level for the vehicle of `file`: `wanted` if it is not empty, otherwise the wrench
/// level if it can control the vehicle. Throws VehicleFileError if the wrench level is wanted and
/// cannot.
[[nodiscard]] inline std::string level_for(const std::string& wanted, const VehicleFile& file) {
  if (wanted == "wrench") require_wrench_level(file);
  if (!wanted.empty()) return wanted;
  return reason_against_wrench_level(file).empty() ? "wrench" : "actuator";
}

/// Returns a sentence that says which level level_for() chose and why.
[[nodiscard]] inline std::string level_choice(const std::string& wanted, const VehicleFile& file) {
  if (!wanted.empty()) return "";
  const std::string reason = reason_against_wrench_level(file);
  return reason.empty() ? "" : file.name + ": flies at the actuator level, because " + reason;
}

/// Settings of the actuator level for `vehicle`, with the allowed errors and limits of `file` that
/// both levels have.
template <int Rotors>
[[nodiscard]] tilt_ropter::ActuatorNmpcSettings actuator_level_settings(
    const VehicleFile& file, const tilt_ropter::Vehicle<Rotors>& vehicle) {
  tilt_ropter::ActuatorNmpcSettings settings =
      tilt_ropter::actuator_nmpc_settings(vehicle, file.allowed_errors);
  settings.problem.bounds.angular_velocity = file.limits.angular_velocity;
  file.ground.apply_to(settings.ground);
  return settings;
}

/// Returns make(settings) with the settings of level_for(wanted, file) for the `vehicle` of `file`.
/// Throws VehicleFileError as that does.
template <int Rotors, typename Make>
[[nodiscard]] auto at_level(const std::string& wanted, const VehicleFile& file,
                            const tilt_ropter::Vehicle<Rotors>& vehicle, const Make& make) {
  if (level_for(wanted, file) == "wrench") return make(file.settings());
  return make(actuator_level_settings(file, vehicle));
}

}  // namespace examples
