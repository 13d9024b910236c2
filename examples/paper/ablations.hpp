#pragma once

#include "../support/mission_figures.hpp"
#include "flights.hpp"
#include "table.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iomanip>
#include <limits>
#include <ostream>
#include <sstream>
#include <string>
#include <vector>

/// Ablations: the hybrid mission with one part of the controller taken away or changed at a time.
/// Some parts matter only if something is wrong; these are also flown under this condition.
namespace examples::paper {

struct Ablation {
  const char* name;     ///< in keys and files
  const char* change;   ///< what is different, and the option of hybrid_mission for it
  const char* shipped;  ///< name of the flight to compare with, of the controller as it is
  void (*set)(MissionOptions& options);
};

[[nodiscard]] inline const std::vector<Ablation>& ablations() {
  using O = MissionOptions;
  static const std::vector<Ablation> all{
      {"shipped", "nothing", "shipped", [](O&) {}},
      {"observer_off", "no external wrench: `--observer off`", "shipped",
       [](O& o) { o.observer = "off"; }},
      {"observer_commands", "observer fed with commands: `--observer commands`", "shipped",
       [](O& o) { o.observer = "commands"; }},
      {"observer_slow", "observer three times slower: `--observer-bandwidth 6.67`", "shipped",
       [](O& o) { o.observer_bandwidth /= 3.0; }},
      {"observer_fast", "observer three times faster: `--observer-bandwidth 60`", "shipped",
       [](O& o) { o.observer_bandwidth *= 3.0; }},
      {"actuators_off", "no actuator constraints: `--no-actuator-rows`", "shipped",
       [](O& o) { o.no_actuator_constraints = true; }},
      {"conditions_off", "no ground conditions: `--no-ground-conditions`", "shipped",
       [](O& o) { o.no_ground_conditions = true; }},
      {"unloading_off", "thrust carries the weight on the ground: `--ground-thrust 14.7`",
       "shipped",
       [](O& o) {
         o.ground_thrust = tilt_ropter::tilt_ropter_vehicle().body.mass * tilt_ropter::gravity;
       }},
      {"ground_as_wrench", "the ground is its estimated wrench: `--as-in-paper ground`", "shipped",
       [](O& o) { o.as_in_paper = {"ground"}; }},
      {"lead_off", "commands without lead: `--as-in-paper lead`", "shipped",
       [](O& o) { o.as_in_paper = {"lead"}; }},
      {"contact_by_height", "contact by height: `--as-in-paper contact`", "shipped",
       [](O& o) { o.as_in_paper = {"contact"}; }},
      {"feed_forward_off", "cost expects hover: `--no-feed-forward`", "shipped",
       [](O& o) { o.no_feed_forward = true; }},
      {"wrench_in_cost", "cost on F and M themselves: `--as-in-paper cost`", "shipped",
       [](O& o) { o.as_in_paper = {"cost"}; }},
      {"height_off", "nothing, height 0.1 m off: `--height-offset 0.1`", "height_off",
       [](O& o) { o.height_offset = 0.1; }},
      {"height_off_contact_by_height", "contact by height, height 0.1 m off", "height_off",
       [](O& o) {
         o.height_offset = 0.1;
         o.as_in_paper = {"contact"};
       }},
      {"slow_servos", "nothing, servos of 2 rad/s: `--servo-speed 2`", "slow_servos",
       [](O& o) { o.servo_speed = 2.0; }},
      {"slow_servos_actuators_off", "no actuator constraints, servos of 2 rad/s", "slow_servos",
       [](O& o) {
         o.servo_speed = 2.0;
         o.no_actuator_constraints = true;
       }},
      {"vibration", "nothing, vibration: `--vibration 0.5`", "vibration",
       [](O& o) { o.vibration = 0.5; }},
      {"vibration_observer_fast", "observer three times faster, vibration", "vibration",
       [](O& o) {
         o.vibration = 0.5;
         o.observer_bandwidth *= 3.0;
       }},
  };
  return all;
}

/// The figures of one ablation in one plant. NaN: not flown.
struct AblationFigures {
  std::string name, change, shipped, plant, error;
  double air = std::numeric_limits<double>::quiet_NaN(), ground = air, mission = air;  ///< RMSE [m]
  double ground_power = air, saved = air;                                              ///< [W], [%]
  double planned_tilt_rate = air, servo_demand = air;  ///< largest [rad/s]
  double mode_changes = air, failures = air, unsolved = air;
  bool unstable = false;  ///< as in Figures
};

[[nodiscard]] inline std::vector<FlightCase> ablation_flights(const std::vector<PlantKind>& plants,
                                                              std::int64_t seed,
                                                              const std::string& solver) {
  std::vector<FlightCase> flights;
  for (const Ablation& ablation : ablations())
    for (const PlantKind plant : plants) {
      FlightCase flight;
      flight.name = std::string(ablation.name) + '_' + to_string(plant);
      flight.plant = plant;
      flight.options.seed = seed;
      flight.options.no_log = true;
      flight.options.solver = solver;
      ablation.set(flight.options);
      flights.push_back(flight);
    }
  return flights;
}

/// Returns the figures of ablation_flights(plants, seed) after these `results`.
[[nodiscard]] inline std::vector<AblationFigures> figures_of(
    const std::vector<PlantKind>& plants, const std::vector<FlightResult>& results) {
  std::vector<AblationFigures> rows;
  for (const Ablation& ablation : ablations())
    for (const PlantKind plant : plants) {
      const FlightResult& result = results.at(rows.size());
      AblationFigures f;
      f.name = ablation.name;
      f.change = ablation.change;
      f.shipped = ablation.shipped;
      f.plant = to_string(plant);
      f.error = result.error;
      if (f.error.empty()) {
        const MissionFigures& m = result.flown.figures;
        f.air = m.air().value();
        f.ground = m.ground().value();
        f.mission = m.all().value();
        f.ground_power = m.ground_power().value();
        f.saved = 100.0 * (1.0 - f.ground_power / m.air_power().value());
        f.planned_tilt_rate = m.planned_tilt_rate();
        f.servo_demand = m.servo_demand();
        f.mode_changes = result.flown.contact_mode_changes;
        f.failures = m.failures();
        f.unstable = !result.flown.loss.empty() || m.moving().max() > 0.5;
        f.unsolved = static_cast<double>(result.flown.solver.unsolved);
      }
      rows.push_back(f);
    }
  return rows;
}

/// Says in which figures `f` is worse or better than `shipped`: by more than a tenth, and by more
/// than half a millimetre, two watts or 0.5 rad/s.
[[nodiscard]] inline std::string effect(const AblationFigures& f, const AblationFigures& shipped) {
  if (!f.error.empty()) return f.error;
  std::string worse, better;
  const auto compare = [&](const char* what, double value, double reference, double least) {
    const double difference = value - reference;
    if (std::abs(difference) < least || std::abs(difference) < 0.1 * reference) return;
    std::string& list = difference > 0.0 ? worse : better;
    list += (list.empty() ? "" : ", ") + std::string(what);
  };
  compare("air", f.air, shipped.air, 5e-4);
  compare("ground", f.ground, shipped.ground, 5e-4);
  compare("mission", f.mission, shipped.mission, 5e-4);
  compare("power", f.ground_power, shipped.ground_power, 2.0);
  compare("servos", f.servo_demand, shipped.servo_demand, 0.5);
  if (worse.empty() && better.empty()) return "none";
  return (worse.empty() ? "" : "worse: " + worse) + (worse.empty() || better.empty() ? "" : "; ") +
         (better.empty() ? "" : "better: " + better);
}

/// The figures of `name` in the plant of `f`.
[[nodiscard]] inline const AblationFigures& same_plant(const std::vector<AblationFigures>& rows,
                                                       const std::string& plant,
                                                       const std::string& name) {
  for (const AblationFigures& row : rows)
    if (row.plant == plant && row.name == name) return row;
  return rows.front();
}

[[nodiscard]] inline Table ablation_table(const std::vector<AblationFigures>& rows) {
  Table table({"changed", "flown by", "effect", "air [mm]", "ground [mm]", "mission [mm]",
               "ground [W]", "saved [%]", "plan turns arms [rad/s]", "servos start [rad/s]",
               "mode changes", "failures", "unsolved ticks"},
              3);
  for (const AblationFigures& f : rows) {
    const auto length = [&f](double metres) {
      return f.unstable ? order_of_magnitude(1e3 * metres) : millimetres(metres);
    };
    const auto other = [&f](double value) {
      return f.unstable ? order_of_magnitude(value) : number(value, 1);
    };
    table.add({f.change, f.plant,
               f.name == f.shipped ? "" : effect(f, same_plant(rows, f.plant, f.shipped)),
               length(f.air), length(f.ground), length(f.mission), other(f.ground_power),
               f.unstable ? "" : number(f.saved, 1), other(f.planned_tilt_rate),
               other(f.servo_demand), number(f.mode_changes, 0), number(f.failures, 0),
               number(f.unsolved, 0)});
  }
  return table;
}

/// The same as CSV: one row for each ablation, in SI units.
[[nodiscard]] inline std::string ablation_csv(const std::vector<AblationFigures>& rows) {
  std::ostringstream out;
  out << "ablation,flown_by,number,air_rmse_m,ground_rmse_m,mission_rmse_m,ground_power_w,"
         "power_saved_percent,planned_tilt_rate_max_radps,tilt_rate_max_radps,"
         "contact_mode_changes,solver_failures,unsolved_ticks\n";
  double place = 0.0;  // of the ablation, from 0
  for (const AblationFigures& f : rows) {
    if (&f != &rows.front() && f.name != (&f - 1)->name) ++place;
    out << f.name << ',' << f.plant
        << csv_numbers({place, f.air, f.ground, f.mission, f.ground_power, f.saved,
                        f.planned_tilt_rate, f.servo_demand, f.mode_changes, f.failures,
                        f.unsolved})
        << '\n';
  }
  return out.str();
}

/// Prints the figures as lines `key: value`.
inline void print(std::ostream& out, const std::vector<AblationFigures>& rows) {
  for (const AblationFigures& f : rows) {
    const std::string name = f.name + '_' + f.plant + '_';
    if (!f.error.empty()) {
      out << name << "error: " << f.error << '\n';
      continue;
    }
    out << name << "air_rmse_m: " << number(f.air, 4) << '\n'
        << name << "ground_rmse_m: " << number(f.ground, 4) << '\n'
        << name << "mission_rmse_m: " << number(f.mission, 4) << '\n'
        << name << "ground_power_w: " << number(f.ground_power, 2) << '\n'
        << name << "power_saved_percent: " << number(f.saved, 2) << '\n';
  }
}

}  // namespace examples::paper
