#pragma once

#include <array>
#include <cstdint>

namespace px4_msgs::msg {
struct SensorCombined {
  std::uint64_t timestamp = 0;
  std::array<float, 3> gyro_rad{}, accelerometer_m_s2{};
};
}  // namespace px4_msgs::msg
