#pragma once

#include "input_file_error.hpp"
#include "wrench_level.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <iosfwd>
#include <limits>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>

/// A user-defined vehicle in a JSON file: every parameter has a name with its unit.
///
///     { "name": "my vehicle",
///       "body": { "mass_kg": 1.5,
///                 "inertia_kg_m2": [0.014, 0.014, 0.025] },  or three rows of three
///       "rotor": { "thrust_coefficient_n_s2_per_rad2": 1.4e-6, "torque_ratio_m": 0.016,
///                  "min_thrust_n": 0, "max_thrust_n": 12, "time_constant_s": 0.03 },
///       "servo": { "time_constant_s": 0.08, "max_rate_radps": 8, "min_angle_deg": -180,
///                  "max_angle_deg": 180, "dead_time_s": 0 },
///       "rotors": [ { "azimuth_deg": -90, "length_m": 0.17,      on an arm in the CoM's plane,
///                     "spin": "counter_clockwise", "tilts": true },
///                   { "position_m": [0.1, 0.1, 0.1],             or anywhere
///                     "thrust_axis": [0, 0, 1],                  direction of thrust at zero tilt
///                     "arm_axis": [1, 0, 0],                     axis of the servo
///                     "spin": "clockwise", "tilts": true } ],    2 to 8 rotors
///       "power": { "electronics_w": 18, "hover_w": 653.64,       and, optional, for each servo
///                  "servo_hold_w": 0.5,                          at rest and, in addition,
///                  "servo_move_j_per_rad": 0.3 },                while it moves
///
///                                                                optional from here on
///       "wheels": { "radius_m": 0.11, "half_track_m": 0.2,       without wheels or legs the
///                   "wheel_base_m": 0 },                         vehicle stays in the air
///       "legs": { "height_m": 0.12, "half_length_m": 0.15,       instead of wheels
///                 "half_width_m": 0.15 },
///       "battery_wh": 100,
///       "battery_nominal_v": 22.2,      under load, at which the rotors reach max_thrust_n
///       "battery_capacity_ah": 5.3, "battery_full_v": 16.8,      all four or none: voltages
///       "battery_empty_v": 13.2, "battery_resistance_ohm": 0.012,   without load
///       "allowed_errors": { "position_m": [0.13, 0.13, 0.11] },  fields of AllowedErrors
///       "limits": { "force_max_n": [6, 6, 30] } }                fields of NmpcBounds
///
/// All values are in the body frame (x forward, y left, z up) with the CoM as its origin.
/// `thrust_axis` and `arm_axis` need not be unit vectors. A rotor that does not tilt needs no
/// `arm_axis`.
///
/// `rotor` may also contain `linear_thrust_coefficient_n_s_per_rad` (default zero): thrust =
/// thrust_coefficient speed^2 + linear_thrust_coefficient speed. An entry of `rotors` may contain
/// any field of `rotor`; the value then replaces the common one for this rotor.
namespace examples {

using AnyVehicle =
    std::variant<tilt_ropter::Vehicle<2>, tilt_ropter::Vehicle<3>, tilt_ropter::Vehicle<4>,
                 tilt_ropter::Vehicle<5>, tilt_ropter::Vehicle<6>, tilt_ropter::Vehicle<7>,
                 tilt_ropter::Vehicle<8>>;

struct VehicleFile {
  std::string name = "Tilt-Ropter";
  AnyVehicle vehicle{tilt_ropter::tilt_ropter_vehicle()};
  double battery_wh = 0.0;  ///< 0: unknown; used only if the vehicle's battery is unknown
  tilt_ropter::AllowedErrors allowed_errors;
  tilt_ropter::NmpcBounds limits;

  /// Returns the undercarriage (wheels or legs), if there is one.
  [[nodiscard]] std::optional<tilt_ropter::Undercarriage> undercarriage() const {
    return std::visit([](const auto& v) { return tilt_ropter::undercarriage(v); }, vehicle);
  }

  /// Returns the settings of the controller for this vehicle.
  [[nodiscard]] tilt_ropter::NmpcSettings settings() const {
    auto s = std::visit(
        [this](const auto& v) { return tilt_ropter::nmpc_settings(v, allowed_errors); }, vehicle);
    s.problem.bounds = limits;
    s.ground.planned_height = 0.0;  // as in the missions
    return s;
  }
};

/// Returns the same settings without a time limit: in a simulation, time stands still while the
/// controller computes, and the results are the same on every machine.
[[nodiscard]] inline tilt_ropter::NmpcSettings in_simulated_time(
    tilt_ropter::NmpcSettings settings) {
  settings.time_limit = std::numeric_limits<double>::infinity();
  return settings;
}

/// An invalid vehicle: the message contains file, field, value and the allowed values.
class VehicleFileError : public InputFileError {
 public:
  using InputFileError::InputFileError;
};

/// Reads and checks every field, and checks that the fields fit together: a physically possible
/// body, rotors that carry the weight, limits that allow hover. The geometry may have any rank.
/// `file` is the name in messages. Throws VehicleFileError.
[[nodiscard]] VehicleFile read_vehicle(std::istream& in, const std::string& file);
[[nodiscard]] VehicleFile read_vehicle(const std::string& path);

/// Writes a file that read_vehicle() reads, with at least 12 digits. Throws std::runtime_error if
/// the file cannot be written.
void write_vehicle(const VehicleFile& file, const std::string& path);

/// Returns the Tilt-Ropter if `path` is empty, otherwise the vehicle in this file.
[[nodiscard]] inline VehicleFile vehicle_or_default(const std::string& path) {
  return path.empty() ? VehicleFile{} : read_vehicle(path);
}

/// For programs that need four rotors. Throws VehicleFileError for any other vehicle.
[[nodiscard]] tilt_ropter::Vehicle<4> four_rotors(const VehicleFile& file);

/// Returns why the wrench level cannot control this vehicle, or an empty text: the programs contain
/// it for 4 rotors and more, and the allocation must have rank 6.
[[nodiscard]] std::string reason_against_wrench_level(const VehicleFile& file);

/// Throws VehicleFileError if the wrench level cannot control this vehicle.
void require_wrench_level(const VehicleFile& file);

/// For programs that need four rotors and the wrench level. Throws VehicleFileError for any other
/// vehicle.
[[nodiscard]] inline tilt_ropter::Vehicle<4> quadrotor(const VehicleFile& file) {
  tilt_ropter::Vehicle<4> vehicle = four_rotors(file);
  require_wrench_level(file);
  return vehicle;
}

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
