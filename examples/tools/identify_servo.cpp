// Identifies a servo from a recorded log of commands and measured angles: time constant, dead time,
// gain and offset with 95 % confidence intervals. Writes a CSV file and a picture of the fit. Can
// also generate a log of a simulated servo with an encoder.

#include "../support/csv.hpp"
#include "../support/fit_program.hpp"
#include "../support/mission_log.hpp"
#include "../support/simulated_servo.hpp"
#include "../support/ulog.hpp"

#include <tilt_ropter/identification/servo_identification.hpp>
#include <tilt_ropter/math/rotation.hpp>

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
#include <stdexcept>
#include <string>
#include <vector>

using namespace tilt_ropter;

namespace {

struct Options {
  std::string input, output = "results";
  std::string time = "time_s", command = "command_rad", angle = "angle_rad";
  std::string topic, command_topic;  // of a ULog; command_topic: empty: `topic`
  double max_dead_time = ServoIdentificationSettings{}.max_dead_time;
  bool no_pictures = false;

  std::string generate;  // output file of the simulated log, or empty
  std::uint64_t seed = 1;
  examples::SimulatedServo servo;
};

void generate(const Options& o) {
  const ServoLog log = examples::log_of(o.servo, o.seed);
  std::ofstream file(o.generate);
  if (!file) throw std::runtime_error("cannot write " + o.generate);
  const examples::SimulatedServo& s = o.servo;
  file << "# A simulated servo: time constant " << s.parameters.time_constant << " s, dead time "
       << s.parameters.dead_time << " s, gain " << s.gain << ", offset " << s.offset
       << " rad; encoder noise " << s.noise << " rad, resolution " << s.resolution << " rad; seed "
       << o.seed << '\n'
       << o.time << ',' << o.command << ',' << o.angle << '\n'
       << std::fixed << std::setprecision(6);
  for (std::size_t i = 0; i < log.times.size(); ++i)
    file << log.times[i] << ',' << log.commands[i] << ',' << log.angles[i] << '\n';
  if (!file.flush()) throw std::runtime_error("cannot write " + o.generate);
}

/// The samples of a topic; each command is the last one before, of its own topic.
ServoLog read_ulog(const Options& o) {
  const examples::Ulog file(o.input);
  for (const std::string& note : file.notes()) std::cerr << note << '\n';
  const std::string time = o.time == Options().time ? "timestamp" : o.time;
  const std::string& commands = o.command_topic.empty() ? o.topic : o.command_topic;
  const examples::CsvTable angles = file.table(o.topic, {time, o.angle});
  const examples::CsvTable given = file.table(commands, {time, o.command});
  ServoLog log;
  std::size_t next = 0;
  for (std::size_t i = 0; i < angles.rows(); ++i) {
    const double now = angles.columns[0][i];
    while (next < given.rows() && given.columns[0][next] <= now) ++next;
    const double values[] = {angles.columns[1][i], next > 0 ? given.columns[1][next - 1] : 0.0};
    if (next == 0 || !std::isfinite(values[0]) || !std::isfinite(values[1])) continue;
    if (!log.times.empty() && !(1e-6 * now > log.times.back()))
      throw InputFileError(o.input + ": byte " + std::to_string(angles.lines[i]) + ": " + time +
                           " of " + o.topic + " does not increase");
    log.times.push_back(1e-6 * now);
    log.angles.push_back(values[0]);
    log.commands.push_back(values[1]);
  }
  return log;
}

ServoLog read_log(const Options& o) {
  if (examples::is_ulog(o.input)) {
    if (o.topic.empty()) throw std::runtime_error(o.input + ": a ULog needs --topic");
    return read_ulog(o);
  }
  if (!o.topic.empty() || !o.command_topic.empty())
    throw std::runtime_error(o.input + ": --topic and --command-topic need a ULog");
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
  const auto [low, high] = std::minmax_element(log.angles.begin(), log.angles.end());
  if (*high - *low > 2.0 * pi)
    std::cerr << "identify_servo: the angles span " << std::setprecision(3) << *high - *low
              << " rad: are they degrees? gain and times are right, offset and residual are not in "
                 "radians.\n";
  if (found.model.gain < 0.5 || found.model.gain > 2.0)
    std::cerr << "identify_servo: the gain is far from 1: are command and angle in one unit?\n";
  std::cout << "fly with it: hybrid_mission --servo-time-constant " << std::setprecision(4)
            << found.model.time_constant << '\n'
            << "in a vehicle file: \"servo\": {\"time_constant_s\": " << found.model.time_constant
            << ", \"dead_time_s\": " << found.model.dead_time << "}\n";
  return 0;
}

constexpr const char* footer = R"(
The log has a header line, then one sample per line. Time stamps must increase; the intervals may
differ. Each command holds until the next one. Use several steps, each held for a few time
constants. Steps must be small: below rate limit times time constant (0.6 rad for 8 rad/s and
0.08 s).

A log of PX4 (ULog, .ulg) needs --topic, the topic with the angles, and the fields in it, such as
    identify_servo log.ulg --topic debug_array --angle 'data[0]' \
        --command-topic actuator_servos --command 'control[0]'
Times are in us as in PX4. The gain is that of the two fields, whatever their units.

Files in the output directory: identify_servo.csv, the log with the fitted angle, and
identify_servo.png.

Exit code: 0 identified, 1 the log does not determine the servo (see the status), 2 a file could not
be read or written, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Identifies a servo from a log of commands and measured angles."};
  Options o;
  o.servo.parameters.dead_time = 0.015;
  CLI::Option* input =
      app.add_option("LOG.csv", o.input, "log of commands and measured angles, or LOG.ulg of PX4");
  app.add_option("-o,--output", o.output, "directory for the fit and its picture")
      ->capture_default_str();
  app.add_option("--time", o.time, "name of the time stamp column [s]")->capture_default_str();
  app.add_option("--command", o.command, "name of the command column [rad]")->capture_default_str();
  app.add_option("--angle", o.angle, "name of the angle column [rad]")->capture_default_str();
  app.add_option("--topic", o.topic,
                 "topic of LOG.ulg with the angles, NAME or NAME:INSTANCE; --time (default "
                 "timestamp [us]), --command and --angle are its fields");
  app.add_option("--command-topic", o.command_topic,
                 "topic of LOG.ulg with the commands, if it is another one");
  app.add_option("--max-dead-time", o.max_dead_time,
                 "largest dead time to search for; 0: assume no dead time [s]")
      ->check(CLI::Range(0.0, 10.0))
      ->capture_default_str();
  app.add_flag("--no-pictures", o.no_pictures, "write only the fit");
  examples::GenerateOptions simulated(app, input, "log of a simulated servo", o.generate);
  simulated.add("--seed", o.seed, "random seed of commands, jitter and noise");
  simulated.add("--time-constant", o.servo.parameters.time_constant,
                "time constant of the servo [s]", CLI::Range(0.001, 10.0));
  simulated.add("--dead-time", o.servo.parameters.dead_time, "dead time of the servo [s]",
                CLI::Range(0.0, 1.0));
  simulated.add("--gain", o.servo.gain, "gain of the servo", CLI::Range(-10.0, 10.0));
  simulated.add("--offset", o.servo.offset, "angle offset of the servo [rad]",
                CLI::Range(-1.0, 1.0));
  simulated.add("--step", o.servo.step, "largest step and largest command [rad]",
                CLI::Range(0.001, 1.5));
  simulated.add("--rate", o.servo.rate, "sample rate; intervals vary by 30 % [Hz]",
                CLI::Range(1.0, 1e4));
  simulated.add("--duration", o.servo.duration, "duration of the log [s]", CLI::Range(0.1, 1e4));
  simulated.add("--noise", o.servo.noise, "standard deviation of the encoder noise [rad]",
                CLI::Range(0.0, 1.0));
  simulated.add("--resolution", o.servo.resolution,
                "resolution of the encoder; 0: no rounding [rad]", CLI::Range(0.0, 1.0));
  app.footer(footer);
  return examples::run_fit_program(app, "identify_servo", argc, argv, o, "LOG.csv", generate,
                                   identify);
}
