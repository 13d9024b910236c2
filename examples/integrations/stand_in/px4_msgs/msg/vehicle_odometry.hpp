#pragma once

#include <array>
#include <cstdint>

namespace px4_msgs::msg {
struct VehicleOdometry {
  static constexpr std::uint8_t POSE_FRAME_NED = 1, POSE_FRAME_FRD = 2;
  static constexpr std::uint8_t VELOCITY_FRAME_NED = 1, VELOCITY_FRAME_FRD = 2,
                                VELOCITY_FRAME_BODY_FRD = 3;
  std::uint64_t timestamp = 0, timestamp_sample = 0;
  std::uint8_t pose_frame = 0;
  std::array<float, 3> position{};
  std::array<float, 4> q{};
  std::uint8_t velocity_frame = 0;
  std::array<float, 3> velocity{}, angular_velocity{};
};
}  // namespace px4_msgs::msg
