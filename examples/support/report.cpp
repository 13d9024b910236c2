#include "report.hpp"

#include "csv.hpp"

#include <tilt_ropter/planning/mission.hpp>

#include <Eigen/Core>
#include <nlohmann/json.hpp>

#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

namespace examples {
namespace {

using nlohmann::json;
using tilt_ropter::Vehicle;

constexpr std::size_t most_rows = 15000;  // in the page: 150 s at 100 Hz take 4 MB

std::string read_text(const std::string& path, const std::string& what_to_do) {
  std::ifstream in(path, std::ios::binary);
  std::ostringstream text;
  if (!in || !(text << in.rdbuf())) throw std::runtime_error("cannot read " + path + what_to_do);
  return text.str();
}

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  for (std::size_t at = 0; (at = text.find(from, at)) != std::string::npos; at += to.size())
    text.replace(at, from.size(), to);
  return text;
}

/// What the page shows of the log, by the columns' names.
std::vector<std::string> shown_columns(std::size_t rotors) {
  std::vector<std::string> names = {"time_s",        "phase",        "on_ground",   "power_w",
                                    "orientation_w", "wall_force_n", "push_force_n"};
  for (const char* axis : {"_x", "_y", "_z"})
    for (const char* name : {"position_m", "reference_m", "velocity_mps", "orientation",
                             "command_force_n", "estimated_force_n", "external_force_n"})
      names.push_back(std::string(name) + axis);
  for (const char* name : {"rotor_speed", "wrench", "pose", "load", "battery"})
    names.push_back(std::string("residual_") + name);
  for (std::size_t i = 1; i <= rotors; ++i)
    for (const char* name : {"tilt_true_rad_", "rotor_speed_radps_"})
      names.push_back(name + std::to_string(i));
  return names;
}

/// Six digits: 0.01 mm at 10 m from the origin.
double rounded(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.6g", value);
  return std::strtod(text, nullptr);
}

/// Adds the table's columns to `columns`, every `stride`-th row.
void add_columns(json& columns, const CsvTable& table, std::size_t stride) {
  for (const std::string& name : table.names) {
    json& values = columns[name] = json::array();
    const std::vector<double>& column = table[name];
    for (std::size_t i = 0; i < column.size(); i += stride) values.push_back(rounded(column[i]));
  }
}

json flight_log(const std::string& directory, std::size_t rotors) {
  const CsvTable log =
      read_csv(directory + "/hybrid_mission.csv", shown_columns(rotors), CsvNumbers::any);
  const CsvTable times =
      read_csv(directory + "/solve_times.csv", {"prepare_us", "feedback_us"}, CsvNumbers::any);
  if (times.rows() != log.rows() || log.rows() == 0)
    throw std::runtime_error(times.file + " does not belong to " + log.file + ": fly again");
  const std::size_t stride = (log.rows() + most_rows - 1) / most_rows;
  json columns;
  add_columns(columns, log, stride);
  add_columns(columns, times, stride);
  return columns;
}

json as_json(const Eigen::Vector3d& v) {
  return {v.x(), v.y(), v.z()};
}

/// What of the vehicle is drawn: at tilt angle alpha a rotor's thrust points along
/// cos(alpha) up - sin(alpha) side.
template <int Rotors>
json drawn_vehicle(const Vehicle<Rotors>& vehicle) {
  json drawn = {{"mass_kg", vehicle.body.mass}};
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i) {
    const tilt_ropter::RotorGeometry& rotor = vehicle.rotors[i];
    const tilt_ropter::RotorParameters& p = rotor_parameters(vehicle, i);
    drawn["rotors"].push_back({{"position_m", as_json(rotor.position)},
                               {"side", as_json(rotor.orientation.col(1))},
                               {"up", as_json(rotor.orientation.col(2))},
                               {"thrust_coefficient", p.thrust_coefficient},
                               {"linear_thrust_coefficient", p.linear_thrust_coefficient}});
  }
  if (vehicle.wheels)
    drawn["wheels"] = {{"radius_m", vehicle.wheels->radius},
                       {"half_track_m", vehicle.wheels->half_track},
                       {"wheel_base_m", vehicle.wheels->wheel_base}};
  return drawn;
}

/// All that the page's script is told.
json flight(const std::string& directory, const VehicleFile& file, const std::string& figures) {
  const auto rotor_count = [](const auto& vehicle) { return vehicle.rotors.size(); };
  json told = {{"name", file.name}, {"figures", json::array()}};
  std::istringstream lines(figures);
  for (std::string line; std::getline(lines, line);) told["figures"].push_back(line);
  told["phases"] = json::array();
  using tilt_ropter::MissionPhase;
  for (int phase = 0; phase <= static_cast<int>(MissionPhase::ground); ++phase)
    told["phases"].push_back(to_string(static_cast<MissionPhase>(phase)));
  told["vehicle"] = std::visit([](const auto& v) { return drawn_vehicle(v); }, file.vehicle);
  told["log"] = flight_log(directory, std::visit(rotor_count, file.vehicle));
  return told;
}

std::string page(const std::string& directory, const VehicleFile& file, const std::string& figures,
                 const std::vector<ScriptFile>& libraries) {
  std::string scripts;
  for (const ScriptFile& library : libraries) {
    const std::string text =
        read_text(library.path, ": install the Debian package " + library.package);
    scripts += "<script>\n" + replaced(text, "</script", "<\\/script") + "</script>\n";
  }
  const json told = flight(directory, file, figures);
  const std::string data = told.dump(-1, ' ', true, json::error_handler_t::replace);
  const std::string form = read_text(TILT_ROPTER_EXAMPLES_DIR "/support/report_page.html",
                                     ": the page is made from it, keep the examples' sources");
  return replaced(replaced(form, "<!--flight-->", replaced(data, "<", "\\u003c")),
                  "<!--libraries-->\n", scripts);
}

}  // namespace

std::vector<ScriptFile> report_libraries() {
  const std::string three = "/usr/share/javascript/three/";
  return {{three + "build/three.min.js", "libjs-three"},
          {three + "examples/js/controls/OrbitControls.js", "libjs-three"},
          {"/usr/share/nodejs/d3/dist/d3.min.js", "node-d3"}};
}

void write_report(const std::string& directory, const VehicleFile& file, const std::string& figures,
                  const std::vector<ScriptFile>& libraries) {
  const std::string path = directory + "/report.html";
  try {
    std::filesystem::remove(path);  // one of an earlier flight
    const std::string text = page(directory, file, figures, libraries);
    std::cout << "writing " << path << std::endl;
    std::ofstream out(path, std::ios::binary);
    if (!(out << text).flush()) throw std::runtime_error("cannot write " + path);
  } catch (const std::exception& error) {
    std::cerr << "no page about the flight: " << error.what() << '\n';
  }
}

}  // namespace examples
