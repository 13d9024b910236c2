// Vehicles with little more thrust than their weight fly far steps with every thrust at its limit.
// Without the curvature of limits and directions in the Hessian (add_curvature() of the problems),
// the plans of a quarter of these flights diverge until the vehicle falls.
// CTest: flight

#include <tilt_ropter/control/nmpc.hpp>

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/actuator_loop.hpp"
#include "support/full_run.hpp"
#include "support/hovering.hpp"
#include "support/simulated_time.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <vector>

namespace tilt_ropter {
namespace thrust_limit_flights_test {

using test_support::hover;
using test_support::hovering;
using test_support::in_simulated_time;

constexpr int ticks = 1500;  // of 10 ms

/// Step from hover at rest.
struct Step {
  double side, up, yaw;  // [m], [m], [rad]

  ReferencePoint operator()(double time) const {
    ReferencePoint point = hover(time);
    point.position += Eigen::Vector3d(side, 0.0, up);
    point.orientation = quaternion_from_yaw(yaw);
    return point;
  }
};

struct Flight {
  int not_solved = 0;     // ticks
  int violating = 0;      // ticks after 0.1 s whose last plan violates more than it relaxed by 0.1
  double astray = 0.0;    // largest distance from the plane of the step [m]
  double distance = 0.0;  // from the goal, at the end [m]

  template <typename Result>
  void add(int tick, const Result& result, const BodyStated& body) {
    const auto& report = result.report;
    not_solved += result.status != NmpcStatus::solved;
    violating += tick >= 10 && report.max_violation > report.largest_relaxation + 0.1;
    astray = std::max(astray, std::abs(body.position.y()));
  }
};

/// Returns `vehicle` with the largest thrusts that give `ratio` times its weight.
template <int Rotors>
Vehicle<Rotors> with_thrust_to_weight(double ratio, Vehicle<Rotors> vehicle) {
  vehicle.rotor.max_thrust = ratio * vehicle.body.mass * gravity / Rotors;
  return vehicle;
}

template <int Rotors>
PlantState<Rotors> at_rest(const ActuatorState<Rotors>& actuators) {
  PlantState<Rotors> start;
  start.body = hovering();
  start.actuators = actuators;
  return start;
}

template <int Rotors>
Flight fly_by_wrench(const Vehicle<Rotors>& vehicle, const Step& step) {
  const Allocation<Rotors> allocation(vehicle);
  Nmpc<Rotors> nmpc(vehicle, in_simulated_time(nmpc_settings(vehicle)));
  AllocationResult<Rotors> sent = test_support::level_hover(allocation, vehicle);
  Plant<Rotors> plant(vehicle);
  plant.reset(at_rest<Rotors>(sent.command));
  Flight flight;
  for (int i = 0; i < ticks; ++i) {
    const double time = plant.time();
    (void)nmpc.prepare(time, step, in_the_air({}));
    const NmpcResult& result = nmpc.feedback(time, plant.body());
    flight.add(i, result, plant.body());
    sent = allocation.allocate(time, result.wrench, result.rate, sent);
    EXPECT_TRUE(plant.step(sent.command, {}, 0.01));
  }
  flight.distance = (step(0.0).position - plant.body().position).norm();
  return flight;
}

template <int Rotors>
Flight fly_by_actuators(const Vehicle<Rotors>& vehicle, const Step& step) {
  ActuatorNmpc<Rotors> nmpc(vehicle, in_simulated_time(actuator_nmpc_settings(vehicle)));
  Plant<Rotors> plant(vehicle);
  plant.reset(at_rest<Rotors>(nmpc.result().command));
  Flight flight;
  for (int i = 0; i < ticks; ++i) {
    const double time = plant.time();
    (void)nmpc.prepare(time, step, in_the_air({}));
    const auto& result = nmpc.feedback(time, plant.body(), plant.actuators());
    flight.add(i, result, plant.body());
    EXPECT_TRUE(plant.step(result.command, {}, 0.01));
  }
  flight.distance = (step(0.0).position - plant.body().position).norm();
  return flight;
}

template <typename Fly>
void expect_arrival(const Fly& fly) {
  const std::vector<double> ratios =
      test_support::full_run() ? std::vector{1.5, 1.2, 1.08, 1.03} : std::vector{1.2, 1.03};
  for (const double ratio : ratios)
    for (const Step& step : {Step{0.0, 3.0, 0.0}, {3.0, 3.0, 1.5}, {5.0, 0.0, 0.0}}) {
      SCOPED_TRACE(testing::Message() << "thrust to weight " << ratio << ", step " << step.side
                                      << ", " << step.up << " m, " << step.yaw << " rad");
      const Flight flight = fly(ratio, step);
      EXPECT_LT(flight.distance, 0.01);
      EXPECT_LT(flight.astray, 0.3);
      EXPECT_LE(flight.violating, 5);
      EXPECT_LE(flight.not_solved, 300);
    }
}

TEST(ThrustLimitFlights, TiltRopterByWrench) {
  expect_arrival([](double ratio, const Step& step) {
    return fly_by_wrench<4>(with_thrust_to_weight<4>(ratio, tilt_ropter_vehicle()), step);
  });
}

TEST(ThrustLimitFlights, TiltRopterByActuators) {
  expect_arrival([](double ratio, const Step& step) {
    return fly_by_actuators<4>(with_thrust_to_weight<4>(ratio, tilt_ropter_vehicle()), step);
  });
}

TEST(ThrustLimitFlights, HexacopterByWrench) {
  expect_arrival([](double ratio, const Step& step) {
    return fly_by_wrench<6>(with_thrust_to_weight<6>(ratio, test_support::tilting_hexacopter()),
                            step);
  });
}

TEST(ThrustLimitFlights, HexacopterByActuators) {
  expect_arrival([](double ratio, const Step& step) {
    return fly_by_actuators<6>(with_thrust_to_weight<6>(ratio, test_support::tilting_hexacopter()),
                               step);
  });
}

// No rotor tilts: the force turns with the body alone.
TEST(ThrustLimitFlights, QuadrotorByActuators) {
  expect_arrival([](double ratio, const Step& step) {
    return fly_by_actuators<4>(with_thrust_to_weight<4>(ratio, test_support::flat_quadrotor()),
                               step);
  });
}

}  // namespace thrust_limit_flights_test
}  // namespace tilt_ropter
