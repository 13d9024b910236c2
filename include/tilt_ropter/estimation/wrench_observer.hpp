// SPDX-License-Identifier: BSD-3-Clause
#pragma once

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

/// Vectors are by body axis. Dead band and limit shape what external() returns, not the filter.
struct WrenchObserverSettings {
  Eigen::Vector3d force_bandwidth{15.0, 15.0, 15.0};           ///< K_f [1/s]
  Eigen::Vector3d torque_bandwidth{15.0, 15.0, 15.0};          ///< K_m [1/s]
  Eigen::Vector3d force_dead_band = Eigen::Vector3d::Zero();   ///< taken off the size [N]
  Eigen::Vector3d torque_dead_band = Eigen::Vector3d::Zero();  ///< taken off the size [N m]
  Eigen::Vector3d force_limit = Eigen::Vector3d::Constant(
      std::numeric_limits<double>::infinity());  ///< of the size, may be infinite [N]
  Eigen::Vector3d torque_limit = Eigen::Vector3d::Constant(
      std::numeric_limits<double>::infinity());  ///< of the size, may be infinite [N m]
  double max_gap = 0.1;                          ///< between samples that belong together [s]
  double min_calibration_time = 1.0;             ///< [s]
  double max_force_deviation = 0.5;    ///< standard deviation of a calibration's blocks [N]
  double max_torque_deviation = 0.05;  ///< standard deviation of a calibration's blocks [N m]
};

/// Settings with one bandwidth [1/s] for force and torque in all axes. The default of 15 keeps the
/// time constant within 10 % in a loop of 50 Hz; one of 100 Hz with an IMU of 1 kHz does better
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
  require_positive("WrenchObserverSettings.min_calibration_time [s]", s.min_calibration_time);
  require_positive("WrenchObserverSettings.max_force_deviation [N]", s.max_force_deviation);
  require_positive("WrenchObserverSettings.max_torque_deviation [N m]", s.max_torque_deviation);
}

/// What became of a sample.
enum class ObserverStatus {
  updated,
  started,  ///< the first sample: momentum is known now, the estimate is unchanged
  gap,      ///< time jumped, forward or back, by more than max_gap: started anew, the estimate kept
  rejected  ///< a number was not finite or beyond 1e6, which no sensor means, or time did not
            ///< advance; nothing was changed
};

/// Whether the estimate can be relied on; of several reasons against it, the first.
enum class WrenchTrust {
  not_started,  ///< no sample yet
  stale,        ///< no good sample within max_gap
  settling,     ///< of what the estimate started from, more than 5 % (3 / K) may be left
  limited,      ///< settled, but cut to a limit
  trusted
};

/// What became of a calibration.
enum class CalibrationStatus {
  calibrated,
  not_begun,
  too_short,  ///< fewer samples than min_calibration_time
  moved,      ///< a deviation above its limit: not at rest
  rejected    ///< the offset would not be finite or beyond 1e6
};

/// Force from specific force, torque from angular momentum. Each axis is a first-order filter of
/// the true external wrench with bandwidth K, discretised exactly: for a wrench that is constant
/// between samples the estimate at the samples is that of the continuous filter for any dt * K.
/// Over a gap the wrench was not constant and neither was the applied one, so none is estimated.
///
/// A calibration at rest, where the external wrench is known, measures the raw residual's offset:
///
///     observer.begin_calibration();  // from now on the vehicle stands on the ground, rotors off
///     ...                            // update() as ever, for a second or more
///     observer.end_calibration({Eigen::Vector3d(0, 0, mass * gravity), Eigen::Vector3d::Zero()});
///
/// In free hover the known wrench is zero. The offset is kept in the body frame, where that of an
/// accelerometer's bias is constant, and that of a shifted CoM while thrust is. That of a wrong
/// mass is not: it is (believed / true - 1) times the applied force, which turns in the body when
/// the vehicle leans and vanishes with the rotors off. So a calibration in hover holds near that
/// attitude only, and takes from a controller what makes up for the mass; one on the ground, with
/// the believed weight as the known force, leaves it in the estimate.
///
/// No function but the constructor throws, none allocates.
template <typename Scalar = double>
class WrenchObserver {
 public:
  /// Throws std::invalid_argument for parameters out of range.
  explicit WrenchObserver(const RigidBodyParameters& body,
                          const WrenchObserverSettings& settings = {})
      : settings_(validated(settings)) {
    validate(body);
    mass_ = Scalar(body.mass);
    inertia_ = body.inertia.cast<Scalar>();
    settling_time_ =
        3.0 / std::min(settings.force_bandwidth.minCoeff(), settings.torque_bandwidth.minCoeff());
  }

  /// Takes one sample at `time` [s], of an IMU at the CoM or taken there, less the biases, and the
  /// wrench `applied` by the actuators since the last sample (from measured rotor speeds and
  /// modelled tilt angles; body frame).
  ObserverStatus update(double time, const InertialSample<Scalar>& sample,
                        const Wrench<Scalar>& applied) noexcept {
    const Vector3<Scalar>&specific_force = sample.specific_force,
          &angular_velocity = sample.angular_velocity;
    if (!std::isfinite(time) || !within(specific_force, 1e6) || !within(angular_velocity, 1e6) ||
        !within(applied, 1e6))
      return ObserverStatus::rejected;
    const double dt = time - time_;
    if (!started_ || std::abs(dt) > settings_.max_gap) {
      const ObserverStatus status = started_ ? ObserverStatus::gap : ObserverStatus::started;
      started_ = true;
      time_ = settling_since_ = time;
      angular_velocity_ = angular_velocity;
      unfiltered_force_ = mass_ * specific_force - applied.force;
      return status;
    }
    if (!(dt > 0.0)) return ObserverStatus::rejected;
    // The momentum at the last sample is the initial value of the torque's integral; the mean of
    // both rates makes the gyroscopic term second order in dt.
    const Vector3<Scalar> rate = (angular_velocity + angular_velocity_) / Scalar(2);
    const Wrench<Scalar> residual{mass_ * specific_force - applied.force,
                                  inertia_ * (angular_velocity - angular_velocity_) / Scalar(dt) -
                                      applied.torque + rate.cross(inertia_ * rate)};
    if (!within(residual, 1e30)) return ObserverStatus::rejected;  // dt was next to nothing
    time_ = time;
    angular_velocity_ = angular_velocity;
    unfiltered_force_ = residual.force;
    filtered_.force += gain(settings_.force_bandwidth, dt)
                           .cwiseProduct(residual.force - offset_.force - filtered_.force);
    filtered_.torque += gain(settings_.torque_bandwidth, dt)
                            .cwiseProduct(residual.torque - offset_.torque - filtered_.torque);
    shape();
    constexpr int most = 1 << 20;  // where nobody takes the mean
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

  /// The estimate, at the CoM in the body frame [N; N m]: filtered() less the dead band, within the
  /// limits. wrench.hpp takes it to other points and into the world frame.
  [[nodiscard]] const Wrench<Scalar>& external() const noexcept { return external_; }

  /// For a loop that is slower than the IMU: the mean of external() over all samples since the last
  /// call, or external() if there was none. A rotor's vibration is aliased in a single sample.
  [[nodiscard]] Wrench<Scalar> take_external() noexcept {
    if (samples_ == 0) return external_;
    const Scalar count(static_cast<Scalar>(samples_));
    samples_ = 0;
    return {sum_.force / count, sum_.torque / count};
  }

  /// The filter's state: external() without dead band and limits.
  [[nodiscard]] const Wrench<Scalar>& filtered() const noexcept { return filtered_; }

  /// What the last sample says of the force, noise and all, body frame [N]; known from the first.
  [[nodiscard]] const Vector3<Scalar>& unfiltered_force() const noexcept {
    return unfiltered_force_;
  }

  [[nodiscard]] const WrenchObserverSettings& settings() const noexcept { return settings_; }

  /// Whether external() can be relied on at `now` [s], the clock of update().
  [[nodiscard]] WrenchTrust trust(double now) const noexcept {
    if (!started_) return WrenchTrust::not_started;
    if (!(std::abs(now - time_) <= settings_.max_gap)) return WrenchTrust::stale;
    if (time_ - settling_since_ < settling_time_) return WrenchTrust::settling;
    return limited_ ? WrenchTrust::limited : WrenchTrust::trusted;
  }

  /// Averages the raw residual from the next sample on; begins anew if it was doing so.
  void begin_calibration() noexcept {
    average_ = {};
    calibrating_ = true;
  }

  /// Ends the calibration. The offset is the average less the `known` external wrench (body frame,
  /// at the CoM), or what it was before unless the status is calibrated.
  CalibrationStatus end_calibration(const Wrench<Scalar>& known = {}) noexcept {
    if (!calibrating_) return CalibrationStatus::not_begun;
    calibrating_ = false;
    if (average_.time < settings_.min_calibration_time) return CalibrationStatus::too_short;
    if (!average_.deviates_less(settings_.max_force_deviation, settings_.max_torque_deviation))
      return CalibrationStatus::moved;
    const Wrench<Scalar> offset{average_.mean.template head<3>() - known.force,
                                average_.mean.template tail<3>() - known.torque};
    if (!within(offset, 1e6)) return CalibrationStatus::rejected;
    set_offset(offset);
    return CalibrationStatus::calibrated;
  }

  /// What is subtracted from the raw residual, body frame [N; N m].
  [[nodiscard]] const Wrench<Scalar>& offset() const noexcept { return offset_; }

  /// An offset from an earlier calibration. It acts from the next sample on, so the estimate does
  /// not jump. Ignored if not finite or beyond 1e6.
  void set_offset(const Wrench<Scalar>& offset) noexcept {
    if (!within(offset, 1e6)) return;
    offset_ = offset;
    settling_since_ = time_;
  }

  /// Forgets estimate, time, momentum and a calibration that has not ended; keeps the offset.
  void reset() noexcept {
    filtered_ = external_ = {};
    samples_ = 0;
    started_ = calibrating_ = false;
  }

 private:
  /// Mean and spread of a wrench in blocks of 0.1 s. Within a block a gyroscope's noise cancels but
  /// for its ends, whatever the rate of the samples, and a push of the vehicle does not.
  struct BlockAverage {
    using Vector6 = Eigen::Matrix<Scalar, 6, 1>;

    void add(const Wrench<Scalar>& sample, double dt) noexcept {
      Vector6 packed;
      packed << sample.force, sample.torque;
      block_sum += Scalar(dt) * packed;
      block_time += dt;
      if (block_time < 0.1) return;
      // Recursively, after D. H. D. West, "Updating mean and variance estimates", 1979.
      time += block_time;
      const Vector6 block = block_sum / Scalar(block_time), step = block - mean;
      mean += Scalar(block_time / time) * step;
      squares += Scalar(block_time) * step.cwiseProduct(block - mean);
      block_sum.setZero();
      block_time = 0.0;
    }

    [[nodiscard]] bool deviates_less(double force, double torque) const noexcept {
      return squares.template head<3>().maxCoeff() <= Scalar(force * force * time) &&
             squares.template tail<3>().maxCoeff() <= Scalar(torque * torque * time);
    }

    Vector6 mean = Vector6::Zero(), squares = Vector6::Zero(), block_sum = Vector6::Zero();
    double time = 0.0, block_time = 0.0;  ///< averaged so far, in the block [s]
  };

  /// NaN is not within.
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

  void shape() noexcept {
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

  WrenchObserverSettings settings_;
  Scalar mass_;
  Matrix3<Scalar> inertia_;
  Wrench<Scalar> filtered_, external_, offset_;
  Wrench<Scalar> sum_;  // of external_, over samples_ since take_external()
  int samples_ = 0;
  Vector3<Scalar> angular_velocity_ = Vector3<Scalar>::Zero();
  Vector3<Scalar> unfiltered_force_ = Vector3<Scalar>::Zero();
  double time_ = 0.0, settling_since_ = 0.0, settling_time_;
  bool started_ = false, limited_ = false, calibrating_ = false;
  BlockAverage average_;
};

}  // namespace tilt_ropter
