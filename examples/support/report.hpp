#pragma once

#include "vehicle_choice.hpp"

#include <string>
#include <vector>

/// The page about a flight, report.html: the way in 3D, plots over time, figures. It holds all that
/// it shows, with the libraries that draw it, so that it opens anywhere and without a network.
namespace examples {

/// A JavaScript file that goes into the page, and the Debian package that installs it.
struct ScriptFile {
  std::string path, package;
};

/// three.js with its control of the view, and d3, where Debian installs them.
[[nodiscard]] std::vector<ScriptFile> report_libraries();

/// Reads hybrid_mission.csv and solve_times.csv in `directory` and writes report.html beside them.
/// `figures`: the lines `key: value` that the program printed. Where that fails, as without a
/// library, it says why on standard error and leaves no page; a program's result does not depend
/// on it.
void write_report(const std::string& directory, const VehicleFile& file, const std::string& figures,
                  const std::vector<ScriptFile>& libraries = report_libraries());

}  // namespace examples
