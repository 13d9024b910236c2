// Compares our plant with MuJoCo: the same vehicle under the same commands, without a controller.

#include "../support/run_program.hpp"
#include "../support/vehicle_choice.hpp"
#include "plant.hpp"

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cmath>
#include <iomanip>
#include <iostream>
#include <string>

using namespace tilt_ropter;

namespace {

constexpr double step = 1e-3;  // [s]

BodyStated at_height(double height) {
  BodyStated body;
  body.position.z() = height;
  return body;
}

template <typename AnyPlant>
void go(AnyPlant& plant, const ActuatorState<4>& command, const Wrenchd& push = {}) {
  if (!plant.step(command, push, step)) throw std::runtime_error("a plant rejected a step");
}

Wrenchd force(double x, double y) {
  Wrenchd wrench;
  wrench.force << x, y, 0.0;
  return wrench;
}

struct Results {
  double hover_drift_mm = 0.0, standing_mm = 0.0;
  double drop_peak_weights = 0.0, drop_rebound_mm = 0.0;
  double roll_distance_m = 0.0, slide_distance_m = 0.0, creep_mmps = 0.0;
  double tilt_time_constant_ms = 0.0, tilt_error_mrad = 0.0, tilt_kick_degps = 0.0;
  double bearing_tilt_mrad = 0.0;
};

template <typename AnyPlant>
Results measure(AnyPlant& plant, const Vehicle<4>& vehicle) {
  Results r;
  const double weight = vehicle.body.mass * gravity;
  const double by_mass = vehicle.body.mass / tilt_ropter_vehicle().body.mass;
  ActuatorState<4> hover;
  for (std::size_t i = 0; i < 4; ++i)
    hover.rotor_speed(static_cast<Eigen::Index>(i)) =
        speed_from_thrust(0.25 * weight, rotor_parameters(vehicle, i));

  plant.reset(at_height(2.0), hover);
  for (int i = 0; i < 1000; ++i) go(plant, hover);
  r.hover_drift_mm = 1e3 * (plant.body().position.z() - 2.0);

  // One arm steps by 0.5 rad, the others hold. The thrust also turns the body, but more slowly.
  plant.reset(at_height(2.0), hover);
  ActuatorState<4> tilted = hover;
  tilted.tilt_angle(2) = 0.5;
  for (int i = 0; i < 1000; ++i) {
    go(plant, tilted);
    if (r.tilt_time_constant_ms == 0.0 &&
        plant.actuators().tilt_angle(2) > 0.5 * (1.0 - std::exp(-1.0)))
      r.tilt_time_constant_ms = 1e3 * plant.time();
    if (i < 10)
      r.tilt_kick_degps =
          std::max(r.tilt_kick_degps, plant.body().angular_velocity.norm() * 180.0 / pi);
  }
  r.tilt_error_mrad = 1e3 * (0.5 - plant.actuators().tilt_angle(2));

  plant.reset(at_height(vehicle.wheels->radius + 0.05), {});
  double lowest = plant.body().position.z();
  bool rebounds = false;
  for (int i = 0; i < 3000; ++i) {
    go(plant, {});
    const double height = plant.body().position.z();
    r.drop_peak_weights = std::max(r.drop_peak_weights, plant.normal_forces().sum() / weight);
    lowest = std::min(lowest, height);
    rebounds = rebounds || (height > lowest && plant.body().velocity.z() > 0.0);
    if (rebounds)
      r.drop_rebound_mm = std::max(r.drop_rebound_mm, 1e3 * (height - vehicle.wheels->radius));
  }
  r.standing_mm = 1e3 * (plant.body().position.z() - vehicle.wheels->radius);

  const auto start = [&plant, &vehicle] {
    plant.reset(at_height(vehicle.wheels->radius), {});
    for (int i = 0; i < 1000; ++i) go(plant, {});
  };
  start();
  while (plant.body().velocity.x() < 1.0) go(plant, {}, force(1.5 * by_mass, 0.0));
  r.bearing_tilt_mrad = 1e3 * plant.actuators().tilt_angle.cwiseAbs().maxCoeff();
  double from = plant.body().position.x();
  for (int i = 0; i < 15000; ++i) go(plant, {});
  r.roll_distance_m = plant.body().position.x() - from;

  start();
  while (plant.body().velocity.y() < 1.0) go(plant, {}, force(0.0, 20.0 * by_mass));
  from = plant.body().position.y();
  for (int i = 0; i < 3000; ++i) go(plant, {});
  r.slide_distance_m = plant.body().position.y() - from;

  start();
  for (int i = 0; i < 2000; ++i) go(plant, {}, force(0.0, 2.0 * by_mass));
  r.creep_mmps = 1e3 * plant.body().velocity.y();
  return r;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Compares our plant with MuJoCo: the same vehicle and commands, no controller."};
  std::string path;
  app.add_option("--vehicle", path,
                 "JSON file of the vehicle (4 rotors, with wheels); default: the Tilt-Ropter");
  return examples::run_program(app, "compare_plants", argc, argv, [&path] {
    const Vehicle<4> vehicle = examples::quadrotor(examples::vehicle_or_default(path));
    if (!vehicle.wheels)
      throw std::runtime_error("the vehicle has no wheels: this program needs wheels");
    Plant<4> ours(vehicle);
    examples::MujocoPlant other(vehicle);
    const Results a = measure(ours, vehicle), b = measure(other, vehicle);
    const auto line = [](const char* key, double x, double y) {
      std::cout << key << ": " << std::fixed << std::setprecision(3) << x << ' ' << y << '\n';
    };
    std::cout << "# ours, MuJoCo\n";
    line("hover_drift_mm", a.hover_drift_mm, b.hover_drift_mm);
    line("tilt_time_constant_ms", a.tilt_time_constant_ms, b.tilt_time_constant_ms);
    line("tilt_error_mrad", a.tilt_error_mrad, b.tilt_error_mrad);
    line("tilt_kick_degps", a.tilt_kick_degps, b.tilt_kick_degps);
    line("standing_mm", a.standing_mm, b.standing_mm);
    line("drop_peak_weights", a.drop_peak_weights, b.drop_peak_weights);
    line("drop_rebound_mm", a.drop_rebound_mm, b.drop_rebound_mm);
    line("bearing_tilt_mrad", a.bearing_tilt_mrad, b.bearing_tilt_mrad);
    line("roll_distance_m", a.roll_distance_m, b.roll_distance_m);
    line("slide_distance_m", a.slide_distance_m, b.slide_distance_m);
    line("creep_mmps", a.creep_mmps, b.creep_mmps);
    return 0;
  });
}
