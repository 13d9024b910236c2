// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

/// Detectors of faulty measurements, for Ekf: repetitions and wrong stamps. Nothing here throws or
/// allocates.
namespace tilt_ropter::detail {

/// Finds measurements that repeat an earlier one bit for bit. A sensor with noise never does this.
/// A simulation without noise does it at rest, but then the IMU's samples repeat as well.
template <typename Scalar>
class RepetitionDetector {
 public:
  void on_imu(const InertialSample<Scalar>& sample) noexcept {
    if (sample.angular_velocity != imu_.angular_velocity ||
        sample.specific_force != imu_.specific_force)
      ++imu_changes_;
    imu_ = sample;
  }

  /// Returns true if `pose` repeats the last one while the samples of the IMU changed.
  [[nodiscard]] bool repeats(const MarkerPose<Scalar>& pose) noexcept {
    const bool same = has_pose_ && pose.position == pose_.position &&
                      (pose.orientation.coeffs() == pose_.orientation.coeffs() ||
                       pose.orientation.coeffs() == -pose_.orientation.coeffs());
    if (same && pose_changes_ != imu_changes_) return true;
    has_pose_ = true;
    pose_changes_ = imu_changes_;
    pose_ = pose;
    return false;
  }

  /// Returns true if the position or velocity `value` is one of the last eight, of all sensors,
  /// and the samples of the IMU changed since. A velocity of zero may repeat: the user knows that
  /// the vehicle stands.
  [[nodiscard]] bool repeats(const Vector3<Scalar>& value) noexcept {
    if (value == Vector3<Scalar>::Zero()) return false;
    ++received_;
    Vector* oldest = &vectors_[0];
    for (Vector& v : vectors_) {
      if (v.received > 0 && v.value == value) {
        v.received = received_;
        return v.imu_changes != imu_changes_;
      }
      if (v.received < oldest->received) oldest = &v;
    }
    *oldest = {value, received_, imu_changes_};
    return false;
  }

  void reset() noexcept { *this = RepetitionDetector(); }

 private:
  struct Vector {
    Vector3<Scalar> value = Vector3<Scalar>::Zero();
    long received = 0;  ///< when, in counts of received vectors; 0: empty
    long imu_changes = 0;
  };
  InertialSample<Scalar> imu_;
  MarkerPose<Scalar> pose_;
  std::array<Vector, 8> vectors_;
  long imu_changes_ = 0, pose_changes_ = 0, received_ = 0;
  bool has_pose_ = false;
};

/// The value by which repetitions of a measurement are found; null if they are not looked for.
template <typename Scalar>
const Vector3<Scalar>* vector_of(const PositionMeasurement<Scalar>& m) noexcept {
  return &m.position;
}
template <typename Scalar>
const Vector3<Scalar>* vector_of(const PoseMeasurement<Scalar>& m) noexcept {
  return &m.position;
}
template <typename Scalar>
const Vector3<Scalar>* vector_of(const WorldVelocityMeasurement<Scalar>& m) noexcept {
  return &m.velocity;
}
template <typename Scalar>
const Vector3<Scalar>* vector_of(const BodyVelocityMeasurement<Scalar>& m) noexcept {
  return &m.velocity;
}
template <typename Scalar, typename Measurement>
const Vector3<Scalar>* vector_of(const Measurement&) noexcept {
  return nullptr;
}

/// Measures the jitter of stamps of a periodic sensor, and corrects steps of its clock.
class StampMonitor {
 public:
  /// Sum of the steps of the sensor's clock [s], to be added to its stamps.
  [[nodiscard]] double clock_step() const noexcept { return clock_step_; }

  /// Processes a corrected stamp [s].
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

  /// Processes the time between stamp and arrival of a measurement that could not be used [s]. If
  /// `needed` measurements in a row arrived with the same strange lag, the sensor's clock has
  /// stepped. Then corrects clock_step() and returns true.
  bool on_unused(double lag, int needed) noexcept {
    // Clocks differ by less than 300 years. Larger numbers would leave no digits for the stamps.
    if (!(std::abs(lag) < 1e10)) return false;
    constexpr double same = 0.02, strange = 0.03;  // [s]
    if (used_ == 0 || std::abs(lag - lag_) < strange) {
      strange_ = 0;
      return false;
    }
    if (strange_ == 0 || std::abs(lag - strange_lag_) > same) {
      strange_ = 0;
      strange_lag_ = lag;
    }
    ++strange_;
    strange_lag_ += (lag - strange_lag_) / static_cast<double>(strange_);
    if (strange_ < needed) return false;
    other_clock_step_ = clock_step_;
    clock_step_ += strange_lag_ - lag_;
    strange_ = 0;
    has_last_ = false;
    return true;
  }

  /// Takes the last step of the clock back, or makes it again, if a measurement with this `lag` [s]
  /// would then be in time. Returns true if clock_step() changed.
  bool swap_clocks(double lag, double max_delay) noexcept {
    const double change = other_clock_step_ - clock_step_;
    if (change == 0.0 || !(std::abs(lag - change) < max_delay)) return false;
    std::swap(clock_step_, other_clock_step_);
    lag_ -= change;
    strange_ = 0;
    has_last_ = false;
    return true;
  }

  void reset() noexcept { *this = StampMonitor(); }

 private:
  static constexpr double max_stddev = 0.02, negligible = 3e-4;  // [s]

  double last_ = 0.0, period_ = 0.0, variance_ = 0.0;
  double lag_ = 0.0, strange_lag_ = 0.0, offset_ = 0.0, displaced_by_ = 0.0;
  double clock_step_ = 0.0, other_clock_step_ = 0.0;  ///< in force, and before the last step
  int displaced_ = 0;
  long steps_ = 0, used_ = 0;
  int strange_ = 0;
  bool has_last_ = false;
};

}  // namespace tilt_ropter::detail
