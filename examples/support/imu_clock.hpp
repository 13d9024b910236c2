#pragma once

#include <cmath>

namespace examples {

/// Stamps of the IMU in the clock of the ticks. If the clock of the IMU alone is set, the models of
/// the controller would otherwise be updated in two clocks. Does not allocate or throw.
class ImuClock {
 public:
  /// Returns the time of a sample. A stamp that jumps counts as set if it does not follow the ticks
  /// either: after a pause of the IMU it does.
  double on_sample(double stamp) {
    if (!std::isfinite(stamp)) return stamp;  // the filter refuses it
    double time = stamp + offset_;
    if (has_tick_ && differ(time, time_) && differ(time, tick_)) {
      offset_ += time_ + period_ - time;
      time = time_ + period_;
      was_set_ = true;
    } else if (time > time_ && time < time_ + limit) {
      period_ = time - time_;
    }
    stamp_ = stamp;
    time_ = time;
    return time;
  }

  /// The time of a tick. If it follows a stamp that has jumped, all clocks were set.
  void on_tick(double time) {
    if (was_set_ && !differ(stamp_, time)) offset_ = 0.0;
    was_set_ = false;
    tick_ = time;
    has_tick_ = true;
  }

 private:
  static constexpr double limit = 0.02;  // [s]
  static bool differ(double a, double b) { return !(std::abs(a - b) <= limit); }

  double offset_ = 0.0;               // tick - stamp
  double stamp_ = 0.0, time_ = 0.0;   // of the last sample
  double tick_ = 0.0, period_ = 0.0;  // of samples
  bool has_tick_ = false, was_set_ = false;
};

}  // namespace examples
