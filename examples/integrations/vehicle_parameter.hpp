#pragma once

#include "../support/vehicle_file.hpp"

#include <rclcpp/rclcpp.hpp>

#include <string>

namespace loops {

/// Returns the vehicle from the JSON file in the node's parameter `vehicle`, or the Tilt-Ropter
/// without this parameter. The node needs four rotors. Throws examples::VehicleFileError.
inline examples::VehicleFile vehicle_parameter(rclcpp::Node& node) {
  return examples::vehicle_or_default(node.declare_parameter("vehicle", std::string()));
}

}  // namespace loops
