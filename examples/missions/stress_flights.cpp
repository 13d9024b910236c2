// Flies large disturbances: steps, turns, knocks, throws, inverted and random states. Reports
// whether the vehicle recovers, whether commands keep their bounds, and the controller's time.

#include "../support/control_level.hpp"
#include "../support/mission_log.hpp"
#include "../support/pictures.hpp"
#include "../support/progress.hpp"
#include "../support/run_program.hpp"
#include "../support/solver_choice.hpp"
#include "../support/statistics.hpp"
#include "../support/stress_flight.hpp"
#include "../support/vehicle_check.hpp"

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <iostream>
#include <limits>
#include <sstream>
#include <string>
#include <type_traits>
#include <variant>
#include <vector>

using namespace examples;

namespace {

struct Options {
  std::string output = "results", vehicle, scenario = "random", level, solver = "automatic";
  double size = 0.0, height = 0.0, duration = 15.0, time_limit_us = 0.0;
  std::uint64_t seed = 1, first = 0, count = 10;
  bool no_pictures = false;
};

/// Accumulates the results of flights.
struct Summary {
  std::uint64_t flights = 0, recovered = 0, worst_flight = 0;
  std::vector<double> hover_us;
  double worst_us = 0.0, worst_us_once = 0.0, worst_bound_ratio = 0.0, worst_solved = 0.0;
  double slowest_recovery = 0.0, lowest = 1e9;
  long ticks = 0, unsolved = 0, approximate = 0, failures = 0;
  int most_passes = 0;
  bool worst_recovered = true;
  SolverTicks solver;

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
    solver.add(r.solver);
    failures += r.failures;
    most_passes = std::max(most_passes, r.most_passes);
    // The worst flight: one without recovery, else the one with the longest tick.
    if (flights == 1 || (worst_recovered && !r.recovered) ||
        (worst_recovered == r.recovered && repeated_us > worst_us))
      worst_flight = index;
    worst_recovered = worst_recovered && r.recovered;
    worst_us = std::max(worst_us, repeated_us);
  }
};

std::string repeating_command(const Options& options, const std::string& program,
                              std::uint64_t index) {
  std::ostringstream command;
  command << program << " --scenario " << options.scenario << " --size " << options.size
          << " --height " << options.height << " --duration " << options.duration << " --seed "
          << options.seed << " --first " << index << " --count 1";
  if (options.time_limit_us > 0.0) command << " --time-limit-us " << options.time_limit_us;
  if (options.level != "wrench") command << " --level " << options.level;
  if (options.solver != "automatic") command << " --solver " << options.solver;
  if (!options.vehicle.empty()) command << " --vehicle " << options.vehicle;
  return command.str();
}

template <template <int> class Level, int Rotors, typename Settings>
void run(const Options& options, const tilt_ropter::Vehicle<Rotors>& vehicle, Settings settings,
         const std::string& program) {
  const Scenario scenario = scenarios().at(options.scenario);
  settings.time_limit = options.time_limit_us > 0.0 ? 1e-6 * options.time_limit_us
                                                    : std::numeric_limits<double>::infinity();
  set_solver(options.solver, settings.solver);
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
    const StressRecord r = fly_stress<Level>(vehicle, settings, start, options.duration);
    // A flight with a tick longer than all before is flown twice more. Each tick counts with its
    // shortest time, since interruptions by the machine do not repeat.
    std::vector<double> ticks = r.tick_us;
    for (int again = 0; again < 2 && r.worst_us() > all.worst_us; ++again) {
      const StressRecord repeated = fly_stress<Level>(vehicle, settings, start, options.duration);
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
  const double hover = percentile(all.hover_us, 0.5);
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
            << "solver_failures: " << all.failures << '\n';
  all.solver.print(std::cout);
  std::cout << "worst_flight: " << all.worst_flight << '\n'
            << "repeat_worst: " << repeating_command(options, program, all.worst_flight) << '\n';
}

constexpr const char* footer = R"(
Scenarios, and the meaning of --size (default in brackets):
  step      step of the reference position in a horizontal direction [m] (20)
  yaw       step of the reference heading [deg] (180)
  knocked   initial angular velocity of the body about any axis [rad/s] (10.77)
  thrown    initial speed of the body [m/s], with an angular velocity of 5/6 of it [rad/s] (6)
  inverted  initial lean of the body [deg] (180)
  random    factor on random initial states within 5 m, 5 m/s, 8 rad/s and 180 degrees of rotation;
            a factor above 1 does not increase the rotation (1)
Flight 0 has a fixed direction, the others a random direction. The vehicle first hovers for 2 s; the
controller knows the true state. Recovered: at the end within 0.1 m, 0.1 rad and 0.2 m/s of the
reference, without ground contact.

Printed, among others:
  median_tick_us          median processor time of prepare() and feedback() in the hover before
  worst_tick_us           longest tick after the disturbance, each the minimum of three runs;
                          worst_tick_once_us is from one run, with interruptions by the machine
  worst_bound_ratio       largest ratio of a command or its rate to its bound
  approximate_ticks       ticks with status approximate: program not solved within the limits
  unsolved_called_solved  ticks with status solved whose recomputed residual is above the tolerance
  solver_failures         ticks without a plan for their measurement

Files in the output directory: stress_flights.csv, one row per flight; stress_flights_log.csv, ten
rows per second; and stress_flights.png.

Exit code: 0 success, 1 an error, 2 an invalid vehicle file, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Tests which disturbances a vehicle recovers from. Flies one scenario many times: hover, "
      "then\n"
      "a large step, a knock or any attitude, with the controller settings of the vehicle."};
  Options options;
  add_level(app, options.level);
  add_solver_in_real_time(app, options.solver);
  app.add_option("--scenario", options.scenario,
                 "scenario: step, yaw, knocked, thrown, inverted or random")
      ->check(CLI::IsMember({"step", "yaw", "knocked", "thrown", "inverted", "random"}))
      ->capture_default_str();
  app.add_option("--size", options.size,
                 "size of the disturbance [m, deg, rad/s, m/s or factor]: see below")
      ->check(CLI::Range(1e-3, 1e3));
  app.add_option("--count", options.count, "number of flights")
      ->check(CLI::Range(std::uint64_t{1}, std::uint64_t{1} << 32U))
      ->capture_default_str();
  app.add_option("--seed", options.seed, "random seed of directions and states")
      ->check(CLI::Range(std::uint64_t{0}, std::uint64_t{1} << 53U))
      ->capture_default_str();
  app.add_option("--first", options.first, "index of the first flight")
      ->check(CLI::Range(std::uint64_t{0}, std::uint64_t{1} << 52U))
      ->capture_default_str();
  app.add_option("--time-limit-us", options.time_limit_us, "time limit of a tick [us]; 0: none")
      ->check(CLI::Range(0.0, 1e9))
      ->capture_default_str();
  app.add_option("--vehicle", options.vehicle,
                 "JSON file of the vehicle; default: the Tilt-Ropter");
  app.add_option("--height", options.height,
                 "height of the initial hover [m]; default: 10, in scenario random 20")
      ->check(CLI::Range(0.2, 1e4));
  app.add_option("--duration", options.duration, "duration of a flight after the disturbance [s]")
      ->check(CLI::Range(0.1, 1e4))
      ->capture_default_str();
  app.add_option("-o,--output", options.output, "directory for the tables and the picture")
      ->capture_default_str();
  app.add_flag("--no-pictures", options.no_pictures, "write only the tables");
  app.footer(footer);
  return run_program(app, "stress_flights", argc, argv, [&options, argv] {
    const Scenario scenario = scenarios().at(options.scenario);
    if (options.size == 0.0) options.size = usual_size(scenario);
    if (options.height == 0.0) options.height = usual_height(scenario);
    const VehicleFile file = vehicle_to_fly(options.vehicle);
    const std::string choice = level_choice(options.level, file);
    if (!choice.empty()) std::cout << choice << '\n';
    options.level = level_for(options.level, file);
    std::visit(
        [&](const auto& v) {
          if constexpr (HasWrenchLevel<std::decay_t<decltype(v)>>::value)
            if (options.level == "wrench")
              return run<WrenchLevel>(options, v, file.settings(), argv[0]);
          run<ActuatorLevel>(options, v, actuator_level_settings(file, v), argv[0]);
        },
        file.vehicle);
    if (!options.no_pictures) draw_pictures("missions/stress_flights.gp", options.output);
    return 0;
  });
}
