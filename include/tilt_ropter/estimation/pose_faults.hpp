// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/inertial_state.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

/// Detectors of faulty poses, for Ekf: repetitions, wrong stamps, and poses that are elsewhere.
/// Nothing here throws or allocates.
namespace tilt_ropter::detail {

/// Finds poses that repeat the last pose bit for bit. A tracker with noise never does this. A
/// simulation without noise does it at rest, but then the IMU's samples repeat as well.
template <typename Scalar>
class RepetitionDetector {
 public:
  void on_imu(const InertialSample<Scalar>& sample) noexcept {
    if (sample.angular_velocity != imu_.angular_velocity ||
        sample.specific_force != imu_.specific_force)
      imu_changed_ = true;
    imu_ = sample;
  }

  /// Returns true if `pose` repeats the last one while the samples of the IMU changed.
  [[nodiscard]] bool repeats(const MarkerPose<Scalar>& pose) noexcept {
    const bool same = has_pose_ && pose.position == pose_.position &&
                      (pose.orientation.coeffs() == pose_.orientation.coeffs() ||
                       pose.orientation.coeffs() == -pose_.orientation.coeffs());
    if (same && imu_changed_) return true;
    has_pose_ = true;
    imu_changed_ = false;
    pose_ = pose;
    return false;
  }

  void reset() noexcept { *this = RepetitionDetector(); }

 private:
  InertialSample<Scalar> imu_;
  MarkerPose<Scalar> pose_;
  bool has_pose_ = false, imu_changed_ = false;
};

/// Measures the jitter of stamps of a periodic sensor, and finds steps of its clock.
class StampMonitor {
 public:
  /// Processes a stamp in the sensor's clock [s].
  void on_stamp(double stamp) noexcept {
    const double step = stamp - last_;
    const bool known = has_last_;
    if (known && step < -0.5 * period_ && step > -1.0) return;  // sent again, or out of order
    has_last_ = true;
    last_ = stamp;
    if (!known || !(std::abs(step) < 1.0)) return;
    if (steps_ == 0) period_ = step;
    if (++steps_ < 5) {  // the median of the first steps is not needed: outliers fade
      period_ = std::max(1e-4, period_ + (step - period_) / static_cast<double>(steps_));
      return;
    }
    // A step over missing measurements is a multiple of the period.
    const double multiple = std::max(1.0, std::floor(step / period_ + 0.25));
    const double error = step - multiple * period_;
    if (multiple < 1.5) period_ = std::max(1e-4, period_ + 0.02 * error);
    const double bounded = std::clamp(error, -max_stddev, max_stddev);
    variance_ += 0.02 * (0.5 * bounded * bounded - variance_);
  }

  /// Standard deviation of a stamp [s]; zero for regular stamps whose clock agrees with the IMU's.
  [[nodiscard]] double stddev() const noexcept {
    const double jitter = std::sqrt(variance_);
    return std::max(jitter > negligible ? jitter : 0.0, offset_);
  }

  /// Processes a refused position that lies `offset` [s] along the path of the estimate, or beside
  /// it (not finite). If enough of them lie at the same place, the clock has an offset that the
  /// settings do not know. It then counts as an error of the stamps.
  void on_displaced(double offset) noexcept {
    constexpr int enough = 8;
    constexpr double alike = 0.005;  // [s]
    if (!(std::abs(offset) <= 1.5 * max_stddev)) {
      displaced_ = 0;
      return;
    }
    if (displaced_ == 0 || std::abs(offset - displaced_by_) > alike) {
      displaced_ = 0;
      displaced_by_ = offset;
    }
    displaced_by_ += (offset - displaced_by_) / static_cast<double>(++displaced_);
    if (displaced_ >= enough) offset_ = std::max(offset_, std::abs(displaced_by_));
  }

  /// Processes the time between stamp and arrival of a measurement that was used [s].
  void on_used(double lag) noexcept {
    lag_ = used_++ == 0 ? lag : lag_ + 0.05 * (lag - lag_);
    strange_ = 0;
  }

  /// Processes the time between stamp and arrival of a measurement that could not be used [s].
  /// Returns the step of the sensor's clock if `needed` measurements in a row arrived with the same
  /// strange lag, or zero.
  [[nodiscard]] double on_unused(double lag, int needed) noexcept {
    constexpr double same = 0.02, strange = 0.03;  // [s]
    if (used_ == 0 || std::abs(lag - lag_) < strange) {
      strange_ = 0;
      return 0.0;
    }
    if (strange_ == 0 || std::abs(lag - strange_lag_) > same) {
      strange_ = 0;
      strange_lag_ = lag;
    }
    ++strange_;
    strange_lag_ += (lag - strange_lag_) / static_cast<double>(strange_);
    if (strange_ < needed) return 0.0;
    strange_ = 0;
    has_last_ = false;
    return strange_lag_ - lag_;
  }

  void reset() noexcept { *this = StampMonitor(); }

 private:
  static constexpr double max_stddev = 0.02, negligible = 3e-4;  // [s]

  double last_ = 0.0, period_ = 0.0, variance_ = 0.0;
  double lag_ = 0.0, strange_lag_ = 0.0, offset_ = 0.0, displaced_by_ = 0.0;
  int displaced_ = 0;
  long steps_ = 0, used_ = 0;
  int strange_ = 0;
  bool has_last_ = false;
};

/// Watches the poses that the gate refuses, and says whether they move like the IMU but elsewhere.
/// Elsewhere means a constant displacement and a constant rotation about the vertical.
template <typename Scalar>
class RefusedPoses {
 public:
  void clear() noexcept { count_ = smooth_ = 0; }

  /// Processes a refused pose at `time` [s]. `predicted` is the pose that the filter expects, of
  /// position error `stddev` [m] and velocity error `velocity_stddev` [m/s].
  void add(double time, const MarkerPose<Scalar>& pose, const MarkerPose<Scalar>& predicted,
           double stddev, double velocity_stddev) noexcept {
    const Eigen::Quaternion<Scalar> turn = pose.orientation * predicted.orientation.conjugate();
    if (count_ == 0 || !moves_like_imu(time, pose, predicted, turn, stddev, velocity_stddev)) {
      count_ = 0;
      first_time_ = time;
      first_ = pose;
      first_predicted_ = predicted;
      turn_ = turn;
      yaw_ = yaw_of(turn);
    }
    ++count_;
    watch_smoothness(time, pose.position, stddev);
  }

  /// Number of poses in a row that move like the IMU, and their duration [s].
  [[nodiscard]] int count() const noexcept { return count_; }
  [[nodiscard]] double duration(double now) const noexcept { return now - first_time_; }
  /// Number of poses in a row whose positions lie on a smooth path.
  [[nodiscard]] int smooth() const noexcept { return smooth_; }
  /// Rotation about the vertical from the estimate to the poses [rad].
  [[nodiscard]] Scalar yaw() const noexcept { return yaw_; }
  /// Lean of that rotation [rad]: the poses and the estimate disagree about the vertical.
  [[nodiscard]] Scalar lean() const noexcept {
    using std::abs;
    using std::acos;
    const Vector3<Scalar> up = turn_ * Vector3<Scalar>::UnitZ();
    return acos(std::clamp(up.z(), Scalar(-1), Scalar(1)));
  }

 private:
  [[nodiscard]] bool moves_like_imu(double time, const MarkerPose<Scalar>& pose,
                                    const MarkerPose<Scalar>& predicted,
                                    const Eigen::Quaternion<Scalar>& turn, double stddev,
                                    double velocity_stddev) const noexcept {
    const double dt = time - first_time_;
    if (!(dt > 0.0)) return false;
    const Vector3<Scalar> moved = pose.position - first_.position;
    const Vector3<Scalar> expected =
        quaternion_from_yaw(yaw_) * (predicted.position - first_predicted_.position);
    const double most = 6.0 * stddev + (3.0 * velocity_stddev + 0.02) * dt;
    return static_cast<double>((moved - expected).norm()) <= most &&
           turn.angularDistance(turn_) < Scalar(0.1);
  }

  // Positions on a smooth path: the change of velocity between three poses is an acceleration of at
  // most 30 m/s^2, beyond noise.
  void watch_smoothness(double time, const Vector3<Scalar>& position, double stddev) noexcept {
    const double dt = time - last_time_;
    if (smooth_ > 0 && !(dt > 1e-4 && dt < 0.5)) smooth_ = 0;
    if (smooth_ > 0) {
      const Vector3<Scalar> velocity = (position - last_) / Scalar(dt);
      const double change = static_cast<double>((velocity - velocity_).norm());
      const double most = 30.0 * (dt + last_step_) + 12.0 * stddev / std::min(dt, last_step_);
      if (smooth_ > 1 && change > most) smooth_ = 0;
      velocity_ = velocity;
      last_step_ = dt;
    }
    ++smooth_;
    last_ = position;
    last_time_ = time;
  }

  double first_time_ = 0.0, last_time_ = 0.0, last_step_ = 0.0;
  MarkerPose<Scalar> first_, first_predicted_;
  Eigen::Quaternion<Scalar> turn_ = Eigen::Quaternion<Scalar>::Identity();
  Vector3<Scalar> last_ = Vector3<Scalar>::Zero(), velocity_ = Vector3<Scalar>::Zero();
  Scalar yaw_ = Scalar(0);
  int count_ = 0, smooth_ = 0;
};

}  // namespace tilt_ropter::detail
