// After construction and a few ticks no function of the control loop at the actuator level uses the
// heap, except NLopt.
// CTest: alone

#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include "support/actuator_loop.hpp"
#include "support/allocation_counter.hpp"
#include "support/loop_watch.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <set>

namespace tilt_ropter {
namespace heap_in_the_actuator_level_test {

using test_support::expect_nlopt_within_documented_bounds;
using test_support::HeapInTheLoop;
using test_support::Random;
using test_support::ticks;

// Repeated jumps of the reference, on the ground and in the air, with bad measurements and
// references.
TEST_F(HeapInTheLoop, ActuatorLevelInAirAndOnGround) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.servo.dead_time = 0.015;
  vehicle.servo.max_rate = 2.0;  // makes constraints active
  vehicle.battery.nominal_voltage = 20.0;
  ActuatorNmpcSettings settings = test_support::in_simulated_time(actuator_nmpc_settings(vehicle));
  ActuatorNmpc<4> nmpc(vehicle, settings);
  const ActuatedBody<4> body(vehicle);
  ActuatedState<4> x;
  x.body.position << 0.0, 0.0, 1.5;
  ActuatorState<4> actuators = nmpc.result().command;
  std::set<NmpcStatus> reached;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    const double time = 0.01 * i;
    const int fault = i % 60 == 30 ? 1 : i % 60 == 45 ? 2 : i % 400 > 370 ? 1 : 0;
    const auto reference = [&](double) {
      ReferencePoint point;
      point.position << (i / 200 % 2 == 0 ? 1.0 : -1.0), 0.5, i / 400 % 2 == 0 ? 1.5 : 0.11;
      if (fault == 2) point.position.x() = std::numeric_limits<double>::quiet_NaN();
      return point;
    };
    ContactEstimate contact = in_the_air({});
    contact.on_ground = i / 400 % 2 == 1;
    if (contact.on_ground) contact.ground.height = 0.0;
    if (i % 25 == 0) {
      settings.problem.weights.position.x() = i % 2 == 0 ? 200.0 : 240.0;
      watch("set_settings", [&] { nmpc.set_settings(settings); });
    }
    (void)watch("set_voltage", [&] { return nmpc.set_voltage(20.0 - 0.001 * time); });
    (void)watch("prepare", [&] { return nmpc.prepare(time, reference, contact); });
    BodyStated delivered = x.body;
    if (fault == 1) delivered.velocity.x() = std::numeric_limits<double>::infinity();
    const ActuatorNmpcResult<4>& result = watch("feedback", [&]() -> const ActuatorNmpcResult<4>& {
      return nmpc.feedback(time, delivered, actuators);
    });
    reached.insert(result.status);
    Eigen::Matrix<double, 8, 1> rates;
    rates << result.thrust_rate, result.tilt_rate;
    x.thrust = result.thrust;
    x.tilt_angle = result.tilt_angle;
    x = watch("ActuatedBody", [&] { return body.step(x, rates, {}, 0.01); });
    x.body.position.z() = std::max(x.body.position.z(), 0.11);
    actuators = watch("command_for", [&] { return nmpc.command_for(body.wrench(x)); });
    actuators.tilt_angle = x.tilt_angle;
  }
  EXPECT_GE(reached.size(), 3U);
  expect_nlopt_within_documented_bounds();
}

}  // namespace heap_in_the_actuator_level_test
}  // namespace tilt_ropter
