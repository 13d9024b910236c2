#pragma once

#include <array>
#include <cstddef>
#include <stdexcept>
#include <string>
#include <vector>

namespace loops {

/// A topic of PX4. Since PX4 1.16 the name of a topic ends in the version of its message, except
/// for version 0.
struct Px4Topic {
  const char* message;  ///< of px4_msgs
  const char* topic;    ///< without version, relative to the namespace
  int version;          ///< of PX4 1.18
  int oldest;           ///< version that px4_node also knows; all between are known, too
};

/// The topics that px4_node uses. The fields of every version are in idl/px4_msgs.idl.
/// VehicleStatus: PX4 1.15 has version 0, PX4 1.16 and 1.17 have version 1. ActuatorServos: all of
/// them have version 0, with 8 instead of 15 controls. BatteryStatus: PX4 1.16 has version 0, and
/// so has PX4 1.15, with other fields after the current.
inline constexpr std::array<Px4Topic, 10> px4_topics = {{
    {"VehicleOdometry", "fmu/out/vehicle_odometry", 0, 0},
    {"SensorCombined", "fmu/out/sensor_combined", 0, 0},
    {"VehicleStatus", "fmu/out/vehicle_status", 4, 0},
    {"VehicleControlMode", "fmu/out/vehicle_control_mode", 0, 0},
    {"BatteryStatus", "fmu/out/battery_status", 1, 0},
    {"OffboardControlMode", "fmu/in/offboard_control_mode", 0, 0},
    {"ActuatorMotors", "fmu/in/actuator_motors", 0, 0},
    {"ActuatorServos", "fmu/in/actuator_servos", 1, 0},
    {"VehicleThrustSetpoint", "fmu/in/vehicle_thrust_setpoint", 0, 0},
    {"TrajectorySetpoint", "fmu/in/trajectory_setpoint", 0, 0},
}};

/// The version of each message that the firmware has.
class Px4Versions {
 public:
  /// PX4 1.18, except for `choices` such as "VehicleStatus=1". Throws std::invalid_argument.
  explicit Px4Versions(const std::vector<std::string>& choices = {}) {
    for (std::size_t i = 0; i < px4_topics.size(); ++i) versions_[i] = px4_topics[i].version;
    for (const std::string& choice : choices) {
      const std::size_t middle = choice.find('=');
      const std::size_t i = index(choice.substr(0, middle));
      const Px4Topic& topic = px4_topics[i];
      int version = topic.oldest;
      while (version <= topic.version &&
             (middle == std::string::npos || choice.substr(middle + 1) != std::to_string(version)))
        ++version;
      if (version > topic.version)
        throw std::invalid_argument(choice + ": must be " + topic.message + "=VERSION, from " +
                                    std::to_string(topic.oldest) + " to " +
                                    std::to_string(topic.version));
      versions_[i] = version;
    }
  }

  /// Throws std::invalid_argument if px4_node has no such message.
  [[nodiscard]] int of(const std::string& message) const { return versions_[index(message)]; }

  /// Returns the name of the topic in ROS 2. Throws as of().
  [[nodiscard]] std::string topic(const std::string& message) const {
    const std::size_t i = index(message);
    return px4_topics[i].topic + (versions_[i] > 0 ? "_v" + std::to_string(versions_[i]) : "");
  }

 private:
  static std::size_t index(const std::string& message) {
    std::string names;
    for (std::size_t i = 0; i < px4_topics.size(); ++i) {
      if (message == px4_topics[i].message) return i;
      names += (i == 0 ? "" : ", ") + std::string(px4_topics[i].message);
    }
    throw std::invalid_argument("\"" + message + "\": must be one of " + names);
  }

  std::array<int, px4_topics.size()> versions_{};
};

}  // namespace loops
