// The main job: take off, fly the paper's figure eight, land, drive a similar one, take off again,
// hover, land. The plant runs at 1 kHz and is not the vehicle that the controller believes in.

#include "support/mission_loop.hpp"
#include "support/pictures.hpp"
#include "support/run_program.hpp"

#include <tilt_ropter/simulation/plant.hpp>

#include <CLI/CLI.hpp>

#include <string>
#include <variant>

int main(int argc, char** argv) {
  CLI::App app{
      "Flies the hybrid mission: take off, figure eight, land, drive, take off, land.\n"
      "A vehicle on legs does all but drive; one without wheels and legs flies the eight in the "
      "air."};
  examples::MissionOptions options;
  examples::add_options(app, options);
  std::string write_path;
  app.add_option("--write-vehicle", write_path,
                 "write the vehicle to this JSON file, to begin from, and fly nothing");
  return examples::run_program(app, "hybrid_mission", argc, argv, [&] {
    const examples::VehicleFile file = examples::vehicle_or_default(options.vehicle_path);
    if (!write_path.empty()) {
      examples::write_vehicle(file, write_path);
      return 0;
    }
    std::visit(
        [&](const auto& vehicle) {
          const auto vehicles = examples::vehicles(options, vehicle);
          tilt_ropter::Plant plant(vehicles.truth);
          examples::fly_mission(
              options, file, vehicles, plant, [] { return tilt_ropter::Wrench<>{}; },
              [](const tilt_ropter::Mission&) {});  // the logs are closed when it returns
        },
        file.vehicle);
    if (!options.no_pictures) examples::draw_pictures("hybrid_mission.gp", options.output);
    return 0;
  });
}
