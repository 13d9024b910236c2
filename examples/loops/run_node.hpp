#pragma once

#include <CLI/CLI.hpp>
#include <rclcpp/rclcpp.hpp>

#include <exception>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

namespace loops {

/// main() of a node: what is not for ROS is --help or wrong, exit code 2.
template <typename Node>
int run_node(const std::string& name, const std::string& help, int argc, const char* const* argv) {
  CLI::App app{help, name};
  std::vector<std::string> arguments = rclcpp::remove_ros_arguments(argc, argv);
  arguments = {arguments.rbegin(), arguments.rend() - 1};  // as CLI11 takes them: the last first
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
