#pragma once

#include "../../cmake/vehicle_file/tilt_ropter/input_file_error.hpp"
#include "../support/vehicle_check.hpp"
#include "node.hpp"
#include "parameters.hpp"

#include <CLI/CLI.hpp>

#include <exception>
#include <iostream>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

namespace loops {

/// main() of a node: calls fly(node, vehicle, file) for the vehicle of the parameter `vehicle`, and
/// prints the counts of its ticks. `app` has the options of the program beside those of ROS 2. Exit
/// code 2 for wrong options, parameters and vehicle files, 1 for other errors.
template <typename Fly>
int run_node(CLI::App& app, int argc, const char* const* argv, const Fly& fly) {
  std::vector<std::string> arguments(argv + 1, argv + argc);
  try {
    Parameters parameters = Parameters::from(arguments, app.get_name());
    // CLI11 needs the arguments in reverse order.
    app.parse(std::vector<std::string>(arguments.rbegin(), arguments.rend()));
    Node node(parameters);
    const examples::VehicleFile file = examples::vehicle_to_fly(parameters.text("vehicle"));
    std::visit([&](const auto& vehicle) { fly(node, vehicle, file); }, file.vehicle);
    node.counts().print(std::cout);
    return 0;
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : 2;
  } catch (const std::invalid_argument& error) {
    std::cerr << app.get_name() << ": " << error.what() << '\n';
    return 2;
  } catch (const tilt_ropter::InputFileError& error) {
    std::cerr << app.get_name() << ": " << error.what() << '\n';
    return 2;
  } catch (const std::exception& error) {
    std::cerr << app.get_name() << ": " << error.what() << '\n';
    return 1;
  }
}

}  // namespace loops
