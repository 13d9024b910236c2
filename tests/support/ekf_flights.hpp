#pragma once

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>

#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <functional>
#include <limits>
#include <vector>

/// Recorded flights for tests of the filter, and the errors of its estimate.
namespace test_support {

/// Time between two IMU samples of a log [s]. Poses come with every second sample.
inline constexpr double imu_period = 0.005;

/// Measurements of both sensors during one flight, in the order of their stamps.
struct Log {
  std::vector<Timed<InertialSampled>> imu;
  std::vector<Timed<MarkerPosed>> poses;
  std::vector<InertialStated> truth;  ///< at the times of `imu`
};

/// Records `duration` [s] of a flight, with the noise of the settings and these initial biases.
inline Log record(const Flight& flight, double duration, unsigned seed,
                  const tilt_ropter::EkfSettings& settings = {},
                  const Eigen::Vector3d& gyro_bias = Eigen::Vector3d::Zero(),
                  const Eigen::Vector3d& accelerometer_bias = Eigen::Vector3d::Zero()) {
  Log log;
  Random random(seed + 1000);
  NoisyImu imu(flight, settings.imu_noise, imu_period, seed, gyro_bias, accelerometer_bias);
  const int samples = static_cast<int>(std::lround(duration / imu_period));
  for (int i = 0; i <= samples; ++i) {
    const double t = imu_period * i;
    log.imu.push_back({t, imu(t)});
    log.truth.push_back(imu.state(t));
    if (i % 2 == 0) log.poses.push_back({t, noisy(flight.pose(t), settings.pose_noise, random)});
  }
  return log;
}

/// Default callback of fly(): ignores the status of each pose.
struct Unobserved {
  void operator()(std::size_t /*pose*/, tilt_ropter::EkfStatus /*status*/) const {}
};

/// Passes the measurements to the filter in the order of arrival. Poses arrive `latency` [s] after
/// their stamp. `seen` is called after each pose with its index and status, `after_imu` after each
/// IMU sample.
template <typename Scalar, typename Seen = Unobserved>
void fly(
    tilt_ropter::Ekf<Scalar>& ekf, const Log& log, double latency = 0.0, const Seen& seen = {},
    const std::function<void()>& after_imu = [] {}) {
  std::size_t j = 0;
  const auto poses_before = [&](double time) {
    for (; j < log.poses.size() && log.poses[j].time + latency < time; ++j) {
      const MarkerPosed& pose = log.poses[j].value;
      seen(j, ekf.on_pose(log.poses[j].time, {pose.position.template cast<Scalar>(),
                                              pose.orientation.template cast<Scalar>()}));
    }
  };
  for (const auto& sample : log.imu) {
    poses_before(sample.time);
    ekf.on_imu(sample.time, {sample.value.angular_velocity.template cast<Scalar>(),
                             sample.value.specific_force.template cast<Scalar>()});
    after_imu();
  }
  poses_before(std::numeric_limits<double>::infinity());
}

/// True if both have the same state bit by bit.
inline bool same(const tilt_ropter::BodyStated& a, const tilt_ropter::BodyStated& b) {
  return a.position == b.position && a.velocity == b.velocity &&
         a.orientation.coeffs() == b.orientation.coeffs() &&
         a.angular_velocity == b.angular_velocity;
}
inline bool same(const tilt_ropter::Ekfd& a, const tilt_ropter::Ekfd& b) {
  return same(a.state(), b.state()) && a.filter().covariance() == b.filter().covariance() &&
         difference(a.filter().state(), b.filter().state()) ==
             tilt_ropter::InertialTangentd::Zero() &&
         a.nis() == b.nis() && a.filter_time() == b.filter_time();
}

/// Norms of the errors of a state [m, m/s, rad, rad/s].
struct Errors {
  double position, velocity, orientation, angular_velocity;
};

/// Returns the errors of state() relative to the flight at the same time.
template <typename Scalar>
Errors errors(const tilt_ropter::Ekf<Scalar>& ekf, const Flight& flight) {
  const tilt_ropter::BodyState<Scalar> x = ekf.state();
  const InertialStated truth = flight.state(ekf.time());
  return {
      (x.position.template cast<double>() - truth.position).norm(),
      (x.velocity.template cast<double>() - truth.velocity).norm(),
      tilt_ropter::quaternion_log(
          Eigen::Quaterniond(truth.orientation.conjugate() *
                             x.orientation.template cast<double>().normalized()))
          .norm(),
      (x.angular_velocity.template cast<double>() - flight.imu(ekf.time()).angular_velocity).norm(),
  };
}

/// Expects that the filter runs and that its estimate has converged.
inline void expect_good(const tilt_ropter::Ekfd& ekf, const Flight& flight) {
  const Errors e = errors(ekf, flight);
  EXPECT_TRUE(ekf.running());
  EXPECT_LT(e.position, 0.005);
  EXPECT_LT(e.velocity, 0.05);
  EXPECT_LT(e.orientation, 0.01);
  EXPECT_LT(e.angular_velocity, 0.15);  // the noise of one sample: 0.03
}

}  // namespace test_support
