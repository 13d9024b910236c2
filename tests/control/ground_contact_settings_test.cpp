// The default of each setting acts with the value that its comment gives. The controller of the 1.5
// kg vehicle uses these defaults on the ground.

#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/detail/reference_wrench.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <limits>

namespace tilt_ropter {
namespace ground_contact_settings_test {

const Vehicle<4> vehicle = tilt_ropter_vehicle();

// Heights are above the standing height of the CoM, on ground at zero height.
ReferencePoint reference_at(double above) {
  ReferencePoint point;
  point.position.z() = undercarriage(vehicle)->height + above;
  return point;
}

ContactEstimate ground(bool stands) {
  ContactEstimate contact;
  contact.ground_known = true;
  contact.on_ground = stands;
  return contact;
}

FlightNode node_with(const GroundContactSettings& settings, bool stands, double reference,
                     double measured) {
  FlightNode node;
  BodyStated state;
  state.position = reference_at(measured).position;
  (void)GroundContact(vehicle.body, undercarriage(vehicle), settings)
      .apply(ground(stands), state, 0.0, reference_at(reference), reference_at(reference), node);
  return node;
}

TEST(GroundContactSettings, ReferenceIsOnTheGroundUpTo3CentimetresAboveIt) {
  EXPECT_TRUE(node_with({}, true, 0.0299, 0.0).on_ground);
  EXPECT_FALSE(node_with({}, true, 0.0301, 0.0).on_ground);
}

TEST(GroundContactSettings, EstimateAndNotTheHeightTellsWhetherTheVehicleStands) {
  EXPECT_TRUE(node_with({}, true, 0.0, 0.02).on_ground);
  EXPECT_FALSE(node_with({}, false, 0.0, 0.0).on_ground);
}

TEST(GroundContactSettings, ContactByHeightAllows5Millimetres) {
  GroundContactSettings settings;
  settings.contact_by_height = true;
  for (const bool stands : {false, true})
    for (const double sign : {-1.0, 1.0}) {
      EXPECT_TRUE(node_with(settings, stands, sign * 0.0049, 0.0).on_ground);
      EXPECT_TRUE(node_with(settings, stands, 0.0, sign * 0.0049).on_ground);
      EXPECT_FALSE(node_with(settings, stands, sign * 0.0051, 0.0).on_ground);
      EXPECT_FALSE(node_with(settings, stands, 0.0, sign * 0.0051).on_ground);
    }
}

TEST(GroundContactSettings, ReferenceSettlesWith10CentimetresPerSecond) {
  const FlightNode node = node_with({}, false, 0.0, 0.0);
  EXPECT_NEAR(node.reference.velocity.z(), -0.10, 1e-12);
}

TEST(GroundContactSettings, GroundWasNotPlannedAndHoldsTheVehicle) {
  const GroundContactSettings settings;
  EXPECT_EQ(settings.planned_height, -std::numeric_limits<double>::infinity());
  EXPECT_TRUE(GroundContact(vehicle.body, undercarriage(vehicle), settings).holds());
}

// A CoM that is 1 cm off the axle pitches the vehicle by 0.147 N m. The four rotors then have the
// thrust that the torque needs, and this one more.
TEST(GroundContactSettings, EveryRotorKeeps6CentinewtonsOfVerticalThrust) {
  const Wrenchd level{Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero()},
      pitched{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.147, 0.0)};
  EXPECT_EQ(ReferenceWrench<4>(vehicle, {}).ground_thrust(level), 0.75);
  GroundContactSettings none;
  none.rotor_thrust = 0.0;
  EXPECT_NEAR(ReferenceWrench<4>(vehicle, {}).ground_thrust(pitched),
              ReferenceWrench<4>(vehicle, none).ground_thrust(pitched) + 4.0 * 0.06, 1e-9);
}

}  // namespace ground_contact_settings_test
}  // namespace tilt_ropter
