// CTest: optimised

#include "../../examples/support/propeller_clearance.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace examples {
namespace propeller_clearance_test {

using namespace tilt_ropter;

// A tilted disc stays between the planes that are one radius from its centre along the arm. Its
// most distant point is as far from the arm as the rim of the disc at zero tilt.
TEST(PropellerClearance, OfTheReferenceVehicleMatchesGeometry) {
  const Vehicle<4> v = tilt_ropter_vehicle();
  const double r = v.rotor.propeller_radius, h = v.rotor.propeller_height;
  const PropellerClearance found = propeller_clearance(v);
  EXPECT_NEAR(found.wheel, 0.26 - 0.015 - 0.17 - r, 1e-6);
  EXPECT_NEAR(found.ground, 0.11 - std::hypot(r, h), 1e-3);
  const double apart = std::hypot(0.17, 0.17);
  EXPECT_GT(found.propeller, apart - 2.0 * std::hypot(r, h));
  EXPECT_LT(found.propeller, apart - 2.0 * h);
}

// FINDINGS of the first version: at a half track of 0.2 m the propellers pass through the wheels.
TEST(PropellerClearance, FindsPropellersThatTouchWheels) {
  Vehicle<4> v = tilt_ropter_vehicle();
  v.wheels->half_track = 0.20;
  EXPECT_EQ(propeller_clearance(v).wheel, 0.0);
  // The wheel's rim enters the disc between centre and rim.
  v.wheels->half_track = 0.17;
  v.wheels->half_width = 1e-3;
  v.wheels->radius = 0.02;
  v.rotor.propeller_height = 0.0;
  EXPECT_EQ(propeller_clearance(v).wheel, 0.0);
}

TEST(PropellerClearance, FindsPropellersThatTouchGround) {
  Vehicle<4> v = tilt_ropter_vehicle();
  v.wheels->radius = 0.07;
  EXPECT_EQ(propeller_clearance(v).ground, 0.0);
  v.servo.min_angle = -0.1;  // the propellers stay above their arms
  v.servo.max_angle = 0.1;
  EXPECT_NEAR(propeller_clearance(v).ground, 0.07 + 0.034 * std::cos(0.1) - 0.0648 * std::sin(0.1),
              2e-4);
}

TEST(PropellerClearance, OfParallelDiscsIsClosedForm) {
  Vehicle<4> v = tilt_ropter_vehicle();
  v.wheels.reset();
  for (RotorGeometry& rotor : v.rotors) rotor.tilts = false;
  const double apart = std::hypot(0.17, 0.17), r = v.rotor.propeller_radius;
  EXPECT_NEAR(propeller_clearance(v).propeller, apart - 2.0 * r, 1e-3);
  EXPECT_EQ(propeller_clearance(v).wheel, PropellerClearance::none);
  EXPECT_EQ(propeller_clearance(v).ground, PropellerClearance::none);
  v.rotor.propeller_radius = 0.13;
  EXPECT_EQ(propeller_clearance(v).propeller, 0.0);
  v.rotors[1].position.z() = v.rotors[0].position.z() = 0.05;  // two discs above the others
  EXPECT_NEAR(propeller_clearance(v).propeller, 0.05, 1e-9);
  v.rotor.propeller_radius = 0.0;
  EXPECT_EQ(propeller_clearance(v).propeller, PropellerClearance::none);
}

}  // namespace propeller_clearance_test
}  // namespace examples
