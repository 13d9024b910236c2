#pragma once

#include "../support/vehicle_file.hpp"

#include <rclcpp/rclcpp.hpp>

#include <string>

namespace loops {

/// The vehicle of four rotors whose JSON file the node's parameter `vehicle` names; the
/// Tilt-Ropter without. Throws examples::VehicleFileError.
inline examples::VehicleFile vehicle_parameter(rclcpp::Node& node) {
  return examples::vehicle_or_default(node.declare_parameter("vehicle", std::string()));
}

}  // namespace loops
