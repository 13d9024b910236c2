#pragma once

#include "../../cmake/vehicle_file/tilt_ropter/input_file_error.hpp"

#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <iosfwd>
#include <optional>
#include <string>

/// A mission in a JSON file: a start and a list of segments. Each segment starts where the segment
/// before it ends, with its speed and heading.
///
///     { "name": "my mission",
///       "start": { "position_m": [0, 0], "yaw_deg": 0 },     [x, y]: on the ground
///       "segments": [ { "type": "rest", "duration_s": 1 },
///                     { "type": "take_off", "height_m": 1.5 },
///                     { "type": "figure_eight", "amplitude_m": [1.5, 0.5, 0.5] },
///                     { "type": "land" } ] }
///
/// The table of all types and fields is in examples/missions/README.md. Positions are those of the
/// CoM, with the ground at height zero; a position of two numbers is on the ground. A file is
/// therefore valid for vehicles with different wheels or legs.
namespace examples {

/// An invalid mission file: the message contains file, segment, field, value and allowed values.
class MissionFileError : public tilt_ropter::InputFileError {
 public:
  using InputFileError::InputFileError;
};

/// Reads and checks every field, and checks that the segments fit together: no jump, no motion
/// below the ground, and on the ground only motions that the undercarriage can do. `file` is the
/// name in messages; trajectories are relative to its directory. Throws MissionFileError.
[[nodiscard]] tilt_ropter::Mission read_mission(
    std::istream& in, const std::string& file,
    const std::optional<tilt_ropter::Undercarriage>& undercarriage);
[[nodiscard]] tilt_ropter::Mission read_mission(
    const std::string& path, const std::optional<tilt_ropter::Undercarriage>& undercarriage);

/// Writes a file that read_mission() reads. `trajectory` is the CSV file of a mission that follows
/// a trajectory. Throws std::runtime_error if the file cannot be written.
void write_mission(const tilt_ropter::Mission& mission,
                   const std::optional<tilt_ropter::Undercarriage>& undercarriage,
                   const std::string& path, const std::string& trajectory = "");

}  // namespace examples
