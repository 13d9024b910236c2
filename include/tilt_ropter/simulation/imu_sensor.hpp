// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/simulation/sensor_core.hpp>
#include <tilt_ropter/simulation/sensor_faults.hpp>

#include <Eigen/Core>

#include <cmath>
#include <cstdint>
#include <optional>

namespace tilt_ropter {

/// Gyroscope and accelerometer. The defaults are typical of a small MEMS unit.
struct ImuSensorParameters {
  double rate = 200.0;                          ///< measurements per second [Hz]
  double delay = 0.0;                           ///< from measurement to output [s]
  double gyro_noise_density = 2.0e-4;           ///< white noise [rad/s/sqrt(Hz)]
  double accelerometer_noise_density = 2.0e-3;  ///< white noise [m/s^2/sqrt(Hz)]
  double gyro_bias_walk = 2.0e-5;               ///< random walk of the bias [rad/s^2/sqrt(Hz)]
  double accelerometer_bias_walk = 3.0e-4;      ///< random walk of the bias [m/s^3/sqrt(Hz)]
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();           ///< initial bias [rad/s]
  Eigen::Vector3d accelerometer_bias = Eigen::Vector3d::Zero();  ///< initial bias [m/s^2]
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< of the IMU relative to the CoM, body [m]
};

inline void validate(const ImuSensorParameters& p) {
  detail::require_timing("ImuSensorParameters", p.rate, p.delay);
  require_non_negative("ImuSensorParameters.gyro_noise_density [rad/s/sqrt(Hz)]",
                       p.gyro_noise_density);
  require_non_negative("ImuSensorParameters.accelerometer_noise_density [m/s^2/sqrt(Hz)]",
                       p.accelerometer_noise_density);
  require_non_negative("ImuSensorParameters.gyro_bias_walk [rad/s^2/sqrt(Hz)]", p.gyro_bias_walk);
  require_non_negative("ImuSensorParameters.accelerometer_bias_walk [m/s^3/sqrt(Hz)]",
                       p.accelerometer_bias_walk);
  require_finite("ImuSensorParameters.gyro_bias [rad/s]", p.gyro_bias);
  require_finite("ImuSensorParameters.accelerometer_bias [m/s^2]", p.accelerometer_bias);
  require_finite("ImuSensorParameters.position [m]", p.position);
}

/// Simulated IMU with white noise, random-walk biases, a rate and a delay.
class ImuSensor {
 public:
  /// Measurement of this sensor.
  struct Measurement : InertialSampled {
    double time = 0.0;  ///< at which it was taken [s]
  };

  /// `seed` is the seed of the noise. Throws std::invalid_argument if `parameters` are invalid.
  ImuSensor(const ImuSensorParameters& parameters, std::uint64_t seed)
      : core_(parameters, seed),
        gyro_bias_(parameters.gyro_bias),
        accelerometer_bias_(parameters.accelerometer_bias) {}

  /// Truth: angular velocity in the body frame [rad/s], specific force of the CoM [m/s^2]. The
  /// angular acceleration, for an IMU beside the CoM, is the difference to the last call.
  [[nodiscard]] std::optional<Measurement> sample(double time,
                                                  const Eigen::Vector3d& angular_velocity,
                                                  const Eigen::Vector3d& specific_force) noexcept {
    if (all_finite(angular_velocity) && all_finite(specific_force)) {
      const Eigen::Vector3d at_imu =
          specific_force + lever_acceleration(time, angular_velocity, core_.parameters.position);
      if (core_.due(time)) take(time, angular_velocity, at_imu);
    }
    return core_.pop(time);
  }

  /// Adds a fault; only kinds of the IMU act. Throws std::invalid_argument if it is out of range.
  void add_fault(const SensorFault& fault) { core_.add_fault(fault); }

  /// Prepares for a run whose time starts anew. Keeps biases, faults and the state of the noise.
  void reset() noexcept {
    core_.reset();
    has_last_ = false;
  }

  /// True biases for comparison with an estimate [rad/s], [m/s^2].
  [[nodiscard]] const Eigen::Vector3d& gyro_bias() const noexcept { return gyro_bias_; }
  [[nodiscard]] const Eigen::Vector3d& accelerometer_bias() const noexcept {
    return accelerometer_bias_;
  }

 private:
  // Acceleration of the IMU relative to the CoM: dw/dt x r + w x (w x r).
  Eigen::Vector3d lever_acceleration(double time, const Eigen::Vector3d& w,
                                     const Eigen::Vector3d& r) noexcept {
    const double dt = time - last_time_;
    const Eigen::Vector3d change = w - last_rate_;
    const bool known = has_last_ && dt > 0.0;
    has_last_ = true;
    last_time_ = time;
    last_rate_ = w;
    if (r == Eigen::Vector3d::Zero()) return r;
    Eigen::Vector3d acceleration = w.cross(w.cross(r));
    if (known) acceleration += (change / dt).cross(r);
    return acceleration;
  }

  void take(double time, const Eigen::Vector3d& angular_velocity,
            const Eigen::Vector3d& specific_force) noexcept {
    const ImuSensorParameters& p = core_.parameters;
    const double root_rate = std::sqrt(p.rate);
    Measurement m;
    m.time = time;
    m.angular_velocity =
        angular_velocity + gyro_bias_ + core_.noise.draw<3>(p.gyro_noise_density * root_rate);
    m.specific_force = specific_force + accelerometer_bias_ +
                       core_.noise.draw<3>(p.accelerometer_noise_density * root_rate);
    bool silent = false;
    core_.for_faults(time, [&](const SensorFault& fault) {
      using Kind = SensorFaultKind;
      if (fault.kind == Kind::imu_dropout) silent = true;
      if (fault.kind == Kind::imu_clock_step) m.time += fault.size;
      if (fault.kind == Kind::imu_vibration) {
        const double phase = 2.0 * pi * fault.frequency * time, rms = std::sqrt(2.0) * fault.size;
        for (int axis = 0; axis < 3; ++axis) {  // a different phase in each axis
          m.angular_velocity(axis) += rms * std::sin(phase + 2.0 * axis);
          m.specific_force(axis) += 10.0 * rms * std::sin(phase + 1.0 + 2.0 * axis);
        }
      }
      if (fault.kind == Kind::imu_saturation) {
        m.angular_velocity = m.angular_velocity.cwiseMax(-fault.size).cwiseMin(fault.size);
        m.specific_force =
            m.specific_force.cwiseMax(-10.0 * fault.size).cwiseMin(10.0 * fault.size);
      }
    });
    if (!silent) core_.push(time, m);
    gyro_bias_ += core_.noise.draw<3>(p.gyro_bias_walk / root_rate);
    accelerometer_bias_ += core_.noise.draw<3>(p.accelerometer_bias_walk / root_rate);
  }

  detail::SensorCore<ImuSensorParameters, Measurement> core_;
  Eigen::Vector3d gyro_bias_, accelerometer_bias_;
  Eigen::Vector3d last_rate_ = Eigen::Vector3d::Zero();
  double last_time_ = 0.0;
  bool has_last_ = false;
};

}  // namespace tilt_ropter
