#pragma once

#include "hybrid_experiment.hpp"
#include "mission_file.hpp"
#include "push_motion.hpp"
#include "trajectory_file.hpp"

#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <CLI/CLI.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <optional>
#include <ostream>
#include <stdexcept>
#include <string>
#include <vector>

/// The missions that the programs fly.
namespace examples {

struct MissionChoice {
  std::string name = "hybrid";
  double speed = 1.5;           // largest speed of the eights [m/s]
  std::optional<double> force;  // of the inspection; no value: 5 [N]
  std::string trajectory;       // CSV file, instead of a mission
  std::string file;             // JSON file, instead of a mission
  std::string write_path;       // write the mission to this file
};

[[nodiscard]] inline const std::vector<std::string>& mission_names() {
  static const std::vector<std::string> names{"hybrid",  "air",    "ground",
                                              "rolling", "excite", "inspect"};
  return names;
}

inline void add_options(CLI::App& app, MissionChoice& choice) {
  auto* mission =
      app.add_option(
             "--mission", choice.name,
             "hybrid: take off, figure eight, land, drive, take off, land, each from rest; "
             "air: the figure eight in flight; ground: the figure eight on the ground; "
             "rolling: from the eight in flight to the eight on the ground and back "
             "without a stop; excite: hover and shake all axes, for identify_vehicle; inspect: "
             "push with a tool on a wall, slide along it by 1 m, fly back")
          ->check(CLI::IsMember(mission_names()))
          ->capture_default_str();
  auto* excite = app.add_flag_callback(
      "--excite", [&choice] { choice.name = "excite"; }, "the same as --mission excite");
  excite->excludes(mission);
  auto* speed =
      app.add_option("--speed", choice.speed,
                     "largest speed in the figure eights; above 1.5 m/s they grow with its "
                     "square, so that accelerations stay [m/s]")
          ->check(CLI::Range(0.1, 10.0))
          ->capture_default_str();
  auto* force = app.add_option("--force", choice.force,
                               "force of --mission inspect on the wall; 5 without this option [N]")
                    ->check(CLI::Range(0.5, 100.0));
  auto* trajectory =
      app.add_option(
             "--trajectory", choice.trajectory,
             "follow this trajectory instead: a CSV file with the columns time_s, x_m, y_m, "
             "z_m (CoM, z up, ground at 0) and, if wanted, yaw_rad or yaw_deg; it starts and ends "
             "at rest, and is not below the ground")
          ->excludes(mission)
          ->excludes(excite)
          ->excludes(force)
          ->excludes(speed);
  app.add_option("--mission-file", choice.file,
                 "fly the mission in this JSON file instead, a list of segments")
      ->excludes(mission)
      ->excludes(speed)
      ->excludes(excite)
      ->excludes(force)
      ->excludes(trajectory);
  app.add_option("--write-mission", choice.write_path,
                 "write the chosen mission to this JSON file as a template, without flying");
}

/// The inspection of a wall: hover, push on it with `force` [N] for 10 s, slide to the left by 1 m
/// at 0.2 m/s, fly back, hover. The tool is a rod ahead, 5 cm longer than the propellers reach.
template <int Rotors>
[[nodiscard]] tilt_ropter::Mission inspection(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                              double force,
                                              const tilt_ropter::HybridMissionSettings& p) {
  using namespace tilt_ropter;
  double ahead = vehicle.wheels ? vehicle.wheels->radius : 0.0;
  for (std::size_t i = 0; i < Rotors; ++i)
    ahead = std::max(
        ahead, vehicle.rotors[i].position.x() + rotor_parameters(vehicle, i).propeller_radius);
  PushSettings push;
  push.from = {{p.origin.x(), p.origin.y(), p.flight_height}, 0.0};
  push.push.surface.tool.x() = ahead + 0.05;
  push.push.surface.point = push.from.position + Eigen::Vector3d(ahead + 0.55, 0.0, 0.0);
  push.push.force = force;
  push.slide.y() = 1.0;
  Waypoint end = push.from;
  end.position += push.slide;
  return Mission({{MissionPhase::hover, Hold(push.from, p.hover_time)},
                  {MissionPhase::air, PushMotion(push)},
                  {MissionPhase::hover, Hold(end, p.hover_time)}},
                 p.start_time);
}

/// Returns the mission of `choice`. Throws std::invalid_argument if the vehicle cannot do it, and
/// std::runtime_error if a file cannot be read.
template <int Rotors>
[[nodiscard]] tilt_ropter::Mission mission_of(const MissionChoice& choice,
                                              const tilt_ropter::Vehicle<Rotors>& vehicle) {
  using namespace tilt_ropter;
  const std::optional<Undercarriage> wheels = undercarriage(vehicle);
  if (choice.force && choice.name != "inspect")
    throw std::invalid_argument("--force: only with --mission inspect");
  if (!choice.file.empty()) return read_mission(choice.file, wheels);
  if (!choice.trajectory.empty()) return read_trajectory(choice.trajectory, wheels);
  HybridMissionSettings settings;
  HybridExperimentSettings lengths;
  const double faster = std::max(1.0, choice.speed / settings.max_speed), larger = faster * faster;
  settings.max_speed = choice.speed;
  settings.air_amplitude.head<2>() *= larger;
  settings.ground_amplitude *= larger;
  lengths.descent_length *= larger;
  lengths.climb_length *= larger;
  lengths.roll_length *= faster;
  if (choice.name == "hybrid") return hybrid_mission(vehicle, settings);
  if (choice.name == "excite") return excitation_experiment(settings);
  if (choice.name == "inspect") return inspection(vehicle, choice.force.value_or(5.0), settings);
  if (choice.name == "air") return aerial_experiment(settings);
  if (!wheels)
    throw std::invalid_argument("--mission " + choice.name + ": the vehicle has no wheels");
  return choice.name == "ground" ? ground_experiment(*wheels, settings)
                                 : hybrid_experiment(*wheels, settings, lengths);
}

/// Prints a line for each bound that a reference passes.
inline void print(std::ostream& out, const std::vector<tilt_ropter::BoundViolation>& violations) {
  for (const tilt_ropter::BoundViolation& v : violations)
    out << "the reference asks for " << v.bound << "[" << v.axis << "] = " << v.required << " at "
        << v.time << " s, allowed is " << v.allowed << '\n';
}

/// Writes the mission of `choice` if a file for it is given. Returns true in this case.
template <int Rotors>
bool write_mission(const MissionChoice& choice, const tilt_ropter::Vehicle<Rotors>& vehicle) {
  if (choice.write_path.empty()) return false;
  write_mission(mission_of(choice, vehicle), undercarriage(vehicle), choice.write_path,
                choice.trajectory);
  return true;
}

}  // namespace examples
