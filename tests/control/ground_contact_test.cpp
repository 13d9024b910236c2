#include <tilt_ropter/control/ground_contact.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace tilt_ropter {
namespace {

const Wrench<> lift{Eigen::Vector3d(0.3, -0.2, 14.0), Eigen::Vector3d(0.1, 0.2, 0.3)};
const WheelParameters wheels{0.11, 0.2};
const Wrench<> breeze{Eigen::Vector3d(0.1, 0.2, -0.3), Eigen::Vector3d(0.01, 0.02, 0.03)};

const RigidBodyParameters body{2.0, Eigen::Matrix3d::Identity()};

GroundContact contact_with(const GroundContactSettings& settings = {}) {
  return {body, wheels, settings};
}

bool update(GroundContact& contact, double height, const Wrench<>& external,
            const Eigen::Quaterniond& orientation = Eigen::Quaterniond::Identity()) {
  BodyState<> state;
  state.position.z() = height;
  state.orientation = orientation;
  return contact.update(state, external);
}

// A wrench of a vertical force alone.
Wrench<> upward(double force) {
  return {Eigen::Vector3d(0.0, 0.0, force), Eigen::Vector3d::Zero()};
}

// The node of a reference at `height`.
WheeledFlightNode node_at(const GroundContact& contact, double height,
                          double side_acceleration = 0.0) {
  ReferencePoint point;
  point.position.z() = height;
  point.acceleration.y() = side_acceleration;
  WheeledFlightNode node;
  contact.apply(point, point, node);
  return node;
}

TEST(GroundContact, ModeHasHysteresis) {
  GroundContact contact = contact_with();  // radius 0.11, enter 0.005, leave 0.03
  update(contact, 0.11, {});
  EXPECT_TRUE(contact.on_ground());
  update(contact, 0.135, {});  // between the thresholds: as before
  EXPECT_TRUE(contact.on_ground());
  update(contact, 0.145, {});
  EXPECT_FALSE(contact.on_ground());
  update(contact, 0.125, {});
  EXPECT_FALSE(contact.on_ground());
  update(contact, 0.114, {});
  EXPECT_TRUE(contact.on_ground());
  EXPECT_EQ(contact.mode_changes(), 2);
}

TEST(GroundContact, NoiseAtTheThresholdChangesTheModeOnce) {
  GroundContact contact = contact_with();
  update(contact, 1.0, {});
  for (int i = 0; i < 1000; ++i) update(contact, 0.13 - 2e-5 * i + 0.004 * std::sin(37.0 * i), {});
  EXPECT_TRUE(contact.on_ground());
  EXPECT_EQ(contact.mode_changes(), 1);
}

TEST(GroundContact, ForcesOfTheGroundStayOnTheGround) {
  GroundContact contact = contact_with();
  update(contact, 1.0, breeze);
  update(contact, 0.11, lift);
  EXPECT_EQ(contact.air_wrench().force, breeze.force);
  const WheeledFlightNode air = node_at(contact, 0.5), ground = node_at(contact, 0.11);
  EXPECT_FALSE(air.on_ground);
  EXPECT_EQ(air.external.force, breeze.force);
  EXPECT_EQ(air.freedom.linear, Eigen::Vector3d::Ones());
  EXPECT_TRUE(ground.on_ground);
  EXPECT_EQ(ground.external.force, Eigen::Vector3d(0.3, 0.0, 0.0));
  EXPECT_EQ(ground.external.torque, Eigen::Vector3d(0.0, 0.2, 0.3));
  EXPECT_EQ(ground.freedom.linear, Eigen::Vector3d(1, 1, 0));
  EXPECT_EQ(ground.freedom.angular, Eigen::Vector3d(0, 1, 1));
}

TEST(GroundContact, TheVerticalIsTheWorldsHoweverTheBodyIsPitched) {
  GroundContact contact = contact_with();
  const Eigen::Quaterniond pitched(Eigen::AngleAxisd(0.4, Eigen::Vector3d::UnitY()));
  update(contact, 0.11, {pitched.conjugate() * Eigen::Vector3d(0.3, -0.2, 14.0), {0, 0, 0}},
         pitched);
  const WheeledFlightNode node = node_at(contact, 0.11);
  EXPECT_LT((pitched * node.external.force - Eigen::Vector3d(0.3, 0.0, 0.0)).norm(), 1e-12);
}

TEST(GroundContact, TheWheelsGiveTheSideForceOfACurveWhateverIsEstimated) {
  GroundContact contact = contact_with();
  update(contact, 0.11, lift);
  EXPECT_DOUBLE_EQ(node_at(contact, 0.11, 1.5).external.force.y(), 3.0);
}

TEST(GroundContact, CloseToTheGroundTheAirsWrenchIsFollowedButNotRemembered) {
  GroundContact contact = contact_with();
  update(contact, 0.5, breeze);
  const Wrench<> gust = upward(3.0);
  update(contact, 0.13, gust);  // in the air still, but the wheels may touch already
  EXPECT_FALSE(contact.on_ground());
  EXPECT_EQ(node_at(contact, 0.5).external.force, gust.force);  // or it would not come down
  EXPECT_EQ(contact.air_wrench().force, breeze.force);
  update(contact, 0.11, gust);
  EXPECT_EQ(node_at(contact, 0.5).external.force, breeze.force);
}

TEST(GroundContact, LeavingTheGroundIsToldOnceAndKeepsTheAirsWrench) {
  GroundContact contact = contact_with();
  EXPECT_FALSE(update(contact, 0.5, breeze));
  EXPECT_FALSE(update(contact, 0.11, lift));
  EXPECT_TRUE(update(contact, 0.2, breeze));
  EXPECT_EQ(contact.air_wrench().force, breeze.force);
  EXPECT_EQ(node_at(contact, 0.5).external.force, breeze.force);
  EXPECT_FALSE(update(contact, 0.3, breeze));
}

TEST(GroundContact, GroundThatCarriesTheVehicleIsNotLeftHoweverHighItIs) {
  GroundContact contact = contact_with();  // 2 kg: 7.85 N are more than air can give
  update(contact, 0.11, lift);
  EXPECT_FALSE(update(contact, 0.31, lift));  // up a slope
  EXPECT_TRUE(contact.on_ground());
  EXPECT_TRUE(node_at(contact, 0.11).on_ground);
  EXPECT_TRUE(update(contact, 0.31, upward(7.8)));
  EXPECT_FALSE(contact.on_ground());
}

TEST(GroundContact, GroundThatCarriesTheVehicleIsReachedBelowLeaveHeight) {
  GroundContact contact = contact_with();
  update(contact, 1.0, {});
  update(contact, 0.145, lift);  // pulled up by something else
  EXPECT_FALSE(contact.on_ground());
  contact = contact_with();
  update(contact, 1.0, {});
  update(contact, 0.135, upward(7.8));
  EXPECT_FALSE(contact.on_ground());
  update(contact, 0.135, upward(7.9));  // landed on a board
  EXPECT_TRUE(contact.on_ground());
}

TEST(GroundContact, ThrustHoldsBackWhereTheReferenceIsDownAndTheWheelsAreNot) {
  GroundContact contact = contact_with();
  const Eigen::Quaterniond pitched(Eigen::AngleAxisd(0.4, Eigen::Vector3d::UnitY()));
  update(contact, 0.2, {}, pitched);
  const WheeledFlightNode node = node_at(contact, 0.11);
  EXPECT_LT((pitched * node.external.force - Eigen::Vector3d(0, 0, 0.07 * 2.0 * gravity)).norm(),
            1e-12);
  EXPECT_EQ(node_at(contact, 0.12).external.force, Eigen::Vector3d::Zero());  // on the way down
  update(contact, 0.112, {});
  EXPECT_EQ(node_at(contact, 0.11).external.force, Eigen::Vector3d::Zero());
}

TEST(GroundContact, WhatTheAirCarriesAnywayIsNotTheGrounds) {
  GroundContact contact = contact_with();
  // Thrust stronger than known looks like a lift, here along a body that is pitched half over.
  const Eigen::Quaterniond pitched(Eigen::AngleAxisd(0.6, Eigen::Vector3d::UnitY()));
  const auto along = [&](double force) {
    return Wrench<>{pitched.conjugate() * Eigen::Vector3d(0.0, 0.0, force),
                    Eigen::Vector3d::Zero()};
  };
  update(contact, 1.0, along(4.0), pitched);
  update(contact, 0.135, along(11.8), pitched);
  EXPECT_FALSE(contact.on_ground());
  update(contact, 0.135, along(11.9), pitched);
  EXPECT_TRUE(contact.on_ground());
}

TEST(GroundContact, AnEstimateGoneWrongInTheAirNeitherHidesNorFeignsTheGround) {
  for (const double wrong : {-1e9, 1e9}) {
    GroundContact contact = contact_with();
    update(contact, 1.0, upward(wrong));
    update(contact, 0.11, lift);
    EXPECT_TRUE(contact.on_ground());
    update(contact, 1.0, {});
    EXPECT_FALSE(contact.on_ground()) << wrong;
    contact = contact_with();
    update(contact, 1.0, upward(wrong));
    update(contact, 0.13, upward(16.0));
    EXPECT_TRUE(contact.on_ground()) << wrong;
  }
}

TEST(GroundContact, NonFiniteMeasurementsChangeNothing) {
  GroundContact contact = contact_with();
  update(contact, 0.11, breeze);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(update(contact, nan, breeze));
  EXPECT_FALSE(update(contact, 5.0, {Eigen::Vector3d::Constant(nan), Eigen::Vector3d::Zero()}));
  EXPECT_TRUE(contact.on_ground());
  EXPECT_EQ(contact.mode_changes(), 0);
}

TEST(GroundContact, AReferenceIsOneOnTheGroundWithinItsTolerance) {
  GroundContactSettings settings;
  settings.reference_tolerance = 2e-3;
  GroundContact contact = contact_with(settings);
  update(contact, 0.11, {});
  EXPECT_TRUE(node_at(contact, 0.1119).on_ground);
  EXPECT_TRUE(node_at(contact, 0.1081).on_ground);
  EXPECT_FALSE(node_at(contact, 0.1121).on_ground);
  EXPECT_FALSE(node_at(contact_with(), 0.11).on_ground);  // nothing measured yet
}

TEST(GroundContact, SettingsOutOfRangeAreRefused) {
  GroundContactSettings s;
  s.leave_height = s.enter_height;
  EXPECT_THROW(contact_with(s), std::invalid_argument);
  EXPECT_THROW((GroundContact{body, WheelParameters{0.0, 0.2}}), std::invalid_argument);
  EXPECT_THROW((GroundContact{RigidBodyParameters{-1.0, body.inertia}, wheels}),
               std::invalid_argument);
  s = {};
  s.carried_share = 0.0;
  EXPECT_THROW(contact_with(s), std::invalid_argument);
  s = {};
  s.settling_share = -0.1;
  EXPECT_THROW(contact_with(s), std::invalid_argument);
  s = {};
  s.down_force = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(contact_with(s), std::invalid_argument);
}

// What a wrench with this vertical force takes or leaves each rotor, upward [N].
Eigen::Vector4d vertical_thrusts(Wrench<> wrench, double force) {
  wrench.force.z() = force;
  Eigen::Matrix<double, 6, 1> packed;
  packed << wrench.force, wrench.torque;
  const Eigen::Matrix<double, 8, 1> thrusts =
      AllocationMatrix<4>(tilt_ropter_vehicle()).pseudoinverse * packed;
  return {thrusts(1), thrusts(3), thrusts(5), thrusts(7)};
}

TEST(GroundThrust, IsTheDownForceWithoutATorque) {
  const GroundThrust<4> thrust(tilt_ropter_vehicle(), {});
  EXPECT_EQ(thrust({}), 0.75);
  EXPECT_EQ(thrust({Eigen::Vector3d(0.5, 0.0, 7.0), Eigen::Vector3d::Zero()}), 0.75);
  // Noise of the estimate, or a CoM that is half a millimetre off the axle.
  EXPECT_EQ(thrust({Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.0075, 0.0)}), 0.75);
}

TEST(GroundThrust, LeavesEveryRotorPushingUpwardUnderTorques) {
  const GroundThrust<4> thrust(tilt_ropter_vehicle(), {});
  for (const double torque : {-0.18, -0.1, 0.05, 0.147}) {  // the last: a CoM 1 cm off the axle
    const Wrench<> wrench{Eigen::Vector3d(1.0, 0.0, 0.0), Eigen::Vector3d(0.0, torque, 0.02)};
    const double force = thrust(wrench);
    const Eigen::Vector4d before = vertical_thrusts(wrench, 0.0);
    const double taken = -before.minCoeff();
    EXPECT_NEAR(vertical_thrusts(wrench, force).minCoeff(), std::min(2.0 * taken, 0.25), 1e-9)
        << torque;
  }
}

TEST(GroundThrust, RotorThrustActsAndHalfTheWeightIsTheMost) {
  const Wrench<> pitched{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.147, 0.0)};
  GroundContactSettings settings;
  settings.rotor_thrust = 0.0;
  const double none = GroundThrust<4>(tilt_ropter_vehicle(), settings)(pitched);
  EXPECT_NEAR(vertical_thrusts(pitched, none).minCoeff(), 0.0, 1e-9);
  settings.rotor_thrust = 0.5;
  EXPECT_NEAR(GroundThrust<4>(tilt_ropter_vehicle(), settings)(pitched), none + 4.0 * 0.5, 1e-9);
  settings.rotor_thrust = 100.0;
  const Wrench<> tipping{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 5.0, 0.0)};
  EXPECT_DOUBLE_EQ(GroundThrust<4>(tilt_ropter_vehicle(), settings)(tipping), 0.5 * 1.5 * gravity);
  settings.down_force = 10.0;  // asked for by the user, who may know better
  EXPECT_EQ(GroundThrust<4>(tilt_ropter_vehicle(), settings)(tipping), 10.0);
  settings.rotor_thrust = -0.1;
  EXPECT_THROW(validate(settings), std::invalid_argument);
}

}  // namespace
}  // namespace tilt_ropter
