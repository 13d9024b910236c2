// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/inertial_state.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <cstddef>
#include <vector>

/// IMU samples between the time of a filter and the newest sample.
namespace tilt_ropter::detail {

/// Ring buffer of the IMU samples that a filter has not used yet. The filter is at the time of
/// from(). Only the constructor allocates.
template <typename Scalar>
class ImuHistory {
 public:
  using Sample = Timed<InertialSample<Scalar>>;

  explicit ImuHistory(std::size_t size) : samples_(size) {}

  /// Forgets all samples and begins at `sample`.
  void begin(const Sample& sample) noexcept {
    count_ = 0;
    from_ = newest_ = sample;
  }

  /// The IMU at the filter's time, and the newest sample.
  [[nodiscard]] const Sample& from() const noexcept { return from_; }
  [[nodiscard]] const Sample& newest() const noexcept { return newest_; }
  [[nodiscard]] bool is_full() const noexcept { return count_ == samples_.size(); }
  /// The sample after from(). There must be one.
  [[nodiscard]] const Sample& next() const noexcept { return at(0); }

  /// Adds a sample later than newest(). The history must not be full.
  void push(const Sample& sample) noexcept {
    samples_[(first_ + count_++) % samples_.size()] = sample;
    newest_ = sample;
  }

  /// Moves from() to `time`, if `time` is later. Calls advance(mean, duration) for each step, with
  /// the mean of its first and last sample and its duration [s]. Interpolates the last sample.
  template <typename Advance>
  void catch_up(double time, const Advance& advance) noexcept {
    const auto move_to = [&](const Sample& to) {
      advance(mean(from_, to), Scalar(to.time - from_.time));
      from_ = to;
    };
    while (count_ > 0 && at(0).time <= time) {
      move_to(at(0));
      first_ = (first_ + 1) % samples_.size();
      --count_;
    }
    if (count_ > 0 && from_.time < time) move_to(between(from_, at(0), time));
  }

  /// Returns the state `x` at from(), propagated to newest().
  [[nodiscard]] InertialState<Scalar> propagated(InertialState<Scalar> x) const noexcept {
    Sample from = from_;
    for (std::size_t i = 0; i < count_; from = at(i++)) x = step(x, from, at(i));
    return x;
  }

  /// Returns the state `x` at sample `from`, propagated to sample `to`.
  [[nodiscard]] static InertialState<Scalar> step(const InertialState<Scalar>& x,
                                                  const Sample& from, const Sample& to) noexcept {
    return propagate(x, mean(from, to), Scalar(to.time - from.time));
  }

 private:
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
    const auto blend = [fraction](const Vector3<Scalar>& from, const Vector3<Scalar>& to) {
      return Vector3<Scalar>(from + fraction * (to - from));
    };
    return {time,
            {blend(a.value.angular_velocity, b.value.angular_velocity),
             blend(a.value.specific_force, b.value.specific_force)}};
  }

  Sample from_ = {}, newest_ = {};
  std::vector<Sample> samples_;  ///< those later than from_
  std::size_t first_ = 0, count_ = 0;
};

}  // namespace tilt_ropter::detail
