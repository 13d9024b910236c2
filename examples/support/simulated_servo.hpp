#pragma once

#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/identification/servo_identification.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <stdexcept>

/// The step response experiment on a simulated servo.
namespace examples {

/// A servo with an encoder, and the steps of its command.
struct SimulatedServo {
  tilt_ropter::ServoParameters parameters = tilt_ropter::tilt_ropter_vehicle().servo;
  double gain = 0.97, offset = 0.02;                   ///< of the angle [rad/rad], [rad]
  double step = 0.4;                                   ///< largest step and largest command [rad]
  double rate = 200.0;                                 ///< of the samples [Hz]
  double duration = 12.0;                              ///< of the log [s]
  double noise = 0.002;                                ///< stddev of the encoder [rad]
  double resolution = 2.0 * tilt_ropter::pi / 4096.0;  ///< of the encoder; 0: no rounding [rad]
};

/// Returns a log. The command changes between levels, by at most `step`, every 0.2 to 0.8 s. The
/// encoder is read at intervals that vary by 30 %, with noise and rounding. Throws
/// std::runtime_error if the dead time is too long for the rate.
[[nodiscard]] inline tilt_ropter::ServoLog log_of(const SimulatedServo& o, std::uint64_t seed) {
  using namespace tilt_ropter;
  // Servo stores at most this number of commands that wait for their dead time.
  if (o.parameters.dead_time * o.rate > 0.7 * (Servod::capacity - 1))
    throw std::runtime_error("--dead-time times --rate must be at most 44");
  Servod servo(o.parameters);
  GaussianNoise noise(seed);
  std::mt19937_64 generator(seed);
  const auto uniform = [&generator](double low, double high) {
    return low + (high - low) * 0x1.0p-53 * static_cast<double>(generator() >> 11U);
  };
  ServoLog log;
  double time = 0.0, next = 0.5, command = 0.0;
  servo.reset(o.offset, time);
  while (time < o.duration) {
    if (time >= next) {
      // Draws a level in [-step, step] that differs from the last level by step / 2 to step.
      const double low = std::max(-o.step, command - o.step);
      const double high = std::min(o.step, command + o.step);
      double level = command;
      while (std::abs(level - command) < 0.5 * o.step) level = uniform(low, high);
      command = level;
      next = time + uniform(0.2, 0.8);
    }
    const double angle = servo.update(time, o.gain * command + o.offset) + o.noise * noise.draw();
    const double seen =
        o.resolution > 0.0 ? o.resolution * std::round(angle / o.resolution) : angle;
    log.times.push_back(time);
    log.commands.push_back(command);
    log.angles.push_back(seen);
    time += uniform(0.7, 1.3) / o.rate;
  }
  return log;
}

}  // namespace examples
