// A ROS 2 node that flies the vehicle. It speaks DDS, the protocol of ROS 2, through Cyclone DDS.

#include "ros2_node.hpp"
#include "run_node.hpp"

#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <cstdint>
#include <iostream>

namespace {

template <int Rotors>
void fly(loops::Node& node, const tilt_ropter::Vehicle<Rotors>& vehicle,
         const examples::VehicleFile& file) {
  loops::Ros2Node<Rotors> pilot(vehicle, file, node.parameters());
  loops::Telemetry telemetry(node, pilot.vehicle());
  auto actuators = node.publisher<actuator_msgs::msg::Actuators>("actuators", {true, 1});
  constexpr dds::Quality many_samples{false, 100};  // those of a tick that comes late
  node.subscribe<sensor_msgs::msg::Imu>("imu", many_samples,
                                        [&](const sensor_msgs::msg::Imu& m) { pilot.on_imu(m); });
  node.subscribe<geometry_msgs::msg::PoseStamped>(
      "pose", dds::sensor_data,
      [&](const geometry_msgs::msg::PoseStamped& m) { pilot.on_pose(m); });
  node.subscribe<sensor_msgs::msg::JointState>(
      "rotor_speeds", dds::sensor_data,
      [&](const sensor_msgs::msg::JointState& m) { pilot.on_rotor_speeds(m); });
  node.subscribe<geometry_msgs::msg::PoseStamped>(
      "hover_point", dds::default_quality,
      [&](const geometry_msgs::msg::PoseStamped& m) { pilot.on_hover_point(m); });
  node.subscribe<std_msgs::msg::Bool>("pause", dds::default_quality,
                                      [&](const std_msgs::msg::Bool& m) { pilot.on_pause(m); });
  node.subscribe<std_msgs::msg::Bool>("land", dds::default_quality,
                                      [&](const std_msgs::msg::Bool& m) { pilot.on_land(m); });
  node.subscribe<trajectory_msgs::msg::MultiDOFJointTrajectory>(
      "trajectory", dds::default_quality,
      [&](const trajectory_msgs::msg::MultiDOFJointTrajectory& m) { pilot.on_trajectory(m); });
  node.parameters().refuse_unknown();
  node.spin(10000000, [&](std::int64_t now) {
    if (const auto* command = pilot.tick(now)) actuators.publish(*command);
    loops::Snapshot snapshot = pilot.snapshot(now);
    snapshot.counts = node.counts();
    telemetry.offer(snapshot);
  });
  pilot.solver().print(std::cout);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{loops::ros2_help, "ros2_node"};
  return loops::run_node(app, argc, argv, [](auto&... arguments) { fly(arguments...); });
}
