// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <algorithm>

namespace tilt_ropter::detail {

/// When a motion takes place. Before the start a motion is at its first point and after the end at
/// its last point. NaN counts as a time before the start.
class Timing {
 public:
  [[nodiscard]] double start_time() const noexcept { return start_; }            ///< [s]
  [[nodiscard]] double end_time() const noexcept { return start_ + duration_; }  ///< [s]
  [[nodiscard]] double duration() const noexcept { return duration_; }           ///< [s]

  /// Shifts the motion to start at `time` [s]; without a call it starts at zero. Throws
  /// std::invalid_argument if `time` is out of range.
  void set_start_time(double time) {
    require_time("start_time [s]", time);
    start_ = time;
  }

 protected:
  void set_timing(double start, double duration) noexcept {
    start_ = start;
    duration_ = duration;
  }
  /// Time since the start [s], between zero and the duration.
  [[nodiscard]] double elapsed(double time) const noexcept {
    const double since = time - start_;
    return since > 0.0 ? std::min(since, duration_) : 0.0;
  }

 private:
  double start_ = 0.0, duration_ = 0.0;
};

}  // namespace tilt_ropter::detail
