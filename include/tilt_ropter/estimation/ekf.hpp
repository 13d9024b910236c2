// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/ekf_settings.hpp>
#include <tilt_ropter/estimation/detail/ekf_start.hpp>
#include <tilt_ropter/estimation/detail/ekf_trust.hpp>
#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/estimation/detail/imu_history.hpp>
#include <tilt_ropter/estimation/detail/measurement_faults.hpp>
#include <tilt_ropter/estimation/detail/measurement_model.hpp>
#include <tilt_ropter/estimation/detail/measurement_queue.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <type_traits>

/// State of the vehicle from IMU, motion capture and other sensors (paper, Sec. Control): an
/// error-state Kalman filter that processes measurements at their time stamps. This header decides
/// which measurement is used and when; the headers that it includes contain the computations.
/// The mounting of the IMU and the check of its clock are here too: only this class uses them.
namespace tilt_ropter {

/// Error-state Kalman filter for delayed measurements. The filter is at the time of the last
/// measurement used, so that a delayed measurement is compared with the state at its own time. From
/// there the state is propagated through the IMU samples. Samples are kept while a measurement of
/// their time may arrive. The constructor allocates all memory. Afterwards nothing throws or
/// allocates. The initial orientation may be arbitrary.
///
/// Faulty poses do not move the estimate:
///
/// - A pose, position or velocity that repeats an earlier one bit for bit, while the IMU's samples
///   change, is not used.
/// - A pose above the gate is not used. If poses move like the IMU but elsewhere for restart_time
///   (the origin of motion capture was moved), the filter restarts there and keeps tilt, velocity
///   and biases. If they move smoothly along a path of at least 0.3 m, it restarts after
///   full_restart_time and keeps only the marker frame. The second time in a row it keeps nothing,
///   and takes back the last step of the poses' clock if they are then in time. on_measurement()
///   has the first kind of restart only, with the orientation of the estimate.
/// - Jitter of the stamps is measured and is part of the poses' noise.
/// - If the clock of the poses steps, their stamps are corrected by the step.
///
/// trust() says how far the estimate can be trusted.
template <typename Scalar>
class Ekf {
 public:
  static constexpr std::size_t max_waiting = 32;  ///< stored measurements ahead of the IMU

  /// Throws std::invalid_argument if a setting is out of range.
  explicit Ekf(const EkfSettings& settings = {});

  /// Processes an IMU sample taken at `time` [s]. This clock is the reference for all times. If it
  /// is set back, five samples at most are late. The estimate then goes on from where it was, and
  /// restarts at the next pose if this pose is elsewhere.
  EkfStatus on_imu(double time, const InertialSample<Scalar>& value) noexcept;

  /// Processes a pose of the marker frame taken at `time` [s] in motion capture's clock.
  /// Poses whose stamps are all off by the same time correct the clock, if it is below 1e10 s.
  EkfStatus on_pose(double time, const MarkerPose<Scalar>& pose) noexcept;

  /// Processes any other measurement, taken at `time` [s] in the IMU's clock. `measurement` is
  /// plain data of at most 512 bytes: a measurement of measurement_models.hpp, or a
  /// callable that takes an InertialMotion<Scalar> and returns a Linearised.
  /// It is used once the filter has started with a pose or by start(). A callable has the gate
  /// alone: it is not checked for repetitions, and the filter does not restart at it. See
  /// EkfSettings::fusion_delay for sensors with different delays.
  template <typename Measurement>
  EkfStatus on_measurement(double time, const Measurement& measurement) noexcept;

  /// Starts, or restarts, at a state known by other means than a pose, at time(). Returns false and
  /// changes nothing before the first IMU sample or if a number is not finite or not positive.
  bool start(const BodyState<Scalar>& body, const StartStddev& stddev) noexcept;

  /// False before the first pose or start(), and after a gap of the IMU until a measurement is
  /// used. Do not use state() for control then.
  [[nodiscard]] bool running() const noexcept { return running_; }

  /// Reliability of the estimate at `now` [s], in the IMU's clock.
  [[nodiscard]] EstimateTrust trust(double now) const noexcept;

  /// Time of the newest IMU sample [s]; zero before the first sample.
  [[nodiscard]] double time() const noexcept { return history_.newest().time; }

  /// Pose and twist of the body (of the CoM) at time().
  [[nodiscard]] BodyState<Scalar> state() const noexcept {
    return body_of(history_.newest().value.angular_velocity - ahead_.gyro_bias);
  }

  /// Same as state() for a loop slower than the IMU. The angular velocity is the mean of all
  /// samples since the last call, including the newest sample. A single sample of a gyroscope that
  /// vibrates with the rotors is aliased. The mean is half a tick old.
  [[nodiscard]] BodyState<Scalar> take_state() noexcept {
    BodyState<Scalar> taken =
        rates_ > 0 ? body_of(rate_sum_ / Scalar(rates_) - ahead_.gyro_bias) : state();
    rates_ = 0;
    return taken;
  }

  /// Newest sample without the biases, in the body frame at the CoM, for WrenchObserver. If the IMU
  /// is not at the CoM, this uses the difference of the last two samples of the gyroscope.
  [[nodiscard]] InertialSample<Scalar> corrected(
      const InertialSample<Scalar>& sample) const noexcept {
    const InertialSample<Scalar> turned = to_body(sample);
    const Vector3<Scalar> rate = turned.angular_velocity - ahead_.gyro_bias;
    Vector3<Scalar> force = turned.specific_force - ahead_.accelerometer_bias;
    if (has_lever_) {
      const Vector3<Scalar> place = imu_position();
      force -= angular_acceleration_.cross(place) + rate.cross(rate.cross(place));
    }
    return {rate, force};
  }

  /// Position of the IMU in the body frame [m], estimated if imu_position_stddev is above zero.
  [[nodiscard]] Vector3<Scalar> imu_position() const noexcept {
    if (!finds_imu()) return imu_position_;
    return marker_position_ - filter_.state().marker_position;
  }

  /// Filter at filter_time(): state of the IMU with biases and marker frame, and covariance. The
  /// marker's position is relative to the IMU, in body axes.
  [[nodiscard]] const ErrorStateFilter<Scalar>& filter() const noexcept { return filter_; }
  /// Time of the last measurement used [s]. If none arrive, at most max_delay behind time().
  [[nodiscard]] double filter_time() const noexcept { return history_.from().time; }
  /// NIS r' S^-1 r of the last measurement that was compared, used or not.
  [[nodiscard]] Scalar nis() const noexcept { return nis_; }
  [[nodiscard]] const EkfCounts& counts() const noexcept { return counts_; }
  /// Measured jitter of the poses' stamps [s], zero if they are regular.
  [[nodiscard]] double stamp_stddev() const noexcept { return stamps_.stddev(); }
  /// Step of the poses' clock that is added to their stamps [s].
  [[nodiscard]] double clock_step() const noexcept { return stamps_.clock_step(); }

  /// Restores the state after construction.
  void reset() noexcept;

 private:
  using Sample = Timed<InertialSample<Scalar>>;
  friend class detail::StoredMeasurement<Ekf>;

  /// A pose and the time between its stamp and its arrival [s].
  struct ArrivedPose {
    MarkerPose<Scalar> pose;
    double lag;
  };
  [[nodiscard]] bool finds_imu() const noexcept { return settings_.imu_position_stddev > 0.0; }

  static bool within(const Vector3<Scalar>& v, double limit) noexcept {
    return all_finite(v) && v.cwiseAbs().maxCoeff() <= Scalar(limit);
  }

  [[nodiscard]] InertialSample<Scalar> to_body(const InertialSample<Scalar>& s) const noexcept {
    return {imu_rotation_ * s.angular_velocity, imu_rotation_ * s.specific_force};
  }

  [[nodiscard]] BodyState<Scalar> body_of(const Vector3<Scalar>& rate) const noexcept {
    BodyState<Scalar> body{ahead_.position, ahead_.velocity, ahead_.orientation, rate};
    if (!has_lever_) return body;
    const Vector3<Scalar> place = imu_position();
    body.position -= ahead_.orientation * place;
    body.velocity -= ahead_.orientation * rate.cross(place);
    return body;
  }

  void begin_mean(const Sample& sample) noexcept {
    rate_sum_ = sample.value.angular_velocity;
    rates_ = 1;
  }

  EkfStatus begin_again(const Sample& sample, double pause) noexcept;
  EkfStatus set_clock(const Sample& sample) noexcept;

  /// Advances the filter through the samples up to `time`, if `time` is later.
  void catch_up(double time) noexcept {
    history_.catch_up(time, [this](const InertialSample<Scalar>& mean, const Scalar& duration) {
      if (running_) filter_.predict(mean, duration);
    });
  }
  /// Propagates the filter's state to the newest sample.
  void look_ahead() noexcept { ahead_ = history_.propagated(filter_.state()); }
  /// Angular velocity at the filter's time, body frame [rad/s].
  [[nodiscard]] Vector3<Scalar> rate() const noexcept {
    return history_.from().value.angular_velocity - filter_.state().gyro_bias;
  }

  EkfStatus unused(EkfStatus status) noexcept {
    ++counts_.unused;
    return status;
  }
  /// A pose with a stamp that cannot be used. Corrects the clock if all poses arrive like this.
  EkfStatus mistimed(EkfStatus status, double lag) noexcept {
    poses_mistimed_ = true;
    watch_clock(lag);
    return unused(status);
  }
  void watch_clock(double lag) noexcept {
    if (!stamps_.on_unused(lag, settings_.max_rejections)) return;
    ++counts_.clock_steps;
    queue_.clear();
    pose_gate().clear();
  }
  /// Takes back the last step of the poses' clock. If the clock changes, the pose with this `lag`
  /// had the wrong stamp, so the next one starts the filter.
  void try_other_clock(double lag) noexcept {
    if (!stamps_.swap_clocks(lag, settings_.max_delay)) return;
    queue_.clear();
    stopped_at_ = -std::numeric_limits<double>::infinity();
    running_ = false;
  }
  [[nodiscard]] detail::GateMonitor<Scalar>& pose_gate() noexcept { return gates_[0]; }

  /// Uses a measurement that is not ahead of the IMU.
  EkfStatus apply(double time, const ArrivedPose& arrived) noexcept;
  template <typename Measurement>
  EkfStatus apply(double time, const Measurement& measurement) noexcept;
  template <typename Measurement>
  EkfStatus use(const Measurement& at, MeasurementKind kind) noexcept;
  template <typename Measurement>
  EkfStatus use_gated(const Measurement& at, MeasurementKind kind, int part) noexcept;
  template <typename Measurement>
  EkfStatus queue(double time, const Measurement& measurement) noexcept;

  void used(MeasurementKind kind) noexcept {
    last_used_[static_cast<std::size_t>(kind)] = filter_time();
    if (is_position(kind)) poses_gated_ = poses_mistimed_ = false;
  }
  static constexpr bool is_position(MeasurementKind kind) noexcept {
    return kind == MeasurementKind::pose || kind == MeasurementKind::position;
  }
  /// Gate for a number of rows, of the same probability as settings_.gate for six.
  [[nodiscard]] Scalar gate_of(int rows) const noexcept {
    constexpr std::array<double, 6> quantile = {15.14, 18.42, 21.11, 23.51, 25.74, 27.86};
    return Scalar(settings_.gate * quantile[static_cast<std::size_t>(rows - 1)] / quantile[5]);
  }

  [[nodiscard]] MarkerPose<Scalar> predicted_pose() const noexcept {
    const InertialState<Scalar>& x = filter_.state();
    return {x.position + x.orientation * x.marker_position, x.orientation * x.marker_orientation};
  }
  [[nodiscard]] double stddev_of(int part) const noexcept {
    return detail::largest_stddev(filter_.covariance(), part);
  }
  /// Standard deviation of the positions of poses, by noise and stamps [m].
  [[nodiscard]] double position_noise() const noexcept {
    return std::hypot(settings_.pose_noise.position,
                      static_cast<double>(filter_.state().velocity.norm()) * stamps_.stddev());
  }
  /// Distance of a pose from the estimate, position [m] plus angle [rad].
  [[nodiscard]] double distance_to(const MarkerPose<Scalar>& pose) const noexcept {
    const MarkerPose<Scalar> here = predicted_pose();
    return static_cast<double>((pose.position - here.position).norm() +
                               pose.orientation.angularDistance(here.orientation));
  }
  /// Time [s] by which the pose is ahead of the estimate, along the estimate's path. Infinite if it
  /// is not on the path, within `noise` [m], or if the marker hardly moves.
  [[nodiscard]] double offset_along_path(const MarkerPose<Scalar>& pose,
                                         double noise) const noexcept {
    const InertialState<Scalar>& x = filter_.state();
    const Vector3<Scalar> velocity = x.velocity + x.orientation * rate().cross(x.marker_position),
                          off = pose.position - predicted_pose().position;
    const Scalar square = velocity.squaredNorm();
    if (!(square > Scalar(0.25))) return std::numeric_limits<double>::infinity();
    const Scalar ahead = off.dot(velocity) / square;
    const bool on_path = (off - ahead * velocity).norm() <= Scalar(6.0 * noise + 0.01);
    return on_path ? static_cast<double>(ahead) : std::numeric_limits<double>::infinity();
  }
  /// Goes on after a short gap of the IMU, for measurements other than poses.
  bool resume() noexcept {
    if (was_started_) running_ = detail::resume(filter_, filter_time() - stopped_at_, rate());
    bridged_ = running_;
    return running_;
  }
  EkfStatus start_at(const ArrivedPose& arrived) noexcept;
  EkfStatus reject(double time, const ArrivedPose& arrived) noexcept;
  /// Counts a used pose and propagates the state to the newest sample. Returns `status`.
  EkfStatus finish(EkfStatus status) noexcept;
  /// Too few poses have confirmed the start.
  [[nodiscard]] bool has_just_started() const noexcept { return confirmed_ < 25; }

  EkfSettings settings_;
  ErrorStateFilter<Scalar> filter_;
  Matrix3<Scalar> imu_rotation_;
  Vector3<Scalar> imu_position_, marker_position_;  ///< of the settings
  bool has_lever_;
  InertialState<Scalar> ahead_;         ///< filter state propagated to the newest IMU sample
  detail::ImuHistory<Scalar> history_;  ///< body axes
  detail::MeasurementQueue<Ekf, max_waiting> queue_;    ///< sorted by time
  Vector3<Scalar> rate_sum_ = Vector3<Scalar>::Zero();  ///< sum of rates since take_state()
  Vector3<Scalar> angular_acceleration_ = Vector3<Scalar>::Zero();
  int rates_ = 0;
  detail::RepetitionDetector<Scalar> repetitions_;
  detail::StampMonitor stamps_;
  std::array<detail::GateMonitor<Scalar>, 4>
      gates_;                   ///< of on_pose(), positions, velocities, poses
  double pose_time_ = 0.0;      ///< time of the last pose compared
  double received_ = 0.0;       ///< stamp of the last pose received
  double last_position_ = 0.0;  ///< time of the last pose used
  double given_up_at_ = 0.0;    ///< time of the last restart after full_restart_time
  double stopped_at_ = 0.0;     ///< last time at which the filter ran
  double behind_time_ = 0.0;    ///< time of the last late IMU sample
  double behind_since_ = 0.0;   ///< time of the first of consecutive late IMU samples
  Scalar nis_ = Scalar(0);
  int behind_ = 0;     ///< consecutive late IMU samples
  int confirmed_ = 0;  ///< poses used since the start
  EkfCounts counts_;
  std::array<double, static_cast<std::size_t>(measurement_kinds)> last_used_ = {};
  bool has_imu_ = false, has_pose_ = false, running_ = false, was_started_ = false;
  bool poses_frozen_ = false, poses_gated_ = false, poses_mistimed_ = false;
  bool bridged_ = false;  ///< clock set back or gap bridged, and no pose was used since
};
using Ekfd = Ekf<double>;  ///< in double precision

namespace detail {

template <typename Measurement, typename = void>
struct KindOf {
  static constexpr MeasurementKind value = MeasurementKind::other;
};
template <typename Measurement>
struct KindOf<Measurement, std::void_t<decltype(Measurement::kind)>> {
  static constexpr MeasurementKind value = Measurement::kind;
};

}  // namespace detail

template <typename Scalar>
Ekf<Scalar>::Ekf(const EkfSettings& settings)
    : settings_(validated(settings)),
      filter_(settings.imu_noise, settings.pose_noise),
      imu_rotation_(settings.imu_orientation.toRotationMatrix().template cast<Scalar>()),
      imu_position_(settings.imu_position.template cast<Scalar>()),
      marker_position_(settings.marker_position.template cast<Scalar>()),
      has_lever_(settings.imu_position != Eigen::Vector3d::Zero() || finds_imu()),
      history_(static_cast<std::size_t>(settings.max_delay * settings.max_imu_rate) + 16) {
  reset();
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::on_imu(double time, const InertialSample<Scalar>& value) noexcept {
  if (!std::isfinite(time) || !within(value.angular_velocity, 1e3) ||
      !within(value.specific_force, 1e5))
    return EkfStatus::rejected;
  const Sample sample{time, to_body(value)};
  const Sample newest = history_.newest();
  const double pause = time - newest.time;
  if (has_imu_ && pause == 0.0) return EkfStatus::duplicate;
  if (has_imu_ && pause < 0.0) {
    // The clock was set back if several samples in a row are late but follow each other.
    behind_ = behind_ > 0 && time <= behind_time_ ? 1 : behind_ + 1;
    if (behind_ == 1) behind_since_ = time;
    behind_time_ = time;
    if (behind_ < std::min(settings_.max_rejections, 5)) return EkfStatus::late;
  }
  behind_ = 0;
  repetitions_.on_imu(value);
  if (has_imu_ && pause < 0.0) return set_clock(sample);
  if (!has_imu_ || pause > settings_.max_imu_gap) return begin_again(sample, pause);
  constexpr int most = 1 << 20;  // bounds the sum if nobody takes the mean
  if (rates_ == 0 || rates_ == most) {
    begin_mean(sample);
  } else {
    rate_sum_ += sample.value.angular_velocity;
    ++rates_;
  }
  if (history_.is_full()) catch_up(history_.next().time);
  history_.push(sample);
  if (running_) ahead_ = history_.step(ahead_, newest, sample);
  if (has_lever_)
    angular_acceleration_ =
        (sample.value.angular_velocity - newest.value.angular_velocity) / Scalar(pause);
  catch_up(time - settings_.max_delay);
  while (queue_.has_until(time - settings_.fusion_delay)) queue_.pop().apply(*this);
  return EkfStatus::updated;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::begin_again(const Sample& sample, double pause) noexcept {
  const bool gap = has_imu_;
  has_imu_ = true;
  if (running_) {
    filter_.reset(ahead_, filter_.covariance());
    stopped_at_ = sample.time - pause;
  }
  running_ = false;
  angular_acceleration_.setZero();
  history_.begin(sample);
  begin_mean(sample);
  return gap ? EkfStatus::stopped : EkfStatus::updated;
}

// The estimate goes on, because there may be no pose. The samples that were late at first have
// their duration; nobody knows what passed before them.
template <typename Scalar>
EkfStatus Ekf<Scalar>::set_clock(const Sample& sample) noexcept {
  const double step = behind_since_ - time();
  for (double& last : last_used_) last += step;
  last_position_ += step;
  given_up_at_ += step;
  queue_.clear();
  for (detail::GateMonitor<Scalar>& gate : gates_) gate.clear();
  has_pose_ = false;
  // After a single wrong stamp the time since the filter ran is still known.
  const double stopped_for = sample.time - stopped_at_;
  if (running_ || !(stopped_for >= 0.0 && stopped_for < 1.0))
    stopped_at_ = sample.time - std::abs(step);
  if (running_) {
    running_ = sample.time - behind_since_ <= settings_.max_imu_gap;
    const Sample newest{behind_since_, history_.newest().value};
    if (running_) ahead_ = history_.step(ahead_, newest, sample);
    filter_.reset(ahead_, filter_.covariance());
  }
  bridged_ = running_;
  angular_acceleration_.setZero();
  history_.begin(sample);
  begin_mean(sample);
  return running_ ? EkfStatus::updated : EkfStatus::stopped;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::on_pose(double time, const MarkerPose<Scalar>& pose) noexcept {
  using std::abs;
  const Scalar length = pose.orientation.norm();
  if (!std::isfinite(time) || !within(pose.position, 1e6) ||
      !(abs(length - Scalar(1)) < Scalar(0.1)))
    return unused(EkfStatus::rejected);
  if (!has_imu_) return unused(EkfStatus::early);
  const double stamp = time + settings_.clock_offset + clock_step();
  if (counts_.used > 0 && stamp == received_) return unused(EkfStatus::duplicate);
  received_ = stamp;
  poses_frozen_ = repetitions_.repeats(pose);
  if (poses_frozen_) {
    ++counts_.frozen;
    return unused(EkfStatus::frozen);
  }
  stamps_.on_stamp(stamp);
  const ArrivedPose arrived{{pose.position, pose.orientation.normalized()}, this->time() - stamp};
  const EkfStatus status = queue(stamp, arrived);
  return status == EkfStatus::early ? mistimed(status, arrived.lag) : status;
}

template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::on_measurement(double time, const Measurement& measurement) noexcept {
  if (!std::isfinite(time)) return EkfStatus::rejected;
  if (!has_imu_) return EkfStatus::early;
  constexpr MeasurementKind kind = detail::KindOf<Measurement>::value;
  if (const Vector3<Scalar>* value = detail::vector_of<Scalar>(measurement)) {
    const bool frozen = repetitions_.repeats(*value);
    if (is_position(kind)) poses_frozen_ = frozen;
    if (frozen) return EkfStatus::frozen;
  }
  const EkfStatus status = queue(time, measurement);
  if (is_position(kind) && status == EkfStatus::early) poses_mistimed_ = true;
  return status;
}

template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::queue(double time, const Measurement& measurement) noexcept {
  const double newest = this->time();
  if (time <= newest - settings_.fusion_delay) return apply(time, measurement);
  if (time > newest + settings_.max_delay || !queue_.push(time, measurement))
    return EkfStatus::early;
  return EkfStatus::waiting;
}

template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::apply(double time, const Measurement& measurement) noexcept {
  if (!running_ && (time < filter_time() || !resume())) return EkfStatus::early;
  constexpr MeasurementKind kind = detail::KindOf<Measurement>::value;
  if (time < filter_time()) {
    if (is_position(kind)) poses_mistimed_ = true;
    return EkfStatus::late;
  }
  catch_up(time);
  const InertialMotion<Scalar> motion{filter_.state(), rate(), imu_position(),
                                      filter_.covariance().template block<3, 3>(
                                          InertialIndex::orientation, InertialIndex::orientation)};
  auto at = [&] {
    if constexpr (std::is_invocable_v<const Measurement&, const InertialMotion<Scalar>&>)
      return measurement(motion);
    else
      return linearise(measurement, motion);
  }();
  if (finds_imu()) {
    // Another place of the IMU moves the body as another position and velocity of the IMU do.
    using I = InertialIndex;
    const Matrix3<Scalar> rotation = motion.state.orientation.toRotationMatrix();
    at.by(I::marker_position) += at.by(I::position) * rotation +
                                 at.by(I::velocity) * rotation * skew(motion.angular_velocity);
  }
  return use(at, kind);
}

template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::use(const Measurement& at, MeasurementKind kind) noexcept {
  if (!at.valid || !at.is_finite()) return EkfStatus::rejected;
  if constexpr (Measurement::rows == 3 || Measurement::rows == 6) {
    if (is_position(kind)) return use_gated(at, kind, InertialIndex::position);
    if (Measurement::rows == 3 && kind == MeasurementKind::velocity)
      return use_gated(at, kind, InertialIndex::velocity);
  }
  const auto innovation = filter_.innovation_of(at);
  nis_ = innovation.distance;
  if (!(nis_ <= gate_of(Measurement::rows)) || !filter_.update(innovation, at))
    return EkfStatus::gated;
  used(kind);
  look_ahead();
  return EkfStatus::updated;
}

// For a position, a velocity, or a pose with its position in the first rows; `part` is where it is
// in the state. The names and units are those of a position.
template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::use_gated(const Measurement& at, MeasurementKind kind, int part) noexcept {
  using std::sqrt;
  constexpr bool is_pose = Measurement::rows == 6;
  const bool is_place = part == InertialIndex::position;
  detail::GateMonitor<Scalar>& gate = gates_[is_pose ? 3 : is_place ? 1 : 2];
  const InertialState<Scalar>& x = filter_.state();
  const Vector3<Scalar> here = is_place ? x.position : x.velocity,
                        off = at.jacobian.template block<3, 3>(0, part).transpose() *
                              at.residual.template head<3>();  // world
  const double distance = static_cast<double>(off.norm()), time = filter_time(),
               noise = static_cast<double>(sqrt(at.noise.diagonal().template head<3>().maxCoeff()));
  MarkerPose<Scalar> there{here + off};
  if constexpr (is_pose)
    there.orientation = quaternion_exp(Vector3<Scalar>(
        x.orientation *
        (at.jacobian.template block<3, 3>(3, InertialIndex::orientation).transpose() *
         at.residual.template tail<3>())));
  const auto innovation = filter_.innovation_of(at);
  nis_ = innovation.distance;
  EkfStatus status = EkfStatus::updated;
  if (nis_ <= gate_of(Measurement::rows) &&
      gate.accepts(time, distance, 6.0 * noise, settings_.restart_time) &&
      filter_.update(innovation, at)) {
    gate.on_used(here);
  } else {
    // Error by lean and bias [m/s^2]. With it the filter restarts only after a motion.
    constexpr double acceleration = 0.3;
    const double rate_stddev =
        is_place ? std::min(0.3, stddev_of(InertialIndex::velocity)) : acceleration;
    gate.on_gated(time, {there, MarkerPose<Scalar>{here}, distance, noise, rate_stddev});
    if (is_place) poses_gated_ = true;
    if (!gate.moves_like_imu(time, std::min(5, settings_.max_rejections), settings_) ||
        !(there.orientation.angularDistance(Eigen::Quaternion<Scalar>::Identity()) < Scalar(0.1)))
      return EkfStatus::gated;
    detail::shift(filter_, part, off, at);
    gate.on_restart(here);
    status = EkfStatus::restarted;
  }
  used(kind);
  look_ahead();
  return status;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::apply(double time, const ArrivedPose& arrived) noexcept {
  if (has_pose_ && time == pose_time_) return unused(EkfStatus::duplicate);
  if (time < filter_time()) return mistimed(EkfStatus::late, arrived.lag);
  catch_up(time);
  has_pose_ = true;
  pose_time_ = time;
  // With such an attitude error an update is far from linear.
  constexpr double linear = 0.3;  // [rad]
  if (running_ && stddev_of(InertialIndex::orientation) > linear) {
    stopped_at_ = last_position_;
    running_ = false;
  }
  if (!running_) return start_at(arrived);
  LinearisedPose<Scalar> at = filter_.linearise(arrived.pose);
  // Bounded, because a wrong velocity must not make every pose credible.
  constexpr double most = 0.1;  // effect of the jitter [m]
  const double speed = static_cast<double>(filter_.state().velocity.norm());
  const double jitter = std::min(stamps_.stddev(), most / std::max(speed, 1.0));
  if (jitter > 0.0) at.add_stamp_noise(filter_.state().velocity, rate(), Scalar(jitter));
  const auto innovation = filter_.innovation_of(at);
  nis_ = innovation.distance;
  const double small = std::max(0.1, 6.0 * position_noise());  // the controller can follow [m]
  if (!(nis_ <= gate_of(6)) ||
      !pose_gate().accepts(time, distance_to(arrived.pose), small, settings_.restart_time) ||
      !filter_.update(innovation, at))
    return bridged_ ? start_at(arrived) : reject(time, arrived);
  pose_gate().on_used(filter_.state().position);
  stamps_.on_used(arrived.lag);
  ++confirmed_;
  return finish(EkfStatus::updated);
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::start_at(const ArrivedPose& arrived) noexcept {
  const bool again = was_started_;
  // Poses on a smooth path that the gate rejected until the attitude was lost: the velocity or the
  // biases are wrong.
  const bool is_wrong = pose_gate().smooth() >= settings_.max_rejections;
  detail::start_at_pose(filter_, arrived.pose,
                        {counts_.used > 0, again && !is_wrong, filter_time() - stopped_at_},
                        settings_);
  confirmed_ = 0;
  stamps_.on_used(arrived.lag);
  return finish(again ? EkfStatus::restarted : EkfStatus::started);
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::reject(double time, const ArrivedPose& arrived) noexcept {
  const Scalar far(60);  // no valid pose has such a NIS
  const double noise = position_noise();
  detail::GateMonitor<Scalar>& gate = pose_gate();
  gate.on_gated(time, {arrived.pose, predicted_pose(), distance_to(arrived.pose), noise,
                       std::min(0.3, stddev_of(InertialIndex::velocity))});
  poses_gated_ = true;
  stamps_.on_displaced(offset_along_path(arrived.pose, noise));
  const bool moves_like_imu =
      gate.moves_like_imu(time, settings_.max_rejections, settings_) && gate.tilt() < Scalar(0.1);
  const bool start_was_wrong = has_just_started() && gate.is_confirmed() && nis_ > far &&
                               gate.smooth() >= std::min(5, settings_.max_rejections);
  const bool given_up = time - last_position_ >= settings_.full_restart_time &&
                        gate.is_confirmed() && gate.smooth() >= settings_.max_rejections &&
                        gate.extent() > 0.3;
  // If the estimate does not last for full_restart_time twice in a row, what was kept is wrong.
  const bool nothing_held =
      given_up && !moves_like_imu && last_position_ - given_up_at_ < settings_.full_restart_time;
  if (moves_like_imu) {
    detail::relocate(filter_, arrived.pose);
  } else if (start_was_wrong || given_up) {
    detail::start_at_pose(filter_, arrived.pose, {counts_.used > 0 && !nothing_held}, settings_);
    if (given_up) given_up_at_ = time;
  } else {
    ++counts_.gated;
    watch_clock(arrived.lag);
    return EkfStatus::gated;
  }
  if (!start_was_wrong) gate.on_restart(filter_.state().position);
  if (!moves_like_imu) confirmed_ = 0;
  const EkfStatus status = finish(EkfStatus::restarted);
  if (nothing_held) try_other_clock(arrived.lag);
  return status;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::finish(EkfStatus status) noexcept {
  if (status == EkfStatus::restarted) ++counts_.restarts;
  ++counts_.used;
  pose_gate().clear();
  bridged_ = false;
  last_position_ = filter_time();
  used(MeasurementKind::pose);
  running_ = was_started_ = true;
  look_ahead();
  return status;
}

template <typename Scalar>
bool Ekf<Scalar>::start(const BodyState<Scalar>& body, const StartStddev& stddev) noexcept {
  if (!has_imu_ || !is_finite(body) || !(body.orientation.norm() > Scalar(0.1)) ||
      !(stddev.position > 0.0 && stddev.velocity > 0.0 && stddev.orientation > 0.0) ||
      !(stddev.position + stddev.velocity + stddev.orientation < 1e6))
    return false;
  catch_up(time());
  detail::start_at_state(filter_, body, stddev, imu_position(), was_started_, settings_);
  for (detail::GateMonitor<Scalar>& gate : gates_) gate = {};
  last_position_ = filter_time();
  confirmed_ = 0;
  bridged_ = false;
  running_ = was_started_ = true;
  look_ahead();
  return true;
}

template <typename Scalar>
EstimateTrust Ekf<Scalar>::trust(double now) const noexcept {
  EstimateTrust t;
  const auto since = [now](double then) {
    const double age = now - then;
    return age >= 0.0 ? age : age < 0.0 ? 0.0 : std::numeric_limits<double>::infinity();
  };
  if (has_imu_) t.imu_age = since(time());
  for (std::size_t i = 0; i < t.age.size(); ++i) t.age[i] = since(last_used_[i]);
  if (!was_started_) return t;
  t.imu_stopped = !running_;
  t.poses_frozen = poses_frozen_;
  t.poses_gated = poses_gated_;
  t.poses_mistimed = poses_mistimed_;
  for (const detail::GateMonitor<Scalar>& gate : gates_)
    t.unconfirmed = t.unconfirmed || !gate.is_confirmed();
  typename ErrorStateFilter<Scalar>::Covariance p = filter_.covariance();
  if (finds_imu()) detail::move_to_body(p, filter_.state().orientation, rate(), imu_position());
  detail::predict_errors(p, std::min(since(filter_time()), 1e3), settings_.imu_noise, t);
  detail::judge(settings_.trust, has_just_started(), t);
  return t;
}

template <typename Scalar>
void Ekf<Scalar>::reset() noexcept {
  has_imu_ = has_pose_ = running_ = was_started_ = false;
  poses_frozen_ = poses_gated_ = poses_mistimed_ = bridged_ = false;
  behind_ = rates_ = confirmed_ = 0;
  pose_time_ = received_ = last_position_ = stopped_at_ = behind_time_ = behind_since_ = 0.0;
  nis_ = Scalar(0);
  counts_ = {};
  given_up_at_ = -std::numeric_limits<double>::infinity();
  last_used_.fill(-std::numeric_limits<double>::infinity());
  history_.begin({});
  queue_.clear();
  repetitions_ = {};
  stamps_ = {};
  for (detail::GateMonitor<Scalar>& gate : gates_) gate = {};
  angular_acceleration_.setZero();
  InertialState<Scalar> x;
  detail::set_marker_frame(x, settings_);
  x.gyro_bias = settings_.gyro_bias.template cast<Scalar>();
  x.accelerometer_bias = settings_.accelerometer_bias.template cast<Scalar>();
  filter_.reset(x, ErrorStateFilter<Scalar>::Covariance::Zero());
  ahead_ = x;
}

}  // namespace tilt_ropter
