// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/inertial_state.hpp>
#include <tilt_ropter/estimation/detail/measurement_model.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <limits>

/// Mathematics of the state estimator, without clocks: an error-state Kalman filter on SO(3) after
/// J. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017, Secs. 5-7 (local
/// orientation errors). Ekf (ekf.hpp) passes measurements with time stamps to it. Does not
/// allocate. Only the constructor and validate() throw.
namespace tilt_ropter {

/// Noise of an IMU. Data sheets give the densities of an IMU at rest. Ten times these values are
/// usual on a vibrating vehicle, also to cover misalignment and scale errors.
struct InertialNoise {
  double gyro_density = 2.0e-3;  ///< noise density of the angular velocity [rad/s/sqrt(Hz)]
  double accelerometer_density = 2.0e-2;  ///< noise density of the specific force [m/s^2/sqrt(Hz)]
  double gyro_bias_walk = 2.0e-5;         ///< random walk of the bias [rad/s^2/sqrt(Hz)]
  double accelerometer_bias_walk = 1.0e-3;  ///< random walk of the bias [m/s^3/sqrt(Hz)]
};

inline void validate(const InertialNoise& n) {
  const double most = 1e3;
  require_in("InertialNoise.gyro_density [rad/s/sqrt(Hz)]", n.gyro_density, 0.0, most);
  require_in("InertialNoise.accelerometer_density [m/s^2/sqrt(Hz)]", n.accelerometer_density, 0.0,
             most);
  require_in("InertialNoise.gyro_bias_walk [rad/s^2/sqrt(Hz)]", n.gyro_bias_walk, 0.0, most);
  require_in("InertialNoise.accelerometer_bias_walk [m/s^3/sqrt(Hz)]", n.accelerometer_bias_walk,
             0.0, most);
}

/// Standard deviations of a MarkerPose, per axis.
struct MarkerPoseNoise {
  double position = 2.0e-3;     ///< of the position, world frame [m]
  double orientation = 5.0e-3;  ///< of the orientation, marker frame [rad]
};

inline void validate(const MarkerPoseNoise& n) {
  require_in("MarkerPoseNoise.position [m]", n.position, 1e-6, 1e3);
  require_in("MarkerPoseNoise.orientation [rad]", n.orientation, 1e-6, 10.0);
}

namespace detail {

/// Adds to the variance of one part of the state (see InertialIndex).
template <typename Covariance>
void add_variance(Covariance& p, int part, double stddev) noexcept {
  for (int i = part; i < part + 3; ++i)
    p(i, i) += static_cast<typename Covariance::Scalar>(stddev * stddev);
}

}  // namespace detail

/// A pose linearised at a state, with its sparse Jacobian
/// H = [I 0 by_turn 0 0 0 rotation; 0 0 to_marker 0 0 I 0]. Same interface as Linearised.
template <typename Scalar>
struct LinearisedPose {
  static constexpr int rows = 6;
  using Square = Eigen::Matrix<Scalar, 6, 6>;
  using Columns = Eigen::Matrix<Scalar, InertialIndex::size, 6>;

  /// `noise` is the diagonal of R. `pose` has an orientation of unit length.
  LinearisedPose(const InertialState<Scalar>& x, const MarkerPose<Scalar>& pose,
                 const Eigen::Matrix<Scalar, 6, 1>& variances) noexcept
      : rotation(x.orientation.toRotationMatrix()),
        to_marker(x.marker_orientation.conjugate().toRotationMatrix()),
        noise(variances) {
    using detail::put, detail::triple;
    const auto place = triple(x.marker_position);
    const auto turn = detail::square(rotation);
    put(times_cross(Scalar(-1) * turn, place), by_turn, 0, 0);
    put(triple(pose.position) - triple(x.position) - turn * place, residual);
    put(triple(quaternion_log(Eigen::Quaternion<Scalar>(
            (x.orientation * x.marker_orientation).conjugate() * pose.orientation))),
        residual, 3);
  }

  /// Adds the noise `stddev` of a stamp [s] at this velocity of the IMU [m/s] and rate [rad/s].
  void set_motion(const Vector3<Scalar>& velocity, const Vector3<Scalar>& angular_velocity,
                  const Scalar& stddev) noexcept {
    constexpr double slow = 0.2;  // [m/s], [rad/s]: noise of the estimate must not look like motion
    if (!(velocity.norm() + angular_velocity.norm() > Scalar(slow))) return;
    by_time << velocity + by_turn * angular_velocity, to_marker * angular_velocity;
    stamp_variance = stddev * stddev;
  }

  /// Leaves the position alone.
  void ignore_orientation() noexcept {
    residual.template tail<3>().setZero();
    by_time.template tail<3>().setZero();
    noise.template tail<3>().setConstant(Scalar(1e6));
  }

  [[nodiscard]] Columns times_transpose(
      const Eigen::Matrix<Scalar, InertialIndex::size, InertialIndex::size>& m) const noexcept {
    using I = InertialIndex;
    const auto columns = [](auto& of, int start) { return of.data() + I::size * start; };
    Columns product;
    std::copy_n(columns(m, I::position), 3 * I::size, columns(product, 0));
    std::copy_n(columns(m, I::marker_orientation), 3 * I::size, columns(product, 3));
    const auto add = [&](int from, const Matrix3<Scalar>& by, int to) {
      detail::add_product<I::size, 3, 3>(columns(m, from), detail::transposed_entries(by),
                                         columns(product, to));
    };
    add(I::orientation, by_turn, 0);
    add(I::marker_position, rotation, 0);
    add(I::orientation, to_marker, 3);
    return product;
  }
  template <int N>
  [[nodiscard]] Eigen::Matrix<Scalar, 6, N> times(
      const Eigen::Matrix<Scalar, InertialIndex::size, N>& c) const noexcept {
    using I = InertialIndex;
    Eigen::Matrix<Scalar, 6, N> s;
    for (int n = 0; n < N; ++n) {
      const auto turn = detail::triple(c, I::orientation, n);
      detail::put(detail::triple(c, I::position, n) + detail::square(by_turn) * turn +
                      detail::square(rotation) * detail::triple(c, I::marker_position, n),
                  s, 0, n);
      detail::put(detail::triple(c, I::marker_orientation, n) + detail::square(to_marker) * turn, s,
                  3, n);
    }
    return s;
  }
  [[nodiscard]] Columns times_noise(const Columns& g) const noexcept {
    Columns product;
    for (int j = 0; j < rows; ++j)
      for (int i = 0; i < InertialIndex::size; ++i) product(i, j) = g(i, j) * noise(j);
    if (!(stamp_variance > Scalar(0))) return product;
    InertialTangent<Scalar> moved = InertialTangent<Scalar>::Zero();
    detail::add_product<InertialIndex::size, rows, 1>(g.data(), detail::entries(by_time),
                                                      moved.data(), stamp_variance);
    detail::add_product<InertialIndex::size, 1, rows>(
        moved.data(), detail::transposed_entries(by_time), product.data());
    return product;
  }
  void add_noise(Square& s) const noexcept {
    for (int j = 0; j < rows; ++j) {
      s(j, j) += noise(j);
      for (int i = 0; i < rows; ++i) s(i, j) += stamp_variance * by_time(i) * by_time(j);
    }
  }

  Matrix3<Scalar> rotation, to_marker, by_turn;
  Eigen::Matrix<Scalar, 6, 1> residual;  ///< position, world [m]; rotation vector, M [rad]
  Eigen::Matrix<Scalar, 6, 1> noise;     ///< variances
  Eigen::Matrix<Scalar, 6, 1> by_time = Eigen::Matrix<Scalar, 6, 1>::Zero();  ///< d pose / d time
  Scalar stamp_variance = Scalar(0);                                          ///< [s^2]
};

/// Difference between a measurement and the state.
template <typename Scalar, int Rows>
struct MeasurementInnovation {
  Eigen::Matrix<Scalar, Rows, 1> residual;       ///< measured - predicted
  Eigen::Matrix<Scalar, Rows, Rows> covariance;  ///< S, covariance of the residual
  /// NIS, r' S^-1 r: chi-square of `Rows` degrees of freedom. The largest number if it overflows,
  /// or if rounding has made S indefinite.
  Scalar distance;
  bool is_definite;                        ///< S is positive definite
  Eigen::Matrix<Scalar, Rows, 1> by_time;  ///< derivative of the measurement by time
  /// P H', cross-covariance of the state's error and the residual.
  Eigen::Matrix<Scalar, InertialIndex::size, Rows> correlation;
};

/// State and covariance of its error. If the covariance of a part of the state is zero, this part
/// is known: the filter uses it and does not change it.
template <typename Scalar>
class ErrorStateFilter {
 public:
  using Covariance = Eigen::Matrix<Scalar, 21, 21>;

  /// Throws std::invalid_argument if a noise value is out of range.
  ErrorStateFilter(const InertialNoise& inertial, const MarkerPoseNoise& pose);

  void reset(const InertialState<Scalar>& state, const Covariance& covariance) noexcept {
    state_ = state;
    covariance_ = covariance;
    by_latency_.setZero();
    updates_ = 0;
    score_ = excess_ = Scalar(0);
    information_ = Scalar(least_information);
  }

  /// Time by which the poses' stamps are late [s], by recursive least squares over the innovations,
  /// as in a filter with this state (B. Friedland, "Treatment of bias in recursive filtering",
  /// 1969). Zero if it is not significant, or if something else explains more of the innovations.
  [[nodiscard]] Scalar latency() const noexcept {
    const Scalar explained = score_ * score_ / information_;
    return explained > std::max(Scalar(36), excess_ / Scalar(3)) ? score_ / information_
                                                                 : Scalar(0);
  }
  /// Corrects the state after poses that were late by `latency` [s]. The next ones are not.
  void correct_latency(const Scalar& latency) noexcept {
    state_ = retract(state_, InertialTangent<Scalar>(by_latency_ * latency));
    score_ = excess_ = Scalar(0);
  }

  /// Widens the covariance and the noise of a sensor that is wrong. predict() forgets this slowly.
  /// `off`: what it has done to position or velocity within a second or so [m], [m/s].
  void widen(bool gyro, double off = 0.0) noexcept;
  void forget_wider_noise() noexcept { wider_.setOnes(); }
  /// True for some time after widen().
  [[nodiscard]] bool is_wider() const noexcept { return wider_.maxCoeff() > Scalar(1.2); }
  /// True if widen() was called again and again: poses and IMU go on contradicting each other.
  [[nodiscard]] bool is_much_wider() const noexcept { return wider_.maxCoeff() > Scalar(5); }
  /// True if more noise explains nothing: something else is wrong, such as the marker frame.
  [[nodiscard]] bool is_widest() const noexcept { return wider_.maxCoeff() > Scalar(0.9 * widest); }

  /// Propagates state and covariance by `dt` > 0 [s] under `sample` (see propagate).
  void predict(const InertialSample<Scalar>& sample, const Scalar& dt) noexcept;

  /// Linearises a pose (orientation of unit length) at the state.
  [[nodiscard]] LinearisedPose<Scalar> linearise(const MarkerPose<Scalar>& pose) const noexcept {
    return {state_, pose, pose_noise_};
  }

  /// Compares a measurement (Linearised or LinearisedPose) with the state of its linearisation.
  template <typename Measurement>
  [[nodiscard]] MeasurementInnovation<Scalar, Measurement::rows> innovation_of(
      const Measurement& at) const noexcept;

  /// Updates state and covariance with a measurement, linearised at the current state, and its
  /// innovation, in Joseph's form (I - K H) P (I - K H)' + K R K', which no error of the gain makes
  /// negative. Returns false and changes nothing if S is not positive definite: rounding can cause
  /// this if P is larger than the noise by more digits than a Scalar has.
  template <typename Measurement>
  bool update(const MeasurementInnovation<Scalar, Measurement::rows>& in,
              const Measurement& at) noexcept;

  /// Updates with a pose (orientation of unit length), whatever its innovation.
  bool update(const MarkerPose<Scalar>& pose) noexcept {
    const LinearisedPose<Scalar> at = linearise(pose);
    return update(innovation_of(at), at);
  }

  [[nodiscard]] const InertialState<Scalar>& state() const noexcept { return state_; }
  [[nodiscard]] const Covariance& covariance() const noexcept { return covariance_; }

 private:
  static constexpr int noisy = InertialIndex::velocity;  // first state with process noise

  InertialState<Scalar> state_;
  Covariance covariance_ = Covariance::Zero();
  /// Variance rates of velocity ... accelerometer bias [1/s].
  Eigen::Matrix<Scalar, 12, 1> process_noise_;
  Eigen::Matrix<Scalar, 6, 1> pose_noise_;
  static constexpr double widest = 100.0;
  static constexpr double latency_memory = 20.0;      // [s]
  static constexpr double least_information = 400.0;  // a standard deviation of 50 ms [1/s^2]
  InertialTangent<Scalar> by_latency_ = InertialTangent<Scalar>::Zero();  ///< d error / d latency
  Scalar score_ = Scalar(0), information_ = Scalar(least_information);    ///< of the least squares
  Scalar excess_ = Scalar(0);                                             ///< sum of NIS minus rows
  static constexpr int first_updates = 50;  // they say little of a latency
  int updates_ = 0;                         ///< since reset() or widen()
  /// Factors of the noise of accelerometer and gyroscope, from 1 to `widest`.
  Eigen::Matrix<Scalar, 2, 1> wider_ = Eigen::Matrix<Scalar, 2, 1>::Ones();
};
using ErrorStateFilterd = ErrorStateFilter<double>;  ///< in double precision

template <typename Scalar>
ErrorStateFilter<Scalar>::ErrorStateFilter(const InertialNoise& inertial,
                                           const MarkerPoseNoise& pose) {
  validate(inertial);
  validate(pose);
  const auto square = [](double stddev) { return Scalar(stddev * stddev); };
  const auto set_noise = [&](int start, double density) {
    std::fill_n(process_noise_.data() + start - noisy, 3, square(density));
  };
  using I = InertialIndex;
  set_noise(I::velocity, inertial.accelerometer_density);
  set_noise(I::orientation, inertial.gyro_density);
  set_noise(I::gyro_bias, inertial.gyro_bias_walk);
  set_noise(I::accelerometer_bias, inertial.accelerometer_bias_walk);
  std::fill_n(pose_noise_.data(), 3, square(pose.position));
  std::fill_n(pose_noise_.data() + 3, 3, square(pose.orientation));
}

template <typename Scalar>
void ErrorStateFilter<Scalar>::predict(const InertialSample<Scalar>& sample,
                                       const Scalar& dt) noexcept {
  const InertialTransition<Scalar> f(state_, sample, dt);
  f.template apply<21, 1, 21>(covariance_.data());  // P F'
  f.template apply<1, 21, 9>(covariance_.data());   // F P F', of its first nine columns
  // Rounding leaves an asymmetric part, which would grow from step to step.
  for (int j = 0; j < 9; ++j) {
    for (int i = 0; i < j; ++i)
      covariance_(i, j) = covariance_(j, i) = (covariance_(i, j) + covariance_(j, i)) / Scalar(2);
    for (int i = 9; i < 21; ++i) covariance_(j, i) = covariance_(i, j);
  }
  f.template apply<1, 21, 1>(by_latency_.data());
  const Scalar forgotten = std::min(Scalar(1), dt / Scalar(latency_memory));
  score_ -= forgotten * score_;
  excess_ -= forgotten * excess_;
  information_ -= forgotten * (information_ - Scalar(least_information));
  constexpr double time_constant = 20.0;  // long beside the contradictions of a vibration [s]
  for (int i = 0; i < 12; ++i) {  // velocity, orientation, biases of gyroscope and accelerometer
    const Scalar factor = wider_(i >= 3 && i < 9 ? 1 : 0);
    covariance_(noisy + i, noisy + i) += dt * factor * factor * process_noise_(i);
  }
  for (int i = 0; i < 2; ++i)
    wider_(i) -= (wider_(i) - Scalar(1)) * std::min(Scalar(1), dt / Scalar(time_constant));
  const InertialState<Scalar> before = state_;
  state_ = propagate(state_, sample, dt);
  // Late poses have started a filter that is late.
  if (updates_ < first_updates) by_latency_ = difference(state_, before) / dt;
}

template <typename Scalar>
void ErrorStateFilter<Scalar>::widen(bool gyro, double off) noexcept {
  using I = InertialIndex;
  // Steps of the bias that are followed at once, and what they have done since.
  constexpr double rate = 0.3, turn = 0.05, force = 2.0, velocity = 0.3;
  constexpr double growth = 3.0;  // of the noise
  const auto add = [this](int part, double stddev) {
    detail::add_variance(covariance_, part, stddev);
  };
  add(gyro ? I::gyro_bias : I::accelerometer_bias, gyro ? rate : force);
  add(gyro ? I::orientation : I::velocity, gyro ? turn : velocity);
  add(I::position, off);
  add(I::velocity, 2.0 * off);
  wider_(gyro) = std::min(Scalar(growth) * wider_(gyro), Scalar(widest));
  updates_ = 0;
}

template <typename Scalar>
template <typename Measurement>
MeasurementInnovation<Scalar, Measurement::rows> ErrorStateFilter<Scalar>::innovation_of(
    const Measurement& at) const noexcept {
  MeasurementInnovation<Scalar, Measurement::rows> in;
  in.residual = at.residual;
  in.correlation = at.times_transpose(covariance_);
  in.covariance = at.times(in.correlation);
  detail::symmetrise(in.covariance);
  at.add_noise(in.covariance);
  const detail::Cholesky factor(in.covariance);
  in.by_time = at.by_time;
  in.distance = std::numeric_limits<Scalar>::max();
  in.is_definite = factor.is_definite;
  if (!in.is_definite) return in;
  const Scalar square = in.residual.dot(factor.solve(in.residual));
  if (square < in.distance) in.distance = square;  // huge residuals overflow
  return in;
}

template <typename Scalar>
template <typename Measurement>
bool ErrorStateFilter<Scalar>::update(const MeasurementInnovation<Scalar, Measurement::rows>& in,
                                      const Measurement& at) noexcept {
  const detail::Cholesky factor(in.covariance);
  if (!factor.is_definite) return false;
  const typename Measurement::Columns gain = factor.solve_rows(in.correlation);
  constexpr int size = InertialIndex::size, rows = Measurement::rows;
  Covariance left = covariance_;  // (I - K H) P
  detail::add_product<size, rows, size>(gain.data(), detail::transposed_entries(in.correlation),
                                        left.data(), Scalar(-1));
  typename Measurement::Columns rest = at.times_noise(gain);
  rest -= at.times_transpose(left);
  for (int j = 0; j < size; ++j) {  // the lower triangle: the other one differs by rounding
    for (int k = 0; k < rows; ++k)
      for (int i = j; i < size; ++i) left(i, j) += rest(i, k) * gain(j, k);
    for (int i = j; i < size; ++i) covariance_(i, j) = covariance_(j, i) = left(i, j);
  }
  const auto times_gain = [&gain](const Eigen::Matrix<Scalar, rows, 1>& x) {
    InertialTangent<Scalar> result = InertialTangent<Scalar>::Zero();
    detail::add_product<size, rows, 1>(gain.data(), detail::entries(x), result.data());
    return result;
  };
  state_ = retract(state_, times_gain(in.residual));
  if (updates_ < first_updates) return ++updates_, true;
  const Eigen::Matrix<Scalar, Measurement::rows, 1> by_latency = at.times(by_latency_) - at.by_time,
                                                    weighted = factor.solve(by_latency);
  by_latency_ -= times_gain(by_latency);
  score_ += weighted.dot(in.residual);
  information_ += weighted.dot(by_latency);
  excess_ += in.distance - Scalar(Measurement::rows);
  return true;
}

}  // namespace tilt_ropter
