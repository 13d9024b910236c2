#pragma once

#include "csv.hpp"
#include "flight_mcap.hpp"
#include "mission_log.hpp"

#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <cstddef>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

/// The log that identify_vehicle reads: one row per IMU sample. The row repeats the last pose and
/// the last measured rotor speeds with their own times, and holds the commands that are in force
/// from the time of the row on.
namespace examples {

/// Names of the columns; those of the measured rotor speeds are optional.
struct IdentificationColumns {
  explicit IdentificationColumns(int rotors) {
    const auto add = [](std::vector<std::string>& names, const std::string& name,
                        const std::vector<std::string>& parts) {
      for (const std::string& part : parts) names.push_back(name + '_' + part);
    };
    std::vector<std::string> numbers;
    for (int i = 1; i <= rotors; ++i) numbers.push_back(std::to_string(i));
    required = {"time_s"};
    add(required, "angular_velocity_radps", {"x", "y", "z"});
    add(required, "specific_force_mps2", {"x", "y", "z"});
    required.emplace_back("pose_time_s");
    add(required, "position_m", {"x", "y", "z"});
    add(required, "orientation", {"w", "x", "y", "z"});
    add(required, "rotor_command_radps", numbers);
    add(required, "tilt_command_rad", numbers);
    measured = {"rotor_speed_time_s"};
    add(measured, "rotor_speed_radps", numbers);
  }

  [[nodiscard]] std::vector<std::string> all() const {
    std::vector<std::string> names = required;
    names.insert(names.end(), measured.begin(), measured.end());
    return names;
  }

  std::vector<std::string> required, measured;
};

/// Passes measurements on to a controller and writes them to the logs that there are.
template <int Rotors, typename Controller>
class IdentificationTap {
 public:
  /// `path`: the file, or empty for no log. Throws std::runtime_error if it cannot be written.
  /// `mcap`: gets IMU and poses, or nullptr.
  IdentificationTap(Controller& controller, const std::string& path, FlightMcap* mcap = nullptr)
      : controller_(controller), mcap_(mcap) {
    if (!path.empty()) log_.emplace(path, IdentificationColumns(Rotors).all());
  }

  void on_rotor_speeds(const Eigen::Matrix<double, Rotors, 1>& speeds) {
    speeds_ = {0.0, speeds};
    speeds_are_new_ = true;
    controller_.on_rotor_speeds(speeds);
  }
  void on_imu(double time, const tilt_ropter::InertialSampled& sample) {
    imu_ = {time, sample};
    imu_is_new_ = true;
    if (mcap_ != nullptr) mcap_->on_imu(time, sample);
    controller_.on_imu(time, sample);
  }
  void on_pose(double time, const tilt_ropter::MarkerPosed& pose) {
    pose_ = {time, pose};
    has_pose_ = true;
    if (mcap_ != nullptr) mcap_->on_pose(time, pose);
    controller_.on_pose(time, pose);
  }

  /// Call this at the end of each step that began at `time`, with the command in force.
  void end_step(double time, const tilt_ropter::ActuatorState<Rotors>& command) {
    if (speeds_are_new_) {
      speeds_.time = time;
      has_speeds_ = true;
    }
    if (log_ && imu_is_new_ && has_pose_ && has_speeds_) {
      const tilt_ropter::MarkerPosed& pose = pose_.value;
      log_->add(imu_.time)
          .add_all(imu_.value.angular_velocity)
          .add_all(imu_.value.specific_force)
          .add(pose_.time)
          .add_all(pose.position)
          .add(pose.orientation.w())
          .add_all(pose.orientation.vec())
          .add_all(command.rotor_speed)
          .add_all(command.tilt_angle)
          .add(speeds_.time)
          .add_all(speeds_.value)
          .end_row();
    }
    speeds_are_new_ = imu_is_new_ = false;
  }

 private:
  Controller& controller_;
  FlightMcap* mcap_;
  std::optional<MissionLog> log_;
  tilt_ropter::Timed<tilt_ropter::InertialSampled> imu_;
  tilt_ropter::Timed<tilt_ropter::MarkerPosed> pose_;
  tilt_ropter::Timed<Eigen::Matrix<double, Rotors, 1>> speeds_;
  bool imu_is_new_ = false, has_pose_ = false, has_speeds_ = false, speeds_are_new_ = false;
};

/// Reads such a log between the times `from` and `until` [s]. Throws std::runtime_error that names
/// file, line and column.
template <int Rotors>
[[nodiscard]] tilt_ropter::VehicleLog<Rotors> read_identification_log(const std::string& path,
                                                                      double from, double until) {
  using namespace tilt_ropter;
  const IdentificationColumns names(Rotors);
  const CsvTable table = read_csv(path, names.required, CsvNumbers::finite, names.measured);
  const bool has_speeds = table.has(names.measured.front());
  if (has_speeds)
    for (const std::string& name : names.measured) (void)table[name];  // all or none
  std::size_t column = 0;
  const auto columns = [&](std::size_t count) {
    std::vector<const double*> list;
    for (std::size_t i = 0; i < count; ++i) list.push_back(table.columns[column++].data());
    return list;
  };
  const auto time = columns(1), rate = columns(3), force = columns(3), pose_time = columns(1),
             position = columns(3), orientation = columns(4), rotors = columns(Rotors),
             tilts = columns(Rotors);
  std::vector<const double*> speed_time, speeds;
  if (has_speeds) {
    speed_time = columns(1);
    speeds = columns(Rotors);
  }
  const auto vector_at = [](const std::vector<const double*>& list, std::size_t row, auto& vector) {
    for (std::size_t i = 0; i < list.size(); ++i)
      vector(static_cast<Eigen::Index>(i)) = list[i][row];
  };
  /// Appends a measurement that is later than the last one; false if it is the last one again.
  const auto append = [&](auto& list, double stamp, std::size_t row, const std::string& name) {
    if (!list.empty() && !(stamp > list.back().time)) {
      if (stamp < list.back().time && name != "time_s")
        throw std::runtime_error(path + ':' + std::to_string(table.lines[row]) + ": column " +
                                 name + " decreases");
      return false;
    }
    list.emplace_back();
    list.back().time = stamp;
    return true;
  };
  VehicleLog<Rotors> log;
  for (std::size_t row = 0; row < table.rows(); ++row) {
    if (time[0][row] < from || time[0][row] > until) continue;
    if (!append(log.imu, time[0][row], row, "time_s"))
      throw std::runtime_error(path + ':' + std::to_string(table.lines[row]) +
                               ": column time_s does not increase");
    vector_at(rate, row, log.imu.back().value.angular_velocity);
    vector_at(force, row, log.imu.back().value.specific_force);
    if (append(log.poses, pose_time[0][row], row, "pose_time_s")) {
      MarkerPosed& pose = log.poses.back().value;
      vector_at(position, row, pose.position);
      pose.orientation = Eigen::Quaterniond(orientation[0][row], orientation[1][row],
                                            orientation[2][row], orientation[3][row]);
      if (!(pose.orientation.squaredNorm() > 1e-6))
        throw std::runtime_error(path + ':' + std::to_string(table.lines[row]) +
                                 ": the columns orientation_w to orientation_z are zero");
    }
    Timed<ActuatorState<Rotors>> command;
    command.time = time[0][row];
    vector_at(rotors, row, command.value.rotor_speed);
    vector_at(tilts, row, command.value.tilt_angle);
    const bool changes = log.commands.empty() ||
                         command.value.rotor_speed != log.commands.back().value.rotor_speed ||
                         command.value.tilt_angle != log.commands.back().value.tilt_angle;
    if (changes || row + 1 == table.rows()) log.commands.push_back(command);
    if (has_speeds && append(log.rotor_speeds, speed_time[0][row], row, "rotor_speed_time_s"))
      vector_at(speeds, row, log.rotor_speeds.back().value);
  }
  return log;
}

}  // namespace examples
