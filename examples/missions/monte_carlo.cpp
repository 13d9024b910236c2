// Flies the hybrid mission with many random vehicles that all differ from the vehicle that the
// controller assumes. Reports the fraction of completed flights and the tracking errors.

#include "../support/control_level.hpp"
#include "../support/flight_file.hpp"
#include "../support/flight_request.hpp"
#include "../support/flight_table.hpp"
#include "../support/pictures.hpp"
#include "../support/progress.hpp"
#include "../support/run_program.hpp"
#include "../support/solver_choice.hpp"
#include "../support/spread_flight.hpp"
#include "../support/vehicle_check.hpp"

#include <CLI/CLI.hpp>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <limits>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

using namespace examples;

namespace {

struct Options {
  std::string output = "results";
  std::string vehicle, level, solver = "automatic", mcap;
  std::uint64_t seed = 1, first = 0, count = 1000;
  std::int64_t replay = -1;
  unsigned threads = std::max(1U, std::thread::hardware_concurrency());
  std::vector<std::string> merge;
  bool resume = false, no_pictures = false;
  // Whether these were given: with --merge they say what the files must hold.
  bool seed_given = false, range_given = false, vehicle_given = false, solver_given = false;
};

FlightRequest request_of(const Options& options) {
  FlightRequest request{this_version(),  this_build(), options.seed,  options.first, options.count,
                        options.vehicle, "",           options.level, options.solver};
  if (!options.vehicle.empty()) request.vehicle_contents = hash_of(read_bytes(options.vehicle));
  return request;
}

/// Flies one vehicle. Adds its index to errors.
SpreadFlight fly(const VehicleFile& file, const Options& options, std::uint64_t index,
                 const std::string& log_directory = "") {
  SpreadChoice choice;
  choice.mcap = options.mcap;
  try {
    return fly_spread(file, level_for(options.level, file), options.solver, options.seed, index,
                      log_directory, choice);
  } catch (const std::exception& error) {
    throw std::runtime_error("vehicle " + std::to_string(index) + ": " + error.what());
  }
}

/// Flies the vehicles of the request that are not yet in the table at `path`, and adds them.
void fly_all(const Options& options, const std::string& path) {
  const VehicleFile file = vehicle_to_fly(options.vehicle);
  const std::string choice = level_choice(options.level, file);
  if (!choice.empty()) std::cerr << choice << '\n';
  const FlightRequest request = request_of(options);
  FlightFile table(path, request, options.resume);
  if (!table.damage().empty()) std::cerr << table.damage() << "; its vehicle is flown again\n";
  if (table.rows() > 0)
    std::cerr << table.rows() << " of " << options.count << " vehicles are in " << path
              << " already\n";
  Progress progress;
  std::mutex mutex;  // protects all that follows, the table and the progress
  std::exception_ptr error;
  std::uint64_t next = request.first, diverged = 0;
  const auto work = [&] {
    for (;;) {
      std::uint64_t index = 0;
      {
        const std::lock_guard<std::mutex> lock(mutex);
        while (next < request.end() && table.has(next)) ++next;
        if (next >= request.end() || error) return;
        index = next++;
      }
      try {
        const SpreadFlight flight = fly(file, options, index);
        const std::lock_guard<std::mutex> lock(mutex);
        if (flight.record.verdict != Verdict::ok) ++diverged;
        table.add(index, flight_line(options.seed, index, flight.draw, flight.record));
        progress.show(static_cast<double>(table.rows()) / static_cast<double>(options.count),
                      std::to_string(diverged) + " diverged");
      } catch (...) {
        const std::lock_guard<std::mutex> lock(mutex);
        error = std::current_exception();
      }
    }
  };
  std::vector<std::thread> threads;
  for (unsigned i = 1; i < options.threads; ++i) threads.emplace_back(work);
  work();
  for (std::thread& thread : threads) thread.join();
  if (error) std::rethrow_exception(error);
  table.finish();
  progress.finish();
}

/// Flies one vehicle again and writes the same logs as hybrid_mission.
void replay(const Options& options, std::uint64_t index) {
  const VehicleFile file = vehicle_to_fly(options.vehicle);
  const SpreadFlight flight = fly(file, options, index, options.output);
  const tilt_ropter::ActuatorFailure& failure = flight.record.failure;
  std::cout << "verdict: " << to_string(flight.record.verdict) << '\n'
            << "actuator_failure: " << to_string(failure.kind) << '\n'
            << std::setprecision(std::numeric_limits<double>::max_digits10);
  for (const auto& [name, value] : flight_row(options.seed, index, flight.draw, flight.record))
    std::cout << name << ": " << value << '\n';
  if (failure.kind != tilt_ropter::FailureKind::none)
    std::cout << "actuator_failure_s: " << failure.time << '\n';
}

/// Returns the word for a shell, quoted if `always` or if necessary.
std::string shell_word(const std::string& text, bool always = false) {
  const char* plain = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789/._-+=:,@%";
  if (!always && !text.empty() && text.find_first_not_of(plain) == std::string::npos) return text;
  std::string quoted = "'";
  for (const char c : text) quoted += c == '\'' ? std::string("'\\''") : std::string(1, c);
  return quoted + '\'';
}

/// Returns the command that flies vehicles of this request, without seed and vehicles.
std::string command_of(const FlightRequest& request, const std::string& program) {
  std::string command = shell_word(program);
  if (!request.level.empty()) command += " --level " + request.level;
  if (request.solver != "automatic") command += " --solver " + request.solver;
  if (!request.vehicle.empty()) command += " --vehicle " + shell_word(request.vehicle, true);
  return command;
}

/// Replaces each directory by the tables below it. Throws std::runtime_error if it has none.
std::vector<std::string> tables_of(const std::vector<std::string>& files) {
  namespace fs = std::filesystem;
  std::vector<std::string> tables;
  for (const std::string& file : files) {
    if (!fs::is_directory(file)) {
      tables.push_back(file);
      continue;
    }
    std::vector<std::string> below;
    for (const auto& entry : fs::recursive_directory_iterator(file))
      if (entry.path().filename() == "monte_carlo.csv") below.push_back(entry.path().string());
    if (below.empty()) throw std::runtime_error("no monte_carlo.csv in or below " + file);
    std::sort(below.begin(), below.end());
    tables.insert(tables.end(), below.begin(), below.end());
  }
  return tables;
}

/// Returns what the files hold together: their vehicles and all between them, or those that the
/// options name. Throws std::runtime_error if they are not parts of one run, or of another run than
/// the options say.
FlightRequest request_of_files(const Options& options, const std::vector<std::string>& files) {
  FlightRequest whole = read_request(files.front());
  const FlightRequest start = whole;
  std::uint64_t end = whole.end();
  for (const std::string& file : files) {
    const FlightRequest part = read_request(file);
    require_same_run(part, file, start, files.front());
    whole.first = std::min(whole.first, part.first);
    end = std::max(end, part.end());
  }
  whole.count = end - whole.first;
  const FlightRequest given = request_of(options);
  FlightRequest wanted = whole;
  if (options.seed_given) wanted.seed = given.seed;
  wanted.version = given.version;
  if (!given.level.empty()) wanted.level = given.level;
  if (options.solver_given) wanted.solver = given.solver;
  if (options.vehicle_given) {
    wanted.vehicle = given.vehicle;
    wanted.vehicle_contents = given.vehicle_contents;
  }
  require_same_run(whole, files.front(), wanted, "the options");
  if (options.range_given) {
    wanted.first = given.first;
    wanted.count = given.count;
  }
  return wanted;
}

/// Merges files of one run into the table at `path`. Returns 3 if vehicles are missing.
int merge(const Options& options, const std::string& path, const std::string& program) {
  const std::vector<std::string> files = tables_of(options.merge);
  const FlightRequest request = request_of_files(options, files);
  std::vector<std::string> damages;
  const CsvTable flights = merge_flights(files, &damages);
  const std::vector<double>& indices = flights["index"];
  for (const double index : {indices.front(), indices.back()})
    if (index < static_cast<double>(request.first) || index >= static_cast<double>(request.end()))
      throw std::runtime_error("vehicle " + std::to_string(static_cast<std::uint64_t>(index)) +
                               " is in the files, but only " + std::to_string(request.first) +
                               " to " + std::to_string(request.end() - 1) + " are wanted");
  std::string text = joined(flights.names) + '\n';
  for (std::size_t i = 0; i < flights.rows(); ++i) text += flight_line(flights, i) + '\n';
  std::filesystem::remove(path);
  write_request(request, path);
  write_atomically(path, text);
  const std::string command = command_of(request, program);
  print_flights(std::cout, flights, command);
  for (const std::string& damage : damages) std::cerr << damage << '\n';
  const std::vector<FlightRange> missing = missing_flights(flights, {request.first, request.count});
  if (missing.empty()) return 0;
  std::cerr << "missing vehicles: " << request.count - flights.rows() << " of " << request.count
            << '\n';
  for (const FlightRange& range : missing)
    std::cerr << "    " << range.first << " to " << range.first + range.count - 1 << '\n';
  std::cerr << "continue the jobs that should have flown them, or fly all of them here:\n    "
            << command << " --seed " << request.seed << " --first " << request.first << " --count "
            << request.count << " --resume --output " << shell_word(options.output) << '\n';
  return 3;
}

int run(const Options& options, const std::string& program) {
  std::filesystem::create_directories(options.output);
  if (options.replay >= 0) {
    replay(options, static_cast<std::uint64_t>(options.replay));
    if (!options.no_pictures) draw_pictures("missions/hybrid_mission.gp", options.output);
    return 0;
  }
  const std::string path = options.output + "/monte_carlo.csv";
  const auto start = std::chrono::steady_clock::now();
  int result = 0;
  if (options.merge.empty()) {
    fly_all(options, path);
    print_flights(std::cout, merge_flights({path}), command_of(request_of(options), program));
  } else {
    result = merge(options, path, program);
  }
  const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
  std::cerr << std::fixed << std::setprecision(1) << "took " << elapsed.count() << " s\n";
  if (!options.no_pictures) draw_pictures("missions/monte_carlo.gp", options.output);
  return result;
}

constexpr const char* footer = R"(
Any vehicle file is taken: 2 to 8 rotors, with wheels, with legs or with neither. The
vehicle flies the part of the mission that it can do, at the level of control that it needs.

Files in the output directory: monte_carlo.csv, one row per vehicle; monte_carlo.run, what the run
was asked for (version, build, seed, vehicles, vehicle file, level, solver); and monte_carlo.png.

On a cluster: seed and index alone determine a vehicle, its noise and its flight, to the bit, for
one build on processors of one kind. Each job flies a part and can be killed at any time. The same
command continues it: with --resume, vehicles in the table are not flown again, and a damaged last
line is. --merge refuses parts of other seeds, vehicles, levels, versions or builds, and names
missing vehicles.
    monte_carlo --first $((1000 * K)) --count 1000 --resume --threads 1 --no-pictures -o part$K
    monte_carlo --merge part*/monte_carlo.csv -o whole
examples/missions/cluster/ has scripts for GNU parallel and Slurm.

Exit code: 0 success, 1 an error, 2 an invalid vehicle file, 3 --merge misses vehicles, above 100
wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Flies the hybrid mission with many vehicles that differ from the vehicle that the "
      "controller\n"
      "assumes: mass +-20 %, moments of inertia +-30 %, CoM +-1 cm, thrust +-15 %, time constants\n"
      "of servos and rotors x0.5 to 2, delays of commands and motion capture up to 20 ms, noise\n"
      "x0.5 to 2, biases, wind up to 1.5 N with gusts, friction 0.3 to 1."};
  Options options;
  app.add_option("-o,--output", options.output, "directory for the table and the pictures")
      ->take_last()
      ->capture_default_str();
  CLI::Option* vehicle = app.add_option("--vehicle", options.vehicle,
                                        "JSON file of the vehicle that the controller assumes; "
                                        "default: the Tilt-Ropter");
  add_level(app, options.level);
  CLI::Option* solver = add_solver_in_real_time(app, options.solver);
  CLI::Option* seed =
      app.add_option("--seed", options.seed, "random seed of vehicles, noise and wind")
          ->check(CLI::Range(std::uint64_t{0}, std::uint64_t{1} << 53U))
          ->capture_default_str();
  CLI::Option* first = app.add_option("--first", options.first, "index of the first vehicle")
                           ->check(CLI::Range(std::uint64_t{0}, std::uint64_t{1} << 52U))
                           ->capture_default_str();
  CLI::Option* count = app.add_option("--count", options.count, "number of vehicles")
                           ->check(CLI::Range(std::uint64_t{1}, std::uint64_t{1} << 32U))
                           ->capture_default_str();
  app.add_option("--threads", options.threads, "number of threads")
      ->check(CLI::Range(1U, 1024U))
      ->capture_default_str();
  CLI::Option* resume =
      app.add_flag("--resume", options.resume,
                   "continue the table in the output directory; without it, start a new table");
  CLI::Option* merge =
      app.add_option(
             "--merge", options.merge,
             "merge the CSV files of parts of a run, without flying, or all monte_carlo.csv "
             "below a directory; their .run files must be beside them; seed, vehicles, vehicle and "
             "level are then what the files "
             "must hold")
          ->excludes(resume);
  CLI::Option* replayed =
      app.add_option(
             "--replay", options.replay,
             "fly only the vehicle with this index; write log and pictures like hybrid_mission")
          ->check(CLI::NonNegativeNumber)
          ->excludes(first)
          ->excludes(count)
          ->excludes(resume)
          ->excludes(merge);
  app.add_option("--mcap", options.mcap,
                 "also write this flight to an MCAP file, as --mcap of hybrid_mission")
      ->needs(replayed);
  app.add_flag("--no-pictures", options.no_pictures, "write only the table or the log");
  app.footer(footer);
  return run_program(app, "monte_carlo", argc, argv, [&] {
    options.seed_given = seed->count() > 0;
    options.range_given = first->count() + count->count() > 0;
    options.vehicle_given = vehicle->count() > 0;
    options.solver_given = solver->count() > 0;
    return run(options, argv[0]);
  });
}
