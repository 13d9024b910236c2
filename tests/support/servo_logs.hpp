#pragma once

#include <tilt_ropter/identification/servo_identification.hpp>

#include "support/random.hpp"

#include <array>
#include <vector>

/// Logs for tests of the identification of a servo.
namespace test_support {

/// Adds white noise with the standard deviation `size` [rad].
inline void add_noise(std::vector<double>& angles, double size, Random& random) {
  for (double& angle : angles) angle += random.normal(size);
}

/// A square wave with a period of 1 s, recorded for 4 s at `rate` [Hz] without noise.
inline tilt_ropter::ServoLog square_log(const tilt_ropter::ServoModel& servo, double size = 0.3,
                                        double rate = 200.0) {
  tilt_ropter::ServoLog log;
  for (int i = 0; i < static_cast<int>(4.0 * rate); ++i) {
    log.times.push_back(i / rate);
    log.commands.push_back(static_cast<int>(i / (0.5 * rate)) % 2 == 1 ? size : 0.0);
  }
  log.angles = tilt_ropter::servo_response(servo, log.times, log.commands, log.times);
  return log;
}

/// A servo with typical values of all parameters.
inline constexpr tilt_ropter::ServoModel usual{0.08, 0.021, 0.95, 0.05, 0.05};

/// Returns the parameters of the model in the order of its members.
inline std::array<double, 5> numbers(const tilt_ropter::ServoModel& m) {
  return {m.time_constant, m.dead_time, m.gain, m.offset, m.initial_angle};
}

}  // namespace test_support
