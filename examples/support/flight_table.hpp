#pragma once

#include "csv.hpp"
#include "spread_flight.hpp"
#include "statistics.hpp"
#include "vehicle_spread.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iomanip>
#include <limits>
#include <ostream>
#include <set>
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
          {"solver_failures", static_cast<double>(r.solver_failures)}};
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

/// Merges the rows of several files into one table, sorted by index. Throws std::runtime_error with
/// file and line if a file cannot be read or has another seed. Throws it also if a vehicle occurs
/// twice, or if a seed, index or verdict is invalid.
[[nodiscard]] inline CsvTable merge_flights(const std::vector<std::string>& files) {
  CsvTable all{"", flight_columns(), {}, {}};
  struct Row {
    double index;
    std::vector<double> values;
  };
  std::vector<Row> rows;
  std::set<double> seen;
  double seed = std::numeric_limits<double>::quiet_NaN();
  for (const std::string& file : files) {
    const CsvTable part = read_csv(file, all.names, CsvNumbers::any);
    for (std::size_t i = 0; i < part.rows(); ++i) {
      const std::string where = file + ':' + std::to_string(part.lines[i]) + ": ";
      Row row{part["index"][i], {}};
      if (!is_count(part["seed"][i])) throw std::runtime_error(where + "no such seed");
      if (!is_count(row.index)) throw std::runtime_error(where + "no such index");
      if (std::isnan(seed)) seed = part["seed"][i];
      if (!(part["seed"][i] == seed)) throw std::runtime_error(where + "the seed is another one");
      if (!seen.insert(row.index).second)
        throw std::runtime_error(where + "the vehicle is there twice");
      const double verdict = part["verdict"][i];
      if (!is_count(verdict) || verdict > static_cast<double>(Verdict::grounded))
        throw std::runtime_error(where + "no such verdict");
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
