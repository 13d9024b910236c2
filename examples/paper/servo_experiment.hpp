#pragma once

#include "../support/mission_log.hpp"
#include "../support/simulated_servo.hpp"
#include "table.hpp"

#include <tilt_ropter/identification/servo_identification.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <ostream>
#include <stdexcept>
#include <string>
#include <vector>

/// The identification of a servo with attached motor and propeller from its response to steps
/// (paper, Sec. External Wrench Estimation).
namespace examples::paper {

/// Pulse width of a hobby servo for an angle [us]: 1500 at zero, 500 more for a quarter turn.
[[nodiscard]] inline double pulse_width(double angle) {
  return 1500.0 + 1000.0 * angle / tilt_ropter::pi;
}

/// Simulates the servo of the Tilt-Ropter with a noisy encoder, identifies it, prints the result
/// and writes servo_identification.csv to `output`. Throws std::runtime_error if the servo is not
/// identified.
inline void identify_simulated_servo(std::ostream& out, const std::string& output,
                                     std::uint64_t seed) {
  SimulatedServo servo;
  servo.gain = 1.0;
  servo.offset = 0.0;
  servo.duration = 6.0;
  const tilt_ropter::ServoLog log = log_of(servo, seed);
  const tilt_ropter::ServoIdentification found = tilt_ropter::identify_servo(log);
  if (found.status != tilt_ropter::ServoIdentificationStatus::identified)
    throw std::runtime_error(std::string("servo: ") + to_string(found.status));
  const std::vector<double> fit =
      tilt_ropter::servo_response(found.model, log.times, log.commands, log.times);
  std::filesystem::create_directories(output);
  MissionLog file(output + "/servo_identification.csv",
                  {"time_s", "pwm_us", "command_rad", "angle_rad", "fit_rad"});
  for (std::size_t i = 0; i < fit.size(); ++i)
    file.add(log.times[i])
        .add(pulse_width(log.commands[i]))
        .add(log.commands[i])
        .add(log.angles[i])
        .add(fit[i])
        .end_row();
  out << "servo_true_time_constant_s: " << number(servo.parameters.time_constant, 5)
      << "\nservo_time_constant_s: " << number(found.model.time_constant, 5)
      << "\nservo_time_constant_95_s: " << number(found.half_width.time_constant, 5)
      << "\nservo_residual_rad: " << number(found.residual_rms, 5) << '\n';
}

}  // namespace examples::paper
