#pragma once

#include "vehicle_file.hpp"

#include <CLI/CLI.hpp>

#include <exception>
#include <iostream>

namespace examples {

/// What is left of main(): parses the options that `app` knows, runs, tells errors. Returns what
/// `run()` does, 1 after an error, 2 for a vehicle that cannot be, above 100 for wrong options.
template <typename Run>
int run_program(CLI::App& app, const char* name, int argc, char** argv, const Run& run) {
  CLI11_PARSE(app, argc, argv);
  try {
    return run();
  } catch (const VehicleFileError& error) {
    std::cerr << name << ": " << error.what() << '\n';
    return 2;
  } catch (const std::exception& error) {
    std::cerr << name << ": " << error.what() << '\n';
    return 1;
  }
}

}  // namespace examples
