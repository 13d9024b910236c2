#pragma once

#include <std_msgs/msg/header.hpp>

#include <vector>

namespace actuator_msgs::msg {
struct Actuators {
  std_msgs::msg::Header header;
  std::vector<double> position, velocity, normalized;
};
}  // namespace actuator_msgs::msg
