#pragma once

#include "../../cmake/vehicle_file/tilt_ropter/input_file_error.hpp"
#include "csv.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/sampled_path.hpp>

#include <cmath>
#include <cstddef>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace examples {

namespace detail {

/// Throws std::runtime_error that names line and column where the trajectory is below the ground or
/// its yaw is in degrees.
inline void check_trajectory(const CsvTable& table, double ground,
                             const std::vector<tilt_ropter::PathSample>& samples) {
  constexpr double sunk = 0.01;                                  // allowed for rounded heights [m]
  constexpr double turn = 2.0 * tilt_ropter::pi, fastest = 6.0;  // [rad], [rad/s]
  const auto refuse = [&table](std::size_t row, const std::string& what) {
    throw std::runtime_error(table.file + ':' + std::to_string(table.lines[row]) + ": " + what);
  };
  const auto shown = [](double value) {
    std::ostringstream text;
    text << value;
    return text.str();
  };
  for (std::size_t i = 0; i < samples.size(); ++i) {
    const double z = samples[i].position.z();
    if (z < ground - sunk)
      refuse(i, "column z_m: " + shown(z) +
                    " is below the ground: z points up and must be at least " + shown(ground) +
                    " m, the height of the CoM on the ground");
    if (!table.has("yaw_rad")) continue;
    const double yaw = samples[i].yaw;
    if (!(std::abs(yaw) > 1.01 * turn)) continue;
    // A yaw that is not wrapped has got there in small steps.
    const auto& last = samples[i > 0 ? i - 1 : 0];
    const double change = std::abs(yaw - last.yaw);
    if (i == 0 || change > 0.5 * turn || change > fastest * (samples[i].time - last.time))
      refuse(i, "column yaw_rad: " + shown(yaw) +
                    " looks like degrees: they belong in a column yaw_deg");
  }
}

}  // namespace detail

/// Reads a trajectory: time_s, x_m, y_m, z_m and, if wanted, yaw_rad or yaw_deg. Where it stays at
/// the standing height, its phase is `ground`, else `air`. Throws tilt_ropter::InputFileError that
/// names the file and, where it can, line and column.
[[nodiscard]] inline tilt_ropter::Mission read_trajectory(
    const std::string& file, const std::optional<tilt_ropter::Undercarriage>& undercarriage) {
  using namespace tilt_ropter;
  const double ground = undercarriage ? undercarriage->height : 0.0;
  std::vector<PathSample> samples;
  try {
    const CsvTable table =
        read_csv(file, {"time_s", "x_m", "y_m", "z_m"}, CsvNumbers::finite, {"yaw_rad", "yaw_deg"});
    if (table.has("yaw_rad") && table.has("yaw_deg"))
      throw std::runtime_error(file + ": either yaw_rad or yaw_deg, not both");
    samples.resize(table.rows());
    for (std::size_t i = 0; i < table.rows(); ++i) {
      samples[i].time = table["time_s"][i];
      samples[i].position << table["x_m"][i], table["y_m"][i], table["z_m"][i];
      if (table.has("yaw_rad")) samples[i].yaw = table["yaw_rad"][i];
      if (table.has("yaw_deg")) samples[i].yaw = table["yaw_deg"][i] * pi / 180.0;
    }
    detail::check_trajectory(table, ground, samples);
  } catch (const std::runtime_error& error) {
    throw InputFileError(error.what());
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
    throw InputFileError(file + ": " + error.what());
  }
}

}  // namespace examples
