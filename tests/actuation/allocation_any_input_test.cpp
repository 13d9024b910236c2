// Any input gives a finite command within limits, or is rejected.
// CTest: optimised

#include <tilt_ropter/actuation/allocation.hpp>

#include "support/allocation_checks.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <limits>
#include <vector>

namespace allocation_any_input_test {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::difference;
using test_support::expect_within_limits;
using test_support::hovering;
using test_support::largest;
using test_support::Random;
using test_support::runs;
using test_support::with_tilt_range;

using Status = AllocationStatus;
constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

TEST(Allocation, NonFiniteSensorValuesCountAsZeroThrust) {
  const Allocation allocation(tilt_ropter_vehicle());
  ActuatorState<4> state = hovering(tilt_ropter_vehicle());
  ActuatorState<4> without = state;
  without.rotor_speed(0) = without.rotor_speed(1) = without.rotor_speed(2) = 0.0;
  state.rotor_speed(0) = nan;
  state.rotor_speed(1) = 1e300;
  state.tilt_angle(2) = infinity;
  EXPECT_LT(largest(difference(allocation.wrench(state), allocation.wrench(without))), 1e-15);
}

TEST(Allocation, RejectsNonFiniteInputAndRepeatsLastCommand) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  const ActuatorState<4> last = hovering(vehicle);
  for (const double bad : {nan, infinity, -infinity}) {
    Wrenchd wanted;
    wanted.torque.y() = bad;
    const auto result = allocation.allocate(wanted, last);
    EXPECT_EQ(result.status, Status::rejected);
    EXPECT_EQ(result.command.rotor_speed, last.rotor_speed);
    EXPECT_EQ(result.command.tilt_angle, last.tilt_angle);
    EXPECT_LT(largest(difference(result.achieved, allocation.wrench(last))), 1e-15);
    EXPECT_EQ(largest(result.lost), 0.0);
    ActuatorState<4> broken = last;
    broken.tilt_angle(1) = bad;
    broken.rotor_speed(2) = bad;
    const auto repaired = allocation.allocate(wanted, broken);
    EXPECT_EQ(repaired.status, Status::rejected);
    expect_within_limits(vehicle, repaired.command);
    EXPECT_EQ(repaired.command.tilt_angle(0), last.tilt_angle(0));
  }
}

// Telemetry that fails must not stop a motor.
TEST(Allocation, ToleratesNonFiniteTelemetry) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  const ActuatorState<4> last = hovering(vehicle);
  const Wrenchd wanted{Vector3d(1.0, -0.5, 14.0), Vector3d(0.0, 0.1, 0.0)};
  const auto expected = allocation.allocate(wanted, last);
  for (const double bad : {nan, infinity, -infinity})
    for (int rotor = 0; rotor < 4; ++rotor) {
      ActuatorState<4> told = last;
      told.rotor_speed(rotor) = bad;
      const auto result = allocation.allocate(wanted, told);
      EXPECT_EQ(result.status, expected.status);
      EXPECT_EQ(result.command.rotor_speed, expected.command.rotor_speed);
      EXPECT_EQ(result.command.tilt_angle, expected.command.tilt_angle);
      for (const double angle : {bad, 1e300, -1e300, 1e9, 5e-324}) {
        told.tilt_angle(rotor) = angle;
        EXPECT_LT(largest(difference(allocation.allocate(wanted, told).achieved, wanted)), 1e-10);
        AllocationResult<4> before;
        before.command = told;
        before.achieved.force.setConstant(bad);
        before.lost.torque.setConstant(bad);
        before.time = bad;
        const auto timed = allocation.allocate(1.0, wanted, {}, before);
        EXPECT_LT(largest(difference(timed.achieved, wanted)), 1e-10);
        expect_within_limits(vehicle, timed.command);
        EXPECT_TRUE(is_finite(timed.achieved) && is_finite(timed.lost));
      }
    }
}

TEST(Allocation, AnyInputGivesAFiniteCommandWithinLimits) {
  const std::vector<double> pool{nan,  infinity, -infinity, 0.0,   5e-324, 1e300, -1e300,
                                 1e-9, 1.0,      -3.0,      100.0, -0.02,  15.0};
  const Vehicle<4> vehicles[] = {tilt_ropter_vehicle(), with_tilt_range(-1.5, 1.5),
                                 with_tilt_range(-2, 2.5)};
  Random random(17);
  const auto pick = [&] { return pool[static_cast<std::size_t>(random.uniform(0.0, 12.999))]; };
  for (Vehicle<4> vehicle : vehicles) {
    for (const double min_thrust : {0.0, 0.4}) {
      vehicle.rotor.min_thrust = min_thrust;
      const Allocation allocation(vehicle);
      for (int i = 0; i < runs(5000); ++i) {
        Wrenchd wanted;
        ActuatorState<4> last;
        for (int k = 0; k < 3; ++k) {
          // Most wrenches are finite, so that only some are rejected.
          wanted.force(k) = i % 3 == 0 ? pick() : random.uniform(-30.0, 30.0);
          wanted.torque(k) = i % 5 == 0 ? pick() : random.uniform(-2.0, 2.0);
        }
        for (int k = 0; k < 4; ++k) {
          last.rotor_speed(k) = i % 7 == 0 ? pick() : 1000.0;
          last.tilt_angle(k) = i % 7 == 1 ? pick() : 0.0;
        }
        const auto result = allocation.allocate(wanted, last);
        expect_within_limits(vehicle, result.command);
        ASSERT_TRUE(is_finite(result.achieved) && is_finite(result.lost));
        ASSERT_TRUE(all_finite(allocation.rates(wanted, wanted).tilt_rate));
        ASSERT_EQ(result.status == Status::rejected, !is_finite(wanted));
      }
    }
  }
}

}  // namespace allocation_any_input_test
