#pragma once

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <iosfwd>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <variant>

/// A vehicle of one's own as a JSON file: every parameter by name, the unit in the name.
///
///     { "name": "my vehicle",
///       "body": { "mass_kg": 1.5,
///                 "inertia_kg_m2": [0.014, 0.014, 0.025] },  or three rows of three
///       "rotor": { "thrust_coefficient_n_s2_per_rad2": 1.4e-6, "torque_ratio_m": 0.016,
///                  "min_thrust_n": 0, "max_thrust_n": 12, "time_constant_s": 0.03 },
///       "servo": { "time_constant_s": 0.08, "max_rate_radps": 8, "min_angle_deg": -180,
///                  "max_angle_deg": 180, "dead_time_s": 0 },
///       "rotors": [ { "azimuth_deg": -90, "length_m": 0.17,      on an arm in the plane of the
///       CoM,
///                     "spin": "counter_clockwise", "tilts": true },
///                   { "position_m": [0.1, 0.1, 0.1],             or anywhere
///                     "thrust_axis": [0, 0, 1],                  of the thrust at zero tilt
///                     "arm_axis": [1, 0, 0],                     that the servo turns it about
///                     "spin": "clockwise", "tilts": true } ],    4, 6 or 8 of them
///       "power": { "electronics_w": 20, "hover_w": 653.64 },
///
///                                                                optional from here on
///       "wheels": { "radius_m": 0.11, "half_track_m": 0.2,       without wheels and legs it
///                   "wheel_base_m": 0 },                         stays in the air
///       "legs": { "height_m": 0.12, "half_length_m": 0.15,       instead of wheels
///                 "half_width_m": 0.15 },
///       "battery_wh": 100,
///       "battery_nominal_v": 22.2,      under load, at which the rotors reach max_thrust_n
///       "allowed_errors": { "position_m": [0.13, 0.13, 0.11] },  any of AllowedErrors
///       "limits": { "force_max_n": [6, 6, 30] } }                any of NmpcBounds
///
/// All in the body frame, x forward, y left, z up, from the CoM. `thrust_axis` and `arm_axis` need
/// not have length one; a rotor that does not tilt needs no `arm_axis`.
///
/// `rotor` may also hold `linear_thrust_coefficient_n_s_per_rad`, zero by default: thrust =
/// thrust_coefficient speed^2 + linear_thrust_coefficient speed. An entry of `rotors` may hold any
/// field of `rotor`, which holds for this rotor instead of the common one.
namespace examples {

using AnyVehicle =
    std::variant<tilt_ropter::Vehicle<4>, tilt_ropter::Vehicle<6>, tilt_ropter::Vehicle<8>>;

struct VehicleFile {
  std::string name = "Tilt-Ropter";
  AnyVehicle vehicle = tilt_ropter::tilt_ropter_vehicle();
  double battery_wh = 0.0;  ///< 0: not known
  tilt_ropter::AllowedErrors allowed_errors;
  tilt_ropter::NmpcBounds limits;

  /// What the vehicle stands on.
  [[nodiscard]] std::optional<tilt_ropter::Undercarriage> undercarriage() const {
    return std::visit([](const auto& v) { return tilt_ropter::undercarriage(v); }, vehicle);
  }

  /// The controller's settings for this vehicle.
  [[nodiscard]] tilt_ropter::NmpcSettings settings() const {
    auto s = std::visit(
        [this](const auto& v) { return tilt_ropter::nmpc_settings(v, allowed_errors); }, vehicle);
    s.problem.bounds = limits;
    s.ground.planned_height = 0.0;  // as the missions have it
    return s;
  }
};

/// The same without a limit on time: in a simulation it stands still while the controller computes,
/// and results are the same on every machine.
[[nodiscard]] inline tilt_ropter::NmpcSettings in_simulated_time(
    tilt_ropter::NmpcSettings settings) {
  settings.time_limit = std::numeric_limits<double>::infinity();
  return settings;
}

/// A vehicle that cannot be: the message names file, field, value and what is allowed.
class VehicleFileError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Reads and checks every field, and whether they fit together: a body that can exist, a geometry
/// that gives every wrench, rotors that carry the weight, limits that hold it. `file` is what
/// messages call it. Throws VehicleFileError.
[[nodiscard]] VehicleFile read_vehicle(std::istream& in, const std::string& file);
[[nodiscard]] VehicleFile read_vehicle(const std::string& path);

/// Writes what read_vehicle() takes, to at least 12 digits. Throws std::runtime_error if it cannot.
void write_vehicle(const VehicleFile& file, const std::string& path);

/// The Tilt-Ropter where `path` is empty.
[[nodiscard]] inline VehicleFile vehicle_or_default(const std::string& path) {
  return path.empty() ? VehicleFile{} : read_vehicle(path);
}

/// For programs that take four rotors. Throws VehicleFileError on others.
[[nodiscard]] tilt_ropter::Vehicle<4> quadrotor(const VehicleFile& file);

}  // namespace examples
