// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle_parts.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <string>

/// All parameters of a vehicle, as plain data with units, and the reference vehicle.
namespace tilt_ropter {

/// All parameters of a vehicle with `Rotors` arms, tilting or fixed.
template <int Rotors>
struct Vehicle {
  RigidBodyParameters body;
  std::array<RotorGeometry, static_cast<std::size_t>(Rotors)> rotors;
  RotorParameters rotor;  ///< of every rotor without RotorGeometry::parameters
  ServoParameters servo;
  std::optional<WheelParameters> wheels;  ///< none: legs instead, or never on the ground
  std::optional<LegParameters> legs;      ///< allowed only without wheels
  PowerParameters power;
  BatteryParameters battery;
};

/// Returns the parameters of `rotor` (from 0): its own parameters if it has them, otherwise the
/// common parameters.
template <int Rotors>
[[nodiscard]] const RotorParameters& rotor_parameters(const Vehicle<Rotors>& vehicle,
                                                      std::size_t rotor) noexcept {
  const std::optional<RotorParameters>& own = vehicle.rotors[rotor].parameters;
  return own ? *own : vehicle.rotor;
}

/// Calls change(parameters) for the common rotor parameters and for the own parameters of each
/// rotor that has them. Example: reduce the thrust of every rotor.
template <int Rotors, typename Change>
void change_rotor_parameters(Vehicle<Rotors>& vehicle, const Change& change) {
  change(vehicle.rotor);
  for (RotorGeometry& rotor : vehicle.rotors)
    if (rotor.parameters) change(*rotor.parameters);
}

/// Returns the largest max_thrust of all rotors [N]. Ignores their effectiveness.
template <int Rotors>
[[nodiscard]] double largest_max_thrust(const Vehicle<Rotors>& vehicle) noexcept {
  double largest = 0.0;
  for (std::size_t i = 0; i < Rotors; ++i)
    largest = std::max(largest, rotor_parameters(vehicle, i).max_thrust);
  return largest;
}

/// Returns the number of rotors that tilt. Each of them has a servo.
template <int Rotors>
[[nodiscard]] int servo_count(const Vehicle<Rotors>& vehicle) noexcept {
  int count = 0;
  for (const RotorGeometry& rotor : vehicle.rotors) count += rotor.tilts ? 1 : 0;
  return count;
}

/// Returns the arm (rotor from 0) that is the axle of `wheel` (from 0, even: right): an arm that
/// points along body y to the wheel's side, with the rotor between the CoM and the wheel, and
/// passes the CoM within 5 cm. Returns std::nullopt if the axle is fixed to the base, if there is
/// no such arm, or if the vehicle has two axles.
template <int Rotors>
[[nodiscard]] std::optional<std::size_t> axle_arm(const Vehicle<Rotors>& vehicle,
                                                  std::size_t wheel) noexcept {
  if (!vehicle.wheels || !vehicle.wheels->on_arms || vehicle.wheels->wheel_base > 0.0)
    return std::nullopt;
  const double side = wheel % 2 == 0 ? -1.0 : 1.0;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[i];
    const double out = side * rotor.position.y();
    if (side * rotor.orientation(1, 0) > 1.0 - 1e-9 && out > 0.0 &&
        out < vehicle.wheels->half_track && std::abs(rotor.position.x()) <= 0.05 &&
        std::abs(rotor.position.z()) <= 0.05)
      return i;
  }
  return std::nullopt;
}

/// Throws std::invalid_argument with the field, its value and the allowed values. Does not check
/// whether the geometry can give every wrench; Allocation checks this by the rank of its matrix.
template <int Rotors>
void validate(const Vehicle<Rotors>& vehicle) {
  validate(vehicle.body);
  for (int i = 0; i < Rotors; ++i)
    validate(vehicle.rotors[static_cast<std::size_t>(i)],
             "Vehicle.rotors[" + std::to_string(i) + "]");
  validate(vehicle.rotor);
  validate(vehicle.servo);
  if (vehicle.wheels) validate(*vehicle.wheels);
  if (vehicle.legs) validate(*vehicle.legs);
  require(!(vehicle.wheels && vehicle.legs), "Vehicle.legs", "given",
          "absent for a vehicle with wheels");
  validate(vehicle.power);
  const double at_rest =
      vehicle.power.electronics + servo_count(vehicle) * vehicle.power.servo_hold;
  require(vehicle.power.hover > at_rest, "PowerParameters.hover [W]", vehicle.power.hover,
          "> electronics and servos at rest");
  validate(vehicle.battery);
}

/// Returns the Undercarriage of the vehicle's wheels or legs, or std::nullopt without wheels and
/// legs.
template <int Rotors>
[[nodiscard]] std::optional<Undercarriage> undercarriage(const Vehicle<Rotors>& vehicle) noexcept {
  if (vehicle.wheels) {
    const WheelParameters& wheels = *vehicle.wheels;
    const bool one_axle = wheels.wheel_base == 0.0;
    Undercarriage stands{wheels.radius, true, one_axle, one_axle};
    stands.rolling_mass = (one_axle ? 2.0 : 4.0) * wheels.inertia / (wheels.radius * wheels.radius);
    stands.turning_inertia = stands.rolling_mass * wheels.half_track * wheels.half_track;
    return stands;
  }
  if (vehicle.legs) return Undercarriage{vehicle.legs->height, false, false, false};
  return std::nullopt;
}

/// Returns the vehicle with the servo of `rotor` (from 0) stuck at `angle` [rad]. Allocation and
/// controller then use a rotor that does not tilt, in a rotor frame that is tilted by `angle`.
/// Throws std::out_of_range if the vehicle has no such rotor.
template <int Rotors>
[[nodiscard]] Vehicle<Rotors> with_stuck_servo(Vehicle<Rotors> vehicle, std::size_t rotor,
                                               double angle) {
  RotorGeometry& stuck = vehicle.rotors.at(rotor);
  const double c = std::cos(angle), s = std::sin(angle);
  Eigen::Matrix3d turn;
  turn << 1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c;
  stuck.orientation = (stuck.orientation * turn).eval();
  stuck.tilts = false;
  return vehicle;
}

/// Returns the vehicle with the thrust of `rotor` (from 0) multiplied by `effectiveness`, a
/// fraction in [0, 1]. Examples: 0.5 for a broken blade, 0 for a lost rotor. Throws
/// std::out_of_range if the vehicle has no such rotor.
template <int Rotors>
[[nodiscard]] Vehicle<Rotors> with_weak_rotor(Vehicle<Rotors> vehicle, std::size_t rotor,
                                              double effectiveness) {
  vehicle.rotors.at(rotor).effectiveness *= effectiveness;
  return vehicle;
}

/// The Tilt-Ropter of the paper: a plus frame numbered like PX4's "Quad +", 1 right (-y), 2 left
/// (+y), 3 front (+x), 4 back (-x). Rotors 1 and 2 turn counter-clockwise seen from above, and
/// their arms are the axles of the wheels. A comment marks each value as the paper's value or as
/// our estimate. The inertia is above the sum of the parts in the paper's component table and of
/// frame, arms and wheels at estimated places (tests/model/component_inertia_test.cpp), which is
/// 0.013, 0.0075, 0.0185 kg m^2.
[[nodiscard]] inline Vehicle<4> tilt_ropter_vehicle() {
  Vehicle<4> v;
  v.body.mass = 1.5;  // paper, Sec. Hardware System Design
  v.body.inertia = Eigen::Vector3d(0.014, 0.014, 0.025).asDiagonal();  // estimate
  const double arm = 0.17;                                             // estimate
  v.rotors = {rotor_on_arm(-pi / 2, arm, Spin::counter_clockwise),  // paper, Sec. Frame Definition
              rotor_on_arm(pi / 2, arm, Spin::counter_clockwise),   // paper
              rotor_on_arm(0.0, arm, Spin::clockwise),              // paper
              rotor_on_arm(pi, arm, Spin::clockwise)};              // paper
  v.rotor.thrust_coefficient = 1.4e-6;                              // estimate
  v.rotor.torque_ratio = 0.016;                                     // estimate
  v.rotor.min_thrust = 0.0;                                         // estimate
  v.rotor.max_thrust = 12.0;                                        // estimate
  v.rotor.time_constant = 0.03;                                     // estimate
  v.servo.time_constant = 0.08;                                     // estimate
  v.servo.max_rate = 8.0;                                           // estimate
  v.servo.min_angle = -pi;                                          // estimate
  v.servo.max_angle = pi;                                           // estimate
  v.servo.dead_time = 0.0;                                          // estimate
  v.rotor.propeller_radius = 0.0648;                                // paper: Foxeer 5145, 5.1 inch
  v.rotor.propeller_height = 0.034;                                 // estimate
  WheelParameters wheels;
  wheels.radius = 0.11;       // estimate
  wheels.half_track = 0.26;   // estimate: the propellers pass the wheels at a distance of 1 cm
  wheels.half_width = 0.015;  // estimate
  wheels.inertia = 4.0e-4;    // estimate: rims of 40 g, a third less than in a ring
  wheels.on_arms = true;      // paper, Sec. Mechanical Design
  v.wheels = wheels;
  // Electronics and four servos at rest take 20 W; only the range 15 to 40 W is known.
  v.power.electronics = 18.0;  // estimate
  v.power.servo_hold = 0.5;    // estimate
  v.power.servo_move = 0.3;    // estimate
  v.power.hover = 653.64;      // paper, Sec. Energy Efficiency
  v.battery.capacity = 5.3;    // paper, Sec. Hardware System Design
  // The paper's battery weighs 485 g. With four cells of nominally 3.7 V that is 162 W h/kg, usual
  // for a lithium-polymer pack of 45C. Five cells would need 202 W h/kg and six 243 W h/kg, which
  // such packs do not reach; three cells would have 121 W h/kg.
  v.battery.full_voltage = 16.8;   // estimate: four cells of 4.2 V
  v.battery.empty_voltage = 13.2;  // estimate: four cells of 3.3 V
  v.battery.resistance = 0.012;    // estimate: 3 mOhm per cell, with leads
  // A full battery sags to about this voltage at the full thrust of all rotors.
  v.battery.nominal_voltage = 13.2;  // estimate
  return v;
}

}  // namespace tilt_ropter
