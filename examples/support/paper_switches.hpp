#pragma once

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <array>
#include <string>
#include <vector>

/// The departures of the library's controller from the controller of the paper, each as a switch.
namespace examples {

/// Settings of the controller and of the allocation behind it.
struct ControllerSettings {
  tilt_ropter::NmpcSettings nmpc;
  tilt_ropter::AllocationSettings allocation;
};

/// A departure: its name, and the function that sets it back to the paper.
struct PaperSwitch {
  const char* name;
  const char* effect;
  void (*set)(ControllerSettings& s, const tilt_ropter::NmpcSettings& paper);
};

[[nodiscard]] inline const std::array<PaperSwitch, 9>& paper_switches() {
  using Settings = ControllerSettings;
  using Paper = tilt_ropter::NmpcSettings;
  static const std::array<PaperSwitch, 9> all{{
      {"cost", "the cost is on F and M themselves, not on their deviation from the wrench needed",
       [](Settings& s, const Paper& paper) {
         s.nmpc.wrench_reference = paper.wrench_reference;
         s.nmpc.problem.weights.ground_thrust = paper.problem.weights.ground_thrust;
       }},
      {"bounds", "the boxes of the paper's table on wrench, wrench rate and body rate",
       [](Settings& s, const Paper& paper) { s.nmpc.problem.bounds = paper.problem.bounds; }},
      {"actuators", "no constraints of thrusts and servo speeds",
       [](Settings& s, const Paper& paper) {
         s.nmpc.actuator_constraints = paper.actuator_constraints;
       }},
      {"contact", "on the ground by the heights of vehicle and reference, not by load",
       [](Settings& s, const Paper& paper) {
         s.nmpc.ground.contact_by_height = paper.ground.contact_by_height;
         s.nmpc.ground.planned_height = paper.ground.planned_height;
       }},
      {"ground", "the ground acts as the whole estimated wrench, not as what it holds",
       [](Settings& s, const Paper& paper) { s.nmpc.ground.model = paper.ground.model; }},
      {"conditions", "the conditions on the ground are hard, not weighted",
       [](Settings& s, const Paper& paper) {
         s.nmpc.problem.weights.ground = paper.problem.weights.ground;
       }},
      {"descent", "references that touch down are followed as they are",
       [](Settings& s, const Paper& paper) {
         s.nmpc.ground.settling_speed = paper.ground.settling_speed;
       }},
      {"lead", "commands do not lead the lags of servos and rotors",
       [](Settings& s, const Paper&) { s.allocation.lag_compensation = 0.0; }},
      {"limits", "each program is solved, however many passes and how much time it takes",
       [](Settings& s, const Paper& paper) {
         s.nmpc.solver = paper.solver;
         s.nmpc.time_limit = paper.time_limit;
       }},
  }};
  return all;
}

/// Sets the switches with these `names`; "all" sets every switch.
inline void set_as_in_paper(const std::vector<std::string>& names, ControllerSettings& settings) {
  const tilt_ropter::NmpcSettings paper = tilt_ropter::paper_nmpc_settings();
  for (const PaperSwitch& s : paper_switches())
    if (std::any_of(names.begin(), names.end(),
                    [&s](const std::string& name) { return name == "all" || name == s.name; }))
      s.set(settings, paper);
}

/// Adds the option --as-in-paper to `app`; parsing fills `names`.
inline void add_paper_switches(CLI::App& app, std::vector<std::string>& names) {
  std::vector<std::string> allowed{"all"};
  std::string text = "what the controller does as printed in the paper, separated by commas:";
  for (const PaperSwitch& s : paper_switches()) {
    allowed.emplace_back(s.name);
    text += std::string("\n") + s.name + ": " + s.effect;
  }
  app.add_option("--as-in-paper", names, text + "\nall: all of these")
      ->delimiter(',')
      ->check(CLI::IsMember(allowed));
}

}  // namespace examples
