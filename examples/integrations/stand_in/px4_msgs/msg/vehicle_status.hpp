#pragma once

#include <cstdint>

namespace px4_msgs::msg {
struct VehicleStatus {
  static constexpr std::uint8_t ARMING_STATE_DISARMED = 1, ARMING_STATE_ARMED = 2;
  static constexpr std::uint8_t NAVIGATION_STATE_MANUAL = 0, NAVIGATION_STATE_OFFBOARD = 14;
  std::uint64_t timestamp = 0;
  std::uint8_t arming_state = 0, nav_state = 0;
};
}  // namespace px4_msgs::msg
