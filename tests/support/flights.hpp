#pragma once

#include <tilt_ropter/estimation/error_state_filter.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "support/random.hpp"

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

/// Flights in closed form and the sensors on board, for tests of what estimates a state.
namespace test_support {

using tilt_ropter::InertialNoise;
using tilt_ropter::InertialSample;
using tilt_ropter::InertialState;
using tilt_ropter::MarkerPose;
using tilt_ropter::MarkerPoseNoise;
using tilt_ropter::Timed;

/// Three sines per axis and two of its derivatives. Frequencies are fixed, phases random.
class SumOfSines {
 public:
  SumOfSines(double amplitude, Random& random) : amplitude_(amplitude) {
    for (auto& phase : phases_)
      for (int axis = 0; axis < 3; ++axis) phase(axis) = random.uniform(0.0, 2.0 * tilt_ropter::pi);
  }

  /// The order-th derivative at time t.
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

  /// Root mean square of the order-th derivative over phases, per axis (their mean).
  [[nodiscard]] double deviation(int order) const {
    double square = 0.0;
    for (std::size_t i = 0; i < phases_.size(); ++i)
      for (int axis = 0; axis < 3; ++axis)
        square += std::pow(part(i) * std::pow(frequency(i, axis), order), 2) / 6.0;
    return std::sqrt(square);
  }

 private:
  [[nodiscard]] double part(std::size_t i) const { return amplitude_ / static_cast<double>(1 + i); }
  /// No two alike: 0.9 to 5.5 rad/s.
  [[nodiscard]] static double frequency(std::size_t i, int axis) {
    return 0.9 + 1.7 * static_cast<double>(i) + 0.6 * axis;
  }

  double amplitude_;
  std::array<Eigen::Vector3d, 3> phases_;
};

/// A smooth flight about all axes with accelerations of several m/s^2 and rates of 1 to 3 rad/s,
/// in closed form: position a sum of sines, orientation q0 Exp(a(t)) with a(t) one, too.
class Flight {
 public:
  /// From any orientation; the marker frame M sits at `marker_position` in the body frame.
  explicit Flight(unsigned seed, const Eigen::Quaterniond& start = Eigen::Quaterniond::Identity(),
                  const Eigen::Vector3d& marker_position = Eigen::Vector3d::Zero(),
                  const Eigen::Quaterniond& marker_orientation = Eigen::Quaterniond::Identity())
      : random_(seed),
        way_(0.5, random_),
        turn_(0.5, random_),
        start_(start),
        marker_position_(marker_position),
        marker_orientation_(marker_orientation) {}

  /// Biases are zero.
  [[nodiscard]] InertialState<> state(double t) const {
    InertialState<> x;
    x.position = way_(t, 0);
    x.velocity = way_(t, 1);
    x.orientation = start_ * tilt_ropter::quaternion_exp(turn_(t, 0));
    x.marker_position = marker_position_;
    x.marker_orientation = marker_orientation_;
    return x;
  }

  /// What an IMU without errors shows at one instant.
  [[nodiscard]] InertialSample<> imu(double t) const {
    InertialSample<> sample;
    sample.angular_velocity = tilt_ropter::right_jacobian(turn_(t, 0)) * turn_(t, 1);
    sample.specific_force = state(t).orientation.conjugate() *
                            (way_(t, 2) + Eigen::Vector3d(0.0, 0.0, tilt_ropter::gravity)).eval();
    return sample;
  }

  [[nodiscard]] MarkerPose<> pose(double t) const {
    const InertialState<> x = state(t);
    return {x.position + x.orientation * marker_position_, x.orientation * marker_orientation_};
  }

  /// Of the velocity at any time over seeds, per axis [m/s].
  [[nodiscard]] double velocity_deviation() const { return way_.deviation(1); }

 private:
  Random random_;
  SumOfSines way_, turn_;
  Eigen::Quaterniond start_;
  Eigen::Vector3d marker_position_;
  Eigen::Quaterniond marker_orientation_;
};

/// Entries of standard deviation `deviation`.
inline Eigen::Vector3d normal_vector(Random& random, double deviation) {
  const double x = random.normal(deviation), y = random.normal(deviation);
  return {x, y, random.normal(deviation)};
}

/// The IMU of a flight with white noise and biases that walk.
class NoisyImu {
 public:
  /// `period` [s] is that between samples: a density d is a deviation d / sqrt(period) of each.
  NoisyImu(const Flight& flight, const InertialNoise& noise, double period, unsigned seed,
           const Eigen::Vector3d& gyro_bias = Eigen::Vector3d::Zero(),
           const Eigen::Vector3d& accelerometer_bias = Eigen::Vector3d::Zero())
      : flight_(flight),
        noise_(noise),
        root_(std::sqrt(period)),
        random_(seed),
        gyro_bias_(gyro_bias),
        accelerometer_bias_(accelerometer_bias) {}

  InertialSample<> operator()(double t) {
    gyro_bias_ += normal_vector(random_, noise_.gyro_bias_walk * root_);
    accelerometer_bias_ += normal_vector(random_, noise_.accelerometer_bias_walk * root_);
    InertialSample<> sample = flight_.imu(t);
    sample.angular_velocity += gyro_bias_ + normal_vector(random_, noise_.gyro_density / root_);
    sample.specific_force +=
        accelerometer_bias_ + normal_vector(random_, noise_.accelerometer_density / root_);
    return sample;
  }

  /// The truth at time t with the biases of the last sample.
  [[nodiscard]] InertialState<> state(double t) const {
    InertialState<> x = flight_.state(t);
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

/// `pose` with white noise.
inline MarkerPose<> noisy(const MarkerPose<>& pose, const MarkerPoseNoise& noise, Random& random) {
  return {pose.position + normal_vector(random, noise.position),
          pose.orientation * tilt_ropter::quaternion_exp(normal_vector(random, noise.orientation))};
}

/// Metres and tens of degrees away from `pose`.
inline MarkerPose<> gone_wrong(const MarkerPose<>& pose, Random& random) {
  const Eigen::Vector3d axis = random.orientation() * Eigen::Vector3d::UnitX();
  return {
      pose.position + random.orientation() * Eigen::Vector3d(random.uniform(0.5, 5.0), 0.0, 0.0),
      pose.orientation * tilt_ropter::quaternion_exp(random.uniform(0.3, 3.0) * axis)};
}

/// The same rotation with the other sign.
inline MarkerPose<> flipped(MarkerPose<> pose) {
  pose.orientation.coeffs() *= -1.0;
  return pose;
}

}  // namespace test_support
