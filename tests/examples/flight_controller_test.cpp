// What the parts of the control loop on board are worth: each is taken away in a short flight.
// CTest: flight

#include "../../examples/support/flight_controller.hpp"

#include "../../examples/support/mission_loop.hpp"
#include "../../examples/support/mission_sensors.hpp"
#include "../../examples/support/vehicle_choice.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/reference.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>

namespace tilt_ropter {
namespace {

using examples::ExternalWrench;

struct Hover {
  double drop = 0.0;        // below the reference, at the end [m]
  double side_force = 0.0;  // largest estimated force along the step [N]
  double held_force = 0.0;  // estimated lift that the controller knows of, at the end [N]
  bool on_ground = true;
};

// Hovers for 3 s with 10 % of unknown mass, then follows a step of 0.5 m ahead for half a second.
Hover hover(ExternalWrench external) {
  const Vehicle<4> believed = tilt_ropter_vehicle();
  Vehicle<4> truth = believed;
  truth.body.mass *= 1.1;
  const NmpcSettings settings = examples::in_simulated_time(nmpc_settings(believed));
  examples::FlightController<4> controller(believed, settings,
                                           examples::MissionSensors<4>::estimation(),
                                           observer_settings(20.0), {}, external);
  examples::MissionSensors<4> sensors(1);
  Plant<4> plant(truth);
  BodyStated start;
  start.position.z() = 1.5;
  ActuatorState<4> command = controller.lift(truth.body.mass * gravity);
  controller.start_with(command);
  plant.reset(start, command);
  ReferencePoint point;
  point.position = start.position;
  Hover result;
  for (int i = 0; i < 3500; ++i) {
    if (i == 3000) {
      result.drop = point.position.z() - plant.body().position.z();
      result.held_force = controller.nmpc().contact().disturbance.force.z();
      point.position.x() += 0.5;
    }
    sensors.sense(plant, controller);
    if (i % 10 == 0 && controller.started()) {
      controller.prepare(plant.time(), [&point](double) { return point; });
      command = controller.control(plant.time());
    }
    const bool stepped = plant.step(command, {}, 1e-3);
    EXPECT_TRUE(stepped);
    if (i >= 3000)
      result.side_force = std::max(result.side_force, std::abs(controller.external().force.x()));
  }
  result.on_ground = controller.contact().estimate().on_ground;
  return result;
}

TEST(FlightController, WithoutTheExternalWrenchUnknownMassLowersTheHover) {
  const Hover with = hover(ExternalWrench::modelled), without = hover(ExternalWrench::unused);
  EXPECT_LT(std::abs(with.drop), 0.01);
  EXPECT_GT(without.drop, 0.05);
  EXPECT_LT(with.held_force, -0.5);
  EXPECT_EQ(without.held_force, 0.0);
  EXPECT_FALSE(without.on_ground);
}

// The servos need 80 ms to follow a command. An observer that does not know this takes the missing
// force for an external one.
TEST(FlightController, WithCommandsTheObserverTakesTheLagOfTheServosForAForce) {
  const Hover modelled = hover(ExternalWrench::modelled),
              commanded = hover(ExternalWrench::commanded);
  EXPECT_GT(commanded.side_force, 3.0 * modelled.side_force);
  EXPECT_LT(std::abs(commanded.drop), 0.01);  // at rest both are right
}

TEST(FlightController, OptionsOfTheMissionReachTheSettings) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const auto settings = [&vehicle](const examples::MissionOptions& options) {
    return examples::controller_settings(options, examples::VehicleFile{}, vehicle).nmpc;
  };
  const NmpcSettings shipped = settings({});
  examples::MissionOptions options;
  options.no_ground_conditions = true;
  EXPECT_TRUE(settings(options).problem.weights.ground.isZero());
  EXPECT_GT(shipped.problem.weights.ground.minCoeff(), 0.0);
  options = {};
  options.no_feed_forward = true;
  EXPECT_EQ(settings(options).wrench_reference, WrenchReference::hover);
  EXPECT_EQ(shipped.wrench_reference, WrenchReference::inverse_dynamics);
  options = {};
  options.ground_thrust = 3.0;
  EXPECT_EQ(settings(options).ground.down_force, 3.0);
}

}  // namespace
}  // namespace tilt_ropter
