#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <functional>
#include <limits>
#include <string>
#include <vector>

namespace {

using namespace tilt_ropter;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

struct Rejection {
  std::string field;
  std::string value;
  std::function<void(Vehicle<4>&)> spoil;
};

LegParameters& stand_on_legs(Vehicle<4>& v) {
  v.wheels.reset();
  return v.legs.emplace();
}

TEST(Vehicle, UndercarriageFollowsWheelsAndLegs) {
  Vehicle<4> v = tilt_ropter_vehicle();
  const auto axle = undercarriage(v);
  ASSERT_TRUE(axle);
  EXPECT_EQ(axle->height, v.wheels->radius);
  EXPECT_TRUE(axle->rolls && axle->pitches);
  EXPECT_NEAR(axle->rolling_mass, 2.0 * 4e-4 / (0.11 * 0.11), 1e-12);
  EXPECT_NEAR(axle->turning_inertia, axle->rolling_mass * 0.26 * 0.26, 1e-12);
  v.wheels->on_arms = false;
  v.wheels->wheel_base = 0.3;
  EXPECT_NEAR(undercarriage(v)->rolling_mass, 2.0 * axle->rolling_mass, 1e-12);
  EXPECT_TRUE(undercarriage(v)->rolls && !undercarriage(v)->pitches);
  stand_on_legs(v).height = 0.2;
  EXPECT_EQ(undercarriage(v)->height, 0.2);
  EXPECT_FALSE(undercarriage(v)->rolls || undercarriage(v)->pitches);
  v.legs.reset();
  EXPECT_FALSE(undercarriage(v));
  EXPECT_NO_THROW(validate(v));
  EXPECT_THROW(validate(Undercarriage{0.0, true, true, true}), std::invalid_argument);
}

// Paper, Sec. Mechanical Design: the arms of rotors 1 and 2 are the axles.
TEST(Vehicle, WheelsOfTheReferenceVehicleSitOnItsArms) {
  Vehicle<4> v = tilt_ropter_vehicle();
  EXPECT_EQ(axle_arm(v, 0), 0U);
  EXPECT_EQ(axle_arm(v, 1), 1U);
  const Vehicle<4> stuck = with_stuck_servo(v, 1, 0.4);
  EXPECT_NO_THROW(validate(stuck));
  EXPECT_EQ(axle_arm(stuck, 1), 1U);
  // The CoM may be beside the axle.
  Vehicle<4> shifted = v;
  for (RotorGeometry& rotor : shifted.rotors) rotor.position += Eigen::Vector3d(0.01, -0.01, 0.01);
  EXPECT_NO_THROW(validate(shifted));
  EXPECT_EQ(axle_arm(shifted, 0), 0U);
  for (RotorGeometry& rotor : shifted.rotors) rotor.position.x() += 0.1;
  EXPECT_FALSE(axle_arm(shifted, 0));
  const auto has_arms = [](auto change) {
    Vehicle<4> changed = tilt_ropter_vehicle();
    change(changed);
    EXPECT_NO_THROW(validate(changed));
    return axle_arm(changed, 0) && axle_arm(changed, 1);
  };
  EXPECT_TRUE(has_arms([](auto& c) { c.rotors[1].position.x() = 0.01; }));
  EXPECT_FALSE(has_arms([](auto& c) { c.rotors[1].position.x() = 0.06; }));
  EXPECT_FALSE(has_arms([](auto& c) { c.wheels->half_track = 0.16; }));
  EXPECT_FALSE(has_arms([](auto& c) { c.wheels->wheel_base = 0.2; }));
  EXPECT_FALSE(has_arms([](auto& c) { c.rotors[0] = rotor_on_arm(-1.5, 0.17, Spin::clockwise); }));
  v.wheels->on_arms = false;
  EXPECT_FALSE(axle_arm(v, 0));
  v.wheels.reset();
  EXPECT_FALSE(axle_arm(v, 0));
}

TEST(Vehicle, ReferenceVehicleIsValid) {
  EXPECT_NO_THROW(validate(tilt_ropter_vehicle()));
}

TEST(Vehicle, DefaultsOfEveryPartAreValid) {
  EXPECT_NO_THROW(validate(RigidBodyParameters{}));
  EXPECT_NO_THROW(validate(RotorGeometry{}));
  EXPECT_NO_THROW(validate(RotorParameters{}));
  EXPECT_NO_THROW(validate(ServoParameters{}));
  EXPECT_NO_THROW(validate(WheelParameters{}));
  EXPECT_NO_THROW(validate(LegParameters{}));
  EXPECT_NO_THROW(validate(Undercarriage{}));
  EXPECT_NO_THROW(validate(PowerParameters{}));
  EXPECT_NO_THROW(validate(BatteryParameters{}));
}

TEST(Vehicle, OwnRotorParametersReplaceCommonParameters) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.rotors[2].parameters = vehicle.rotor;
  vehicle.rotors[2].parameters->max_thrust = 20.0;
  EXPECT_EQ(rotor_parameters(vehicle, 1).max_thrust, 12.0);
  EXPECT_EQ(rotor_parameters(vehicle, 2).max_thrust, 20.0);
  EXPECT_EQ(largest_max_thrust(vehicle), 20.0);
  change_rotor_parameters(vehicle, [](RotorParameters& rotor) { rotor.max_thrust *= 0.5; });
  EXPECT_EQ(rotor_parameters(vehicle, 1).max_thrust, 6.0);
  EXPECT_EQ(rotor_parameters(vehicle, 2).max_thrust, 10.0);
}

TEST(Vehicle, VoltageRatioRejectsImplausibleVoltages) {
  const BatteryParameters battery{20.0};
  EXPECT_EQ(voltage_ratio(battery, 16.0), 0.8);
  EXPECT_EQ(voltage_ratio(battery, 22.0), 1.1);
  for (const double bad : {9.9, 30.1, 0.0, -16.0, nan, std::numeric_limits<double>::infinity()})
    EXPECT_FALSE(voltage_ratio(battery, bad).has_value()) << bad;
  EXPECT_FALSE(voltage_ratio(BatteryParameters{}, 16.0).has_value());
}

TEST(Vehicle, BatteryIsKnownWithItsCapacity) {
  EXPECT_TRUE(is_known(tilt_ropter_vehicle().battery));
  EXPECT_FALSE(is_known(BatteryParameters{}));
  EXPECT_NO_THROW(validate(BatteryParameters{}));
  EXPECT_NO_THROW(validate(BatteryParameters{20.0}));  // only the nominal voltage
  BatteryParameters battery;
  battery.resistance = 0.01;  // not known without the other fields
  EXPECT_THROW(validate(battery), std::invalid_argument);
}

TEST(Vehicle, CountsOneServoForEachRotorThatTilts) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  EXPECT_EQ(servo_count(vehicle), 4);
  vehicle.rotors[2].tilts = false;
  EXPECT_EQ(servo_count(vehicle), 3);
}

TEST(Vehicle, RejectsEveryInvalidFieldByNameAndValue) {
  using V = Vehicle<4>;
  const std::vector<Rejection> rejections{
      {"RigidBodyParameters.mass", "-1", [](V& v) { v.body.mass = -1.0; }},
      {"RigidBodyParameters.inertia", "nan", [](V& v) { v.body.inertia(1, 1) = nan; }},
      {"RigidBodyParameters.inertia", "9", [](V& v) { v.body.inertia(2, 2) = 9.0; }},
      {"Vehicle.rotors[2].position", "nan", [](V& v) { v.rotors[2].position.x() = nan; }},
      {"Vehicle.rotors[3].orientation", "inf",
       [](V& v) { v.rotors[3].orientation(0, 0) = std::numeric_limits<double>::infinity(); }},
      {"Vehicle.rotors[0].orientation", "2",
       [](V& v) { v.rotors[0].orientation = 2.0 * Eigen::Matrix3d::Identity(); }},
      {"Vehicle.rotors[1].orientation", "-1",
       [](V& v) { v.rotors[1].orientation = -Eigen::Matrix3d::Identity(); }},
      {"Vehicle.rotors[2].effectiveness", "-0.1", [](V& v) { v.rotors[2].effectiveness = -0.1; }},
      {"Vehicle.rotors[3].effectiveness", "1.5", [](V& v) { v.rotors[3].effectiveness = 1.5; }},
      {"Vehicle.rotors[0].effectiveness", "nan", [](V& v) { v.rotors[0].effectiveness = nan; }},
      {"RotorParameters.thrust_coefficient", "0", [](V& v) { v.rotor.thrust_coefficient = 0.0; }},
      {"RotorParameters.thrust_coefficient", "1e-300: must be in [1e-11, 1e+06]",
       [](V& v) { v.rotor.thrust_coefficient = 1e-300; }},
      {"RotorParameters.torque_ratio", "1e+300", [](V& v) { v.rotor.torque_ratio = 1e300; }},
      {"RotorParameters.min_thrust", "1e+300", [](V& v) { v.rotor.min_thrust = 1e300; }},
      {"RotorParameters.max_thrust", "1e+300", [](V& v) { v.rotor.max_thrust = 1e300; }},
      {"RotorParameters.time_constant", "1e-300", [](V& v) { v.rotor.time_constant = 1e-300; }},
      {"ServoParameters.time_constant", "1e+300", [](V& v) { v.servo.time_constant = 1e300; }},
      {"ServoParameters.max_rate", "1e+300", [](V& v) { v.servo.max_rate = 1e300; }},
      {"ServoParameters.min_angle", "-1e+300", [](V& v) { v.servo.min_angle = -1e300; }},
      {"ServoParameters.max_angle", "1e+300", [](V& v) { v.servo.max_angle = 1e300; }},
      {"ServoParameters.dead_time", "1e+300", [](V& v) { v.servo.dead_time = 1e300; }},
      {"RigidBodyParameters.mass", "1e+300", [](V& v) { v.body.mass = 1e300; }},
      {"RigidBodyParameters.inertia", "e+298", [](V& v) { v.body.inertia *= 1e300; }},
      {"Vehicle.rotors[1].position", "1e+300", [](V& v) { v.rotors[1].position.z() = 1e300; }},
      {"WheelParameters.radius", "1e+300", [](V& v) { v.wheels->radius = 1e300; }},
      {"WheelParameters.half_track", "1e+300", [](V& v) { v.wheels->half_track = 1e300; }},
      {"PowerParameters.electronics", "1e+300", [](V& v) { v.power.electronics = 1e300; }},
      {"PowerParameters.hover", "1e+300", [](V& v) { v.power.hover = 1e300; }},
      {"RotorParameters.linear_thrust_coefficient", "-0.003: must be in [-0.0028982",
       [](V& v) { v.rotor.linear_thrust_coefficient = -0.003; }},
      {"RotorParameters.linear_thrust_coefficient", "2000: must be in [-0.0028982",
       [](V& v) { v.rotor.linear_thrust_coefficient = 2000.0; }},
      {"RotorParameters.linear_thrust_coefficient", "nan",
       [](V& v) { v.rotor.linear_thrust_coefficient = nan; }},
      {"Vehicle.rotors[1].parameters.max_thrust", "-4",
       [](V& v) {
         v.rotors[1].parameters = v.rotor;
         v.rotors[1].parameters->max_thrust = -4.0;
       }},
      {"BatteryParameters.nominal_voltage", "-12", [](V& v) { v.battery.nominal_voltage = -12.0; }},
      {"BatteryParameters.nominal_voltage", "0.01", [](V& v) { v.battery.nominal_voltage = 0.01; }},
      {"BatteryParameters.nominal_voltage", "nan", [](V& v) { v.battery.nominal_voltage = nan; }},
      {"BatteryParameters.nominal_voltage", "1e+300: must be in [0.1, 1e5], or zero",
       [](V& v) { v.battery.nominal_voltage = 1e300; }},
      {"RotorParameters.torque_ratio", "-0.5", [](V& v) { v.rotor.torque_ratio = -0.5; }},
      {"RotorParameters.min_thrust", "-2", [](V& v) { v.rotor.min_thrust = -2.0; }},
      {"RotorParameters.max_thrust", "0", [](V& v) { v.rotor.max_thrust = 0.0; }},
      {"RotorParameters.max_thrust", "nan", [](V& v) { v.rotor.max_thrust = nan; }},
      {"RotorParameters.time_constant", "0", [](V& v) { v.rotor.time_constant = 0.0; }},
      {"ServoParameters.time_constant", "-3", [](V& v) { v.servo.time_constant = -3.0; }},
      {"ServoParameters.max_rate", "0", [](V& v) { v.servo.max_rate = 0.0; }},
      {"ServoParameters.min_angle", "nan", [](V& v) { v.servo.min_angle = nan; }},
      {"ServoParameters.max_angle", "-4", [](V& v) { v.servo.max_angle = -4.0; }},
      {"ServoParameters.dead_time", "-0.1", [](V& v) { v.servo.dead_time = -0.1; }},
      {"WheelParameters.radius", "0", [](V& v) { v.wheels->radius = 0.0; }},
      {"WheelParameters.half_track", "-1", [](V& v) { v.wheels->half_track = -1.0; }},
      {"WheelParameters.wheel_base", "-1", [](V& v) { v.wheels->wheel_base = -1.0; }},
      {"WheelParameters.half_width", "-1", [](V& v) { v.wheels->half_width = -1.0; }},
      {"WheelParameters.inertia", "0", [](V& v) { v.wheels->inertia = 0.0; }},
      {"RotorParameters.propeller_radius", "-1", [](V& v) { v.rotor.propeller_radius = -1.0; }},
      {"RotorParameters.propeller_height", "nan", [](V& v) { v.rotor.propeller_height = nan; }},
      {"Vehicle.legs", "given", [](V& v) { v.legs = LegParameters{}; }},
      {"LegParameters.height", "0", [](V& v) { stand_on_legs(v).height = 0.0; }},
      {"LegParameters.half_length", "-2", [](V& v) { stand_on_legs(v).half_length = -2.0; }},
      {"LegParameters.half_width", "nan", [](V& v) { stand_on_legs(v).half_width = nan; }},
      {"PowerParameters.electronics", "-1", [](V& v) { v.power.electronics = -1.0; }},
      {"PowerParameters.hover", "20", [](V& v) { v.power.hover = 20.0; }},
      {"PowerParameters.hover", "17", [](V& v) { v.power.hover = 17.0; }},
      {"PowerParameters.servo_hold", "-0.5", [](V& v) { v.power.servo_hold = -0.5; }},
      {"PowerParameters.servo_move", "nan", [](V& v) { v.power.servo_move = nan; }},
      {"BatteryParameters.capacity", "-5", [](V& v) { v.battery.capacity = -5.0; }},
      {"BatteryParameters.capacity", "0", [](V& v) { v.battery.capacity = 0.0; }},
      {"BatteryParameters.full_voltage", "0", [](V& v) { v.battery.full_voltage = 0.0; }},
      {"BatteryParameters.full_voltage", "1e+300", [](V& v) { v.battery.full_voltage = 1e300; }},
      {"BatteryParameters.empty_voltage", "17: must be in [0.1, 16.8]",
       [](V& v) { v.battery.empty_voltage = 17.0; }},
      {"BatteryParameters.resistance", "-0.01", [](V& v) { v.battery.resistance = -0.01; }},
      {"BatteryParameters.resistance", "nan", [](V& v) { v.battery.resistance = nan; }},
  };
  for (const Rejection& rejection : rejections) {
    Vehicle<4> vehicle = tilt_ropter_vehicle();
    rejection.spoil(vehicle);
    try {
      validate(vehicle);
      ADD_FAILURE() << rejection.field << " = " << rejection.value << " was accepted";
    } catch (const std::invalid_argument& error) {
      const std::string text = error.what();
      EXPECT_EQ(text.rfind(rejection.field, 0), 0U) << text;
      EXPECT_NE(text.find(rejection.value), std::string::npos) << text;
      EXPECT_NE(text.find(": must be "), std::string::npos) << text;
    }
  }
}

TEST(Vehicle, ArmsPointOutwardAndStayLevel) {
  for (const double azimuth : {0.0, 0.3, pi / 2, pi, -2.0}) {
    const RotorGeometry rotor = rotor_on_arm(azimuth, 0.3, Spin::clockwise);
    EXPECT_NO_THROW(validate(rotor));
    EXPECT_NEAR(rotor.position.norm(), 0.3, 1e-15);
    EXPECT_LT((0.3 * rotor.orientation.col(0) - rotor.position).norm(), 1e-15);
    EXPECT_LT((rotor.orientation.col(2) - Eigen::Vector3d::UnitZ()).norm(), 1e-15);
    EXPECT_EQ(rotor.spin, Spin::clockwise);
    EXPECT_TRUE(rotor.tilts);
  }
}

TEST(Vehicle, TiltRopterRotorsAreNumberedLikePlusQuadrotor) {
  const Vehicle<4> v = tilt_ropter_vehicle();
  const double arm = v.rotors[0].position.norm();
  EXPECT_LT((v.rotors[0].position - Eigen::Vector3d(0.0, -arm, 0.0)).norm(), 1e-15);
  EXPECT_LT((v.rotors[1].position - Eigen::Vector3d(0.0, arm, 0.0)).norm(), 1e-15);
  EXPECT_LT((v.rotors[2].position - Eigen::Vector3d(arm, 0.0, 0.0)).norm(), 1e-15);
  EXPECT_LT((v.rotors[3].position - Eigen::Vector3d(-arm, 0.0, 0.0)).norm(), 1e-15);
  EXPECT_EQ(v.rotors[0].spin, Spin::counter_clockwise);
  EXPECT_EQ(v.rotors[1].spin, Spin::counter_clockwise);
  EXPECT_EQ(v.rotors[2].spin, Spin::clockwise);
  EXPECT_EQ(v.rotors[3].spin, Spin::clockwise);
  EXPECT_GT(4.0 * v.rotor.max_thrust, 2.0 * v.body.mass * gravity);
}

}  // namespace
