// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <type_traits>

/// External wrench from motion and applied wrench (paper, Sec. External Wrench Estimation,
/// Eq. wrench_estimation; after Tomić, Ott & Haddadin 2017).
namespace tilt_ropter {

/// Vectors have one entry per body axis. A larger bandwidth gives a faster but noisier estimate.
/// Dead band and limit change the result of external(), not the filter.
struct WrenchObserverSettings {
  Eigen::Vector3d force_bandwidth{15.0, 15.0, 15.0};           ///< K_f, force bandwidth [1/s]
  Eigen::Vector3d torque_bandwidth{15.0, 15.0, 15.0};          ///< K_m, torque bandwidth [1/s]
  Eigen::Vector3d force_dead_band = Eigen::Vector3d::Zero();   ///< subtracted from the size [N]
  Eigen::Vector3d torque_dead_band = Eigen::Vector3d::Zero();  ///< subtracted from the size [N m]
  /// Largest magnitude [N]. Infinite: three times the weight, which only an impact exceeds.
  Eigen::Vector3d force_limit = Eigen::Vector3d::Constant(std::numeric_limits<double>::infinity());
  /// Largest magnitude [N m]. Infinite: three times the weight at one metre.
  Eigen::Vector3d torque_limit = Eigen::Vector3d::Constant(std::numeric_limits<double>::infinity());
  double max_gap = 0.1;  ///< longest time between samples without a restart [s]
  static constexpr double min_calibration_time = 1.0;  ///< shortest valid calibration [s]
  /// Largest standard deviations of a calibration's blocks [N], [N m].
  static constexpr double max_force_stddev = 0.5, max_torque_stddev = 0.05;
};

/// Settings with one bandwidth [1/s] for force and torque in all axes. The default of 15 keeps the
/// time constant within 10 % in a loop of 50 Hz. A loop of 100 Hz with an IMU of 1 kHz works better
/// with 20 (measured: examples/missions/README.md, "Bandwidth of the wrench observer").
[[nodiscard]] inline WrenchObserverSettings observer_settings(double bandwidth) {
  WrenchObserverSettings settings;
  settings.force_bandwidth.setConstant(bandwidth);
  settings.torque_bandwidth.setConstant(bandwidth);
  return settings;
}

inline void validate(const WrenchObserverSettings& s) {
  require_positive("WrenchObserverSettings.force_bandwidth [1/s]", s.force_bandwidth);
  require_positive("WrenchObserverSettings.torque_bandwidth [1/s]", s.torque_bandwidth);
  require_non_negative("WrenchObserverSettings.force_dead_band [N]", s.force_dead_band);
  require_non_negative("WrenchObserverSettings.torque_dead_band [N m]", s.torque_dead_band);
  require_positive_or_infinite("WrenchObserverSettings.force_limit [N]", s.force_limit);
  require_positive_or_infinite("WrenchObserverSettings.torque_limit [N m]", s.torque_limit);
  require_positive("WrenchObserverSettings.max_gap [s]", s.max_gap);
}

/// Result of processing a sample.
enum class ObserverStatus {
  updated,
  started,  ///< first sample: the momentum is now known, the estimate is unchanged
  gap,      ///< time jumped by more than max_gap: the observer restarts and keeps the estimate
  rejected  ///< not finite, above 1e6, or time did not advance: nothing was changed
};

[[nodiscard]] constexpr const char* to_string(ObserverStatus status) noexcept {
  return detail::name_in({"updated", "started", "gap", "rejected"}, status);
}

/// Reliability of the estimate: the first of these values that applies.
enum class WrenchTrust {
  not_started,  ///< no sample yet
  stale,        ///< no valid sample within max_gap
  settling,     ///< more than 5 % of the initial estimate may remain (time < 3 / K)
  limited,      ///< settled, but clamped to a limit
  trusted
};

[[nodiscard]] constexpr const char* to_string(WrenchTrust status) noexcept {
  return detail::name_in({"not_started", "stale", "settling", "limited", "trusted"}, status);
}

/// What the observer knows after a sample. The sums grow with time: the mean over any stretch of
/// time, such as the tick of a loop slower than the IMU, is a difference of two values, see
/// means_between(). All wrenches are at the CoM, in the body frame [N; N m].
template <typename Scalar>
struct ObservedWrench {
  /// In single precision, differences of long sums would lose their digits.
  using Sum = Wrench<std::conditional_t<std::is_same_v<Scalar, float>, double, Scalar>>;

  ObserverStatus status = ObserverStatus::rejected;  ///< of the sample of this value
  WrenchTrust trust = WrenchTrust::not_started;      ///< reliability of `external` at `time`
  double time = 0.0;  ///< of the last sample that was not rejected [s]
  /// The estimate: filtered, minus the dead band, within the limits.
  Wrench<Scalar> external;
  /// From the last sample alone, without filter, dead band and limits, with all its noise. The
  /// torque needs two samples and is zero after the first one.
  Wrench<Scalar> raw;
  /// Argument of update() with the last sample; nothing for another source of external wrenches.
  std::optional<Wrench<Scalar>> applied;
  Sum external_sum, raw_sum;  ///< integrals over the intervals of all samples [N s; N m s]
  double duration = 0.0;      ///< sum of these intervals [s]
  /// Bandwidths of the filter of `external` [1/s].
  Eigen::Vector3d force_bandwidth =
      Eigen::Vector3d::Constant(std::numeric_limits<double>::infinity());
  Eigen::Vector3d torque_bandwidth = force_bandwidth;

  /// Adds `raw` and `external` for an interval of `dt` [s].
  void add_to_sums(double dt) noexcept {
    using Number = typename decltype(Sum::force)::Scalar;
    const Number part(dt);
    external_sum.force += part * external.force.template cast<Number>();
    external_sum.torque += part * external.torque.template cast<Number>();
    raw_sum.force += part * raw.force.template cast<Number>();
    raw_sum.torque += part * raw.torque.template cast<Number>();
    duration += dt;
  }
};
using ObservedWrenchd = ObservedWrench<double>;  ///< in double precision

/// Means of ObservedWrench::external and ObservedWrench::raw over the samples between two values.
template <typename Sum>
struct WrenchMeans {
  Sum external, raw;
};

/// Returns the means between two values of one observer, at the CoM, in the body frame [N; N m];
/// nothing without a sample between them. Vibration is aliased in a sample, and cancels in a mean.
template <typename Scalar>
[[nodiscard]] auto means_between(const ObservedWrench<Scalar>& before,
                                 const ObservedWrench<Scalar>& now) noexcept {
  using Sum = typename ObservedWrench<Scalar>::Sum;
  const double duration = now.duration - before.duration;
  const auto mean = [&](const Sum& first, const Sum& last) {
    return Sum{(last.force - first.force) / duration, (last.torque - first.torque) / duration};
  };
  std::optional<WrenchMeans<Sum>> means;
  if (duration > 0.0)
    means.emplace(WrenchMeans<Sum>{mean(before.external_sum, now.external_sum),
                                   mean(before.raw_sum, now.raw_sum)});
  return means;
}

/// The value after `last` for an external wrench from another source, such as a force sensor,
/// measured at `time` [s] without a filter. Rejects what WrenchObserver::update() rejects, and has
/// no means over more than a second, or if time goes back.
[[nodiscard]] inline ObservedWrenchd unfiltered_wrench(const ObservedWrenchd& last, double time,
                                                       const Wrenchd& external) noexcept {
  ObservedWrenchd next = last;
  next.status = ObserverStatus::rejected;
  if (!std::isfinite(time) || !(external.force.norm() <= 1e6) || !(external.torque.norm() <= 1e6))
    return next;
  const double dt = time - last.time;
  const bool follows = last.trust != WrenchTrust::not_started && dt > 0.0 && dt <= 1.0;
  next.status = follows ? ObserverStatus::updated : ObserverStatus::started;
  next.trust = WrenchTrust::trusted;
  next.time = time;
  next.external = next.raw = external;
  next.applied.reset();
  if (follows) next.add_to_sums(dt);
  return next;
}

/// Result of a calibration.
enum class CalibrationStatus {
  calibrated,
  not_begun,
  too_short,  ///< shorter than min_calibration_time
  moved,      ///< a standard deviation is above its limit: not at rest
  rejected,   ///< a number is not finite or exceeds 1e6
  // The offset would exceed half the weight. The measured specific force
  in_g,             ///< is right in units of 9.81 m/s^2
  without_gravity,  ///< is near zero
  reversed,         ///< points the wrong way, as in forward-right-down axes
  along_x,          ///< is right, but along body x instead
  along_y,          ///< is right, but along body y instead
  along_z,          ///< is right, but along body z instead
  implausible       ///< or the torque contradicts the known wrench in another way
};

[[nodiscard]] constexpr const char* to_string(CalibrationStatus status) noexcept {
  return detail::name_in(
      {"calibrated", "not_begun", "too_short", "moved", "rejected", "in_g", "without_gravity",
       "reversed", "along_x", "along_y", "along_z", "implausible"},
      status);
}

/// True if the IMU contradicts the known wrench by more than an offset: do not fly with it.
[[nodiscard]] constexpr bool contradicts_weight(CalibrationStatus status) noexcept {
  return status >= CalibrationStatus::in_g;
}

/// Compares a `measured` mean specific force with the `expected` one, at rest or in hover, both in
/// the body frame [m/s^2]. Returns `calibrated` up to an error of half of gravity, which an offset
/// or a wrong mass may explain; otherwise a status that contradicts_weight().
template <typename Scalar>
[[nodiscard]] CalibrationStatus check_specific_force(const Vector3<Scalar>& measured,
                                                     const Vector3<Scalar>& expected) noexcept {
  const Scalar most = Scalar(gravity / 2.0);
  if ((measured - expected).norm() <= most) return CalibrationStatus::calibrated;
  if ((measured * Scalar(gravity) - expected).norm() <= most) return CalibrationStatus::in_g;
  if (measured.norm() <= most / Scalar(2)) return CalibrationStatus::without_gravity;
  if ((measured + expected).norm() <= most) return CalibrationStatus::reversed;
  using std::abs;
  Eigen::Index axis = 0;
  const Scalar along = measured.cwiseAbs().maxCoeff(&axis);
  constexpr CalibrationStatus axes[] = {CalibrationStatus::along_x, CalibrationStatus::along_y,
                                        CalibrationStatus::along_z};
  const bool is_along = abs(along - expected.norm()) <= most &&
                        (measured - measured(axis) * Vector3<Scalar>::Unit(axis)).norm() <= most;
  return is_along ? axes[axis] : CalibrationStatus::implausible;
}

/// Observes the external wrench: force from specific force, torque from angular momentum. Each axis
/// is a first-order filter of the true external wrench with bandwidth K, discretised exactly. If
/// the wrench is constant between samples, the estimate at the samples equals the estimate of the
/// continuous filter for any dt * K. Over a gap neither the external nor the applied wrench was
/// constant, so nothing is estimated there.
///
/// A calibration at rest, where the external wrench is known, measures the offset of the raw
/// residual:
///
///     observer.begin_calibration();  // from now on the vehicle stands on the ground, rotors off
///     ...                            // update() as ever, for a second or more
///     observer.end_calibration({Eigen::Vector3d(0, 0, mass * gravity), Eigen::Vector3d::Zero()});
///
/// In free hover the known wrench is zero. The offset is kept in the body frame. There the offset
/// of an accelerometer bias is constant, and the offset of a shifted CoM is constant while the
/// thrust is constant. The offset of a wrong mass is not constant: it is (believed / true - 1)
/// times the applied force. It rotates in the body frame when the vehicle leans, and it vanishes
/// with the rotors off. A calibration in hover is therefore valid only near that attitude. It also
/// removes the mass error from the estimate, so a controller can no longer compensate it. A
/// calibration on the ground, with the believed weight as the known force, keeps the mass error in
/// the estimate.
///
/// Only the constructor throws. Nothing allocates.
template <typename Scalar>
class WrenchObserver {
 public:
  /// Throws std::invalid_argument if a parameter or setting is out of range.
  explicit WrenchObserver(const RigidBodyParameters& body,
                          const WrenchObserverSettings& settings = {});

  /// Processes one sample at `time` [s]. `sample` is from an IMU at the CoM, or converted to the
  /// CoM, minus the biases. `applied` is the wrench of the actuators since the last sample (from
  /// measured rotor speeds and modelled tilt angles; body frame). If the controller predicts
  /// another wrench, such as drag (OwnTerm), add it: otherwise it is also an external wrench.
  /// Returns what is known now; a sample that is rejected changes nothing but the status.
  [[nodiscard]] const ObservedWrench<Scalar>& update(double time,
                                                     const InertialSample<Scalar>& sample,
                                                     const Wrench<Scalar>& applied) noexcept;

  /// What was known after the last sample.
  [[nodiscard]] const ObservedWrench<Scalar>& observed() const noexcept { return observed_; }
  [[nodiscard]] const Wrench<Scalar>& external() const noexcept { return observed_.external; }

  /// State of the filter: external() without dead band and limits.
  [[nodiscard]] const Wrench<Scalar>& filtered() const noexcept { return filtered_; }

  /// Reliability of external() at `now` [s], in the clock of update().
  [[nodiscard]] WrenchTrust trust(double now) const noexcept {
    const bool is_old = !(std::abs(now - observed_.time) <= longest_gap());
    return started_ && is_old ? WrenchTrust::stale : observed_.trust;
  }

  /// Averages the raw residual from the next sample on. Restarts a calibration that has not ended.
  void begin_calibration() noexcept {
    average_ = {};
    calibrating_ = true;
  }

  /// Ends the calibration. If the status is calibrated, the offset becomes the average minus the
  /// `known` external wrench (body frame, at the CoM). An offset above half the weight, or above
  /// the weight at 0.1 m, is none: the status says which unit or axis would explain it.
  CalibrationStatus end_calibration(const Wrench<Scalar>& known = {}) noexcept;

  /// Offset that is subtracted from the raw residual, body frame [N; N m].
  [[nodiscard]] const Wrench<Scalar>& offset() const noexcept { return offset_; }

  /// Sets an offset from an earlier calibration. It acts from the next sample on, so the estimate
  /// does not jump. Ignored if not finite or above 1e6.
  void set_offset(const Wrench<Scalar>& offset) noexcept {
    if (!within(offset, 1e6)) return;
    offset_ = offset;
    settling_since_ = observed_.time;
    judge();
  }

  /// Clears estimate, applied wrench, time, momentum and a calibration that has not ended. Keeps
  /// offset and sums.
  void reset() noexcept {
    filtered_ = observed_.external = observed_.raw = {};
    observed_.applied.reset();
    started_ = calibrating_ = false;
    judge();
  }

 private:
  /// Mean and spread of a wrench in blocks of 0.1 s. Within a block the noise of a gyroscope
  /// cancels except at the ends, at any sample rate. A push of the vehicle does not cancel.
  struct BlockAverage {
    using Vector6 = Eigen::Matrix<Scalar, 6, 1>;

    void add(const Wrench<Scalar>& sample, const Wrench<Scalar>& applied, double dt) noexcept;

    [[nodiscard]] bool deviates_less(double force, double torque) const noexcept {
      bool all = true;
      for (int i = 0; i < 6; ++i) {
        const double most = i < 3 ? force : torque;
        all = all && squares(i) <= Scalar(most * most * time);
      }
      return all;
    }

    Vector6 mean = Vector6::Zero(), squares = Vector6::Zero(), block_sum = Vector6::Zero();
    Vector3<Scalar> applied_sum = Vector3<Scalar>::Zero();  ///< integral of the applied force
    double time = 0.0, block_time = 0.0;  ///< time of all blocks, of the current block [s]
  };

  /// max_gap with a tolerance for rounding errors of the stamps [s].
  [[nodiscard]] double longest_gap() const noexcept { return settings_.max_gap * (1.0 + 1e-6); }

  /// Returns false for NaN.
  static bool within(const Vector3<Scalar>& v, double bound) noexcept {
    using std::abs;
    return abs(v.x()) <= Scalar(bound) && abs(v.y()) <= Scalar(bound) &&
           abs(v.z()) <= Scalar(bound);
  }
  static bool within(const Wrench<Scalar>& w, double bound) noexcept {
    return within(w.force, bound) && within(w.torque, bound);
  }

  void shape() noexcept;

  // Sets the trust at the time of the last sample.
  void judge() noexcept {
    observed_.trust = !started_                                           ? WrenchTrust::not_started
                      : observed_.time - settling_since_ < settling_time_ ? WrenchTrust::settling
                      : limited_                                          ? WrenchTrust::limited
                                                                          : WrenchTrust::trusted;
  }

  WrenchObserverSettings settings_;
  Scalar mass_;
  Matrix3<Scalar> inertia_;
  ObservedWrench<Scalar> observed_;
  Wrench<Scalar> filtered_, offset_;
  Vector3<Scalar> angular_velocity_ = Vector3<Scalar>::Zero();
  double settling_since_ = 0.0, settling_time_;
  bool started_ = false, limited_ = false, calibrating_ = false;
  BlockAverage average_;
};
using WrenchObserverd = WrenchObserver<double>;  ///< in double precision

template <typename Scalar>
WrenchObserver<Scalar>::WrenchObserver(const RigidBodyParameters& body,
                                       const WrenchObserverSettings& settings)
    : settings_(validated(settings)) {
  validate(body);
  mass_ = Scalar(body.mass);
  inertia_ = body.inertia.cast<Scalar>();
  const double most = 3.0 * body.mass * gravity;
  settings_.force_limit = settings.force_limit.cwiseMin(most);
  settings_.torque_limit = settings.torque_limit.cwiseMin(most);
  settling_time_ =
      3.0 / std::min(settings.force_bandwidth.minCoeff(), settings.torque_bandwidth.minCoeff());
  observed_.force_bandwidth = settings.force_bandwidth;
  observed_.torque_bandwidth = settings.torque_bandwidth;
}

template <typename Scalar>
const ObservedWrench<Scalar>& WrenchObserver<Scalar>::update(
    double time, const InertialSample<Scalar>& sample, const Wrench<Scalar>& applied) noexcept {
  const Vector3<Scalar>&specific_force = sample.specific_force,
        &angular_velocity = sample.angular_velocity;
  observed_.status = ObserverStatus::rejected;
  if (!std::isfinite(time) || !within(specific_force, 1e6) || !within(angular_velocity, 1e6) ||
      !within(applied, 1e6))
    return observed_;
  const double dt = time - observed_.time;
  if (!started_ || std::abs(dt) > longest_gap()) {
    observed_.applied = applied;
    observed_.status = started_ ? ObserverStatus::gap : ObserverStatus::started;
    started_ = true;
    observed_.time = settling_since_ = time;
    angular_velocity_ = angular_velocity;
    observed_.raw.force = mass_ * specific_force - applied.force;
    observed_.raw.force -= offset_.force;
    observed_.raw.torque.setZero();
    judge();
    return observed_;
  }
  if (!(dt > 0.0)) return observed_;
  // The momentum at the last sample is the initial value of the torque's integral. The mean of
  // both rates makes the gyroscopic term second order in dt.
  const Vector3<Scalar> change = angular_velocity - angular_velocity_,
                        rate = angular_velocity_ + Scalar(0.5) * change,
                        momentum_rate = inertia_ * Vector3<Scalar>(Scalar(1.0 / dt) * change) +
                                        rate.cross(inertia_ * rate);
  const Wrench<Scalar> residual{mass_ * specific_force - applied.force,
                                momentum_rate - applied.torque};
  if (!within(residual, 1e30)) return observed_;  // dt was almost zero
  observed_.status = ObserverStatus::updated;
  observed_.time = time;
  observed_.applied = applied;
  angular_velocity_ = angular_velocity;
  observed_.raw = {residual.force - offset_.force, residual.torque - offset_.torque};
  const auto follow = [dt](Vector3<Scalar>& value, const Vector3<Scalar>& raw,
                           const Eigen::Vector3d& bandwidth) {
    for (int i = 0; i < 3; ++i)
      value(i) += Scalar(-std::expm1(-bandwidth(i) * dt)) * (raw(i) - value(i));
  };
  follow(filtered_.force, observed_.raw.force, settings_.force_bandwidth);
  follow(filtered_.torque, observed_.raw.torque, settings_.torque_bandwidth);
  shape();
  observed_.add_to_sums(dt);
  judge();
  if (calibrating_) average_.add(residual, applied, dt);
  return observed_;
}

template <typename Scalar>
CalibrationStatus WrenchObserver<Scalar>::end_calibration(const Wrench<Scalar>& known) noexcept {
  if (!calibrating_) return CalibrationStatus::not_begun;
  calibrating_ = false;
  if (average_.time < settings_.min_calibration_time) return CalibrationStatus::too_short;
  if (!average_.deviates_less(settings_.max_force_stddev, settings_.max_torque_stddev))
    return CalibrationStatus::moved;
  const Wrench<Scalar> offset{average_.mean.template head<3>() - known.force,
                              average_.mean.template tail<3>() - known.torque};
  if (!within(offset, 1e6) || !within(known, 1e6)) return CalibrationStatus::rejected;
  const Vector3<Scalar> expected =
      known.force + average_.applied_sum / Scalar(average_.time + average_.block_time);
  const CalibrationStatus status = check_specific_force(
      Vector3<Scalar>((offset.force + expected) / mass_), Vector3<Scalar>(expected / mass_));
  if (status != CalibrationStatus::calibrated) return status;
  constexpr double arm = 0.1;  // no centre of mass is further from where it is believed [m]
  if (!within(offset.torque, arm * gravity * double(mass_))) return CalibrationStatus::implausible;
  set_offset(offset);
  return status;
}

template <typename Scalar>
void WrenchObserver<Scalar>::BlockAverage::add(const Wrench<Scalar>& sample,
                                               const Wrench<Scalar>& applied, double dt) noexcept {
  applied_sum += Scalar(dt) * applied.force;
  for (int i = 0; i < 6; ++i)
    block_sum(i) += Scalar(dt) * (i < 3 ? sample.force(i) : sample.torque(i - 3));
  block_time += dt;
  if (block_time < 0.1) return;
  // Recursive update after D. H. D. West, "Updating mean and variance estimates", 1979.
  time += block_time;
  for (int i = 0; i < 6; ++i) {
    const Scalar block = block_sum(i) / Scalar(block_time), step = block - mean(i);
    mean(i) += Scalar(block_time / time) * step;
    squares(i) += Scalar(block_time) * step * (block - mean(i));
    block_sum(i) = Scalar(0);
  }
  block_time = 0.0;
}

template <typename Scalar>
void WrenchObserver<Scalar>::shape() noexcept {
  limited_ = false;
  const auto shaped = [this](const Vector3<Scalar>& filtered, const Eigen::Vector3d& dead_band,
                             const Eigen::Vector3d& limit) {
    Vector3<Scalar> cut;
    for (int i = 0; i < 3; ++i) {
      const Scalar& value = filtered(i);
      const Scalar band = static_cast<Scalar>(dead_band(i)), bound = static_cast<Scalar>(limit(i));
      const Scalar rest = value >= band    ? Scalar(value - band)
                          : value <= -band ? Scalar(value + band)
                                           : Scalar(0);
      const bool above = rest > bound, below = rest < -bound;
      cut(i) = above ? bound : below ? Scalar(-bound) : rest;
      limited_ = limited_ || above || below;
    }
    return cut;
  };
  observed_.external.force =
      shaped(filtered_.force, settings_.force_dead_band, settings_.force_limit);
  observed_.external.torque =
      shaped(filtered_.torque, settings_.torque_dead_band, settings_.torque_limit);
}

}  // namespace tilt_ropter
