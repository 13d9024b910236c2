#pragma once

#include <array>
#include <cstdint>

namespace px4_msgs::msg {
struct ActuatorServos {
  static constexpr std::uint8_t NUM_CONTROLS = 8;
  std::uint64_t timestamp = 0, timestamp_sample = 0;
  std::array<float, 8> control{};
};
}  // namespace px4_msgs::msg
