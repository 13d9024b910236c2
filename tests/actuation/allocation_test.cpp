// The result is exact where the wrench is reachable and reports what is lost where it is not.
// CTest: optimised

#include <tilt_ropter/actuation/allocation.hpp>

#include "support/allocation_checks.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace allocation_test {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::difference;
using test_support::expect_within_limits;
using test_support::hovering;
using test_support::largest;
using test_support::omnidirectional_octocopter;
using test_support::Random;
using test_support::random_wrench;
using test_support::tilting_hexacopter;
using test_support::with_tilt_range;

using Status = AllocationStatus;
constexpr double infinity = std::numeric_limits<double>::infinity();

/// Scales `count`, given for 10^6 random wrenches, to the number of wrenches in expect_honest().
int of_million(int count) {
  return test_support::quick_or_full(count / 100, count);
}

/// Number of results with each status.
class Statuses {
 public:
  void add(Status status) { ++count_[static_cast<std::size_t>(status)]; }
  int operator[](Status status) const { return count_[static_cast<std::size_t>(status)]; }

 private:
  std::array<int, 7> count_{};
};

/// Groups of wrench components that are scaled together.
std::array<Vector3d, 4> groups_of(const Wrenchd& w) {
  return {Vector3d(w.torque.x(), w.torque.y(), 0.0), Vector3d(0.0, 0.0, w.force.z()),
          Vector3d(w.force.x(), w.force.y(), 0.0), Vector3d(0.0, 0.0, w.torque.z())};
}

/// Checks the properties that hold for every result of allocate(). Counts the statuses.
template <int Rotors>
void expect_honest(const Vehicle<Rotors>& vehicle, double force, double torque, unsigned seed,
                   Statuses& count) {
  const Allocation allocation(vehicle);
  Random random(seed);
  ActuatorState<Rotors> last = hovering(vehicle);
  count = {};
  const int n = of_million(1000000);
  double worst = 0.0;
  for (int i = 0; i < n; ++i) {
    const Wrenchd wanted = random_wrench(random, force, torque);
    const auto result = allocation.allocate(wanted, last);
    count.add(result.status);
    expect_within_limits(vehicle, result.command);
    const double size = std::max(1.0, largest(wanted));
    // `achieved` is the forward map of the command; `lost` is wanted minus achieved.
    ASSERT_LT(largest(difference(allocation.wrench(result.command), result.achieved)),
              1e-12 * size);
    ASSERT_LT(largest({result.achieved.force + result.lost.force - wanted.force,
                       result.achieved.torque + result.lost.torque - wanted.torque}),
              1e-14 * size);
    if (gives_wrench(result.status)) worst = std::max(worst, largest(result.lost));
    if (result.status == Status::limited && vehicle.rotor.min_thrust <= 0.0) {
      // Each group keeps its direction and does not grow. The loss of arms that wait at the end of
      // their range may have any direction.
      double h = 1e-6;
      for (int k = 0; k < Rotors; ++k)
        if (std::abs(std::abs(result.command.tilt_angle(k)) - pi) < 1e-12)
          h += vehicle.rotor.max_thrust * AllocationSettings{}.range_end_margin;
      const auto asked = groups_of(wanted), given = groups_of(result.achieved);
      for (std::size_t g = 0; g < asked.size(); ++g) {
        ASSERT_LT(given[g].cross(asked[g].normalized()).norm(), h);
        ASSERT_LT(given[g].norm(), asked[g].norm() + h);
        ASSERT_GT(given[g].dot(asked[g]), -h * asked[g].norm());
      }
    }
    last = result.command;
  }
  EXPECT_EQ(count[Status::rejected], 0);
  test_support::check_at_most(8, "allocation: loss where none is said [N, N m]", worst, 1e-10);
}

// Thrusts far below a newton: no limit is one of an absolute size.
TEST(Allocation, CarriesAVehicleOfTenGrams) {
  Vehicle<4> tiny = tilt_ropter_vehicle();
  tiny.body.mass = 0.01;
  tiny.body.inertia *= 0.01 / 1.5;
  tiny.rotor.max_thrust = 0.08;
  tiny.rotor.thrust_coefficient *= 0.08 / 12.0;
  const Allocation<4> allocation(tiny);
  for (const double lean : {0.0, 0.1, 0.25}) {  // up to more than the rotors give
    const Wrenchd wanted{{lean, 0.0, 0.1}, Vector3d::Zero()};
    const auto result = allocation.allocate(wanted, {});
    EXPECT_NEAR(allocation.wrench(result.command).force.z(), 0.1, 1e-6) << lean;
    if (lean < 0.2) {
      EXPECT_LT(largest(difference(allocation.wrench(result.command), wanted)), 1e-6) << lean;
    }
    EXPECT_GE(allocation.wrench(result.command).force.x(), 0.5 * lean) << lean;
  }
}

TEST(Allocation, TiltRopterReportsAchievedAndLostWrench) {
  Statuses count;
  expect_honest(tilt_ropter_vehicle(), 8.0, 0.5, 1, count);
  // For these wrenches almost no result is limited.
  EXPECT_LT(count[Status::limited] + count[Status::range_end_held], of_million(10000));
  expect_honest(tilt_ropter_vehicle(), 25.0, 2.0, 2, count);
  EXPECT_GT(count[Status::ok], of_million(200000));
  EXPECT_GT(count[Status::null_space_used], of_million(30000));
  EXPECT_GT(count[Status::limited], of_million(50000));
}

TEST(Allocation, KeepsServoRangesForRandomWrenches) {
  Statuses count;
  expect_honest(with_tilt_range(-0.5 * pi, 0.5 * pi), 15.0, 0.5, 3, count);
  EXPECT_GT(std::min({count[Status::ok], count[Status::null_space_used], count[Status::limited]}),
            of_million(10000));
  expect_honest(with_tilt_range(-2.0, 2.2), 15.0, 0.5, 4, count);  // not convex
  EXPECT_GT(std::min({count[Status::ok], count[Status::null_space_used], count[Status::limited]}),
            of_million(10000));
}

TEST(Allocation, KeepsMinThrustForRandomWrenches) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.rotor.min_thrust = 0.5;
  Statuses count;
  expect_honest(vehicle, 8.0, 0.5, 5, count);
  EXPECT_GT(count[Status::null_space_used],
            of_million(30000));  // the null space raises thrusts that are too small
  EXPECT_LT(count[Status::limited], of_million(1000));
}

TEST(Allocation, HexacopterReportsAchievedAndLostWrench) {
  Statuses count;
  expect_honest(tilting_hexacopter(), 35.0, 3.0, 6, count);
  EXPECT_GT(std::min({count[Status::ok], count[Status::null_space_used], count[Status::limited]}),
            of_million(10000));
}

TEST(Allocation, FixedRotorsNeverPullForRandomWrenches) {
  Statuses count;
  expect_honest(omnidirectional_octocopter(), 18.0, 1.5, 7, count);
  EXPECT_EQ(count[Status::ok], 0);  // the minimum-norm thrusts always include a negative thrust
  EXPECT_GT(std::min(count[Status::null_space_used], count[Status::limited]), of_million(10000));
  Vehicle<8> idling = omnidirectional_octocopter();
  idling.rotor.min_thrust = 0.5;
  expect_honest(idling, 8.0, 0.5, 8, count);
  EXPECT_GT(count[Status::null_space_used], of_million(500000));
}

TEST(Allocation, FloatReachesFloatPrecision) {
  const Allocation<4, float> allocation(tilt_ropter_vehicle());
  Random random(9);
  ActuatorState<4, float> last;
  for (int i = 0; i < 20000; ++i) {
    const Wrenchd wanted = random_wrench(random, 20.0, 1.5);
    const auto result =
        allocation.allocate({wanted.force.cast<float>(), wanted.torque.cast<float>()}, last);
    if (gives_wrench(result.status)) {
      ASSERT_LT(result.lost.force.norm(), 2e-3F);
      ASSERT_LT(result.lost.torque.norm(), 2e-3F);
    }
    ASSERT_TRUE(all_finite(result.command.rotor_speed) && all_finite(result.command.tilt_angle));
    last = result.command;
  }
}

TEST(Allocation, HoverUsesEqualVerticalThrusts) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  Wrenchd wanted;
  wanted.force.z() = vehicle.body.mass * gravity;
  const auto result = allocation.allocate(wanted, {});
  EXPECT_EQ(result.status, Status::ok);
  EXPECT_LT((result.command.rotor_speed - hovering(vehicle).rotor_speed).norm(), 1e-9);
  EXPECT_LT(result.command.tilt_angle.norm(), 1e-14);
}

/// Returns the largest rotor thrust [N], minimised over a grid of the null space.
double least_largest_thrust(const AllocationMatrix<4>& allocation, const Wrenchd& wanted) {
  Eigen::Matrix<double, 6, 1> packed;
  packed << wanted.force, wanted.torque;
  const Eigen::Matrix<double, 8, 1> base = allocation.pseudoinverse * packed;
  double least = infinity;
  for (double u = -15.0; u <= 15.0; u += 0.15) {
    for (double v = -15.0; v <= 15.0; v += 0.15) {
      const Eigen::Matrix<double, 8, 1> t = base + allocation.null_space * Eigen::Vector2d(u, v);
      double most = 0.0;
      for (int i = 0; i < 4; ++i) most = std::max(most, t.segment<2>(2 * i).norm());
      least = std::min(least, most);
    }
  }
  return least;
}

TEST(Allocation, LimitedWrenchIsNotImprovableByNullSpaceGrid) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  const AllocationMatrix<4> matrix(vehicle);
  Random random(10);
  std::array<int, 4> scaled{};
  for (int i = 0; i < 200; ++i) {
    const Wrenchd wanted = random_wrench(random, 40.0, i % 4 == 0 ? 8.0 : 2.0);
    const auto result = allocation.allocate(wanted, {});
    if (result.status != Status::limited) continue;
    // Slightly more of the first reduced group exceeds max_thrust at every point of the grid. This
    // holds with the later groups as achieved, absent or in full.
    const auto asked = groups_of(wanted), given = groups_of(result.achieved);
    std::size_t first = 0;
    while (first < 4 && (asked[first] - given[first]).norm() < 1e-5) ++first;
    ASSERT_LT(first, 4U);
    ++scaled[first];
    const bool is_torque = first == 0 || first == 3;
    for (const bool lateral_whole : {false, true})
      for (const int later : {0, 1, 2}) {
        std::array<Vector3d, 4> more = given;
        more[first] += (is_torque ? 0.03 : 0.05) * asked[first].normalized();
        for (std::size_t g = first + 1; g < 4 && later > 0; ++g)
          more[g] = later == 1 || (g == 2 && !lateral_whole) ? Vector3d::Zero() : asked[g];
        EXPECT_GT(least_largest_thrust(matrix, {more[1] + more[2], more[0] + more[3]}),
                  vehicle.rotor.max_thrust)
            << i << ' ' << first;
      }
  }
  EXPECT_GT(scaled[0], 5);
  EXPECT_GT(scaled[1] + scaled[2], 50);
}

TEST(Allocation, KeepsTorqueIfForceIsUnreachable) {
  AllocationSettings settings;
  settings.priorities = {WrenchGroup::level, WrenchGroup::yaw, WrenchGroup::lift,
                         WrenchGroup::sideways};
  const Allocation allocation(tilt_ropter_vehicle(), settings);
  const Vector3d torque(0.3, -0.2, 0.4), direction = Vector3d(1.0, -2.0, 3.0).normalized();
  const auto result = allocation.allocate({1000.0 * direction, torque}, {});
  EXPECT_EQ(result.status, Status::limited);
  EXPECT_LT((result.achieved.torque - torque).norm(), 1e-10);
  EXPECT_GT(result.achieved.force.dot(direction), 30.0);
  // The result does not depend on the magnitude of the unreachable force.
  const auto huge = allocation.allocate({1e300 * direction, torque}, {});
  EXPECT_LT((huge.achieved.force - result.achieved.force).norm(), 1e-4);
}

TEST(Allocation, ScalesUnreachableTorqueAndKeepsLift) {
  // This hexacopter with slanted fixed rotors has no null space and can only push upwards.
  Vehicle<6> vehicle = tilting_hexacopter();
  vehicle.servo.min_angle = -1.0;
  for (std::size_t i = 0; i < 6; ++i) {
    RotorGeometry& rotor = vehicle.rotors[i];
    const Eigen::AngleAxisd slant(i % 2 == 0 ? 0.5 : -0.5, Vector3d::UnitX());
    rotor.orientation = rotor.orientation * slant.toRotationMatrix();
    rotor.tilts = false;
  }
  const Allocation allocation(vehicle);
  Wrenchd hover;
  hover.force.z() = 15.0;
  EXPECT_EQ(allocation.allocate(hover, {}).status, Status::ok);
  // With 15 N of lift this roll torque is unreachable. It is scaled down, and the lift is kept.
  hover.torque.x() = 50.0;
  const auto result = allocation.allocate(hover, {});
  EXPECT_EQ(result.status, Status::limited);
  EXPECT_NEAR(result.achieved.force.z(), 15.0, 1e-3);
  EXPECT_GT(result.achieved.torque.x(), 0.5);
  EXPECT_LT(std::abs(result.achieved.torque.y()) + std::abs(result.achieved.torque.z()), 1e-9);
  // A downward force is impossible.
  const auto down = allocation.allocate({Vector3d(0.0, 0.0, -5.0), Vector3d::Zero()}, {});
  EXPECT_EQ(down.status, Status::limited);
  EXPECT_LT(largest(down.achieved), 1e-9);
  // With min_thrust above zero it cannot give a zero wrench either. It gives the smallest thrust.
  vehicle.rotor.min_thrust = 0.3;
  const auto idle = Allocation(vehicle).allocate({}, {});
  EXPECT_EQ(idle.status, Status::limited);
  expect_within_limits(vehicle, idle.command);
  EXPECT_NEAR(idle.lost.force.z(), -6.0 * 0.3 * std::cos(0.5), 1e-9);
}

}  // namespace allocation_test
