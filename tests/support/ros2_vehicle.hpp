#pragma once

#include "../../examples/integrations/messages.hpp"
#include "../../examples/support/mission_sensors.hpp"
#include "heavy_vehicle.hpp"

#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstdint>
#include <vector>

namespace test_support {

/// A simulated vehicle that speaks in messages of ROS 2: a vehicle that is heavier than believed,
/// with the sensors of the mission, in side wind. Its plant is `start` [ns] behind the clock of the
/// stamps.
template <int Rotors>
class AnyRos2Vehicle {
 public:
  explicit AnyRos2Vehicle(std::int64_t start_time, const tilt_ropter::Vehicle<Rotors>& believed =
                                                       tilt_ropter::tilt_ropter_vehicle())
      : start(start_time), plant(heavier(believed)) {}

  /// Gives the messages of this millisecond to on_imu, on_pose and on_rotor_speeds of `node`.
  template <typename Node>
  void sense(Node& node) {
    Messages<Node> messages{*this, node};
    sensors_.sense(plant, messages);
  }

  void on_command(const actuator_msgs::msg::Actuators& m) {
    if (++commands == 1) first_stamp = loops::seconds(m.header.stamp);
    if (m.velocity._length != Rotors || m.position._length != Rotors) return;
    command_.rotor_speed = Eigen::Map<const Numbers>(m.velocity._buffer);
    command_.tilt_angle = Eigen::Map<const Numbers>(m.position._buffer);
    command_stamp = loops::seconds(m.header.stamp);
  }

  /// One millisecond.
  [[nodiscard]] bool step() { return plant.step(command_, {wind, Eigen::Vector3d::Zero()}, 1e-3); }
  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& command() const { return command_; }
  [[nodiscard]] std::int64_t now() const {
    return start + static_cast<std::int64_t>(std::llround(1e9 * plant.time()));
  }

  std::int64_t start;
  tilt_ropter::Plant<Rotors> plant;
  int commands = 0;
  double first_stamp = 0.0, command_stamp = 0.0;  ///< of the first and the last command [s]
  Eigen::Vector3d wind{0.3, 0.6, 0.0};            ///< [N]

 private:
  using Numbers = Eigen::Matrix<double, Rotors, 1>;

  /// Called by MissionSensors.
  template <typename Node>
  struct Messages {
    AnyRos2Vehicle& vehicle;
    Node& node;

    [[nodiscard]] std_msgs::msg::Header header(double time) const {
      return {loops::stamp(vehicle.start + static_cast<std::int64_t>(std::llround(1e9 * time))),
              nullptr};
    }
    void on_imu(double time, const tilt_ropter::InertialSampled& sample) {
      sensor_msgs::msg::Imu m{};
      m.header = header(time);
      m.orientation_covariance[0] = -1.0;  // not measured
      const Eigen::Vector3d &w = sample.angular_velocity, &f = sample.specific_force;
      m.angular_velocity = {w.x(), w.y(), w.z()};
      m.linear_acceleration = {f.x(), f.y(), f.z()};
      node.on_imu(m);
    }
    void on_pose(double time, const tilt_ropter::MarkerPosed& pose) {
      const Eigen::Vector3d& p = pose.position;
      const Eigen::Quaterniond& q = pose.orientation;
      node.on_pose({header(time), {{p.x(), p.y(), p.z()}, {q.x(), q.y(), q.z(), q.w()}}});
    }
    void on_rotor_speeds(const Numbers& speeds) {
      const std::vector<double> values(speeds.data(), speeds.data() + Rotors);
      sensor_msgs::msg::JointState m{};
      loops::refer_to(m.velocity, values);
      node.on_rotor_speeds(m);
    }
  };

  examples::MissionSensors<Rotors> sensors_{5};
  tilt_ropter::ActuatorState<Rotors> command_;
};
using Ros2Vehicle = AnyRos2Vehicle<4>;

}  // namespace test_support
