#pragma once

#include "flight_log.hpp"
#include "ulog.hpp"

#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>
#include <vector>

/// What a ULog of PX4 knows of a flight, in this library's frames: ENU and forward-left-up. Times
/// are those of PX4's clock [s]; samples whose stamp does not increase are left out. All functions
/// throw InputFileError.
namespace examples {

namespace detail {

inline std::vector<std::string> elements(const std::string& name, int count) {
  std::vector<std::string> names;
  names.reserve(static_cast<std::size_t>(count));
  for (int i = 0; i < count; ++i) names.push_back(name + '[' + std::to_string(i) + ']');
  return names;
}

inline std::vector<std::string> joined(const std::vector<std::vector<std::string>>& parts) {
  std::vector<std::string> all;
  for (const auto& part : parts) all.insert(all.end(), part.begin(), part.end());
  return all;
}

inline Eigen::Vector3d vector_at(const CsvTable& table, std::size_t row, std::size_t first) {
  return {table.columns[first][row], table.columns[first + 1][row], table.columns[first + 2][row]};
}

inline Eigen::Quaterniond quaternion_at(const CsvTable& table, std::size_t row, std::size_t first) {
  const Eigen::Vector3d v = vector_at(table, row, first + 1);
  return {table.columns[first][row], v.x(), v.y(), v.z()};
}

/// The fields of a topic after a first column with the time of the measurement [us]:
/// timestamp_sample, or timestamp where that is not set, as in older logs and in simulations.
inline CsvTable stamped(const Ulog& log, const std::string& topic,
                        std::vector<std::string> fields) {
  fields.insert(fields.begin(), "timestamp");
  CsvTable table = log.table(topic, fields);
  if (!log.has(topic, "timestamp_sample")) return table;
  const std::vector<double> samples = log.table(topic, {"timestamp_sample"}).columns[0];
  for (std::size_t i = 0; i < samples.size(); ++i)
    if (samples[i] > 0.0) table.columns[0][i] = samples[i];
  return table;
}

/// Appends a sample if its stamp is later than the last one.
template <typename List, typename Value>
void append(List& list, double microseconds, const Value& value) {
  const double time = 1e-6 * microseconds;
  if (list.empty() || time > list.back().time) list.push_back({time, value});
}

}  // namespace detail

/// IMU: sensor_combined.
[[nodiscard]] inline InertialLog px4_imu(const Ulog& log) {
  using namespace tilt_ropter;
  const CsvTable t =
      log.table("sensor_combined", detail::joined({{"timestamp"},
                                                   detail::elements("gyro_rad", 3),
                                                   detail::elements("accelerometer_m_s2", 3)}));
  InertialLog imu;
  for (std::size_t i = 0; i < t.rows(); ++i) {
    const InertialSampled sample{flu_from_frd(detail::vector_at(t, i, 1)),
                                 flu_from_frd(detail::vector_at(t, i, 4))};
    if (!all_finite(sample.angular_velocity) || !all_finite(sample.specific_force))
      throw InputFileError(t.file + ": byte " + std::to_string(t.lines[i]) +
                           ": sensor_combined is not finite");
    detail::append(imu, t.columns[0][i], sample);
  }
  if (imu.size() < 2) throw InputFileError(t.file + ": fewer than two samples of sensor_combined");
  return imu;
}

/// Where poses come from if nobody says it: from outside, else PX4's own estimate.
[[nodiscard]] inline std::string px4_pose_topic(const Ulog& log) {
  for (const char* topic :
       {"vehicle_mocap_odometry", "vehicle_visual_odometry", "vehicle_odometry"})
    if (log.has(topic)) return topic;
  return "vehicle_local_position";
}

/// States, of which position and orientation are not finite where PX4 does not know them: from a
/// topic with the message VehicleOdometry; or from vehicle_local_position or
/// vehicle_local_position_groundtruth, with the attitude from vehicle_attitude or its ground truth.
[[nodiscard]] inline StateLog px4_states(const Ulog& log, const std::string& topic) {
  using namespace tilt_ropter;
  constexpr double unknown = std::numeric_limits<double>::quiet_NaN();
  const std::vector<std::string> xyz = {"x", "y", "z"}, vxyz = {"vx", "vy", "vz"};
  StateLog states;
  const std::string local = "vehicle_local_position";
  if (topic.compare(0, local.size(), local) == 0) {
    const CsvTable t = detail::stamped(log, topic, detail::joined({xyz, vxyz}));
    const CsvTable a = detail::stamped(log, "vehicle_attitude" + topic.substr(local.size()),
                                       detail::elements("q", 4));
    std::size_t next = 0;
    for (std::size_t i = 0; i < t.rows(); ++i) {
      const double time = t.columns[0][i];
      while (next < a.rows() && a.columns[0][next] < time) ++next;
      if (next == 0 || next == a.rows()) continue;
      const double step = a.columns[0][next] - a.columns[0][next - 1];
      NedBodyStated ned;
      ned.position = detail::vector_at(t, i, 1);
      ned.velocity = detail::vector_at(t, i, 4);
      ned.orientation = detail::quaternion_at(a, next - 1, 1)
                            .slerp(step > 0.0 ? (time - a.columns[0][next - 1]) / step : 1.0,
                                   detail::quaternion_at(a, next, 1));
      ned.angular_velocity.setZero();
      detail::append(states, time, enu_from_ned(ned));
    }
    return states;
  }
  const bool old = !log.has(topic, "position[0]") && log.has(topic, "x");  // before PX4 1.14
  const CsvTable t = detail::stamped(log, topic,
                                     detail::joined({old ? xyz : detail::elements("position", 3),
                                                     detail::elements("q", 4),
                                                     old ? vxyz : detail::elements("velocity", 3),
                                                     {"velocity_frame"}}));
  for (std::size_t i = 0; i < t.rows(); ++i) {
    NedBodyStated ned;
    ned.position = detail::vector_at(t, i, 1);
    ned.orientation = detail::quaternion_at(t, i, 4);
    ned.velocity = detail::vector_at(t, i, 8);
    ned.angular_velocity.setZero();
    const int frame = static_cast<int>(t.columns[11][i]), in_body = old ? 2 : 3;
    if (frame == in_body) ned.velocity = ned.orientation * ned.velocity;
    if (!old && frame == 0) ned.velocity.setConstant(unknown);
    detail::append(states, t.columns[0][i], enu_from_ned(ned));
  }
  return states;
}

/// The poses of such a topic.
[[nodiscard]] inline MarkerLog px4_poses(const Ulog& log, const std::string& topic) {
  MarkerLog marker;
  for (const auto& state : px4_states(log, topic)) {
    const Eigen::Quaterniond& q = state.value.orientation;
    const bool has_orientation = std::abs(q.norm() - 1.0) < 0.1;  // false for NaN
    if (!tilt_ropter::all_finite(state.value.position))
      ++marker.lost;
    else if (has_orientation)
      marker.poses.push_back({state.time, {state.value.position, q.normalized()}});
    else
      marker.positions.push_back({state.time, state.value.position});
  }
  return marker;
}

/// What the identification of a vehicle needs, between the times `from` and `until`. Motor and
/// servo i of actuator_motors and actuator_servos are those of rotor i, as px4_node sends them,
/// with the thrust model factor of its parameter. Rotor speeds are those of esc_status, if it is
/// there.
template <int Rotors>
[[nodiscard]] tilt_ropter::VehicleLog<Rotors> px4_vehicle_log(
    const Ulog& log, const tilt_ropter::Vehicle<Rotors>& vehicle, const std::string& pose_topic,
    double thrust_model_factor, double from, double until) {
  using namespace tilt_ropter;
  const auto is_used = [&](double time) { return time >= from && time <= until; };
  VehicleLog<Rotors> used;
  for (const auto& sample : px4_imu(log))
    if (is_used(sample.time)) used.imu.push_back(sample);
  for (const auto& pose : px4_poses(log, pose_topic).poses)
    if (is_used(pose.time)) used.poses.push_back(pose);

  ActuatorOutputSettings<Rotors> settings;
  settings.thrust_model_factor = thrust_model_factor;
  const OutputScaling<Rotors> scaling(vehicle, settings);
  const std::vector<std::string> controls =
      detail::joined({{"timestamp"}, detail::elements("control", Rotors)});
  const CsvTable motors = log.table("actuator_motors", controls);
  const bool has_servos = log.has("actuator_servos");
  if (!has_servos && std::any_of(vehicle.rotors.begin(), vehicle.rotors.end(),
                                 [](const RotorGeometry& rotor) { return rotor.tilts; }))
    (void)log.table("actuator_servos", controls);  // says that it is missing
  const CsvTable servos = has_servos ? log.table("actuator_servos", controls) : CsvTable{};
  // A command begins with each message of either topic.
  ActuatorOutputs<Rotors> outputs;
  for (std::size_t m = 0, s = 0; m < motors.rows() || s < servos.rows();) {
    const bool is_motor =
        s == servos.rows() || (m < motors.rows() && motors.columns[0][m] <= servos.columns[0][s]);
    const CsvTable& table = is_motor ? motors : servos;
    const std::size_t row = is_motor ? m++ : s++;
    for (int i = 0; i < Rotors; ++i)
      (is_motor ? outputs.motor : outputs.servo)(i) =
          table.columns[static_cast<std::size_t>(i) + 1][row];
    const auto command = scaling.command(outputs);  // none if a servo is disarmed
    const double time = 1e-6 * table.columns[0][row];
    if (m == 0 || (has_servos && s == 0) || !command || !is_used(time)) continue;
    if (!used.commands.empty() && !(time > used.commands.back().time))
      used.commands.back().value = *command;
    else
      used.commands.push_back({time, *command});
  }

  if (!log.has("esc_status")) return used;
  std::vector<std::string> fields = {"timestamp"};
  const bool has_functions = log.has("esc_status", "esc[0].actuator_function");
  constexpr int all = 8, first_motor = 101;  // ESCs of the message; actuator_function of motor 1
  for (int i = 0; i < all; ++i) {
    const std::string esc = "esc[" + std::to_string(i) + "].";
    fields.push_back(esc + "esc_rpm");
    fields.push_back(esc + (has_functions ? "actuator_function" : "esc_rpm"));
  }
  const CsvTable escs = log.table("esc_status", fields);
  for (std::size_t row = 0; row < escs.rows(); ++row) {
    Eigen::Matrix<double, Rotors, 1> speeds;
    for (int rotor = 0; rotor < Rotors; ++rotor) {
      int esc = rotor;
      for (int i = 0; i < all && has_functions; ++i)
        if (escs.columns[static_cast<std::size_t>(2 * i + 2)][row] == first_motor + rotor) esc = i;
      speeds(rotor) = std::abs(escs.columns[static_cast<std::size_t>(2 * esc + 1)][row]) * pi / 30;
    }
    if (is_used(1e-6 * escs.columns[0][row]))
      detail::append(used.rotor_speeds, escs.columns[0][row], speeds);
  }
  return used;
}

}  // namespace examples
