#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "support/allocation_paths.hpp"
#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

namespace {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::omnidirectional_octocopter;
using test_support::Random;
using test_support::steepest;
using test_support::tilting_hexacopter;
using test_support::with_tilt_range;

using Status = AllocationStatus;
constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

int runs(int quick) {
  return test_support::quick_or_full(quick, 10 * quick);
}

/// The same fraction of the random wrenches of expect_honest() as `count` is of 10^6.
int of_million(int count) {
  return test_support::quick_or_full(count / 100, count);
}

Wrench<> random_wrench(Random& random, double force, double torque) {
  Wrench<> w;
  w.force = random.vector(force);
  w.torque = random.vector(torque);
  return w;
}

template <int Rotors>
ActuatorState<Rotors> hovering(const Vehicle<Rotors>& vehicle) {
  ActuatorState<Rotors> state;
  state.rotor_speed.setConstant(
      speed_from_thrust(vehicle.body.mass * gravity / Rotors, vehicle.rotor.thrust_coefficient));
  return state;
}

template <int Rotors>
void expect_within_limits(const Vehicle<Rotors>& v, const ActuatorState<Rotors>& command) {
  const double c = v.rotor.thrust_coefficient;
  for (int i = 0; i < Rotors; ++i) {
    ASSERT_GE(command.rotor_speed(i), speed_from_thrust(v.rotor.min_thrust, c));
    ASSERT_LE(command.rotor_speed(i), speed_from_thrust(v.rotor.max_thrust, c));
    if (v.rotors[static_cast<std::size_t>(i)].tilts) {
      ASSERT_GE(command.tilt_angle(i), v.servo.min_angle);
      ASSERT_LE(command.tilt_angle(i), v.servo.max_angle);
    } else {
      ASSERT_EQ(command.tilt_angle(i), 0.0);
    }
  }
}

double largest(const Wrench<>& w) {
  return std::max(w.force.cwiseAbs().maxCoeff(), w.torque.cwiseAbs().maxCoeff());
}

Wrench<> difference(const Wrench<>& a, const Wrench<>& b) {
  return {a.force - b.force, a.torque - b.torque};
}

/// How often each status was reported.
class Statuses {
 public:
  void add(Status status) { ++count_[static_cast<std::size_t>(status)]; }
  int operator[](Status status) const { return count_[static_cast<std::size_t>(status)]; }

 private:
  std::array<int, 7> count_{};
};

/// The parts of a wrench that are scaled together.
std::array<Vector3d, 4> groups_of(const Wrench<>& w) {
  return {Vector3d(w.torque.x(), w.torque.y(), 0.0), Vector3d(0.0, 0.0, w.force.z()),
          Vector3d(w.force.x(), w.force.y(), 0.0), Vector3d(0.0, 0.0, w.torque.z())};
}

/// What holds for every answer. Counts statuses.
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
    const Wrench<> wanted = random_wrench(random, force, torque);
    const auto result = allocation.allocate(wanted, last);
    count.add(result.status);
    expect_within_limits(vehicle, result.command);
    const double size = std::max(1.0, largest(wanted));
    // achieved is what the forward map says of the command, lost what is missing from wanted.
    ASSERT_LT(largest(difference(allocation.wrench(result.command), result.achieved)),
              1e-12 * size);
    ASSERT_LT(largest({result.achieved.force + result.lost.force - wanted.force,
                       result.achieved.torque + result.lost.torque - wanted.torque}),
              1e-14 * size);
    if (gives_wrench(result.status)) worst = std::max(worst, largest(result.lost));
    if (result.status == Status::limited && vehicle.rotor.min_thrust <= 0.0) {
      // The direction of each group is kept, its size never grows. What arms lose that wait at
      // the end of their range has any direction.
      double h = 1e-6;
      for (int k = 0; k < Rotors; ++k)
        if (std::abs(std::abs(result.command.tilt_angle(k)) - pi) < 1e-12)
          h += vehicle.rotor.max_thrust * AllocationParameters{}.range_end_margin;
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

TEST(Allocation, TiltRopterIsHonestOverRandomWrenches) {
  Statuses count;
  expect_honest(tilt_ropter_vehicle(), 8.0, 0.5, 1, count);
  // In this range almost nothing is limited.
  EXPECT_LT(count[Status::limited] + count[Status::range_end_held], of_million(10000));
  expect_honest(tilt_ropter_vehicle(), 25.0, 2.0, 2, count);
  EXPECT_GT(count[Status::ok], of_million(200000));
  EXPECT_GT(count[Status::null_space_used], of_million(30000));
  EXPECT_GT(count[Status::limited], of_million(50000));
}

TEST(Allocation, ServoRangesAreKeptOverRandomWrenches) {
  Statuses count;
  expect_honest(with_tilt_range(-0.5 * pi, 0.5 * pi), 15.0, 0.5, 3, count);
  EXPECT_GT(std::min({count[Status::ok], count[Status::null_space_used], count[Status::limited]}),
            of_million(10000));
  expect_honest(with_tilt_range(-2.0, 2.2), 15.0, 0.5, 4, count);  // not convex
  EXPECT_GT(std::min({count[Status::ok], count[Status::null_space_used], count[Status::limited]}),
            of_million(10000));
}

TEST(Allocation, MinThrustIsKeptOverRandomWrenches) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.rotor.min_thrust = 0.5;
  Statuses count;
  expect_honest(vehicle, 8.0, 0.5, 5, count);
  EXPECT_GT(count[Status::null_space_used],
            of_million(30000));  // the null space raises what is too small
  EXPECT_LT(count[Status::limited], of_million(1000));
}

TEST(Allocation, HexacopterIsHonestOverRandomWrenches) {
  Statuses count;
  expect_honest(tilting_hexacopter(), 35.0, 3.0, 6, count);
  EXPECT_GT(std::min({count[Status::ok], count[Status::null_space_used], count[Status::limited]}),
            of_million(10000));
}

TEST(Allocation, FixedRotorsNeverPullOverRandomWrenches) {
  Statuses count;
  expect_honest(omnidirectional_octocopter(), 18.0, 1.5, 7, count);
  EXPECT_EQ(count[Status::ok], 0);  // the least thrusts always pull somewhere
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
    const Wrench<> wanted = random_wrench(random, 20.0, 1.5);
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

TEST(Allocation, HoverIsEqualThrustStraightUp) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  Wrench<> wanted;
  wanted.force.z() = vehicle.body.mass * gravity;
  const auto result = allocation.allocate(wanted, {});
  EXPECT_EQ(result.status, Status::ok);
  EXPECT_LT((result.command.rotor_speed - hovering(vehicle).rotor_speed).norm(), 1e-9);
  EXPECT_LT(result.command.tilt_angle.norm(), 1e-14);
}

/// Largest of the rotors' thrusts over a grid of the null space, at its least.
double least_largest_thrust(const AllocationMatrix<4>& allocation, const Wrench<>& wanted) {
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

TEST(Allocation, NothingIsGivenUpThatAGridOverTheNullSpaceCouldReach) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  const AllocationMatrix<4> matrix(vehicle);
  Random random(10);
  std::array<int, 4> scaled{};
  for (int i = 0; i < 200; ++i) {
    const Wrench<> wanted = random_wrench(random, 40.0, i % 4 == 0 ? 8.0 : 2.0);
    const auto result = allocation.allocate(wanted, {});
    if (result.status != Status::limited) continue;
    // Somewhat more of the first group that is not whole, while the groups behind it are as they
    // are, absent or whole, is beyond max_thrust wherever the grid looks.
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

TEST(Allocation, TorqueIsKeptWhenForceIsBeyondReach) {
  AllocationParameters parameters;
  parameters.priorities = {WrenchGroup::level, WrenchGroup::yaw, WrenchGroup::lift,
                           WrenchGroup::sideways};
  const Allocation allocation(tilt_ropter_vehicle(), parameters);
  const Vector3d torque(0.3, -0.2, 0.4), direction = Vector3d(1.0, -2.0, 3.0).normalized();
  const auto result = allocation.allocate({1000.0 * direction, torque}, {});
  EXPECT_EQ(result.status, Status::limited);
  EXPECT_LT((result.achieved.torque - torque).norm(), 1e-10);
  EXPECT_GT(result.achieved.force.dot(direction), 30.0);
  // The size of what is out of reach does not matter.
  const auto huge = allocation.allocate({1e300 * direction, torque}, {});
  EXPECT_LT((huge.achieved.force - result.achieved.force).norm(), 1e-4);
}

TEST(Allocation, TorqueBeyondReachIsScaledButForceThatCarriesItIsNotDropped) {
  // A hexacopter with slanted fixed rotors has no null space; it can only push upwards.
  Vehicle<6> vehicle = tilting_hexacopter();
  vehicle.servo.min_angle = -1.0;
  for (std::size_t i = 0; i < 6; ++i) {
    RotorGeometry& rotor = vehicle.rotors[i];
    const Eigen::AngleAxisd slant(i % 2 == 0 ? 0.5 : -0.5, Vector3d::UnitX());
    rotor.orientation = rotor.orientation * slant.toRotationMatrix();
    rotor.tilts = false;
  }
  const Allocation allocation(vehicle);
  Wrench<> hover;
  hover.force.z() = 15.0;
  EXPECT_EQ(allocation.allocate(hover, {}).status, Status::ok);
  // Roll beyond what 15 N of lift allow: as much of it as goes, and the lift stays.
  hover.torque.x() = 50.0;
  const auto result = allocation.allocate(hover, {});
  EXPECT_EQ(result.status, Status::limited);
  EXPECT_NEAR(result.achieved.force.z(), 15.0, 1e-3);
  EXPECT_GT(result.achieved.torque.x(), 0.5);
  EXPECT_LT(std::abs(result.achieved.torque.y()) + std::abs(result.achieved.torque.z()), 1e-9);
  // Downwards it cannot push at all.
  const auto down = allocation.allocate({Vector3d(0.0, 0.0, -5.0), Vector3d::Zero()}, {});
  EXPECT_EQ(down.status, Status::limited);
  EXPECT_LT(largest(down.achieved), 1e-9);
  // Nor stand still when its rotors idle: the least it can is what it does.
  vehicle.rotor.min_thrust = 0.3;
  const auto idle = Allocation(vehicle).allocate({}, {});
  EXPECT_EQ(idle.status, Status::limited);
  expect_within_limits(vehicle, idle.command);
  EXPECT_NEAR(idle.lost.force.z(), -6.0 * 0.3 * std::cos(0.5), 1e-9);
}

/// Largest change of a tilt angle per step along a path of wrenches; at thrusts above 2 h also its
/// largest product with thrust / step.
struct Turning {
  double per_step = 0.0;
  double times_thrust_per_step = 0.0;
};

template <typename Path>
Turning turning(const Allocation<4>& allocation, const Path& path, double step) {
  constexpr double duration = 10.0;  // [s]
  Turning turning;
  // An arm of next to no thrust takes its time to its angle, which is not the path's turning.
  AllocationResult<4> last = allocation.allocate(path(0.0), {});
  last.time = 0.0;
  for (double s = step; s <= 1.0; s += step) {
    const Wrench<> wanted = path(s);
    const auto result = allocation.allocate(duration * s, wanted, {}, last);
    Eigen::Matrix<double, 6, 1> packed, change;
    packed << wanted.force, wanted.torque;
    const Wrench<> before = path(s - step);
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

TEST(Allocation, AnglesAreContinuousOnPathsThroughZeroThrust) {
  const Allocation allocation(with_tilt_range(-6.0 * pi, 6.0 * pi));
  Random random(11);
  for (int run = 0; run < runs(60); ++run) {
    // Through zero exactly, closely, or at some distance.
    const double miss = run % 3 == 0 ? 0.0 : std::pow(10.0, random.uniform(-6.0, 0.0));
    const Wrench<> along = random_wrench(random, 2.0, 0.1), aside = random_wrench(random, 2.0, 0.1);
    const auto path = [&](double s) {
      const double t = 2.0 * s - 1.0;
      return Wrench<>{t * along.force + miss * aside.force, t * along.torque + miss * aside.torque};
    };
    const Turning coarse = turning(allocation, path, 4e-4);
    const Turning fine = turning(allocation, path, 1e-5);
    // 40 times the steps: at zero thrust the turn per step falls as step^(2/3), 11.7 times.
    EXPECT_LT(fine.per_step, 0.04) << run;
    EXPECT_LT(fine.per_step, 0.2 * coarse.per_step) << run;
    EXPECT_LT(fine.times_thrust_per_step, 1.01) << run;
  }
}

TEST(Allocation, AnglesAreContinuousOnPathsThroughPi) {
  const Allocation allocation(with_tilt_range(-6.0 * pi, 6.0 * pi));
  Random random(12);
  for (int run = 0; run < 30; ++run) {
    // A force that turns twice about a random axis.
    const Vector3d axis = random.vector(1.0).normalized(), start = axis.unitOrthogonal() * 10.0;
    const auto path = [&](double s) {
      const Vector3d force = Eigen::AngleAxisd(4.0 * pi * s, axis) * start;
      return Wrench<>{force, Vector3d(0.05, 0.0, 0.1)};
    };
    EXPECT_LT(turning(allocation, path, 1e-4).times_thrust_per_step, 1.01);
  }
  // About body y the two side arms turn with the force, past pi and on to 4 pi.
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

TEST(Allocation, AtTheEndOfTheRangeTheEquivalentAngleInsideIsTaken) {
  const Vehicle<4> vehicle = with_tilt_range(-pi, pi);
  const Allocation allocation(vehicle);
  ActuatorState<4> last;
  int turned_over = 0;
  for (int i = 0; i <= 4000; ++i) {
    const double angle = 4.0 * pi * i / 4000.0;
    const auto result = allocation.allocate(
        {Vector3d(10.0 * std::sin(angle), 0.0, 10.0 * std::cos(angle)), Vector3d::Zero()}, last);
    // Two arms of 5 N wait for up to the margin.
    const double held = 10.0 * std::sin(AllocationParameters{}.range_end_margin);
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
  // Twice through pi: not more than each arm each time.
  EXPECT_GE(turned_over, 2);
  EXPECT_LE(turned_over, 8);
}

TEST(Allocation, NullSpaceIsUsedContinuously) {
  const auto draw = [](double force) {
    return [force](Random& random) { return random_wrench(random, force, 1.0); };
  };
  const Vehicle<8> octocopter = omnidirectional_octocopter();
  const int paths = test_support::quick_or_full(3, 30);
  EXPECT_LT(steepest(octocopter, paths, 4000, draw(12.0)),
            1.2 * steepest(octocopter, paths, 500, draw(12.0)));
  const Vehicle<4> narrow = with_tilt_range(-0.5 * pi, 0.5 * pi);
  EXPECT_LT(steepest(narrow, 30, 8000, draw(15.0)), 1.2 * steepest(narrow, 30, 500, draw(15.0)));
}

/// Largest change per step of the commanded thrust vectors [N] along random straight paths into
/// what is out of reach.
double largest_jump(const Vehicle<4>& vehicle, int steps, int& limited) {
  const Allocation allocation(vehicle);
  Random random(13);
  double jump = 0.0;
  for (int run = 0; run < 30; ++run) {
    Wrench<> from = random_wrench(random, 15.0, 1.0), to = random_wrench(random, 40.0, 1.0);
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
        const double thrust =
            thrust_from_speed(result.command.rotor_speed(k), vehicle.rotor.thrust_coefficient);
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

TEST(Allocation, CommandsAreContinuousWhereLimitsBegin) {
  const Vehicle<4> vehicle = with_tilt_range(-6.0 * pi, 6.0 * pi);  // no arm turns over
  int limited = 0;
  const double coarse = largest_jump(vehicle, 1000, limited);
  EXPECT_GT(limited, 5000);
  // Where the last choice of thrusts closes, they move as the square root of the path: 16 times the
  // steps, a quarter of the jump.
  EXPECT_LT(largest_jump(vehicle, 16000, limited), 0.4 * coarse);
}

TEST(Allocation, AtZeroThrustTheLastAngleIsHeld) {
  const Allocation allocation(tilt_ropter_vehicle());
  ActuatorState<4> last;
  last.tilt_angle << 0.3, -1.2, 2.0, 3.1;
  const auto result = allocation.allocate({}, last);
  EXPECT_EQ(result.status, Status::ok);
  EXPECT_EQ(result.command.tilt_angle, last.tilt_angle);
  EXPECT_EQ(result.command.rotor_speed.norm(), 0.0);
}

TEST(Allocation, BelowTheHoldThrustAngleFollowsAndLosesLittle) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  AllocationParameters parameters;
  parameters.hold_thrust = 0.5;
  const Allocation steady(vehicle, parameters);
  const Allocation usual(vehicle);
  Wrench<> wanted;
  wanted.force << 0.6, 0.0, 0.8;  // about 0.3 N per rotor
  AllocationResult<4> last;
  last.time = 0.0;
  EXPECT_EQ(usual.allocate(0.01, wanted, {}, last).status, Status::ok);
  EXPECT_EQ(steady.allocate(wanted, {}).status, Status::ok);  // last was long ago
  auto result = steady.allocate(0.01, wanted, {}, last);
  EXPECT_EQ(result.status, Status::angle_held);
  EXPECT_GT(largest(result.lost), 1e-3);
  EXPECT_LT(result.lost.force.norm(), 4.0 * 2.0 * parameters.hold_thrust);
  // Kept up, the wrench is reached.
  for (int i = 2; i < 400; ++i) result = steady.allocate(0.01 * i, wanted, {}, result);
  EXPECT_EQ(result.status, Status::ok);
  EXPECT_LT(largest(result.lost), 1e-10);
}

/// Angles of the arms after 0.1 s of a small push to the side, in calls `dt` [s] apart.
Eigen::Vector4d angles_after(double dt, const AllocationParameters& parameters) {
  const Allocation allocation(tilt_ropter_vehicle(), parameters);
  AllocationResult<4> last;
  last.time = 0.0;
  const Wrench<> push{Vector3d(0.012, 0.003, 0.01), Vector3d::Zero()};
  for (int i = 1; i <= std::lround(0.1 / dt); ++i)
    last = allocation.allocate(dt * i, push, {}, last);
  return last.command.tilt_angle;
}

TEST(Allocation, BelowTheHoldThrustAnglesDoNotDependOnTheRateOfCalls) {
  AllocationParameters parameters;
  parameters.hold_time = 0.02;
  const Eigen::Vector4d fast = angles_after(1e-3, parameters);
  EXPECT_GT(fast.cwiseAbs().maxCoeff(), 0.1);
  EXPECT_LT(fast.cwiseAbs().maxCoeff(), 1.0);
  for (const double dt : {0.1, 0.05, 0.02, 0.01, 5e-3})
    EXPECT_LT((angles_after(dt, parameters) - fast).cwiseAbs().maxCoeff(), 1e-12) << dt;
  // (T / h)^2 of arms 1 and 2, seen from angle zero, is the closed form's.
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Eigen::Matrix<double, 6, 1> packed;
  packed << 0.012, 0.003, 0.01, 0.0, 0.0, 0.0;
  const Eigen::Matrix<double, 8, 1> thrusts = Allocation(vehicle).pseudoinverse() * packed;
  for (int i = 0; i < 4; ++i) {
    const double square = thrusts.segment<2>(2 * i).squaredNorm() / (0.02 * 0.02);
    const double target = std::atan2(thrusts(2 * i), thrusts(2 * i + 1));
    const double way = 1.0 - std::exp(-0.1 / parameters.hold_time * square / (1.0 - square));
    EXPECT_NEAR(fast(i), way * target, 1e-12);
  }
  parameters.hold_time = 0.2;
  EXPECT_LT(angles_after(0.01, parameters).cwiseAbs().maxCoeff(), 0.3 * fast.cwiseAbs().maxCoeff());
}

TEST(Allocation, TimeThatDoesNotPassHoldsAnglesAndHeals) {
  const Allocation allocation(tilt_ropter_vehicle());
  const Wrench<> push{Vector3d(0.012, 0.0, 0.01), Vector3d::Zero()};
  AllocationResult<4> last;
  last.time = 1.0;
  for (const double time : {1.0, 0.5, nan, -infinity}) {
    const auto result = allocation.allocate(time, push, {}, last);
    EXPECT_EQ(result.command.tilt_angle, last.command.tilt_angle) << time;
    EXPECT_EQ(result.status, Status::angle_held);
    EXPECT_TRUE(std::isfinite(result.time));
  }
  // One stamp far ahead, then the right ones again.
  auto result = allocation.allocate(1e6, push, {}, last);
  result = allocation.allocate(1.0, push, {}, result);
  result = allocation.allocate(1.01, push, {}, result);
  EXPECT_EQ(result.time, 1.01);
  result.command = {};
  EXPECT_GT(allocation.allocate(1.02, push, {}, result).command.tilt_angle.norm(), 1e-3);
}

TEST(Allocation, ForwardMapHasTheColumnsOfTheMatrixAsDerivatives) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  Random random(14);
  for (int run = 0; run < runs(1000); ++run) {
    ActuatorState<4> at;
    for (int i = 0; i < 4; ++i) {
      at.rotor_speed(i) = run % 10 == 0 ? 0.0 : random.uniform(0.0, 3000.0);
      at.tilt_angle(i) = random.uniform(-pi, pi);
    }
    const auto jacobian = test_support::jacobian_at_zero<6, 8>([&](const auto& dual) {
      using Dual = test_support::Dual<8>;
      ActuatorState<4, Dual> moved;
      for (int i = 0; i < 4; ++i) {
        moved.rotor_speed(i) = at.rotor_speed(i) + dual(2 * i);
        moved.tilt_angle(i) = at.tilt_angle(i) + dual(2 * i + 1);
      }
      const Wrench<Dual> wrench = allocation.wrench(moved);
      Eigen::Matrix<Dual, 6, 1> packed;
      packed << wrench.force, wrench.torque;
      return packed;
    });
    for (int i = 0; i < 4; ++i) {
      const double c = vehicle.rotor.thrust_coefficient, speed = at.rotor_speed(i);
      const double sine = std::sin(at.tilt_angle(i)), cosine = std::cos(at.tilt_angle(i));
      const auto lateral = allocation.matrix().col(2 * i);
      const auto vertical = allocation.matrix().col(2 * i + 1);
      EXPECT_LT(
          (jacobian.col(2 * i) - 2.0 * c * speed * (sine * lateral + cosine * vertical)).norm(),
          1e-15);
      EXPECT_LT((jacobian.col(2 * i + 1) - c * speed * speed * (cosine * lateral - sine * vertical))
                    .norm(),
                1e-12);
    }
  }
}

TEST(Allocation, BrokenSensorsCountAsRotorsAtRest) {
  const Allocation allocation(tilt_ropter_vehicle());
  ActuatorState<4> state = hovering(tilt_ropter_vehicle());
  ActuatorState<4> without = state;
  without.rotor_speed(0) = without.rotor_speed(1) = without.rotor_speed(2) = 0.0;
  state.rotor_speed(0) = nan;
  state.rotor_speed(1) = 1e300;
  state.tilt_angle(2) = infinity;
  EXPECT_LT(largest(difference(allocation.wrench(state), allocation.wrench(without))), 1e-15);
}

TEST(Allocation, RatesAreTheDerivativesOfTheInverseMap) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  Random random(15);
  using Dual = test_support::Dual<1>;
  for (int run = 0; run < runs(2000); ++run) {
    const Wrench<> wrench = random_wrench(random, 8.0, 0.5), rate = random_wrench(random, 5.0, 2.0);
    const ActuatorRates<4> rates = allocation.rates(wrench, rate);
    Eigen::Matrix<Dual, 6, 1> packed;
    for (int i = 0; i < 3; ++i) {
      packed(i) = Dual(wrench.force(i), Eigen::Matrix<double, 1, 1>(rate.force(i)));
      packed(i + 3) = Dual(wrench.torque(i), Eigen::Matrix<double, 1, 1>(rate.torque(i)));
    }
    const Eigen::Matrix<Dual, 8, 1> thrusts = allocation.pseudoinverse().cast<Dual>() * packed;
    for (int i = 0; i < 4; ++i) {
      const Dual size =
          sqrt(Dual(thrusts(2 * i) * thrusts(2 * i) + thrusts(2 * i + 1) * thrusts(2 * i + 1)));
      if (size.value() < 0.02) continue;
      const Dual angle = atan2(thrusts(2 * i), thrusts(2 * i + 1));
      const Dual speed = speed_from_thrust(size, vehicle.rotor.thrust_coefficient);
      EXPECT_NEAR(rates.tilt_rate(i), angle.derivatives()(0),
                  1e-11 * (1.0 + std::abs(rates.tilt_rate(i))));
      EXPECT_NEAR(rates.rotor_acceleration(i), speed.derivatives()(0),
                  1e-11 * (1.0 + std::abs(rates.rotor_acceleration(i))));
    }
  }
}

TEST(Allocation, RatesAreDifferencesOfCommands) {
  const Allocation allocation(with_tilt_range(-6.0 * pi, 6.0 * pi));
  Random random(16);
  for (int run = 0; run < 200; ++run) {
    const Wrench<> wrench = random_wrench(random, 8.0, 0.5), rate = random_wrench(random, 5.0, 2.0);
    const auto at = [&](double t) {
      return Wrench<>{wrench.force + t * rate.force, wrench.torque + t * rate.torque};
    };
    const auto now = allocation.allocate(wrench, {});
    const auto before = allocation.allocate(at(-1e-6), now.command).command;
    const auto after = allocation.allocate(at(1e-6), now.command).command;
    const ActuatorRates<4> rates = allocation.rates(wrench, rate);
    for (int i = 0; i < 4; ++i) {
      const double tilt = (after.tilt_angle(i) - before.tilt_angle(i)) / 2e-6;
      const double speed = (after.rotor_speed(i) - before.rotor_speed(i)) / 2e-6;
      if (now.command.rotor_speed(i) < 400.0) continue;
      EXPECT_NEAR(rates.tilt_rate(i), tilt, 1e-5 * (1.0 + std::abs(tilt)));
      EXPECT_NEAR(rates.rotor_acceleration(i), speed, 1e-4 * (1.0 + std::abs(speed)));
    }
  }
}

TEST(Allocation, RatesAreFiniteAtZeroThrustAndZeroForNonsense) {
  const Allocation allocation(tilt_ropter_vehicle());
  Wrench<> rate;
  rate.force << 1.0, 2.0, 3.0;
  const ActuatorRates<4> at_rest = allocation.rates({}, rate);
  EXPECT_EQ(at_rest.tilt_rate.norm() + at_rest.rotor_acceleration.norm(), 0.0);
  for (const double bad : {nan, infinity, 1e300}) {
    Wrench<> wrench;
    wrench.force.setConstant(bad);
    EXPECT_EQ(allocation.rates(wrench, wrench).tilt_rate.norm(), 0.0);
    EXPECT_TRUE(all_finite(allocation.rates(wrench, rate).rotor_acceleration));
  }
}

/// Largest error [N] of the force that lagging actuators apply on a smooth path of wrenches.
double lag_error(double lag_compensation) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  AllocationParameters parameters;
  parameters.lag_compensation = lag_compensation;
  const Allocation allocation(vehicle, parameters);
  ActuatorModel<4> actuators(vehicle);
  AllocationResult<4> last;
  last.command = hovering(vehicle);
  actuators.reset(last.command, 0.0);
  double error = 0.0;
  for (int i = 0; i < 2000; ++i) {
    const double time = 0.002 * i;
    Wrench<> wanted, rate;
    wanted.force << 3.0 * std::sin(3.0 * time), 0.0, 15.0 + std::cos(2.0 * time);
    rate.force << 9.0 * std::cos(3.0 * time), 0.0, -2.0 * std::sin(2.0 * time);
    last = allocation.allocate(time, wanted, rate, last);
    const Wrench<> applied = allocation.wrench(actuators.update(time, last.command));
    if (time > 1.0) error = std::max(error, (applied.force - wanted.force).norm());
  }
  return error;
}

TEST(Allocation, CommandsThatRunAheadUndoTheLagOfTheActuators) {
  const double lagging = lag_error(0.0);
  EXPECT_GT(lagging, 0.3);
  EXPECT_LT(lag_error(1.0), 0.1 * lagging);
  EXPECT_NEAR(lag_error(0.5), 0.5 * lagging, 0.15 * lagging);
}

TEST(Allocation, CommandsThatRunAheadStayWithinLimits) {
  const Vehicle<4> vehicle = with_tilt_range(-1.0, 1.0);
  const Allocation allocation(vehicle);
  Random random(18);
  AllocationResult<4> last;
  for (int i = 0; i < 20000; ++i) {
    const Wrench<> wanted = random_wrench(random, 15.0, 1.0);
    const Wrench<> rate = random_wrench(random, i % 2 == 0 ? 1e300 : 500.0, 500.0);
    last = allocation.allocate(0.01 * i, wanted, rate, last);
    expect_within_limits(vehicle, last.command);
  }
  const auto rejected =
      allocation.allocate(300.0, {Vector3d(nan, 0.0, 0.0), Vector3d::Zero()}, {}, last);
  EXPECT_EQ(rejected.status, Status::rejected);
  EXPECT_EQ(rejected.command.tilt_angle, last.command.tilt_angle);
}

TEST(Allocation, CommandsRunAheadLessWhereThrustIsSmall) {
  AllocationParameters eager, calm;
  eager.calm_share = 1e-6;
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  // A hundredth of hover: a tenth of the thrust at which calm begins.
  const Wrench<> faint{Vector3d(0.0, 0.0, 0.01 * vehicle.body.mass * gravity), Vector3d::Zero()};
  const Wrench<> sideways{Vector3d(0.2, 0.0, 0.0), Vector3d::Zero()};
  const double full =
      Allocation(vehicle, eager).allocate(0.0, faint, sideways, {}).command.tilt_angle(0);
  EXPECT_GT(std::abs(full), 0.01);
  EXPECT_NEAR(Allocation(vehicle, calm).allocate(0.0, faint, sideways, {}).command.tilt_angle(0),
              0.01 * full, 1e-9);
}

TEST(Allocation, NonFiniteInputIsRejectedAndTheLastCommandRepeated) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  const ActuatorState<4> last = hovering(vehicle);
  for (const double bad : {nan, infinity, -infinity}) {
    Wrench<> wanted;
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

// A telemetry line that fails stops no motor.
TEST(Allocation, NonFiniteTelemetryDoesNoHarm) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  const ActuatorState<4> last = hovering(vehicle);
  const Wrench<> wanted{Vector3d(1.0, -0.5, 14.0), Vector3d(0.0, 0.1, 0.0)};
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
        Wrench<> wanted;
        ActuatorState<4> last;
        for (int k = 0; k < 3; ++k) {
          // Mostly finite, so that not nearly all are rejected.
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

TEST(Allocation, ConstructionRefusesWhatItCannotServe) {
  EXPECT_THROW(Allocation{test_support::flat_quadrotor()}, std::invalid_argument);
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.rotor.max_thrust = nan;
  EXPECT_THROW(Allocation{vehicle}, std::invalid_argument);
  AllocationParameters parameters;
  parameters.hold_thrust = 0.0;
  EXPECT_THROW(Allocation(tilt_ropter_vehicle(), parameters), std::invalid_argument);
  for (const double bad : {-0.1, 1.1, nan}) {
    parameters = {};
    parameters.lag_compensation = bad;
    EXPECT_THROW(Allocation(tilt_ropter_vehicle(), parameters), std::invalid_argument);
  }
  const auto message = [](const AllocationParameters& p) -> std::string {
    try {
      Allocation(tilt_ropter_vehicle(), p);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return {};
  };
  for (const double bad : {0.0, -1.0, nan, infinity}) {
    parameters = {};
    parameters.hold_time = bad;
    EXPECT_NE(message(parameters).find("hold_time [s]"), std::string::npos);
  }
  for (const double bad : {-0.1, 2.0, nan}) {
    parameters = {};
    parameters.range_end_margin = bad;
    EXPECT_NE(message(parameters).find("range_end_margin [rad]"), std::string::npos);
  }
  parameters = {};
  parameters.priorities[3] = WrenchGroup::lift;
  EXPECT_NE(message(parameters).find("priorities = 0, 1, 2, 1: must be level (0)"),
            std::string::npos);
  parameters.priorities[3] = static_cast<WrenchGroup>(7);
  EXPECT_NE(message(parameters).find("priorities"), std::string::npos);
}

}  // namespace
