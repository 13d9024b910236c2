// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/imu_sensor.hpp>
#include <tilt_ropter/simulation/sensor_core.hpp>
#include <tilt_ropter/simulation/sensor_faults.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstdint>
#include <optional>

/// Simulated sensors for the plant, with noise, bias, rate and delay.
///
/// Every sensor is constructed from its parameters and a seed and has
///
///     std::optional<Measurement> sample(double time, <truth at that time>) noexcept
///
/// Call sample() at every step of the plant, with absolute time [s] that does not decrease. The
/// first call takes a measurement and starts the sampling grid of the sensor's rate. A later call
/// takes a measurement if the next instant of the grid is reached. sample() returns each
/// measurement once, `delay` after it was taken, with the time at which it was taken. The same seed
/// and the same calls give bitwise identical results with every standard library. Sensors allocate
/// at construction only. They take no measurement if the truth or the time is not finite.
///
/// reset() prepares a sensor for a new run whose time may start anywhere: it drops measurements
/// that wait and starts a new sampling grid. ImuSensor and PoseSensor can be given faults.
namespace tilt_ropter {

/// Pose sensor such as motion capture. It measures the pose of the body.
struct PoseSensorParameters {
  double rate = 100.0;                ///< measurements per second [Hz]
  double delay = 0.01;                ///< from measurement to output [s]
  double position_noise = 5.0e-4;     ///< standard deviation per axis, world frame [m]
  double orientation_noise = 2.0e-3;  ///< standard deviation per axis, body frame [rad]
};

inline void validate(const PoseSensorParameters& p) {
  detail::require_timing("PoseSensorParameters", p.rate, p.delay);
  require_non_negative("PoseSensorParameters.position_noise [m]", p.position_noise);
  require_non_negative("PoseSensorParameters.orientation_noise [rad]", p.orientation_noise);
}

/// Simulated pose sensor with white noise, a rate and a delay.
class PoseSensor {
 public:
  /// Measurement of this sensor.
  struct Measurement : MarkerPosed {
    double time = 0.0;  ///< at which it was taken [s]
  };

  /// `seed` is the seed of the noise. Throws std::invalid_argument if `parameters` are invalid.
  PoseSensor(const PoseSensorParameters& parameters, std::uint64_t seed)
      : core_(parameters, seed), jitter_(seed + 1) {}

  [[nodiscard]] std::optional<Measurement> sample(double time, const BodyStated& truth) noexcept {
    if (is_finite(truth) && core_.due(time)) take(time, truth);
    return core_.pop(time);
  }

  /// Adds a fault; only kinds of poses act. Throws std::invalid_argument if it is out of range.
  void add_fault(const SensorFault& fault) { core_.add_fault(fault); }

  /// Prepares for a run whose time starts anew. Keeps faults and the state of the noise.
  void reset() noexcept {
    core_.reset();
    last_.reset();
  }

 private:
  void take(double time, const BodyStated& truth) noexcept {
    Measurement m;
    m.time = time;
    m.position = truth.position + core_.noise.draw<3>(core_.parameters.position_noise);
    m.orientation = (truth.orientation *
                     quaternion_exp(core_.noise.draw<3>(core_.parameters.orientation_noise)))
                        .normalized();
    bool silent = false, frozen = false;
    core_.for_faults(time, [&](const SensorFault& fault) {
      using Kind = SensorFaultKind;
      if (fault.kind == Kind::pose_dropout) silent = true;
      if (fault.kind == Kind::pose_freeze) frozen = true;
      if (fault.kind == Kind::pose_jump) m.position.x() += fault.size;
      if (fault.kind == Kind::pose_ghost) {
        m.position += Eigen::Vector3d(fault.size, 0.0, 0.0) - truth.position;
        m.orientation = truth.orientation.conjugate() * m.orientation;
      }
      if (fault.kind == Kind::pose_clock_step) m.time += fault.size;
      if (fault.kind == Kind::pose_jitter) m.time += jitter_.draw() * fault.size;
    });
    if (frozen && last_) {
      m.position = last_->position;
      m.orientation = last_->orientation;
    }
    last_ = m;
    if (!silent) core_.push(time, m);
  }

  detail::SensorCore<PoseSensorParameters, Measurement> core_;
  GaussianNoise jitter_;  // of its own, so that faults do not change the other noise
  std::optional<Measurement> last_;
};

/// Sensor of the rotor speeds, such as the motor controllers.
struct RotorSpeedSensorParameters {
  double rate = 500.0;  ///< measurements per second [Hz]
  double delay = 0.0;   ///< from measurement to output [s]
  double noise = 5.0;   ///< standard deviation [rad/s]
};

inline void validate(const RotorSpeedSensorParameters& p) {
  detail::require_timing("RotorSpeedSensorParameters", p.rate, p.delay);
  require_non_negative("RotorSpeedSensorParameters.noise [rad/s]", p.noise);
}

/// Simulated rotor speed sensor with white noise, a rate and a delay.
template <int Rotors>
class RotorSpeedSensor {
 public:
  /// Measurement of this sensor.
  struct Measurement {
    double time = 0.0;  ///< at which it was taken [s]
    Eigen::Matrix<double, Rotors, 1> rotor_speed =
        Eigen::Matrix<double, Rotors, 1>::Zero();  ///< [rad/s], >= 0
  };

  /// `seed` is the seed of the noise. Throws std::invalid_argument if `parameters` are invalid.
  RotorSpeedSensor(const RotorSpeedSensorParameters& parameters, std::uint64_t seed)
      : core_(parameters, seed) {}

  [[nodiscard]] std::optional<Measurement> sample(
      double time, const Eigen::Matrix<double, Rotors, 1>& rotor_speed) noexcept {
    if (all_finite(rotor_speed) && core_.due(time)) {
      Measurement m;
      m.time = time;
      m.rotor_speed =
          (rotor_speed + core_.noise.template draw<Rotors>(core_.parameters.noise)).cwiseMax(0.0);
      core_.push(m);
    }
    return core_.pop(time);
  }

  /// Prepares for a run whose time starts anew. Keeps the state of the noise.
  void reset() noexcept { core_.reset(); }

 private:
  detail::SensorCore<RotorSpeedSensorParameters, Measurement> core_;
};

/// Sensor of the whole body state. It replaces sensors and estimator in tests of a controller.
struct StateSensorParameters {
  double rate = 1000.0;                  ///< measurements per second [Hz]
  double delay = 0.0;                    ///< from measurement to output [s]
  double position_noise = 1.0e-3;        ///< standard deviation per axis, world frame [m]
  double velocity_noise = 1.0e-2;        ///< standard deviation per axis, world frame [m/s]
  double orientation_noise = 3.0e-3;     ///< standard deviation per axis, body frame [rad]
  double angular_velocity_noise = 1e-2;  ///< standard deviation per axis, body frame [rad/s]
};

inline void validate(const StateSensorParameters& p) {
  detail::require_timing("StateSensorParameters", p.rate, p.delay);
  require_non_negative("StateSensorParameters.position_noise [m]", p.position_noise);
  require_non_negative("StateSensorParameters.velocity_noise [m/s]", p.velocity_noise);
  require_non_negative("StateSensorParameters.orientation_noise [rad]", p.orientation_noise);
  require_non_negative("StateSensorParameters.angular_velocity_noise [rad/s]",
                       p.angular_velocity_noise);
}

/// Simulated sensor of the body state with white noise, a rate and a delay.
class StateSensor {
 public:
  /// Measurement of this sensor.
  struct Measurement {
    double time = 0.0;  ///< at which it was taken [s]
    BodyStated body;
  };

  /// `seed` is the seed of the noise. Throws std::invalid_argument if `parameters` are invalid.
  StateSensor(const StateSensorParameters& parameters, std::uint64_t seed)
      : core_(parameters, seed) {}

  [[nodiscard]] std::optional<Measurement> sample(double time, const BodyStated& truth) noexcept {
    if (is_finite(truth) && core_.due(time)) {
      const StateSensorParameters& p = core_.parameters;
      Measurement m;
      m.time = time;
      m.body.position = truth.position + core_.noise.draw<3>(p.position_noise);
      m.body.velocity = truth.velocity + core_.noise.draw<3>(p.velocity_noise);
      m.body.orientation =
          (truth.orientation * quaternion_exp(core_.noise.draw<3>(p.orientation_noise)))
              .normalized();
      m.body.angular_velocity =
          truth.angular_velocity + core_.noise.draw<3>(p.angular_velocity_noise);
      core_.push(m);
    }
    return core_.pop(time);
  }

  /// Prepares for a run whose time starts anew. Keeps the state of the noise.
  void reset() noexcept { core_.reset(); }

 private:
  detail::SensorCore<StateSensorParameters, Measurement> core_;
};

}  // namespace tilt_ropter
