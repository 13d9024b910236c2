#pragma once

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "support/random.hpp"

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

/// Flights in closed form and their onboard sensors, for tests of state estimators.
namespace test_support {

using tilt_ropter::InertialNoise;
using tilt_ropter::InertialSampled;
using tilt_ropter::InertialStated;
using tilt_ropter::MarkerPosed;
using tilt_ropter::MarkerPoseNoise;
using tilt_ropter::Timed;

/// Three sines per axis, and their derivatives. The frequencies are fixed, the phases are random.
class SumOfSines {
 public:
  SumOfSines(double amplitude, Random& random) : amplitude_(amplitude) {
    for (auto& phase : phases_)
      for (int axis = 0; axis < 3; ++axis) phase(axis) = random.uniform(0.0, 2.0 * tilt_ropter::pi);
  }

  /// Returns the derivative of this order at time t [s].
  [[nodiscard]] Eigen::Vector3d operator()(double t, int order) const {
    Eigen::Vector3d sum = Eigen::Vector3d::Zero();
    for (std::size_t i = 0; i < phases_.size(); ++i)
      for (int axis = 0; axis < 3; ++axis) {
        const double w = frequency(i, axis);
        sum(axis) += part(i) * std::pow(w, order) *
                     std::sin(w * t + phases_[i](axis) + order * tilt_ropter::pi / 2.0);
      }
    return sum;
  }

  /// Returns the root mean square of the derivative of this order over random phases: one axis,
  /// averaged over the three axes.
  [[nodiscard]] double deviation(int order) const {
    double square = 0.0;
    for (std::size_t i = 0; i < phases_.size(); ++i)
      for (int axis = 0; axis < 3; ++axis)
        square += std::pow(part(i) * std::pow(frequency(i, axis), order), 2) / 6.0;
    return std::sqrt(square);
  }

 private:
  [[nodiscard]] double part(std::size_t i) const { return amplitude_ / static_cast<double>(1 + i); }
  /// All frequencies are different: 0.9 to 5.5 rad/s.
  [[nodiscard]] static double frequency(std::size_t i, int axis) {
    return 0.9 + 1.7 * static_cast<double>(i) + 0.6 * axis;
  }

  double amplitude_;
  std::array<Eigen::Vector3d, 3> phases_;
};

/// A smooth flight in closed form, with rotation about all axes, accelerations of several m/s^2 and
/// rates of 1 to 3 rad/s. The position is a sum of sines. The orientation is q0 Exp(a(t)), where
/// a(t) is also a sum of sines.
class Flight {
 public:
  /// Starts from any orientation. The marker frame M is at `marker_position` [m] in the body frame.
  explicit Flight(unsigned seed, const Eigen::Quaterniond& start = Eigen::Quaterniond::Identity(),
                  const Eigen::Vector3d& marker_position = Eigen::Vector3d::Zero(),
                  const Eigen::Quaterniond& marker_orientation = Eigen::Quaterniond::Identity())
      : random_(seed),
        way_(0.5, random_),
        turn_(0.5, random_),
        start_(start),
        marker_position_(marker_position),
        marker_orientation_(marker_orientation) {}

  /// Returns the true state at time t [s]; the biases are zero.
  [[nodiscard]] InertialStated state(double t) const {
    InertialStated x;
    x.position = way_(t, 0);
    x.velocity = way_(t, 1);
    x.orientation = start_ * tilt_ropter::quaternion_exp(turn_(t, 0));
    x.marker_position = marker_position_;
    x.marker_orientation = marker_orientation_;
    return x;
  }

  /// Returns the sample of an IMU without errors at time t [s].
  [[nodiscard]] InertialSampled imu(double t) const {
    InertialSampled sample;
    sample.angular_velocity = tilt_ropter::right_jacobian(turn_(t, 0)) * turn_(t, 1);
    sample.specific_force = state(t).orientation.conjugate() *
                            (way_(t, 2) + Eigen::Vector3d(0.0, 0.0, tilt_ropter::gravity)).eval();
    return sample;
  }

  [[nodiscard]] MarkerPosed pose(double t) const {
    const InertialStated x = state(t);
    return {x.position + x.orientation * marker_position_, x.orientation * marker_orientation_};
  }

  /// Standard deviation of the velocity at any time over seeds, per axis [m/s].
  [[nodiscard]] double velocity_stddev() const { return way_.deviation(1); }

 private:
  Random random_;
  SumOfSines way_, turn_;
  Eigen::Quaterniond start_;
  Eigen::Vector3d marker_position_;
  Eigen::Quaterniond marker_orientation_;
};

/// Returns a random vector whose entries have the standard deviation `deviation`.
inline Eigen::Vector3d normal_vector(Random& random, double deviation) {
  const double x = random.normal(deviation), y = random.normal(deviation);
  return {x, y, random.normal(deviation)};
}

/// The IMU of a flight with white noise and random-walk biases.
class NoisyImu {
 public:
  /// `period` [s] is the time between samples. A noise density d gives each sample the standard
  /// deviation d / sqrt(period).
  NoisyImu(const Flight& flight, const InertialNoise& noise, double period, unsigned seed,
           const Eigen::Vector3d& gyro_bias = Eigen::Vector3d::Zero(),
           const Eigen::Vector3d& accelerometer_bias = Eigen::Vector3d::Zero())
      : flight_(flight),
        noise_(noise),
        root_(std::sqrt(period)),
        random_(seed),
        gyro_bias_(gyro_bias),
        accelerometer_bias_(accelerometer_bias) {}

  InertialSampled operator()(double t) {
    gyro_bias_ += normal_vector(random_, noise_.gyro_bias_walk * root_);
    accelerometer_bias_ += normal_vector(random_, noise_.accelerometer_bias_walk * root_);
    InertialSampled sample = flight_.imu(t);
    sample.angular_velocity += gyro_bias_ + normal_vector(random_, noise_.gyro_density / root_);
    sample.specific_force +=
        accelerometer_bias_ + normal_vector(random_, noise_.accelerometer_density / root_);
    return sample;
  }

  /// Returns the true state at time t with the biases of the last sample.
  [[nodiscard]] InertialStated state(double t) const {
    InertialStated x = flight_.state(t);
    x.gyro_bias = gyro_bias_;
    x.accelerometer_bias = accelerometer_bias_;
    return x;
  }

 private:
  Flight flight_;
  InertialNoise noise_;
  double root_;
  Random random_;
  Eigen::Vector3d gyro_bias_, accelerometer_bias_;
};

/// Returns `pose` with white noise.
inline MarkerPosed noisy(const MarkerPosed& pose, const MarkerPoseNoise& noise, Random& random) {
  return {pose.position + normal_vector(random, noise.position),
          pose.orientation * tilt_ropter::quaternion_exp(normal_vector(random, noise.orientation))};
}

/// Returns a pose that differs from `pose` by 0.5 to 5 m and 0.3 to 3 rad.
inline MarkerPosed gone_wrong(const MarkerPosed& pose, Random& random) {
  const Eigen::Vector3d axis = random.orientation() * Eigen::Vector3d::UnitX();
  return {
      pose.position + random.orientation() * Eigen::Vector3d(random.uniform(0.5, 5.0), 0.0, 0.0),
      pose.orientation * tilt_ropter::quaternion_exp(random.uniform(0.3, 3.0) * axis)};
}

/// Returns the same rotation with the opposite sign of the quaternion.
inline MarkerPosed flipped(MarkerPosed pose) {
  pose.orientation.coeffs() *= -1.0;
  return pose;
}

}  // namespace test_support
