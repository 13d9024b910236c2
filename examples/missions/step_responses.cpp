// Effect of tuning: flies a sideways step and a turn, with each allowed error and each limit halved
// and doubled.

#include "../support/flight_controller.hpp"
#include "../support/mission_log.hpp"
#include "../support/mission_sensors.hpp"
#include "../support/pictures.hpp"
#include "../support/progress.hpp"
#include "../support/run_program.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_check.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <CLI/CLI.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <functional>
#include <iomanip>
#include <iostream>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

using namespace tilt_ropter;
using examples::VehicleFile;

namespace {

struct Options {
  std::string vehicle, output = "results", solver = "automatic";
  double step = 1.0, turn = 60.0;
  bool no_pictures = false;
};

constexpr double step_time = 1.0, turn_time = 4.0, end_time = 7.0, sample = 0.01;  // [s]

/// A setting to tune. `turns` is true if its effect is shown by the turn, false for the step.
struct Knob {
  const char* name;
  bool turns;
  std::function<void(VehicleFile&, double)> scale;
};

std::vector<Knob> knobs() {
  const auto error = [](Eigen::Vector3d AllowedErrors::*field) {
    return [field](VehicleFile& f, double factor) { f.allowed_errors.*field *= factor; };
  };
  const auto limit = [](Eigen::Vector3d NmpcBounds::*field) {
    return [field](VehicleFile& f, double factor) { f.limits.*field *= factor; };
  };
  // Scales the horizontal force only: the vertical force must carry the weight.
  const auto force = [](VehicleFile& f, double factor) {
    f.limits.force_min.head<2>() *= factor;
    f.limits.force_max.head<2>() *= factor;
  };
  const auto torque = [](VehicleFile& f, double factor) {
    f.limits.torque_min *= factor;
    f.limits.torque_max *= factor;
  };
  return {{"allowed position", false, error(&AllowedErrors::position)},
          {"allowed velocity", false, error(&AllowedErrors::velocity)},
          {"allowed force", false, error(&AllowedErrors::force)},
          {"allowed force rate", false, error(&AllowedErrors::force_rate)},
          {"limit of force", false, force},
          {"limit of force rate", false, limit(&NmpcBounds::force_rate)},
          {"allowed orientation", true, error(&AllowedErrors::orientation)},
          {"allowed angular velocity", true, error(&AllowedErrors::angular_velocity)},
          {"allowed torque", true, error(&AllowedErrors::torque)},
          {"allowed torque rate", true, error(&AllowedErrors::torque_rate)},
          {"limit of torque", true, torque},
          {"limit of angular velocity", true, limit(&NmpcBounds::angular_velocity)}};
}

/// Sideways position [m], heading [deg] and lean [deg], one value every `sample` seconds.
struct Response {
  std::vector<double> side, heading, lean;
  examples::SolverTicks solver;
};

template <int Rotors>
Response fly(const Options& options, const VehicleFile& file, const Vehicle<Rotors>& vehicle) {
  constexpr double period = 1e-3;
  double now = 0.0;
  // The reference ignores its argument: the controller does not see the steps in advance.
  const examples::Reference reference = [&](double) {
    ReferencePoint point;
    point.position << 0.0, now < step_time ? 0.0 : options.step, 1.5;
    point.orientation = quaternion_from_yaw(now < turn_time ? 0.0 : options.turn * pi / 180.0);
    return point;
  };
  Plant<Rotors> plant(vehicle);
  examples::MissionSensors<Rotors> sensors(1);
  NmpcSettings settings = examples::in_simulated_time(file.settings());
  examples::set_solver(options.solver, settings.solver);
  examples::FlightController<Rotors> controller(
      vehicle, settings, examples::MissionSensors<Rotors>::estimation(), observer_settings(20.0),
      {}, examples::ExternalWrench::modelled, options.solver == examples::nlopt_alone);
  ActuatorState<Rotors> command = controller.lift(vehicle.body.mass * gravity);
  controller.start_with(command);
  BodyStated start;
  start.position = reference(0.0).position;
  plant.reset(start, command);
  Response response;
  for (long i = 0; i < std::lround(end_time / period); ++i) {
    sensors.sense(plant, controller);
    if (i % std::lround(sample / period) == 0) {
      now = plant.time();
      if (controller.started()) {
        controller.prepare(now, reference);
        command = controller.control(now);
        response.solver.add(controller.result().status, controller.result().report);
      }
      const Eigen::Matrix3d r = plant.body().orientation.toRotationMatrix();
      response.side.push_back(plant.body().position.y());
      response.heading.push_back(std::atan2(r(1, 0), r(0, 0)) * 180.0 / pi);
      response.lean.push_back(std::acos(std::clamp(r(2, 2), -1.0, 1.0)) * 180.0 / pi);
    }
    if (!plant.step(command, {}, period)) throw std::runtime_error("the plant rejected a step");
  }
  return response;
}

/// Rise time from 10 to 90 % [s] (NaN if 90 % is not reached) and overshoot [%] of a step.
struct StepFigures {
  double rise = std::nan(""), overshoot = 0.0;
};

StepFigures figures(const std::vector<double>& values, double start, double end, double size) {
  StepFigures result;
  double at_ten = std::nan("");
  const auto first = static_cast<std::size_t>(std::lround(start / sample)),
             last = static_cast<std::size_t>(std::lround(end / sample));
  for (std::size_t i = first; i < std::min(last, values.size()); ++i) {
    const double fraction = values[i] / size, time = sample * static_cast<double>(i);
    if (std::isnan(at_ten) && fraction >= 0.1) at_ten = time;
    if (std::isnan(result.rise) && fraction >= 0.9) result.rise = time - at_ten;
    result.overshoot = std::max(result.overshoot, 100.0 * (fraction - 1.0));
  }
  return result;
}

void run(const Options& options) {
  const VehicleFile file = examples::vehicle_to_fly(options.vehicle);
  const auto fly_changed = [&](const Knob* knob, double factor) {
    VehicleFile changed = file;
    if (knob != nullptr) knob->scale(changed, factor);
    return examples::with_wrench_level(changed,
                                       [&](const auto& v) { return fly(options, changed, v); });
  };
  const std::vector<Knob> all = knobs();
  examples::Progress progress;
  std::vector<std::array<Response, 3>> flown;  // halved, unchanged, doubled
  const Response usual = fly_changed(nullptr, 1.0);
  for (const Knob& knob : all) {
    progress.show(static_cast<double>(flown.size()) / static_cast<double>(all.size()), knob.name);
    flown.push_back({fly_changed(&knob, 0.5), usual, fly_changed(&knob, 2.0)});
  }
  progress.finish();
  examples::SolverTicks solver = usual.solver;
  for (const std::array<Response, 3>& variants : flown) {
    solver.add(variants[0].solver);
    solver.add(variants[2].solver);
  }

  std::filesystem::create_directories(options.output);
  examples::MissionLog log(options.output + "/step_responses.csv",
                           {"knob", "factor", "time_s", "side_m", "heading_deg", "lean_deg"});
  std::cout << std::left << std::setw(28) << "field"
            << "shown by   factor   rise [s]   overshoot "
            << "[%]   lean at most [deg]\n"
            << std::fixed;
  for (std::size_t k = 0; k < all.size(); ++k) {
    for (const std::size_t variant : {0U, 1U, 2U}) {
      const Response& r = flown[k][variant];
      const double factor = variant == 0 ? 0.5 : static_cast<double>(variant);
      for (std::size_t i = 0; i < r.side.size(); ++i)
        log.add(static_cast<double>(k))
            .add(factor)
            .add(sample * static_cast<double>(i))
            .add(r.side[i])
            .add(r.heading[i])
            .add(r.lean[i])
            .end_row();
      const StepFigures f = all[k].turns ? figures(r.heading, turn_time, end_time, options.turn)
                                         : figures(r.side, step_time, turn_time, options.step);
      std::cout << std::left << std::setw(28) << all[k].name << std::setw(11)
                << (all[k].turns ? "turn" : "step") << std::setw(9) << std::setprecision(1)
                << factor << std::setw(11) << std::setprecision(2) << f.rise << std::setw(16)
                << std::setprecision(1) << f.overshoot
                << *std::max_element(r.lean.begin(), r.lean.end()) << '\n';
    }
  }
  solver.print(std::cout);
}

constexpr const char* footer = R"(
Half an allowed error has four times the weight in the cost. The effect of a field depends on the
others: a field that is not the tightest has little effect. A rise time of nan means that 90 % of
the step was not reached.

Files in the output directory: step_responses.csv and step_responses.png.

Exit code: 0 success, 1 an error, 2 an invalid vehicle file, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Shows the effect of tuning: flies a sideways step and a turn, with each allowed error\n"
      "and each limit of a vehicle file halved and doubled."};
  Options options;
  app.add_option("--vehicle", options.vehicle,
                 "JSON file of the vehicle; default: the Tilt-Ropter");
  examples::add_solver(app, options.solver);
  app.add_option("-o,--output", options.output, "directory for the responses and the picture")
      ->capture_default_str();
  app.add_option("--step", options.step, "size of the step to the left [m]")
      ->check(CLI::Range(0.01, 10.0))
      ->capture_default_str();
  app.add_option("--turn", options.turn, "size of the turn to the left [deg]")
      ->check(CLI::Range(1.0, 170.0))
      ->capture_default_str();
  app.add_flag("--no-pictures", options.no_pictures, "write only the responses");
  app.footer(footer);
  return examples::run_program(app, "step_responses", argc, argv, [&options] {
    run(options);
    if (!options.no_pictures) examples::draw_pictures("missions/step_responses.gp", options.output);
    return 0;
  });
}
