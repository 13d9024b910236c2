// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/error_state_filter.hpp>
#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

/// Settings of Ekf.
namespace tilt_ropter {

/// Errors that the caller allows, for Ekf::trust(). An error counts as too large if `confidence`
/// times its predicted standard deviation exceeds the limit.
struct EkfTrustLimits {
  double position_error = 0.15;      ///< allowed in normal operation [m]
  double velocity_error = 0.5;       ///< allowed in normal operation [m/s]
  double orientation_error = 0.1;    ///< allowed at any time [rad]
  double lost_position_error = 1.0;  ///< above this the position counts as lost [m]
  double confidence = 3.0;           ///< standard deviations between estimate and limit
  /// Longest time without a used position that is still normal operation [s].
  double position_age = 0.1;
  double imu_age = 0.05;  ///< longest time without IMU samples [s]
};

inline void validate(const EkfTrustLimits& s) {
  require_positive("EkfTrustLimits.position_error [m]", s.position_error);
  require_positive("EkfTrustLimits.velocity_error [m/s]", s.velocity_error);
  require_positive("EkfTrustLimits.orientation_error [rad]", s.orientation_error);
  require(std::isfinite(s.lost_position_error) && s.lost_position_error >= s.position_error,
          "EkfTrustLimits.lost_position_error [m]", s.lost_position_error,
          "finite and >= position_error");
  require_positive("EkfTrustLimits.confidence", s.confidence);
  require_positive("EkfTrustLimits.position_age [s]", s.position_age);
  require_positive("EkfTrustLimits.imu_age [s]", s.imu_age);
}

/// All times are in seconds. All stddev fields are standard deviations per axis.
struct EkfSettings {
  InertialNoise imu_noise;     ///< noise of the IMU
  MarkerPoseNoise pose_noise;  ///< noise of the poses

  /// Pose of the IMU in the body frame: position [m], and rotation IMU -> body.
  Eigen::Vector3d imu_position = Eigen::Vector3d::Zero();
  Eigen::Quaterniond imu_orientation = Eigen::Quaterniond::Identity();
  /// Standard deviation of imu_position [m]. Zero switches its estimation off. The estimate takes
  /// the positions of marker and sensors in the body frame as known, and needs motion like that of
  /// the marker frame. At most one of imu_position_stddev and marker_position_stddev is above zero,
  /// because the measurements show only the difference of the two positions.
  double imu_position_stddev = 0.0;

  /// Pose of the marker frame M in the body frame: origin of M [m], and rotation M -> body.
  Eigen::Vector3d marker_position = Eigen::Vector3d::Zero();
  Eigen::Quaterniond marker_orientation = Eigen::Quaterniond::Identity();
  /// Standard deviations of this pose. Zero switches its estimation off. If the estimation is on,
  /// it takes about ten seconds of motion about all axes. A vehicle at rest gives no information
  /// about this pose.
  double marker_position_stddev = 0.0;     ///< of marker_position [m]
  double marker_orientation_stddev = 0.0;  ///< of marker_orientation [rad]

  /// Time to add to the stamp of a pose to get the IMU's clock (see calibrate_clock).
  double clock_offset = 0.0;

  /// Biases at the start, such as those of calibrate_log().
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();           ///< [rad/s]
  Eigen::Vector3d accelerometer_bias = Eigen::Vector3d::Zero();  ///< [m/s^2]
  /// Initial standard deviations of the states that the first pose does not measure.
  double velocity_stddev = 15.0;           ///< of the velocity, about zero [m/s]
  double gyro_bias_stddev = 0.1;           ///< of gyro_bias [rad/s]
  double accelerometer_bias_stddev = 0.5;  ///< of accelerometer_bias [m/s^2]

  /// Largest NIS of a pose that is used. One in 10^4 valid poses exceeds 27.9. Other measurements
  /// have gates of the same probability.
  double gate = 27.9;
  /// Smallest number of consecutive poses refused by the gate before the filter restarts.
  int max_rejections = 25;
  /// Shortest time of consecutive refused poses before the filter restarts at them. They must move
  /// like the IMU during all this time. A jump that ends earlier is ignored.
  double restart_time = 1.0;
  /// Largest distance over which the filter restarts like this at rest, where no motion shows that
  /// the poses are those of the vehicle [m]. Angles count, 1 rad as 1 m. An object at rest beside a
  /// vehicle that hovers looks the same, and the estimate must not fall to the ground with it.
  double restart_distance = 0.6;
  /// Time without a used pose after which the filter restarts at poses that move smoothly, along a
  /// path of at least 0.3 m, although they do not move like the IMU. Then the estimate itself may
  /// be wrong. Of an object at rest this is not believed.
  double give_up_time = 6.0;
  /// Largest time by which a measurement may arrive after, or before, the IMU sample of the same
  /// time.
  double max_delay = 0.2;
  /// Fastest IMU [Hz]. The filter keeps the samples of max_delay, at this rate.
  double max_imu_rate = 8000.0;
  /// Measurements wait this time before they are used, so that measurements with different delays
  /// are used in the order of their stamps. Set it to the longest delay of a sensor if there are
  /// several sensors; at most max_delay.
  double fusion_delay = 0.0;
  /// Longest pause of the IMU that is bridged. After a longer pause the next pose restarts the
  /// filter. After at most 0.4 s any other measurement lets it go on, with a larger covariance.
  double max_imu_gap = 0.1;

  EkfTrustLimits trust;  ///< allowed errors, for Ekf::trust()
};

inline void validate(const EkfSettings& s) {
  validate(s.imu_noise);
  validate(s.pose_noise);
  const auto require_place = [](const char* field, const Eigen::Vector3d& place) {
    require(detail::all_entries(place, [](double x) { return std::abs(x) <= 100.0; }), field, place,
            "in [-100, 100] in every entry");
  };
  const auto require_rotation = [](const char* field, const Eigen::Quaterniond& q) {
    require(std::abs(q.norm() - 1.0) < 1e-6, field, q.coeffs(), "of unit length");
  };
  require_place("EkfSettings.imu_position [m]", s.imu_position);
  require_rotation("EkfSettings.imu_orientation", s.imu_orientation);
  require_in("EkfSettings.imu_position_stddev [m]", s.imu_position_stddev, 0.0, 100.0);
  require_place("EkfSettings.marker_position [m]", s.marker_position);
  require_rotation("EkfSettings.marker_orientation", s.marker_orientation);
  require_in("EkfSettings.marker_position_stddev [m]", s.marker_position_stddev, 0.0, 100.0);
  require(s.imu_position_stddev == 0.0 || s.marker_position_stddev == 0.0,
          "EkfSettings.marker_position_stddev [m]", s.marker_position_stddev,
          "0 if imu_position_stddev is above 0");
  require_in("EkfSettings.marker_orientation_stddev [rad]", s.marker_orientation_stddev, 0.0, 10.0);
  require_time("EkfSettings.clock_offset [s]", s.clock_offset);
  require(detail::all_entries(s.gyro_bias, [](double x) { return std::abs(x) <= 1e3; }),
          "EkfSettings.gyro_bias [rad/s]", s.gyro_bias, "in [-1000, 1000] in every entry");
  require(detail::all_entries(s.accelerometer_bias, [](double x) { return std::abs(x) <= 1e3; }),
          "EkfSettings.accelerometer_bias [m/s^2]", s.accelerometer_bias,
          "in [-1000, 1000] in every entry");
  require_in("EkfSettings.velocity_stddev [m/s]", s.velocity_stddev, 1e-6, 1e3);
  require_in("EkfSettings.gyro_bias_stddev [rad/s]", s.gyro_bias_stddev, 0.0, 1e3);
  require_in("EkfSettings.accelerometer_bias_stddev [m/s^2]", s.accelerometer_bias_stddev, 0.0,
             1e3);
  require_positive("EkfSettings.gate", s.gate);
  require(s.max_rejections >= 1, "EkfSettings.max_rejections", s.max_rejections, "at least 1");
  require_in("EkfSettings.restart_time [s]", s.restart_time, 0.0, 60.0);
  require_in("EkfSettings.restart_distance [m]", s.restart_distance, 0.0, 1e6);
  require_in("EkfSettings.give_up_time [s]", s.give_up_time, s.restart_time, 600.0);
  require_in("EkfSettings.max_delay [s]", s.max_delay, 1e-6, 10.0);
  require_in("EkfSettings.max_imu_rate [Hz]", s.max_imu_rate, 1.0, 1e5);
  require_in("EkfSettings.fusion_delay [s]", s.fusion_delay, 0.0, s.max_delay);
  require_in("EkfSettings.max_imu_gap [s]", s.max_imu_gap, 1e-6, 1.0);
  validate(s.trust);
}

}  // namespace tilt_ropter
