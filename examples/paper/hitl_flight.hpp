#pragma once

#include "experiments.hpp"
#include "table.hpp"

#include <unistd.h>

#include <cstdlib>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

/// The hybrid mission with hardware in the loop (paper, Sec. Simulation): three programs, here on
/// one computer and in real time.
namespace examples::paper {

/// Runs hitl_onboard, hitl_flight_controller and hitl_simulator of the directory `programs`, in a
/// DDS domain of their own unless ROS_DOMAIN_ID names one. Their output goes to hitl_*.txt in
/// `output`. The flight ends at mission time `until` [s]; 0: at the end of the mission. Throws
/// std::runtime_error if the simulator fails.
[[nodiscard]] inline std::vector<Figures> fly_hardware_in_the_loop(const std::string& programs,
                                                                   const std::string& output,
                                                                   double until) {
  // Others may fly, too. Higher domains have ports that Linux gives to any program.
  setenv("ROS_DOMAIN_ID", std::to_string(1 + getpid() % 100).c_str(), 0);
  const std::string script = "bash '" TILT_ROPTER_EXAMPLES_DIR "/hitl/fly.sh' '" + programs +
                             "' '" + output + "' --until " + std::to_string(until);
  if (std::system(script.c_str()) != 0)
    throw std::runtime_error("hitl_simulator failed: see " + output + "/hitl_simulator.txt");

  std::map<std::string, double> printed;
  std::istringstream lines(read_text(output + "/hitl_simulator.txt"));
  for (std::string line; std::getline(lines, line);) {
    const std::size_t colon = line.find(": ");
    if (colon != std::string::npos)
      printed[line.substr(0, colon)] = std::atof(line.c_str() + colon + 2);
  }
  const auto figure = [&](const char* key) {
    const auto found = printed.find(key);
    return found == printed.end() ? not_measured : found->second;
  };
  std::vector<Figures> rows(3);
  for (Figures& row : rows) {
    row.plant = "hitl";
    row.settings = "library";
  }
  rows[0].experiment = "air";
  rows[0].rmse = figure("air_rmse_m");
  rows[1].experiment = "ground";
  rows[1].rmse = figure("ground_rmse_m");
  rows[2].experiment = "hybrid";
  rows[2].from_start = figure("mission_rmse_m");
  rows[2].air_power = figure("flight_power_w");
  rows[2].ground_power = figure("ground_power_w");
  return rows;
}

}  // namespace examples::paper
