// Limits of the usual range: periods from 0.1 to 50 ms, horizons from 2 to 200 intervals, vehicles
// from 30 g to 100 kg.

#include "support/hovering.hpp"
#include "support/random.hpp"
#include "support/simulated_time.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace edge_of_use_test {

using test_support::hover;

/// The Tilt-Ropter, scaled in length so that it has this `mass` [kg]. The mass grows with the cube
/// of the length, the inertia with the fifth power and the thrust with the mass. Lags and servo
/// speeds stay the same.
Vehicle<4> scaled_vehicle(double mass) {
  Vehicle<4> v = tilt_ropter_vehicle();
  const double by_mass = mass / v.body.mass, scale = std::cbrt(by_mass);
  v.body.mass = mass;
  v.body.inertia *= by_mass * scale * scale;
  for (RotorGeometry& rotor : v.rotors) rotor.position *= scale;
  v.rotor.thrust_coefficient *= by_mass;
  v.rotor.max_thrust *= by_mass;
  v.rotor.torque_ratio *= scale;
  v.wheels->radius *= scale;
  v.wheels->half_track *= scale;
  return v;
}

/// Hovers for 4 s against an external force of a tenth of the weight. Returns the position error
/// [m].
double hover_error(const Vehicle<4>& vehicle, const NmpcSettings& settings, double period) {
  const double by_mass = vehicle.body.mass / tilt_ropter_vehicle().body.mass;
  Vehicle<4> truth = vehicle;
  truth.wheels->inertia *= std::pow(by_mass, 5.0 / 3.0);  // avoids tiny substeps
  Plant<4> plant(truth);
  AllocationSettings of_allocation;
  of_allocation.hold_thrust *= by_mass;
  const Allocation<4> allocation(vehicle, of_allocation);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body);
  Nmpc<4> nmpc(vehicle, test_support::in_simulated_time(settings));
  PlantState<4> start = plant.state();
  start.body.position << 0.1, -0.1, 1.5;
  Wrenchd pull;
  pull.force.x() = 0.1 * vehicle.body.mass * gravity;
  AllocationResult<4> sent = test_support::level_hover(allocation, vehicle);
  start.actuators = sent.command;
  plant.reset(start);
  actuators.reset(sent.command, 0.0);
  const long ticks = std::lround(4.0 / period);
  const long control = std::max(1L, std::lround(0.01 / period));  // NMPC at 100 Hz or every tick
  int failures = 0;
  for (long i = 0; i < ticks; ++i) {
    const double time = plant.time();
    (void)observer.update(
        time, plant.inertial_sample(),
        allocation.wrench(ActuatorState<4>{plant.actuators().rotor_speed,
                                           actuators.update(time, sent.command).tilt_angle}));
    if (i % control == 0) {
      (void)nmpc.prepare(time, hover, in_the_air(observer.external()));
      const NmpcResult& result = nmpc.feedback(time, plant.body());
      failures += !has_plan(result.status);
      sent = allocation.allocate(time, result.wrench, result.rate, sent);
      actuators.update(time, sent.command);
    }
    EXPECT_TRUE(plant.step(sent.command, pull, period));
  }
  EXPECT_EQ(failures, 0);
  return (plant.body().position - hover(0.0).position).norm();
}

TEST(EdgeOfUse, HoversWithPeriodsFrom100usTo50ms) {
  for (const double period : {1e-4, 1e-3, 5e-3, 0.02, 0.05}) {
    SCOPED_TRACE(period);
    EXPECT_LT(hover_error(tilt_ropter_vehicle(), {}, period), 0.01);
  }
}

TEST(EdgeOfUse, HoversWithHorizonsFrom2To200Intervals) {
  for (const int intervals : {2, 5, 20, 60, 200}) {
    SCOPED_TRACE(intervals);
    NmpcSettings settings;
    settings.problem.intervals = intervals;
    settings.problem.interval = intervals < 20 ? 0.2 : 0.1;
    EXPECT_LT(hover_error(tilt_ropter_vehicle(), settings, 0.01), 0.01);
  }
}

TEST(EdgeOfUse, HoversWithMassesFrom30gTo100kg) {
  for (const double mass : {0.03, 0.3, 5.0, 100.0}) {
    SCOPED_TRACE(mass);
    EXPECT_LT(hover_error(scaled_vehicle(mass), nmpc_settings(scaled_vehicle(mass)), 0.01), 0.01);
  }
}

TEST(EdgeOfUse, SinglePrecisionAllocationWorksForEveryMass) {
  test_support::Random random(6);
  for (const double mass : {0.03, 1.5, 100.0}) {
    const Vehicle<4> vehicle = scaled_vehicle(mass);
    const Allocation<4, float> allocation(vehicle);
    const double weight = mass * gravity;
    ActuatorState<4, float> last;
    for (int i = 0; i < 1000; ++i) {
      Wrench<float> wanted;
      wanted.force =
          (Eigen::Vector3d(0.0, 0.0, weight) + random.vector(0.2 * weight)).cast<float>();
      wanted.torque =
          random.vector(0.02 * weight * vehicle.rotors[0].position.norm()).cast<float>();
      const auto result = allocation.allocate(wanted, last);
      ASSERT_EQ(result.status, AllocationStatus::ok);
      EXPECT_LT(result.lost.force.norm(), 1e-5 * weight);
      last = result.command;
    }
  }
}

}  // namespace edge_of_use_test
}  // namespace tilt_ropter
