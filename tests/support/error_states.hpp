#pragma once

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include "support/flights.hpp"
#include "support/random.hpp"

#include <Eigen/Core>

#include <cmath>

/// Filters, states and covariances for tests of the error-state filter.
namespace test_support {

/// Returns a filter with typical noise.
inline tilt_ropter::ErrorStateFilterd filter() {
  return {InertialNoise{2e-3, 2e-2, 2e-5, 3e-4}, MarkerPoseNoise{2e-3, 5e-3}};
}

/// Returns a random state with biases and a marker frame.
inline InertialStated random_inertial_state(Random& random) {
  InertialStated x;
  x.position = random.vector(5.0);
  x.velocity = random.vector(5.0);
  x.orientation = random.orientation();
  x.gyro_bias = random.vector(0.1);
  x.accelerometer_bias = random.vector(0.5);
  x.marker_orientation = random.orientation();
  x.marker_position = random.vector(0.2);
  return x;
}

/// Returns a random covariance. All parts of the state are correlated, with magnitudes typical for
/// the filter.
inline tilt_ropter::ErrorStateFilterd::Covariance random_covariance(Random& random) {
  using Tangent = tilt_ropter::InertialTangentd;
  using Covariance = tilt_ropter::ErrorStateFilterd::Covariance;
  Covariance a = Covariance::NullaryExpr([&random] { return random.normal(1.0); });
  const Tangent size =
      Tangent::NullaryExpr([&random] { return std::pow(10.0, random.uniform(-3.0, 0.0)); });
  a = (size.asDiagonal() * a).eval();
  Covariance p = a * a.transpose() / 21.0;
  p.triangularView<Eigen::StrictlyUpper>() = p.transpose();
  return p;
}

/// Returns the same value with another scalar.
template <typename Scalar, typename From>
tilt_ropter::InertialState<Scalar> cast(const tilt_ropter::InertialState<From>& x) {
  tilt_ropter::InertialState<Scalar> y;
  y.position = x.position.template cast<Scalar>();
  y.velocity = x.velocity.template cast<Scalar>();
  y.orientation = x.orientation.template cast<Scalar>();
  y.gyro_bias = x.gyro_bias.template cast<Scalar>();
  y.accelerometer_bias = x.accelerometer_bias.template cast<Scalar>();
  y.marker_orientation = x.marker_orientation.template cast<Scalar>();
  y.marker_position = x.marker_position.template cast<Scalar>();
  return y;
}

/// Returns the same value with another scalar.
template <typename Scalar>
tilt_ropter::InertialSample<Scalar> cast(const InertialSampled& s) {
  return {s.angular_velocity.cast<Scalar>(), s.specific_force.cast<Scalar>()};
}

/// Returns the same value with another scalar.
template <typename Scalar>
tilt_ropter::MarkerPose<Scalar> cast(const MarkerPosed& pose) {
  return {pose.position.cast<Scalar>(), pose.orientation.cast<Scalar>()};
}

}  // namespace test_support
