// The main job: take off, fly the paper's figure eight, land, drive a similar one, take off again,
// hover, land. The plant runs at 1 kHz and is not the vehicle that the controller believes in.

#include "support/mission_loop.hpp"
#include "support/pictures.hpp"

#include <tilt_ropter/simulation/plant.hpp>

#include <CLI/CLI.hpp>

#include <exception>
#include <iostream>

int main(int argc, char** argv) {
  CLI::App app{"Flies the hybrid mission: take off, figure eight, land, drive, take off, land."};
  examples::MissionOptions options;
  examples::add_options(app, options);
  CLI11_PARSE(app, argc, argv);
  try {
    const examples::MissionVehicles vehicles = examples::vehicles(options);
    tilt_ropter::Plant<4> plant(vehicles.truth);
    examples::fly_mission(
        options, vehicles, plant, [] { return tilt_ropter::Wrench<>{}; },
        [](const tilt_ropter::Mission&) {});  // the logs are closed when it returns
    if (!options.no_pictures) examples::draw_pictures("hybrid_mission.gp", options.output);
    return 0;
  } catch (const std::exception& error) {
    std::cerr << "hybrid_mission: " << error.what() << '\n';
    return 1;
  }
}
