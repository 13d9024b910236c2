// What the parts of the control loop on board are worth: each is taken away in a short flight.
// CTest: flight

#include "../../examples/support/flight_controller.hpp"
#include "../../examples/support/fault_option.hpp"
#include "../../examples/support/hybrid_experiment.hpp"
#include "../../examples/support/mission_loop.hpp"
#include "../../examples/support/mission_sensors.hpp"
#include "../../examples/support/vehicle_choice.hpp"
#include "../../examples/support/vehicle_spread.hpp"
#include "support/identification_flights.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace tilt_ropter {
namespace flight_controller_test {

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

// It landed without poses, and stopped. Then what carried it gives way.
TEST(FlightController, RotorsStartAgainIfTheVehicleFallsAfterItsLanding) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  examples::FlightController<4> controller(vehicle,
                                           examples::in_simulated_time(nmpc_settings(vehicle)),
                                           examples::MissionSensors<4>::estimation());
  examples::MissionSensors<4> sensors(1);
  sensors.add_fault(examples::parse_fault("pose_dropout:start=2"));
  Plant<4> plant(vehicle);
  ReferencePoint point;
  point.position.z() = 0.6;
  BodyStated start;
  start.position = point.position;
  ActuatorState<4> command = controller.lift(vehicle.body.mass * gravity);
  controller.start_with(command);
  plant.reset(start, command);
  int stopped_at = 0;
  double fastest = 0.0, at_touch = 0.0;
  bool flew_again = false;
  for (int i = 0; i < 30000; ++i) {
    sensors.sense(plant, controller);
    if (i % 10 == 0 && controller.started()) {
      controller.prepare(plant.time(), [&point](double) { return point; });
      command = controller.control(plant.time());
    }
    ASSERT_TRUE(plant.step(command, {}, 1e-3));
    const bool stopped = controller.mode() == examples::FlightMode::stopped;
    if (stopped && stopped_at == 0) stopped_at = i;
    if (stopped_at > 0 && i < stopped_at + 1000) {
      EXPECT_TRUE(stopped) << i;
    }
    if (stopped_at > 0 && i == stopped_at + 1000) {
      PlantState<4> higher = plant.state();
      higher.body.position.z() += 4.0;
      plant.reset(higher);
    }
    if (stopped_at == 0 || i <= stopped_at + 1000) continue;
    fastest = std::max(fastest, -plant.body().velocity.z());
    flew_again = flew_again || !stopped;
    if (at_touch == 0.0 && plant.normal_forces().sum() > 0.0) at_touch = -plant.body().velocity.z();
  }
  EXPECT_GT(stopped_at, 2000);
  EXPECT_TRUE(flew_again);
  EXPECT_LT(fastest, 4.0);
  EXPECT_LT(at_touch, 1.5);
  EXPECT_EQ(controller.mode(), examples::FlightMode::stopped);
  std::printf("falls at %.2f m/s, touches the ground at %.2f m/s\n", fastest, at_touch);
}

// Its servos are half as fast as modelled and late, which is found, by a model that is too slow
// then. Against that model the IMU swings. It must not lose the flight to poses that are late.
TEST(FlightController, SlowServosAreNoVibrationOfTheImu) {
  const Vehicle<4> nominal = tilt_ropter_vehicle();
  examples::RandomStream random(1, 42);  // of IdentifyVehicleSpread
  const examples::VehicleDraw draw = test_support::draw_in_steps(random, nominal);
  const Vehicle<4> truth = examples::true_vehicle(draw, nominal);
  const Eigen::Vector3d drag = random.uniform_vector(0.0, 0.3);
  const auto flight = test_support::fly_for_identification(
      truth, nominal, draw.com_offset, draw, random, examples::excitation_experiment(), drag);
  EXPECT_TRUE(flight.flew);
  EXPECT_LT(flight.max_error, 0.1);
}

}  // namespace flight_controller_test
}  // namespace tilt_ropter
