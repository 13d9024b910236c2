// Searches the allowed errors of a vehicle file, from which the weights of the controller follow,
// by flights in simulation and NLopt's algorithms without derivatives.

#include "../support/control_level.hpp"
#include "../support/csv.hpp"
#include "../support/flight_request.hpp"
#include "../support/paper_switches.hpp"
#include "../support/pictures.hpp"
#include "../support/progress.hpp"
#include "../support/run_program.hpp"
#include "../support/spread_flight.hpp"
#include "../support/vehicle_check.hpp"

#include <CLI/CLI.hpp>

#include <nlopt.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <thread>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

using namespace examples;
using Figures = std::map<std::string, double>;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
volatile std::sig_atomic_t interrupted = 0;

struct Options {
  std::string output = "results", vehicle, level, algorithm = "bobyqa";
  SpreadChoice choice;
  std::vector<std::string> minimise{"mission_rmse_m"}, limits;
  std::uint64_t seed = 1;
  int vehicles = 4, evaluations = 100000;
  unsigned threads = std::max(1U, std::thread::hardware_concurrency());
  double range = 30.0, time_limit = 600.0;  // [s]
  bool worst = false, resume = false, no_mujoco = false, no_pictures = false;
};

const std::map<std::string, nlopt_algorithm>& algorithms() {
  static const std::map<std::string, nlopt_algorithm> all{
      {"bobyqa", NLOPT_LN_BOBYQA}, {"sbplx", NLOPT_LN_SBPLX}, {"crs2", NLOPT_GN_CRS2_LM}};
  return all;
}

Figures figures_of(const FlightRecord& record) {
  Figures figures{{"unsolved_ticks", static_cast<double>(record.solver.unsolved)}};
  record.figures.for_all(record.mode_changes, [&](const std::string& key, double value, int) {
    const bool is_time = key.size() > 3 && key.compare(key.size() - 3, 3, "_us") == 0;
    if (!is_time) figures[key] = value;  // times differ from run to run
  });
  return figures;
}

/// Returns an empty text if flights have a figure of this name.
std::string refusal_of(const std::string& key) {
  FlightRecord record;
  record.figures = MissionFigures(0.0, false);
  for (const auto phase : {tilt_ropter::MissionPhase::air, tilt_ropter::MissionPhase::ground})
    record.figures.on_plant(phase, Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), 0.0, 0.0,
                            true);
  const Figures known = figures_of(record);
  if (known.count(key) > 0) return "";
  std::string message = key + ": must be one of";
  for (const auto& [name, value] : known) message += ' ' + name;
  return message;
}

struct Limit {
  std::string key;
  double value = 0.0;

  [[nodiscard]] bool at_least() const { return key == "power_saved_percent"; }
  /// By how much `figure` exceeds the limit, as a fraction of it; of the power that is left if the
  /// limit is for the power that is saved.
  [[nodiscard]] double violation(double figure) const {
    const double excess = at_least() ? value - figure : figure - value;
    const double scale = std::abs(at_least() ? 100.0 - value : value);
    return std::max(0.0, excess) / (scale > 0.0 ? scale : 1.0);
  }
};

Limit limit_of(const std::string& text) {
  const std::size_t equals = std::min(text.find('='), text.size());
  Limit limit{text.substr(0, equals), 0.0};
  if (const std::string wrong = refusal_of(limit.key); !wrong.empty())
    throw std::invalid_argument(wrong);
  const std::string_view number = std::string_view(text).substr(std::min(equals + 1, text.size()));
  if (!examples::detail::csv_number(number, CsvNumbers::finite, limit.value).empty())
    throw std::invalid_argument(text + ": must be KEY=VALUE with a finite number");
  return limit;
}

/// Calls action(key, field) for each error that the search changes.
template <typename Errors, typename Action>
void for_searched(Errors& errors, const std::string& level, const Action& action) {
  int i = 0;
  tilt_ropter::for_allowed_errors(errors, [&](const char* key, const char*, auto& value) {
    const bool of_both = i < 4, of_wrench = i < 8;
    if (of_both || of_wrench == (level == "wrench")) action(key, value);
    ++i;
  });
}

/// What a point of the search gives.
struct Tried {
  double cost = nan;       ///< what NLopt minimises
  double objective = nan;  ///< of the flights to their end
  double lost = 0.0;       ///< flights that ended early
  Figures figures;         ///< mean of the flights to their end, or the worst
};

/// The search: flies each point once, and appends it to the table in the output directory.
class Search {
 public:
  Search(const Options& options, VehicleFile file)
      : options_(options), file_(std::move(file)), level_(level_for(options.level, file_)) {
    for (const std::string& text : options.limits) limits_.push_back(limit_of(text));
    columns_ = {"mission_rmse_m", "flight_power_w", "ground_power_w"};
    for (const std::string& key : options.minimise) add_column(key);
    for (const Limit& limit : limits_) add_column(limit.key);
    for_searched(file_.allowed_errors, level_,
                 [&](const char* key, const auto&) { errors_.emplace_back(key); });
    open_table();
  }

  /// Searches until the time or the number of points is used up, or NLopt finds nothing better.
  /// The figures are not smooth, and the model of bobyqa may end early for that: it starts again
  /// from the best point, with smaller steps where the last ones found nothing better.
  void run() {
    asked_ = std::vector<double>(errors_.size(), 1.0);
    asked_cost_ = at(asked_).cost;
    nlopt_srand(static_cast<unsigned long>(options_.seed));
    for (double step = std::log(2.0); step > 0.1;) {  // first to twice the error
      const double last = asked_cost_;
      if (!search(step)) break;
      if (!(asked_cost_ < last)) step *= 0.5;
    }
    progress_.finish();
  }

  [[nodiscard]] const std::vector<Limit>& limits() const { return limits_; }
  [[nodiscard]] const std::vector<std::string>& columns() const { return columns_; }
  [[nodiscard]] std::size_t evaluations() const { return tried_.size(); }
  [[nodiscard]] int flights() const { return flights_; }
  [[nodiscard]] const Tried& before() const {
    return tried_.at(std::vector<double>(errors_.size(), 1.0));
  }
  [[nodiscard]] const std::pair<const std::vector<double>, Tried>& best() const {
    return *std::min_element(tried_.begin(), tried_.end(), [](const auto& a, const auto& b) {
      return a.second.cost < b.second.cost;
    });
  }

  /// Returns the vehicle with each allowed error times its factor.
  [[nodiscard]] VehicleFile with(const std::vector<double>& factors) const {
    VehicleFile file = file_;
    std::size_t i = 0;
    for_searched(file.allowed_errors, level_,
                 [&](const char*, auto& value) { value *= factors[i++]; });
    return file;
  }

  /// Flies the vehicles of `seed` with these factors of the errors.
  [[nodiscard]] Tried fly(const std::vector<double>& factors, std::uint64_t seed) {
    const VehicleFile file = with(factors);
    std::vector<FlightRecord> records(static_cast<std::size_t>(options_.vehicles));
    std::atomic<std::size_t> next{0};
    std::exception_ptr error;
    std::mutex mutex;
    const auto work = [&] {
      try {
        for (std::size_t i = next++; i < records.size() && interrupted == 0; i = next++)
          records[i] = fly_spread(file, level_, "automatic", seed, i, "", options_.choice).record;
      } catch (...) {
        const std::lock_guard<std::mutex> lock(mutex);
        error = std::current_exception();
      }
    };
    std::vector<std::thread> others;
    for (unsigned i = 1; i < options_.threads; ++i) others.emplace_back(work);
    work();
    for (std::thread& other : others) other.join();
    if (error) std::rethrow_exception(error);
    flights_ += interrupted == 0 ? options_.vehicles : 0;
    return judged(records);
  }

 private:
  /// Searches from the best point, with first steps of a factor of exp(step). Returns false if it
  /// was ended before NLopt has converged.
  bool search(double step) {
    const auto n = static_cast<unsigned>(asked_.size());
    const double limit = std::log(options_.range);
    const std::unique_ptr<nlopt_opt_s, decltype(&nlopt_destroy)> opt(
        nlopt_create(algorithms().at(options_.algorithm), n), nlopt_destroy);
    opt_ = opt.get();
    nlopt_set_lower_bounds1(opt_, -limit);
    nlopt_set_upper_bounds1(opt_, limit);
    nlopt_set_initial_step1(opt_, step);
    nlopt_set_xtol_abs1(opt_, 0.02);  // all errors are known to 2 %
    // Of crs2, which by default has 10 (n + 1): more than fly in ten minutes.
    nlopt_set_population(opt_, 3 * (n + 1));
    nlopt_set_min_objective(opt_, cost, this);
    std::vector<double> x(n);
    std::transform(asked_.begin(), asked_.end(), x.begin(),
                   [limit](double v) { return std::clamp(std::log(v), -limit, limit); });
    double value = 0.0;
    const nlopt_result result = nlopt_optimize(opt_, x.data(), &value);
    opt_ = nullptr;
    if (error_) std::rethrow_exception(error_);
    return result != NLOPT_FORCED_STOP;
  }

  void add_column(const std::string& key) {
    if (std::find(columns_.begin(), columns_.end(), key) == columns_.end()) columns_.push_back(key);
  }

  [[nodiscard]] Tried judged(const std::vector<FlightRecord>& records) const {
    Tried t;
    std::map<std::string, Mean> means;
    Figures worst;
    double penalty = 0.0;
    for (const FlightRecord& record : records) {
      if (record.verdict != Verdict::ok) {
        ++t.lost;
        penalty += 10.0 + 10.0 * (1.0 - record.time / record.duration);
        continue;
      }
      for (const auto& [key, value] : figures_of(record)) {
        means[key].add(value);
        const auto [at, is_new] = worst.emplace(key, value);
        if (!is_new)
          at->second =
              Limit{key}.at_least() ? std::min(at->second, value) : std::max(at->second, value);
      }
    }
    for (const auto& [key, mean] : means)
      t.figures[key] = options_.worst ? worst.at(key) : mean.value();
    t.cost = penalty;
    if (means.empty()) return t;
    const auto figure = [&](const std::string& key) {
      const auto found = t.figures.find(key);
      if (found == t.figures.end())
        throw std::invalid_argument("the flights of this mission have no " + key);
      return found->second;
    };
    double sum = 0.0;
    for (const std::string& key : options_.minimise) sum += std::log(std::max(figure(key), 1e-9));
    sum /= static_cast<double>(options_.minimise.size());
    t.objective = std::exp(sum);
    t.cost += sum;
    for (const Limit& limit : limits_) t.cost += 10.0 * limit.violation(figure(limit.key));
    return t;
  }

  /// Flies a point unless it is in the table.
  const Tried& at(const std::vector<double>& factors) {
    const auto known = tried_.find(factors);
    if (known != tried_.end()) return known->second;
    const Tried tried = fly(factors, options_.seed);
    if (interrupted != 0) throw std::runtime_error("interrupted before the first point was flown");
    const auto found = tried_.emplace(factors, tried).first;
    write(found->first, found->second);
    return found->second;
  }

  static double cost(unsigned n, const double* x, double*, void* data) {
    auto& search = *static_cast<Search*>(data);
    std::vector<double> factors(n);
    std::transform(x, x + n, factors.begin(), [](double value) { return std::exp(value); });
    try {
      const bool is_new = search.tried_.count(factors) == 0;
      if (!is_new || search.goes_on()) {
        const double found = search.at(factors).cost;
        if (found < search.asked_cost_) {
          search.asked_ = factors;
          search.asked_cost_ = found;
        }
        return found;
      }
    } catch (...) {
      if (interrupted == 0) search.error_ = std::current_exception();
    }
    nlopt_force_stop(search.opt_);
    return std::numeric_limits<double>::max();
  }

  /// False when it is time to end. The flights with another seed, before and after, need as long
  /// as two points.
  [[nodiscard]] bool goes_on() {
    const std::chrono::duration<double> passed = std::chrono::steady_clock::now() - start_;
    const double each = passed.count() * options_.vehicles / std::max(1, flights_);
    const double left = options_.time_limit - passed.count() - 2.0 * each;
    std::ostringstream doing;
    doing << "best " << std::setprecision(3) << best().second.objective << ", "
          << std::ceil(std::max(0.0, left) / 60.0) << " min left";
    progress_.show(
        std::min(1.0, std::max(1.0 - left / options_.time_limit,
                               static_cast<double>(tried_.size()) / options_.evaluations)),
        doing.str());
    return interrupted == 0 && left > each &&
           tried_.size() < static_cast<std::size_t>(options_.evaluations);
  }

  /// What the points of a table were asked for, in one line.
  [[nodiscard]] std::string request() const {
    const auto file = [](const std::string& path) {
      return path.empty() ? std::string("none") : hash_of(read_bytes(path));
    };
    std::ostringstream text;
    const MissionChoice& mission = options_.choice.mission;
    text << std::setprecision(17) << "# tune_weights " << this_version() << "; vehicle "
         << file(options_.vehicle) << "; level " << level_ << "; mission " << mission.name << ' '
         << mission.speed << ' ' << file(mission.trajectory) << ' ' << file(mission.file)
         << "; start-off " << options_.choice.start_off << "; as-in-paper "
         << CLI::detail::join(options_.choice.as_in_paper) << "; spread "
         << options_.choice.fraction << "; vehicles " << options_.vehicles << "; seed "
         << options_.seed << "; worst " << options_.worst << "; minimise "
         << CLI::detail::join(options_.minimise) << "; limit " << CLI::detail::join(options_.limits)
         << "; algorithm " << options_.algorithm << "; range " << options_.range << "; build "
         << this_build();
    return text.str();
  }

  void open_table() {
    const std::string path = options_.output + "/tune_weights.csv";
    std::string text = request() + "\ncost,objective,lost";
    for (const std::string& key : columns_) text += ',' + key;
    for (const std::string& key : errors_) text += ",factor_" + key;
    text += '\n';
    if (options_.resume && std::filesystem::exists(path)) {
      std::string old = read_bytes(path);
      old.erase(old.rfind('\n') + 1);  // a line that a killed run did not finish
      if (old.substr(0, text.size()) != text)
        throw std::runtime_error(path + " is of another run, which --resume cannot continue:\n" +
                                 old.substr(0, old.find('\n')) + "\nasked for now:\n" + request());
      text = old;
      std::istringstream in(old);
      const CsvTable table = read_csv(in, path, {}, CsvNumbers::any);
      for (std::size_t row = 0; row < table.rows(); ++row) {
        Tried tried{table["cost"][row], table["objective"][row], table["lost"][row], {}};
        for (const std::string& key : columns_) tried.figures[key] = table[key][row];
        std::vector<double> factors;
        for (const std::string& key : errors_) factors.push_back(table["factor_" + key][row]);
        tried_.emplace(factors, tried);
      }
    }
    write_atomically(path, text);
    table_.open(path, std::ios::app);
    table_ << std::setprecision(std::numeric_limits<double>::max_digits10);
  }

  void write(const std::vector<double>& factors, const Tried& tried) {
    table_ << tried.cost << ',' << tried.objective << ',' << tried.lost;
    for (const std::string& key : columns_) {
      const auto found = tried.figures.find(key);
      table_ << ',' << (found == tried.figures.end() ? nan : found->second);
    }
    for (const double factor : factors) table_ << ',' << factor;
    table_ << std::endl;
    if (!table_) throw std::runtime_error("cannot write " + options_.output + "/tune_weights.csv");
  }

  const Options& options_;
  VehicleFile file_;
  std::string level_;
  std::vector<Limit> limits_;
  std::vector<std::string> columns_, errors_;
  std::map<std::vector<double>, Tried> tried_;
  std::vector<double> asked_;  // best point that NLopt asked for: not one that --resume has read
  double asked_cost_ = 0.0;
  std::ofstream table_;
  nlopt_opt opt_ = nullptr;
  std::exception_ptr error_;
  int flights_ = 0;
  Progress progress_;
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

/// Prints figures before and after, one below the other.
void print(const Search& search, const std::string& prefix, const Tried& before,
           const Tried& after) {
  const auto line = [&](const std::string& key, double old, double value) {
    std::cout << prefix << key << "_before: " << old << '\n'
              << prefix << key << "_after: " << value << '\n';
  };
  line("objective", before.objective, after.objective);
  line("lost", before.lost, after.lost);
  for (const std::string& key : search.columns())
    if (after.figures.count(key) > 0 && !std::isnan(after.figures.at(key)))
      line(key, before.figures.count(key) > 0 ? before.figures.at(key) : nan,
           after.figures.at(key));
}

/// Prints the command that flies a vehicle in MuJoCo, and its figures where that program is built.
void fly_in_mujoco(const Options& options, const Search& search, const std::string& vehicle,
                   const std::string& name) {
  const SpreadChoice& choice = options.choice;
  std::string arguments = " --no-pictures --output '" + options.output + "/mujoco'";
  if (!vehicle.empty()) arguments += " --vehicle '" + vehicle + '\'';
  if (!options.level.empty()) arguments += " --level " + options.level;
  if (!choice.mission.trajectory.empty())
    arguments += " --trajectory '" + choice.mission.trajectory + '\'';
  else if (!choice.mission.file.empty())
    arguments += " --mission-file '" + choice.mission.file + '\'';
  else
    arguments += " --mission " + choice.mission.name + " --speed " +
                 CLI::detail::to_string(choice.mission.speed);
  if (choice.start_off > 0.0)
    arguments += " --start-off " + CLI::detail::to_string(choice.start_off);
  if (!choice.as_in_paper.empty())
    arguments += " --as-in-paper " + CLI::detail::join(choice.as_in_paper);
  std::cout << "mujoco_command_" << name << ": mission_mujoco" << arguments << '\n';
#ifdef TUNE_WEIGHTS_MUJOCO  // set by CMake if MuJoCo is found
  if (options.no_mujoco || !std::filesystem::exists(TUNE_WEIGHTS_MUJOCO)) return;
  const std::unique_ptr<FILE, int (*)(FILE*)> pipe(
      popen(("'" TUNE_WEIGHTS_MUJOCO "'" + arguments + " 2>/dev/null").c_str(), "r"), pclose);
  char line[512];
  while (pipe && std::fgets(line, sizeof line, pipe.get()) != nullptr) {
    const std::string text = line, key = text.substr(0, text.find(": "));
    if (std::find(search.columns().begin(), search.columns().end(), key) != search.columns().end())
      std::cout << "mujoco_" << key << '_' << name << text.substr(key.size());
  }
#else
  (void)search;
#endif
}

int run(const Options& options) {
  const VehicleFile file = vehicle_to_fly(options.vehicle);
  if (std::visit([&](const auto& v) { return write_mission(options.choice.mission, v); },
                 file.vehicle))
    return 0;
  std::filesystem::create_directories(options.output);
  Search search(options, file);
  std::signal(SIGINT, [](int) {
    interrupted = 1;
    std::signal(SIGINT, SIG_DFL);  // the second ends the program
  });
  search.run();
  const auto& [factors, best] = search.best();
  const VehicleFile tuned = search.with(factors);
  const std::string path = options.output + "/tuned_vehicle.json";
  write_vehicle(tuned, path);

  std::cout << "algorithm: " << options.algorithm << "\nevaluations: " << search.evaluations()
            << '\n';
  print(search, "", search.before(), best);
  for (const Limit& limit : search.limits())
    std::cout << limit.key << "_limit: " << limit.value << '\n';
  for_searched(tuned.allowed_errors, level_for(options.level, file),
               [](const char* key, const auto& value) {
                 std::cout << "best_" << key << ": ";
                 if constexpr (std::is_same_v<decltype(value), const double&>)
                   std::cout << value << '\n';
                 else
                   std::cout << value.x() << ' ' << value.y() << ' ' << value.z() << '\n';
               });
  // Whoever interrupts does not want to wait.
  const Tried other_before = search.fly(std::vector<double>(factors.size(), 1.0), options.seed + 1);
  const Tried other_after = search.fly(factors, options.seed + 1);
  if (interrupted == 0) {
    print(search, "other_seed_", other_before, other_after);
    fly_in_mujoco(options, search, options.vehicle, "before");
    fly_in_mujoco(options, search, path, "after");
  }
  std::cout << "flights: " << search.flights() << "\nvehicle_file: " << path << std::endl;
  if (!options.no_pictures) draw_pictures("tools/tune_weights.gp", options.output);
  return 0;
}

constexpr const char* footer = R"(
What is searched: one factor for each allowed error of the vehicle file (AllowedErrors), four of
both levels of control and four of the level that flies, 1/30 to 30 with the default --range. The
ratio of the axes of an error stays. Each point of the search flies --vehicles vehicles with their
winds, sensors and seeds, from the spread of monte_carlo.

What NLopt minimises: the sum of
  ln(objective); the objective is the mean over the flights of the figure --minimise KEY, and of
      several such figures the geometric mean;
  for each --limit KEY=VALUE 10 times the fraction by which the mean figure exceeds VALUE, or, of
      power_saved_percent, by which the power that is left exceeds 100 - VALUE. Exceeding a limit by
      a tenth costs as much as an objective that is 2.7 times as large;
  10 for each flight that is lost, and up to 10 more for the part of it that is missing. Lost
      flights do not count in the means.
With --worst, the largest figure of the flights replaces the mean (of power_saved_percent the
smallest). KEY is a figure that a mission prints, such as air_rmse_m, ground_rmse_m, mission_rmse_m,
flight_power_w, ground_power_w, touchdown_speed_mps, takeoff_error_m, landing_error_m.

Algorithms: bobyqa (quadratic models in a trust region), sbplx (Nelder-Mead on subspaces), both from
the vehicle's errors, and crs2 (controlled random search in the whole range). Two runs with the same
options try the same points; --time-limit only says how many. Ctrl-C ends the search with the best
point so far.

Files in the output directory: tuned_vehicle.json, the vehicle with the best errors;
tune_weights.csv, each point; tune_weights.png: each error against the objective, and tracking
against power. The best is flown again with other seeds, and in MuJoCo where mission_mujoco is
built: take no weights that are better in one plant only.

Exit code: 0 success, 1 an error, 2 wrong options or an invalid file.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Searches the weights of the controller: the allowed errors of a vehicle file, by flights "
      "in\n"
      "simulation. Example:\n"
      "    tune_weights --vehicle my_vehicle.json --minimise air_rmse_m --limit "
      "touchdown_speed_mps=0.2"};
  Options options;
  app.add_option("-o,--output", options.output, "directory for the results")
      ->take_last()
      ->capture_default_str();
  app.add_option("--vehicle", options.vehicle,
                 "JSON file of the vehicle whose errors are the start; default: the Tilt-Ropter");
  add_level(app, options.level);
  add_options(app, options.choice.mission);
  app.add_option("--start-off", options.choice.start_off,
                 "if the mission starts in flight: distance from the reference at the start [m]")
      ->check(CLI::Range(0.0, 2.0))
      ->capture_default_str();
  add_paper_switches(app, options.choice.as_in_paper);
  app.add_option("--minimise", options.minimise, "KEY of the figure to minimise; may be repeated")
      ->check(refusal_of)
      ->capture_default_str();
  app.add_option("--limit", options.limits,
                 "KEY=VALUE: the figure KEY may be VALUE at most, power_saved_percent at least; "
                 "may be repeated")
      ->check([](const std::string& text) {
        try {
          (void)limit_of(text);
        } catch (const std::invalid_argument& error) {
          return std::string(error.what());
        }
        return std::string();
      });
  app.add_flag("--worst", options.worst, "the worst flight counts, not the mean of the flights");
  app.add_option("--algorithm", options.algorithm, "algorithm of NLopt")
      ->check(CLI::IsMember(algorithms()))
      ->capture_default_str();
  app.add_option("--range", options.range, "largest factor of an error, either way")
      ->check(CLI::Range(1.1, 1000.0))
      ->capture_default_str();
  app.add_option("--vehicles", options.vehicles, "vehicles that fly for each point")
      ->check(CLI::Range(1, 1000))
      ->capture_default_str();
  app.add_option("--spread", options.choice.fraction,
                 "how far they differ from the assumed vehicle: 1 as in monte_carlo, 0 not at all")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  app.add_option("--seed", options.seed, "random seed of vehicles, noise and wind, and of crs2")
      ->check(CLI::Range(std::uint64_t{0}, std::uint64_t{1} << 53U))
      ->capture_default_str();
  app.add_option("--time-limit", options.time_limit, "for search and flights with other seeds [s]")
      ->check(CLI::Range(1.0, 1e6))
      ->capture_default_str();
  app.add_option("--evaluations", options.evaluations, "largest number of points")
      ->check(CLI::Range(1, 1000000))
      ->capture_default_str();
  app.add_option("--threads", options.threads, "number of threads")
      ->check(CLI::Range(1U, 1024U))
      ->capture_default_str();
  app.add_flag("--resume", options.resume,
               "continue the run in the output directory: its points are not flown again");
  app.add_flag("--no-mujoco", options.no_mujoco, "do not fly the result in MuJoCo");
  app.add_flag("--no-pictures", options.no_pictures, "do not draw");
  app.footer(footer);
  const int code = run_program(app, "tune_weights", argc, argv, [&] { return run(options); });
  return code > 2 ? 2 : code;  // wrong options
}
