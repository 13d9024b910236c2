#pragma once

#include "vehicle_choice.hpp"

#include <CLI/CLI.hpp>

#include <exception>
#include <iostream>

namespace examples {

/// The common part of main(): parses the options in `app`, runs the program and prints errors.
/// Returns the result of run(), `error_code` after an error, 2 for an invalid vehicle or mission
/// file, and above 100 for wrong options.
template <typename Run>
int run_program(CLI::App& app, const char* name, int argc, char** argv, const Run& run,
                int error_code = 1) {
  CLI11_PARSE(app, argc, argv);
  try {
    return run();
  } catch (const tilt_ropter::InputFileError& error) {
    std::cerr << name << ": " << error.what() << '\n';
    return 2;
  } catch (const std::exception& error) {
    std::cerr << name << ": " << error.what() << '\n';
    return error_code;
  }
}

}  // namespace examples
