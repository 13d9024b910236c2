// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/ekf_settings.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <type_traits>
#include <utility>

/// Detectors of faulty measurements, for MeasurementGuard: repetitions, wrong stamps, and series of
/// measurements that do not fit the estimate. Nothing here throws or allocates.
namespace tilt_ropter::detail {

/// Finds measurements that repeat an earlier one bit for bit. A sensor with noise never does this.
/// A simulation without noise does it at rest, but then the IMU's samples repeat as well.
template <typename Scalar>
class RepetitionDetector {
 public:
  void on_imu(const InertialSample<Scalar>& sample) noexcept {
    if (!(sample.angular_velocity == imu_.angular_velocity &&
          sample.specific_force == imu_.specific_force))
      ++imu_changes_;
    imu_ = sample;
  }

  /// Returns true if `pose` repeats the last one while the samples of the IMU changed.
  [[nodiscard]] bool repeats(const MarkerPose<Scalar>& pose) noexcept {
    const bool same = pose_changes_ >= 0 && pose.position == pose_.position &&
                      (pose.orientation.coeffs() == pose_.orientation.coeffs() ||
                       pose.orientation.coeffs() == -pose_.orientation.coeffs());
    if (same && pose_changes_ != imu_changes_) return true;
    pose_changes_ = imu_changes_;
    pose_ = pose;
    return false;
  }

  /// Returns true if the position or velocity `value` is one of the last eight, of all sensors, and
  /// the samples of the IMU changed since. A velocity of zero may repeat: the vehicle stands.
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

 private:
  struct Vector {
    Vector3<Scalar> value = Vector3<Scalar>::Zero();
    long received = 0;  ///< when, in counts of received vectors; 0: empty
    long imu_changes = 0;
  };
  InertialSample<Scalar> imu_;
  MarkerPose<Scalar> pose_;
  std::array<Vector, 8> vectors_;
  long imu_changes_ = 0, received_ = 0;
  long pose_changes_ = -1;  ///< of the IMU before the last pose; -1: no pose yet
};

/// The value by which repetitions of a measurement are found; null if they are not looked for.
template <typename Scalar, typename M>
const Vector3<Scalar>* vector_of(const M& m) noexcept {
  if constexpr (std::is_same_v<M, PositionMeasurement<Scalar>> ||
                std::is_same_v<M, PoseMeasurement<Scalar>>)
    return &m.position;
  else if constexpr (std::is_same_v<M, WorldVelocityMeasurement<Scalar>> ||
                     std::is_same_v<M, BodyVelocityMeasurement<Scalar>>)
    return &m.velocity;
  else
    return nullptr;
}

/// The kind that a measurement declares.
template <typename M, typename = void>
inline constexpr MeasurementKind kind_of = MeasurementKind::other;
template <typename M>
inline constexpr MeasurementKind kind_of<M, std::void_t<decltype(M::kind)>> = M::kind;

/// Consecutive numbers that are alike, and their mean.
struct AlikeNumbers {
  void add(double number, double tolerance) noexcept {
    if (count == 0 || std::abs(number - mean) > tolerance) *this = {number, 0};
    mean += (number - mean) / static_cast<double>(++count);
  }
  double mean = 0.0;
  int count = 0;
};

/// Measures the jitter of stamps of a periodic sensor, and corrects steps of its clock.
class StampMonitor {
 public:
  /// Sum of the steps of the sensor's clock [s], to be added to its stamps.
  [[nodiscard]] double clock_step() const noexcept { return clock_step_; }

  /// Processes a corrected stamp [s].
  void on_stamp(double stamp) noexcept {
    const double step = stamp - last_;
    const bool known = has_last_;
    gated_variance_ *= 0.9998;                                  // some 50 s at 100 Hz
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

  /// Standard deviation of a stamp [s]; zero for regular stamps.
  [[nodiscard]] double stddev() const noexcept {
    const double jitter = std::sqrt(std::max(variance_, gated_variance_));
    return jitter > negligible ? jitter : 0.0;
  }

  /// Error of the stamps of an agreeing clock that is subtracted from them [s].
  [[nodiscard]] double latency() const noexcept { return latency_; }

  /// Processes a gated pose whose stamp is late by `latency` [s], or that errs in another way (not
  /// finite). Returns the mean of enough of them that are alike, otherwise zero.
  [[nodiscard]] double on_displaced(double latency) noexcept {
    constexpr int enough = 8;
    constexpr double same = 0.003;  // [s]
    if (!std::isfinite(latency)) return displaced_ = {}, 0.0;
    // Stamps alone do not show all of a jitter beyond their period.
    if (variance_ > negligible * negligible && displaced_.count > 0 &&
        std::abs(latency - displaced_.mean) > same) {
      const double jitter = std::clamp(latency, -max_stddev, max_stddev);
      gated_variance_ += 0.3 * (jitter * jitter - gated_variance_);
    }
    displaced_.add(latency, same);
    return displaced_.count >= enough && std::abs(displaced_.mean) > same ? displaced_.mean : 0.0;
  }
  /// Changes latency() by `change`, within `most` [s]. Returns the change.
  double on_latency(double change, double most) noexcept {
    change = std::clamp(latency_ + change, -most, most) - latency_;
    latency_ += change;
    lag_ += change;
    displaced_ = {};
    has_last_ = false;
    return change;
  }

  /// Processes the time between stamp and arrival of a measurement that was used [s].
  void on_used(double lag) noexcept {
    lag_ = used_++ == 0 ? lag : lag_ + 0.05 * (lag - lag_);
    strange_ = {};
  }

  /// Processes the time between stamp and arrival of a measurement that could not be used [s]. If
  /// `needed` measurements in a row arrived with the same strange lag, the sensor's clock has
  /// stepped. Then corrects clock_step() and returns true.
  bool on_unused(double lag, int needed) noexcept {
    // Clocks differ by less than 300 years. Larger numbers would leave no digits for the stamps.
    if (!(std::abs(lag) < 1e10)) return false;
    constexpr double same = 0.02, strange = 0.03;  // [s]
    if (used_ == 0 || std::abs(lag - lag_) < strange)
      strange_ = {};
    else
      strange_.add(lag, same);
    if (strange_.count < needed) return false;
    other_clock_step_ = clock_step_;
    clock_step_ += strange_.mean - lag_;
    strange_ = {};
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
    strange_ = {};
    has_last_ = false;
    return true;
  }

 private:
  static constexpr double max_stddev = 0.02, negligible = 3e-4;  // [s]

  double last_ = 0.0, period_ = 0.0, variance_ = 0.0, gated_variance_ = 0.0, lag_ = 0.0,
         latency_ = 0.0;
  AlikeNumbers strange_, displaced_;                  ///< lags, latencies
  double clock_step_ = 0.0, other_clock_step_ = 0.0;  ///< in force, and before the last step
  long steps_ = 0, used_ = 0;
  bool has_last_ = false;
};

/// A measured pose beside the estimate. For a velocity, all positions are velocities [m/s].
template <typename Scalar>
struct PoseComparison {
  MarkerPose<Scalar> measured, predicted;
  double distance;         ///< between them: position [m] plus angle [rad]
  double noise;            ///< standard deviation of the measured position [m]
  double velocity_stddev;  ///< of the estimate [m/s]
};

/// Variance of the noise of a sensor, by squares of its samples in its unit.
struct PoseNoise {
  /// Adds a square. `believed`: the standard deviation of the settings.
  void add(double square, double believed) noexcept {
    // Parts of a sample that count for a mean of some 20 and of some 100 samples; the largest
    // sample, so that wild ones are soon forgotten; and that beside which one is an outlier.
    constexpr double part = 0.05, slow_part = 0.01, most = 100.0, outlier = 4.0;
    const double variance = believed * believed, bounded = std::min(square, most * variance);
    recent += part * (bounded - recent);
    excess += slow_part * (std::min(bounded / variance, outlier * excess) - excess);
    excess = std::max(1.0, excess);
  }
  /// The variance of a longer time, without outliers, by the believed one. 1 if it may be chance.
  [[nodiscard]] double factor() const noexcept {
    constexpr double chance = 1.3;  // some four standard deviations of the mean
    return excess > chance ? excess : 1.0;
  }
  double recent = 0.0;  ///< variance of the last samples
  double excess = 1.0;  ///< as factor(), with chance
};

/// Tests whether poses continue each other without a jump, used or not: positions with a plausible
/// acceleration, orientations as the gyroscope measures. Poses that are above the gate but continue
/// those that were used show that the IMU is wrong.
template <typename Scalar>
class PoseContinuity {
 public:
  void on_pose(double time, const PoseComparison<Scalar>& c, double orientation_noise) noexcept {
    const double dt = time - last_time_;
    const Vector3<Scalar>& position = c.measured.position;
    const Vector3<Scalar> velocity = (position - last_) / Scalar(dt);
    const Eigen::Quaternion<Scalar> turn =
        c.predicted.orientation.conjugate() * c.measured.orientation;
    if (!(dt > 1e-4 && dt < longest)) {
      steps_ = 0;
      jumped_ = true;
    } else {
      constexpr double acceleration = 30.0;  // [m/s^2]
      const double step = std::min(dt, last_step_),
                   most = acceleration * (dt + last_step_) + 12.0 * c.noise / step;
      if (steps_++ > 0 && !(static_cast<double>((velocity - velocity_).norm()) <= most))
        jumped_ = true;
      constexpr double rate = 1.0;  // of a wrong gyroscope [rad/s]
      const auto turned = static_cast<double>(turn.angularDistance(turn_));
      if (!(turned <= 8.0 * orientation_noise + rate * dt)) turned_ = true;
      // Second differences in three axes, which the IMU has no part in.
      const Vector3<Scalar> rotation =
          quaternion_log(last_orientation_.conjugate() * c.measured.orientation);
      const auto change = static_cast<double>((velocity - velocity_).norm()) * dt,
                 turn_change = static_cast<double>((rotation - rotation_).norm());
      if (steps_ > 1 && std::abs(dt - last_step_) < 0.2 * dt) {
        position_noise_.add(change * change / 18.0, c.noise);
        orientation_noise_.add(turn_change * turn_change / 18.0, orientation_noise);
      }
      rotation_ = rotation;
    }
    last_time_ = time;
    last_step_ = dt;
    last_ = position;
    last_orientation_ = c.measured.orientation;
    velocity_ = velocity;
    turn_ = turn;
  }
  /// The last pose was used, and the next ones are compared with an estimate that follows it.
  void on_used() noexcept {
    jumped_ = turned_ = false;
    turn_.setIdentity();
  }

  /// True if all positions since the last pose that was used continue each other.
  [[nodiscard]] bool positions_continue() const noexcept { return !jumped_ && steps_ > 1; }
  /// True if `most` standard deviations of the poses' noise explain `distance` [m], `turn` [rad].
  [[nodiscard]] bool is_noise(double distance, double turn, double most) const noexcept {
    return distance <= most * std::sqrt(position_noise_.recent) &&
           turn <= most * std::sqrt(orientation_noise_.recent);
  }
  /// Variances that positions and orientations show among each other by the believed ones, >= 1.
  [[nodiscard]] double position_factor() const noexcept { return position_noise_.factor(); }
  [[nodiscard]] double orientation_factor() const noexcept { return orientation_noise_.factor(); }
  /// True if the orientation has stepped since then.
  [[nodiscard]] bool turned() const noexcept { return turned_; }

 private:
  static constexpr double longest = 0.15;  // of a gap in which nothing jumps unseen [s]

  Vector3<Scalar> last_ = Vector3<Scalar>::Zero(), velocity_ = Vector3<Scalar>::Zero();
  Vector3<Scalar> rotation_ = Vector3<Scalar>::Zero();  ///< between the last two poses [rad]
  Eigen::Quaternion<Scalar> turn_ = Eigen::Quaternion<Scalar>::Identity(),
                            last_orientation_ = turn_;
  double last_time_ = -std::numeric_limits<double>::infinity(), last_step_ = 1.0;
  PoseNoise position_noise_, orientation_noise_;  ///< per axis; [m], [rad]
  int steps_ = 0;
  bool jumped_ = false, turned_ = false;
};

/// Finds by how much the orientation of the poses has stepped while their positions go on: motion
/// capture has defined the rigid body again. Later orientations are turned back.
template <typename Scalar>
class OrientationStep {
 public:
  /// The pose with the orientation that it had before the steps.
  [[nodiscard]] MarkerPose<Scalar> undone(const MarkerPose<Scalar>& pose) const noexcept {
    return {pose.position, (pose.orientation * back_).normalized()};
  }

  /// Processes a pose whose orientation does not fit. `noise`: of the orientation [rad].
  void on_pose(double time, const PoseComparison<Scalar>& c, double noise) noexcept {
    constexpr double long_enough = 0.25;  // to tell a step from outliers and from a drift [s]
    const Eigen::Quaternion<Scalar> turn =
        c.predicted.orientation.conjugate() * c.measured.orientation;
    if (count_ == 0 || !(static_cast<double>(turn.angularDistance(turn_)) <= 8.0 * noise)) {
      since_ = time;
      turn_ = turn;
      count_ = 0;
    }
    turn_ = turn_.slerp(Scalar(1) / Scalar(++count_), turn);
    if (!is_steady() || !(time - since_ >= long_enough)) return;
    back_ = (back_ * turn_.conjugate()).normalized();
    count_ = 0;
  }
  /// The orientation fits again.
  void end() noexcept { count_ = 0; }

  /// True if the orientation has stepped and the step is not known yet.
  [[nodiscard]] bool is_open() const noexcept { return count_ > 0; }
  /// True if some consecutive poses show the same step.
  [[nodiscard]] bool is_steady() const noexcept { return count_ >= 5; }
  /// True if orientations are turned back.
  [[nodiscard]] bool is_known() const noexcept { return back_.w() != Scalar(1); }

 private:
  Eigen::Quaternion<Scalar> back_ = Eigen::Quaternion<Scalar>::Identity(), turn_ = back_;
  double since_ = 0.0;
  int count_ = 0;
};

/// Tests whether measurements that the gate rejects move like the IMU but elsewhere: with a
/// constant displacement and a constant rotation about the vertical.
///
/// While nothing is used, the covariance grows, until the gate passes even faulty measurements. So
/// after a long series on a smooth path, a measurement must also be close, or must come back to the
/// estimate in one step. Otherwise the filter restarts, and only at measurements that move like the
/// IMU. At rest this is no evidence: another object at rest does the same. Such a restart is
/// allowed once, over a small distance, while the velocity is still known and if the rejected
/// measurements have never moved unlike the IMU. The next one needs a motion that agrees, unless
/// measurements that were used have followed a motion since.
template <typename Scalar>
class GateMonitor {
 public:
  /// Forgets the measurements that were rejected.
  void clear() noexcept {
    gated_ = count_ = smooth_ = 0;
    inconsistent_ = moved_ = false;
  }

  /// True if a measurement at `distance` from the estimate that passes the gate may be used.
  /// `small`: distance that does no harm. `short_time` [s]: duration of a short series.
  [[nodiscard]] bool accepts(double time, double distance, double small,
                             double short_time) const noexcept {
    return smooth_ < 5 || time - since_ < short_time || distance <= small ||
           distance <= 0.5 * last_distance_;
  }

  /// Processes a measurement that is rejected at `time` [s].
  void on_gated(double time, const PoseComparison<Scalar>& c) noexcept {
    if (gated_++ == 0) since_ = time;
    last_distance_ = c.distance;
    const Eigen::Quaternion<Scalar> turn =
        c.measured.orientation * c.predicted.orientation.conjugate();
    if (count_ == 0 || !continues(time, c, turn)) {
      count_ = 0;
      moved_ = false;
      first_time_ = time;
      first_ = c;
      turn_ = turn;
    }
    ++count_;
    check_smoothness(time, c.measured.position, c.noise);
    constexpr double known = 0.1;  // error of a velocity with which rest can be detected [m/s]
    if ((gated_ > 1 && count_ == 1) || c.velocity_stddev > known) inconsistent_ = true;
  }

  /// True if `count` or more have moved like the IMU for restart_time, and the filter may restart.
  [[nodiscard]] bool moves_like_imu(double time, int count,
                                    const EkfSettings& settings) const noexcept {
    return count_ >= count && time - first_time_ >= settings.restart_time &&
           (moved_ ||
            (confirmed_ && !inconsistent_ && last_distance_ <= settings.restart_distance));
  }
  /// Angle between the verticals of these measurements and of the estimate [rad].
  [[nodiscard]] Scalar tilt() const noexcept {
    using std::acos;
    return acos(std::clamp((turn_ * Vector3<Scalar>::UnitZ()).z(), Scalar(-1), Scalar(1)));
  }
  /// Number of consecutive measurements that were rejected.
  [[nodiscard]] int gated() const noexcept { return gated_; }
  /// Number of consecutive measurements on a smooth path, and its extent [m].
  [[nodiscard]] int smooth() const noexcept { return smooth_; }
  [[nodiscard]] double extent() const noexcept { return extent_; }
  /// False if the filter has restarted at these measurements and no motion has confirmed it.
  [[nodiscard]] bool is_confirmed() const noexcept { return confirmed_; }

  /// Processes a restart, or a measurement that was used, with the estimate's `position`.
  void on_restart(const Vector3<Scalar>& position) noexcept {
    confirmed_ = moved_;
    restarted_at_ = position;
    used_ = 0;
    clear();
  }
  void on_used(const Vector3<Scalar>& position) noexcept {
    constexpr int enough = 10;
    constexpr double far = 0.3;  // [m]
    if (++used_ >= enough && (position - restarted_at_).norm() > Scalar(far)) confirmed_ = true;
    used_ = std::min(used_, enough);
    clear();
  }

 private:
  /// True if a measurement moves like the IMU since the first one of the series.
  [[nodiscard]] bool continues(double time, const PoseComparison<Scalar>& c,
                               const Eigen::Quaternion<Scalar>& turn) noexcept {
    const double dt = time - first_time_;
    if (!(dt > 0.0)) return false;
    const Vector3<Scalar> moved = c.measured.position - first_.measured.position;
    const Vector3<Scalar> expected =
        quaternion_from_yaw(yaw_of(turn_)) * (c.predicted.position - first_.predicted.position);
    const double most = 6.0 * c.noise + (3.0 * c.velocity_stddev + 0.02) * dt;
    if (!(static_cast<double>((moved - expected).norm()) <= most) ||
        !(turn.angularDistance(turn_) < Scalar(0.1)))
      return false;
    // So far that it is not an object at rest.
    moved_ = moved_ || static_cast<double>(expected.norm()) > 2.0 * most;
    return true;
  }

  /// Positions on a smooth path: the change of velocity between three measurements is an
  /// acceleration of at most 30 m/s^2, beyond noise.
  void check_smoothness(double time, const Vector3<Scalar>& position, double stddev) noexcept {
    const double dt = time - last_time_;
    if (smooth_ > 0 && !(dt > 1e-4 && dt < 2.5)) smooth_ = 0;
    if (smooth_ > 0) {
      const Vector3<Scalar> velocity = (position - last_) / Scalar(dt);
      const double change = static_cast<double>((velocity - velocity_).norm());
      const double most = 30.0 * (dt + last_step_) + 12.0 * stddev / std::min(dt, last_step_);
      if (smooth_ > 1 && change > most) smooth_ = 0;
      velocity_ = velocity;
      last_step_ = dt;
    }
    if (smooth_ == 0) {
      begin_ = position;
      extent_ = 0.0;
    }
    extent_ = std::max(extent_, static_cast<double>((position - begin_).norm()));
    ++smooth_;
    last_ = position;
    last_time_ = time;
  }

  PoseComparison<Scalar> first_ = {};  ///< of those that move like the IMU
  Eigen::Quaternion<Scalar> turn_ = Eigen::Quaternion<Scalar>::Identity();  ///< estimate -> first_
  Vector3<Scalar> last_ = Vector3<Scalar>::Zero(), velocity_ = Vector3<Scalar>::Zero(),
                  begin_ = Vector3<Scalar>::Zero(), restarted_at_ = Vector3<Scalar>::Zero();
  double first_time_ = 0.0, last_time_ = 0.0, last_step_ = 0.0, extent_ = 0.0;
  double since_ = 0.0, last_distance_ = 0.0;
  int gated_ = 0, count_ = 0, smooth_ = 0, used_ = 0;
  bool moved_ = false, confirmed_ = true, inconsistent_ = false;
};

}  // namespace tilt_ropter::detail
