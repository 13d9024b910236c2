// Identifies a servo from a recorded log of commands and measured angles: time constant, dead time,
// gain and offset with their 95 % intervals, a CSV of the fit and a picture of it. Makes such logs,
// too, of a simulated servo with encoder, to try it on.

#include "support/csv.hpp"
#include "support/mission_log.hpp"
#include "support/pictures.hpp"

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

  std::string generate;  // the file, or empty
  std::uint64_t seed = 1;
  double time_constant = tilt_ropter_vehicle().servo.time_constant;
  double dead_time = 0.015, gain = 0.97, offset = 0.02;
  double step = 0.4, rate = 200.0, duration = 12.0;
  double noise = 0.002, resolution = 2.0 * pi / 4096.0;
};

// The servo moves between levels at most `step` apart, each held for 0.2 to 0.8 s; its encoder is
// read 30 % early or late, with noise, and rounds.
void generate(const Options& o) {
  ServoParameters parameters = tilt_ropter_vehicle().servo;
  parameters.time_constant = o.time_constant;
  parameters.dead_time = o.dead_time;
  // Of the commands that wait for their dead time, Servo keeps no more.
  if (o.dead_time * o.rate > 0.7 * (Servo<>::capacity - 1))
    throw std::runtime_error("--dead-time times --rate must be at most 44");
  Servo<> servo(parameters);
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
      // Between -step and step, and at least half a step away.
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
    std::cerr << "identify_servo: the residual has a shape that a first-order lag has not. If the "
                 "steps drove the servo to its rate limit, make them smaller.\n";
  std::cout << "fly with it: hybrid_mission --servo-time-constant " << std::setprecision(4)
            << found.model.time_constant << '\n';
  return 0;
}

constexpr const char* footer = R"(
The log has a header line, one sample a line, stamps that increase, as unevenly as they like. Each
command is held until the next one. Best are several steps, each held for some time constants, and
small: below rate limit times time constant (0.6 rad for 8 rad/s and 0.08 s).

In the output directory: identify_servo.csv, the log with the fitted angle beside it, and
identify_servo.png.

Exit code: 0 identified, 1 the log cannot tell (the status says why), 2 a file could not be read or
written, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Identifies a servo from a log of commands and measured angles."};
  Options o;
  CLI::Option* input = app.add_option("LOG.csv", o.input, "the log");
  app.add_option("-o,--output", o.output, "directory for the fit and its picture")
      ->capture_default_str();
  app.add_option("--time", o.time, "name of the column of time stamps [s]")->capture_default_str();
  app.add_option("--command", o.command, "of commands [rad]")->capture_default_str();
  app.add_option("--angle", o.angle, "of measured angles [rad]")->capture_default_str();
  app.add_option("--max-dead-time", o.max_dead_time, "longest that is looked for; 0: none [s]")
      ->check(CLI::Range(0.0, 10.0))
      ->capture_default_str();
  app.add_flag("--no-pictures", o.no_pictures, "write the fit only");
  const std::string group = "To make a log of a simulated servo instead";
  CLI::Option* generated = app.add_option("--generate", o.generate, "file to write it to")
                               ->group(group)
                               ->excludes(input);
  const auto add = [&](const char* name, double& value, const char* text, const CLI::Range& range) {
    app.add_option(name, value, text)
        ->check(range)
        ->capture_default_str()
        ->needs(generated)
        ->group(group);
  };
  app.add_option("--seed", o.seed, "of commands, jitter and noise")
      ->capture_default_str()
      ->needs(generated)
      ->group(group);
  add("--time-constant", o.time_constant, "of the servo [s]", CLI::Range(0.001, 10.0));
  add("--dead-time", o.dead_time, "of the servo [s]", CLI::Range(0.0, 1.0));
  add("--gain", o.gain, "of the servo", CLI::Range(-10.0, 10.0));
  add("--offset", o.offset, "of the servo [rad]", CLI::Range(-1.0, 1.0));
  add("--step", o.step, "largest, and largest command [rad]", CLI::Range(0.001, 1.5));
  add("--rate", o.rate, "of samples, which jitter by 30 % [Hz]", CLI::Range(1.0, 1e4));
  add("--duration", o.duration, "[s]", CLI::Range(0.1, 1e4));
  add("--noise", o.noise, "of the encoder [rad]", CLI::Range(0.0, 1.0));
  add("--resolution", o.resolution, "of the encoder; 0: any [rad]", CLI::Range(0.0, 1.0));
  app.footer(footer);
  CLI11_PARSE(app, argc, argv);
  try {
    if (!o.generate.empty()) {
      generate(o);
      return 0;
    }
    if (o.input.empty()) {
      std::cerr << "LOG.csv is required, or --generate\nRun with --help for more information.\n";
      return 106;
    }
    const int code = identify(o);
    if (code == 0 && !o.no_pictures) examples::draw_pictures("identify_servo.gp", o.output);
    return code;
  } catch (const std::exception& error) {
    std::cerr << "identify_servo: " << error.what() << '\n';
    return 2;
  }
}
