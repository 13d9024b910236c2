#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "support/allocation_paths.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

namespace allocation_failures_test {

using namespace tilt_ropter;
using test_support::Random;
using Status = AllocationStatus;
using Vector6 = Eigen::Matrix<double, 6, 1>;

struct Case {
  std::string name;
  Vehicle<4> vehicle;
};

std::vector<Case> cases() {
  const Vehicle<4> whole = tilt_ropter_vehicle();
  Vehicle<4> idling = whole;
  idling.rotor.min_thrust = 0.3;
  return {{"servo 1 stuck at 0", with_stuck_servo(whole, 0, 0.0)},
          {"servo 2 stuck at 30 degrees", with_stuck_servo(whole, 1, pi / 6.0)},
          {"servo 3 stuck at -90 degrees", with_stuck_servo(whole, 2, -pi / 2.0)},
          {"rotor 4 at half thrust", with_weak_rotor(whole, 3, 0.5)},
          {"rotor 1 lost", with_weak_rotor(whole, 0, 0.0)},
          {"rotor 3 lost, the others idle", with_weak_rotor(idling, 2, 0.0)},
          {"servo 4 stuck at 20 degrees, rotor 2 at 0.7, idle",
           with_weak_rotor(with_stuck_servo(idling, 3, 0.35), 1, 0.7)}};
}

Vector6 packed(const Wrenchd& w) {
  Vector6 v;
  v << w.force, w.torque;
  return v;
}

Wrenchd around_hover(Random& random, double force, double torque) {
  Wrenchd w{random.vector(force), random.vector(torque)};
  w.force.z() += 14.7;
  return w;
}

/// Wrench of a command by the plant, which shares no code with the allocation.
Vector6 on_plant(Plant<4>& plant, const ActuatorState<4>& command) {
  PlantState<4> x = plant.state();
  x.actuators = command;
  plant.reset(x);
  return packed(plant.actuator_wrench());
}

TEST(AllocationFailures, StuckServoGivesSameWrenchAsHeldServo) {
  Random random(1);
  for (int i = 0; i < 200; ++i) {
    const auto arm = static_cast<std::size_t>(i % 4);
    const double angle = random.uniform(-pi, pi);
    ActuatorState<4> state;
    for (int k = 0; k < 4; ++k) {
      state.rotor_speed(k) = random.uniform(0.0, 2900.0);
      state.tilt_angle(k) = random.uniform(-pi, pi);
    }
    state.tilt_angle(i % 4) = angle;
    Plant<4> whole(tilt_ropter_vehicle());
    const Vehicle<4> vehicle = with_stuck_servo(tilt_ropter_vehicle(), arm, angle);
    Plant<4> stuck(vehicle);
    const Vector6 expected = on_plant(whole, state);
    EXPECT_LT((on_plant(stuck, state) - expected).norm(), 1e-13);
    EXPECT_LT((packed(Allocation(vehicle).wrench(state)) - expected).norm(), 1e-13);
  }
}

TEST(AllocationFailures, GivesWrenchOrReportsLossWithinLimits) {
  const int wrenches = test_support::quick_or_full(20000, 200000);
  for (const Case& failure : cases()) {
    SCOPED_TRACE(failure.name);
    const Vehicle<4>& v = failure.vehicle;
    const Allocation<4> allocation(v);
    Plant<4> plant(v);
    Random random(2);
    const double slowest = speed_from_thrust(v.rotor.min_thrust, v.rotor),
                 fastest = speed_from_thrust(v.rotor.max_thrust, v.rotor);
    ActuatorState<4> last;
    Eigen::Vector4d least = Eigen::Vector4d::Constant(fastest);
    std::vector<int> count(7, 0);
    for (int i = 0; i < wrenches; ++i) {
      const Wrenchd wanted =
          i % 2 == 0 ? around_hover(random, 4.0, 0.3) : around_hover(random, 15.0, 1.5);
      const auto result = allocation.allocate(wanted, last);
      const ActuatorState<4>& command = result.command;
      ++count[static_cast<std::size_t>(result.status)];
      ASSERT_GE(command.rotor_speed.minCoeff(), slowest);
      ASSERT_LE(command.rotor_speed.maxCoeff(), fastest);
      ASSERT_LE(command.tilt_angle.cwiseAbs().maxCoeff(), pi);
      for (int k = 0; k < 4; ++k) {
        const RotorGeometry& rotor = v.rotors[static_cast<std::size_t>(k)];
        if (!rotor.tilts) {
          ASSERT_EQ(command.tilt_angle(k), 0.0);
        }
        if (rotor.effectiveness > 0.0) continue;
        ASSERT_EQ(command.rotor_speed(k), slowest);
        ASSERT_EQ(command.tilt_angle(k), last.tilt_angle(k));
      }
      const Vector6 given = on_plant(plant, command);
      ASSERT_LT((packed(result.achieved) - given).norm(), 1e-12);
      ASSERT_LT((packed(result.achieved) + packed(result.lost) - packed(wanted)).norm(), 1e-13);
      if (gives_wrench(result.status)) {
        ASSERT_LT((given - packed(wanted)).norm(), 1e-10);
      }
      if (result.status == Status::limited && v.rotor.min_thrust <= 0.0) {
        ASSERT_LE(result.achieved.torque.norm(), wanted.torque.norm() + 0.1);
        ASSERT_LE(result.achieved.force.norm(), wanted.force.norm() + 0.1);
      }
      least = least.cwiseMin(command.rotor_speed);
      last = command;
    }
    // A weak rotor may idle at the same speed as the others, with its fraction of min_thrust.
    if (v.rotor.min_thrust > 0.0) {
      EXPECT_LT(least.maxCoeff(), 1.001 * slowest);
    }
    const int limited = count[static_cast<std::size_t>(Status::limited)];
    EXPECT_GT(wrenches - limited, wrenches / 3);
    EXPECT_GT(limited, wrenches / 20);
    EXPECT_EQ(count[static_cast<std::size_t>(Status::rejected)], 0);
  }
}

TEST(AllocationFailures, CommandsAreContinuous) {
  const auto draw = [](Random& random) { return around_hover(random, 5.0, 0.4); };
  for (const Case& failure : cases()) {
    if (failure.vehicle.rotor.min_thrust > 0.0) continue;  // with min_thrust the thrusts jump
    SCOPED_TRACE(failure.name);
    EXPECT_LT(test_support::steepest(failure.vehicle, 20, 8000, draw),
              1.2 * test_support::steepest(failure.vehicle, 20, 500, draw));
  }
}

TEST(AllocationFailures, WeakRotorTurnsFasterAndRatesMatchCommands) {
  const Vehicle<4> vehicle = with_weak_rotor(tilt_ropter_vehicle(), 1, 0.5);
  const Allocation<4> allocation(vehicle), whole(tilt_ropter_vehicle());
  const Wrenchd now{{1.0, -0.5, 13.0}, {0.1, -0.05, 0.1}}, rate{{3.0, 2.0, -4.0}, {0.1, 0.2, 0.3}};
  const double h = 1e-6;
  const auto command = allocation.allocate(now, {}).command;
  Eigen::Vector4d expected = whole.allocate(now, {}).command.rotor_speed;
  expected(1) *= std::sqrt(2.0);
  EXPECT_LT((command.rotor_speed - expected).norm(), 1e-9);
  const auto next =
      allocation.allocate({now.force + h * rate.force, now.torque + h * rate.torque}, command);
  const Eigen::Vector4d difference = (next.command.rotor_speed - command.rotor_speed) / h;
  EXPECT_LT((allocation.rates(now, rate).rotor_acceleration - difference).norm(), 1e-2);
}

TEST(AllocationFailures, LostRotorHasZeroRatesAndOthersKeepTheirs) {
  const Allocation<4> allocation(with_weak_rotor(tilt_ropter_vehicle(), 2, 0.0));
  const auto rates =
      allocation.rates({{0.0, 2.0, 14.7}, {0.0, 0.0, 0.1}}, {{1.0, 0.0, 5.0}, {0.1, 0.0, 0.0}});
  EXPECT_EQ(rates.rotor_acceleration(2), 0.0);
  EXPECT_EQ(rates.tilt_rate(2), 0.0);
  EXPECT_GT(rates.rotor_acceleration.head<2>().cwiseAbs().minCoeff(), 1.0);
}

}  // namespace allocation_failures_test
