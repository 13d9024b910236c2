// Flies the hybrid mission with many random vehicles that all differ from the vehicle that the
// controller assumes. Reports the fraction of completed flights and the tracking errors.

#include "../support/flight_table.hpp"
#include "../support/mission_log.hpp"
#include "../support/mission_loop.hpp"
#include "../support/pictures.hpp"
#include "../support/progress.hpp"
#include "../support/run_program.hpp"
#include "../support/spread_flight.hpp"
#include "../support/vehicle_spread.hpp"

#include <CLI/CLI.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <limits>
#include <map>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

using namespace examples;

namespace {

struct Options {
  std::string output = "results";
  std::string vehicle;
  std::uint64_t seed = 1, first = 0, count = 1000;
  std::int64_t replay = -1;
  unsigned threads = std::max(1U, std::thread::hardware_concurrency());
  std::vector<std::string> merge;
  bool no_pictures = false;
};

/// Writes the rows of flights in the order of their index. They may be added in any order.
class Rows {
 public:
  Rows(const std::string& path, std::uint64_t first) : path_(path), file_(path), next_(first) {
    file_ << std::setprecision(std::numeric_limits<double>::max_digits10);
    const std::vector<std::string> names = flight_columns();
    for (std::size_t i = 0; i < names.size(); ++i) file_ << (i ? "," : "") << names[i];
    file_ << std::endl;
    require_good();
  }

  void add(std::uint64_t seed, std::uint64_t index, const VehicleDraw& draw,
           const FlightRecord& record) {
    waiting_[index] = flight_row(seed, index, draw, record);
    for (auto row = waiting_.find(next_); row != waiting_.end(); row = waiting_.find(++next_)) {
      for (std::size_t i = 0; i < row->second.size(); ++i)
        file_ << (i ? "," : "") << row->second[i].second;
      file_ << std::endl;  // flush: an interrupted run keeps its rows
      waiting_.erase(row);
    }
    require_good();
  }

 private:
  void require_good() const {
    if (!file_) throw std::runtime_error("cannot write " + path_);
  }

  std::string path_;
  std::ofstream file_;
  std::uint64_t next_;
  std::map<std::uint64_t, std::vector<std::pair<std::string, double>>> waiting_;
};

/// Flies vehicles first to first + count - 1 independently and writes one row for each to `path`.
void fly_all(const Options& options, const std::string& path) {
  const VehicleFile file = vehicle_or_default(options.vehicle);
  const tilt_ropter::Vehicle<4> believed = quadrotor(file);
  const tilt_ropter::NmpcSettings settings = in_simulated_time(file.settings());
  const tilt_ropter::Mission mission = hybrid_mission(believed);
  Rows rows(path, options.first);
  Progress progress;
  std::mutex mutex;  // protects the rows, the progress and the error
  std::exception_ptr error;
  std::uint64_t flown = 0, diverged = 0;
  std::atomic<std::uint64_t> next{0};
  const auto work = [&] {
    try {
      for (std::uint64_t i = next++; i < options.count; i = next++) {
        RandomStream random(options.seed, options.first + i);
        const VehicleDraw draw = draw_vehicle(random, believed.body.inertia);
        const FlightRecord record = fly_spread(draw, random, believed, settings, mission, {});
        const std::lock_guard<std::mutex> lock(mutex);
        if (record.verdict != Verdict::ok) ++diverged;
        rows.add(options.seed, options.first + i, draw, record);
        progress.show(static_cast<double>(++flown) / static_cast<double>(options.count),
                      std::to_string(diverged) + " diverged");
      }
    } catch (...) {
      const std::lock_guard<std::mutex> lock(mutex);
      error = std::current_exception();
      next = options.count;
    }
  };
  std::vector<std::thread> threads;
  for (unsigned i = 1; i < options.threads; ++i) threads.emplace_back(work);
  work();
  for (std::thread& thread : threads) thread.join();
  if (error) std::rethrow_exception(error);
  progress.finish();
}

/// Flies one vehicle again and writes the same logs as hybrid_mission.
void replay(const Options& options, std::uint64_t index) {
  RandomStream random(options.seed, index);
  const VehicleFile file = vehicle_or_default(options.vehicle);
  const tilt_ropter::Vehicle<4> believed = quadrotor(file);
  const VehicleDraw draw = draw_vehicle(random, believed.body.inertia);
  MissionLog log(options.output + "/hybrid_mission.csv", examples::detail::mission_columns(4));
  MissionLog times(options.output + "/solve_times.csv", {"time_s", "prepare_us", "feedback_us"});
  const FlightRecord record = fly_spread(
      draw, random, believed, in_simulated_time(file.settings()), hybrid_mission(believed),
      [&](const tilt_ropter::Mission& mission, const tilt_ropter::Plant<4>& plant,
          const examples::FlightController<4>& controller, const tilt_ropter::PowerModel& power) {
        examples::detail::log_row(log, mission, plant, controller,
                                  power.power(plant.actuators().rotor_speed));
        const tilt_ropter::optimal_control::SolveReport& report = controller.result().report;
        times.add(plant.time()).add(report.prepare_us).add(report.feedback_us).end_row();
      });
  std::cout << "verdict: " << to_string(record.verdict) << '\n'
            << std::setprecision(std::numeric_limits<double>::max_digits10);
  for (const auto& [name, value] : flight_row(options.seed, index, draw, record))
    std::cout << name << ": " << value << '\n';
}

void run(const Options& options, const std::string& program) {
  std::filesystem::create_directories(options.output);
  if (options.replay >= 0) {
    replay(options, static_cast<std::uint64_t>(options.replay));
    if (!options.no_pictures) draw_pictures("missions/hybrid_mission.gp", options.output);
    return;
  }
  const std::string path = options.output + "/monte_carlo.csv";
  const std::string command =
      options.vehicle.empty() ? program : program + " --vehicle '" + options.vehicle + '\'';
  const auto start = std::chrono::steady_clock::now();
  if (options.merge.empty()) {
    fly_all(options, path);
    print_flights(std::cout, merge_flights({path}), command);
  } else {
    const CsvTable flights = merge_flights(options.merge);
    std::ofstream file(path);
    file << std::setprecision(std::numeric_limits<double>::max_digits10);
    for (std::size_t c = 0; c < flights.names.size(); ++c)
      file << (c ? "," : "") << flights.names[c];
    for (std::size_t i = 0; i < flights.rows(); ++i)
      for (std::size_t c = 0; c < flights.names.size(); ++c)
        file << (c ? "," : "\n") << flights.columns[c][i];
    file << '\n';
    file.close();
    if (!file) throw std::runtime_error("cannot write " + path);
    print_flights(std::cout, flights, command);
  }
  const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
  std::cerr << std::fixed << std::setprecision(1) << "took " << elapsed.count() << " s\n";
  if (!options.no_pictures) draw_pictures("missions/monte_carlo.gp", options.output);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Flies the hybrid mission with many vehicles that differ from the vehicle that the "
      "controller\n"
      "assumes: mass +-20 %, moments of inertia +-30 %, CoM +-1 cm, thrust +-15 %, time constants\n"
      "of servos and rotors x0.5 to 2, delays of commands and motion capture up to 20 ms, noise\n"
      "x0.5 to 2, biases, wind up to 1.5 N with gusts, friction 0.3 to 1. Seed and index alone\n"
      "determine a flight. To spread a million flights over a cluster with SLURM arrays or GNU\n"
      "parallel:\n"
      "    monte_carlo --first $((1000 * K)) --count 1000 --threads 1 --no-pictures -o part$K\n"
      "    monte_carlo --merge part*/monte_carlo.csv -o whole"};
  Options options;
  app.add_option("-o,--output", options.output, "directory for the table and the pictures")
      ->take_last()
      ->capture_default_str();
  app.add_option("--vehicle", options.vehicle,
                 "JSON file of the vehicle that the controller assumes: 4 rotors, with wheels; "
                 "default: the Tilt-Ropter");
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
  CLI::Option* merge = app.add_option("--merge", options.merge,
                                      "merge the CSV files of earlier runs, without flying")
                           ->excludes(first)
                           ->excludes(count);
  app.add_option("--replay", options.replay,
                 "fly only the vehicle with this index; write log and pictures like hybrid_mission")
      ->check(CLI::NonNegativeNumber)
      ->excludes(first)
      ->excludes(count)
      ->excludes(merge);
  app.add_flag("--no-pictures", options.no_pictures, "write only the table or the log");
  return run_program(app, "monte_carlo", argc, argv, [&options, argv] {
    run(options, argv[0]);
    return 0;
  });
}
