// A vehicle that cannot push along its axle steers: its wheels give the side force that turns the
// velocity with the heading. All other vehicles, and all vehicles in the air, do not steer.

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/contact.hpp>

#include "support/actuator_loop.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

namespace tilt_ropter {
namespace actuator_nmpc_steering_test {

using Eigen::Vector3d;
using Node = ActuatorLevelNode<4>;

constexpr double speed = 0.8, turn_rate = 0.5;  // [m/s], [rad/s]

// Node 3 of a plan around a circle, on the ground or 1 m above it, with this pitch angle [rad].
Node node_of(const Vehicle<4>& vehicle, ActuatorNmpc<4>& nmpc, bool on_ground, double pitch = 0.0) {
  const double height = undercarriage(vehicle)->height + (on_ground ? 0.0 : 1.0);
  const auto circle = [&](double time) {
    const double heading = turn_rate * time, radius = speed / turn_rate;
    const Vector3d ahead(std::cos(heading), std::sin(heading), 0.0),
        left(-ahead.y(), ahead.x(), 0.0);
    ReferencePoint point;
    point.position = -radius * left + Vector3d(0.0, 0.0, height);
    point.velocity = speed * ahead;
    point.acceleration = speed * turn_rate * left;
    point.orientation = quaternion_from_yaw(heading) * quaternion_exp(Vector3d(0.0, pitch, 0.0));
    point.angular_velocity =
        quaternion_exp(Vector3d(0.0, -pitch, 0.0)) * Vector3d(0.0, 0.0, turn_rate);
    return point;
  };
  ContactEstimate contact = in_the_air({});
  if (on_ground) {
    contact.on_ground = contact.ground_known = true;
    contact.ground.height = 0.0;
  }
  BodyStated measured;
  measured.position = circle(0.0).position;
  for (int i = 0; i < 2; ++i) {
    (void)nmpc.prepare(0.0, circle, contact);
    (void)nmpc.feedback(0.0, measured, {});
  }
  const Node& node = nmpc.solver().problem().node(3);
  EXPECT_EQ(node.on_ground, on_ground);
  return node;
}

Node node_of(const Vehicle<4>& vehicle, bool on_ground, double pitch = 0.0,
             GroundModel model = GroundModel::held) {
  ActuatorNmpcSettings settings = actuator_nmpc_settings(vehicle);
  settings.ground.model = model;
  ActuatorNmpc<4> nmpc(vehicle, test_support::in_simulated_time(settings));
  return node_of(vehicle, nmpc, on_ground, pitch);
}

// The flat quadrotor whose rotors tilt on the arms along body x, or on those along body y.
Vehicle<4> with_tilting_pair(bool along_x) {
  Vehicle<4> vehicle = test_support::flat_quadrotor();
  for (RotorGeometry& rotor : vehicle.rotors)
    rotor.tilts = (std::abs(rotor.position.x()) > std::abs(rotor.position.y())) == along_x;
  return vehicle;
}

double needed(const Vehicle<4>& vehicle) {  // side force of the turn [N]
  return vehicle.body.mass * speed * turn_rate;
}

void expect_no_steering(const Node& node, double side_force) {
  EXPECT_EQ(node.steering.speed, Vector3d::Zero());
  EXPECT_EQ(node.steering.side, 1.0);
  EXPECT_NEAR(node.external.force.y(), side_force, 1e-12);
}

// The model adds the side force of the angular velocity. That of the reference is then not
// external.
TEST(ActuatorNmpcSteering, WheelsOfAVehicleThatCannotPushSidewaysSteer) {
  Vehicle<4> four_wheels = test_support::flat_quadrotor();
  four_wheels.wheels->wheel_base = 0.2;
  for (const Vehicle<4>& vehicle :
       {test_support::flat_quadrotor(), four_wheels, with_tilting_pair(false)}) {
    const Node node = node_of(vehicle, true);
    EXPECT_LT((node.steering.speed - Vector3d(0.0, 0.0, speed)).norm(), 1e-12);
    EXPECT_EQ(node.steering.side, 0.0);
    EXPECT_NEAR(node.external.force.y(), 0.0, 1e-12);
  }
}

TEST(ActuatorNmpcSteering, SteersAboutTheNormalOfTheGroundAlsoIfPitched) {
  const double pitch = 0.2;
  const Node node = node_of(test_support::flat_quadrotor(), true, pitch);
  const double ahead = speed * std::cos(pitch);  // along body x
  EXPECT_LT((node.steering.speed - ahead * Vector3d(-std::sin(pitch), 0.0, std::cos(pitch))).norm(),
            1e-12);
}

TEST(ActuatorNmpcSteering, VehicleInTheAirDoesNotSteerAlsoAfterATakeOff) {
  const Vehicle<4> vehicle = test_support::flat_quadrotor();
  ActuatorNmpc<4> nmpc(vehicle, test_support::in_simulated_time(actuator_nmpc_settings(vehicle)));
  EXPECT_EQ(node_of(vehicle, nmpc, true).steering.side, 0.0);
  expect_no_steering(node_of(vehicle, nmpc, false), 0.0);
}

TEST(ActuatorNmpcSteering, VehicleThatPushesSidewaysDoesNotSteer) {
  for (const Vehicle<4>& vehicle : {tilt_ropter_vehicle(), with_tilting_pair(true)})
    expect_no_steering(node_of(vehicle, true), needed(vehicle));
}

TEST(ActuatorNmpcSteering, VehicleOnLegsDoesNotSteer) {
  Vehicle<4> vehicle = test_support::flat_quadrotor();
  vehicle.wheels.reset();
  vehicle.legs = LegParameters{};
  expect_no_steering(node_of(vehicle, true), needed(vehicle));
}

// The external wrench of this model contains the side force of the wheels.
TEST(ActuatorNmpcSteering, ModelWithTheWholeExternalWrenchDoesNotSteer) {
  expect_no_steering(
      node_of(test_support::flat_quadrotor(), true, 0.0, GroundModel::external_wrench), 0.0);
}

}  // namespace actuator_nmpc_steering_test
}  // namespace tilt_ropter
