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
  Eigen::Vector3d force_limit = Eigen::Vector3d::Constant(
      std::numeric_limits<double>::infinity());  ///< largest magnitude, may be infinite [N]
  Eigen::Vector3d torque_limit = Eigen::Vector3d::Constant(
      std::numeric_limits<double>::infinity());  ///< largest magnitude, may be infinite [N m]
  double max_gap = 0.1;  ///< longest time between samples without a restart [s]
  static constexpr double min_calibration_time = 1.0;  ///< shortest valid calibration [s]
  /// Largest standard deviation of a calibration's blocks [N].
  static constexpr double max_force_stddev = 0.5;
  /// Largest standard deviation of a calibration's blocks [N m].
  static constexpr double max_torque_stddev = 0.05;
};

/// Settings with one bandwidth [1/s] for force and torque in all axes. The default of 15 keeps the
/// time constant within 10 % in a loop of 50 Hz. A loop of 100 Hz with an IMU of 1 kHz works better
/// with 20 (measured: README, on the observer).
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
  /// Time jumped forward or back by more than max_gap. The observer restarts and keeps the
  /// estimate.
  gap,
  /// A number was not finite or above 1e6, which no valid sensor reports, or time did not advance.
  /// Nothing was changed.
  rejected
};

[[nodiscard]] constexpr const char* to_string(ObserverStatus status) noexcept {
  return detail::name_in({"updated", "started", "gap", "rejected"}, status);
}

/// Reliability of the estimate. If several reasons against it apply, the value is the first of them
/// in this order.
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

/// Result of a calibration.
enum class CalibrationStatus {
  calibrated,
  not_begun,
  too_short,  ///< shorter than min_calibration_time
  moved,      ///< a standard deviation is above its limit: not at rest
  rejected    ///< the offset would not be finite or would exceed 1e6
};

[[nodiscard]] constexpr const char* to_string(CalibrationStatus status) noexcept {
  return detail::name_in({"calibrated", "not_begun", "too_short", "moved", "rejected"}, status);
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
  /// measured rotor speeds and modelled tilt angles; body frame).
  ObserverStatus update(double time, const InertialSample<Scalar>& sample,
                        const Wrench<Scalar>& applied) noexcept;

  /// Estimate of the external wrench at the CoM in the body frame [N; N m]: filtered() minus the
  /// dead band, within the limits. transport() and wrench_in_world() convert it.
  [[nodiscard]] const Wrench<Scalar>& external() const noexcept { return external_; }

  /// For a loop slower than the IMU: mean of external() over all samples since the last call, or
  /// external() if there was no sample. The vibration of a rotor is aliased in a single sample.
  [[nodiscard]] Wrench<Scalar> take_external() noexcept {
    if (samples_ == 0) return external_;
    const Scalar count(static_cast<Scalar>(samples_));
    samples_ = 0;
    return {sum_.force / count, sum_.torque / count};
  }

  /// State of the filter: external() without dead band and limits.
  [[nodiscard]] const Wrench<Scalar>& filtered() const noexcept { return filtered_; }

  /// Force from the last sample, with all its noise, body frame [N]. Known from the first sample
  /// on.
  [[nodiscard]] const Vector3<Scalar>& unfiltered_force() const noexcept {
    return unfiltered_force_;
  }

  [[nodiscard]] const WrenchObserverSettings& settings() const noexcept { return settings_; }

  /// Reliability of external() at `now` [s], in the clock of update().
  [[nodiscard]] WrenchTrust trust(double now) const noexcept {
    if (!started_) return WrenchTrust::not_started;
    if (!(std::abs(now - time_) <= longest_gap())) return WrenchTrust::stale;
    if (time_ - settling_since_ < settling_time_) return WrenchTrust::settling;
    return limited_ ? WrenchTrust::limited : WrenchTrust::trusted;
  }

  /// Averages the raw residual from the next sample on. Restarts a calibration that has not ended.
  void begin_calibration() noexcept {
    average_ = {};
    calibrating_ = true;
  }

  /// Ends the calibration. If the status is calibrated, the offset becomes the average minus the
  /// `known` external wrench (body frame, at the CoM). Otherwise the offset is unchanged.
  CalibrationStatus end_calibration(const Wrench<Scalar>& known = {}) noexcept;

  /// Offset that is subtracted from the raw residual, body frame [N; N m].
  [[nodiscard]] const Wrench<Scalar>& offset() const noexcept { return offset_; }

  /// Sets an offset from an earlier calibration. It acts from the next sample on, so the estimate
  /// does not jump. Ignored if not finite or above 1e6.
  void set_offset(const Wrench<Scalar>& offset) noexcept {
    if (!within(offset, 1e6)) return;
    offset_ = offset;
    settling_since_ = time_;
  }

  /// Clears the estimate, the time, the momentum and a calibration that has not ended. Keeps the
  /// offset.
  void reset() noexcept {
    filtered_ = external_ = {};
    samples_ = 0;
    started_ = calibrating_ = false;
  }

 private:
  /// Mean and spread of a wrench in blocks of 0.1 s. Within a block the noise of a gyroscope
  /// cancels except at the ends, at any sample rate. A push of the vehicle does not cancel.
  struct BlockAverage {
    using Vector6 = Eigen::Matrix<Scalar, 6, 1>;

    void add(const Wrench<Scalar>& sample, double dt) noexcept;

    [[nodiscard]] bool deviates_less(double force, double torque) const noexcept {
      return squares.template head<3>().maxCoeff() <= Scalar(force * force * time) &&
             squares.template tail<3>().maxCoeff() <= Scalar(torque * torque * time);
    }

    Vector6 mean = Vector6::Zero(), squares = Vector6::Zero(), block_sum = Vector6::Zero();
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

  static Vector3<Scalar> gain(const Eigen::Vector3d& bandwidth, double dt) noexcept {
    const auto passed = [dt](double k) { return -std::expm1(-k * dt); };
    return bandwidth.unaryExpr(passed).template cast<Scalar>();
  }

  void shape() noexcept;

  WrenchObserverSettings settings_;
  Scalar mass_;
  Matrix3<Scalar> inertia_;
  Wrench<Scalar> filtered_, external_, offset_;
  Wrench<Scalar> sum_;  // sum of external_ over samples_ samples since take_external()
  int samples_ = 0;
  Vector3<Scalar> angular_velocity_ = Vector3<Scalar>::Zero();
  Vector3<Scalar> unfiltered_force_ = Vector3<Scalar>::Zero();
  double time_ = 0.0, settling_since_ = 0.0, settling_time_;
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
  settling_time_ =
      3.0 / std::min(settings.force_bandwidth.minCoeff(), settings.torque_bandwidth.minCoeff());
}

template <typename Scalar>
ObserverStatus WrenchObserver<Scalar>::update(double time, const InertialSample<Scalar>& sample,
                                              const Wrench<Scalar>& applied) noexcept {
  const Vector3<Scalar>&specific_force = sample.specific_force,
        &angular_velocity = sample.angular_velocity;
  if (!std::isfinite(time) || !within(specific_force, 1e6) || !within(angular_velocity, 1e6) ||
      !within(applied, 1e6))
    return ObserverStatus::rejected;
  const double dt = time - time_;
  if (!started_ || std::abs(dt) > longest_gap()) {
    const ObserverStatus status = started_ ? ObserverStatus::gap : ObserverStatus::started;
    started_ = true;
    time_ = settling_since_ = time;
    angular_velocity_ = angular_velocity;
    unfiltered_force_ = mass_ * specific_force - applied.force;
    return status;
  }
  if (!(dt > 0.0)) return ObserverStatus::rejected;
  // The momentum at the last sample is the initial value of the torque's integral. The mean of
  // both rates makes the gyroscopic term second order in dt.
  const Vector3<Scalar> rate = (angular_velocity + angular_velocity_) / Scalar(2);
  const Wrench<Scalar> residual{mass_ * specific_force - applied.force,
                                inertia_ * (angular_velocity - angular_velocity_) / Scalar(dt) -
                                    applied.torque + rate.cross(inertia_ * rate)};
  if (!within(residual, 1e30)) return ObserverStatus::rejected;  // dt was almost zero
  time_ = time;
  angular_velocity_ = angular_velocity;
  unfiltered_force_ = residual.force;
  filtered_.force += gain(settings_.force_bandwidth, dt)
                         .cwiseProduct(residual.force - offset_.force - filtered_.force);
  filtered_.torque += gain(settings_.torque_bandwidth, dt)
                          .cwiseProduct(residual.torque - offset_.torque - filtered_.torque);
  shape();
  constexpr int most = 1 << 20;  // bounds the sum if nobody takes the mean
  if (samples_ == 0 || samples_ == most) {
    sum_ = external_;
    samples_ = 1;
  } else {
    sum_.force += external_.force;
    sum_.torque += external_.torque;
    ++samples_;
  }
  if (calibrating_) average_.add(residual, dt);
  return ObserverStatus::updated;
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
  if (!within(offset, 1e6)) return CalibrationStatus::rejected;
  set_offset(offset);
  return CalibrationStatus::calibrated;
}

template <typename Scalar>
void WrenchObserver<Scalar>::BlockAverage::add(const Wrench<Scalar>& sample, double dt) noexcept {
  Vector6 packed;
  packed << sample.force, sample.torque;
  block_sum += Scalar(dt) * packed;
  block_time += dt;
  if (block_time < 0.1) return;
  // Recursive update after D. H. D. West, "Updating mean and variance estimates", 1979.
  time += block_time;
  const Vector6 block = block_sum / Scalar(block_time), step = block - mean;
  mean += Scalar(block_time / time) * step;
  squares += Scalar(block_time) * step.cwiseProduct(block - mean);
  block_sum.setZero();
  block_time = 0.0;
}

template <typename Scalar>
void WrenchObserver<Scalar>::shape() noexcept {
  limited_ = false;
  const auto shaped = [this](const Vector3<Scalar>& filtered, const Eigen::Vector3d& dead_band,
                             const Eigen::Vector3d& limit) {
    const Vector3<Scalar>&band = dead_band.cast<Scalar>(), &bound = limit.cast<Scalar>();
    const Vector3<Scalar> rest = filtered - filtered.cwiseMax(-band).cwiseMin(band);
    Vector3<Scalar> cut = rest.cwiseMax(-bound).cwiseMin(bound);
    limited_ = limited_ || cut != rest;
    return cut;
  };
  external_.force = shaped(filtered_.force, settings_.force_dead_band, settings_.force_limit);
  external_.torque = shaped(filtered_.torque, settings_.torque_dead_band, settings_.torque_limit);
}

}  // namespace tilt_ropter
