#pragma once

#include <cstdint>

namespace px4_msgs::msg {
struct OffboardControlMode {
  std::uint64_t timestamp = 0;
  bool position = false, velocity = false, acceleration = false, attitude = false,
       body_rate = false, thrust_and_torque = false, direct_actuator = false;
};
}  // namespace px4_msgs::msg
