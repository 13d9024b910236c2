// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Settings and results of Ekf: status of a measurement, counts, reliability of the estimate.
namespace tilt_ropter {

/// Result of a measurement. Only `updated`, `started` and `restarted` change the estimate.
enum class EkfStatus {
  updated,    ///< used
  started,    ///< first pose: the filter starts at this pose
  restarted,  ///< the filter restarts at this measurement, after rejections or a gap of the IMU
  waiting,    ///< ahead of the IMU, or of fusion_delay: used when its time comes
  stopped,    ///< IMU sample after a gap: the estimate is frozen (see max_imu_gap)
  gated,      ///< too unlikely (NIS above the gate)
  duplicate,  ///< stamp was seen before
  late,       ///< older than an IMU sample, or a measurement, that was already used
  early,      ///< too far ahead of the IMU, before its first sample, or too many wait
  rejected,   ///< not finite, not a rotation, or absurd (1e3 rad/s, 1e5 m/s^2, 1e6 m)
  frozen      ///< the same values as before, bit for bit, while the IMU's samples changed
};

[[nodiscard]] constexpr const char* to_string(EkfStatus status) noexcept {
  return detail::name_in({"updated", "started", "restarted", "waiting", "stopped", "gated",
                          "duplicate", "late", "early", "rejected", "frozen"},
                         status);
}

/// Number of poses by result.
struct EkfCounts {
  long used = 0;      ///< updates, starts and restarts
  long restarts = 0;  ///< restarts among the used poses
  long gated = 0;
  long unused = 0;       ///< duplicate, late, early, rejected or frozen
  long frozen = 0;       ///< frozen poses among the unused poses
  long clock_steps = 0;  ///< corrections of the poses' clock; taking one back does not count
};

/// Reliability of the estimate, from good to bad. A supervisor acts on it: fly, hold, land by IMU.
enum class EstimateState {
  good,            ///< all predicted errors are within their limits, position is measured
  dead_reckoning,  ///< no recent position, but the predicted errors are within their limits
  /// Position or velocity error above its limit, attitude good; or the estimate contradicts its
  /// measurements, has just restarted, or has implausible biases: the reasons tell which.
  degraded,
  position_lost,  ///< position error above lost_position_error, attitude good: land
  starting,       ///< not started, or the velocity is not known yet after a start
  lost            ///< IMU silent or stopped, or attitude error above its limit
};

[[nodiscard]] constexpr const char* to_string(EstimateState state) noexcept {
  return detail::name_in(
      {"good", "dead_reckoning", "degraded", "position_lost", "starting", "lost"}, state);
}

/// Result of Ekf::trust().
struct EstimateTrust {
  EstimateState state = EstimateState::starting;
  double imu_age = std::numeric_limits<double>::infinity();  ///< of the newest IMU sample [s]
  /// Age of the last used measurement of each MeasurementKind [s]; infinite if there was none.
  std::array<double, static_cast<std::size_t>(measurement_kinds)> age = {};
  /// Predicted standard deviations at the time of the question, largest axis.
  double position_stddev = 0.0;     ///< [m]
  double velocity_stddev = 0.0;     ///< [m/s]
  double orientation_stddev = 0.0;  ///< [rad]
  /// Error of the poses' stamps against the IMU, found in motion and subtracted from them [s].
  double latency = 0.0;
  // Reasons. Several may apply.
  bool imu_silent = false;      ///< no IMU sample within imu_age
  bool imu_stopped = false;     ///< gap of the IMU, nothing used since
  bool no_position = false;     ///< no pose or position within position_age
  bool poses_frozen = false;    ///< the last pose or position was a repetition
  bool poses_gated = false;     ///< the last pose or position was above the gate
  bool poses_mistimed = false;  ///< the last pose or position was late or early
  /// The orientation of on_pose() has stepped while the positions went on: motion capture has
  /// defined the rigid body again. The positions alone are used, for 0.25 s or longer.
  bool orientation_unused = false;
  bool marker_turned = false;  ///< such a step was found: orientations are corrected by it
  /// The filter has restarted at measurements of something at rest, and no motion has confirmed
  /// since that they are those of the vehicle. Hold, then land: the descent confirms or gates them.
  bool unconfirmed = false;
  /// Restarted within the last second; within five if it was the second time in ten seconds.
  bool restarted = false;
  /// The measurements that were used deviate more than they should: their mean NIS is above three
  /// times their number of rows, poses contradict the IMU again and again, as with a wrong heading
  /// of the marker frame, or a heading contradicts gyroscope and positions, such as that of a
  /// compass that turns away: its weight is then small. The predicted errors are too small.
  bool inconsistent = false;
  /// A bias or the marker frame is more than five standard deviations from that of the settings, as
  /// with a wrong unit, sign or axis of the IMU.
  bool implausible_bias = false;
  /// Poses have shown that the IMU is wrong: its noise counts more, for up to a minute.
  bool imu_contradicted = false;
  bool position_error = false;     ///< predicted position error above its limit
  bool velocity_error = false;     ///< predicted velocity error above its limit
  bool orientation_error = false;  ///< predicted attitude error above its limit

  [[nodiscard]] double age_of(MeasurementKind kind) const noexcept {
    return age[static_cast<std::size_t>(kind)];
  }
};

/// Errors that the caller allows, for Ekf::trust(). An error counts as too large if `confidence`
/// times its predicted standard deviation exceeds the limit.
struct EkfTrustLimits {
  double position_error = 0.15;                  ///< allowed in normal operation [m]
  static constexpr double velocity_error = 0.5;  ///< allowed in normal operation [m/s]
  double orientation_error = 0.1;                ///< allowed at any time [rad]
  double lost_position_error = 1.0;              ///< above this the position counts as lost [m]
  /// Standard deviations between estimate and limit.
  static constexpr double confidence = 3.0;
  /// Longest time without a used position that is still normal operation [s].
  double position_age = 0.1;
  double imu_age = 0.05;  ///< longest time without IMU samples [s]
};

inline void validate(const EkfTrustLimits& s) {
  require_positive("EkfTrustLimits.position_error [m]", s.position_error);
  require_positive("EkfTrustLimits.orientation_error [rad]", s.orientation_error);
  require(std::isfinite(s.lost_position_error) && s.lost_position_error >= s.position_error,
          "EkfTrustLimits.lost_position_error [m]", s.lost_position_error,
          "finite and >= position_error");
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
  /// about this pose. If the estimate is more than five of them away when the filter starts again
  /// at a pose, it starts with the pose of the settings.
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
  /// Smallest number of consecutive poses above the gate before the filter restarts.
  int max_rejections = 25;
  /// Shortest time of consecutive gated poses before the filter restarts at them. They must move
  /// like the IMU during all this time. A jump that ends earlier is ignored.
  double restart_time = 1.0;
  /// Largest distance over which the filter restarts like this at rest, where no motion shows that
  /// the poses are those of the vehicle [m]. Angles count, 1 rad as 1 m. An object at rest beside a
  /// vehicle that hovers looks the same, and the estimate must not fall to the ground with it.
  double restart_distance = 0.6;
  /// Time without a used pose after which the filter restarts at poses that move smoothly, along a
  /// path of at least 0.3 m, although they do not move like the IMU: the estimate itself may be
  /// wrong. It does not restart like this at poses of an object at rest. Positions of a receiver
  /// count, too, along a path of eight of their standard deviations more.
  double full_restart_time = 6.0;
  /// Largest time between the arrivals of a measurement and of the IMU sample of the same time.
  double max_delay = 0.2;
  /// Fastest IMU [Hz]. The filter keeps the samples of max_delay, at this rate.
  double max_imu_rate = 8000.0;
  /// Measurements wait this time, so that those of different delays are used in the order of their
  /// stamps. With several sensors, set it to the longest delay of one; at most max_delay.
  double fusion_delay = 0.0;
  /// Longest pause of the IMU that is bridged. After a longer pause the next pose restarts the
  /// filter. After at most 0.4 s any other measurement resumes it, with a larger covariance.
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
  require_in("EkfSettings.full_restart_time [s]", s.full_restart_time, s.restart_time, 600.0);
  require_in("EkfSettings.max_delay [s]", s.max_delay, 1e-6, 10.0);
  require_in("EkfSettings.max_imu_rate [Hz]", s.max_imu_rate, 1.0, 1e5);
  require_in("EkfSettings.fusion_delay [s]", s.fusion_delay, 0.0, s.max_delay);
  require_in("EkfSettings.max_imu_gap [s]", s.max_imu_gap, 1e-6, 1.0);
  validate(s.trust);
}

}  // namespace tilt_ropter
