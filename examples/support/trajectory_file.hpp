#pragma once

#include "../../cmake/vehicle_file/tilt_ropter/input_file_error.hpp"
#include "csv.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/sampled_path.hpp>

#include <algorithm>
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

/// Throws std::runtime_error that names the line where the path is faster than any flight, or the
/// file if it is nowhere faster than 5 mm/s: metres or seconds are others.
inline void check_motion(const CsvTable& table, const tilt_ropter::SampledPath& path) {
  constexpr double fastest = 50.0, strongest = 100.0, slowest = 0.005;  // [m/s], [m/s^2], [m/s]
  const auto range_of = [&table](const char* column) {
    const auto [low, high] = std::minmax_element(table[column].begin(), table[column].end());
    return std::make_pair(*low, *high);
  };
  const auto refuse = [&](const char* column) {
    const auto [low, high] = range_of(column);
    std::ostringstream text;
    text << table.file << ": column " << column << " is from " << low << " to " << high
         << ": is it in m, in a local world? Not UTM, not degrees";
    throw std::runtime_error(text.str());
  };
  const auto is_narrow = [&range_of](const char* column) {  // as a flight in degrees is
    const auto [low, high] = range_of(column);
    return high - low > 1e-7 && high - low < 1e-3 && std::abs(low) > 1.0;
  };
  for (const char* column : {"x_m", "y_m", "z_m"})
    if (!(std::max(-range_of(column).first, range_of(column).second) <= 1e4)) refuse(column);
  if (is_narrow("x_m") && is_narrow("y_m")) refuse("x_m");
  double most = 0.0, extent = 0.0;
  for (const char* column : {"x_m", "y_m", "z_m"})
    extent = std::max(extent, range_of(column).second - range_of(column).first);
  for (std::size_t i = 1; i < table.rows(); ++i) {
    const double from = table["time_s"][i - 1], to = table["time_s"][i];
    const double step = (path(to).position - path(from).position).norm();
    const double speed = step / (to - from), acceleration = path(to).acceleration.norm();
    most = std::max(most, speed);
    if (speed <= fastest && acceleration <= strongest) continue;
    std::ostringstream text;
    text << table.file << ':' << table.lines[i] << ": the trajectory asks for " << speed
         << " m/s and " << acceleration << " m/s^2: are the columns in m and s?";
    throw std::runtime_error(text.str());
  }
  if (extent > 0.1 && most < slowest)
    throw std::runtime_error(table.file + ": the trajectory is nowhere faster than " +
                             std::to_string(most) + " m/s: are the columns in m and s?");
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
  CsvTable table;
  try {
    table =
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
    detail::check_motion(table, path);
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
  } catch (const std::runtime_error& error) {
    throw InputFileError(error.what());
  }
}

}  // namespace examples
