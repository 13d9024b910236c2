// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/simulation/delay_queue.hpp>
#include <tilt_ropter/simulation/gaussian_noise.hpp>
#include <tilt_ropter/simulation/sensor_faults.hpp>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

namespace tilt_ropter::detail {

/// Common part of all sensors: parameters, noise, sampling grid and delay.
template <typename Parameters, typename Measurement>
class SensorCore {
 public:
  SensorCore(const Parameters& given, std::uint64_t seed)
      : parameters(validated(given)),
        noise(seed),
        queue_(static_cast<std::size_t>(given.rate * given.delay) + 4) {}

  /// Returns true if a measurement is due at `time` [s]. Tolerates a rounding error of a thousandth
  /// of a period.
  [[nodiscard]] bool due(double time) noexcept {
    if (!std::isfinite(time)) return false;
    if (!started_) start_ = time;
    const double instant = std::floor((time - start_) * parameters.rate + 1e-3);
    if (started_ && instant <= last_instant_) return false;
    started_ = true;
    last_instant_ = instant;
    return true;
  }

  void push(const Measurement& m) noexcept { push(m.time, m); }
  /// For a measurement taken at `time` [s] with another stamp.
  void push(double time, const Measurement& m) noexcept { queue_.push(time + parameters.delay, m); }
  [[nodiscard]] std::optional<Measurement> pop(double time) noexcept { return queue_.pop(time); }

  void reset() noexcept {
    queue_.clear();
    started_ = false;
  }

  void add_fault(const SensorFault& fault) { faults_.push_back(validated(fault)); }
  /// Calls `act` with each fault that acts at `time` [s].
  template <typename Act>
  void for_faults(double time, Act act) const noexcept {
    for (const SensorFault& fault : faults_)
      if (fault.acts(time)) act(fault);
  }

  Parameters parameters;
  GaussianNoise noise;

 private:
  std::vector<SensorFault> faults_;
  DelayQueue<Measurement> queue_;
  bool started_ = false;
  double start_ = 0.0, last_instant_ = 0.0;
};

inline void require_timing(const std::string& sensor, double rate, double delay) {
  require_positive(sensor + ".rate [Hz]", rate);
  require_non_negative(sensor + ".delay [s]", delay);
  require(rate * delay <= 1e5, sensor + ".delay [s]", delay, "at most 1e5 periods of the rate");
}

}  // namespace tilt_ropter::detail
