// The hybrid mission: take off, fly the figure eight of the paper, land, drive a similar figure
// eight, take off again, hover, land. The plant runs at 1 kHz. Its vehicle differs from the one
// that the controller assumes.

#include "../support/pictures.hpp"
#include "../support/report.hpp"
#include "../support/run_program.hpp"
#include "../support/simulated_mission.hpp"

#include <CLI/CLI.hpp>

#include <iostream>
#include <sstream>
#include <string>
#include <variant>

int main(int argc, char** argv) {
  CLI::App app{
      "Simulates the hybrid mission: take off, figure eight, land, drive, take off, land.\n"
      "A vehicle with legs skips the drive; a vehicle without wheels or legs only flies the figure "
      "eight."};
  examples::MissionOptions options;
  examples::add_options(app, options);
  app.footer(examples::mission_exit_codes);
  std::string write_path;
  app.add_option("--write-vehicle", write_path,
                 "write the vehicle to this JSON file as a template, without flying");
  return examples::run_program(app, "hybrid_mission", argc, argv, [&] {
    const examples::VehicleFile file = examples::vehicle_or_default(options.vehicle_path);
    if (!write_path.empty()) {
      examples::write_vehicle(file, write_path);
      return 0;
    }
    const auto write = [&](const auto& vehicle) { return write_mission(options.mission, vehicle); };
    if (std::visit(write, file.vehicle)) return 0;
    options.stop_at_loss = true;
    double lean = 0.0;
    examples::FlightReport report =
        examples::report_flight(options, file, [&](const examples::FlightProgress& on_progress) {
          examples::FlownMission flown = examples::fly_simulated(options, file, on_progress);
          lean = flown.lean;
          return flown;
        });
    if (options.wall.x) {
      std::ostringstream printed;
      printed << "lean_max_deg: " << lean * 180.0 / tilt_ropter::pi << '\n';
      std::cout << printed.str();
      report.figures += printed.str();
    }
    if (!options.no_pictures) {
      examples::write_report(options.output, file, report.figures);
      examples::draw_pictures("missions/hybrid_mission.gp", options.output);
    }
    return report.exit_code("hybrid_mission");
  });
}
