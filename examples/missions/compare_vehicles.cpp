// Full actuation against leaning: flies the same mission with a vehicle, with the same vehicle
// whose servos are locked, so that it has to lean, and with a bicopter. Compares tracking and
// power.

#include "../support/pictures.hpp"
#include "../support/progress.hpp"
#include "../support/run_program.hpp"
#include "../support/simulated_mission.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_check.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <CLI/CLI.hpp>

#include <cstdint>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

namespace {

struct Options {
  std::string output = "results", vehicle, solver = "automatic";
  std::vector<std::string> others;
  std::string mission = "hybrid";
  std::int64_t seed = 1;
  bool mcap = false, no_pictures = false;
};

/// Returns the vehicle with its servos locked at zero. Its axles no longer turn with the arms.
examples::VehicleFile locked(examples::VehicleFile file) {
  std::visit(
      [](auto& vehicle) {
        for (tilt_ropter::RotorGeometry& rotor : vehicle.rotors) rotor.tilts = false;
        if (vehicle.wheels) vehicle.wheels->on_arms = false;
      },
      file.vehicle);
  file.name += " with locked servos";
  return file;
}

struct Row {
  std::string name, level;
  double mass = 0.0, lean = 0.0;  // [kg], [rad]
  examples::MissionFigures figures{0.0};
  examples::SolverTicks solver;
};

/// Returns a number with `digits` decimals, or "-" if nothing was counted.
std::string shown(double value, int digits, long count = 1) {
  std::ostringstream text;
  text << std::fixed << std::setprecision(digits) << value;
  return count > 0 ? text.str() : "-";
}

/// Power saved on the ground [%].
double saved(const examples::MissionFigures& figures) {
  return 100.0 * (1.0 - figures.ground_power().value() / figures.air_power().value());
}

void print(const std::vector<Row>& rows) {
  std::cout << std::left << std::setw(38) << "vehicle" << std::setw(10) << "level" << std::right
            << std::setw(10) << "RMSE air" << std::setw(9) << "ground" << std::setw(7) << "lean"
            << std::setw(11) << "power air" << std::setw(9) << "ground" << std::setw(8) << "saved"
            << '\n'
            << std::left << std::setw(48) << "" << std::right << std::setw(10) << "[mm]"
            << std::setw(9) << "[mm]" << std::setw(7) << "[deg]" << std::setw(11) << "[W]"
            << std::setw(9) << "[W]" << std::setw(8) << "[%]" << '\n';
  for (const Row& row : rows) {
    const examples::MissionFigures& f = row.figures;
    const long drives = f.ground().count();
    std::cout << std::left << std::setw(38) << row.name << std::setw(10) << row.level << std::right
              << std::setw(10) << shown(1e3 * f.air().value(), 1) << std::setw(9)
              << shown(1e3 * f.ground().value(), 1, drives) << std::setw(7)
              << shown(row.lean * 180.0 / tilt_ropter::pi, 1) << std::setw(11)
              << shown(f.air_power().value(), 1) << std::setw(9)
              << shown(f.ground_power().value(), 1, drives) << std::setw(8)
              << shown(saved(f), 1, drives) << '\n';
  }
}

void write(const std::vector<Row>& rows, const std::string& path) {
  std::ofstream out(path);
  out << "vehicle,level,mass_kg,air_rmse_m,ground_rmse_m,mission_rmse_m,lean_max_deg,"
         "flight_power_w,ground_power_w,power_saved_percent,touchdown_speed_mps,solver_failures,"
         "active_ticks,riccati_ticks,nlopt_ticks,structured_ticks,unsolved_ticks\n";
  for (const Row& row : rows) {
    const examples::MissionFigures& f = row.figures;
    const bool drives = f.ground().count() > 0;
    out << '"' << row.name << "\"," << row.level << ',' << row.mass << ',' << f.air().value()
        << ',';
    if (drives) out << f.ground().value();
    out << ',' << f.all().value() << ',' << row.lean * 180.0 / tilt_ropter::pi << ','
        << f.air_power().value() << ',';
    if (drives) out << f.ground_power().value();
    out << ',';
    if (drives) out << saved(f);
    const examples::SolverTicks& s = row.solver;
    out << ',' << f.touchdown_speed() << ',' << f.failures() << ',' << s.active << ',' << s.riccati
        << ',' << s.nlopt << ',' << s.structured << ',' << s.unsolved << '\n';
  }
  if (!out.flush()) throw std::runtime_error("cannot write " + path);
}

/// Returns the exit code.
int run(const Options& options) {
  std::vector<examples::VehicleFile> files;
  files.push_back(examples::vehicle_to_fly(options.vehicle));
  files.push_back(locked(files.front()));
  for (const std::string& path : options.others) files.push_back(examples::read_vehicle(path));
  std::vector<Row> rows;
  std::vector<std::string> losses;
  examples::Progress progress;
  for (const examples::VehicleFile& file : files) {
    examples::MissionOptions flight;
    flight.mission.name = options.mission;
    flight.seed = options.seed;
    flight.solver = options.solver;
    flight.stop_at_loss = true;
    flight.output = options.output + "/vehicle_" + std::to_string(rows.size() + 1);
    if (options.mcap) flight.mcap = flight.output + "/flight.mcap";
    const double before = static_cast<double>(rows.size()), all = static_cast<double>(files.size());
    const examples::FlownMission flown =
        examples::fly_simulated(flight, file, [&](double fraction, tilt_ropter::MissionPhase) {
          progress.show((before + fraction) / all, file.name);
        });
    if (!flown.loss.empty())
      losses.push_back(file.name + ": " + flown.loss + "; likely reason: " + flown.loss_reason);
    Row row;
    row.name = file.name;
    row.level = examples::level_for("", file);
    row.mass = std::visit([](const auto& vehicle) { return vehicle.body.mass; }, file.vehicle);
    row.lean = flown.lean;
    row.figures = flown.figures;
    row.solver = flown.solver;
    rows.push_back(row);
  }
  progress.finish();
  print(rows);
  examples::SolverTicks solver;
  for (const Row& row : rows) solver.add(row.solver);
  solver.print(std::cout);
  write(rows, options.output + "/compare_vehicles.csv");
  for (const std::string& loss : losses) std::cerr << "compare_vehicles: " << loss << '\n';
  return losses.empty() ? 0 : 1;
}

constexpr const char* footer = R"(
Lean is the largest angle of the body's z axis to the vertical; power is the mean in the figure
eights in the air and on the ground.

Files in the output directory: compare_vehicles.csv, one row per vehicle; vehicle_1/, vehicle_2/,
... with the log of each flight as hybrid_mission writes it; and compare_vehicles.png.

Exit code: 0 success, 1 a vehicle was lost or another error, 2 an invalid vehicle file, above 100
wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Compares full actuation with leaning: flies the same mission with a vehicle, with the same\n"
      "vehicle whose servos are locked, and with other vehicles. Each is controlled at the level\n"
      "that suits it."};
  Options options;
  options.others = {TILT_ROPTER_EXAMPLES_DIR "/vehicles/bicopter.json"};
  app.add_option("--vehicle", options.vehicle,
                 "JSON file of the first vehicle; default: the Tilt-Ropter");
  app.add_option("--other", options.others,
                 "JSON file of a vehicle to compare with; may be repeated; default: the bicopter");
  examples::add_solver_in_real_time(app, options.solver);
  app.add_option("--mission", options.mission, "hybrid, air or ground, as of hybrid_mission")
      ->check(CLI::IsMember({"hybrid", "air", "ground"}))
      ->capture_default_str();
  app.add_option("--seed", options.seed, "seed of the sensor noise")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  app.add_option("-o,--output", options.output, "directory for table, logs and picture")
      ->capture_default_str();
  app.add_flag("--mcap", options.mcap,
               "also write flight.mcap of each vehicle, as --mcap of hybrid_mission");
  app.add_flag("--no-pictures", options.no_pictures, "write only the table and the logs");
  app.footer(footer);
  return examples::run_program(app, "compare_vehicles", argc, argv, [&options] {
    const int lost = run(options);
    if (!options.no_pictures)
      examples::draw_pictures("missions/compare_vehicles.gp", options.output);
    return lost;
  });
}
