// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/delayed_filter.hpp>
#include <tilt_ropter/estimation/detail/ekf_settings.hpp>
#include <tilt_ropter/estimation/detail/ekf_start.hpp>
#include <tilt_ropter/estimation/detail/ekf_trust.hpp>
#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/estimation/detail/measurement_faults.hpp>
#include <tilt_ropter/estimation/detail/measurement_guard.hpp>
#include <tilt_ropter/estimation/detail/measurement_model.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <type_traits>

/// State of the vehicle from IMU, motion capture and other sensors (paper, Sec. Control).
namespace tilt_ropter {

/// Error-state Kalman filter for delayed measurements. The filter is at the time of the last
/// measurement used, so that a delayed measurement is compared with the state at its own time. From
/// there the state is propagated through the IMU samples. The constructor allocates all memory.
/// Afterwards nothing throws or allocates. The initial orientation may be arbitrary.
///
/// Faulty poses do not move the estimate (see detail::MeasurementGuard, which decides):
///
/// - A pose, position or velocity that repeats an earlier one bit for bit, while the IMU's samples
///   change, is not used.
/// - A pose above the gate is not used. If poses move like the IMU but elsewhere for restart_time
///   (the origin of motion capture was moved), the filter restarts there and keeps tilt, velocity
///   and biases. If they move smoothly along a path of at least 0.3 m, it restarts after
///   full_restart_time and keeps only the marker frame. The second time in a row it keeps nothing,
///   and takes back the last step of the poses' clock if they are then in time. on_measurement()
///   has the first kind of restart only, with the orientation of the estimate.
/// - If the orientation of the poses steps while their positions go on, motion capture has defined
///   the rigid body again. Their positions alone are used until the step is known, 0.25 s or
///   longer, and later orientations are corrected by it.
/// - If the stamps of the poses are late or early by a constant time, motion shows it, and the
///   stamps are corrected by it (EstimateTrust::latency). A correction after which poses are gated,
///   or that leaves the NIS large, is taken back within a second.
/// - Jitter of the stamps is measured and is part of the poses' noise.
/// - If the clock of the poses steps, their stamps are corrected by the step.
///
/// trust() reports the reliability of the estimate.
template <typename Scalar>
class Ekf {
 public:
  static constexpr std::size_t max_waiting = 32;  ///< stored measurements ahead of the IMU

  /// Throws std::invalid_argument if a setting is out of range.
  explicit Ekf(const EkfSettings& settings = {});

  /// Processes an IMU sample taken at `time` [s]; all times are in this clock. If it is set back,
  /// five samples at most are late. The estimate restarts if the next pose is elsewhere.
  EkfStatus on_imu(double time, const InertialSample<Scalar>& value) noexcept;

  /// Processes a pose of the marker frame taken at `time` [s] in motion capture's clock.
  /// Poses whose stamps are all off by the same time correct the clock, if it is below 1e10 s.
  EkfStatus on_pose(double time, const MarkerPose<Scalar>& pose) noexcept;

  /// Processes any other measurement, taken at `time` [s] in the IMU's clock, once the filter has
  /// started. `measurement` is plain data of at most 512 bytes: a measurement of
  /// measurement_models.hpp, or a callable that takes an InertialMotion<Scalar> and returns a
  /// Linearised. A callable is not checked for repetitions. If it does not declare `static
  /// constexpr MeasurementKind kind`, the filter does not restart at it, and trust() does not count
  /// it as a position. See EkfSettings::fusion_delay for sensors with different delays.
  template <typename Measurement>
  EkfStatus on_measurement(double time, const Measurement& measurement) noexcept;

  /// Starts, or restarts, at a state known by other means than a pose, at time(). Returns false and
  /// changes nothing before the first IMU sample or if a number is not finite or not positive.
  /// The heading may be wrong by any angle: compass, or positions and velocities of a receiver in
  /// motion, correct it (detail::HeadingFromMotion), by a restart.
  bool start(const BodyState<Scalar>& body, const StartStddev& stddev) noexcept;

  /// False before the first pose or start(), and after a gap of the IMU until a measurement is
  /// used. Do not use state() for control then.
  [[nodiscard]] bool running() const noexcept { return filter_.running(); }

  /// Reliability of the estimate at `now` [s], in the IMU's clock.
  [[nodiscard]] EstimateTrust trust(double now) const noexcept;

  /// Time of the newest IMU sample [s]; zero before the first sample.
  [[nodiscard]] double time() const noexcept { return filter_.newest().time; }

  /// Pose and twist of the body (of the CoM) at time().
  [[nodiscard]] BodyState<Scalar> state() const noexcept {
    return body_of(filter_.newest().value.angular_velocity - filter_.ahead().gyro_bias);
  }

  /// Same as state() for a loop slower than the IMU. The angular velocity is the mean of all
  /// samples since the last call, half a tick old: vibration of the rotors is aliased in a sample.
  [[nodiscard]] BodyState<Scalar> take_state() noexcept {
    BodyState<Scalar> taken =
        rates_ > 0 ? body_of(rate_sum_ / Scalar(rates_) - filter_.ahead().gyro_bias) : state();
    rates_ = 0;
    return taken;
  }

  /// Newest sample without the biases, in the body frame at the CoM, for WrenchObserver. If the IMU
  /// is not at the CoM, this uses the difference of the last two samples of the gyroscope.
  [[nodiscard]] InertialSample<Scalar> corrected(
      const InertialSample<Scalar>& sample) const noexcept {
    const InertialSample<Scalar> turned = to_body(sample);
    const Vector3<Scalar> rate = turned.angular_velocity - filter_.ahead().gyro_bias;
    Vector3<Scalar> force = turned.specific_force - filter_.ahead().accelerometer_bias;
    if (has_lever()) {
      const Vector3<Scalar> place = imu_position();
      force -= angular_acceleration_.cross(place) + rate.cross(rate.cross(place));
    }
    return {rate, force};
  }

  /// Position of the IMU in the body frame [m], estimated if imu_position_stddev is above zero.
  [[nodiscard]] Vector3<Scalar> imu_position() const noexcept {
    if (!finds_imu()) return settings_.imu_position.template cast<Scalar>();
    return settings_.marker_position.template cast<Scalar>() - filter().state().marker_position;
  }

  /// Filter at filter_time(): state of the IMU with biases and marker frame, and covariance. The
  /// marker's position is relative to the IMU, in body axes.
  [[nodiscard]] const ErrorStateFilter<Scalar>& filter() const noexcept { return filter_.filter(); }
  /// Time of the last measurement used [s]. If none arrive, at most max_delay behind time().
  [[nodiscard]] double filter_time() const noexcept { return filter_.time(); }
  /// NIS r' S^-1 r of the last measurement that was compared, used or not.
  [[nodiscard]] Scalar nis() const noexcept { return guard_.nis(); }
  [[nodiscard]] const EkfCounts& counts() const noexcept { return guard_.counts(); }
  /// Step of the poses' clock that is added to their stamps [s].
  [[nodiscard]] double clock_step() const noexcept { return guard_.stamps().clock_step(); }

  /// Restores the state after construction.
  void reset() noexcept;

 private:
  using Action = detail::Action;
  using ArrivedPose = detail::ArrivedPose<Scalar>;
  friend class detail::StoredMeasurement<Ekf>;

  [[nodiscard]] bool finds_imu() const noexcept { return settings_.imu_position_stddev > 0.0; }
  [[nodiscard]] bool has_lever() const noexcept {
    return settings_.imu_position != Eigen::Vector3d::Zero() || finds_imu();
  }
  [[nodiscard]] InertialSample<Scalar> to_body(const InertialSample<Scalar>& s) const noexcept {
    return {imu_rotation_ * s.angular_velocity, imu_rotation_ * s.specific_force};
  }
  [[nodiscard]] BodyState<Scalar> body_of(const Vector3<Scalar>& rate) const noexcept {
    return body_at(filter_.ahead(), rate);
  }
  [[nodiscard]] BodyState<Scalar> body_at(const InertialState<Scalar>& x,
                                          const Vector3<Scalar>& rate) const noexcept {
    BodyState<Scalar> body{x.position, x.velocity, x.orientation, rate};
    if (!has_lever()) return body;
    const Vector3<Scalar> place = imu_position();
    body.position -= x.orientation * place;
    body.velocity -= x.orientation * rate.cross(place);
    return body;
  }

  /// Restarts with another heading if motion shows that it is wrong since start(). `value`: a
  /// position or velocity of the IMU, with its standard deviation.
  bool find_heading(bool is_position, const Vector3<Scalar>& value, double stddev) noexcept;

  /// Uses, stores or drops a measurement that arrives.
  template <typename Measurement>
  EkfStatus receive(double time, const Measurement& measurement,
                    const detail::Verdict& verdict) noexcept;
  /// Compares a measurement with the state at its time, and uses or drops it.
  EkfStatus apply(double time, const ArrivedPose& arrived) noexcept;
  template <typename Measurement>
  EkfStatus apply(double time, const Measurement& measurement) noexcept;

  EkfSettings settings_;
  Matrix3<Scalar> imu_rotation_;
  detail::DelayedFilter<Scalar> filter_;
  detail::MeasurementGuard<Scalar> guard_;
  detail::MeasurementQueue<Ekf, max_waiting> queue_;
  Vector3<Scalar> rate_sum_ = Vector3<Scalar>::Zero();  ///< sum of rates since take_state()
  int rates_ = 0;
  Vector3<Scalar> angular_acceleration_ = Vector3<Scalar>::Zero();
};
using Ekfd = Ekf<double>;  ///< in double precision

template <typename Scalar>
Ekf<Scalar>::Ekf(const EkfSettings& settings)
    : settings_(validated(settings)),
      imu_rotation_(settings.imu_orientation.toRotationMatrix().template cast<Scalar>()),
      filter_(settings.imu_noise, settings.pose_noise,
              static_cast<std::size_t>(settings.max_delay * settings.max_imu_rate) + 16),
      guard_(settings) {
  reset();
}

template <typename Scalar>
void Ekf<Scalar>::reset() noexcept {
  InertialState<Scalar> x;
  detail::set_marker_frame(x, settings_);
  x.gyro_bias = settings_.gyro_bias.template cast<Scalar>();
  x.accelerometer_bias = settings_.accelerometer_bias.template cast<Scalar>();
  filter_.reset(x);
  guard_ = detail::MeasurementGuard<Scalar>(settings_);
  queue_.clear();
  rates_ = 0;
  angular_acceleration_.setZero();
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::on_imu(double time, const InertialSample<Scalar>& value) noexcept {
  const detail::Verdict verdict = guard_.on_imu(time, value, filter_);
  if (verdict.action == Action::drop) return verdict.status;
  const Timed<InertialSample<Scalar>> sample{time, to_body(value)}, newest = filter_.newest();
  const bool restarts = verdict.action == Action::restart;
  constexpr int most = 1 << 20;  // bounds the sum if nobody takes the mean
  rates_ = restarts || rates_ == most ? 1 : rates_ + 1;
  rate_sum_ = rates_ == 1 ? sample.value.angular_velocity
                          : Vector3<Scalar>(rate_sum_ + sample.value.angular_velocity);
  if (restarts) {
    angular_acceleration_.setZero();
    if (verdict.clock_changed) {
      queue_.clear();
      filter_.begin_in_new_clock(sample, guard_.late_since(), settings_.max_imu_gap);
    } else {
      filter_.begin_after_gap(sample);
    }
    return running() ? EkfStatus::updated : verdict.status;
  }
  angular_acceleration_ =
      (sample.value.angular_velocity - newest.value.angular_velocity) / Scalar(time - newest.time);
  filter_.push(sample);
  filter_.catch_up(time - settings_.max_delay);
  while (queue_.has_until(time - settings_.fusion_delay)) queue_.pop().apply(*this);
  return EkfStatus::updated;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::on_pose(double time, const MarkerPose<Scalar>& pose) noexcept {
  const double stamp = time + settings_.clock_offset + clock_step() - guard_.stamps().latency();
  return receive(stamp,
                 ArrivedPose{{pose.position, pose.orientation.normalized()}, this->time() - stamp},
                 guard_.on_pose(stamp, pose, queue_.has_room(), filter_));
}

template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::on_measurement(double time, const Measurement& measurement) noexcept {
  const EkfStatus status = receive(
      time, measurement, guard_.on_measurement(time, measurement, queue_.has_room(), filter_));
  if (status == EkfStatus::early && filter_.has_imu())
    guard_.on_mistimed(detail::kind_of<Measurement>);
  return status;
}

template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::receive(double time, const Measurement& measurement,
                               const detail::Verdict& verdict) noexcept {
  if (verdict.action == Action::use) return apply(time, measurement);
  if (verdict.action == Action::wait) queue_.push(time, measurement);
  if (verdict.clock_changed) queue_.clear();
  return verdict.status;
}

template <typename Scalar>
EkfStatus Ekf<Scalar>::apply(double time, const ArrivedPose& arrived) noexcept {
  filter_.catch_up(time);
  const MarkerPose<Scalar> pose = guard_.turn().undone(arrived.pose);
  LinearisedPose<Scalar> at = filter().linearise(pose);
  at.noise.template head<3>() *= Scalar(guard_.continuity().position_factor());
  at.noise.template tail<3>() *= Scalar(guard_.continuity().orientation_factor());
  const Vector3<Scalar>& velocity = filter().state().velocity;
  // Bounded, because a wrong velocity must not make every pose likely.
  constexpr double most = 0.1;  // effect of the jitter [m]
  const double jitter = std::min(guard_.stamps().stddev(),
                                 most / std::max(static_cast<double>(velocity.norm()), 1.0));
  at.set_motion(velocity, filter_.mean_rate(), Scalar(jitter));
  const auto innovation = filter().innovation_of(at);
  const detail::Verdict verdict = guard_.judge(time, {pose, arrived.lag}, innovation, filter_);
  if (verdict.clock_changed) queue_.clear();
  if (verdict.action == Action::drop) return verdict.status;
  filter_.change([&](ErrorStateFilter<Scalar>& f) {
    if (verdict.action == Action::restart)
      return detail::start_at_pose(f, guard_.turn().undone(arrived.pose), verdict.known, settings_);
    if (verdict.action != Action::use) f.widen(verdict.action == Action::widen_gyro);
    if (verdict.position_only) at.ignore_orientation();
    const bool is_same = verdict.action == Action::use && !verdict.position_only;
    f.update(is_same ? innovation : f.innovation_of(at), at);
    if (verdict.latency != 0.0) f.correct_latency(Scalar(verdict.latency));
  });
  filter_.heading().end();
  filter_.set_running();
  guard_.on_used(verdict, filter().state().position);
  // The stamp of this pose was that of the wrong clock: the next one starts the filter.
  if (verdict.clock_changed) filter_.stop();
  return verdict.status;
}

template <typename Scalar>
template <typename Measurement>
EkfStatus Ekf<Scalar>::apply(double time, const Measurement& measurement) noexcept {
  constexpr MeasurementKind kind = detail::kind_of<Measurement>;
  constexpr int part =
      kind == MeasurementKind::velocity ? InertialIndex::velocity : InertialIndex::position;
  if (!running() && (time < filter_time() || !filter_.resume())) return EkfStatus::early;
  if (time < filter_time()) {
    guard_.on_mistimed(kind);
    return EkfStatus::late;
  }
  filter_.catch_up(time);
  const InertialMotion<Scalar> motion{filter().state(), filter_.rate(), imu_position(),
                                      filter().covariance().template block<3, 3>(
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
  if (!at.valid || !at.is_usable()) return EkfStatus::rejected;
  if constexpr (kind == MeasurementKind::heading) at.noise *= Scalar(guard_.heading().factor());
  if constexpr (decltype(at)::rows == 3 &&
                (kind == MeasurementKind::position || kind == MeasurementKind::velocity)) {
    const InertialState<Scalar>& x = filter().state();
    const bool in_world = at.by(part).isIdentity();
    if (in_world && find_heading(part == InertialIndex::position,
                                 (part == InertialIndex::position ? x.position : x.velocity) +
                                     detail::displacement<Scalar>(part, at),
                                 std::sqrt(static_cast<double>(at.noise.diagonal().maxCoeff()))))
      return EkfStatus::restarted;
  }
  const auto innovation = filter().innovation_of(at);
  const detail::Verdict verdict = guard_.judge(kind, part, at, innovation, filter_);
  if (verdict.action == Action::drop) return verdict.status;
  filter_.change([&](ErrorStateFilter<Scalar>& f) {
    if (verdict.action == Action::restart) return detail::shift(f, part, at);
    if constexpr (decltype(at)::rows >= 3)
      if (verdict.action == Action::start_over) return detail::start_at_position(f, at, settings_);
    if (verdict.action == Action::use) return (void)f.update(innovation, at);
    double off = 0.0;
    if constexpr (decltype(at)::rows >= 3)
      off = static_cast<double>(detail::displacement<Scalar>(part, at).norm());
    if (verdict.action == Action::forget_heading)
      detail::forget_heading(f, off);
    else
      f.widen(verdict.action == Action::widen_gyro, off);
    f.update(f.innovation_of(at), at);
  });
  return verdict.status;
}

template <typename Scalar>
bool Ekf<Scalar>::find_heading(bool is_position, const Vector3<Scalar>& value,
                               double stddev) noexcept {
  detail::HeadingFromMotion<Scalar>& heading = filter_.heading();
  const InertialState<Scalar>& x = filter().state();
  if (!heading.finds_error(is_position, value, stddev, x)) {
    if (heading.is_stale()) heading.begin(x);
    return false;
  }
  filter_.change([&](ErrorStateFilter<Scalar>& f) {
    f.reset(heading.state(x), f.covariance());
    constexpr double tilt = 0.1;  // [rad]
    detail::start_at_state(f, body_at(f.state(), filter_.rate()),
                           {1.0, 1.0, std::max(tilt, heading.stddev())}, imu_position(),
                           filter_.started(), settings_);
  });
  heading.begin(filter().state());
  guard_.on_heading(filter_time());
  return true;
}

template <typename Scalar>
bool Ekf<Scalar>::start(const BodyState<Scalar>& body, const StartStddev& stddev) noexcept {
  if (!filter_.has_imu() || !is_finite(body) || !(body.orientation.norm() > Scalar(0.1)) ||
      !(stddev.position > 0.0 && stddev.velocity > 0.0 && stddev.orientation > 0.0) ||
      !(stddev.position + stddev.velocity + stddev.orientation < 1e6))
    return false;
  filter_.catch_up(time());
  filter_.change([&](ErrorStateFilter<Scalar>& f) {
    detail::start_at_state(f, body, stddev, imu_position(), filter_.started(), settings_);
  });
  filter_.set_running();
  filter_.heading().begin(filter().state());
  guard_.on_start(filter_time());
  return true;
}

template <typename Scalar>
EstimateTrust Ekf<Scalar>::trust(double now) const noexcept {
  EstimateTrust t = guard_.report(now, filter_.started());
  if (filter_.has_imu()) t.imu_age = detail::age(now, time());
  if (!filter_.started()) return t;
  t.imu_stopped = !running();
  t.imu_contradicted = filter().is_wider();
  t.inconsistent |= filter().is_much_wider();
  typename ErrorStateFilter<Scalar>::Covariance p = filter().covariance();
  if (finds_imu())
    detail::move_to_body(p, filter().state().orientation, filter_.rate(), imu_position());
  detail::predict_errors(p, std::min(detail::age(now, filter_time()), 1e3), settings_.imu_noise, t);
  t.implausible_bias = detail::has_implausible_bias(filter().state(), settings_) ||
                       !detail::has_plausible_marker_frame(filter().state(), settings_);
  detail::judge(settings_.trust, guard_.has_just_started(), t);
  return t;
}

}  // namespace tilt_ropter
