// A node that flies a vehicle with PX4 in offboard mode: it commands motors and servos. In a ROS 2
// workspace, it depends on rclcpp, px4_msgs, CLI11 and tilt_ropter; do not put stand_in/ on the
// include path there.

#include "px4_node.hpp"
#include "run_node.hpp"

int main(int argc, char** argv) {
  return loops::run_node<loops::Px4Node>("px4_node", loops::px4_help, argc, argv);
}
