// A node that flies a vehicle with PX4 in offboard mode: it commands motors and servos. It speaks
// DDS through Cyclone DDS, as PX4 does through its uXRCE-DDS agent.

#include "px4_node.hpp"
#include "px4_topics.hpp"
#include "run_node.hpp"

#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cstdint>
#include <iostream>
#include <string>
#include <type_traits>
#include <variant>
#include <vector>

namespace {

using namespace px4_msgs::msg;

using Servos = std::variant<dds::Publisher<ActuatorServos>, dds::Publisher<ActuatorServosV0>>;

Servos servos_publisher(loops::Node& node, const loops::Px4Versions& versions) {
  const std::string topic = versions.topic("ActuatorServos");
  if (versions.of("ActuatorServos") == 0) return node.publisher<ActuatorServosV0>(topic, {true, 1});
  return node.publisher<ActuatorServos>(topic, {true, 1});
}

template <int Rotors>
void subscribe_to_status(loops::Node& node, loops::Px4Node<Rotors>& pilot,
                         const loops::Px4Versions& versions) {
  const std::string topic = versions.topic("VehicleStatus");
  const auto subscribe = [&](auto message) {
    node.subscribe<decltype(message)>(topic, dds::sensor_data,
                                      [&pilot](const auto& m) { pilot.on_status(m); });
  };
  switch (versions.of("VehicleStatus")) {
    case 0:
      return subscribe(VehicleStatusV0{});
    case 1:
      return subscribe(VehicleStatusV1{});
    case 2:
      return subscribe(VehicleStatusV2{});
    case 3:
      return subscribe(VehicleStatusV3{});
    default:
      return subscribe(VehicleStatus{});
  }
}

template <int Rotors>
void subscribe_to_battery(loops::Node& node, loops::Px4Node<Rotors>& pilot,
                          const loops::Px4Versions& versions) {
  const auto subscribe = [&](auto message) {
    node.subscribe<decltype(message)>(versions.topic("BatteryStatus"), dds::sensor_data,
                                      [&pilot](const auto& m) { pilot.on_battery(m); });
  };
  if (versions.of("BatteryStatus") == 0)
    subscribe(BatteryStatusV0{});
  else
    subscribe(BatteryStatus{});
}

template <int Rotors>
void fly(loops::Node& node, const tilt_ropter::Vehicle<Rotors>& vehicle,
         const examples::VehicleFile& file, const std::vector<std::string>& choices) {
  const loops::Px4Versions versions(choices);
  loops::Px4Node<Rotors> pilot(vehicle, file, node.parameters());
  loops::Telemetry telemetry(node, pilot.vehicle());
  auto mode = node.publisher<OffboardControlMode>(versions.topic("OffboardControlMode"), {true, 1});
  auto motors = node.publisher<ActuatorMotors>(versions.topic("ActuatorMotors"), {true, 1});
  Servos servos = servos_publisher(node, versions);
  auto thrust =
      node.publisher<VehicleThrustSetpoint>(versions.topic("VehicleThrustSetpoint"), {true, 1});
  node.subscribe<VehicleOdometry>(versions.topic("VehicleOdometry"), dds::sensor_data,
                                  [&](const VehicleOdometry& m) { pilot.on_odometry(m); });
  node.subscribe<SensorCombined>(versions.topic("SensorCombined"), dds::sensor_data,
                                 [&](const SensorCombined& m) { pilot.on_sensors(m); });
  subscribe_to_status(node, pilot, versions);
  subscribe_to_battery(node, pilot, versions);
  node.subscribe<VehicleControlMode>(
      versions.topic("VehicleControlMode"), dds::sensor_data,
      [&](const VehicleControlMode& m) { pilot.on_control_mode(m); });
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
  node.subscribe<TrajectorySetpoint>(versions.topic("TrajectorySetpoint"), dds::sensor_data,
                                     [&](const TrajectorySetpoint& m) { pilot.on_set_point(m); });
  node.parameters().refuse_unknown();
  const bool tilts = std::any_of(vehicle.rotors.begin(), vehicle.rotors.end(),
                                 [](const auto& rotor) { return rotor.tilts; });
  node.spin(10000000, [&](std::int64_t now) {
    const bool servos_heard =
        std::visit([](const auto& publisher) { return publisher.subscribers() > 0; }, servos);
    pilot.on_listeners(motors.subscribers() > 0 && (servos_heard || !tilts));
    const auto out = pilot.tick(now);
    if (out.mode) mode.publish(*out.mode);
    if (out.thrust) thrust.publish(*out.thrust);
    if (out.actuators) {
      motors.publish(
          loops::px4_controls<ActuatorMotors>(out.actuators->motor, out.now, out.sample));
      std::visit(
          [&](auto& publisher) {
            using Message = typename std::decay_t<decltype(publisher)>::message_type;
            publisher.publish(
                loops::px4_controls<Message>(out.actuators->servo, out.now, out.sample));
          },
          servos);
    }
    loops::Snapshot snapshot = pilot.snapshot(now);
    snapshot.counts = node.counts();
    telemetry.offer(snapshot);
  });
  pilot.solver().print(std::cout);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{loops::px4_help, "px4_node"};
  std::vector<std::string> versions;
  app.add_option("--px4-message-version", versions,
                 "version of a message in older firmware, as MESSAGE=VERSION: VehicleStatus=1 "
                 "ActuatorServos=0 for PX4 1.17, BatteryStatus=0 too for 1.16; may be given "
                 "several times")
      ->take_all();
  return loops::run_node(app, argc, argv, [&](auto&... arguments) { fly(arguments..., versions); });
}
