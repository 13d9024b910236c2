#pragma once

#include "csv.hpp"

#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/sampled_path.hpp>

#include <cstddef>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace examples {

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

}  // namespace examples
