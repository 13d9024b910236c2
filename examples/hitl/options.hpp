#pragma once

#include "../support/run_program.hpp"
#include "link.hpp"

#include <CLI/CLI.hpp>

#include <csignal>
#include <string>

namespace hitl {

/// Default addresses of the three programs: only on this computer.
struct Addresses {
  std::string simulator = "127.0.0.1:24001";
  std::string onboard = "127.0.0.1:24002";
  std::string flight_controller = "127.0.0.1:24003";
};

inline void add_options(CLI::App& app, Addresses& addresses, BadLine& line, std::string& vehicle) {
  app.add_option("--vehicle", vehicle,
                 "JSON file of a vehicle with 4 rotors; the same for all three programs");
  const std::string group = "The line (give every program the same addresses)";
  const auto add = [&](const char* name, auto& value, const char* text) {
    return app.add_option(name, value, text)->capture_default_str()->group(group);
  };
  add("--simulator", addresses.simulator, "address of hitl_simulator");
  add("--onboard", addresses.onboard, "address of hitl_onboard");
  add("--flight-controller", addresses.flight_controller, "address of hitl_flight_controller");
  add("--loss", line.loss, "fraction of the sent datagrams that is lost")
      ->check(CLI::Range(0.0, 1.0));
  add("--spike-share", line.spike_fraction, "fraction of the sent datagrams that is delayed")
      ->check(CLI::Range(0.0, 1.0));
  add("--spike", line.spike, "delay of these datagrams [s]")->check(CLI::Range(0.0, 1.0));
}

/// Set by interrupt and termination signals, so that a program ends with its report.
inline volatile std::sig_atomic_t interrupted = 0;

inline void end_on_signals() {
  for (const int number : {SIGINT, SIGTERM}) std::signal(number, [](int) { interrupted = 1; });
}

/// examples::run_program() for a program that ends with its report after such a signal.
template <typename Run>
int run_program(CLI::App& app, const char* name, int argc, char** argv, const Run& run) {
  return examples::run_program(app, name, argc, argv, [&run] {
    end_on_signals();
    return run();
  });
}

}  // namespace hitl
