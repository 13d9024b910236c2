// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include "input_file_error.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <iosfwd>
#include <optional>
#include <string>
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
///       "limits": { "force_max_n": [6, 6, 30] },                 fields of NmpcBounds
///       "ground": { "down_force_n": 0.75 } }                     fields of GroundContactSettings
///
/// Without `hover_w` the power of hover is estimated by the torques of the rotors, with motors of
/// 65 % efficiency.
///
/// All values are in the body frame (x forward, y left, z up) with the CoM as its origin.
/// `thrust_axis` and `arm_axis` need not be unit vectors. A rotor that does not tilt needs no
/// `arm_axis`.
///
/// `rotor` may also contain `linear_thrust_coefficient_n_s_per_rad` (default zero): thrust =
/// thrust_coefficient speed^2 + linear_thrust_coefficient speed. An entry of `rotors` may contain
/// any field of `rotor`; the value then replaces the common one for this rotor.
namespace tilt_ropter {

/// A vehicle of any number of rotors that a file may have.
using AnyVehicle = std::variant<Vehicle<2>, Vehicle<3>, Vehicle<4>, Vehicle<5>, Vehicle<6>,
                                Vehicle<7>, Vehicle<8>>;

/// Settings on the ground that a file may have. What is absent follows from the vehicle.
struct VehicleFileGround {
  /// As in GroundContactSettings [N], [N], [m/s].
  std::optional<double> down_force, rotor_thrust, settling_speed;

  /// Replaces what is there, for references that were planned for a ground at height zero.
  void apply_to(GroundContactSettings& settings) const {
    settings.planned_height = 0.0;
    settings.down_force = down_force.value_or(settings.down_force);
    settings.rotor_thrust = rotor_thrust.value_or(settings.rotor_thrust);
    settings.settling_speed = settling_speed.value_or(settings.settling_speed);
  }
};

/// Calls action(key, unit, field) for each field of AllowedErrors, with its name in a file. First
/// four of both levels of control, then four of the wrench level, then four of the actuator level,
/// which are single numbers.
template <typename Errors, typename Action>
void for_allowed_errors(Errors& e, const Action& action) {
  action("position_m", "m", e.position);
  action("velocity_mps", "m/s", e.velocity);
  action("orientation_rad", "rad", e.orientation);
  action("angular_velocity_radps", "rad/s", e.angular_velocity);
  action("force_per_weight", "times the weight", e.force);
  action("torque_per_weight_and_size", "times weight and size", e.torque);
  action("force_rate_per_weight_and_s", "times the weight, in a second", e.force_rate);
  action("torque_rate_per_weight_size_and_s", "times weight and size, in a second", e.torque_rate);
  action("thrust_per_hover_thrust", "times the thrust in hover", e.thrust);
  action("thrust_on_ground_per_hover_thrust", "times the thrust in hover", e.thrust_on_ground);
  action("thrust_rate_per_hover_thrust_and_s", "times the thrust in hover, in a second",
         e.thrust_rate);
  action("tilt_rate_radps", "rad/s", e.tilt_rate);
}

/// What a vehicle file says. By default the Tilt-Ropter.
struct VehicleFile {
  std::string name = "Tilt-Ropter";
  AnyVehicle vehicle{tilt_ropter_vehicle()};
  /// Energy of the battery [Wh]. 0: unknown. Used only if the vehicle's battery is unknown.
  double battery_wh = 0.0;
  AllowedErrors allowed_errors;
  NmpcBounds limits;
  VehicleFileGround ground;

  /// Returns the undercarriage (wheels or legs), if there is one.
  [[nodiscard]] std::optional<Undercarriage> undercarriage() const {
    return std::visit([](const auto& v) { return tilt_ropter::undercarriage(v); }, vehicle);
  }

  /// Returns the settings of Nmpc for this vehicle, with what the file says.
  [[nodiscard]] NmpcSettings settings() const {
    auto s =
        std::visit([this](const auto& v) { return nmpc_settings(v, allowed_errors); }, vehicle);
    s.problem.bounds = limits;
    ground.apply_to(s.ground);
    return s;
  }
};

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

}  // namespace tilt_ropter
