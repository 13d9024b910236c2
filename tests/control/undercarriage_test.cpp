// Vehicles with four fixed wheels, with legs and without undercarriage, in closed loop. The
// controller is the same; only the Undercarriage of the vehicle differs.

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/hovering.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace undercarriage_test {

struct Flight {
  double air_rmse = 0.0, ground_rmse = 0.0, rest_thrust = 0.0;
  double touchdown_speed = 0.0, largest_error = 0.0, final_height = 0.0;
  int mode_changes = 0;
};

// Flies the hybrid mission. The true mass is 10 % larger than the controller's model.
Flight fly(const Vehicle<4>& vehicle) {
  Vehicle<4> truth = vehicle;
  truth.body.mass *= 1.1;
  HybridMissionSettings job;
  job.rest_time = 4.0;
  const Mission mission = hybrid_mission(vehicle, job);
  const auto reference = [&mission](double time) { return mission(time); };
  Plant<4> plant(truth);
  const Allocation allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body);
  ContactEstimator contact(vehicle);
  NmpcSettings settings = test_support::in_simulated_time(nmpc_settings(vehicle));
  Nmpc<4> nmpc(vehicle, settings);
  AllocationResult<4> sent;
  const bool stands = undercarriage(vehicle).has_value();
  if (!stands) {
    sent = test_support::level_hover(allocation, vehicle);
    BodyStated hovering;
    hovering.position = mission(0.0).position;
    plant.reset(hovering, sent.command);
    actuators.reset(sent.command, 0.0);
  }
  const Wrenchd wind{Eigen::Vector3d(0.3, -0.2, 0.0), Eigen::Vector3d::Zero()};
  Flight flight;
  double air = 0.0, ground = 0.0, rest = 0.0;
  long in_air = 0, on_ground = 0, at_rest = 0;
  bool touched = stands;
  for (long i = 0; plant.time() < mission.duration(); ++i) {
    const double time = plant.time();
    const ActuatorState<4> applied{plant.actuators().rotor_speed,
                                   actuators.update(time, sent.command).tilt_angle};
    const ObservedWrenchd& observed =
        observer.update(time, plant.inertial_sample(), allocation.wrench(applied));
    if (i % 10 == 0) {
      contact.update(time, plant.body(), observed);
      EXPECT_EQ(nmpc.prepare(time, reference, contact.estimate()),
                optimal_control::PrepareStatus::prepared);
      const NmpcResult& result = nmpc.feedback(time, plant.body());
      EXPECT_TRUE(has_plan(result.status));
      sent = allocation.allocate(time, result.wrench, result.rate, sent);
      actuators.update(time, sent.command);
    }
    EXPECT_TRUE(plant.step(sent.command, wind, 1e-3));
    const double error = (plant.body().position - mission(plant.time()).position).norm();
    const MissionPhase phase = mission.phase(plant.time());
    flight.largest_error = std::max(flight.largest_error, error);
    if (phase == MissionPhase::air) {
      air += error * error;
      ++in_air;
    }
    if (phase == MissionPhase::ground) {
      ground += error * error;
      ++on_ground;
    }
    if (phase == MissionPhase::rest && plant.time() > mission.duration() - 0.5) {
      rest += plant.actuator_wrench().force.norm();
      ++at_rest;
    }
    const bool touches = plant.normal_forces().sum() > 0.0;
    if (touches && !touched)
      flight.touchdown_speed = std::max(flight.touchdown_speed, -plant.body().velocity.z());
    touched = touches;
  }
  const auto root_mean = [](double sum, long n) {
    return n > 0 ? std::sqrt(sum / static_cast<double>(n)) : 0.0;
  };
  flight.air_rmse = root_mean(air, in_air);
  flight.ground_rmse = root_mean(ground, on_ground);
  flight.rest_thrust = at_rest > 0 ? rest / static_cast<double>(at_rest) : 0.0;
  flight.final_height = plant.body().position.z();
  flight.mode_changes = contact.mode_changes();
  return flight;
}

TEST(Undercarriage, FourFixedWheelsLandDriveAndTakeOff) {
  Vehicle<4> car = tilt_ropter_vehicle();
  car.wheels->wheel_base = 0.30;
  const Flight flight = fly(car);
  EXPECT_EQ(flight.mode_changes, 4);
  EXPECT_LT(flight.air_rmse, 0.01);
  EXPECT_LT(flight.ground_rmse, 0.03);
  EXPECT_LT(flight.largest_error, 0.10);
  EXPECT_LT(flight.touchdown_speed, 0.2);
  EXPECT_LT(flight.rest_thrust, 1.1);
}

TEST(Undercarriage, LegsTakeOffAndLand) {
  Vehicle<4> bird = tilt_ropter_vehicle();
  bird.wheels.reset();
  bird.legs = LegParameters{};
  const Flight flight = fly(bird);
  EXPECT_EQ(flight.mode_changes, 2);
  EXPECT_LT(flight.air_rmse, 0.01);
  EXPECT_LT(flight.largest_error, 0.10);
  EXPECT_LT(flight.touchdown_speed, 0.2);
  EXPECT_LT(flight.rest_thrust, 1.1);
  EXPECT_NEAR(flight.final_height, bird.legs->height, 0.005);
}

TEST(Undercarriage, WithoutUndercarriageHeightZeroHasNoEffect) {
  Vehicle<4> kite = tilt_ropter_vehicle();
  kite.wheels.reset();
  const Flight flight = fly(kite);
  EXPECT_EQ(flight.mode_changes, 0);
  EXPECT_LT(flight.air_rmse, 0.01);
}

}  // namespace undercarriage_test
}  // namespace tilt_ropter
