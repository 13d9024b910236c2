// The position of the world's origin does not change a flight. Height zero has no special meaning;
// only the height of the ground matters.
// CTest: flight

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/check_table.hpp"
#include "support/hovering.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace tilt_ropter {
namespace origin_test {

struct Flight {
  std::vector<Eigen::Vector3d> positions;
  double rmse = 0.0;
  int mode_changes = 0;
  bool on_ground = false;
};

// Flies `reference` for `duration` [s]. The reference is in the plant's world frame, where the
// ground is at height zero. The world frame of the controller has its origin `up` [m] higher.
template <typename Reference>
Flight fly(const Reference& reference, double up, double duration, bool from_hover) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Plant<4> plant(vehicle);
  const Allocation allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body);
  ContactEstimator contact(vehicle);
  Nmpc<4> nmpc(vehicle, test_support::in_simulated_time());
  AllocationResult<4> sent;
  if (from_hover) {
    sent = test_support::level_hover(allocation, vehicle);
    BodyStated hovering;
    hovering.position = reference(0.0).position;
    plant.reset(hovering, sent.command);
    actuators.reset(sent.command, 0.0);
  }
  const auto on_board = [&](double time) {
    ReferencePoint point = reference(time);
    point.position.z() -= up;
    return point;
  };
  const Wrenchd wind{Eigen::Vector3d(0.3, -0.2, 0.1), Eigen::Vector3d::Zero()};
  Flight flight;
  double squares = 0.0;
  const long ticks = std::lround(duration / 0.01);
  for (long i = 0; i < ticks; ++i) {
    const double time = plant.time();
    const ActuatorState<4> applied{plant.actuators().rotor_speed,
                                   actuators.update(time, sent.command).tilt_angle};
    const ObservedWrenchd& observed =
        observer.update(time, plant.inertial_sample(), allocation.wrench(applied));
    BodyStated measured = plant.body();
    measured.position.z() -= up;
    contact.update(time, measured, observed);
    EXPECT_EQ(nmpc.prepare(time, on_board, contact.estimate()),
              optimal_control::PrepareStatus::prepared);
    const NmpcResult& result = nmpc.feedback(time, measured);
    sent = allocation.allocate(time, result.wrench, result.rate, sent);
    actuators.update(time, sent.command);
    for (int j = 0; j < 10; ++j) EXPECT_TRUE(plant.step(sent.command, wind, 1e-3));
    flight.positions.push_back(plant.body().position);
    squares += (plant.body().position - reference(plant.time()).position).squaredNorm();
  }
  flight.rmse = std::sqrt(squares / static_cast<double>(ticks));
  flight.mode_changes = contact.mode_changes();
  flight.on_ground = contact.estimate().on_ground;
  return flight;
}

ReferencePoint sway(double time) {
  ReferencePoint point;
  const double w = 1.0, a = 0.4;
  point.position << a * std::sin(w * time), 0.0, 1.5 + a * (1.0 - std::cos(w * time));
  point.velocity << a * w * std::cos(w * time), 0.0, a * w * std::sin(w * time);
  point.acceleration << -a * w * w * std::sin(w * time), 0.0, a * w * w * std::cos(w * time);
  return point;
}

double largest_difference(const Flight& a, const Flight& b) {
  double largest = 0.0;
  for (std::size_t i = 0; i < a.positions.size(); ++i)
    largest = std::max(largest, (a.positions[i] - b.positions[i]).norm());
  return largest;
}

TEST(Origin, FlightInTheAirDoesNotDependOnTheOrigin) {
  const Flight here = fly(sway, 0.0, 10.0, true);
  EXPECT_EQ(here.mode_changes, 0);
  for (const double up : {1.5, 2.0, 3.0, -40.0}) {
    const Flight there = fly(sway, up, 10.0, true);
    EXPECT_EQ(there.mode_changes, 0) << up;
    test_support::check_at_most(24, "RMSE with another origin, differs by [m]",
                                std::abs(there.rmse - here.rmse), 1e-4);
    EXPECT_LT(largest_difference(here, there), 1e-3) << up;
  }
}

TEST(Origin, MissionDoesNotDependOnTheOrigin) {
  const Mission mission = hybrid_mission(tilt_ropter_vehicle());
  const auto reference = [&](double time) { return mission(time); };
  const Flight here = fly(reference, 0.0, mission.duration(), false);
  EXPECT_EQ(here.mode_changes, 4);
  EXPECT_TRUE(here.on_ground);
  for (const double up : {1.5, 3.0}) {
    const Flight there = fly(reference, up, mission.duration(), false);
    EXPECT_EQ(there.mode_changes, 4) << up;
    EXPECT_TRUE(there.on_ground);
    test_support::check_at_most(24, "RMSE with another origin, differs by [m]",
                                std::abs(there.rmse - here.rmse), 1e-4);
  }
}

// Flight from a roof down to the street. The reference goes below the ground of the take-off, and
// the vehicle must follow it. The plant's ground is the street. The contact estimator knows the
// roof, because its first updates show a vehicle that stands on the roof.
TEST(Origin, FliesBelowTheGroundOfTheTakeOff) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  ObservedWrenchd observed;
  const auto see = [&](double time, const Wrenchd& external) {
    return observed = unfiltered_wrench(observed, time, external);
  };
  Plant<4> plant(vehicle);
  const Allocation allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  ContactEstimator contact(vehicle);
  Nmpc<4> nmpc(vehicle, test_support::in_simulated_time());
  Wrenchd weight;
  weight.force.z() = vehicle.body.mass * gravity;
  BodyStated x;
  x.position.z() = 3.0 + vehicle.wheels->radius;
  double time = -2.0;
  for (; time < -1.0; time += 0.01) contact.update(time, x, see(time, weight));
  ASSERT_TRUE(contact.estimate().on_ground);
  for (; time < -0.5; time += 0.01) contact.update(time, x, see(time, {}));
  x.position.z() = 3.5;
  for (; time < 0.0; time += 0.01) contact.update(time, x, see(time, {}));
  ASSERT_FALSE(contact.estimate().on_ground);

  AllocationResult<4> sent = test_support::level_hover(allocation, vehicle);
  plant.reset(x, sent.command);
  actuators.reset(sent.command, 0.0);
  const auto street = [](double now) {  // 2.5 m down in 5 s, then constant
    ReferencePoint point;
    point.position.z() = 3.5 - 0.5 * std::min(now, 5.0);
    point.velocity.z() = now < 5.0 ? -0.5 : 0.0;
    return point;
  };
  for (int i = 0; i < 1500; ++i) {
    contact.update(plant.time() + 0.01, plant.body(), see(plant.time() + 0.01, {}));
    EXPECT_EQ(nmpc.prepare(plant.time(), street, contact.estimate()),
              optimal_control::PrepareStatus::prepared);
    const NmpcResult& result = nmpc.feedback(plant.time(), plant.body());
    sent = allocation.allocate(plant.time(), result.wrench, result.rate, sent);
    ASSERT_TRUE(plant.step(sent.command, {}, 0.01));
  }
  EXPECT_NEAR(plant.body().position.z(), 1.0, 0.01);
  EXPECT_LT(plant.body().velocity.norm(), 0.01);
  EXPECT_EQ(plant.normal_forces().sum(), 0.0);
}

}  // namespace origin_test
}  // namespace tilt_ropter
