// What a vehicle recovers from: steps, turns, knocks, throws, upside down, any state; what becomes
// of its commands on the way, and what the controller's ticks cost.

#include "support/mission_log.hpp"
#include "support/pictures.hpp"
#include "support/progress.hpp"
#include "support/run_program.hpp"
#include "support/stress_flight.hpp"
#include "support/vehicle_file.hpp"

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <iostream>
#include <limits>
#include <sstream>
#include <string>
#include <variant>
#include <vector>

using namespace examples;

namespace {

struct Options {
  std::string output = "results", vehicle, scenario = "random";
  double size = 0.0, height = 0.0, duration = 15.0, time_limit_us = 0.0;
  std::uint64_t seed = 1, first = 0, count = 10;
  bool no_pictures = false;
};

/// Sums up flights as they come.
struct Summary {
  std::uint64_t flights = 0, recovered = 0, worst_flight = 0;
  std::vector<double> hover_us;
  double worst_us = 0.0, worst_us_once = 0.0, worst_bound_ratio = 0.0, worst_solved = 0.0;
  double slowest_recovery = 0.0, lowest = 1e9;
  long ticks = 0, unsolved = 0, approximate = 0, failures = 0;
  int most_passes = 0;
  bool worst_recovered = true;

  void add(std::uint64_t index, const StressRecord& r, double repeated_us) {
    ++flights;
    recovered += r.recovered;
    hover_us.insert(hover_us.end(), r.hover_us.begin(), r.hover_us.end());
    worst_us_once = std::max(worst_us_once, r.worst_us());
    worst_bound_ratio = std::max(worst_bound_ratio, r.worst_bound_ratio);
    worst_solved = std::max(worst_solved, r.worst_solved);
    slowest_recovery = std::max(slowest_recovery, r.recovery_time);
    lowest = std::min(lowest, r.lowest);
    ticks += static_cast<long>(r.tick_us.size());
    unsolved += r.unsolved_called_solved;
    approximate += r.approximate;
    failures += r.failures;
    most_passes = std::max(most_passes, r.most_passes);
    // The worst is one that did not recover, else the one with the longest tick.
    if (flights == 1 || (worst_recovered && !r.recovered) ||
        (worst_recovered == r.recovered && repeated_us > worst_us))
      worst_flight = index;
    worst_recovered = worst_recovered && r.recovered;
    worst_us = std::max(worst_us, repeated_us);
  }
};

double median(std::vector<double> values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

std::string repeating_command(const Options& options, const std::string& program,
                              std::uint64_t index) {
  std::ostringstream command;
  command << program << " --scenario " << options.scenario << " --size " << options.size
          << " --height " << options.height << " --duration " << options.duration << " --seed "
          << options.seed << " --first " << index << " --count 1";
  if (options.time_limit_us > 0.0) command << " --time-limit-us " << options.time_limit_us;
  if (!options.vehicle.empty()) command << " --vehicle " << options.vehicle;
  return command.str();
}

template <int Rotors>
void run(const Options& options, const VehicleFile& file,
         const tilt_ropter::Vehicle<Rotors>& vehicle, const std::string& program) {
  const Scenario scenario = scenarios().at(options.scenario);
  tilt_ropter::NmpcSettings settings = file.settings();
  settings.time_limit = options.time_limit_us > 0.0 ? 1e-6 * options.time_limit_us
                                                    : std::numeric_limits<double>::infinity();
  std::filesystem::create_directories(options.output);
  MissionLog table(
      options.output + "/stress_flights.csv",
      {"flight", "recovered", "recovery_time_s", "lowest_m", "speed_mps", "tilt_deg", "rate_radps",
       "worst_tick_us", "most_passes", "bound_ratio", "approximate_ticks", "solver_failures"});
  MissionLog log(
      options.output + "/stress_flights_log.csv",
      {"flight", "recovered", "time_s", "distance_m", "angle_deg", "speed_mps", "height_m"});
  Summary all;
  Progress progress;
  constexpr double degrees = 180.0 / tilt_ropter::pi;
  for (std::uint64_t i = 0; i < options.count; ++i) {
    const std::uint64_t index = options.first + i;
    const StressStart start =
        stress_start(scenario, options.size, options.height, options.seed, index);
    const StressRecord r = fly_stress(vehicle, settings, start, options.duration);
    // A tick longer than all before is flown twice more, and the least of its times counts: what
    // does not repeat itself is not the controller's.
    std::vector<double> ticks = r.tick_us;
    for (int again = 0; again < 2 && r.worst_us() > all.worst_us; ++again) {
      const StressRecord repeated = fly_stress(vehicle, settings, start, options.duration);
      for (std::size_t t = 0; t < std::min(ticks.size(), repeated.tick_us.size()); ++t)
        ticks[t] = std::min(ticks[t], repeated.tick_us[t]);
    }
    const double worst = ticks.empty() ? 0.0 : *std::max_element(ticks.begin(), ticks.end());
    all.add(index, r, worst);
    const Eigen::Vector3d up = start.body.orientation.conjugate() * Eigen::Vector3d::UnitZ();
    table.add(static_cast<double>(index))
        .add(r.recovered)
        .add(r.recovery_time)
        .add(r.lowest)
        .add(start.body.velocity.norm())
        .add(degrees * std::acos(std::clamp(up.z(), -1.0, 1.0)))
        .add(start.body.angular_velocity.norm())
        .add(worst)
        .add(r.most_passes)
        .add(r.worst_bound_ratio)
        .add(r.approximate)
        .add(r.failures)
        .end_row();
    for (const StressSample& s : r.samples)
      log.add(static_cast<double>(index))
          .add(r.recovered)
          .add(s.time)
          .add(s.distance)
          .add(degrees * s.angle)
          .add(s.speed)
          .add(s.height)
          .end_row();
    progress.show(static_cast<double>(i + 1) / static_cast<double>(options.count),
                  std::to_string(all.flights - all.recovered) + " not recovered");
  }
  progress.finish();
  const double hover = median(all.hover_us);
  std::cout << "scenario: " << options.scenario << '\n'
            << "size: " << options.size << '\n'
            << "flights: " << all.flights << '\n'
            << "recovered_fraction: "
            << static_cast<double>(all.recovered) / static_cast<double>(all.flights) << '\n'
            << "slowest_recovery_s: " << all.slowest_recovery << '\n'
            << "lowest_m: " << all.lowest << '\n'
            << "median_tick_us: " << hover << '\n'
            << "worst_tick_us: " << all.worst_us << '\n'
            << "worst_tick_once_us: " << all.worst_us_once << '\n'
            << "worst_to_median: " << all.worst_us / std::max(hover, 1e-9) << '\n'
            << "most_passes: " << all.most_passes << '\n'
            << "worst_bound_ratio: " << all.worst_bound_ratio << '\n'
            << "ticks: " << all.ticks << '\n'
            << "approximate_ticks: " << all.approximate << '\n'
            << "unsolved_called_solved: " << all.unsolved << '\n'
            << "worst_solved_residual: " << all.worst_solved << '\n'
            << "solver_failures: " << all.failures << '\n'
            << "worst_flight: " << all.worst_flight << '\n'
            << "repeat_worst: " << repeating_command(options, program, all.worst_flight) << '\n';
}

constexpr const char* footer = R"(
Scenarios, and what --size means (without it, the size in brackets):
  step      the reference jumps sideways by that many metres (20)
  yaw       it turns by that many degrees (180)
  knocked   the body turns at that many rad/s about any axis (10.77)
  thrown    the body flies at that many m/s and turns at 5/6 as many rad/s (6)
  inverted  the body leans by that many degrees (180)
  random    any state within 5 m, 5 m/s and 8 rad/s, each times the size, and any attitude; below
            a size of 1 that leans at most as large a share of 180 degrees (1)
Flight 0 has the plainest direction, the others any. The vehicle hovers for two seconds before, and
knows its state. Recovered: at the end within 0.1 m, 0.1 rad and 0.2 m/s, no ground touched.

Printed, among others:
  median_tick_us          processor time of prepare() and feedback() in the hover before
  worst_tick_us           the longest tick afterwards, the least of three runs; worst_tick_once_us
                          is that of one run, with all that the machine did meanwhile
  worst_bound_ratio       largest command or rate of one over its bound
  approximate_ticks       ticks whose program was not solved within the limits, and which say so
  unsolved_called_solved  ticks that say solved with a residual, counted again, above tolerance
  solver_failures         ticks without a plan from their measurement

In the output directory: stress_flights.csv, a row of each flight, stress_flights_log.csv, ten rows a
second, and stress_flights.png.

Exit code: 0, 1 an error, 2 a vehicle that cannot be, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "What can a vehicle recover from? Flies a scenario many times: from the vehicle's hover "
      "into\n"
      "a large step, a knock, any attitude, under the controller with the vehicle's settings."};
  Options options;
  app.add_option("--scenario", options.scenario, "step, yaw, knocked, thrown, inverted, random")
      ->check(CLI::IsMember({"step", "yaw", "knocked", "thrown", "inverted", "random"}))
      ->capture_default_str();
  app.add_option("--size", options.size, "m, degrees, rad/s, m/s or a factor: see below")
      ->check(CLI::Range(1e-3, 1e3));
  app.add_option("--count", options.count, "how many flights")
      ->check(CLI::Range(std::uint64_t{1}, std::uint64_t{1} << 32U))
      ->capture_default_str();
  app.add_option("--seed", options.seed, "of their directions and states")
      ->check(CLI::Range(std::uint64_t{0}, std::uint64_t{1} << 53U))
      ->capture_default_str();
  app.add_option("--first", options.first, "index of the first flight")
      ->check(CLI::Range(std::uint64_t{0}, std::uint64_t{1} << 52U))
      ->capture_default_str();
  app.add_option("--time-limit-us", options.time_limit_us, "for a tick [us]; 0: none")
      ->check(CLI::Range(0.0, 1e9))
      ->capture_default_str();
  app.add_option("--vehicle", options.vehicle, "its JSON file; the Tilt-Ropter without");
  app.add_option("--height", options.height, "of the hover before [m]; 10 without, 20 in random")
      ->check(CLI::Range(0.2, 1e4));
  app.add_option("--duration", options.duration, "of a flight [s]")
      ->check(CLI::Range(0.1, 1e4))
      ->capture_default_str();
  app.add_option("-o,--output", options.output, "directory for tables and picture")
      ->capture_default_str();
  app.add_flag("--no-pictures", options.no_pictures, "write the tables only");
  app.footer(footer);
  return run_program(app, "stress_flights", argc, argv, [&options, argv] {
    const Scenario scenario = scenarios().at(options.scenario);
    if (options.size == 0.0) options.size = usual_size(scenario);
    if (options.height == 0.0) options.height = usual_height(scenario);
    const VehicleFile file = vehicle_or_default(options.vehicle);
    std::visit([&](const auto& v) { run(options, file, v, argv[0]); }, file.vehicle);
    if (!options.no_pictures) draw_pictures("stress_flights.gp", options.output);
    return 0;
  });
}
