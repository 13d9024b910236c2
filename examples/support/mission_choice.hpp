#pragma once

#include "csv.hpp"

#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/experiments.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/sampled_path.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cstddef>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

/// The missions that the programs fly.
namespace examples {

struct MissionChoice {
  std::string name = "hybrid";
  double speed = 1.5;      // largest speed of the eights [m/s]
  std::string trajectory;  // CSV file, instead of a mission
};

inline void add_options(CLI::App& app, MissionChoice& choice) {
  auto* mission =
      app.add_option("--mission", choice.name,
                     "hybrid: take off, figure eight, land, drive, take off, land, each from rest; "
                     "air: the figure eight in flight; ground: the figure eight on the ground; "
                     "rolling: from the eight in flight to the eight on the ground and back "
                     "without a stop")
          ->check(CLI::IsMember({"hybrid", "air", "ground", "rolling"}))
          ->capture_default_str();
  auto* speed =
      app.add_option("--speed", choice.speed,
                     "largest speed in the figure eights; above 1.5 m/s they grow with its "
                     "square, so that accelerations stay [m/s]")
          ->check(CLI::Range(0.1, 10.0))
          ->capture_default_str();
  app.add_option("--trajectory", choice.trajectory,
                 "follow this trajectory instead: a CSV file with the columns time_s, x_m, y_m, "
                 "z_m (CoM, ground at 0) and, if wanted, yaw_rad; it starts and ends at rest")
      ->excludes(mission)
      ->excludes(speed);
}

/// Reads a trajectory. Where it stays at the standing height, its phase is `ground`, else `air`.
/// Throws std::runtime_error that names the file.
[[nodiscard]] inline tilt_ropter::Mission read_trajectory(
    const std::string& file, const std::optional<tilt_ropter::Undercarriage>& undercarriage) {
  using namespace tilt_ropter;
  const CsvTable table =
      read_csv(file, {"time_s", "x_m", "y_m", "z_m"}, CsvNumbers::finite, {"yaw_rad"});
  std::vector<PathSample> samples(table.rows());
  for (std::size_t i = 0; i < samples.size(); ++i) {
    samples[i].time = table["time_s"][i];
    samples[i].position << table["x_m"][i], table["y_m"][i], table["z_m"][i];
    if (table.has("yaw_rad")) samples[i].yaw = table["yaw_rad"][i];
  }
  const auto stands = [&](std::size_t i) {
    return undercarriage && samples[i].position.z() <= undercarriage->height + 1e-3;
  };
  try {
    const SampledPath path(samples);
    std::vector<MissionSegment> segments;
    for (std::size_t i = 0; i + 1 < samples.size();) {
      const bool on_ground = stands(i) && stands(i + 1);
      std::size_t end = i + 1;
      while (end + 1 < samples.size() && (stands(end) && stands(end + 1)) == on_ground) ++end;
      segments.push_back({on_ground ? MissionPhase::ground : MissionPhase::air,
                          path.part(samples[i].time, samples[end].time)});
      i = end;
    }
    return Mission(std::move(segments));
  } catch (const std::invalid_argument& error) {
    throw std::runtime_error(file + ": " + error.what());
  }
}

/// Returns the mission of `choice`. Throws std::invalid_argument if the vehicle cannot do it, and
/// std::runtime_error if a file cannot be read.
template <int Rotors>
[[nodiscard]] tilt_ropter::Mission mission_of(const MissionChoice& choice,
                                              const tilt_ropter::Vehicle<Rotors>& vehicle) {
  using namespace tilt_ropter;
  const std::optional<Undercarriage> wheels = undercarriage(vehicle);
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
  if (choice.name == "air") return aerial_experiment(settings);
  if (!wheels)
    throw std::invalid_argument("--mission " + choice.name + ": the vehicle has no wheels");
  return choice.name == "ground" ? ground_experiment(*wheels, settings)
                                 : hybrid_experiment(*wheels, settings, lengths);
}

}  // namespace examples
