// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/ekf_start.hpp>
#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/estimation/detail/heading_from_motion.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <new>
#include <type_traits>
#include <vector>

/// Filter of delayed measurements, and queue of those that wait for their time.
namespace tilt_ropter::detail {

/// Error-state filter for delayed measurements. The filter is at time(); the later IMU samples are
/// kept in a ring buffer, and ahead() is the state propagated through them to newest(). Samples are
/// in body axes, times in the clock of the IMU [s]. Only the constructor allocates and throws.
template <typename Scalar>
class DelayedFilter {
 public:
  using Sample = Timed<InertialSample<Scalar>>;

  /// Keeps at most `size` samples. Throws std::invalid_argument if a noise is out of range.
  DelayedFilter(const InertialNoise& inertial, const MarkerPoseNoise& pose, std::size_t size)
      : filter_(inertial, pose), samples_(size) {}

  /// Forgets everything. The state is `x`, without covariance.
  void reset(const InertialState<Scalar>& x) noexcept {
    phase_ = Phase::no_imu;
    stopped_at_ = 0.0;
    filter_.reset(x, ErrorStateFilter<Scalar>::Covariance::Zero());
    filter_.forget_wider_noise();
    ahead_ = x;
    heading_.end();
    begin({});
  }

  [[nodiscard]] bool has_imu() const noexcept { return phase_ > Phase::no_imu; }
  [[nodiscard]] bool started() const noexcept { return phase_ >= Phase::stopped; }
  [[nodiscard]] bool running() const noexcept { return phase_ >= Phase::bridged; }
  /// True if a gap or a step of the IMU's clock was bridged, and no pose was used since.
  [[nodiscard]] bool is_bridged() const noexcept { return phase_ == Phase::bridged; }
  /// Last time at which the filter ran, if it is stopped or a gap was bridged [s].
  [[nodiscard]] double stopped_at() const noexcept { return stopped_at_; }

  [[nodiscard]] const ErrorStateFilter<Scalar>& filter() const noexcept { return filter_; }
  [[nodiscard]] double time() const noexcept { return from_.time; }
  [[nodiscard]] const InertialState<Scalar>& ahead() const noexcept { return ahead_; }
  [[nodiscard]] const Sample& newest() const noexcept { return newest_; }
  /// Angular velocity at time(), body frame [rad/s].
  [[nodiscard]] Vector3<Scalar> rate() const noexcept {
    return from_.value.angular_velocity - filter_.state().gyro_bias;
  }
  /// Mean of the angular velocity over some 20 ms up to time(), without most of its noise.
  [[nodiscard]] Vector3<Scalar> mean_rate() const noexcept {
    return mean_rate_ - filter_.state().gyro_bias;
  }

  /// Adds a sample later than newest(). If the buffer is full, the filter advances by one sample.
  void push(const Sample& sample) noexcept {
    if (count_ == samples_.size()) catch_up(at(0).time);
    if (running()) ahead_ = step(ahead_, newest_, sample);
    samples_[(first_ + count_++) % samples_.size()] = sample;
    newest_ = sample;
  }

  /// Advances the filter to `time`, if `time` is later. Interpolates the last sample.
  void catch_up(double time) noexcept {
    const auto move_to = [this](const Sample& to) {
      constexpr double span = 0.02;  // [s]
      const double dt = to.time - from_.time;
      if (running()) filter_.predict(mean(from_, to), Scalar(dt));
      heading_.predict(mean(from_, to), Scalar(dt));
      mean_rate_ += Scalar(std::min(1.0, dt / span)) * (to.value.angular_velocity - mean_rate_);
      from_ = to;
    };
    while (count_ > 0 && at(0).time <= time) {
      move_to(at(0));
      first_ = (first_ + 1) % samples_.size();
      --count_;
    }
    if (count_ > 0 && from_.time < time) move_to(between(from_, at(0), time));
  }

  /// Begins at the first sample, or at a sample after a gap. A filter that runs stops at newest().
  void begin_after_gap(const Sample& sample) noexcept {
    const double gap = sample.time - newest_.time;
    if (running()) {
      filter_.reset(ahead_, filter_.covariance());
      stopped_at_ = sample.time - gap;
    }
    phase_ = started() ? Phase::stopped : Phase::not_started;
    filter_.forget_wider_noise();
    begin(sample);
  }

  /// Begins at a sample after the clock was set back to `first` [s]. The estimate is kept, because
  /// there may be no pose. The time since `first` is bridged if it is at most `max_gap` [s].
  void begin_in_new_clock(const Sample& sample, double first, double max_gap) noexcept {
    // After a single wrong stamp the time since the filter ran is still known.
    const double stopped_for = sample.time - stopped_at_;
    if (running() || !(stopped_for >= 0.0 && stopped_for < 1.0))
      stopped_at_ = sample.time - std::abs(first - newest_.time);
    if (running()) {
      phase_ = sample.time - first <= max_gap ? Phase::bridged : Phase::stopped;
      if (running()) ahead_ = step(ahead_, {first, newest_.value}, sample);
      filter_.reset(ahead_, filter_.covariance());
      begin_heading_again();
    }
    begin(sample);
  }

  /// Bridges a short gap, for measurements other than poses. Returns true if the filter runs.
  bool resume() noexcept {
    if (started() && detail::resume(filter_, time() - stopped_at_, rate())) {
      phase_ = Phase::bridged;
      begin_heading_again();
    }
    return running();
  }

  /// Changes state and covariance by `change(filter)`.
  template <typename Change>
  void change(const Change& change) noexcept {
    change(filter_);
    look_ahead();
  }
  /// The filter runs after a start, and nothing is bridged after a pose was used.
  void set_running() noexcept { phase_ = Phase::running; }
  /// Whether the heading of a start is right.
  [[nodiscard]] HeadingFromMotion<Scalar>& heading() noexcept { return heading_; }
  /// Stops until the next pose, which knows nothing of the time before.
  void stop() noexcept {
    phase_ = Phase::stopped;
    stopped_at_ = -std::numeric_limits<double>::infinity();
  }

 private:
  enum class Phase { no_imu, not_started, stopped, bridged, running };

  void begin(const Sample& sample) noexcept {
    count_ = 0;
    from_ = newest_ = sample;
    mean_rate_ = sample.value.angular_velocity;
  }
  /// Over a gap the attitude is not that of the gyroscope alone.
  void begin_heading_again() noexcept {
    if (heading_.is_open()) heading_.begin(filter_.state());
  }

  /// Propagates the filter's state to the newest sample.
  void look_ahead() noexcept {
    ahead_ = filter_.state();
    Sample from = from_;
    for (std::size_t i = 0; i < count_; from = at(i++)) ahead_ = step(ahead_, from, at(i));
  }

  static InertialState<Scalar> step(const InertialState<Scalar>& x, const Sample& from,
                                    const Sample& to) noexcept {
    return propagate(x, mean(from, to), Scalar(to.time - from.time));
  }

  [[nodiscard]] const Sample& at(std::size_t i) const noexcept {
    return samples_[(first_ + i) % samples_.size()];
  }

  static InertialSample<Scalar> mean(const Sample& a, const Sample& b) noexcept {
    return {(a.value.angular_velocity + b.value.angular_velocity) / Scalar(2),
            (a.value.specific_force + b.value.specific_force) / Scalar(2)};
  }

  /// Interpolates the IMU linearly between two samples.
  static Sample between(const Sample& a, const Sample& b, double time) noexcept {
    const Scalar fraction = Scalar((time - a.time) / (b.time - a.time));
    const InertialSample<Scalar>&from = a.value, &to = b.value;
    return {time,
            {from.angular_velocity + fraction * (to.angular_velocity - from.angular_velocity),
             from.specific_force + fraction * (to.specific_force - from.specific_force)}};
  }

  ErrorStateFilter<Scalar> filter_;
  HeadingFromMotion<Scalar> heading_;
  InertialState<Scalar> ahead_;
  Vector3<Scalar> mean_rate_ = Vector3<Scalar>::Zero();
  Sample from_ = {}, newest_ = {};
  std::vector<Sample> samples_;  ///< those later than from_
  std::size_t first_ = 0, count_ = 0;
  double stopped_at_ = 0.0;
  Phase phase_ = Phase::no_imu;
};

/// Holds any copyable measurement of at most `capacity` bytes, and passes it to its receiver.
/// `Receiver` has a member template `apply(time, measurement)`.
template <typename Receiver>
class StoredMeasurement {
 public:
  static constexpr std::size_t capacity = 512;

  StoredMeasurement() noexcept = default;
  StoredMeasurement(const StoredMeasurement& other) noexcept { *this = other; }
  StoredMeasurement& operator=(const StoredMeasurement& other) noexcept {
    if (this == &other) return *this;
    time = other.time;
    act_ = other.act_;
    if (act_ != nullptr) act_(other.bytes_.data(), time, nullptr, bytes_.data());
    return *this;
  }
  ~StoredMeasurement() = default;

  template <typename Measurement>
  void set(double at, const Measurement& measurement) noexcept {
    static_assert(sizeof(Measurement) <= capacity && alignof(Measurement) <= alignment,
                  "the measurement is too large to wait");
    static_assert(std::is_trivially_destructible_v<Measurement>,
                  "a measurement is plain data: numbers and vectors of fixed size");
    time = at;
    act_ = &act<Measurement>;
    new (bytes_.data()) Measurement(measurement);
  }

  void apply(Receiver& receiver) const noexcept { act_(bytes_.data(), time, &receiver, nullptr); }

  double time = 0.0;

 private:
  static constexpr std::size_t alignment = 64;

  /// Passes a measurement to a receiver, or copies it to other bytes if there is none.
  template <typename Measurement>
  static void act(const void* from, double at, Receiver* receiver, void* to) noexcept {
    const Measurement& measurement = *static_cast<const Measurement*>(from);
    if (receiver != nullptr)
      receiver->apply(at, measurement);
    else
      new (to) Measurement(measurement);
  }

  alignas(alignment) std::array<unsigned char, capacity> bytes_ = {};
  void (*act_)(const void*, double, Receiver*, void*) noexcept = nullptr;
};

/// At most `Size` measurements by their times, those of equal time in the order in which they came.
template <typename Receiver, std::size_t Size>
class MeasurementQueue {
 public:
  [[nodiscard]] bool has_room() const noexcept { return count_ < Size; }
  /// Adds a measurement. There must be room.
  template <typename Measurement>
  void push(double time, const Measurement& measurement) noexcept {
    std::size_t place = count_++;
    for (; place > 0 && entries_[place - 1].time > time; --place)
      entries_[place] = entries_[place - 1];
    entries_[place].set(time, measurement);
  }

  [[nodiscard]] bool has_until(double time) const noexcept {
    return count_ > 0 && entries_[0].time <= time;
  }

  /// Removes and returns the first measurement. The queue must not be empty.
  [[nodiscard]] StoredMeasurement<Receiver> pop() noexcept {
    const StoredMeasurement<Receiver> first = entries_[0];
    --count_;
    for (std::size_t i = 0; i < count_; ++i) entries_[i] = entries_[i + 1];
    return first;
  }

  void clear() noexcept { count_ = 0; }

 private:
  std::array<StoredMeasurement<Receiver>, Size> entries_;
  std::size_t count_ = 0;
};

}  // namespace tilt_ropter::detail
