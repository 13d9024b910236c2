// The plant and the controller's model are written independently and must describe the same
// vehicle.

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace tilt_ropter {
namespace two_models_test {

using test_support::Random;

TEST(TwoModels, FollowTheSameTrajectoryUnderTheSameCommands) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.body.inertia << 0.014, 4e-4, -7e-4, 4e-4, 0.0143, 3e-4, -7e-4, 3e-4, 0.025;
  vehicle.servo.dead_time = 0.02;
  vehicle.rotors[0].parameters = {1.1e-6, 0.02, 0.3, 9.0, 0.05, 8e-4};
  vehicle.rotors[3].parameters = {2.0e-6, 0.012, 0.0, 14.0, 0.02, -5e-4};
  const Allocation allocation(vehicle);
  const RigidBodyd body(vehicle.body);
  Random random(71);
  for (int flight = 0; flight < 3; ++flight) {
    PlantState<4> start;
    start.body.position << 0.0, 0.0, 50.0;
    start.body.orientation = random.orientation();
    start.body.angular_velocity = random.vector(2.0);
    start.body.velocity = random.vector(2.0);
    start.actuators.rotor_speed.setConstant(1500.0);
    PlantParameters parameters;  // the model has no freely turning wheels
    parameters.contact.bearing_friction = 0.0;
    Vehicle<4> true_vehicle = vehicle;
    true_vehicle.wheels->inertia = 1e-6;
    Plant<4> plant(true_vehicle, parameters);
    plant.reset(start);
    ActuatorModel<4> actuators(vehicle);
    actuators.reset(start.actuators, 0.0);
    Stated model;
    model.body = start.body;

    const double dt = 1e-3;
    ActuatorState<4> command = start.actuators;
    const Wrenchd wind{random.vector(0.5), random.vector(0.01)};
    (void)actuators.update(0.0, command);
    for (int i = 0; i < 1000; ++i) {
      const double time = dt * i;
      if (i % 50 == 0)  // steps that reach the rate limit and the end of the range
        for (int r = 0; r < 4; ++r) {
          command.rotor_speed(r) = random.uniform(500.0, 2500.0);
          command.tilt_angle(r) = random.uniform(-3.5, 3.5);
        }
      // The model uses the mean of the wrench over the step, by Simpson's rule.
      const auto wrench_at = [&](double t) {
        return allocation.wrench(actuators.update(t, command));
      };
      const Wrenchd first = wrench_at(time), middle = wrench_at(time + 0.5 * dt),
                    last = wrench_at(time + dt);
      model.wrench.force = (first.force + 4.0 * middle.force + last.force) / 6.0;
      model.wrench.torque = (first.torque + 4.0 * middle.torque + last.torque) / 6.0;
      model = body.step(model, Eigen::Matrix<double, 6, 1>::Zero(), wind, dt);
      ASSERT_TRUE(plant.step(command, wind, dt));
    }
    const BodyStated& truth = plant.body();
    EXPECT_LT((actuators.state().tilt_angle - plant.actuators().tilt_angle).norm(), 1e-3);
    EXPECT_LT((actuators.state().rotor_speed - plant.actuators().rotor_speed).norm(), 1e-2);
    EXPECT_LT((model.body.position - truth.position).norm(), 1e-3);
    EXPECT_LT((model.body.velocity - truth.velocity).norm(), 1e-2);
    EXPECT_LT(
        quaternion_log(Eigen::Quaterniond(model.body.orientation.conjugate() * truth.orientation))
            .norm(),
        1e-2);
    EXPECT_LT((model.body.angular_velocity - truth.angular_velocity).norm(), 0.05);
    EXPECT_GT((truth.position - start.body.position).norm(), 1.0);
  }
}

}  // namespace two_models_test
}  // namespace tilt_ropter
