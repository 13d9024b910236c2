#pragma once

#include <CLI/CLI.hpp>
#include <rclcpp/rclcpp.hpp>

#include <exception>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

namespace loops {

/// main() of a node. Arguments that are not for ROS must be --help; any other one gives exit code
/// 2.
template <typename Node>
int run_node(const std::string& name, const std::string& help, int argc, const char* const* argv) {
  CLI::App app{help, name};
  std::vector<std::string> arguments = rclcpp::remove_ros_arguments(argc, argv);
  // CLI11 needs the arguments in reverse order.
  arguments = {arguments.rbegin(), arguments.rend() - 1};
  try {
    app.parse(arguments);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : 2;
  }
  int result = 0;
  rclcpp::init(argc, argv);
  try {
    rclcpp::spin(std::make_shared<Node>());
  } catch (const std::exception& error) {
    std::cerr << name << ": " << error.what() << '\n';
    result = 1;
  }
  rclcpp::shutdown();
  return result;
}

}  // namespace loops
