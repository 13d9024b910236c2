// Identification of a servo from any log with any settings.

#include <tilt_ropter/identification/servo_identification.hpp>

#include "fuzz/input.hpp"

#include <algorithm>
#include <cmath>

using namespace tilt_ropter;

namespace {

bool is_finite(const ServoModel& m) {
  return std::isfinite(m.time_constant) && std::isfinite(m.dead_time) && std::isfinite(m.gain) &&
         std::isfinite(m.offset) && std::isfinite(m.initial_angle);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  ServoIdentificationSettings s;
  if (input.coin()) input.vary_all(s.max_dead_time);
  s.max_iterations = input.integer(0, 100);

  // A servo that follows its command. The input bytes replace some samples.
  ServoLog log;
  const int rows = input.integer(0, 60);
  const double period = input.number(0.05);
  double angle = 0.0, command = 0.0;
  for (int i = 0; i < rows; ++i) {
    if (input.integer(0, 7) == 0) command = input.number(1.0);
    angle += 0.2 * (command - angle);
    log.times.push_back(input.integer(0, 31) == 0 ? input.number(3.0) : std::abs(period) * i);
    log.commands.push_back(command);
    log.angles.push_back(input.integer(0, 31) == 0 ? input.number(1.0) : angle);
  }
  if (input.integer(0, 31) == 0) log.angles.push_back(0.0);

  ServoIdentification found;
  if (!fuzz::accepted([&] { found = identify_servo(log, s); })) return 0;
  if (found.status != ServoIdentificationStatus::identified) return 0;
  fuzz::expect(is_finite(found.model) && is_finite(found.half_width),
               "what was identified is finite");
  fuzz::expect(std::isfinite(found.residual_rms) && found.r_squared <= 1.0 + 1e-9,
               "residual and explained share are numbers");
  fuzz::expect(found.model.time_constant >= s.min_time_constant &&
                   found.model.time_constant <= s.max_time_constant &&
                   found.model.dead_time >= 0.0 && found.model.dead_time <= s.max_dead_time,
               "the model is among those looked for");
  return 0;
}
