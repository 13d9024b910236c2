#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <limits>

namespace vehicle_test {

using namespace tilt_ropter;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

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

}  // namespace vehicle_test
