#include <tilt_ropter/actuation/allocation.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

#include "support/allocation_paths.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

namespace allocation_reach_test {

using namespace tilt_ropter;
using test_support::Random;

constexpr double degree = pi / 180.0;

template <int Rotors>
Vehicle<Rotors> with_range(Vehicle<Rotors> vehicle, double lower, double upper) {
  vehicle.servo.min_angle = lower * degree;
  vehicle.servo.max_angle = upper * degree;
  return vehicle;
}

/// Random thrusts and angles within limits. For odd `kind`, about 60 % of them are exactly at a
/// limit.
template <int Rotors>
ActuatorState<Rotors> within_limits(const Vehicle<Rotors>& vehicle, Random& random, int kind) {
  const auto between = [&](double low, double high) {
    const double where = random.uniform(0.0, 1.0), value = random.uniform(low, high);
    if (kind % 2 == 0 || where > 0.6) return value;
    return where < 0.3 ? low : high;
  };
  ActuatorState<Rotors> state;
  for (int i = 0; i < Rotors; ++i) {
    const double thrust = between(vehicle.rotor.min_thrust, vehicle.rotor.max_thrust);
    const double angle = between(vehicle.servo.min_angle, vehicle.servo.max_angle);
    state.rotor_speed(i) = speed_from_thrust(thrust, vehicle.rotor);
    if (vehicle.rotors[static_cast<std::size_t>(i)].tilts) state.tilt_angle(i) = angle;
  }
  return state;
}

/// Returns the largest error [N, N m] of the wrench that the command's speeds and angles give.
/// Every wanted wrench is reachable. Arms that wait at the end of their range are left out;
/// `waiting` is the fraction of wrenches with such arms.
template <int Rotors>
double worst_error(const Vehicle<Rotors>& vehicle, int wrenches, double& waiting) {
  const Allocation<Rotors> allocation(vehicle);
  const auto matrix = AllocationMatrix<Rotors>(vehicle).matrix;
  Random random(21);
  ActuatorState<Rotors> last;
  double worst = 0.0;
  int waits = 0;
  for (int i = 0; i < wrenches; ++i) {
    const auto truth = within_limits(vehicle, random, i);
    const Eigen::Matrix<double, 6, 1> wanted = matrix * test_support::thrusts_of(vehicle, truth);
    // Start from rest, from a random command, or from the last command.
    if (i % 3 == 0) last = {};
    if (i % 3 == 1) last = within_limits(vehicle, random, 0);
    const auto result = allocation.allocate({wanted.head<3>(), wanted.tail<3>()}, last);
    last = result.command;
    if (result.status == AllocationStatus::range_end_held) {
      ++waits;
      continue;
    }
    const Eigen::Matrix<double, 6, 1> given =
        matrix * test_support::thrusts_of(vehicle, result.command);
    worst = std::max(worst, (given - wanted).cwiseAbs().maxCoeff());
  }
  waiting = static_cast<double>(waits) / wrenches;
  return worst;
}

template <int Rotors>
void expect_all_given(const std::string& name, const Vehicle<Rotors>& vehicle, int quick,
                      double most_waiting) {
  SCOPED_TRACE(name);
  double waiting = 0.0;
  const double worst = worst_error(vehicle, test_support::quick_or_full(quick, 50000), waiting);
  test_support::check_at_most(26, "allocation, " + name + ": error within reach [N, N m]", worst,
                              1e-6);
  EXPECT_LE(waiting, most_waiting);
}

TEST(AllocationReach, GivesAllReachableWrenchesForAllServoRanges) {
  for (const double range :
       {10.0,  15.0,  20.0,  30.0,  45.0,  60.0,  75.0,  90.0,  90.5,  100.0, 110.0,
        120.0, 135.0, 150.0, 160.0, 170.0, 175.0, 179.0, 180.0, 190.0, 200.0})
    expect_all_given("+-" + std::to_string(range), with_range(tilt_ropter_vehicle(), -range, range),
                     2000, range > 90.0 ? 0.05 : 0.0);
}

TEST(AllocationReach, GivesAllReachableWrenchesForAsymmetricRanges) {
  for (const auto& [lower, upper] : {std::pair{-20.0, 70.0},
                                     {5.0, 80.0},
                                     {-10.0, 170.0},
                                     {-60.0, 200.0},
                                     {100.0, 330.0},
                                     {-30.0, 300.0}})
    expect_all_given(std::to_string(lower) + " to " + std::to_string(upper),
                     with_range(tilt_ropter_vehicle(), lower, upper), 2000, 0.05);
}

TEST(AllocationReach, GivesAllReachableWrenchesWithSixAndEightRotors) {
  Vehicle<8> tilting = test_support::omnidirectional_octocopter();
  Vehicle<8> mixed = tilting;
  for (std::size_t i = 0; i < 8; ++i) {
    tilting.rotors[i].tilts = true;
    mixed.rotors[i].tilts = i % 2 == 0;
  }
  expect_all_given("8 fixed", test_support::omnidirectional_octocopter(), 2000, 0.0);
  for (const double range : {15.0, 60.0, 120.0, 170.0, 180.0, 200.0}) {
    const std::string name = "+-" + std::to_string(range);
    expect_all_given("6, " + name, with_range(test_support::tilting_hexacopter(), -range, range),
                     1000, 0.05);
    expect_all_given("8, " + name, with_range(tilting, -range, range), 500, 0.05);
    expect_all_given("4 of 8 tilt, " + name, with_range(mixed, -range, range), 500, 0.05);
  }
}

TEST(AllocationReach, GivesAllReachableWrenchesWithActuatorFailures) {
  for (const double range : {20.0, 60.0, 120.0, 180.0}) {
    const Vehicle<4> v = with_range(tilt_ropter_vehicle(), -range, range);
    expect_all_given("weak", with_weak_rotor(v, 3, 0.3), 2000, 0.05);
    expect_all_given("lost", with_weak_rotor(v, 0, 0.0), 2000, 0.05);
    expect_all_given("stuck", with_stuck_servo(v, 1, 0.4), 2000, 0.05);
    const Vehicle<6> six = with_range(test_support::tilting_hexacopter(), -range, range);
    expect_all_given(
        "6, weak and lost and stuck",
        with_stuck_servo(with_weak_rotor(with_weak_rotor(six, 1, 0.4), 2, 0.0), 4, 0.3), 1000,
        0.05);
  }
}

TEST(AllocationReach, GivesAllReachableWrenchesWithFixedRotorMinThrust) {
  Vehicle<8> v = test_support::omnidirectional_octocopter();
  v.rotor.min_thrust = 0.5;
  expect_all_given("8 fixed that idle", v, 2000, 0.0);
}

// The thrusts of a tilting rotor with min_thrust above zero are not a convex set. If the status
// says that the wrench is given, the wrench is exact. Almost every wrench is given.
TEST(AllocationReach, GivesMostReachableWrenchesWithTiltingRotorMinThrust) {
  struct Case {
    double range, min_thrust;  // [degrees], [N]
    double lost;               // largest fraction of wrenches that are not given
  };
  // If min_thrust acts along the minimum-norm thrusts alone, 0.2 % are lost at 120 degrees and
  // 0.3 N, and 1.4 % with 1 N.
  for (const Case& c : {Case{20.0, 0.3, 0.001},
                        {60.0, 0.3, 0.003},
                        {120.0, 0.3, 0.001},
                        {180.0, 0.3, 0.001},
                        {120.0, 1.0, 0.006}}) {
    Vehicle<4> v = with_range(tilt_ropter_vehicle(), -c.range, c.range);
    v.rotor.min_thrust = c.min_thrust;
    const Allocation<4> allocation(v);
    Random random(22);
    const int wrenches = test_support::quick_or_full(3000, 100000);
    int lost = 0;
    for (int i = 0; i < wrenches; ++i) {
      const Wrenchd wanted = allocation.wrench(within_limits(v, random, 0));
      const auto result = allocation.allocate(wanted, {});
      const Wrenchd given = allocation.wrench(result.command);
      const double error =
          (given.force - wanted.force).norm() + (given.torque - wanted.torque).norm();
      if (gives_wrench(result.status)) {
        ASSERT_LT(error, 1e-9);
      }
      lost += error > 1e-6;
    }
    EXPECT_LE(lost, c.lost * wrenches) << c.range << " degrees, " << c.min_thrust << " N";
  }
}

// From angles near an end of the range, an arm that turns over may have too little thrust on its
// new side. Such thrusts are not usable, although they are within the other limits.
TEST(AllocationReach, GivesMostReachableWrenchesWithMinThrustNearTheRangeEnd) {
  for (const double range : {120.0, 170.0, 200.0}) {
    Vehicle<4> v = with_range(tilt_ropter_vehicle(), -range, range);
    v.rotor.min_thrust = 0.3;
    Vehicle<4> weak = v;  // small thrusts
    weak.rotor.max_thrust *= 0.3;
    const Allocation<4> allocation(v);
    Random random(23);
    const int wrenches = test_support::quick_or_full(1000, 30000);
    int lost = 0;
    for (int i = 0; i < wrenches; ++i) {
      ActuatorState<4> last;
      for (double& angle : last.tilt_angle)
        angle = (random.uniform(0.0, 1.0) < 0.5 ? -1.0 : 1.0) *
                (range * degree - random.uniform(0.0, 0.1));
      const Wrenchd wanted = allocation.wrench(within_limits(weak, random, 0));
      const auto result = allocation.allocate(wanted, last);
      const Wrenchd given = allocation.wrench(result.command);
      lost += (given.force - wanted.force).norm() + (given.torque - wanted.torque).norm() > 1e-6;
    }
    EXPECT_LE(lost, 0.005 * wrenches) << range;
  }
}

}  // namespace allocation_reach_test
