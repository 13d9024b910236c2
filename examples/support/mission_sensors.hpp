#pragma once

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <Eigen/Core>

#include <cmath>
#include <cstdint>
#include <vector>

namespace examples {

/// The sensors of the vehicle in the mission: an IMU with biases, rotor speeds, and motion
/// capture at 100 Hz with a delay of 20 ms.
template <int Rotors>
struct MissionSensors {
  explicit MissionSensors(std::uint64_t seed, double imu_rate = 1000.0)
      : imu(imu_parameters(imu_rate), seed),
        rotor_speeds({}, seed + 1000),
        poses(pose_parameters(), seed + 2000) {}

  /// Breaks a sensor. Each sensor ignores the kinds of the others.
  void add_fault(const tilt_ropter::SensorFault& fault) {
    imu.add_fault(fault);
    poses.add_fault(fault);
    faults.push_back(fault);
  }

  static tilt_ropter::ImuSensorParameters imu_parameters(double rate) {
    tilt_ropter::ImuSensorParameters p;
    p.rate = rate;
    p.gyro_bias << 0.01, -0.02, 0.015;
    p.accelerometer_bias << 0.05, -0.08, 0.1;
    return p;
  }

  static tilt_ropter::PoseSensorParameters pose_parameters() {
    tilt_ropter::PoseSensorParameters p;
    p.delay = 0.02;
    p.position_noise = 1e-3;
    p.orientation_noise = 3e-3;
    return p;
  }

  /// Returns the settings of the estimator for these sensors.
  static tilt_ropter::EkfSettings estimation() {
    const tilt_ropter::PoseSensorParameters p = pose_parameters();
    tilt_ropter::EkfSettings settings;
    settings.pose_noise = {p.position_noise, p.orientation_noise};
    return settings;
  }

  /// Passes the current measurements of `plant` to `controller`. Motion capture is `height_error`
  /// [m] too high.
  template <typename Plant, typename Controller>
  void sense(const Plant& plant, Controller& controller, double height_error = 0.0) {
    const double time = plant.time();
    const auto speeds = rotor_speeds.sample(time, plant.actuators().rotor_speed);
    if (const auto& m = speeds; m && has_rotor_speeds) controller.on_rotor_speeds(m->rotor_speed);
    if (auto m = imu.sample(time, plant.body().angular_velocity, plant.specific_force())) {
      if (vibration > 0.0) {
        const double now = vibration * std::sqrt(2.0) *
                           std::sin(2.0 * tilt_ropter::pi * vibration_frequency * time);
        m->angular_velocity.array() += now;
        m->specific_force.array() += 10.0 * now;
      }
      controller.on_imu(m->time, *m);
    }
    tilt_ropter::BodyStated seen = plant.body();
    seen.position.z() += height_error;
    if (!has_poses) return;
    seen.position += pose_drift;
    seen.orientation = tilt_ropter::quaternion_from_yaw(yaw_drift) * seen.orientation;
    if (const auto m = poses.sample(time, seen)) controller.on_pose(m->time, *m);
  }

  /// Rms of each angular rate [rad/s]; the specific force has ten times this value in [m/s^2].
  double vibration = 0.0;
  bool has_rotor_speeds = true;  // false: no telemetry
  /// [Hz]. Near 100 Hz a loop with one sample per tick sees a slow oscillation.
  double vibration_frequency = 97.0;
  bool has_poses = true;                                 // false: motion capture is off
  Eigen::Vector3d pose_drift = Eigen::Vector3d::Zero();  // of the frame of the poses [m]
  double yaw_drift = 0.0;                                // of that frame [rad]
  tilt_ropter::ImuSensor imu;
  tilt_ropter::RotorSpeedSensor<Rotors> rotor_speeds;
  tilt_ropter::PoseSensor poses;
  std::vector<tilt_ropter::SensorFault> faults;  // as given
};

}  // namespace examples
