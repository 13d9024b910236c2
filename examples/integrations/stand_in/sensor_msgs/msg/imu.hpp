#pragma once

#include <geometry_msgs/msg/pose_stamped.hpp>
#include <std_msgs/msg/header.hpp>

namespace sensor_msgs::msg {
struct Imu {
  std_msgs::msg::Header header;
  geometry_msgs::msg::Vector3 angular_velocity, linear_acceleration;
};
}  // namespace sensor_msgs::msg
