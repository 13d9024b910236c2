// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <array>
#include <cstddef>
#include <limits>
#include <optional>
#include <string_view>

/// Faults of simulated sensors, to try estimators on. Each fault acts for some time.
namespace tilt_ropter {

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
  imu_saturation    ///< rates are cut at `size` [rad/s], specific forces at ten times it [m/s^2]
};

inline constexpr std::array<std::string_view, 10> sensor_fault_names = {
    "pose_freeze", "pose_jump",   "pose_dropout",   "pose_jitter",   "pose_clock_step",
    "pose_ghost",  "imu_dropout", "imu_clock_step", "imu_vibration", "imu_saturation"};

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
  const bool positive = f.kind == SensorFaultKind::pose_jitter ||
                        f.kind == SensorFaultKind::imu_vibration ||
                        f.kind == SensorFaultKind::imu_saturation;
  require(!positive || f.size > 0.0, "SensorFault.size", f.size, "> 0 for this kind");
  require_in("SensorFault.frequency [Hz]", f.frequency, 1e-3, 1e4);
}

}  // namespace tilt_ropter
