// Every limit of the settings and constructors of actuators and allocation, by the name in the
// message.

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/actuation/servo.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cstddef>
#include <string>

namespace tilt_ropter {
namespace actuation_settings_test {

using namespace test_support;

// Expects that `construct` names the field of the vehicle that `spoil` sets.
void expect_vehicle_refused(const char* field, void (*spoil)(Vehicle<4>&),
                            void (*construct)(const Vehicle<4>&)) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  expect_accepted([&] { construct(vehicle); });
  spoil(vehicle);
  expect_refused(field, [&] { construct(vehicle); });
}

void spoil_mass(Vehicle<4>& v) {
  v.body.mass = 0.0;
}
void spoil_servo(Vehicle<4>& v) {
  v.servo.max_rate = 0.0;
}
void spoil_rotor(Vehicle<4>& v) {
  v.rotor.time_constant = 0.0;
}
void spoil_last_rotor(Vehicle<4>& v) {
  v.rotors[3].parameters = v.rotor;
  v.rotors[3].parameters->time_constant = 0.0;
}
void spoil_battery(Vehicle<4>& v) {
  v.battery.resistance = -1.0;
}

const char* const mass = "RigidBodyParameters.mass [kg]";
const char* const servo = "ServoParameters.max_rate [rad/s]";
const char* const rotor = "RotorParameters.time_constant [s]";
const char* const battery = "BatteryParameters.resistance [ohm]";

TEST(ActuationSettings, AllocationNamesEachField) {
  using S = AllocationSettings;
  const Fields<S> check;
  check("AllocationSettings.hold_thrust [N]", &S::hold_thrust, positive());
  check("AllocationSettings.lag_compensation", &S::lag_compensation, in_range(0.0, 1.0));
}

TEST(ActuationSettings, AllocationNeedsEachPriorityOnce) {
  const auto check = [](int a, int b, int c, int d) {
    const auto group = [](int index) { return static_cast<WrenchGroup>(index); };
    AllocationSettings s;
    s.priorities = {group(a), group(b), group(c), group(d)};
    validate(s);
  };
  expect_accepted([&] { check(3, 2, 1, 0); });
  expect_accepted([&] { check(1, 0, 3, 2); });
  const std::string name = "AllocationSettings.priorities";
  expect_refused(
      name, [&] { check(0, 1, 2, 1); }, "0, 1, 2, 1: must be level (0)");
  expect_refused(name, [&] { check(3, 3, 3, 3); });
  expect_refused(name, [&] { check(0, 1, 2, 4); });
  expect_refused(name, [&] { check(-1, 0, 1, 2); });
}

TEST(ActuationSettings, AllocationChecksVehicleAndSettings) {
  const auto construct = [](const Vehicle<4>& v) { Allocation<4>{v}; };
  expect_vehicle_refused(mass, spoil_mass, construct);
  expect_vehicle_refused(servo, spoil_servo, construct);
  AllocationSettings settings;
  settings.hold_thrust = 0.0;
  expect_refused("AllocationSettings.hold_thrust [N]",
                 [&] { Allocation<4>(tilt_ropter_vehicle(), settings); });
}

TEST(ActuationSettings, OutputScalingNamesEachField) {
  using S = ActuatorOutputSettings<4>;
  const Fields<S> check;
  check("ActuatorOutputSettings.thrust_model_factor", &S::thrust_model_factor, in_range(0.0, 1.0));
  check("ActuatorOutputSettings.autopilot_factor", &S::autopilot_factor, in_range(0.0, 1.0));
  const char* trim = "ServoOutputParameters.trim";
  check(
      trim, [](S& s, double v) { s.servos[0].trim = v; }, in_range(-1.0, 1.0));
  check(
      trim, [](S& s, double v) { s.servos[3].trim = v; }, in_range(-1.0, 1.0));
  S settings;
  settings.servos[1].trim = 2.0;
  expect_refused(trim, [&] { OutputScaling<4>(tilt_ropter_vehicle(), settings); });
  const auto construct = [](const Vehicle<4>& v) { OutputScaling<4>{v}; };
  expect_vehicle_refused(servo, spoil_servo, construct);
  expect_vehicle_refused(rotor, spoil_rotor, construct);
  expect_vehicle_refused(rotor, spoil_last_rotor, construct);
  expect_vehicle_refused(battery, spoil_battery, construct);
}

TEST(ActuationSettings, ModelsCheckTheVehicle) {
  expect_vehicle_refused(servo, spoil_servo, [](const Vehicle<4>& v) { FailureDetector<4>{v}; });
  expect_vehicle_refused(servo, spoil_servo, [](const Vehicle<4>& v) { ActuatedBody<4>{v}; });
  const auto construct = [](const Vehicle<4>& v) { ActuatorModel<4>{v}; };
  expect_vehicle_refused(battery, spoil_battery, construct);
  expect_vehicle_refused(servo, spoil_servo, construct);
  expect_vehicle_refused(rotor, spoil_last_rotor, construct);
  expect_vehicle_refused(servo, spoil_servo,
                         [](const Vehicle<4>& v) { (void)control_authority(v); });
  Vehicle<4> point = tilt_ropter_vehicle();  // of rank below 6
  for (RotorGeometry& geometry : point.rotors) geometry.position.setZero();
  expect_accepted([&] { (void)control_authority(point); });
  point.body.mass = -1.0;
  expect_refused(mass, [&] { (void)control_authority(point); });
  expect_vehicle_refused(rotor, spoil_rotor, [](const Vehicle<4>& v) { Rotord{v.rotor}; });
  expect_vehicle_refused(servo, spoil_servo, [](const Vehicle<4>& v) { Servod{v.servo}; });
}

TEST(ActuationSettings, BatteryNamesItsArguments) {
  const BatteryParameters valid = tilt_ropter_vehicle().battery;
  expect_range("Battery: state of charge", in_range(0.0, 1.0), true,
               [&](double charge) { Battery(valid, charge); });
  expect_refused(
      "BatteryParameters.capacity [A h]", [] { Battery{BatteryParameters{}}; }, "0: must be known");
  expect_vehicle_refused(battery, spoil_battery, [](const Vehicle<4>& v) { Battery{v.battery}; });
}

TEST(ActuationSettings, PowerModelNamesItsArguments) {
  const auto construct = [](const Vehicle<4>& v) { PowerModel{v}; };
  expect_vehicle_refused(mass, spoil_mass, construct);
  expect_vehicle_refused(rotor, spoil_rotor, construct);
  expect_vehicle_refused(rotor, spoil_last_rotor, construct);
  expect_vehicle_refused(
      "PowerParameters.servo_move [J/rad]", [](Vehicle<4>& v) { v.power.servo_move = -1.0; },
      construct);
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.power.electronics = 18.0;
  vehicle.power.servo_hold = 0.5;
  const Eigen::Vector4d hover = Eigen::Vector4d::Constant(1000.0);
  expect_range(
      "PowerModel: speeds in hover [rad/s]", {{0.0, 1.0}, {-1.0, not_a_number, infinite}}, false,
      [&](double speed) { PowerModel(vehicle, Eigen::Vector4d(1000.0, 1000.0, speed, 1000.0)); });
  expect_range("PowerParameters.hover [W]", {{above(20.0)}, {20.0, 19.0}}, true, [&](double watts) {
    Vehicle<4> other = vehicle;
    other.power.hover = watts;
    PowerModel(other, hover);
  });
  vehicle.power.hover = 21.0;  // 1 W for one rotor
  expect_range("PowerModel's coefficient [W s^3]", {{3e-67}, {2e-67, 0.0}}, false,
               [&](double speed) { PowerModel(vehicle, Eigen::Vector4d(speed, 0.0, 0.0, 0.0)); });
}

}  // namespace actuation_settings_test
}  // namespace tilt_ropter
