#pragma once

#include "../support/mission_figures.hpp"
#include "../support/solver_choice.hpp"
#include "flights.hpp"
#include "table.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <array>
#include <cmath>
#include <cstddef>
#include <iomanip>
#include <limits>
#include <ostream>
#include <sstream>
#include <string>
#include <vector>

/// The paper's flights (paper, Sec. Real-World Experiments), and their figures beside the paper's.
namespace examples::paper {

inline constexpr double not_measured = std::numeric_limits<double>::quiet_NaN();

/// The figures of one flight. NaN: not measured.
struct Figures {
  std::string experiment, plant, settings;
  double rmse = not_measured;  ///< while the reference moves [m]
  std::array<double, 3> axes{not_measured, not_measured, not_measured};  ///< RMSE of x, y, z [m]
  double max = not_measured;         ///< largest error there [m]
  double from_start = not_measured;  ///< RMSE of the whole flight, with the way to the start [m]
  double air_power = not_measured, ground_power = not_measured;  ///< means in the eights [W]
  double lean = not_measured;                                    ///< largest lean [rad]
  double mode_changes = not_measured, failures = not_measured, unsolved = not_measured;
  SolverTicks solver;           ///< all zero: not measured
  double saved = not_measured;  ///< power on the ground against power in the air [%]
  std::string error;
  bool unstable = false;  ///< 0.5 m or more from the reference, or lost: digits depend on the build
};

/// The figures that the paper prints.
[[nodiscard]] inline std::vector<Figures> printed_in_the_paper() {
  const auto row = [](const char* experiment, double rmse) {
    Figures f;
    f.experiment = experiment;
    f.plant = "vehicle";
    f.settings = "paper";
    f.rmse = rmse;
    return f;
  };
  std::vector<Figures> rows{row("air", 0.052), row("ground", 0.145), row("hybrid", 0.125)};
  rows[2].air_power = 653.64;
  rows[2].ground_power = 47.38;
  return rows;
}

/// The controllers that fly the experiments.
struct ControllerChoice {
  const char* name;
  std::vector<std::string> as_in_paper;  ///< see paper_switches()
  std::string level = "wrench";          ///< of control, see level_for()
};

[[nodiscard]] inline const std::vector<ControllerChoice>& controllers() {
  static const std::vector<ControllerChoice> all{
      {"library", {}},
      {"library_actuator_level", {}, "actuator"},
      {"preset", {"all"}},  // paper_nmpc_settings()
      {"preset_wider_bounds",
       {"cost", "actuators", "contact", "ground", "conditions", "descent", "lead"}}};
  return all;
}

/// The flights: `experiments` of "air", "ground", "hybrid", `settings` of controllers().
[[nodiscard]] inline std::vector<FlightCase> experiment_flights(
    const std::vector<std::string>& experiments, const std::vector<std::string>& settings,
    const std::vector<PlantKind>& plants, std::int64_t seed,
    const std::string& solver = "automatic") {
  std::vector<FlightCase> flights;
  for (const std::string& experiment : experiments)
    for (const ControllerChoice& controller : controllers())
      for (const PlantKind plant : plants) {
        if (std::find(settings.begin(), settings.end(), controller.name) == settings.end())
          continue;
        FlightCase flight;
        flight.name = experiment + '_' + controller.name + '_' + to_string(plant);
        flight.plant = plant;
        flight.options.seed = seed;
        flight.options.mission.name = experiment == "hybrid" ? "rolling" : experiment;
        if (experiment == "hybrid") flight.options.start_off = 0.5;
        flight.options.as_in_paper = controller.as_in_paper;
        flight.options.level = controller.level;
        flight.options.solver = solver;
        flights.push_back(flight);
      }
  return flights;
}

/// Returns the figures of a flight of experiment_flights(), whose name says what it is.
[[nodiscard]] inline Figures figures_of(const FlightCase& flight, const FlightResult& result) {
  Figures f;
  const std::size_t first = flight.name.find('_'), last = flight.name.rfind('_');
  f.experiment = flight.name.substr(0, first);
  f.settings = flight.name.substr(first + 1, last - first - 1);
  f.plant = to_string(flight.plant);
  f.error = result.error;
  if (!f.error.empty()) return f;
  const MissionFigures& m = result.flown.figures;
  f.rmse = m.moving().value();
  for (std::size_t i = 0; i < 3; ++i) f.axes[i] = m.moving().axis(i);
  f.max = m.moving().max();
  f.from_start = m.all().value();
  if (m.air_power().count() > 0) f.air_power = m.air_power().value();
  if (m.ground_power().count() > 0) f.ground_power = m.ground_power().value();
  f.lean = result.flown.lean;
  f.mode_changes = result.flown.contact_mode_changes;
  f.failures = m.failures();
  f.unstable = !result.flown.loss.empty() || f.max > 0.5;
  f.unsolved = static_cast<double>(result.flown.solver.unsolved);
  f.solver = result.flown.solver;
  return f;
}

/// Fills in the power that the ground saves: against the same flight, or against the eight in the
/// air with the same plant and settings.
inline void compare_power(std::vector<Figures>& rows) {
  for (Figures& f : rows) {
    double air = f.air_power;
    for (const Figures& other : rows)
      if (std::isnan(air) && other.experiment == "air" && other.plant == f.plant &&
          other.settings == f.settings)
        air = other.air_power;
    f.saved = 100.0 * (1.0 - f.ground_power / air);
  }
}

/// The paper's figures, each followed by ours.
[[nodiscard]] inline std::vector<Figures> beside_the_paper(const std::vector<Figures>& flown) {
  std::vector<Figures> rows;
  for (const Figures& paper : printed_in_the_paper()) {
    rows.push_back(paper);
    for (const Figures& ours : flown)
      if (ours.experiment == paper.experiment) rows.push_back(ours);
  }
  compare_power(rows);
  return rows;
}

[[nodiscard]] inline Table experiment_table(const std::vector<Figures>& rows) {
  Table table({"experiment", "flown by", "settings", "RMSE [mm]", "x", "y", "z", "max [mm]",
               "with start [mm]", "air [W]", "ground [W]", "saved [%]", "lean [deg]",
               "mode changes", "failures", "unsolved ticks"},
              3);
  for (const Figures& f : rows) {
    const auto length = [&f](double metres) {
      return f.unstable ? order_of_magnitude(1e3 * metres) : millimetres(metres);
    };
    const auto other = [&f](double value, int digits) {
      return f.unstable ? order_of_magnitude(value) : number(value, digits);
    };
    table.add({f.experiment, f.plant, f.error.empty() ? f.settings : f.settings + ": " + f.error,
               length(f.rmse), length(f.axes[0]), length(f.axes[1]), length(f.axes[2]),
               length(f.max), length(f.from_start), other(f.air_power, 2), other(f.ground_power, 2),
               f.unstable ? "" : number(f.saved, 1), other(f.lean * 180.0 / tilt_ropter::pi, 1),
               number(f.mode_changes, 0), number(f.failures, 0), number(f.unsolved, 0)});
  }
  return table;
}

/// The same as CSV, in SI units. Not measured: nan.
[[nodiscard]] inline std::string experiment_csv(const std::vector<Figures>& rows) {
  std::ostringstream out;
  out << "experiment,flown_by,settings,rmse_m,rmse_x_m,rmse_y_m,rmse_z_m,max_error_m,"
         "rmse_from_start_m,air_power_w,ground_power_w,power_saved_percent,lean_max_rad,"
         "contact_mode_changes,solver_failures,unsolved_ticks\n";
  for (const Figures& f : rows) {
    out << f.experiment << ',' << f.plant << ',' << f.settings;
    out << csv_numbers({f.rmse, f.axes[0], f.axes[1], f.axes[2], f.max, f.from_start, f.air_power,
                        f.ground_power, f.saved, f.lean, f.mode_changes, f.failures, f.unsolved})
        << '\n';
  }
  return out.str();
}

/// Prints the figures of every row as lines `key: value`.
inline void print(std::ostream& out, const std::vector<Figures>& rows) {
  for (const Figures& f : rows) {
    const std::string name = f.experiment + '_' + f.settings + '_' + f.plant + '_';
    const auto line = [&](const char* key, double value, int digits) {
      if (!std::isnan(value)) out << name << key << ": " << number(value, digits) << '\n';
    };
    if (!f.error.empty()) out << name << "error: " << f.error << '\n';
    line("rmse_m", f.rmse, 4);
    line("rmse_x_m", f.axes[0], 4);
    line("rmse_y_m", f.axes[1], 4);
    line("rmse_z_m", f.axes[2], 4);
    line("max_error_m", f.max, 4);
    line("rmse_from_start_m", f.from_start, 4);
    line("air_power_w", f.air_power, 2);
    line("ground_power_w", f.ground_power, 2);
    line("power_saved_percent", f.saved, 2);
    line("lean_max_deg", f.lean * 180.0 / tilt_ropter::pi, 2);
    line("contact_mode_changes", f.mode_changes, 0);
    line("solver_failures", f.failures, 0);
    if (!std::isnan(f.unsolved)) f.solver.print(out, name);
  }
}

}  // namespace examples::paper
