// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/measurements.hpp>

#include <array>
#include <cstddef>
#include <limits>

/// Results of Ekf: status of a measurement, counts, and the reliability of the estimate.
namespace tilt_ropter {

/// Result of processing a measurement. Only `updated`, `started` and `restarted` change the
/// estimate.
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

[[nodiscard]] inline const char* to_string(EkfStatus status) {
  constexpr std::array<const char*, 11> names = {"updated", "started",  "restarted", "waiting",
                                                 "stopped", "gated",    "duplicate", "late",
                                                 "early",   "rejected", "frozen"};
  return names[static_cast<std::size_t>(status)];
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
  degraded,        ///< position or velocity error above its limit, attitude good
  position_lost,   ///< position error above lost_position_error, attitude good: land
  starting,        ///< not started, or the velocity is not known yet after a start
  lost             ///< IMU silent or stopped, or attitude error above its limit
};

[[nodiscard]] inline const char* to_string(EstimateState state) {
  constexpr std::array<const char*, 6> names = {"good",          "dead_reckoning", "degraded",
                                                "position_lost", "starting",       "lost"};
  return names[static_cast<std::size_t>(state)];
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
  // Reasons. Several may apply.
  bool imu_silent = false;      ///< no IMU sample within imu_age
  bool imu_stopped = false;     ///< gap of the IMU, nothing used since
  bool no_position = false;     ///< no pose or position within position_age
  bool poses_frozen = false;    ///< the last pose or position was a repetition
  bool poses_disputed = false;  ///< the last pose or position was refused by the gate
  bool poses_mistimed = false;  ///< the last pose or position was late or early
  /// The filter has restarted at measurements of something at rest, and no motion has confirmed
  /// since that they are those of the vehicle. Hold the position, then land: the descent confirms
  /// them or has them refused.
  bool unconfirmed = false;
  bool position_error = false;     ///< predicted position error above its limit
  bool velocity_error = false;     ///< predicted velocity error above its limit
  bool orientation_error = false;  ///< predicted attitude error above its limit

  [[nodiscard]] double age_of(MeasurementKind kind) const noexcept {
    return age[static_cast<std::size_t>(kind)];
  }
};

}  // namespace tilt_ropter
