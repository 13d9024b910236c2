// Every limit of the parameters of a vehicle, by the name in the message.

#include <tilt_ropter/model/vehicle.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <string>

namespace tilt_ropter {
namespace vehicle_parts_test {

using namespace test_support;

TEST(VehicleParts, BodyNamesEachField) {
  using S = RigidBodyParameters;
  const Fields<S> check;
  check("RigidBodyParameters.mass [kg]", &S::mass, in_range(1e-6, 1e6));
  check("RigidBodyParameters.inertia", [](S& s, double v) { s.inertia(1, 1) = v; },
        {{2.0}, {2.01, -1.0, not_a_number}});
}

TEST(VehicleParts, RotorNamesEachField) {
  using S = RotorParameters;
  S valid;
  valid.thrust_coefficient = 0.5;
  valid.max_thrust = 4.0;  // the thrust begins at half of the top speed with the factor -1
  const Fields<S> check{valid};
  check("RotorParameters.thrust_coefficient [N s^2]", &S::thrust_coefficient, in_range(1e-11, 1e6));
  check("RotorParameters.torque_ratio [m]", &S::torque_ratio, in_range(0.0, 1e3));
  check("RotorParameters.min_thrust [N]", &S::min_thrust,
        {{0.0, below(4.0)}, {below(0.0), above(1e6), not_a_number}});
  check.refuse("RotorParameters.max_thrust [N]", [](S& s) { s.min_thrust = 1e6; });
  check("RotorParameters.linear_thrust_coefficient [N s]", &S::linear_thrust_coefficient,
        in_range(-1.0, 1e3));
  check("RotorParameters.time_constant [s]", &S::time_constant, in_range(1e-6, 1e3));
  check("RotorParameters.propeller_radius [m]", &S::propeller_radius, in_range(0.0, 1e3));
  check("RotorParameters.propeller_height [m]", &S::propeller_height, in_range(-1e3, 1e3));
  valid.min_thrust = 0.5;
  Fields<S>{valid}("RotorParameters.max_thrust [N]", &S::max_thrust, above_up_to(0.5, 1e6));
}

TEST(VehicleParts, RotorGeometryNamesEachField) {
  using S = RotorGeometry;
  const Fields<S> check;
  check("RotorGeometry.position [m]", &S::position, in_range(-1e3, 1e3));
  check("RotorGeometry.effectiveness", &S::effectiveness, in_range(0.0, 1.0));
  check.refuse("RotorGeometry.parameters.torque_ratio [m]", [](S& s) {
    s.parameters = RotorParameters{};
    s.parameters->torque_ratio = -1.0;
  });
  // Each of these matrices violates one condition of a rotation matrix.
  const char* name = "RotorGeometry.orientation";
  const Range most{{0.8e-6, -0.8e-6}, {1.2e-6, -1.2e-6, 0.5, -0.5}};
  const auto long_x = [](S& s, double v) {
    s.orientation.col(0) *= std::sqrt(1.0 + v);
    s.orientation.col(2) *= std::sqrt(1.0 + v);
  };
  const auto long_y = [](S& s, double v) {
    s.orientation.col(1) *= std::sqrt(1.0 + v);
    s.orientation.col(2) *= std::sqrt(1.0 + v);
  };
  const auto oblique = [](S& s, double v) {
    s.orientation.col(1) << v, std::sqrt(1.0 - v * v), 0.0;
    s.orientation(2, 2) = std::sqrt(1.0 - v * v);
  };
  check(name, long_x, most);
  check(name, long_y, most);
  check(name, oblique, most);
  check(
      name, [](S& s, double v) { s.orientation(0, 2) = v; }, most);
  check.refuse(name, [](S& s) { s.orientation *= -1.0; });  // left-handed
  expect_refused(
      name,
      [] {
        S s;
        s.orientation(2, 1) = infinite;
        validate(s);
      },
      "(1, 0, 0; 0, 1, 0; 0, inf, 1): must be finite");
}

TEST(VehicleParts, ServoNamesEachField) {
  using S = ServoParameters;
  const Fields<S> check;
  check("ServoParameters.time_constant [s]", &S::time_constant, in_range(1e-6, 1e3));
  check("ServoParameters.max_rate [rad/s]", &S::max_rate, in_range(1e-6, 1e6));
  check("ServoParameters.min_angle [rad]", &S::min_angle,
        {{-1e3, 0.0}, {below(-1e3), above(1e3), not_a_number}});
  check.refuse("ServoParameters.max_angle [rad]", [](S& s) { s.min_angle = 1e3; });
  check("ServoParameters.max_angle [rad]", &S::max_angle, above_up_to(-pi, 1e3));
  check("ServoParameters.dead_time [s]", &S::dead_time, in_range(0.0, 1e3));
}

TEST(VehicleParts, WheelsLegsAndUndercarriageNameEachField) {
  using W = WheelParameters;
  const Fields<W> wheels;
  wheels("WheelParameters.radius [m]", &W::radius, in_range(1e-6, 1e3));
  wheels("WheelParameters.half_track [m]", &W::half_track, in_range(1e-6, 1e3));
  wheels("WheelParameters.wheel_base [m]", &W::wheel_base, in_range(0.0, 1e3));
  wheels("WheelParameters.half_width [m]", &W::half_width, in_range(0.0, 1e3));
  wheels("WheelParameters.inertia [kg m^2]", &W::inertia, in_range(1e-12, 1e6));
  using L = LegParameters;
  const Fields<L> legs;
  legs("LegParameters.height [m]", &L::height, in_range(1e-6, 1e3));
  legs("LegParameters.half_length [m]", &L::half_length, in_range(1e-6, 1e3));
  legs("LegParameters.half_width [m]", &L::half_width, in_range(1e-6, 1e3));
  using U = Undercarriage;
  const Fields<U> undercarriage;
  undercarriage("Undercarriage.height [m]", &U::height, in_range(1e-6, 1e3));
  undercarriage("Undercarriage.rolling_mass [kg]", &U::rolling_mass, in_range(0.0, 1e6));
  undercarriage("Undercarriage.turning_inertia [kg m^2]", &U::turning_inertia, in_range(0.0, 1e6));
}

TEST(VehicleParts, PowerNamesEachField) {
  using S = PowerParameters;
  S valid;
  valid.electronics = 20.0;
  valid.hover = 600.0;
  const Fields<S> check{valid};
  check("PowerParameters.electronics [W]", &S::electronics,
        {{0.0, below(600.0)}, {below(0.0), above(1e9), not_a_number}});
  check.refuse("PowerParameters.hover [W]", [](S& s) { s.electronics = 1e9; });
  check("PowerParameters.hover [W]", &S::hover, above_up_to(20.0, 1e9));
  check("PowerParameters.servo_hold [W]", &S::servo_hold, in_range(0.0, 1e6));
  check("PowerParameters.servo_move [J/rad]", &S::servo_move, in_range(0.0, 1e6));
}

TEST(VehicleParts, BatteryNamesEachField) {
  using S = BatteryParameters;
  S valid;
  valid.capacity = 5.0;
  valid.full_voltage = 16.0;
  valid.empty_voltage = 0.1;
  const Fields<S> check{valid}, unknown;
  const Range nominal{{0.0, 0.1, 1e5},
                      {below(0.0), above(0.0), below(0.1), above(1e5), not_a_number}};
  check("BatteryParameters.nominal_voltage [V]", &S::nominal_voltage, nominal);
  unknown("BatteryParameters.nominal_voltage [V]", &S::nominal_voltage, nominal);
  check("BatteryParameters.capacity [A h]", &S::capacity, in_range(1e-3, 1e6));
  check("BatteryParameters.full_voltage [V]", &S::full_voltage, in_range(0.1, 1e5));
  check("BatteryParameters.empty_voltage [V]", &S::empty_voltage, in_range(0.1, 16.0));
  check("BatteryParameters.resistance [ohm]", &S::resistance, in_range(0.0, 1e3));
  // One number alone does not make a battery.
  const Range alone{{0.0}, {not_a_number, 1.0, -1.0, 1e-12}};
  unknown("BatteryParameters.capacity [A h]", &S::capacity, {{0.0}, {-1.0, 1e-12, not_a_number}});
  unknown.refuse("BatteryParameters.full_voltage [V]", [](S& s) { s.capacity = 1.0; });
  const char* capacity = "BatteryParameters.capacity [A h]";
  unknown(
      capacity, [](S& s, double v) { s.full_voltage = v; }, alone);
  unknown(
      capacity, [](S& s, double v) { s.empty_voltage = v; }, alone);
  unknown(
      capacity, [](S& s, double v) { s.resistance = v; }, alone);
}

TEST(VehicleParts, VehicleChecksAllItsParts) {
  using V = Vehicle<4>;
  const Fields<V> check{tilt_ropter_vehicle()};
  check.refuse("RigidBodyParameters.mass [kg]", [](V& v) { v.body.mass = 0.0; });
  for (std::size_t i = 0; i < 4; ++i) {
    const std::string rotor = "Vehicle.rotors[" + std::to_string(i) + "]";
    V vehicle = check.valid;
    vehicle.rotors[i].effectiveness = 2.0;
    expect_refused(
        rotor + ".effectiveness", [&] { validate(vehicle); }, "2:");
    vehicle = check.valid;
    vehicle.rotors[i].parameters = vehicle.rotor;
    vehicle.rotors[i].parameters->max_thrust = -4.0;
    expect_refused(
        rotor + ".parameters.max_thrust [N]", [&] { validate(vehicle); }, "-4:");
  }
  check.refuse("RotorParameters.time_constant [s]", [](V& v) { v.rotor.time_constant = 0.0; });
  check.refuse("ServoParameters.max_rate [rad/s]", [](V& v) { v.servo.max_rate = 0.0; });
  check.refuse("WheelParameters.radius [m]", [](V& v) { v.wheels->radius = 0.0; });
  check.refuse("Vehicle.legs", [](V& v) { v.legs = LegParameters{}; });
  check.refuse("LegParameters.height [m]", [](V& v) {
    v.wheels.reset();
    v.legs = LegParameters{};
    v.legs->height = 0.0;
  });
  check.refuse("PowerParameters.servo_move [J/rad]", [](V& v) { v.power.servo_move = -1.0; });
  check.refuse("BatteryParameters.resistance [ohm]", [](V& v) { v.battery.resistance = -1.0; });
  V with_legs = check.valid;
  with_legs.wheels->radius = -1.0;
  with_legs.wheels.reset();
  expect_accepted([&] { validate(with_legs); });
  with_legs.legs = LegParameters{};
  expect_accepted([&] { validate(with_legs); });
  check(
      "PowerParameters.hover [W]",
      [](V& v, double hover) {
        v.power.electronics = 18.0;
        v.power.servo_hold = 0.5;
        v.rotors[2].tilts = false;  // three servos
        v.power.hover = hover;
      },
      above_up_to(19.5, 1e9));
}

}  // namespace vehicle_parts_test
}  // namespace tilt_ropter
