// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <string>

/// All parameters of a vehicle and of its parts (body, rotors, servos, wheels or legs, power,
/// battery), as plain data with units, and the reference vehicle.
namespace tilt_ropter {

/// Gravitational acceleration [m/s^2], the paper's value. It points along world -z.
inline constexpr double gravity = 9.81;

/// Mass and inertia of the whole vehicle, including rotors and wheels.
struct RigidBodyParameters {
  double mass = 1.0;  ///< [kg]
  Eigen::Matrix3d inertia =
      Eigen::Matrix3d::Identity();  ///< about the CoM, in the body frame [kg m^2]
};

/// Motor and propeller. The thrust at speed Omega is thrust_coefficient Omega^2 +
/// linear_thrust_coefficient Omega, see thrust_from_speed(). If the thrust of a real propeller
/// rises faster than the squared speed, the linear term is negative. The thrust then begins at the
/// speed -linear_thrust_coefficient / thrust_coefficient.
struct RotorParameters {
  double thrust_coefficient = 1.0e-6;  ///< factor of the squared speed [N s^2 / rad^2]
  double torque_ratio = 0.016;         ///< reaction torque / thrust [m]
  double min_thrust = 0.0;             ///< lower thrust limit [N]
  double max_thrust = 10.0;  ///< upper limit, at the battery's nominal voltage if it is known [N]
  double time_constant = 0.03;  ///< of the first-order lag of the speed [s]
  /// Factor of the speed, at least -sqrt(thrust_coefficient max_thrust / 2) [N s / rad]. At this
  /// lower bound the thrust begins at half of the top speed.
  double linear_thrust_coefficient = 0.0;
  double propeller_radius = 0.0;  ///< zero: unknown, its clearance is then not checked [m]
  double propeller_height = 0.0;  ///< of the propeller above the arm axis, along the thrust [m]
};

/// Rotation direction of a rotor, seen from the side to which its thrust points.
enum class Spin { counter_clockwise = 1, clockwise = -1 };

/// Mounting of a rotor. The origin of the rotor frame is the intersection of the propeller axis and
/// the arm axis; x points outward along the arm. At tilt angle alpha the thrust points along
/// (0, -sin alpha, cos alpha) in this frame.
struct RotorGeometry {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< frame origin in the body frame [m]
  Eigen::Matrix3d orientation =
      Eigen::Matrix3d::Identity();  ///< rotor frame -> body frame, a rotation matrix
  Spin spin = Spin::counter_clockwise;
  bool tilts = true;  ///< false: alpha is always zero, thrust along the rotor frame's z
  /// Thrust at a speed, and thrust limits, as a fraction of those in RotorParameters. Zero: lost.
  double effectiveness = 1.0;
  /// Motor and propeller of this rotor. Without a value the rotor uses Vehicle::rotor.
  /// rotor_parameters() returns the parameters that apply.
  std::optional<RotorParameters> parameters = std::nullopt;
};

/// Returns a rotor at the end of an arm of `length` [m] in the body's xy plane. `azimuth` [rad] is
/// the angle of the arm from body x.
[[nodiscard]] inline RotorGeometry rotor_on_arm(double azimuth, double length, Spin spin) {
  RotorGeometry rotor;
  const double c = std::cos(azimuth), s = std::sin(azimuth);
  rotor.position << length * c, length * s, 0.0;
  rotor.orientation << c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0;
  rotor.spin = spin;
  return rotor;
}

/// Servo that tilts an arm. All arms of a vehicle have the same servo.
struct ServoParameters {
  double time_constant =
      0.08;  ///< of the first-order lag of the angle (paper, Sec. External Wrench Estimation) [s]
  double max_rate = 8.0;   ///< largest rate of the angle [rad/s]
  double min_angle = -pi;  ///< lower end of the range [rad]
  double max_angle = pi;   ///< upper end of the range [rad]
  double dead_time = 0.0;  ///< time from a command to the first motion [s]
};

/// Passive wheels. Their axles are parallel to body y. All wheels are equal.
struct WheelParameters {
  double radius = 0.1;      ///< [m]
  double half_track = 0.2;  ///< distance from CoM to wheel centre along body y [m]
  /// Distance between front and rear axle, with the CoM in the middle [m]. Zero: one axle through
  /// the CoM, about which the vehicle pitches freely.
  double wheel_base = 0.0;
  double half_width = 0.015;  ///< half of the thickness of a wheel [m]
  double inertia = 4.0e-4;    ///< of one wheel about its axle [kg m^2]
  /// True: the axles are the tilting arms along -y and +y, as in the paper, Sec. Mechanical Design.
  /// The bearings then load the servos of these arms. A wheel that no such arm reaches (see
  /// axle_arm()) has its axle on the base. False: all axles are fixed to the base.
  bool on_arms = false;
};

/// Four legs with stiff feet at the corners of a rectangle under the CoM.
struct LegParameters {
  double height = 0.12;       ///< height of the CoM above the feet [m]
  double half_length = 0.15;  ///< distance from CoM to foot along body x [m]
  double half_width = 0.15;   ///< distance from CoM to foot along body y [m]
};

/// Free motions of a vehicle on the ground, on wheels or on legs. Filters and controllers use no
/// other property of wheels and legs. The ground always prevents vertical motion of the CoM, roll
/// about body x and motion along body y.
struct Undercarriage {
  double height = 0.1;  ///< height of the CoM above the ground [m]
  bool rolls = true;    ///< moves freely along body x
  bool turns = true;    ///< turns freely on the spot about body z
  bool pitches = true;  ///< turns freely about body y
  /// Inertia of the rolling wheels against a motion along body x [kg] and against a turn about
  /// body z [kg m^2], in addition to RigidBodyParameters.
  double rolling_mass = 0.0, turning_inertia = 0.0;
};

/// Electrical power of the vehicle, see PowerModel. Every rotor that tilts has a servo.
struct PowerParameters {
  double electronics = 20.0;  ///< power without rotors and servos [W]
  double hover = 600.0;       ///< total power in hover, with servos at rest [W]
  double servo_hold = 0.0;    ///< power of each servo that holds its angle [W]
  double servo_move = 0.0;    ///< additional energy of a servo per angle that it turns [J/rad]
};

/// Parameters of a Battery. The fields after nominal_voltage are all zero if it is unknown.
struct BatteryParameters {
  /// Voltage under load at which the rotors reach RotorParameters::max_thrust [V]. Zero: unknown;
  /// the voltage then has no effect.
  double nominal_voltage = 0.0;
  double capacity = 0.0;       ///< charge from full to empty [A h]
  double full_voltage = 0.0;   ///< open-circuit voltage at full charge [V]
  double empty_voltage = 0.0;  ///< open-circuit voltage at zero charge, at most full_voltage [V]
  double resistance = 0.0;     ///< of cells, leads and connectors [ohm]
};

/// Returns true if capacity and voltages of the battery are given.
[[nodiscard]] inline bool is_known(const BatteryParameters& battery) noexcept {
  return battery.capacity > 0.0;
}

/// Returns the measured `voltage` [V] divided by the nominal voltage. Returns std::nullopt if the
/// nominal voltage is unknown or the ratio is below 0.5 or above 1.5. No battery in use has such a
/// ratio, so the caller must ignore the measurement.
[[nodiscard]] inline std::optional<double> voltage_ratio(const BatteryParameters& battery,
                                                         double voltage) noexcept {
  if (!(battery.nominal_voltage > 0.0)) return std::nullopt;
  const double ratio = voltage / battery.nominal_voltage;
  return ratio >= 0.5 && ratio <= 1.5 ? std::optional<double>(ratio) : std::nullopt;
}

// Ranges wider than the values of any vehicle prevent overflow in products of two parameters.
inline void validate(const RigidBodyParameters& p) {
  require_in("RigidBodyParameters.mass [kg]", p.mass, 1e-6, 1e6);
  require_inertia("RigidBodyParameters.inertia", p.inertia);
}

inline void validate(const RotorParameters& p, const std::string& field = "RotorParameters") {
  require_in(field + ".thrust_coefficient [N s^2]", p.thrust_coefficient, 1e-11, 1e6);
  require_in(field + ".torque_ratio [m]", p.torque_ratio, 0.0, 1e3);
  require_in(field + ".min_thrust [N]", p.min_thrust, 0.0, 1e6);
  require(p.max_thrust > p.min_thrust && p.max_thrust <= 1e6, field + ".max_thrust [N]",
          p.max_thrust, "> min_thrust and <= 1e6");
  require_in(field + ".linear_thrust_coefficient [N s]", p.linear_thrust_coefficient,
             -std::sqrt(0.5 * p.thrust_coefficient * p.max_thrust), 1e3);
  require_in(field + ".time_constant [s]", p.time_constant, 1e-6, 1e3);
  require_in(field + ".propeller_radius [m]", p.propeller_radius, 0.0, 1e3);
  require_in(field + ".propeller_height [m]", p.propeller_height, -1e3, 1e3);
}

/// `field` is the name of the rotor in the message.
inline void validate(const RotorGeometry& p, const std::string& field = "RotorGeometry") {
  require(detail::all_entries(p.position, [](double x) { return std::abs(x) <= 1e3; }),
          field + ".position [m]", p.position, "in [-1000, 1000] in every entry");
  require_finite(field + ".orientation", p.orientation);
  const Eigen::Vector3d x = p.orientation.col(0), y = p.orientation.col(1);
  const double skewness = (x.cross(y) - p.orientation.col(2)).norm();
  require(std::abs(x.squaredNorm() - 1.0) <= 1e-6 && std::abs(y.squaredNorm() - 1.0) <= 1e-6 &&
              std::abs(x.dot(y)) <= 1e-6 && skewness <= 1e-6,
          field + ".orientation", p.orientation, "a rotation matrix");
  require_in(field + ".effectiveness", p.effectiveness, 0.0, 1.0);
  if (p.parameters) validate(*p.parameters, field + ".parameters");
}

inline void validate(const ServoParameters& p) {
  require_in("ServoParameters.time_constant [s]", p.time_constant, 1e-6, 1e3);
  require_in("ServoParameters.max_rate [rad/s]", p.max_rate, 1e-6, 1e6);
  require_in("ServoParameters.min_angle [rad]", p.min_angle, -1e3, 1e3);
  require(p.max_angle > p.min_angle && p.max_angle <= 1e3, "ServoParameters.max_angle [rad]",
          p.max_angle, "> min_angle and <= 1e3");
  require_in("ServoParameters.dead_time [s]", p.dead_time, 0.0, 1e3);
}

inline void validate(const WheelParameters& p) {
  require_in("WheelParameters.radius [m]", p.radius, 1e-6, 1e3);
  require_in("WheelParameters.half_track [m]", p.half_track, 1e-6, 1e3);
  require_in("WheelParameters.wheel_base [m]", p.wheel_base, 0.0, 1e3);
  require_in("WheelParameters.half_width [m]", p.half_width, 0.0, 1e3);
  require_in("WheelParameters.inertia [kg m^2]", p.inertia, 1e-12, 1e6);
}

inline void validate(const LegParameters& p) {
  require_in("LegParameters.height [m]", p.height, 1e-6, 1e3);
  require_in("LegParameters.half_length [m]", p.half_length, 1e-6, 1e3);
  require_in("LegParameters.half_width [m]", p.half_width, 1e-6, 1e3);
}

inline void validate(const Undercarriage& p) {
  require_in("Undercarriage.height [m]", p.height, 1e-6, 1e3);
  require_in("Undercarriage.rolling_mass [kg]", p.rolling_mass, 0.0, 1e6);
  require_in("Undercarriage.turning_inertia [kg m^2]", p.turning_inertia, 0.0, 1e6);
}

inline void validate(const PowerParameters& p) {
  require_in("PowerParameters.electronics [W]", p.electronics, 0.0, 1e9);
  require(p.hover > p.electronics && p.hover <= 1e9, "PowerParameters.hover [W]", p.hover,
          "> electronics and <= 1e9");
  require_in("PowerParameters.servo_hold [W]", p.servo_hold, 0.0, 1e6);
  require_in("PowerParameters.servo_move [J/rad]", p.servo_move, 0.0, 1e6);
}

inline void validate(const BatteryParameters& p) {
  require(p.nominal_voltage >= 0.0 && p.nominal_voltage <= 1e5 &&
              !(p.nominal_voltage > 0.0 && p.nominal_voltage < 0.1),
          "BatteryParameters.nominal_voltage [V]", p.nominal_voltage,
          "in [0.1, 1e5], or zero where it is not known");
  if (p.capacity == 0.0 && p.full_voltage == 0.0 && p.empty_voltage == 0.0 && p.resistance == 0.0)
    return;
  require_in("BatteryParameters.capacity [A h]", p.capacity, 1e-3, 1e6);
  require_in("BatteryParameters.full_voltage [V]", p.full_voltage, 0.1, 1e5);
  require_in("BatteryParameters.empty_voltage [V]", p.empty_voltage, 0.1, p.full_voltage);
  require_in("BatteryParameters.resistance [ohm]", p.resistance, 0.0, 1e3);
}

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

/// Returns the parameters of `rotor` (from 0): its own if it has them, otherwise the common ones.
template <int Rotors>
[[nodiscard]] const RotorParameters& rotor_parameters(const Vehicle<Rotors>& vehicle,
                                                      std::size_t rotor) noexcept {
  const std::optional<RotorParameters>& own = vehicle.rotors[rotor].parameters;
  return own ? *own : vehicle.rotor;
}

/// Calls change(parameters) for the common rotor parameters and for the own ones of each rotor.
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

/// Returns the Undercarriage of wheels or legs, or std::nullopt without wheels and legs.
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
