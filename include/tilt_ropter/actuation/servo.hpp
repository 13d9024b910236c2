// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/clock.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Servo that tilts an arm: first-order lag (paper, Sec. External Wrench Estimation) with rate
/// limit, range and dead time.
namespace tilt_ropter {

/// Angle of one servo. Between two updates the command is held and
/// d(angle)/dt = clamp((command - angle) / time_constant, +-max_rate) is solved in closed form. The
/// solution is a ramp while the rate limit is active, then an exponential. The result therefore
/// does not depend on the update rate. Does not allocate. Only the constructor throws.
///
/// Commands wait for their dead time in a ring buffer of `capacity` entries. Two commands closer
/// than dead_time / (capacity - 1) share an entry. The later command then takes effect at the time
/// of the earlier command, too early by up to this spacing. If updates are further apart than this
/// spacing, the dead time is exact (1 kHz: dead times up to 63 ms).
template <typename Scalar>
class Servo {
 public:
  static constexpr std::size_t capacity = 64;

  /// Starts at zero or the nearest angle in range. Throws std::invalid_argument if validate() does.
  explicit Servo(const ServoParameters& parameters = {}) : parameters_(parameters) {
    validate(parameters);
    angle_ = command_ = bounded(Scalar(0));
  }

  /// Advances the angle to `time` [s] under the earlier commands. Then accepts `command` [rad],
  /// clamped to the range, which acts from time + dead_time on. The first update, and one after
  /// clock_was_set_back(), starts the clock and does not change the angle. Ignores a command or
  /// time that is not finite, and a time before the last time. Returns the angle at `time`.
  Scalar update(double time, const Scalar& command) noexcept {
    using std::abs;
    const bool usable =
        std::isfinite(time) && abs(command) < Scalar(std::numeric_limits<double>::infinity());
    if (!usable) return angle_;
    if (started_ && clock_was_set_back(time, time_)) set_clock(time);
    if (started_ && time < time_) return angle_;
    if (!started_) time_ = time;
    started_ = true;
    push(time + parameters_.dead_time, bounded(command));
    while (waiting_ > 0 && queue_[first_].time <= time) {
      move_to(queue_[first_].time);
      command_ = queue_[first_].command;
      first_ = (first_ + 1) % capacity;
      --waiting_;
    }
    move_to(time);
    return angle_;
  }

  /// Sets angle and command [rad], clamped to the range, at `time` [s]. Discards waiting commands.
  void reset(const Scalar& angle, double time) noexcept {
    angle_ = command_ = bounded(angle);
    time_ = time;
    started_ = std::isfinite(time);
    waiting_ = 0;
  }

  [[nodiscard]] const Scalar& angle() const noexcept { return angle_; }  ///< [rad]

 private:
  struct Waiting {
    double time = 0.0;  ///< time at which the command takes effect [s]
    Scalar command{};
  };

  // The waiting commands keep their remaining dead time.
  void set_clock(double time) noexcept {
    for (std::size_t i = 0; i < waiting_; ++i) queue_[(first_ + i) % capacity].time += time - time_;
    time_ = time;
  }

  void push(double time, const Scalar& command) noexcept {
    const double spacing = parameters_.dead_time / static_cast<double>(capacity - 1);
    if (waiting_ > 0) {
      Waiting& youngest = queue_[(first_ + waiting_ - 1) % capacity];
      if (time - youngest.time < spacing || waiting_ == capacity) {
        youngest.command = command;
        return;
      }
    }
    queue_[(first_ + waiting_) % capacity] = {time, command};
    ++waiting_;
  }

  void move_to(double time) noexcept {
    using std::abs;
    using std::exp;
    const double duration = time - time_;
    if (duration <= 0.0) return;
    time_ = time;
    const Scalar rate = Scalar(parameters_.max_rate);
    const Scalar time_constant = Scalar(parameters_.time_constant);
    Scalar error = command_ - angle_;
    Scalar rest = Scalar(duration);
    // Above this error the rate limit is active.
    const Scalar knee = rate * time_constant;
    if (abs(error) > knee) {
      const Scalar ramp = (abs(error) - knee) / rate;
      const Scalar direction = error > Scalar(0) ? Scalar(1) : Scalar(-1);
      if (ramp >= rest) {
        angle_ = bounded(angle_ + direction * rate * rest);
        return;
      }
      error = direction * knee;
      rest -= ramp;
    }
    angle_ = bounded(command_ - error * exp(-rest / time_constant));
  }

  [[nodiscard]] Scalar bounded(const Scalar& angle) const noexcept {
    const Scalar lower = Scalar(parameters_.min_angle), upper = Scalar(parameters_.max_angle);
    if (!(angle > lower)) return lower;
    return angle < upper ? angle : upper;
  }

  ServoParameters parameters_;
  Scalar angle_{};
  Scalar command_{};
  double time_ = 0.0;
  bool started_ = false;
  std::array<Waiting, capacity> queue_{};
  std::size_t first_ = 0;
  std::size_t waiting_ = 0;
};
using Servod = Servo<double>;  ///< in double precision

}  // namespace tilt_ropter
