// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/ekf_settings.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

/// What a filter does with measurements of one kind that its gate refuses one after another, for
/// Ekf. Either the measurements are wrong or the estimate is. Nothing here throws or allocates.
namespace tilt_ropter::detail {

/// Watches the poses that the gate refuses, and says whether they move like the IMU but elsewhere.
/// Elsewhere means a constant displacement and a constant rotation about the vertical.
template <typename Scalar>
class RefusedPoses {
 public:
  void clear() noexcept {
    count_ = smooth_ = 0;
    moved_ = false;
  }

  /// Processes a refused pose at `time` [s]. `predicted` is the pose that the filter expects, of
  /// position error `stddev` [m] and velocity error `velocity_stddev` [m/s].
  void add(double time, const MarkerPose<Scalar>& pose, const MarkerPose<Scalar>& predicted,
           double stddev, double velocity_stddev) noexcept {
    const Eigen::Quaternion<Scalar> turn = pose.orientation * predicted.orientation.conjugate();
    if (count_ == 0 || !moves_like_imu(time, pose, predicted, turn, stddev, velocity_stddev)) {
      count_ = 0;
      moved_ = false;
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
  /// True if these poses moved, by so much that an object at rest cannot be meant.
  [[nodiscard]] bool moved() const noexcept { return moved_; }
  /// Number of poses in a row whose positions lie on a smooth path, and its extent [m].
  [[nodiscard]] int smooth() const noexcept { return smooth_; }
  [[nodiscard]] double extent() const noexcept { return extent_; }
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
                                    double velocity_stddev) noexcept {
    const double dt = time - first_time_;
    if (!(dt > 0.0)) return false;
    const Vector3<Scalar> moved = pose.position - first_.position;
    const Vector3<Scalar> expected =
        quaternion_from_yaw(yaw_) * (predicted.position - first_predicted_.position);
    const double most = 6.0 * stddev + (3.0 * velocity_stddev + 0.02) * dt;
    if (!(static_cast<double>((moved - expected).norm()) <= most) ||
        !(turn.angularDistance(turn_) < Scalar(0.1)))
      return false;
    moved_ = moved_ || static_cast<double>(expected.norm()) > 2.0 * most;
    return true;
  }

  // Positions on a smooth path: the change of velocity between three poses is an acceleration of at
  // most 30 m/s^2, beyond noise.
  void watch_smoothness(double time, const Vector3<Scalar>& position, double stddev) noexcept {
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

  double first_time_ = 0.0, last_time_ = 0.0, last_step_ = 0.0, extent_ = 0.0;
  MarkerPose<Scalar> first_, first_predicted_;
  Eigen::Quaternion<Scalar> turn_ = Eigen::Quaternion<Scalar>::Identity();
  Vector3<Scalar> last_ = Vector3<Scalar>::Zero(), velocity_ = Vector3<Scalar>::Zero(),
                  begin_ = Vector3<Scalar>::Zero();
  Scalar yaw_ = Scalar(0);
  int count_ = 0, smooth_ = 0;
  bool moved_ = false;
};

/// Decides whether measurements that were refused for a while are used again.
///
/// While nothing is used, the covariance grows, until the gate takes even the wrong measurements.
/// So the gate alone does not end a long dispute with measurements on a smooth path. A measurement
/// must also be close, or must come back to the estimate in one step. Otherwise the filter
/// restarts, and only at measurements that move like the IMU. At rest this proves nothing: another
/// object at rest does the same. Such a restart is allowed once, over a small distance, while the
/// velocity is still known and if the refused measurements have never moved unlike the IMU. The
/// next one needs a motion that agrees, unless measurements that were used have followed a motion
/// since.
template <typename Scalar>
class Dispute {
 public:
  void reset() noexcept { *this = Dispute(); }

  /// Forgets the measurements that were refused.
  void clear() noexcept {
    refusals_ = 0;
    contradicted_ = false;
    refused_.clear();
  }

  /// True if a measurement at `distance` from the estimate that passes the gate may be used.
  /// `small`: distance that does no harm. `patience` [s]: duration of a short dispute.
  [[nodiscard]] bool accepts(double time, double distance, double small,
                             double patience) const noexcept {
    return refused_.smooth() < 5 || time - since_ < patience || distance <= small ||
           distance <= 0.5 * last_distance_;
  }

  /// Processes a refused measurement; see RefusedPoses::add().
  void on_refused(double time, double distance, const MarkerPose<Scalar>& pose,
                  const MarkerPose<Scalar>& predicted, double stddev,
                  double velocity_stddev) noexcept {
    if (refusals_++ == 0) since_ = time;
    last_distance_ = distance;
    refused_.add(time, pose, predicted, stddev, velocity_stddev);
    constexpr double known = 0.1;  // error of a velocity with which rest can be told [m/s]
    if ((refusals_ > 1 && refused_.count() == 1) || velocity_stddev > known) contradicted_ = true;
  }
  [[nodiscard]] const RefusedPoses<Scalar>& refused() const noexcept { return refused_; }

  /// True if the refused measurements move like the IMU for restart_time and may be believed.
  [[nodiscard]] bool moves_like_imu(double time, int count,
                                    const EkfSettings& settings) const noexcept {
    return refused_.count() >= count && refused_.duration(time) >= settings.restart_time &&
           (refused_.moved() ||
            (proven_ && !contradicted_ && last_distance_ <= settings.restart_distance));
  }
  /// True unless the filter has restarted at these measurements and no motion has confirmed it.
  [[nodiscard]] bool is_proven() const noexcept { return proven_; }

  /// Processes a restart, or a measurement that was used, with the estimate's `position`.
  void on_restart(const Vector3<Scalar>& position) noexcept {
    proven_ = refused_.moved();
    proof_from_ = position;
    used_ = 0;
    clear();
  }
  void on_used(const Vector3<Scalar>& position) noexcept {
    constexpr int enough = 10;
    constexpr double far = 0.3;  // [m]
    if (++used_ >= enough && (position - proof_from_).norm() > Scalar(far)) proven_ = true;
    used_ = std::min(used_, enough);
    clear();
  }

 private:
  RefusedPoses<Scalar> refused_;
  Vector3<Scalar> proof_from_ = Vector3<Scalar>::Zero();
  double since_ = 0.0, last_distance_ = 0.0;
  int refusals_ = 0, used_ = 0;
  bool proven_ = true, contradicted_ = false;
};

}  // namespace tilt_ropter::detail
