// A ROS 2 node that flies the vehicle. In a ROS 2 workspace, compile this file and
// ../support/flight_controller.cpp. It depends on rclcpp, sensor_msgs, geometry_msgs,
// actuator_msgs, CLI11 and tilt_ropter; do not put stand_in/ on the include path there.

#include "ros2_node.hpp"
#include "run_node.hpp"

int main(int argc, char** argv) {
  return loops::run_node<loops::Ros2Node>("ros2_node", loops::ros2_help, argc, argv);
}
