// Identifies a servo from a recorded log of commands and measured angles: time constant, dead time,
// gain and offset with 95 % confidence intervals. Writes a CSV file and a picture of the fit. Can
// also generate a log of a simulated servo with an encoder.

#include "../support/csv.hpp"
#include "../support/fit_program.hpp"
#include "../support/mission_log.hpp"

#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/estimation/servo_identification.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/gaussian_noise.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <filesystem>
#include <fstream>
#include <functional>
#include <iomanip>
#include <iostream>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

using namespace tilt_ropter;

namespace {

struct Options {
  std::string input, output = "results";
  std::string time = "time_s", command = "command_rad", angle = "angle_rad";
  double max_dead_time = ServoIdentificationSettings{}.max_dead_time;
  bool no_pictures = false;

  std::string generate;  // output file of the simulated log, or empty
  std::uint64_t seed = 1;
  double time_constant = tilt_ropter_vehicle().servo.time_constant;
  double dead_time = 0.015, gain = 0.97, offset = 0.02;
  double step = 0.4, rate = 200.0, duration = 12.0;
  double noise = 0.002, resolution = 2.0 * pi / 4096.0;
};

// Simulates a servo whose command changes between levels, by at most `step`, every 0.2 to 0.8 s.
// The encoder is read at intervals that vary by 30 %, with noise and rounding.
void generate(const Options& o) {
  ServoParameters parameters = tilt_ropter_vehicle().servo;
  parameters.time_constant = o.time_constant;
  parameters.dead_time = o.dead_time;
  // Servo stores at most this number of commands that wait for their dead time.
  if (o.dead_time * o.rate > 0.7 * (Servod::capacity - 1))
    throw std::runtime_error("--dead-time times --rate must be at most 44");
  Servod servo(parameters);
  GaussianNoise noise(o.seed);
  std::mt19937_64 generator(o.seed);
  const auto uniform = [&generator](double low, double high) {
    return low + (high - low) * 0x1.0p-53 * static_cast<double>(generator() >> 11U);
  };

  std::ofstream file(o.generate);
  if (!file) throw std::runtime_error("cannot write " + o.generate);
  file << "# A simulated servo: time constant " << o.time_constant << " s, dead time "
       << o.dead_time << " s, gain " << o.gain << ", offset " << o.offset << " rad; encoder noise "
       << o.noise << " rad, resolution " << o.resolution << " rad; seed " << o.seed << '\n'
       << o.time << ',' << o.command << ',' << o.angle << '\n'
       << std::fixed << std::setprecision(6);
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
    file << time << ',' << command << ',' << seen << '\n';
    time += uniform(0.7, 1.3) / o.rate;
  }
  if (!file.flush()) throw std::runtime_error("cannot write " + o.generate);
}

ServoLog read_log(const Options& o) {
  const examples::CsvTable table = examples::read_csv(o.input, {o.time, o.command, o.angle});
  const std::vector<double>& times = table.columns[0];
  const auto step_back = std::adjacent_find(times.begin(), times.end(), std::greater_equal<>());
  if (step_back != times.end()) {
    const std::size_t line = table.lines[static_cast<std::size_t>(step_back - times.begin()) + 1];
    throw std::runtime_error(o.input + ':' + std::to_string(line) + ": column " + o.time +
                             " does not increase");
  }
  return {times, table.columns[1], table.columns[2]};
}

void print(const ServoIdentification& found) {
  std::cout << "status: " << to_string(found.status) << '\n'
            << "samples: " << found.samples << '\n';
  if (found.model.time_constant <= 0.0) return;  // refused before the fit
  const auto line = [](const char* key, double value) {
    std::cout << key << ": " << std::fixed << std::setprecision(5) << value << '\n';
  };
  line("time_constant_s", found.model.time_constant);
  line("time_constant_95_s", found.half_width.time_constant);
  line("dead_time_s", found.model.dead_time);
  line("dead_time_95_s", found.half_width.dead_time);
  line("gain", found.model.gain);
  line("gain_95", found.half_width.gain);
  line("offset_rad", found.model.offset);
  line("offset_95_rad", found.half_width.offset);
  line("residual_rad", found.residual_rms);
  line("residual_correlation", found.residual_correlation);
  line("r_squared", found.r_squared);
}

void write_fit(const Options& o, const ServoLog& log, const ServoModel& model) {
  const std::vector<double> fit = servo_response(model, log.times, log.commands, log.times);
  std::filesystem::create_directories(o.output);
  examples::MissionLog file(o.output + "/identify_servo.csv",
                            {"time_s", "command_rad", "angle_rad", "fit_rad"});
  for (std::size_t i = 0; i < fit.size(); ++i)
    file.add(log.times[i] - log.times.front())
        .add(log.commands[i])
        .add(log.angles[i])
        .add(fit[i])
        .end_row();
}

int identify(const Options& o) {
  const ServoLog log = read_log(o);
  ServoIdentificationSettings settings;
  settings.max_dead_time = o.max_dead_time;
  const ServoIdentification found = identify_servo(log, settings);
  print(found);
  if (found.model.time_constant > 0.0) write_fit(o, log, found.model);
  if (found.status != ServoIdentificationStatus::identified) {
    std::cerr << "identify_servo: " << o.input << ": " << to_string(found.status) << '\n';
    return 1;
  }
  if (found.residual_correlation > 0.5)
    std::cerr
        << "identify_servo: the residual is correlated: a first-order lag does not fit well. If "
           "the steps reached the rate limit of the servo, make them smaller.\n";
  std::cout << "fly with it: hybrid_mission --servo-time-constant " << std::setprecision(4)
            << found.model.time_constant << '\n';
  return 0;
}

constexpr const char* footer = R"(
The log has a header line, then one sample per line. Time stamps must increase; the intervals may
differ. Each command holds until the next one. Use several steps, each held for a few time
constants. Steps must be small: below rate limit times time constant (0.6 rad for 8 rad/s and
0.08 s).

Files in the output directory: identify_servo.csv, the log with the fitted angle, and
identify_servo.png.

Exit code: 0 identified, 1 the log does not determine the servo (see the status), 2 a file could not
be read or written, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Identifies a servo from a log of commands and measured angles."};
  Options o;
  CLI::Option* input = app.add_option("LOG.csv", o.input, "log of commands and measured angles");
  app.add_option("-o,--output", o.output, "directory for the fit and its picture")
      ->capture_default_str();
  app.add_option("--time", o.time, "name of the time stamp column [s]")->capture_default_str();
  app.add_option("--command", o.command, "name of the command column [rad]")->capture_default_str();
  app.add_option("--angle", o.angle, "name of the angle column [rad]")->capture_default_str();
  app.add_option("--max-dead-time", o.max_dead_time,
                 "largest dead time to search for; 0: assume no dead time [s]")
      ->check(CLI::Range(0.0, 10.0))
      ->capture_default_str();
  app.add_flag("--no-pictures", o.no_pictures, "write only the fit");
  examples::GenerateOptions simulated(app, input, "log of a simulated servo", o.generate);
  simulated.add("--seed", o.seed, "random seed of commands, jitter and noise");
  simulated.add("--time-constant", o.time_constant, "time constant of the servo [s]",
                CLI::Range(0.001, 10.0));
  simulated.add("--dead-time", o.dead_time, "dead time of the servo [s]", CLI::Range(0.0, 1.0));
  simulated.add("--gain", o.gain, "gain of the servo", CLI::Range(-10.0, 10.0));
  simulated.add("--offset", o.offset, "angle offset of the servo [rad]", CLI::Range(-1.0, 1.0));
  simulated.add("--step", o.step, "largest step and largest command [rad]", CLI::Range(0.001, 1.5));
  simulated.add("--rate", o.rate, "sample rate; intervals vary by 30 % [Hz]", CLI::Range(1.0, 1e4));
  simulated.add("--duration", o.duration, "duration of the log [s]", CLI::Range(0.1, 1e4));
  simulated.add("--noise", o.noise, "standard deviation of the encoder noise [rad]",
                CLI::Range(0.0, 1.0));
  simulated.add("--resolution", o.resolution, "resolution of the encoder; 0: no rounding [rad]",
                CLI::Range(0.0, 1.0));
  app.footer(footer);
  return examples::run_fit_program(app, "identify_servo", argc, argv, o, "LOG.csv", generate,
                                   identify);
}
