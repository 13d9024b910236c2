#pragma once

#include "../support/run_program.hpp"
#include "link.hpp"

#include <CLI/CLI.hpp>

#include <csignal>
#include <string>

namespace hitl {

/// Where the three programs listen unless told otherwise: on this computer alone.
struct Addresses {
  std::string simulator = "127.0.0.1:24001";
  std::string onboard = "127.0.0.1:24002";
  std::string flight_controller = "127.0.0.1:24003";
};

inline void add_options(CLI::App& app, Addresses& addresses, BadLine& line, std::string& vehicle) {
  app.add_option("--vehicle", vehicle,
                 "JSON file of the vehicle, of 4 rotors; the same for all three");
  const std::string group = "The line (every program is told the same addresses)";
  const auto add = [&](const char* name, auto& value, const char* text) {
    return app.add_option(name, value, text)->capture_default_str()->group(group);
  };
  add("--simulator", addresses.simulator, "where hitl_simulator listens");
  add("--onboard", addresses.onboard, "where hitl_onboard listens");
  add("--flight-controller", addresses.flight_controller, "where hitl_flight_controller listens");
  add("--loss", line.loss, "share of what this program sends that gets lost")
      ->check(CLI::Range(0.0, 1.0));
  add("--spike-share", line.spike_share, "share of what it sends that is held back")
      ->check(CLI::Range(0.0, 1.0));
  add("--spike", line.spike, "for so long [s]")->check(CLI::Range(0.0, 1.0));
}

/// Set by interrupt and termination signals, for a program to end with its report.
inline volatile std::sig_atomic_t interrupted = 0;

inline void end_on_signals() {
  for (const int number : {SIGINT, SIGTERM}) std::signal(number, [](int) { interrupted = 1; });
}

/// examples::run_program() for a program that ends with its report when it is told to.
template <typename Run>
int run_program(CLI::App& app, const char* name, int argc, char** argv, const Run& run) {
  return examples::run_program(app, name, argc, argv, [&run] {
    end_on_signals();
    return run();
  });
}

}  // namespace hitl
