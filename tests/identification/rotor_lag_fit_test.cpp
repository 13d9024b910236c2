// Time constant and dead time of rotors from a log of commanded and measured speeds.

#include <tilt_ropter/identification/detail/vehicle_fit.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <cstddef>

namespace tilt_ropter::detail {
namespace rotor_lag_fit_test {

using test_support::Random;
using RotorVector = VehicleLog<4>::RotorVector;

constexpr double lag_ratio = 1.3, dead_time = 0.012, gain = 1.02, offset = -20.0;
constexpr double duration = 10.0, noise = 4.0;  // [s], [rad/s]

// Rotors that follow steps of the command every 20 to 200 ms, and measurements that are wrong by a
// gain and an offset. The IMU samples have no content here, only stamps.
VehicleLog<4> record(const Vehicle<4>& vehicle, unsigned seed) {
  Random random(seed);
  VehicleLog<4> log;
  RotorVector command = RotorVector::Constant(1600.0), speed = command;
  double next = 0.0;
  std::size_t in_force = 0;
  constexpr double step = 1e-3;
  for (int i = 0; i <= static_cast<int>(duration / step); ++i) {
    const double time = step * i;
    if (time >= next) {
      for (double& c : command) c = 1600.0 + random.uniform(-200.0, 200.0);
      next = time + 0.001 * std::round(random.uniform(20.0, 200.0));
      ActuatorState<4> sent;
      sent.rotor_speed = command;
      log.commands.push_back({time, sent});
    }
    if (i % 5 == 0) {
      log.imu.push_back({time, {}});
      RotorVector measured = gain * speed + RotorVector::Constant(offset);
      for (double& m : measured) m += random.normal(noise);
      log.rotor_speeds.push_back({time, measured});
    }
    while (in_force + 1 < log.commands.size() &&
           log.commands[in_force + 1].time + dead_time <= time + 1e-9)
      ++in_force;
    const double lag = lag_ratio * vehicle.rotor.time_constant;
    speed += (1.0 - std::exp(-step / lag)) * (log.commands[in_force].value.rotor_speed - speed);
  }
  return log;
}

TEST(RotorLagFit, FindsTimeConstantAndDeadTimeWithHonestIntervals) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  constexpr int logs = 30;
  Eigen::Vector2d squares = Eigen::Vector2d::Zero(), largest = Eigen::Vector2d::Zero();
  for (unsigned seed = 0; seed < logs; ++seed) {
    const VehicleLog<4> log = record(vehicle, seed);
    const RotorLagFit<4> fit(log, vehicle);
    const Eigen::Vector2d error(fit.log_scale - std::log(lag_ratio), fit.dead_time - dead_time);
    const Eigen::Vector2d stddev = fit.covariance.diagonal().cwiseSqrt();
    largest = largest.cwiseMax(error.cwiseAbs());
    squares += error.cwiseQuotient(stddev).cwiseAbs2();
    EXPECT_LT(fit.covariance(0, 1), 0.0);  // a longer lag looks like a longer dead time
  }
  EXPECT_LT(largest(0), 0.02);
  EXPECT_LT(largest(1), 5e-4);
  for (int i = 0; i < 2; ++i) {
    EXPECT_GT(std::sqrt(squares(i) / logs), 0.6) << i;
    EXPECT_LT(std::sqrt(squares(i) / logs), 1.6) << i;
  }
}

TEST(RotorLagFit, CorrectionsAreWhatTheModelOfTheSpeedsDoesNotGive) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const VehicleLog<4> log = record(vehicle, 100);
  const RotorLagFit<4> fit(log, vehicle);
  const auto corrections = fit.speed_corrections();
  ASSERT_EQ(corrections.size(), log.imu.size());
  for (std::size_t j = 200; j + 200 < corrections.size(); ++j)
    for (int i = 0; i < 4; ++i)
      EXPECT_NEAR(corrections[j](i), (gain - 1.0) * 1600.0 + offset, 0.02 * 200.0 + noise)
          << j << ' ' << i;
}

// Constant commands say nothing about the lag: the given one stays, and its interval is wide.
TEST(RotorLagFit, ConstantCommandsLeaveThePrior) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  VehicleLog<4> log = record(vehicle, 101);
  log.commands.resize(1);
  for (auto& m : log.rotor_speeds) m.value.setConstant(1600.0);
  const RotorLagFit<4> fit(log, vehicle);
  EXPECT_NEAR(fit.log_scale, 0.0, 1e-9);
  EXPECT_NEAR(fit.dead_time, 0.0, 1e-9);
  EXPECT_GT(std::sqrt(fit.covariance(0, 0)), 0.9);
  EXPECT_GT(std::sqrt(fit.covariance(1, 1)), 0.045);
}

}  // namespace rotor_lag_fit_test
}  // namespace tilt_ropter::detail
