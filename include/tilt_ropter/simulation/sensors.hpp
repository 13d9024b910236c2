// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/detail/delay_queue.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <random>
#include <string>
#include <string_view>
#include <vector>

/// Simulated sensors, each with noise, a rate, a delay and faults to try estimators on.
namespace tilt_ropter {

/// White Gaussian noise by Marsaglia's polar method, the same with every standard library.
class GaussianNoise {
 public:
  explicit GaussianNoise(std::uint64_t seed) : generator_(seed) {}

  /// Returns a sample with zero mean and unit variance.
  [[nodiscard]] double draw() noexcept {
    if (has_spare_) {
      has_spare_ = false;
      return spare_;
    }
    double u = 0.0, v = 0.0, square = 0.0;
    do {
      u = uniform();
      v = uniform();
      square = u * u + v * v;
    } while (square >= 1.0 || square <= 0.0);
    const double scale = std::sqrt(-2.0 * std::log(square) / square);
    spare_ = scale * v;
    has_spare_ = true;
    return scale * u;
  }

  /// Returns `Size` independent samples with standard deviation `stddev`.
  template <int Size>
  [[nodiscard]] Eigen::Matrix<double, Size, 1> draw(double stddev) noexcept {
    Eigen::Matrix<double, Size, 1> sample;
    for (int i = 0; i < Size; ++i) sample(i) = stddev * draw();
    return sample;
  }

 private:
  /// Uniform sample in [-1, 1) with 53 random bits.
  double uniform() noexcept { return static_cast<double>(generator_() >> 11U) * 0x1.0p-52 - 1.0; }

  std::mt19937_64 generator_;
  double spare_ = 0.0;
  bool has_spare_ = false;
};

/// What is wrong with a sensor.
enum class SensorFaultKind {
  pose_freeze,      ///< poses repeat the last one, with fresh stamps
  pose_jump,        ///< positions are off by `size` [m] along world x
  pose_dropout,     ///< no poses
  pose_jitter,      ///< stamps have an error of standard deviation `size` [s]
  pose_clock_step,  ///< stamps are off by `size` [s]
  pose_ghost,       ///< poses of another object: at rest at `size` [m] along world x, with noise
  imu_dropout,      ///< no IMU samples
  imu_clock_step,   ///< stamps of the IMU are off by `size` [s]
  imu_vibration,    ///< rates vibrate with an rms of `size` [rad/s], specific forces ten times it
  imu_saturation,   ///< rates are cut at `size` [rad/s], specific forces at ten times it [m/s^2]
  accelerometer_step,  ///< the bias of the specific force along body x is off by `size` [m/s^2]
  gyro_step,           ///< the bias of the rate about body x is off by `size` [rad/s]
  accelerometer_clip,  ///< specific forces are cut at `size` [m/s^2]
  orientation_step,    ///< orientations are turned by `size` [deg] about body z, positions are not
  pose_late,           ///< stamps are `size` [s] later than the measurement, arrivals likewise
  pose_burst           ///< `size` poses arrive together
};

inline constexpr std::array<std::string_view, 16> sensor_fault_names = {
    "pose_freeze",        "pose_jump",        "pose_dropout",       "pose_jitter",
    "pose_clock_step",    "pose_ghost",       "imu_dropout",        "imu_clock_step",
    "imu_vibration",      "imu_saturation",   "accelerometer_step", "gyro_step",
    "accelerometer_clip", "orientation_step", "pose_late",          "pose_burst"};

[[nodiscard]] inline std::string_view to_string(SensorFaultKind kind) {
  return sensor_fault_names[static_cast<std::size_t>(kind)];
}

/// Returns the kind of this name, if there is one.
[[nodiscard]] inline std::optional<SensorFaultKind> sensor_fault_kind(std::string_view name) {
  for (std::size_t i = 0; i < sensor_fault_names.size(); ++i)
    if (sensor_fault_names[i] == name) return static_cast<SensorFaultKind>(i);
  return std::nullopt;
}

/// A fault from `start` for `duration`.
struct SensorFault {
  SensorFaultKind kind = SensorFaultKind::pose_dropout;
  double start = 0.0;                                         ///< [s]
  double duration = std::numeric_limits<double>::infinity();  ///< may be infinite [s]
  double size = 0.0;        ///< in the unit of the kind; no effect on freeze and dropout
  double frequency = 97.0;  ///< of imu_vibration [Hz]

  [[nodiscard]] bool acts(double time) const noexcept {
    return time >= start && time < start + duration;
  }
};

inline void validate(const SensorFault& f) {
  require_finite("SensorFault.start [s]", f.start);
  require(f.duration > 0.0, "SensorFault.duration [s]", f.duration, "> 0, may be infinite");
  require_in("SensorFault.size", f.size, -1e3, 1e3);
  const bool positive =
      f.kind == SensorFaultKind::pose_jitter || f.kind == SensorFaultKind::imu_vibration ||
      f.kind == SensorFaultKind::imu_saturation || f.kind == SensorFaultKind::accelerometer_clip ||
      f.kind == SensorFaultKind::pose_late || f.kind == SensorFaultKind::pose_burst;
  require(!positive || f.size > 0.0, "SensorFault.size", f.size, "> 0 for this kind");
  require_in("SensorFault.frequency [Hz]", f.frequency, 1e-3, 1e4);
}

}  // namespace tilt_ropter

namespace tilt_ropter::detail {

/// Common part of all sensors: parameters, noise, sampling grid, delay and faults.
template <typename Parameters, typename Sample>
class Sensor {
 public:
  using Measurement = Sample;  ///< measurement of this sensor

  /// `seed` is the seed of the noise. Throws std::invalid_argument if `given` is invalid.
  Sensor(const Parameters& given, std::uint64_t seed)
      : parameters_(validated(given)),
        noise_(seed),
        queue_(static_cast<std::size_t>(given.rate * given.delay) + 128) {}  // room for faults

  /// Adds a fault; only kinds of this sensor act. Throws std::invalid_argument if out of range.
  void add_fault(const SensorFault& fault) { faults_.push_back(validated(fault)); }

  /// Prepares for a run whose time starts anew. Keeps biases, faults and the state of the noise.
  void reset() noexcept {
    queue_.clear();
    started_ = false;
  }

 protected:
  /// True if a measurement is due at `time` [s], with a tolerance of a thousandth of a period.
  [[nodiscard]] bool due(double time) noexcept {
    if (!std::isfinite(time)) return false;
    if (!started_) start_ = time;
    const double instant = std::floor((time - start_) * parameters_.rate + 1e-3);
    if (started_ && instant <= last_instant_) return false;
    started_ = true;
    last_instant_ = instant;
    return true;
  }
  /// For a measurement taken at `time` [s], perhaps with another stamp.
  void push(double time, const Measurement& m) noexcept {
    queue_.push(time + parameters_.delay, m);
  }
  [[nodiscard]] std::optional<Measurement> pop(double time) noexcept { return queue_.pop(time); }
  /// Calls `act` with each fault that acts at `time` [s].
  template <typename Act>
  void for_faults(double time, Act act) const noexcept {
    for (const SensorFault& fault : faults_)
      if (fault.acts(time)) act(fault);
  }

  Parameters parameters_;
  GaussianNoise noise_;

 private:
  std::vector<SensorFault> faults_;
  DelayQueue<Measurement> queue_;
  bool started_ = false;
  double start_ = 0.0, last_instant_ = 0.0;
};

/// A value with the time at which it was taken.
template <typename Value>
struct Stamped : Value {
  double time = 0.0;  ///< [s]
};

inline void require_timing(const std::string& sensor, double rate, double delay) {
  require_positive(sensor + ".rate [Hz]", rate);
  require_non_negative(sensor + ".delay [s]", delay);
  require(rate * delay <= 1e5, sensor + ".delay [s]", delay, "at most 1e5 periods of the rate");
}

}  // namespace tilt_ropter::detail

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
class ImuSensor : public detail::Sensor<ImuSensorParameters, detail::Stamped<InertialSampled>> {
 public:
  ImuSensor(const ImuSensorParameters& parameters, std::uint64_t seed)
      : Sensor(parameters, seed),
        gyro_bias_(parameters.gyro_bias),
        accelerometer_bias_(parameters.accelerometer_bias) {}

  /// Truth: angular velocity in the body frame [rad/s], specific force of the CoM [m/s^2]. The
  /// angular acceleration, for an IMU beside the CoM, is the difference to the last call.
  [[nodiscard]] std::optional<Measurement> sample(double time,
                                                  const Eigen::Vector3d& angular_velocity,
                                                  const Eigen::Vector3d& specific_force) noexcept {
    if (all_finite(angular_velocity) && all_finite(specific_force)) {
      const Eigen::Vector3d at_imu =
          specific_force + lever_acceleration(time, angular_velocity, parameters_.position);
      if (due(time)) take(time, angular_velocity, at_imu);
    }
    return pop(time);
  }

  void reset() noexcept {
    Sensor::reset();
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
    const ImuSensorParameters& p = parameters_;
    const double root_rate = std::sqrt(p.rate);
    Measurement m;
    m.time = time;
    m.angular_velocity =
        angular_velocity + gyro_bias_ + noise_.draw<3>(p.gyro_noise_density * root_rate);
    m.specific_force = specific_force + accelerometer_bias_ +
                       noise_.draw<3>(p.accelerometer_noise_density * root_rate);
    bool silent = false;
    for_faults(time, [&](const SensorFault& fault) {
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
      if (fault.kind == Kind::accelerometer_step) m.specific_force.x() += fault.size;
      if (fault.kind == Kind::gyro_step) m.angular_velocity.x() += fault.size;
      if (fault.kind == Kind::accelerometer_clip)
        m.specific_force = m.specific_force.cwiseMax(-fault.size).cwiseMin(fault.size);
    });
    if (!silent) push(time, m);
    gyro_bias_ += noise_.draw<3>(p.gyro_bias_walk / root_rate);
    accelerometer_bias_ += noise_.draw<3>(p.accelerometer_bias_walk / root_rate);
  }

  Eigen::Vector3d gyro_bias_, accelerometer_bias_;
  Eigen::Vector3d last_rate_ = Eigen::Vector3d::Zero();
  double last_time_ = 0.0;
  bool has_last_ = false;
};

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
class PoseSensor : public detail::Sensor<PoseSensorParameters, detail::Stamped<MarkerPosed>> {
 public:
  PoseSensor(const PoseSensorParameters& parameters, std::uint64_t seed)
      : Sensor(parameters, seed), jitter_(seed + 1) {}

  [[nodiscard]] std::optional<Measurement> sample(double time, const BodyStated& truth) noexcept {
    if (is_finite(truth) && due(time)) take(time, truth);
    return pop(time);
  }

  void reset() noexcept {
    Sensor::reset();
    last_.reset();
  }

 private:
  void take(double time, const BodyStated& truth) noexcept {
    Measurement m;
    m.time = time;
    m.position = truth.position + noise_.draw<3>(parameters_.position_noise);
    m.orientation =
        (truth.orientation * quaternion_exp(noise_.draw<3>(parameters_.orientation_noise)))
            .normalized();
    bool silent = false, frozen = false;
    double sent = time;
    for_faults(time, [&](const SensorFault& fault) {
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
      if (fault.kind == Kind::orientation_step)
        m.orientation = m.orientation * quaternion_from_yaw(fault.size * pi / 180.0);
      if (fault.kind == Kind::pose_late) {
        m.time += fault.size;
        sent += fault.size;
      }
      if (fault.kind == Kind::pose_burst) {
        const double period = fault.size / parameters_.rate;
        sent = period * std::ceil(time / period - 1e-6);
      }
    });
    if (frozen && last_) {
      m.position = last_->position;
      m.orientation = last_->orientation;
    }
    last_ = m;
    if (!silent) push(sent, m);
  }

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

/// Measurement of a RotorSpeedSensor.
template <int Rotors>
struct RotorSpeedMeasurement {
  double time = 0.0;  ///< at which it was taken [s]
  Eigen::Matrix<double, Rotors, 1> rotor_speed =
      Eigen::Matrix<double, Rotors, 1>::Zero();  ///< [rad/s], >= 0
};

/// Simulated rotor speed sensor with white noise, a rate and a delay.
template <int Rotors>
class RotorSpeedSensor
    : public detail::Sensor<RotorSpeedSensorParameters, RotorSpeedMeasurement<Rotors>> {
 public:
  using Base = detail::Sensor<RotorSpeedSensorParameters, RotorSpeedMeasurement<Rotors>>;
  using Base::Base;
  using typename Base::Measurement;

  [[nodiscard]] std::optional<Measurement> sample(
      double time, const Eigen::Matrix<double, Rotors, 1>& rotor_speed) noexcept {
    if (all_finite(rotor_speed) && this->due(time)) {
      Measurement m;
      m.time = time;
      m.rotor_speed =
          (rotor_speed + this->noise_.template draw<Rotors>(this->parameters_.noise)).cwiseMax(0.0);
      this->push(time, m);
    }
    return this->pop(time);
  }
};

}  // namespace tilt_ropter
