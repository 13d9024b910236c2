// Reproduces the paper: its flights in our plant and in MuJoCo, the identification of the servo,
// the hardware in the loop, its drawings, and a table of all figures beside the printed ones.

#include "../support/pictures.hpp"
#include "../support/run_program.hpp"
#include "../support/solver_choice.hpp"
#include "ablations.hpp"
#include "control_diagram.hpp"
#include "experiments.hpp"
#include "flights.hpp"
#include "frames_drawing.hpp"
#include "hitl_flight.hpp"
#include "servo_experiment.hpp"
#include "table.hpp"

#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

namespace fs = std::filesystem;
using namespace examples::paper;

namespace {

struct Options {
  std::string output = "results/paper", update;
  std::vector<std::string> only, settings, plants;
  std::string solver = "automatic";
  std::int64_t seed = 1;
  int threads = 2;
  bool ablations = false, hitl = false, mcap = false, no_pictures = false;
  double hitl_until = 0.0;
  std::string programs;  // directory of the other programs
};

const std::vector<std::string> experiments{"air", "ground", "hybrid"};

bool wants(const std::vector<std::string>& chosen, const std::string& name) {
  return chosen.empty() || std::find(chosen.begin(), chosen.end(), name) != chosen.end();
}

bool named(const std::vector<std::string>& chosen, const std::string& name) {
  return !chosen.empty() && wants(chosen, name);
}

std::vector<std::string> chosen(const std::vector<std::string>& all,
                                const std::vector<std::string>& choice) {
  std::vector<std::string> some;
  std::copy_if(all.begin(), all.end(), std::back_inserter(some),
               [&](const std::string& name) { return wants(choice, name); });
  return some;
}

std::vector<PlantKind> plants_of(const Options& o) {
  std::vector<PlantKind> plants;
  if (wants(o.plants, "plant")) plants.push_back(PlantKind::own);
  if (named(o.plants, "mujoco") && !has_mujoco)
    throw std::runtime_error("built without MuJoCo (Debian: libmujoco-dev)");
  if (has_mujoco && wants(o.plants, "mujoco")) plants.push_back(PlantKind::mujoco);
  if (!has_mujoco) std::cerr << "without MuJoCo (Debian: libmujoco-dev): our plant only\n";
  return plants;
}

/// Copies these pictures to the pictures of the examples, and replaces a section of the README if
/// everything was flown.
void update(const Options& o, const std::string& section, const std::string& text,
            const std::vector<std::string>& pictures) {
  if (o.update.empty()) return;
  const bool complete = o.only.empty() && o.settings.empty() && o.plants.empty();
  if (complete && !section.empty())
    replace_section(o.update + "/paper/README.md", section, '\n' + text + '\n');
  for (const std::string& picture : pictures)
    if (fs::exists(o.output + '/' + picture))
      fs::copy_file(o.output + '/' + picture, o.update + "/pictures/" + picture,
                    fs::copy_options::overwrite_existing);
}

void draw(const std::string& script, const Options& o) {
  const fs::path here = fs::current_path();
  examples::draw_pictures(script, o.output);
  fs::current_path(here);
}

std::vector<FlightCase> with_mcap(std::vector<FlightCase> flights, bool mcap) {
  for (FlightCase& flight : flights) flight.mcap = mcap;
  return flights;
}

int fly_experiments(const Options& o) {
  const std::vector<std::string> flown = chosen(experiments, o.only);
  const std::vector<PlantKind> plants = plants_of(o);
  std::vector<std::string> settings;
  for (const ControllerChoice& controller : controllers())
    if (wants(o.settings, controller.name)) settings.emplace_back(controller.name);
  std::vector<Figures> ours;
  int errors = 0;
  const std::vector<FlightCase> cases =
      with_mcap(experiment_flights(flown, settings, plants, o.seed, o.solver), o.mcap);
  if (!cases.empty()) {
    const std::vector<FlightResult> results = fly_all(cases, o.output, o.threads);
    for (std::size_t i = 0; i < cases.size(); ++i) {
      ours.push_back(figures_of(cases[i], results[i]));
      if (results[i].error.empty()) continue;
      std::cerr << cases[i].name << ": " << results[i].error << '\n';
      ++errors;
    }
  }
  if (o.hitl || named(o.only, "hitl")) {
    std::cerr << "hardware in the loop, in real time\n";
    const std::vector<Figures> loop = fly_hardware_in_the_loop(o.programs, o.output, o.hitl_until);
    ours.insert(ours.end(), loop.begin(), loop.end());
  }
  if (!ours.empty()) {
    const std::vector<Figures> rows = beside_the_paper(ours);
    const std::string table = experiment_table(rows).markdown() + '\n' + about_unstable_flights;
    print(std::cout, rows);
    std::cout << '\n' << table << '\n';
    write_text(o.output + "/paper.csv", experiment_csv(rows));
    write_text(o.output + "/paper.md", table);
    update(o, "experiments", table, {});
  }
  return errors > 0 ? 1 : 0;
}

int fly_ablations(const Options& o) {
  const std::vector<PlantKind> plants = plants_of(o);
  const std::vector<FlightResult> results =
      fly_all(with_mcap(ablation_flights(plants, o.seed, o.solver), o.mcap), o.output, o.threads);
  const std::vector<AblationFigures> rows = figures_of(plants, results);
  const std::string table = ablation_table(rows).markdown() + '\n' + about_unstable_flights;
  print(std::cout, rows);
  std::cout << '\n' << table << '\n';
  write_text(o.output + "/ablations.csv", ablation_csv(rows));
  write_text(o.output + "/ablations.md", table);
  if (!o.no_pictures) draw("paper/ablations.gp", o);
  update(o, "ablations", table, {"ablations.png"});
  return std::all_of(rows.begin(), rows.end(), [](const auto& row) { return row.error.empty(); })
             ? 0
             : 1;
}

int reproduce(const Options& o) {
  fs::create_directories(o.output);
  int code = 0;
  if (wants(o.only, "servo"))
    identify_simulated_servo(std::cout, o.output, static_cast<std::uint64_t>(o.seed));
  code = std::max(code, fly_experiments(o));
  if (wants(o.only, "drawings")) {
    write_text(o.output + "/frames.svg", draw_frames(tilt_ropter::tilt_ropter_vehicle()));
    write_text(o.output + "/control_diagram.svg", draw_control_diagram());
  }
  if (!o.no_pictures) draw("paper/reproduce_paper.gp", o);
  update(o, "", "",
         {"frames.svg", "control_diagram.svg", "paper_trajectories.png", "paper_hybrid.png",
          "paper_power.png", "paper_servo.png"});
  if (named(o.only, "ablations") || o.ablations) code = std::max(code, fly_ablations(o));
  return code;
}

constexpr const char* footer = R"(
Files in the output directory: a directory with the log of each flight (such as
air_library_plant/hybrid_mission.csv), paper.csv and paper.md (the table beside the paper's
figures), servo_identification.csv, frames.svg, control_diagram.svg, hitl_*.txt, ablations.csv,
ablations.md, and pictures.

Exit code: 0 all is done, 1 a flight could not be flown or a file not be written, above 100 wrong
options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Reproduces the paper: flies its experiments, identifies the servo, draws its figures, and "
      "writes a table of all figures beside the printed ones."};
  Options o;
  o.programs = fs::absolute(argv[0]).parent_path().string();
  app.add_option("-o,--output", o.output, "directory for logs, tables and pictures")
      ->capture_default_str();
  app.add_option("--only", o.only,
                 "only these, separated by commas: air, ground, hybrid (flights), servo, drawings, "
                 "hitl, ablations; default: all but the last two")
      ->delimiter(',')
      ->check(CLI::IsMember({"air", "ground", "hybrid", "servo", "drawings", "hitl", "ablations"}));
  std::vector<std::string> names;
  for (const ControllerChoice& controller : controllers()) names.emplace_back(controller.name);
  app.add_option("--settings", o.settings,
                 "fly with these settings only, separated by commas: library (the library's own), "
                 "library_actuator_level (the same, planning thrusts and tilt angles), preset (the "
                 "paper as printed), preset_wider_bounds (the paper's equations with "
                 "the library's bounds); default: all")
      ->delimiter(',')
      ->check(CLI::IsMember(names));
  app.add_option(
         "--plants", o.plants,
         "fly in these plants only, separated by commas: plant (ours), mujoco; default: all "
         "that are there")
      ->delimiter(',')
      ->check(CLI::IsMember({"plant", "mujoco"}));
  app.add_flag("--hitl", o.hitl,
               "also fly the hybrid mission with hardware in the loop, in real time");
  app.add_option("--hitl-until", o.hitl_until,
                 "end that flight at this mission time; 0: full mission [s]")
      ->check(CLI::Range(0.0, 1000.0));
  app.add_flag("--ablations", o.ablations,
               "also fly the hybrid mission with one part of the controller changed at a time");
  examples::add_solver_in_real_time(app, o.solver);
  app.add_option("--seed", o.seed, "seed of the sensor noise")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  app.add_option("--threads", o.threads, "flights at the same time")
      ->check(CLI::Range(1, 256))
      ->capture_default_str();
  app.add_option(
         "--update", o.update,
         "also replace the pictures in pictures/ of this folder, the project's examples/, and "
         "after complete runs the tables in its paper/README.md")
      ->check(CLI::ExistingDirectory);
  app.add_flag("--mcap", o.mcap,
               "also write flight.mcap beside the log of each flight, as --mcap of hybrid_mission");
  app.add_flag("--no-pictures", o.no_pictures, "write tables, logs and drawings, no plots");
  app.footer(footer);
  return examples::run_program(app, "reproduce_paper", argc, argv, [&] { return reproduce(o); });
}
