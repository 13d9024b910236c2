#pragma once

#include "csv.hpp"
#include "flight_request.hpp"
#include "spread_flight.hpp"
#include "statistics.hpp"
#include "vehicle_spread.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iomanip>
#include <limits>
#include <map>
#include <numeric>
#include <ostream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

/// The flights of a Monte Carlo run as rows of numbers: writes, reads, merges and summarises them.
namespace examples {

/// Returns one row: the vehicle number, its parameters and the result of its flight.
[[nodiscard]] inline std::vector<std::pair<std::string, double>> flight_row(std::uint64_t seed,
                                                                            std::uint64_t index,
                                                                            const VehicleDraw& d,
                                                                            const FlightRecord& r) {
  return {{"seed", static_cast<double>(seed)},
          {"index", static_cast<double>(index)},
          {"mass_factor", d.mass},
          {"inertia_factor_x", d.inertia.x()},
          {"inertia_factor_y", d.inertia.y()},
          {"inertia_factor_z", d.inertia.z()},
          {"com_offset_x_m", d.com_offset.x()},
          {"com_offset_y_m", d.com_offset.y()},
          {"com_offset_z_m", d.com_offset.z()},
          {"thrust_factor", d.thrust},
          {"servo_time_constant_factor", d.servo_time_constant},
          {"rotor_time_constant_factor", d.rotor_time_constant},
          {"command_delay_s", d.command_delay},
          {"capture_delay_s", d.capture_delay},
          {"noise_factor", d.noise},
          {"gyro_bias_x_radps", d.gyro_bias.x()},
          {"gyro_bias_y_radps", d.gyro_bias.y()},
          {"gyro_bias_z_radps", d.gyro_bias.z()},
          {"accelerometer_bias_x_mps2", d.accelerometer_bias.x()},
          {"accelerometer_bias_y_mps2", d.accelerometer_bias.y()},
          {"accelerometer_bias_z_mps2", d.accelerometer_bias.z()},
          {"wind_n", d.wind},
          {"wind_direction_rad", d.wind_direction},
          {"friction", d.friction},
          {"verdict", static_cast<double>(r.verdict)},
          {"time_s", r.time},
          {"air_rmse_m", r.air_rmse},
          {"ground_rmse_m", r.ground_rmse},
          {"mission_rmse_m", r.mission_rmse},
          {"max_error_m", r.max_error},
          {"flight_power_w", r.flight_power},
          {"ground_power_w", r.ground_power},
          {"touchdown_speed_mps", r.touchdown_speed},
          {"mode_changes", static_cast<double>(r.mode_changes)},
          {"solver_failures", static_cast<double>(r.solver_failures)},
          {"false_alarms", static_cast<double>(r.false_alarms)},
          {"active_ticks", static_cast<double>(r.solver.active)},
          {"riccati_ticks", static_cast<double>(r.solver.riccati)},
          {"nlopt_ticks", static_cast<double>(r.solver.nlopt)},
          {"structured_ticks", static_cast<double>(r.solver.structured)},
          {"unsolved_ticks", static_cast<double>(r.solver.unsolved)}};
}

[[nodiscard]] inline std::vector<std::string> flight_columns() {
  std::vector<std::string> names;
  for (const auto& [name, value] : flight_row(0, 0, {}, {})) names.push_back(name);
  return names;
}

/// True if `value` can be a count or an index: a whole number that a double represents exactly.
[[nodiscard]] inline bool is_count(double value) {
  return value >= 0.0 && value <= 9007199254740992.0 && value == std::floor(value);
}

/// Returns the values separated by commas.
template <typename Values>
[[nodiscard]] std::string joined(const Values& values) {
  std::ostringstream text;
  text << std::setprecision(std::numeric_limits<double>::max_digits10);
  for (const auto& value : values) text << (&value == &*values.begin() ? "" : ",") << value;
  return text.str();
}

/// Returns row `i` of the table as a line of a CSV file, which reads back as the same numbers.
[[nodiscard]] inline std::string flight_line(const CsvTable& flights, std::size_t i) {
  std::vector<double> values;
  for (const std::vector<double>& column : flights.columns) values.push_back(column[i]);
  return joined(values);
}

/// Returns the line of a flight, see flight_row().
[[nodiscard]] inline std::string flight_line(std::uint64_t seed, std::uint64_t index,
                                             const VehicleDraw& draw, const FlightRecord& record) {
  std::vector<double> values;
  for (const auto& [name, value] : flight_row(seed, index, draw, record)) values.push_back(value);
  return joined(values);
}

/// The rows of a file, and what is wrong with its last line, or an empty text. Then the table does
/// not have this line.
struct FlightPart {
  CsvTable flights;
  std::string damage;
};

/// Reads the flights of a file. A last line without an end is damage: the run that wrote it was
/// killed. With `any_damage` a last line that cannot be read is damage, too. Throws
/// std::runtime_error with file and line for anything else that cannot be read, and for an invalid
/// seed, index or verdict.
[[nodiscard]] inline FlightPart read_flights(const std::string& file, bool any_damage = false) {
  std::string text = read_bytes(file);
  const auto without_last_line = [](const std::string& lines) {
    const std::size_t end = lines.empty() ? std::string::npos : lines.rfind('\n', lines.size() - 2);
    return lines.size() < 2 || end == std::string::npos ? std::string() : lines.substr(0, end + 1);
  };
  const auto read = [&file](const std::string& lines) {
    if (lines.empty()) {
      const std::vector<std::string> names = flight_columns();
      return CsvTable{file, names, std::vector<std::vector<double>>(names.size()), {}};
    }
    std::istringstream in(lines);
    CsvTable flights = read_csv(in, file, flight_columns(), CsvNumbers::any);
    for (std::size_t i = 0; i < flights.rows(); ++i) {
      const std::string where = file + ':' + std::to_string(flights.lines[i]) + ": ";
      if (!is_count(flights["seed"][i])) throw std::runtime_error(where + "no such seed");
      if (!is_count(flights["index"][i])) throw std::runtime_error(where + "no such index");
      const double verdict = flights["verdict"][i];
      if (!is_count(verdict) || verdict > static_cast<double>(Verdict::grounded))
        throw std::runtime_error(where + "no such verdict");
    }
    return flights;
  };
  FlightPart part;
  if (!text.empty() && text.back() != '\n') {
    const auto line = std::count(text.begin(), text.end(), '\n') + 1;
    part.damage = file + ':' + std::to_string(line) + ": the last line is cut off";
    text += '\n';
    text = without_last_line(text);
  }
  try {
    part.flights = read(text);
  } catch (const std::runtime_error& error) {
    const std::string rest = without_last_line(text);
    if (!any_damage || !part.damage.empty() || rest.empty()) throw;
    part.flights = read(rest);
    part.damage = error.what();
  }
  return part;
}

/// Merges the rows of several files into one table, sorted by index. Appends to `damages` what is
/// wrong with the last lines of files. Throws std::runtime_error with file and line if
/// read_flights() throws, if a file has another seed, or if a vehicle occurs twice.
[[nodiscard]] inline CsvTable merge_flights(const std::vector<std::string>& files,
                                            std::vector<std::string>* damages = nullptr) {
  CsvTable all{"", flight_columns(), {}, {}};
  struct Row {
    double index;
    std::vector<double> values;
  };
  std::vector<Row> rows;
  std::map<double, const std::string*> seen;  // the file of each vehicle
  double seed = std::numeric_limits<double>::quiet_NaN();
  for (const std::string& file : files) {
    const FlightPart read = read_flights(file);
    const CsvTable& part = read.flights;
    if (damages != nullptr && !read.damage.empty()) damages->push_back(read.damage);
    for (std::size_t i = 0; i < part.rows(); ++i) {
      const std::string where = file + ':' + std::to_string(part.lines[i]) + ": ";
      Row row{part["index"][i], {}};
      if (std::isnan(seed)) seed = part["seed"][i];
      if (!(part["seed"][i] == seed)) throw std::runtime_error(where + "the seed is another one");
      const auto [there, is_new] = seen.emplace(row.index, &file);
      if (!is_new)
        throw std::runtime_error(where + "the vehicle is there twice, also in " + *there->second);
      for (const std::vector<double>& column : part.columns) row.values.push_back(column[i]);
      rows.push_back(std::move(row));
    }
  }
  if (rows.empty()) throw std::runtime_error("no vehicles in " + files.front());
  std::sort(rows.begin(), rows.end(), [](const Row& a, const Row& b) { return a.index < b.index; });
  all.columns.resize(all.names.size());
  for (const Row& row : rows) {
    for (std::size_t c = 0; c < row.values.size(); ++c) all.columns[c].push_back(row.values[c]);
    all.lines.push_back(all.lines.size() + 2);
  }
  return all;
}

/// A range of vehicles.
struct FlightRange {
  std::uint64_t first = 0, count = 0;
};

/// Returns the vehicles from `first` to first + count - 1 that are not in the table, which is
/// sorted by index.
[[nodiscard]] inline std::vector<FlightRange> missing_flights(const CsvTable& flights,
                                                              FlightRange wanted) {
  std::vector<FlightRange> missing;
  std::uint64_t next = wanted.first;
  for (const double value : flights["index"]) {
    const auto index = static_cast<std::uint64_t>(value);
    if (index > next) missing.push_back({next, index - next});
    next = index + 1;
  }
  const std::uint64_t end = wanted.first + wanted.count;
  if (next < end) missing.push_back({next, end - next});
  return missing;
}

/// Returns the row numbers from the worst vehicle to the best. Divergences come first. Other
/// flights are ordered by the larger ratio of an RMSE to its limit: 6 cm in the air, 10 cm on the
/// ground.
[[nodiscard]] inline std::vector<std::size_t> worst_first(const CsvTable& flights) {
  const auto badness = [&flights](std::size_t i) {
    const double rmse =
        std::max(flights["air_rmse_m"][i] / 0.06, flights["ground_rmse_m"][i] / 0.10);
    return (flights["verdict"][i] > 0.0 ? 1e6 : 0.0) + (std::isfinite(rmse) ? rmse : 1e5);
  };
  std::vector<std::size_t> order(flights.rows());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
  std::stable_sort(order.begin(), order.end(),
                   [&badness](std::size_t a, std::size_t b) { return badness(a) > badness(b); });
  return order;
}

/// Prints percentiles of all flights, the worst five, and the command of `program` to repeat each
/// of these.
inline void print_flights(std::ostream& out, const CsvTable& flights, const std::string& program) {
  const std::vector<double>& verdicts = flights["verdict"];
  out << "vehicles: " << flights.rows() << '\n';
  out << "divergences: "
      << std::count_if(verdicts.begin(), verdicts.end(), [](double v) { return v != 0.0; }) << '\n';
  const std::vector<double>& alarms = flights["false_alarms"];
  out << "false_alarms: "
      << std::count_if(alarms.begin(), alarms.end(), [](double v) { return v != 0.0; }) << '\n';
  for (const char* name :
       {"active_ticks", "riccati_ticks", "nlopt_ticks", "structured_ticks", "unsolved_ticks"}) {
    const std::vector<double>& ticks = flights[name];
    out << name << ": " << std::fixed << std::setprecision(0)
        << std::accumulate(ticks.begin(), ticks.end(), 0.0) << '\n';
  }
  out << std::fixed << std::setprecision(4);
  out << std::left << std::setw(22) << "percentile" << std::right;
  const std::vector<double> fractions = {0.05, 0.5, 0.95, 0.99, 1.0};
  for (const double fraction : fractions) out << std::setw(10) << std::lround(100.0 * fraction);
  out << '\n';
  for (const char* name :
       {"air_rmse_m", "ground_rmse_m", "mission_rmse_m", "max_error_m", "flight_power_w",
        "ground_power_w", "touchdown_speed_mps", "mode_changes", "solver_failures"}) {
    out << std::left << std::setw(22) << name << std::right;
    for (const double fraction : fractions)
      out << std::setw(10) << percentile(flights[name], fraction);
    out << '\n';
  }
  const std::vector<std::size_t> order = worst_first(flights);
  for (std::size_t place = 0; place < std::min<std::size_t>(5, order.size()); ++place) {
    const std::size_t i = order[place];
    const auto index = static_cast<std::uint64_t>(flights["index"][i]);
    out << "worst " << place + 1 << ": vehicle " << index << ", "
        << to_string(static_cast<Verdict>(verdicts[i]));
    out << std::setprecision(3);
    for (std::size_t c = 2; c < flights.names.size(); ++c)
      if (flights.names[c] != "verdict")
        out << (c % 5 == 2 ? "\n   " : "") << ' ' << flights.names[c] << ' '
            << flights.columns[c][i];
    out << "\n    " << program << " --seed " << static_cast<std::uint64_t>(flights["seed"][i])
        << " --replay " << index << '\n';
  }
}

}  // namespace examples
