// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/clock_calibration.hpp>
#include <tilt_ropter/estimation/error_state_filter.hpp>
#include <tilt_ropter/math/validation.hpp>

namespace tilt_ropter {

/// Settings of calibrate_log().
struct LogCalibrationSettings {
  /// Noise of IMU and poses. Only their ratios matter, because the residuals show their size. A
  /// walk of zero is a constant bias.
  InertialNoise imu_noise;
  MarkerPoseNoise pose_noise;
  /// The first guess of clock offset and marker orientation.
  ClockCalibrationSettings clock;
  /// Standard deviation of the direction of gravity from -z of motion capture's world, per axis
  /// [rad]. Zero: the world is level, as the filter assumes.
  double gravity_stddev = 0.0;
  double gyro_bias_stddev = 0.2;           ///< before the flight, about zero [rad/s]
  double accelerometer_bias_stddev = 1.0;  ///< before the flight, about zero [m/s^2]

  /// A calibration with a larger standard deviation is refused.
  double max_marker_position_stddev = 0.01;     ///< [m]
  double max_marker_orientation_stddev = 0.01;  ///< [rad]
  double max_gyro_bias_stddev = 0.01;           ///< [rad/s]
  double max_accelerometer_bias_stddev = 0.1;   ///< [m/s^2]

  double max_imu_gap = 0.05;  ///< longest pause between IMU samples [s]
  int max_iterations = 40;    ///< of Gauss-Newton
};

inline void validate(const LogCalibrationSettings& s) {
  validate(s.imu_noise);
  require_positive("LogCalibrationSettings.imu_noise.gyro_density", s.imu_noise.gyro_density);
  require_positive("LogCalibrationSettings.imu_noise.accelerometer_density",
                   s.imu_noise.accelerometer_density);
  validate(s.pose_noise);
  validate(s.clock);
  require_in("LogCalibrationSettings.gravity_stddev [rad]", s.gravity_stddev, 0.0, 1.0);
  require_in("LogCalibrationSettings.gyro_bias_stddev [rad/s]", s.gyro_bias_stddev, 0.0, 1e3);
  require_in("LogCalibrationSettings.accelerometer_bias_stddev [m/s^2]",
             s.accelerometer_bias_stddev, 0.0, 1e3);
  require_positive("LogCalibrationSettings.max_marker_position_stddev [m]",
                   s.max_marker_position_stddev);
  require_positive("LogCalibrationSettings.max_marker_orientation_stddev [rad]",
                   s.max_marker_orientation_stddev);
  require_positive("LogCalibrationSettings.max_gyro_bias_stddev [rad/s]", s.max_gyro_bias_stddev);
  require_positive("LogCalibrationSettings.max_accelerometer_bias_stddev [m/s^2]",
                   s.max_accelerometer_bias_stddev);
  require_in("LogCalibrationSettings.max_imu_gap [s]", s.max_imu_gap, 1e-6, 1.0);
  require(s.max_iterations >= 1, "LogCalibrationSettings.max_iterations", s.max_iterations,
          "at least 1");
}

}  // namespace tilt_ropter
