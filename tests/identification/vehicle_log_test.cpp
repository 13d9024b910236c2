// Which logs are usable, and the replay of commands through a lag.

#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <limits>
#include <string>
#include <utility>
#include <vector>

namespace tilt_ropter::detail {
namespace vehicle_log_test {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinite = std::numeric_limits<double>::infinity();

VehicleLog<4> good_log() {
  VehicleLog<4> log;
  for (int i = 0; i < 3; ++i) {
    const double time = 0.01 * i;
    log.imu.push_back({time, {}});
    log.poses.push_back({time, {}});
    log.commands.push_back({time, {}});
    log.rotor_speeds.push_back({time, VehicleLog<4>::RotorVector::Zero()});
  }
  return log;
}

void expect_bad(const std::string& what, const std::function<void(VehicleLog<4>&)>& change) {
  VehicleLog<4> log = good_log();
  change(log);
  EXPECT_FALSE(is_good_log(log)) << what;
}

TEST(VehicleLog, IsGoodIfAllNumbersAreFiniteAlsoWithoutRotorSpeeds) {
  VehicleLog<4> log = good_log();
  EXPECT_TRUE(is_good_log(log));
  log.rotor_speeds.clear();
  EXPECT_TRUE(is_good_log(log));
  for (auto& pose : log.poses) pose.value.orientation.coeffs() *= 2.0;  // it is normalised later
  EXPECT_TRUE(is_good_log(log));
}

// One wrong entry of one list is enough, while all others are good.
TEST(VehicleLog, OneNumberThatIsNotFiniteMakesItBad) {
  for (const double bad : {nan, infinite, -infinite}) {
    expect_bad("rate", [bad](auto& log) { log.imu[1].value.angular_velocity.y() = bad; });
    expect_bad("force", [bad](auto& log) { log.imu[1].value.specific_force.z() = bad; });
    expect_bad("position", [bad](auto& log) { log.poses[1].value.position.x() = bad; });
    expect_bad("orientation", [bad](auto& log) { log.poses[1].value.orientation.x() = bad; });
    expect_bad("speed", [bad](auto& log) { log.commands[1].value.rotor_speed(2) = bad; });
    expect_bad("angle", [bad](auto& log) { log.commands[1].value.tilt_angle(3) = bad; });
    expect_bad("measured speed", [bad](auto& log) { log.rotor_speeds[1].value(0) = bad; });
  }
  expect_bad("no rotation", [](auto& log) { log.poses[2].value.orientation.coeffs().setZero(); });
}

TEST(VehicleLog, StampsMustBeFiniteAndIncreaseInEveryList) {
  for (const double bad : {nan, infinite, 0.0, -1.0}) {
    expect_bad("imu", [bad](auto& log) { log.imu[1].time = bad; });
    expect_bad("poses", [bad](auto& log) { log.poses[1].time = bad; });
    expect_bad("commands", [bad](auto& log) { log.commands[1].time = bad; });
    expect_bad("rotor speeds", [bad](auto& log) { log.rotor_speeds[1].time = bad; });
  }
  expect_bad("last", [](auto& log) { log.imu.back().time = infinite; });
  expect_bad("first", [](auto& log) { log.poses.front().time = -infinite; });
}

TEST(VehicleLog, StampsOfAnotherClockOrUnitMakeItBad) {
  const auto changed = [](auto& list, double factor, double offset) {
    for (auto& entry : list) entry.time = factor * (entry.time + 1.0) + offset;
  };
  for (const auto& [factor, offset] : {std::pair{1e3, 0.0}, {1e9, 0.0}, {1.0, 1.4e9}}) {
    expect_bad("poses",
               [f = factor, o = offset, &changed](auto& log) { changed(log.poses, f, o); });
    expect_bad("commands",
               [f = factor, o = offset, &changed](auto& log) { changed(log.commands, f, o); });
    expect_bad("rotor speeds",
               [f = factor, o = offset, &changed](auto& log) { changed(log.rotor_speeds, f, o); });
  }
}

TEST(VehicleLog, IndexBeforeIsThatOfTheLastElementAtOrBeforeATime) {
  const auto poses = good_log().poses;  // at 0, 0.01 and 0.02 s
  for (const auto& [time, index] : {std::pair<double, std::size_t>{-1.0, 0},
                                    {0.0, 0},
                                    {0.009, 0},
                                    {0.01, 1},
                                    {0.015, 1},
                                    {0.02, 2},
                                    {9.0, 2}})
    EXPECT_EQ(index_before(poses, time), index) << time;
}

TEST(VehicleLog, OrientationIsInterpolatedAndHeldAtTheEnds) {
  auto poses = good_log().poses;
  const Eigen::Vector3d turn(0.2, -0.4, 0.6);
  poses[1].value.orientation = quaternion_exp(turn);
  poses[2].value.orientation = quaternion_exp(turn);
  poses[2].value.orientation.coeffs() *= -3.0;  // the same rotation
  const auto expect_part = [&](double time, double part) {
    const Eigen::Quaterniond expected = quaternion_exp(Eigen::Vector3d(part * turn));
    EXPECT_LT(orientation_at(poses, time).angularDistance(expected), 1e-7) << time;
  };
  expect_part(-1.0, 0.0);
  expect_part(0.0025, 0.25);
  expect_part(0.0075, 0.75);
  expect_part(0.015, 1.0);
  expect_part(0.02, 1.0);
  expect_part(9.0, 1.0);
}

struct Replayed {
  std::vector<double> values, rates;
};

// Replays a step from zero to `size` at 0.1 s, at stamps every 10 ms.
Replayed step(const LagModel& lag, double size) {
  const std::vector<Timed<double>> commands{{0.0, 0.0}, {0.1, size}};
  std::vector<Timed<int>> stamps;
  stamps.reserve(100);
  for (int i = 0; i < 100; ++i) stamps.push_back({0.01 * i, 0});
  Replayed r;
  replay(
      commands, stamps, lag, [](double command) { return command; },
      [&r](std::size_t i, double value, double rate) {
        EXPECT_EQ(i, r.values.size());
        r.values.push_back(value);
        r.rates.push_back(rate);
      });
  return r;
}

TEST(CommandReplay, IsAFirstOrderLagAfterTheDeadTime) {
  for (const double dead_time : {0.0, 0.035, -0.02}) {
    const Replayed r = step({0.08, dead_time, 1e9}, -2.0);
    for (std::size_t i = 0; i < r.values.size(); ++i) {
      const double since = std::max(0.0, 0.01 * static_cast<double>(i) - 0.1 - dead_time),
                   left = std::exp(-since / 0.08);
      EXPECT_NEAR(r.values[i], -2.0 * (1.0 - left), 1e-9) << dead_time << ' ' << i;
      if (since > 0.0) {
        EXPECT_NEAR(r.rates[i], -2.0 * left / 0.08, 1e-8) << dead_time << ' ' << i;
      }
    }
  }
}

// The rate is limited while more than max_rate * time_constant is left.
TEST(CommandReplay, KeepsTheRateLimitInBothDirections) {
  for (const double sign : {1.0, -1.0}) {
    const LagModel lag{0.05, 0.0, 4.3};
    const Replayed r = step(lag, sign * 1.0);
    const double knee = 4.3 * 0.05, ramp = (1.0 - knee) / 4.3;
    for (std::size_t i = 0; i < r.values.size(); ++i) {
      const double since = std::max(0.0, 0.01 * static_cast<double>(i) - 0.1);
      const double value =
          since < ramp ? 4.3 * since : 1.0 - knee * std::exp(-(since - ramp) / 0.05);
      EXPECT_NEAR(r.values[i], sign * value, 1e-9) << i;
      EXPECT_LE(std::abs(r.rates[i]), 4.3 + 1e-12);
    }
  }
}

}  // namespace vehicle_log_test
}  // namespace tilt_ropter::detail
