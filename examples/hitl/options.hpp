#pragma once

#include "../support/run_program.hpp"
#include "link.hpp"

#include <CLI/CLI.hpp>

#include <csignal>
#include <string>

namespace hitl {

inline void add_options(CLI::App& app, Line& line, std::string& vehicle) {
  app.add_option("--vehicle", vehicle,
                 "JSON file of a vehicle with 2 to 8 rotors; the same for all three programs");
  const auto add = [&](const char* name, auto& value, const char* text) {
    return app.add_option(name, value, text)->capture_default_str()->group("A bad line");
  };
  add("--loss", line.loss, "fraction of the received messages that is lost")
      ->check(CLI::Range(0.0, 1.0));
  add("--spike-share", line.spike_fraction, "fraction of the received messages that is delayed")
      ->check(CLI::Range(0.0, 1.0));
  add("--spike", line.spike, "delay of these messages [s]")->check(CLI::Range(0.0, 1.0));
  app.add_option("--lock-step", line.lock_step,
                 "fly in lock step: the simulation waits for each command instead of the clock, at "
                 "most for this time [s]; the same for all three programs; 0: real time")
      ->check(CLI::Range(0.0, 1000.0))
      ->capture_default_str();
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
