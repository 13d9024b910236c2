#pragma once

#include <array>
#include <cstdint>

namespace px4_msgs::msg {
struct ActuatorMotors {
  static constexpr std::uint8_t NUM_CONTROLS = 12;
  std::uint64_t timestamp = 0, timestamp_sample = 0;
  std::uint16_t reversible_flags = 0;
  std::array<float, 12> control{};
};
}  // namespace px4_msgs::msg
