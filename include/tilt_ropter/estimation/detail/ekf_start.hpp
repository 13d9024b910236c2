// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/ekf_settings.hpp>
#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>

/// State and covariance with which Ekf starts and restarts. Nothing here throws or allocates.
namespace tilt_ropter {

/// Standard deviations of a state that is given to Ekf::start(), per axis.
struct StartStddev {
  double position = 1.0;     ///< [m]
  double velocity = 0.5;     ///< [m/s]
  double orientation = 0.1;  ///< [rad]
};

namespace detail {

/// Sets the variance of one part of the state (see InertialIndex).
template <typename Covariance>
void set_variance(Covariance& p, int part, double stddev) noexcept {
  using Scalar = typename Covariance::Scalar;
  for (int i = part; i < part + 3; ++i) p(i, i) = Scalar(stddev * stddev);
}

/// Replaces the covariance of one part of the state: it does not depend on other parts any more.
template <typename Covariance>
void forget(Covariance& p, int part, double stddev) noexcept {
  for (int i = 0; i < p.rows(); ++i)
    for (int k = part; k < part + 3; ++k) p(i, k) = p(k, i) = 0;
  set_variance(p, part, stddev);
}

/// Sets the marker frame, relative to the IMU, to that of the settings.
template <typename Scalar>
void set_marker_frame(InertialState<Scalar>& x, const EkfSettings& settings) noexcept {
  x.marker_position = (settings.marker_position - settings.imu_position).template cast<Scalar>();
  x.marker_orientation = settings.marker_orientation.template cast<Scalar>();
}

/// Standard deviation of the marker's position relative to the IMU [m].
inline double marker_position_stddev(const EkfSettings& settings) noexcept {
  return std::max(settings.marker_position_stddev, settings.imu_position_stddev);
}

/// Replaces the covariance of the marker frame, relative to the IMU, by that of the settings.
template <typename Covariance>
void forget_marker_frame(Covariance& p, const EkfSettings& settings) noexcept {
  forget(p, InertialIndex::marker_orientation, settings.marker_orientation_stddev);
  forget(p, InertialIndex::marker_position, marker_position_stddev(settings));
}

/// Changes the covariance of IMU and marker frame to that of the body's position and velocity, if
/// the position of the IMU, `body_to_imu` in the body frame [m], is estimated. `sign` -1: back.
template <typename Scalar, typename Covariance>
void move_to_body(Covariance& p, const Eigen::Quaternion<Scalar>& orientation,
                  const Vector3<Scalar>& angular_velocity, const Vector3<Scalar>& body_to_imu,
                  Scalar sign = Scalar(1)) noexcept {
  using I = InertialIndex;
  const Matrix3<Scalar> rotation = sign * orientation.toRotationMatrix();
  const Matrix3<Scalar> position_by_turn = rotation * skew(body_to_imu),
                        velocity_by_turn =
                            rotation * skew(Vector3<Scalar>(angular_velocity.cross(body_to_imu))),
                        velocity_by_place = rotation * skew(angular_velocity),
                        velocity_by_bias = -rotation * skew(body_to_imu);
  const auto rows = [&p](int start) { return p.template middleRows<3>(start); };
  rows(I::position) +=
      (position_by_turn * rows(I::orientation) + rotation * rows(I::marker_position)).eval();
  rows(I::velocity) +=
      (velocity_by_turn * rows(I::orientation) + velocity_by_bias * rows(I::gyro_bias) +
       velocity_by_place * rows(I::marker_position))
          .eval();
  const auto columns = [&p](int start) { return p.template middleCols<3>(start); };
  columns(I::position) += (columns(I::orientation) * position_by_turn.transpose() +
                           columns(I::marker_position) * rotation.transpose())
                              .eval();
  columns(I::velocity) += (columns(I::orientation) * velocity_by_turn.transpose() +
                           columns(I::gyro_bias) * velocity_by_bias.transpose() +
                           columns(I::marker_position) * velocity_by_place.transpose())
                              .eval();
}

/// True if the marker frame is within five standard deviations of that of the settings. Poses that
/// were wrong can have taught another one, of which the covariance is sure.
template <typename Scalar>
[[nodiscard]] bool has_plausible_marker_frame(const InertialState<Scalar>& x,
                                              const EkfSettings& settings) noexcept {
  constexpr double most = 5.0;       // standard deviations
  constexpr double rounding = 1e-4;  // of a frame that is not estimated [m], [rad]
  InertialState<Scalar> expected;
  set_marker_frame(expected, settings);
  const auto off = static_cast<double>((x.marker_position - expected.marker_position).norm()),
             turn = static_cast<double>(
                 x.marker_orientation.angularDistance(expected.marker_orientation));
  return off <= most * marker_position_stddev(settings) + rounding &&
         turn <= most * settings.marker_orientation_stddev + rounding;
}

/// What the filter knows before it starts at a pose.
struct KnownAtStart {
  bool marker_frame = false;         ///< learned from poses that were used before
  bool biases_and_velocity = false;  ///< from before a gap
  double gap = 0.0;                  ///< its duration [s]
  bool all_but_place = false;        ///< all except position and heading
};

/// Adds to the variance of the heading, about the vertical [rad^2].
template <typename Scalar, typename Covariance>
void add_heading_variance(Covariance& p, const InertialState<Scalar>& x, double variance) noexcept {
  const Vector3<Scalar> up = x.orientation.conjugate() * Vector3<Scalar>::UnitZ();
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      p(InertialIndex::orientation + i, InertialIndex::orientation + k) +=
          Scalar(variance) * up(i) * up(k);
}

/// Moves the estimate to a pose in another place, and turns it about the vertical.
template <typename Scalar>
void relocate(ErrorStateFilter<Scalar>& filter, const MarkerPose<Scalar>& pose) noexcept {
  using I = InertialIndex;
  InertialState<Scalar> x = filter.state();
  const Eigen::Quaternion<Scalar> turn = quaternion_from_yaw(yaw_of(Eigen::Quaternion<Scalar>(
      pose.orientation * (x.orientation * x.marker_orientation).conjugate())));
  x.orientation = (turn * x.orientation).normalized();
  x.velocity = turn * x.velocity;
  x.position = pose.position - x.orientation * x.marker_position;
  auto p = filter.covariance();
  const Matrix3<Scalar> rotation = turn.toRotationMatrix();
  for (int i = 0; i < I::size; ++i)
    put(square(rotation) * triple(p, I::velocity, i), p, I::velocity, i);
  p.transposeInPlace();
  for (int i = 0; i < I::size; ++i)
    put(square(rotation) * triple(p, I::velocity, i), p, I::velocity, i);
  forget(p, I::position, 1.0);
  // The heading is as good as the pose says; the tilt is kept.
  add_heading_variance(p, x, 0.01);
  filter.reset(x, p);
  filter.update(pose);
}

/// Starts at the pose, with the known marker frame if it is plausible. The update from a much
/// larger covariance sets the correlation between the pose and an uncertain marker frame.
template <typename Scalar>
void start_at_pose(ErrorStateFilter<Scalar>& filter, const MarkerPose<Scalar>& pose,
                   const KnownAtStart& known, const EkfSettings& settings) noexcept {
  if (known.all_but_place) return relocate(filter, pose);
  using I = InertialIndex;
  using Covariance = typename ErrorStateFilter<Scalar>::Covariance;
  InertialState<Scalar> x = filter.state();
  const bool frame_is_known = known.marker_frame && has_plausible_marker_frame(x, settings);
  if (!frame_is_known) set_marker_frame(x, settings);
  x.orientation = (pose.orientation * x.marker_orientation.conjugate()).normalized();
  x.position = pose.position - x.orientation * x.marker_position;
  Covariance p = Covariance::Zero();
  p.template bottomRightCorner<12, 12>() = filter.covariance().template bottomRightCorner<12, 12>();
  if (!frame_is_known) forget_marker_frame(p, settings);
  double velocity_stddev = settings.velocity_stddev;
  if (known.biases_and_velocity) {
    // The velocity has changed by an unknown acceleration during the gap.
    constexpr double acceleration = 10.0;  // [m/s^2]
    velocity_stddev = std::min(velocity_stddev, 0.5 + acceleration * known.gap);
  } else {
    x.velocity.setZero();
    x.gyro_bias = settings.gyro_bias.template cast<Scalar>();
    x.accelerometer_bias = settings.accelerometer_bias.template cast<Scalar>();
    forget(p, I::gyro_bias, settings.gyro_bias_stddev);
    forget(p, I::accelerometer_bias, settings.accelerometer_bias_stddev);
  }
  set_variance(p, I::position, 1.0);
  set_variance(p, I::orientation, 1.0);
  set_variance(p, I::velocity, velocity_stddev);
  filter.reset(x, p);
  filter.update(pose);
}

/// Difference of the first three rows of a measurement from a part of the state, world frame.
template <typename Scalar, typename Measurement>
[[nodiscard]] Vector3<Scalar> displacement(int part, const Measurement& at) noexcept {
  Vector3<Scalar> displacement = Vector3<Scalar>::Zero();
  for (int i = 0; i < 3; ++i)
    for (int row = 0; row < 3; ++row)
      displacement(i) += at.jacobian(row, part + i) * at.residual(row);
  return displacement;
}

/// Makes the heading unknown, and position and velocity as unsure as `off` [m], which a wrong
/// heading has caused within a second or so.
template <typename Scalar>
void forget_heading(ErrorStateFilter<Scalar>& filter, double off) noexcept {
  using I = InertialIndex;
  constexpr double any = 3.0;  // [rad]
  auto p = filter.covariance();
  add_heading_variance(p, filter.state(), any * any);
  add_variance(p, I::position, off);
  add_variance(p, I::velocity, 2.0 * off);
  filter.reset(filter.state(), p);
}

/// Restarts at a position. Velocity, tilt and biases may be wrong.
template <typename Scalar, typename Measurement>
void start_at_position(ErrorStateFilter<Scalar>& filter, Measurement at,
                       const EkfSettings& settings) noexcept {
  using I = InertialIndex;
  constexpr double tilt = 0.3, force = 2.0;  // [rad], [m/s^2]
  InertialState<Scalar> x = filter.state();
  x.position += displacement<Scalar>(I::position, at);
  x.velocity.setZero();
  auto p = filter.covariance();
  forget(p, I::position, 1.0);
  forget(p, I::velocity, settings.velocity_stddev);
  forget(p, I::orientation, tilt);
  forget(p, I::gyro_bias, settings.gyro_bias_stddev);
  forget(p, I::accelerometer_bias, force);
  filter.reset(x, p);
  at.residual.setZero();
  (void)filter.update(filter.innovation_of(at), at);
}

/// Moves one part of the state, position or velocity, to the measurement `at`.
template <typename Scalar, typename Measurement>
void shift(ErrorStateFilter<Scalar>& filter, int part, Measurement at) noexcept {
  InertialState<Scalar> x = filter.state();
  (part == InertialIndex::position ? x.position : x.velocity) += displacement<Scalar>(part, at);
  auto p = filter.covariance();
  forget(p, part, 1.0);
  filter.reset(x, p);
  at.residual.setZero();
  (void)filter.update(filter.innovation_of(at), at);
}

/// Bridges `gap` [s] without IMU samples, during which the vehicle accelerated and turned in an
/// unknown way. `angular_velocity`: after the gap, body frame [rad/s]. Returns false and changes
/// nothing if the gap is so long that the attitude is lost.
template <typename Scalar>
[[nodiscard]] bool resume(ErrorStateFilter<Scalar>& filter, double gap,
                          const Vector3<Scalar>& angular_velocity) noexcept {
  using I = InertialIndex;
  constexpr double longest = 0.4;            // [s]
  constexpr double turn = 1.0, push = 10.0;  // stddev of the unknown [rad/s], [m/s^2]
  if (!(gap <= longest)) return false;
  const Scalar dt = static_cast<Scalar>(gap);
  InertialState<Scalar> x = filter.state();
  x.position += dt * x.velocity;
  x.orientation =
      (x.orientation * quaternion_exp(Vector3<Scalar>(dt * angular_velocity))).normalized();
  auto p = filter.covariance();
  p.template middleRows<3>(I::position) += dt * p.template middleRows<3>(I::velocity);
  p.template middleCols<3>(I::position) += dt * p.template middleCols<3>(I::velocity);
  add_variance(p, I::orientation, turn * gap);
  add_variance(p, I::velocity, push * gap);
  add_variance(p, I::position, push * gap * gap / 2.0);
  filter.reset(x, p);
  return true;
}

/// Starts at a state of the body (of the CoM). `imu_position` is that of the IMU, body frame [m].
template <typename Scalar>
void start_at_state(ErrorStateFilter<Scalar>& filter, const BodyState<Scalar>& body,
                    const StartStddev& stddev, const Vector3<Scalar>& imu_position,
                    bool marker_frame_is_known, const EkfSettings& settings) noexcept {
  using I = InertialIndex;
  using Covariance = typename ErrorStateFilter<Scalar>::Covariance;
  InertialState<Scalar> x = filter.state();
  x.orientation = body.orientation.normalized();
  x.position = body.position + x.orientation * imu_position;
  x.velocity =
      body.velocity + x.orientation * Vector3<Scalar>(body.angular_velocity.cross(imu_position));
  Covariance p = Covariance::Zero();
  p.template bottomRightCorner<6, 6>() = filter.covariance().template bottomRightCorner<6, 6>();
  if (!marker_frame_is_known) forget_marker_frame(p, settings);
  set_variance(p, I::position, stddev.position);
  set_variance(p, I::velocity, stddev.velocity);
  set_variance(p, I::orientation, stddev.orientation);
  set_variance(p, I::gyro_bias, settings.gyro_bias_stddev);
  set_variance(p, I::accelerometer_bias, settings.accelerometer_bias_stddev);
  if (settings.imu_position_stddev > 0.0)
    move_to_body(p, x.orientation, body.angular_velocity, imu_position, Scalar(-1));
  filter.reset(x, p);
}

}  // namespace detail

}  // namespace tilt_ropter
