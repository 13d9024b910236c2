// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/error_state_filter.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

/// State of the vehicle from IMU and motion capture (paper, Sec. Control): an error-state Kalman
/// filter that processes measurements at their time stamps. This header is long because Ekf is a
/// class template, so its function definitions must be in the header.
namespace tilt_ropter {

/// All times are in seconds. All stddev fields are standard deviations per axis.
struct EkfSettings {
  InertialNoise imu_noise;     ///< noise of the IMU
  MarkerPoseNoise pose_noise;  ///< noise of the poses

  /// Pose of the marker frame M in the body frame: origin of M [m], and rotation M -> body.
  Eigen::Vector3d marker_position = Eigen::Vector3d::Zero();
  Eigen::Quaterniond marker_orientation = Eigen::Quaterniond::Identity();
  /// Standard deviations of this pose. Zero switches its estimation off. If the estimation is on,
  /// it takes about ten seconds of motion about all axes. A vehicle at rest gives no information
  /// about this pose.
  double marker_position_stddev = 0.0;     ///< of marker_position [m]
  double marker_orientation_stddev = 0.0;  ///< of marker_orientation [rad]

  /// Time to add to the stamp of a pose to get the IMU's clock (see calibrate_clock).
  double clock_offset = 0.0;

  /// Initial standard deviations of the states that the first pose does not measure.
  double velocity_stddev = 1.0;            ///< of the velocity, about zero [m/s]
  double gyro_bias_stddev = 0.1;           ///< of the gyro bias, about zero [rad/s]
  double accelerometer_bias_stddev = 0.5;  ///< of the accelerometer bias, about zero [m/s^2]

  /// Largest NIS of a pose that is used. One in 10^4 valid poses exceeds 27.9.
  double gate = 27.9;
  /// Number of consecutive poses refused by the gate after which the filter restarts at the last of
  /// these poses. Also the number of consecutive IMU samples behind the newest sample after which
  /// the newest sample, or the clock, counts as wrong. The filter then treats this as a gap.
  int max_rejections = 25;
  /// Largest time by which a pose may arrive after, or before, the IMU sample of the same time.
  double max_delay = 0.2;
  /// Longest pause of the IMU that is bridged. After a longer pause the next pose restarts the
  /// filter.
  double max_imu_gap = 0.1;
};

inline void validate(const EkfSettings& s) {
  validate(s.imu_noise);
  validate(s.pose_noise);
  require(detail::all_entries(s.marker_position, [](double x) { return std::abs(x) <= 100.0; }),
          "EkfSettings.marker_position [m]", s.marker_position, "in [-100, 100] in every entry");
  require(std::abs(s.marker_orientation.norm() - 1.0) < 1e-6, "EkfSettings.marker_orientation",
          s.marker_orientation.coeffs(), "of unit length");
  require_in("EkfSettings.marker_position_stddev [m]", s.marker_position_stddev, 0.0, 100.0);
  require_in("EkfSettings.marker_orientation_stddev [rad]", s.marker_orientation_stddev, 0.0, 10.0);
  require_time("EkfSettings.clock_offset [s]", s.clock_offset);
  require_in("EkfSettings.velocity_stddev [m/s]", s.velocity_stddev, 1e-6, 1e3);
  require_in("EkfSettings.gyro_bias_stddev [rad/s]", s.gyro_bias_stddev, 0.0, 1e3);
  require_in("EkfSettings.accelerometer_bias_stddev [m/s^2]", s.accelerometer_bias_stddev, 0.0,
             1e3);
  require_positive("EkfSettings.gate", s.gate);
  require(s.max_rejections >= 1, "EkfSettings.max_rejections", s.max_rejections, "at least 1");
  require_in("EkfSettings.max_delay [s]", s.max_delay, 1e-6, 10.0);
  require_in("EkfSettings.max_imu_gap [s]", s.max_imu_gap, 1e-6, 1.0);
}

/// Result of processing a measurement. A measurement with a status after `restarted` did not change
/// the estimate.
enum class EkfStatus {
  updated,    ///< used
  started,    ///< first pose: the filter starts at this pose
  restarted,  ///< the filter restarts at this pose, after rejections or a gap of the IMU
  waiting,    ///< pose ahead of the IMU: used when the IMU reaches its time
  stopped,    ///< IMU sample after a gap: the estimate is frozen until the next pose
  gated,      ///< pose is too unlikely (NIS above the gate)
  duplicate,  ///< stamp was seen before
  late,       ///< older than an IMU sample, or a pose, that was already used
  early,      ///< pose too far ahead of the IMU, before its first sample, or too many poses wait
  rejected    ///< not finite, not a rotation, or absurd (1e3 rad/s, 1e5 m/s^2, 1e6 m)
};

[[nodiscard]] inline const char* to_string(EkfStatus status) {
  constexpr std::array<const char*, 10> names = {"updated", "started", "restarted", "waiting",
                                                 "stopped", "gated",   "duplicate", "late",
                                                 "early",   "rejected"};
  return names[static_cast<std::size_t>(status)];
}

/// Number of poses by result.
struct EkfCounts {
  long used = 0;      ///< updates, starts and restarts
  long restarts = 0;  ///< restarts among the used poses
  long gated = 0;
  long unused = 0;  ///< duplicate, late, early or rejected
};

/// Error-state Kalman filter for delayed poses. The filter is at the time of the last pose used, so
/// that a delayed pose is compared with the state at its own time. From there the state is
/// propagated through the IMU samples. Samples are kept while a pose of their time may arrive. The
/// constructor allocates all memory. Afterwards nothing throws or allocates. The initial
/// orientation may be arbitrary.
template <typename Scalar>
class Ekf {
 public:
  static constexpr std::size_t max_samples = 1024;  ///< IMU samples kept for delayed poses
  static constexpr std::size_t max_waiting = 32;    ///< stored poses ahead of the IMU

  /// Throws std::invalid_argument if a setting is out of range.
  explicit Ekf(const EkfSettings& settings = {});

  /// Processes an IMU sample taken at `time` [s]. This clock is the reference for all times.
  EkfStatus on_imu(double time, const InertialSample<Scalar>& value) noexcept;

  /// Processes a pose of the marker frame taken at `time` [s] in motion capture's clock.
  EkfStatus on_pose(double time, const MarkerPose<Scalar>& pose) noexcept;

  /// False before the first pose and after a gap of the IMU. Do not use state() for control then.
  [[nodiscard]] bool running() const noexcept { return running_; }

  /// Time of the newest IMU sample [s]; zero before the first sample.
  [[nodiscard]] double time() const noexcept { return newest_.time; }

  /// Pose and twist of the body at time(). The body frame is the IMU's frame.
  [[nodiscard]] BodyState<Scalar> state() const noexcept {
    return {ahead_.position, ahead_.velocity, ahead_.orientation,
            newest_.value.angular_velocity - ahead_.gyro_bias};
  }

  /// Same as state() for a loop slower than the IMU. The angular velocity is the mean of all
  /// samples since the last call, including the newest sample. A single sample of a gyroscope that
  /// vibrates with the rotors is aliased. The mean is half a tick old.
  [[nodiscard]] BodyState<Scalar> take_state() noexcept {
    BodyState<Scalar> taken = state();
    if (rates_ > 0) taken.angular_velocity = rate_sum_ / Scalar(rates_) - ahead_.gyro_bias;
    rates_ = 0;
    return taken;
  }

  /// Sample without the biases, for WrenchObserver.
  [[nodiscard]] InertialSample<Scalar> corrected(
      const InertialSample<Scalar>& sample) const noexcept {
    return {sample.angular_velocity - ahead_.gyro_bias,
            sample.specific_force - ahead_.accelerometer_bias};
  }

  /// Filter at filter_time(): state with biases and marker frame, and covariance.
  [[nodiscard]] const ErrorStateFilter<Scalar>& filter() const noexcept { return filter_; }
  /// Time of the last pose used [s]. If no poses arrive, at most max_delay behind time().
  [[nodiscard]] double filter_time() const noexcept { return from_.time; }
  /// NIS r' S^-1 r of the last pose that was compared, used or not.
  [[nodiscard]] Scalar nis() const noexcept { return nis_; }
  [[nodiscard]] const EkfCounts& counts() const noexcept { return counts_; }

  /// Restores the state after construction.
  void reset() noexcept;

 private:
  using Sample = Timed<InertialSample<Scalar>>;
  using Covariance = typename ErrorStateFilter<Scalar>::Covariance;

  static bool within(const Vector3<Scalar>& v, double limit) noexcept {
    return all_finite(v) && v.cwiseAbs().maxCoeff() <= Scalar(limit);
  }

  static InertialSample<Scalar> mean(const Sample& a, const Sample& b) noexcept {
    return {(a.value.angular_velocity + b.value.angular_velocity) / Scalar(2),
            (a.value.specific_force + b.value.specific_force) / Scalar(2)};
  }

  static InertialState<Scalar> step(const InertialState<Scalar>& x, const Sample& from,
                                    const Sample& to) noexcept {
    return propagate(x, mean(from, to), Scalar(to.time - from.time));
  }

  /// Interpolates the IMU linearly between two samples.
  static Sample between(const Sample& a, const Sample& b, double time) noexcept {
    const Scalar fraction = Scalar((time - a.time) / (b.time - a.time));
    const auto blend = [fraction](const Vector3<Scalar>& from, const Vector3<Scalar>& to) {
      return Vector3<Scalar>(from + fraction * (to - from));
    };
    return {time,
            {blend(a.value.angular_velocity, b.value.angular_velocity),
             blend(a.value.specific_force, b.value.specific_force)}};
  }

  [[nodiscard]] const Sample& at(std::size_t i) const noexcept {
    return samples_[(first_ + i) % max_samples];
  }

  void begin_mean(const Sample& sample) noexcept {
    rate_sum_ = sample.value.angular_velocity;
    rates_ = 1;
  }

  /// Advances the filter through the samples up to `time`, if `time` is later.
  void catch_up(double time) noexcept;

  void advance(const Sample& to) noexcept;

  EkfStatus unused(EkfStatus status) noexcept {
    ++counts_.unused;
    return status;
  }

  EkfStatus take(double time, const MarkerPose<Scalar>& pose) noexcept;

  /// Starts the vehicle at the pose, with the known marker frame and the last values of the biases.
  /// The update from a much larger covariance sets the correlation between the pose and an
  /// uncertain marker frame.
  void start(const MarkerPose<Scalar>& pose) noexcept;

  static void fill(Covariance& p, int start, double stddev) noexcept {
    p.diagonal().template segment<3>(start).setConstant(Scalar(stddev * stddev));
  }

  EkfSettings settings_;
  ErrorStateFilter<Scalar> filter_;
  InertialState<Scalar> ahead_;  ///< filter state propagated to newest_
  Sample from_;                  ///< IMU at the filter's time
  Sample newest_;                ///< the last of samples_, or from_
  std::vector<Sample> samples_;  ///< ring buffer of samples later than from_
  std::size_t first_ = 0, count_ = 0;
  std::array<Timed<MarkerPose<Scalar>>, max_waiting> poses_;  ///< sorted by time
  std::size_t waiting_ = 0;
  Vector3<Scalar> rate_sum_ = Vector3<Scalar>::Zero();  ///< sum of rates since take_state()
  int rates_ = 0;
  double pose_time_ = 0.0;  ///< time of the last pose compared
  Scalar nis_ = Scalar(0);
  int rejections_ = 0, behind_ = 0;  ///< consecutive gated poses, consecutive late IMU samples
  EkfCounts counts_;
  bool has_imu_ = false, has_pose_ = false, running_ = false;
};
using Ekfd = Ekf<double>;  ///< in double precision

template <typename Scalar>
Ekf<Scalar>::Ekf(const EkfSettings& settings)
    : settings_(validated(settings)),
      filter_(settings.imu_noise, settings.pose_noise),
      samples_(max_samples) {
  reset();
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::on_imu(double time, const InertialSample<Scalar>& value) noexcept {
  if (!std::isfinite(time) || !within(value.angular_velocity, 1e3) ||
      !within(value.specific_force, 1e5))
    return EkfStatus::rejected;
  const Sample sample{time, value};
  const double pause = time - newest_.time;
  if (has_imu_ && pause == 0.0) return EkfStatus::duplicate;
  if (has_imu_ && pause < 0.0 && ++behind_ < settings_.max_rejections) return EkfStatus::late;
  behind_ = 0;
  if (!has_imu_ || pause < 0.0 || pause > settings_.max_imu_gap) {
    const bool gap = has_imu_;
    has_imu_ = true;
    running_ = false;
    count_ = 0;
    if (pause < 0.0) waiting_ = 0;
    from_ = newest_ = sample;
    begin_mean(sample);
    return gap ? EkfStatus::stopped : EkfStatus::updated;
  }
  constexpr int most = 1 << 20;  // bounds the sum if nobody takes the mean
  if (rates_ == 0 || rates_ == most) {
    begin_mean(sample);
  } else {
    rate_sum_ += sample.value.angular_velocity;
    ++rates_;
  }
  if (count_ == max_samples) catch_up(at(0).time);
  samples_[(first_ + count_++) % max_samples] = sample;
  if (running_) ahead_ = step(ahead_, newest_, sample);
  newest_ = sample;
  catch_up(time - settings_.max_delay);
  while (waiting_ > 0 && poses_[0].time <= time) {
    const Timed<MarkerPose<Scalar>> next = poses_[0];
    std::copy(poses_.begin() + 1, poses_.begin() + static_cast<std::ptrdiff_t>(waiting_),
              poses_.begin());
    --waiting_;
    take(next.time, next.value);
  }
  return EkfStatus::updated;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::on_pose(double time, const MarkerPose<Scalar>& pose) noexcept {
  using std::abs;
  const Scalar length = pose.orientation.norm();
  if (!std::isfinite(time) || !within(pose.position, 1e6) ||
      !(abs(length - Scalar(1)) < Scalar(0.1)))
    return unused(EkfStatus::rejected);
  const double stamp = time + settings_.clock_offset;
  const MarkerPose<Scalar> unit{pose.position, pose.orientation.normalized()};
  if (!has_imu_) return unused(EkfStatus::early);
  if (stamp <= newest_.time) return take(stamp, unit);
  if (stamp > newest_.time + settings_.max_delay || waiting_ == max_waiting)
    return unused(EkfStatus::early);
  auto place = poses_.begin() + static_cast<std::ptrdiff_t>(waiting_++);
  for (; place != poses_.begin() && (place - 1)->time > stamp; --place) *place = *(place - 1);
  *place = {stamp, unit};
  return EkfStatus::waiting;
}

template <typename Scalar>
void Ekf<Scalar>::reset() noexcept {
  has_imu_ = has_pose_ = running_ = false;
  count_ = waiting_ = 0;
  rejections_ = behind_ = rates_ = 0;
  nis_ = Scalar(0);
  counts_ = {};
  from_ = newest_ = {};
  InertialState<Scalar> x;
  x.marker_position = settings_.marker_position.template cast<Scalar>();
  x.marker_orientation = settings_.marker_orientation.template cast<Scalar>();
  filter_.reset(x, Covariance::Zero());
  ahead_ = x;
}

template <typename Scalar>
void Ekf<Scalar>::catch_up(double time) noexcept {
  while (count_ > 0 && at(0).time <= time) {
    advance(at(0));
    first_ = (first_ + 1) % max_samples;
    --count_;
  }
  if (count_ > 0 && from_.time < time) advance(between(from_, at(0), time));
}

template <typename Scalar>
void Ekf<Scalar>::advance(const Sample& to) noexcept {
  if (running_) filter_.predict(mean(from_, to), Scalar(to.time - from_.time));
  from_ = to;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::take(double time, const MarkerPose<Scalar>& pose) noexcept {
  if (has_pose_ && time == pose_time_) return unused(EkfStatus::duplicate);
  if (time < from_.time) return unused(EkfStatus::late);
  catch_up(time);
  has_pose_ = true;
  pose_time_ = time;
  EkfStatus status = running_ ? EkfStatus::updated : EkfStatus::started;
  if (running_) {
    const auto innovation = filter_.innovation(pose);
    nis_ = innovation.distance;
    if (!(nis_ <= Scalar(settings_.gate)) || !filter_.update(innovation)) {
      if (++rejections_ < settings_.max_rejections) {
        ++counts_.gated;
        return EkfStatus::gated;
      }
      status = EkfStatus::restarted;
    }
  } else if (counts_.used > 0) {
    status = EkfStatus::restarted;
  }
  if (status != EkfStatus::updated) start(pose);
  if (status == EkfStatus::restarted) ++counts_.restarts;
  ++counts_.used;
  rejections_ = 0;
  running_ = true;
  ahead_ = filter_.state();
  Sample from = from_;
  for (std::size_t i = 0; i < count_; from = at(i++)) ahead_ = step(ahead_, from, at(i));
  return status;
}

template <typename Scalar>
void Ekf<Scalar>::start(const MarkerPose<Scalar>& pose) noexcept {
  using I = InertialIndex;
  InertialState<Scalar> x = filter_.state();
  x.orientation = (pose.orientation * x.marker_orientation.conjugate()).normalized();
  x.position = pose.position - x.orientation * x.marker_position;
  x.velocity.setZero();
  Covariance p = Covariance::Zero();
  if (counts_.used > 0) {
    p.template bottomRightCorner<6, 6>() = filter_.covariance().template bottomRightCorner<6, 6>();
  } else {
    fill(p, I::marker_orientation, settings_.marker_orientation_stddev);
    fill(p, I::marker_position, settings_.marker_position_stddev);
  }
  fill(p, I::position, 1.0);
  fill(p, I::orientation, 1.0);
  fill(p, I::velocity, settings_.velocity_stddev);
  fill(p, I::gyro_bias, settings_.gyro_bias_stddev);
  fill(p, I::accelerometer_bias, settings_.accelerometer_bias_stddev);
  filter_.reset(x, p);
  filter_.update(filter_.innovation(pose));
}

}  // namespace tilt_ropter
