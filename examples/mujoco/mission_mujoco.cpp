// The hybrid mission in the independent physics engine MuJoCo: the same controller and sensors. The
// vehicle is a tree of bodies, with arms whose mass tilts and wheels that roll.

#include "../support/mission_loop.hpp"
#include "../support/pictures.hpp"
#include "../support/report.hpp"
#include "../support/run_program.hpp"
#include "plant.hpp"
#ifdef MISSION_MUJOCO_FILM  // set by CMake if EGL is found
#include "film.hpp"
#endif

#include <tilt_ropter/simulation/sensors.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <variant>

using namespace tilt_ropter;

namespace {

struct Options {
  examples::MissionOptions mission;
  examples::MujocoParameters mujoco;
  double slope_deg = 0.0, slope_direction_deg = 0.0;
  double tyre_scrub = 1.0;  // [mm]
  double wind = 0.0;
  int slow_servo = 0;
  double slow_factor = 2.0;
  bool film = false;
};

#ifdef MISSION_MUJOCO_FILM
using examples::Film;
#else
template <int Rotors>
struct Film {
  Film(const examples::MujocoPlant<Rotors>&, const std::string&) {
    throw std::runtime_error("built without EGL (Debian: libegl-dev)");
  }
  void on_step(const Mission&) {}
  void finish() {}
};
#endif

/// Records a film if possible. Otherwise prints the reason, and the mission continues.
template <int Rotors>
class MaybeFilm {
 public:
  MaybeFilm(bool wanted, const examples::MujocoPlant<Rotors>& plant, const std::string& directory) {
    if (wanted) attempt([&] { film_ = std::make_unique<Film<Rotors>>(plant, directory); });
  }
  void on_step(const Mission& mission) {
    if (film_) attempt([&] { film_->on_step(mission); });
  }
  void finish() {
    if (film_) attempt([&] { film_->finish(); });
  }

 private:
  template <typename Action>
  void attempt(Action&& action) {
    try {
      action();
    } catch (const std::exception& error) {
      std::cerr << "no film: " << error.what() << '\n';
      film_.reset();
    }
  }

  std::unique_ptr<Film<Rotors>> film_;
};

/// Wind as a force at the CoM [N]: a mean along the y axis of the world, and gusts in all axes with
/// a standard deviation of a third of the mean and a correlation time of 0.5 s.
class Wind {
 public:
  Wind(double mean, std::uint64_t seed) : mean_(mean), noise_(seed) {}

  Wrenchd on(const BodyStated& body, double dt) {
    if (mean_ == 0.0) return {};
    constexpr double stay = 0.5;
    const double keep = std::exp(-dt / stay);
    gust_ = keep * gust_ + noise_.draw<3>(std::sqrt(1.0 - keep * keep) * mean_ / 3.0);
    Wrenchd wrench;
    wrench.force = body.orientation.conjugate() * (mean_ * Eigen::Vector3d::UnitY() + gust_);
    return wrench;
  }

 private:
  double mean_;
  GaussianNoise noise_;
  Eigen::Vector3d gust_ = Eigen::Vector3d::Zero();
};

/// Returns the exit code.
template <int Rotors>
int fly(const Options& options, const examples::VehicleFile& file, const Vehicle<Rotors>& vehicle) {
  const auto vehicles = examples::vehicles(options.mission, vehicle);
  const examples::MujocoParameters mujoco =
      examples::with_fitting_arms(vehicles.truth, options.mujoco);
  if (mujoco.arm_mass < options.mujoco.arm_mass)
    std::cerr << "the arms weigh " << mujoco.arm_mass << " kg instead of "
              << options.mujoco.arm_mass << " kg, so that they fit into this vehicle\n";
  examples::MujocoPlant<Rotors> plant(vehicles.truth, mujoco);
  if (options.slow_servo > 0) {
    require(options.slow_servo <= Rotors, "--slow-servo", options.slow_servo,
            "at most " + std::to_string(Rotors) + ", the number of rotors");
    ServoParameters slow = vehicles.truth.servo;
    slow.time_constant *= options.slow_factor;
    slow.max_rate /= options.slow_factor;
    plant.set_servo(static_cast<std::size_t>(options.slow_servo - 1), slow);
  }
  Wind wind(options.wind, static_cast<std::uint64_t>(options.mission.seed) + 3000);
  std::filesystem::create_directories(options.mission.output);
  MaybeFilm film(options.film, plant, options.mission.output);
  double upright = 1.0;  // smallest cosine of the angle between body z and world z
  const examples::FlightReport flown =
      examples::fly_mission(  // the logs are closed when it returns
          options.mission, file, vehicles, plant, [&] { return wind.on(plant.body(), 1e-3); },
          [&](const Mission& mission) {
            upright = std::min(upright, plant.body().orientation.toRotationMatrix()(2, 2));
            film.on_step(mission);
          },
          options.mujoco.ground_height != 0.0 || options.mujoco.slope != 0.0);
  film.finish();
  std::ostringstream attitude;
  attitude << "lean_max_deg: " << std::fixed << std::setprecision(2)
           << std::acos(upright) * 180.0 / pi << '\n'
           << "tipped_over: " << (upright < 0.5) << '\n';
  std::cout << attitude.str();
  if (!options.mission.no_pictures) {
    examples::write_report(options.mission.output, file, flown.figures + attitude.str());
    examples::draw_pictures("missions/hybrid_mission.gp", options.mission.output);
  }
  return flown.exit_code("mission_mujoco");
}

int fly(Options& options) {
  options.mujoco.seen = options.film;
  options.mujoco.slope = options.slope_deg * pi / 180.0;
  options.mujoco.torsional_friction = 1e-3 * options.tyre_scrub;
  options.mujoco.slope_direction = options.slope_direction_deg * pi / 180.0;
  const examples::VehicleFile file = examples::vehicle_or_default(options.mission.vehicle_path);
  return std::visit(
      [&](const auto& vehicle) {
        return write_mission(options.mission.mission, vehicle) ? 0 : fly(options, file, vehicle);
      },
      file.vehicle);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Flies the hybrid mission in MuJoCo, with any ground and disturbances."};
  Options options;
  options.mission.output = "results/mujoco";
  examples::add_options(app, options.mission);
  app.footer(examples::mission_exit_codes);
  app.add_option("--slope", options.slope_deg, "slope of the ground [deg]")
      ->check(CLI::Range(-20.0, 20.0))
      ->capture_default_str();
  app.add_option("--slope-direction", options.slope_direction_deg,
                 "azimuth of the direction in which the ground rises; 0: along x [deg]")
      ->check(CLI::Range(-360.0, 360.0))
      ->capture_default_str();
  app.add_option("--ground-height", options.mujoco.ground_height,
                 "height of the ground; the mission assumes zero [m]")
      ->check(CLI::Range(-2.0, 2.0))
      ->capture_default_str();
  app.add_option("--tyre-scrub", options.tyre_scrub,
                 "torque / normal force of a wheel that turns on the spot [mm]")
      ->check(CLI::Range(0.0, 20.0))
      ->capture_default_str();
  app.add_option("--com-x", options.mujoco.com_x,
                 "position of the true CoM ahead of the CoM that the controller assumes [m]")
      ->check(CLI::Range(-0.05, 0.05))
      ->capture_default_str();
  app.add_option("--friction", options.mujoco.contact.friction,
                 "friction coefficient of wheels and ground")
      ->check(CLI::Range(0.01, 2.0))
      ->capture_default_str();
  app.add_option("--step", options.mujoco.step_height,
                 "height of a plank across the track on the ground; 0: no plank [m]")
      ->check(CLI::Range(0.0, 0.1))
      ->capture_default_str();
  app.add_option("--wind", options.wind,
                 "mean wind force along world y; gusts have a third of it as stddev [N]")
      ->check(CLI::Range(0.0, 10.0))
      ->capture_default_str();
  app.add_option("--payload", options.mujoco.payload,
                 "mass 5 cm below the CoM that the controller does not know [kg]")
      ->check(CLI::Range(0.0, 2.0))
      ->capture_default_str();
  app.add_option("--slow-servo", options.slow_servo,
                 "arm (from 1) whose servo has the time constant times --slow-factor and the "
                 "speed divided by it; 0: none")
      ->check(CLI::Range(0, 8))
      ->capture_default_str();
  app.add_option("--slow-factor", options.slow_factor, "factor for --slow-servo")
      ->check(CLI::Range(0.1, 20.0))
      ->capture_default_str();
  app.add_option("--time-step", options.mujoco.time_step, "time step of MuJoCo [s]")
      ->check(CLI::Range(1e-5, 2e-3))
      ->capture_default_str();
  app.add_flag("--film,!--no-film", options.film,
               "also record mission.mp4, mission.gif, air.png, ground.png (needs EGL, ffmpeg)");
  options.mission.stop_at_loss = true;
  return examples::run_program(app, "mission_mujoco", argc, argv,
                               [&options] { return fly(options); });
}
