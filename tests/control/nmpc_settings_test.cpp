#include "support/vehicles.hpp"

#include <tilt_ropter/control/detail/reference_wrench.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace tilt_ropter {
namespace nmpc_settings_test {

void expect_close(const Eigen::Vector3d& a, const Eigen::Vector3d& b, double relative) {
  EXPECT_TRUE(a.isApprox(b, relative)) << a.transpose() << " and " << b.transpose();
}

TEST(NmpcSettings, ReferenceVehicleGivesTheDefaults) {
  const NmpcSettings own = nmpc_settings(tilt_ropter_vehicle()), usual;
  const NmpcWeights &w = own.problem.weights, &v = usual.problem.weights;
  expect_close(w.force, v.force, 1e-3);
  expect_close(w.torque, v.torque, 1e-3);
  expect_close(w.position, v.position, 1e-3);
  expect_close(w.velocity, v.velocity, 1e-3);
  expect_close(w.orientation, v.orientation, 1e-3);
  expect_close(w.angular_velocity, v.angular_velocity, 1e-3);
  expect_close(w.force_rate, v.force_rate, 1e-3);
  expect_close(w.torque_rate, v.torque_rate, 1e-3);
  const NmpcBounds &b = own.problem.bounds, &c = usual.problem.bounds;
  expect_close(b.force_min, c.force_min, 1e-12);
  expect_close(b.force_max, c.force_max, 1e-12);
  expect_close(b.torque_max, c.torque_max, 1e-12);
  expect_close(b.force_rate, c.force_rate, 1e-12);
  expect_close(b.torque_rate, c.torque_rate, 1e-12);
  EXPECT_NEAR(own.ground.down_force, usual.ground.down_force, 1e-12);
}

// Bryson's rule: an allowed error has a cost of 1, for a vehicle of any size.
TEST(NmpcSettings, AllowedErrorHasCostOne) {
  AllowedErrors errors;
  errors.position << 0.1, 0.2, 0.3;
  errors.torque_rate << 0.5, 1.0, 2.0;
  Vehicle<6> vehicle = test_support::tilting_hexacopter();  // arms of 0.25 m
  vehicle.body.mass = 4.0;
  const double weight = 4.0 * gravity;
  const NmpcWeights w = nmpc_settings(vehicle, errors).problem.weights;
  for (int i = 0; i < 3; ++i) {
    EXPECT_NEAR(w.position(i) * errors.position(i) * errors.position(i), 1.0, 1e-12);
    const double force = errors.force(i) * weight,
                 torque_rate = errors.torque_rate(i) * weight * 0.25;
    EXPECT_NEAR(w.force(i) * force * force, 1.0, 1e-12);
    EXPECT_NEAR(w.torque_rate(i) * torque_rate * torque_rate, 1.0, 1e-12);
  }
}

TEST(NmpcSettings, SlowerServosGiveMoreThrustOnTheGround) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  const double usual = nmpc_settings(vehicle).ground.down_force;
  const auto of_servo = [&](double max_rate) {
    vehicle.servo.max_rate = max_rate;
    return nmpc_settings(vehicle).ground.down_force / usual;
  };
  EXPECT_NEAR(of_servo(4.0), 2.0, 1e-12);
  EXPECT_NEAR(of_servo(1.0), 4.0, 1e-12);
  EXPECT_NEAR(of_servo(16.0), 1.0, 1e-12);
  for (RotorGeometry& rotor : vehicle.rotors) rotor.tilts = false;
  EXPECT_NEAR(of_servo(1.0), 1.0, 1e-12);
}

TEST(NmpcSettings, BoundsAndGroundThrustScaleWithWeightAndSize) {
  Vehicle<4> big = tilt_ropter_vehicle();
  big.body.mass *= 3.0;
  for (RotorGeometry& rotor : big.rotors) rotor.position *= 2.0;
  big.rotors[0].effectiveness = 0.0;  // a lost rotor does not count
  big.rotors[0].position *= 10.0;
  const NmpcSettings s = nmpc_settings(big), usual;
  expect_close(s.problem.bounds.force_max, 3.0 * usual.problem.bounds.force_max, 1e-12);
  expect_close(s.problem.bounds.torque_min, 6.0 * usual.problem.bounds.torque_min, 1e-12);
  expect_close(s.problem.bounds.torque_rate, 6.0 * usual.problem.bounds.torque_rate, 1e-12);
  expect_close(s.problem.bounds.angular_velocity, usual.problem.bounds.angular_velocity, 1e-12);
  EXPECT_NEAR(s.problem.weights.ground_thrust, usual.problem.weights.ground_thrust / 9.0, 1e-12);
  EXPECT_NEAR(s.ground.down_force, 3.0 * usual.ground.down_force, 1e-12);
  EXPECT_NEAR(s.ground.rotor_thrust, 3.0 * usual.ground.rotor_thrust, 1e-12);
}

}  // namespace nmpc_settings_test
}  // namespace tilt_ropter
