// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/ekf_settings.hpp>
#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <algorithm>
#include <cmath>
#include <limits>

/// How Ekf::trust() predicts its errors and judges them. Nothing here throws or allocates.
namespace tilt_ropter::detail {

/// Square root of the largest variance of a part of the state (see InertialIndex).
template <typename Covariance>
[[nodiscard]] double largest_stddev(const Covariance& p, int part) noexcept {
  return std::sqrt(
      std::max(0.0, static_cast<double>(p.diagonal().template segment<3>(part).maxCoeff())));
}

/// Standard deviation of the heading, about the vertical [rad].
template <typename Scalar>
[[nodiscard]] double heading_stddev(const ErrorStateFilter<Scalar>& filter) noexcept {
  const Vector3<Scalar> up = filter.state().orientation.conjugate() * Vector3<Scalar>::UnitZ();
  Scalar variance(0);
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      variance +=
          up(i) * up(k) *
          filter.covariance()(InertialIndex::orientation + i, InertialIndex::orientation + k);
  return std::sqrt(std::max(0.0, static_cast<double>(variance)));
}

/// Time since `then` [s], at least zero; infinite if it is not a number.
[[nodiscard]] inline double age(double now, double then) noexcept {
  if (std::isnan(now - then)) return std::numeric_limits<double>::infinity();
  return std::max(now - then, 0.0);
}

/// Predicts the standard deviations of `t`, `dt` [s] after the time of the covariance `p`, by the
/// variances of velocity, attitude and accelerometer.
template <typename Covariance>
void predict_errors(const Covariance& p, double dt, const InertialNoise& noise,
                    EstimateTrust& t) noexcept {
  using I = InertialIndex;
  const auto variance = [&p](int row, int column) { return static_cast<double>(p(row, column)); };
  const double lean = largest_stddev(p, I::orientation),
               bias = largest_stddev(p, I::accelerometer_bias);
  const double density = noise.accelerometer_density;
  const double acceleration = gravity * gravity * lean * lean + bias * bias;
  double position = 0.0, velocity = 0.0;
  for (int i = 0; i < 3; ++i) {
    const int r = I::position + i, v = I::velocity + i;
    position =
        std::max(position, variance(r, r) + 2.0 * dt * variance(r, v) + dt * dt * variance(v, v));
    velocity = std::max(velocity, variance(v, v));
  }
  t.position_stddev = std::sqrt(std::max(0.0, position) + 0.25 * std::pow(dt, 4) * acceleration +
                                density * density * std::pow(dt, 3) / 3.0);
  t.velocity_stddev =
      std::sqrt(std::max(0.0, velocity) + dt * dt * acceleration + density * density * dt);
  t.orientation_stddev =
      std::hypot(lean, dt * largest_stddev(p, I::gyro_bias), noise.gyro_density * std::sqrt(dt));
}

/// True if a bias is more than five standard deviations from that of the settings.
template <typename Scalar>
[[nodiscard]] bool has_implausible_bias(const InertialState<Scalar>& x,
                                        const EkfSettings& s) noexcept {
  constexpr double most = 5.0;  // standard deviations
  const auto is_far = [](const Vector3<Scalar>& bias, const Eigen::Vector3d& expected,
                         double stddev) {
    return !((bias.template cast<double>() - expected).cwiseAbs().maxCoeff() <= most * stddev);
  };
  return is_far(x.gyro_bias, s.gyro_bias, s.gyro_bias_stddev) ||
         is_far(x.accelerometer_bias, s.accelerometer_bias, s.accelerometer_bias_stddev);
}

/// Judges ages and errors, sets the state. `just_started`: too few poses have confirmed the start.
inline void judge(const EkfTrustLimits& limits, bool just_started, EstimateTrust& t) noexcept {
  const auto above = [&limits](double stddev, double limit) {
    return !(limits.confidence * stddev <= limit);
  };
  t.imu_silent = !(t.imu_age <= limits.imu_age);
  t.no_position =
      !(std::min(t.age_of(MeasurementKind::pose), t.age_of(MeasurementKind::position)) <=
        limits.position_age + std::max(0.0, t.latency));
  t.position_error = above(t.position_stddev, limits.position_error);
  t.velocity_error = above(t.velocity_stddev, limits.velocity_error);
  t.orientation_error = above(t.orientation_stddev, limits.orientation_error);
  if (t.imu_silent || t.imu_stopped || t.orientation_error)
    t.state = EstimateState::lost;
  else if (t.velocity_error && just_started && !t.no_position)
    t.state = EstimateState::starting;
  else if (above(t.position_stddev, limits.lost_position_error))
    t.state = EstimateState::position_lost;
  else if (t.position_error || t.velocity_error || t.restarted || t.inconsistent ||
           t.implausible_bias)
    t.state = EstimateState::degraded;
  else
    t.state = t.no_position ? EstimateState::dead_reckoning : EstimateState::good;
}

}  // namespace tilt_ropter::detail
