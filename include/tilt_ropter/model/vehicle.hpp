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

/// What the vehicle is: every parameter of it, plain data with units, and the reference vehicle.
namespace tilt_ropter {

/// Acceleration of gravity [m/s^2], the paper's; it points along world -z.
inline constexpr double gravity = 9.81;

/// Of the whole vehicle, with rotors and wheels.
struct RigidBodyParameters {
  double mass = 1.0;  ///< [kg]
  Eigen::Matrix3d inertia =
      Eigen::Matrix3d::Identity();  ///< about the CoM, in the body frame [kg m^2]
};

/// Motor and propeller. The thrust at speed Omega is
///
///     T = thrust_coefficient Omega^2 + linear_thrust_coefficient Omega,
///
/// and zero where that is negative. Without the linear term it is the paper's law. Where the thrust
/// of a real propeller rises faster than the square of the speed, the linear term is negative; the
/// thrust begins at the speed -linear_thrust_coefficient / thrust_coefficient then. Where it rises
/// slower, the linear term is positive.
struct RotorParameters {
  double thrust_coefficient = 1.0e-6;  ///< of the speed's square [N s^2 / rad^2]
  double torque_ratio = 0.016;         ///< reaction torque / thrust [m]
  double min_thrust = 0.0;             ///< [N]
  double max_thrust = 10.0;            ///< at the battery's nominal voltage, if that is known [N]
  double time_constant = 0.03;         ///< of the speed's first-order lag [s]
  /// Of the speed, at least -sqrt(thrust_coefficient max_thrust / 2): the thrust begins at half of
  /// the top speed there [N s / rad].
  double linear_thrust_coefficient = 0.0;
};

/// Direction in which a rotor turns, seen from where its thrust points to.
enum class Spin { counter_clockwise = 1, clockwise = -1 };

/// Where a rotor sits. Its frame has its origin where the propeller's axis meets the arm's, x along
/// the arm outward; at tilt angle alpha the thrust points along (0, -sin alpha, cos alpha) there.
struct RotorGeometry {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< origin in the body frame [m]
  Eigen::Matrix3d orientation =
      Eigen::Matrix3d::Identity();  ///< rotor frame -> body frame, a rotation matrix
  Spin spin = Spin::counter_clockwise;
  bool tilts = true;  ///< false: alpha is always zero, thrust along the rotor frame's z
  /// Share of RotorParameters' thrust that the rotor gives at a speed, and of its limits; 0: it is
  /// lost.
  double effectiveness = 1.0;
  /// This rotor's own motor and propeller. Without a value the rotor has those of Vehicle::rotor;
  /// rotor_parameters() returns the ones that hold.
  std::optional<RotorParameters> parameters = std::nullopt;
};

/// A rotor at the end of an arm of `length` [m] in the body's xy plane at `azimuth` [rad] from x.
[[nodiscard]] inline RotorGeometry rotor_on_arm(double azimuth, double length, Spin spin) {
  RotorGeometry rotor;
  const double c = std::cos(azimuth), s = std::sin(azimuth);
  rotor.position << length * c, length * s, 0.0;
  rotor.orientation << c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0;
  rotor.spin = spin;
  return rotor;
}

/// Servo that tilts an arm; the same for all arms of a vehicle.
struct ServoParameters {
  double time_constant =
      0.08;  ///< of the angle's first-order lag (paper, Sec. External Wrench Estimation) [s]
  double max_rate = 8.0;   ///< [rad/s]
  double min_angle = -pi;  ///< [rad]
  double max_angle = pi;   ///< [rad]
  double dead_time = 0.0;  ///< from command to first motion [s]
};

/// Passive wheels that turn about axes along body y.
struct WheelParameters {
  double radius = 0.1;      ///< [m]
  double half_track = 0.2;  ///< CoM to wheel centre along body y [m]
  /// Distance between a front and a rear axle with the CoM in the middle. Zero: one axle through
  /// the CoM, on which the vehicle pitches freely [m].
  double wheel_base = 0.0;
};

/// Four legs with stiff feet, at the corners of a rectangle under the CoM.
struct LegParameters {
  double height = 0.12;       ///< of the CoM above the feet [m]
  double half_length = 0.15;  ///< CoM to foot along body x [m]
  double half_width = 0.15;   ///< CoM to foot along body y [m]
};

/// How a vehicle on the ground can still move, whatever it stands on. Filters and controllers know
/// nothing else of wheels and legs. The ground always holds the CoM's height, the roll about body x
/// and the way along body y.
struct Undercarriage {
  double height = 0.1;  ///< of the CoM above the ground [m]
  bool rolls = true;    ///< moves along body x
  bool turns = true;    ///< turns on the spot about body z
  bool pitches = true;  ///< turns freely about body y
};

/// Electrical power P = electronics + c sum Omega^3, with c such that hover takes `hover`.
struct PowerParameters {
  double electronics = 20.0;  ///< drawn without any thrust [W]
  double hover = 600.0;       ///< total in hover [W]
};

/// Source of the rotors' power.
struct BatteryParameters {
  /// Voltage under load at which the rotors reach RotorParameters::max_thrust [V]. Zero: not known,
  /// and the voltage plays no part.
  double nominal_voltage = 0.0;
};

/// All that is known of a vehicle with `Rotors` arms, tilting or not.
template <int Rotors>
struct Vehicle {
  RigidBodyParameters body;
  std::array<RotorGeometry, static_cast<std::size_t>(Rotors)> rotors;
  RotorParameters rotor;  ///< of every rotor without parameters of its own
  ServoParameters servo;
  std::optional<WheelParameters> wheels;  ///< none: it has legs or never touches the ground
  std::optional<LegParameters> legs;      ///< only without wheels
  PowerParameters power;
  BatteryParameters battery;
};

/// Motor and propeller of `rotor` (from 0): its own, or those that are common to all.
template <int Rotors>
[[nodiscard]] const RotorParameters& rotor_parameters(const Vehicle<Rotors>& vehicle,
                                                      std::size_t rotor) noexcept {
  const std::optional<RotorParameters>& own = vehicle.rotors[rotor].parameters;
  return own ? *own : vehicle.rotor;
}

/// Calls change(parameters) for the common rotor parameters and for those of each rotor that has
/// its own, as where every rotor gives less thrust.
template <int Rotors, typename Change>
void change_rotor_parameters(Vehicle<Rotors>& vehicle, const Change& change) {
  change(vehicle.rotor);
  for (RotorGeometry& rotor : vehicle.rotors)
    if (rotor.parameters) change(*rotor.parameters);
}

/// Largest max_thrust of all rotors, with their effectiveness left aside [N].
template <int Rotors>
[[nodiscard]] double largest_max_thrust(const Vehicle<Rotors>& vehicle) noexcept {
  double largest = 0.0;
  for (std::size_t i = 0; i < Rotors; ++i)
    largest = std::max(largest, rotor_parameters(vehicle, i).max_thrust);
  return largest;
}

/// Measured voltage [V] over the nominal voltage. Nothing where the nominal voltage is not known.
/// No battery in use has less than half or more than 1.5 times its nominal voltage, so such a
/// measurement gives nothing, too, and has to be ignored.
[[nodiscard]] inline std::optional<double> voltage_ratio(const BatteryParameters& battery,
                                                         double voltage) noexcept {
  if (!(battery.nominal_voltage > 0.0)) return std::nullopt;
  const double ratio = voltage / battery.nominal_voltage;
  return ratio >= 0.5 && ratio <= 1.5 ? std::optional<double>(ratio) : std::nullopt;
}

// The ranges are beyond any vehicle. Without them products of two parameters can overflow.
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
  // At the lower end the thrust begins at half of the top speed.
  require_in(field + ".linear_thrust_coefficient [N s]", p.linear_thrust_coefficient,
             -std::sqrt(0.5 * p.thrust_coefficient * p.max_thrust), 1e3);
  require_in(field + ".time_constant [s]", p.time_constant, 1e-6, 1e3);
}

/// `field` is what the message calls the rotor.
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
}

inline void validate(const LegParameters& p) {
  require_in("LegParameters.height [m]", p.height, 1e-6, 1e3);
  require_in("LegParameters.half_length [m]", p.half_length, 1e-6, 1e3);
  require_in("LegParameters.half_width [m]", p.half_width, 1e-6, 1e3);
}

inline void validate(const Undercarriage& p) {
  require_in("Undercarriage.height [m]", p.height, 1e-6, 1e3);
}

inline void validate(const PowerParameters& p) {
  require_in("PowerParameters.electronics [W]", p.electronics, 0.0, 1e9);
  require(p.hover > p.electronics && p.hover <= 1e9, "PowerParameters.hover [W]", p.hover,
          "> electronics and <= 1e9");
}

inline void validate(const BatteryParameters& p) {
  require(p.nominal_voltage >= 0.0 && p.nominal_voltage <= 1e5 &&
              !(p.nominal_voltage > 0.0 && p.nominal_voltage < 0.1),
          "BatteryParameters.nominal_voltage [V]", p.nominal_voltage,
          "in [0.1, 1e5], or zero where it is not known");
}

/// Throws std::invalid_argument naming the field, its value and what is allowed. Whether the
/// geometry can give every wrench is for Allocation to say, which needs its rank.
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
  validate(vehicle.battery);
}

/// That of the vehicle's wheels or legs; none without either.
template <int Rotors>
[[nodiscard]] std::optional<Undercarriage> undercarriage(const Vehicle<Rotors>& vehicle) noexcept {
  if (vehicle.wheels) {
    const bool one_axle = vehicle.wheels->wheel_base == 0.0;
    return Undercarriage{vehicle.wheels->radius, true, one_axle, one_axle};
  }
  if (vehicle.legs) return Undercarriage{vehicle.legs->height, false, false, false};
  return std::nullopt;
}

/// The same vehicle with the servo of `rotor` (from 0) stuck at `angle` [rad]: to allocation and
/// controller a rotor that does not tilt, in a frame that does. Throws std::out_of_range.
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

/// The same vehicle with `rotor` (from 0) giving the share `effectiveness`, in [0, 1], of the
/// thrust that it gave: 0.5 a broken blade, 0 a rotor lost. Throws std::out_of_range.
template <int Rotors>
[[nodiscard]] Vehicle<Rotors> with_weak_rotor(Vehicle<Rotors> vehicle, std::size_t rotor,
                                              double effectiveness) {
  vehicle.rotors.at(rotor).effectiveness *= effectiveness;
  return vehicle;
}

/// The Tilt-Ropter of the paper: a plus frame numbered like PX4's "Quad +", 1 right (-y), 2 left
/// (+y), 3 front (+x), 4 back (-x). Rotors 1 and 2 turn counter-clockwise seen from above and their
/// arms carry the wheels. Each value is marked as the paper's or as our estimate.
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
  v.wheels = {0.11, 0.20};                                          // estimate
  v.power.electronics = 20.0;  // estimate; known only to lie between 15 and 40
  v.power.hover = 653.64;      // paper, Sec. Energy Efficiency
  return v;
}

}  // namespace tilt_ropter
