// Thrusts and tilt angles change without jumps, and arms with small thrust turn slowly.
// CTest: optimised

#include <tilt_ropter/actuation/allocation.hpp>

#include "support/allocation_checks.hpp"
#include "support/allocation_paths.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <limits>

namespace allocation_continuity_test {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::expect_within_limits;
using test_support::largest;
using test_support::omnidirectional_octocopter;
using test_support::Random;
using test_support::random_wrench;
using test_support::runs;
using test_support::steepest;
using test_support::with_tilt_range;

using Status = AllocationStatus;
constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

/// Largest change of a tilt angle per step along a path of wrenches. For thrusts above twice
/// hold_thrust, also the largest product of this change and thrust / change of the thrust vector.
struct Turning {
  double per_step = 0.0;
  double times_thrust_per_step = 0.0;
};

template <typename Path>
Turning turning(const Allocation<4>& allocation, const Path& path, double step) {
  constexpr double duration = 10.0;  // [s]
  Turning turning;
  // The first call has no earlier time, so all arms start at their target angles. Otherwise an arm
  // with small thrust would first turn slowly to its angle.
  AllocationResult<4> last = allocation.allocate(path(0.0), {});
  last.time = 0.0;
  for (double s = step; s <= 1.0; s += step) {
    const Wrenchd wanted = path(s);
    const auto result = allocation.allocate(duration * s, wanted, {}, last);
    Eigen::Matrix<double, 6, 1> packed, change;
    packed << wanted.force, wanted.torque;
    const Wrenchd before = path(s - step);
    change << wanted.force - before.force, wanted.torque - before.torque;
    const Eigen::Matrix<double, 8, 1> thrusts = allocation.pseudoinverse() * packed;
    const Eigen::Matrix<double, 8, 1> changes = allocation.pseudoinverse() * change;
    for (int i = 0; i < 4; ++i) {
      const double turn = std::abs(result.command.tilt_angle(i) - last.command.tilt_angle(i));
      turning.per_step = std::max(turning.per_step, turn);
      const double thrust = thrusts.segment<2>(2 * i).norm();
      if (thrust > 0.04)
        turning.times_thrust_per_step = std::max(turning.times_thrust_per_step,
                                                 turn * thrust / changes.segment<2>(2 * i).norm());
    }
    last = result;
  }
  return turning;
}

TEST(Allocation, AnglesAreContinuousThroughZeroThrust) {
  const Allocation allocation(with_tilt_range(-6.0 * pi, 6.0 * pi));
  Random random(11);
  for (int run = 0; run < runs(60); ++run) {
    // Through zero thrust exactly, or past it at a small or larger distance.
    const double miss = run % 3 == 0 ? 0.0 : std::pow(10.0, random.uniform(-6.0, 0.0));
    const Wrenchd along = random_wrench(random, 2.0, 0.1), aside = random_wrench(random, 2.0, 0.1);
    const auto path = [&](double s) {
      const double t = 2.0 * s - 1.0;
      return Wrenchd{t * along.force + miss * aside.force, t * along.torque + miss * aside.torque};
    };
    const Turning coarse = turning(allocation, path, 4e-4);
    const Turning fine = turning(allocation, path, 1e-5);
    // The fine path has 40 times the steps. At zero thrust the turn per step falls with step^(2/3),
    // here by a factor of 11.7.
    EXPECT_LT(fine.per_step, 0.04) << run;
    EXPECT_LT(fine.per_step, 0.2 * coarse.per_step) << run;
    EXPECT_LT(fine.times_thrust_per_step, 1.01) << run;
  }
}

TEST(Allocation, AnglesAreContinuousThroughPi) {
  const Allocation allocation(with_tilt_range(-6.0 * pi, 6.0 * pi));
  Random random(12);
  for (int run = 0; run < 30; ++run) {
    // A force that rotates twice about a random axis.
    const Vector3d axis = random.vector(1.0).normalized(), start = axis.unitOrthogonal() * 10.0;
    const auto path = [&](double s) {
      const Vector3d force = Eigen::AngleAxisd(4.0 * pi * s, axis) * start;
      return Wrenchd{force, Vector3d(0.05, 0.0, 0.1)};
    };
    EXPECT_LT(turning(allocation, path, 1e-4).times_thrust_per_step, 1.01);
  }
  // If the force rotates about body y, the two side arms rotate with it, past pi and on to 4 pi.
  ActuatorState<4> last;
  for (int i = 0; i <= 4000; ++i) {
    const double angle = 4.0 * pi * i / 4000.0;
    const auto result = allocation.allocate(
        {Vector3d(10.0 * std::sin(angle), 0.0, 10.0 * std::cos(angle)), Vector3d::Zero()}, last);
    ASSERT_LT((result.command.tilt_angle - last.tilt_angle).head<2>().cwiseAbs().maxCoeff(), 0.02);
    last = result.command;
  }
  EXPECT_NEAR(std::abs(last.tilt_angle(0)), 4.0 * pi, 1e-9);
}

TEST(Allocation, TakesEquivalentAngleAtEndOfServoRange) {
  const Vehicle<4> vehicle = with_tilt_range(-pi, pi);
  const Allocation allocation(vehicle);
  ActuatorState<4> last;
  int turned_over = 0;
  for (int i = 0; i <= 4000; ++i) {
    const double angle = 4.0 * pi * i / 4000.0;
    const auto result = allocation.allocate(
        {Vector3d(10.0 * std::sin(angle), 0.0, 10.0 * std::cos(angle)), Vector3d::Zero()}, last);
    // Two arms of 5 N wait at the end of the range, each by up to the margin.
    const double held = 10.0 * std::sin(AllocationSettings{}.range_end_margin);
    ASSERT_LT(largest(result.lost), result.status == Status::range_end_held ? held : 1e-10);
    expect_within_limits(vehicle, result.command);
    const Eigen::Array4d turn = (result.command.tilt_angle - last.tilt_angle).cwiseAbs();
    ASSERT_EQ((turn > pi + 1e-5).count(), result.turned_over);
    if (result.turned_over > 0) {
      ASSERT_EQ(result.status, Status::turned_over);
    }
    turned_over += result.turned_over;
    last = result.command;
  }
  // The path passes pi twice. Each arm turns over at most once per pass.
  EXPECT_GE(turned_over, 2);
  EXPECT_LE(turned_over, 8);
}

TEST(Allocation, ThrustsAreContinuousWhereNullSpaceIsUsed) {
  const auto draw = [](double force) {
    return [force](Random& random) { return random_wrench(random, force, 1.0); };
  };
  const Vehicle<8> octocopter = omnidirectional_octocopter();
  const int paths = test_support::quick_or_full(1, 30);
  EXPECT_LT(steepest(octocopter, paths, 4000, draw(12.0)),
            1.2 * steepest(octocopter, paths, 500, draw(12.0)));
  const Vehicle<4> narrow = with_tilt_range(-0.5 * pi, 0.5 * pi);
  const int narrow_paths = test_support::quick_or_full(4, 30);
  EXPECT_LT(steepest(narrow, narrow_paths, 8000, draw(15.0)),
            1.2 * steepest(narrow, narrow_paths, 500, draw(15.0)));
}

/// Returns the largest change per step of the commanded thrust vectors [N] along random straight
/// paths to unreachable wrenches.
double largest_jump(const Vehicle<4>& vehicle, int steps, int& limited) {
  const Allocation allocation(vehicle);
  Random random(13);
  double jump = 0.0;
  for (int run = 0; run < 30; ++run) {
    Wrenchd from = random_wrench(random, 15.0, 1.0), to = random_wrench(random, 40.0, 1.0);
    from.force.z() += 15.0;
    to.force.z() += 25.0;
    ActuatorState<4> last;
    Eigen::Matrix<double, 8, 1> thrusts, before = Eigen::Matrix<double, 8, 1>::Zero();
    for (int i = 0; i <= steps; ++i) {
      const double s = static_cast<double>(i) / steps;
      const auto result = allocation.allocate(
          {(1.0 - s) * from.force + s * to.force, (1.0 - s) * from.torque + s * to.torque}, last);
      for (int k = 0; k < 4; ++k) {
        const double angle = result.command.tilt_angle(k);
        const double thrust = thrust_from_speed(result.command.rotor_speed(k), vehicle.rotor);
        thrusts.segment<2>(2 * k) << thrust * std::sin(angle), thrust * std::cos(angle);
      }
      if (i > 0) jump = std::max(jump, (thrusts - before).norm());
      limited += result.status == Status::limited ? 1 : 0;
      before = thrusts;
      last = result.command;
    }
  }
  return jump;
}

TEST(Allocation, CommandsAreContinuousAtStartOfLimiting) {
  const Vehicle<4> vehicle = with_tilt_range(-6.0 * pi, 6.0 * pi);  // no arm turns over
  int limited = 0;
  const double coarse = largest_jump(vehicle, 1000, limited);
  EXPECT_GT(limited, 5000);
  // At the end of the reachable set the thrusts change with the square root of the path. With 16
  // times the steps the jump falls to a quarter.
  EXPECT_LT(largest_jump(vehicle, 16000, limited), 0.4 * coarse);
}

TEST(Allocation, HoldsLastAngleAtZeroThrust) {
  const Allocation allocation(tilt_ropter_vehicle());
  ActuatorState<4> last;
  last.tilt_angle << 0.3, -1.2, 2.0, 3.1;
  const auto result = allocation.allocate({}, last);
  EXPECT_EQ(result.status, Status::ok);
  EXPECT_EQ(result.command.tilt_angle, last.tilt_angle);
  EXPECT_EQ(result.command.rotor_speed.norm(), 0.0);
}

TEST(Allocation, AngleFollowsBelowHoldThrustWithSmallLoss) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  AllocationSettings settings;
  settings.hold_thrust = 0.5;
  const Allocation steady(vehicle, settings);
  const Allocation usual(vehicle);
  Wrenchd wanted;
  wanted.force << 0.6, 0.0, 0.8;  // about 0.3 N per rotor
  AllocationResult<4> last;
  last.time = 0.0;
  EXPECT_EQ(usual.allocate(0.01, wanted, {}, last).status, Status::ok);
  EXPECT_EQ(steady.allocate(wanted, {}).status, Status::ok);  // the last command is infinitely old
  auto result = steady.allocate(0.01, wanted, {}, last);
  EXPECT_EQ(result.status, Status::angle_held);
  EXPECT_GT(largest(result.lost), 1e-3);
  EXPECT_LT(result.lost.force.norm(), 4.0 * 2.0 * settings.hold_thrust);
  // If the wanted wrench persists, it is reached.
  for (int i = 2; i < 400; ++i) result = steady.allocate(0.01 * i, wanted, {}, result);
  EXPECT_EQ(result.status, Status::ok);
  EXPECT_LT(largest(result.lost), 1e-10);
}

/// Returns the tilt angles after a small sideways push of 0.1 s, with calls `dt` [s] apart.
Eigen::Vector4d angles_after(double dt) {
  const Allocation allocation(tilt_ropter_vehicle());
  AllocationResult<4> last;
  last.time = 0.0;
  const Wrenchd push{Vector3d(0.012, 0.003, 0.01), Vector3d::Zero()};
  for (int i = 1; i <= std::lround(0.1 / dt); ++i)
    last = allocation.allocate(dt * i, push, {}, last);
  return last.command.tilt_angle;
}

TEST(Allocation, AnglesBelowHoldThrustAreIndependentOfCallRate) {
  const Eigen::Vector4d fast = angles_after(1e-3);
  EXPECT_GT(fast.cwiseAbs().maxCoeff(), 0.1);
  for (const double dt : {0.1, 0.05, 0.02, 0.01, 5e-3})
    EXPECT_LT((angles_after(dt) - fast).cwiseAbs().maxCoeff(), 1e-12) << dt;
  // Closed form of each arm's angle from zero, with the time constant hold_time (h^2 / T^2 - 1).
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Eigen::Matrix<double, 6, 1> packed;
  packed << 0.012, 0.003, 0.01, 0.0, 0.0, 0.0;
  const Eigen::Matrix<double, 8, 1> thrusts = Allocation(vehicle).pseudoinverse() * packed;
  for (int i = 0; i < 4; ++i) {
    const double square = thrusts.segment<2>(2 * i).squaredNorm() / (0.02 * 0.02);
    const double target = std::atan2(thrusts(2 * i), thrusts(2 * i + 1));
    const double way =
        1.0 - std::exp(-0.1 / AllocationSettings::hold_time * square / (1.0 - square));
    EXPECT_NEAR(fast(i), way * target, 1e-12);
  }
}

TEST(Allocation, HoldsAnglesIfTimeDoesNotAdvanceAndRecovers) {
  const Allocation allocation(tilt_ropter_vehicle());
  const Wrenchd push{Vector3d(0.012, 0.0, 0.01), Vector3d::Zero()};
  AllocationResult<4> last;
  last.time = 1.0;
  for (const double time : {1.0, 0.5, nan, -infinity}) {
    const auto result = allocation.allocate(time, push, {}, last);
    EXPECT_EQ(result.command.tilt_angle, last.command.tilt_angle) << time;
    EXPECT_EQ(result.status, Status::angle_held);
    EXPECT_TRUE(std::isfinite(result.time));
  }
  // After one stamp far in the future, correct stamps follow.
  auto result = allocation.allocate(1e6, push, {}, last);
  result = allocation.allocate(1.0, push, {}, result);
  result = allocation.allocate(1.01, push, {}, result);
  EXPECT_EQ(result.time, 1.01);
  result.command = {};
  EXPECT_GT(allocation.allocate(1.02, push, {}, result).command.tilt_angle.norm(), 1e-3);
}

}  // namespace allocation_continuity_test
