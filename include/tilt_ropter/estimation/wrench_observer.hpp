#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cmath>

/// External wrench from motion and applied wrench (paper, Sec. External Wrench Estimation,
/// Eq. wrench_estimation; after Tomić, Ott & Haddadin 2017).
namespace tilt_ropter {

/// Bandwidths of the first-order filters through which the true external wrench is seen.
struct WrenchObserverSettings {
  Eigen::Vector3d force_bandwidth{5.0, 5.0, 5.0};   ///< K_f, body axes [1/s]
  Eigen::Vector3d torque_bandwidth{5.0, 5.0, 5.0};  ///< K_m, body axes [1/s]
};

inline void validate(const WrenchObserverSettings& s) {
  require_positive("WrenchObserverSettings.force_bandwidth [1/s]", s.force_bandwidth);
  require_positive("WrenchObserverSettings.torque_bandwidth [1/s]", s.torque_bandwidth);
}

enum class ObserverStatus {
  updated,
  started,  ///< the first sample: momentum is known now, the estimate is unchanged
  rejected  ///< a number was not finite or time did not advance; nothing was changed
};

/// Force from specific force, torque from angular momentum. Each axis is a first-order filter of
/// the true external wrench with bandwidth K, discretised exactly: for a wrench that is constant
/// between samples the estimate at the samples is that of the continuous filter for any dt * K.
template <typename Scalar = double>
class WrenchObserver {
 public:
  /// Throws std::invalid_argument for parameters out of range.
  explicit WrenchObserver(const RigidBodyParameters& body,
                          const WrenchObserverSettings& settings = {}) {
    validate(body);
    validate(settings);
    mass_ = Scalar(body.mass);
    inertia_ = body.inertia.cast<Scalar>();
    force_bandwidth_ = settings.force_bandwidth.cast<Scalar>();
    torque_bandwidth_ = settings.torque_bandwidth.cast<Scalar>();
  }

  /// Takes one sample: `specific_force` q^-1 (dv/dt - g) [m/s^2] and `angular_velocity` [rad/s] in
  /// the body frame at the CoM, and the wrench `applied` by the actuators since the last sample
  /// (from measured rotor speeds and modelled tilt angles). No allocation, no exception.
  ObserverStatus update(Scalar time, const Vector3<Scalar>& specific_force,
                        const Vector3<Scalar>& angular_velocity,
                        const Wrench<Scalar>& applied) noexcept {
    using std::isfinite;
    if (!isfinite(time) || !specific_force.allFinite() || !angular_velocity.allFinite() ||
        !is_finite(applied))
      return ObserverStatus::rejected;
    if (!started_) {
      started_ = true;
      time_ = time;
      angular_velocity_ = angular_velocity;
      return ObserverStatus::started;
    }
    const Scalar dt = time - time_;
    if (!(dt > Scalar(0))) return ObserverStatus::rejected;
    // The momentum at the last sample is the initial value of the torque's integral; the mean of
    // both rates makes the gyroscopic term second order in dt.
    const Vector3<Scalar> rate = (angular_velocity + angular_velocity_) / Scalar(2);
    const Vector3<Scalar> torque = inertia_ * (angular_velocity - angular_velocity_) / dt -
                                   applied.torque + rate.cross(inertia_ * rate);
    const Vector3<Scalar> force = mass_ * specific_force - applied.force;
    if (!torque.allFinite() || !force.allFinite()) return ObserverStatus::rejected;
    time_ = time;
    angular_velocity_ = angular_velocity;
    external_.force += gain(force_bandwidth_, dt).cwiseProduct(force - external_.force);
    external_.torque += gain(torque_bandwidth_, dt).cwiseProduct(torque - external_.torque);
    return ObserverStatus::updated;
  }

  /// The estimate, at the CoM in the body frame [N; N m].
  [[nodiscard]] const Wrench<Scalar>& external() const { return external_; }

  /// Replaces the estimate, for instance when contact with the ground ends at once. Ignored if not
  /// finite.
  void set_external(const Wrench<Scalar>& external) noexcept {
    if (is_finite(external)) external_ = external;
  }

  /// Forgets estimate, time and momentum.
  void reset() noexcept {
    external_ = {};
    started_ = false;
  }

 private:
  static Vector3<Scalar> gain(const Vector3<Scalar>& bandwidth, Scalar dt) {
    using std::expm1;
    return {-expm1(-bandwidth.x() * dt), -expm1(-bandwidth.y() * dt), -expm1(-bandwidth.z() * dt)};
  }

  Scalar mass_;
  Matrix3<Scalar> inertia_;
  Vector3<Scalar> force_bandwidth_, torque_bandwidth_;
  Wrench<Scalar> external_;
  Vector3<Scalar> angular_velocity_ = Vector3<Scalar>::Zero();
  Scalar time_ = Scalar(0);
  bool started_ = false;
};

}  // namespace tilt_ropter
