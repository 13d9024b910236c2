// Identifies a vehicle from the log of one flight: thrust coefficient or mass, CoM, inertia, torque
// ratio, lags and delays of rotors and servos, drag, each with a 95 % confidence interval. Writes a
// vehicle file, the fit, and a picture.

#include "../support/identification_log.hpp"
#include "../support/mission_log.hpp"
#include "../support/pictures.hpp"
#include "../support/px4_log.hpp"
#include "../support/run_program.hpp"
#include "../support/ulog.hpp"
#include "../support/vehicle_choice.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/identification/vehicle_identification.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <Eigen/Core>

#include <array>
#include <cstddef>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <limits>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <variant>
#include <vector>

using namespace tilt_ropter;

namespace {

struct Options {
  std::string input, output = "results", vehicle_path, trust = "mass";
  std::array<double, 3> imu_position{};
  double from = -std::numeric_limits<double>::infinity();
  double until = std::numeric_limits<double>::infinity();
  double min_height = std::numeric_limits<double>::quiet_NaN();  // NaN: by the undercarriage
  std::string pose_topic;                                        // of a ULog; empty: what is there
  double thrust_model_factor = 0.0;                              // of a ULog
  bool no_pictures = false;
};

const char* unit_of(VehicleParameter p) {
  constexpr const char* units[] = {
      "",   "_m", "_m", "_m",         "_kg_m2",     "_kg_m2",     "_kg_m2", "_m",   "_s",
      "_s", "_s", "_s", "_n_s_per_m", "_n_s_per_m", "_n_s_per_m", "_kg_m2", "_kg_m"};
  return units[static_cast<std::size_t>(p)];
}

void line(const std::string& name, const std::string& unit, double value, double half_width,
          bool excited) {
  std::cout << name << unit << ": " << std::setprecision(5) << value
            << (excited ? "" : " (not excited)") << '\n'
            << name << "_95" << unit << ": " << std::setprecision(3) << half_width << '\n';
}

template <int Rotors>
void print(const VehicleIdentification<Rotors>& found, const Options& o) {
  const auto& v = found.vehicle;
  const IdentifiedParameter& scale = found[VehicleParameter::thrust_per_mass];
  const double relative = scale.half_width / scale.value;
  line("mass_over_thrust_coefficient", "_rad2_per_m", v.body.mass / v.rotor.thrust_coefficient,
       relative * v.body.mass / v.rotor.thrust_coefficient, scale.excited);
  if (o.trust == "mass")
    line("thrust_coefficient", "_n_s2_per_rad2", v.rotor.thrust_coefficient,
         relative * v.rotor.thrust_coefficient, scale.excited);
  else
    line("mass", "_kg", v.body.mass, relative * v.body.mass, scale.excited);
  std::string not_excited;
  for (std::size_t i = 0; i < found.parameters.size(); ++i) {
    const auto parameter = static_cast<VehicleParameter>(i);
    const IdentifiedParameter& p = found.parameters[i];
    if (i > 0) line(to_string(parameter), unit_of(parameter), p.value, p.half_width, p.excited);
    if (!p.excited)
      not_excited += (not_excited.empty() ? "" : " ") + std::string(to_string(parameter));
  }
  std::cout << std::setprecision(3) << "force_residual_mps2: " << found.force_residual_rms << '\n'
            << "angular_acceleration_residual_radps2: " << found.angular_acceleration_residual_rms
            << '\n'
            << "servo_rate_limited_fraction: " << found.rate_limited_fraction << '\n'
            << "not_excited: " << (not_excited.empty() ? "none" : not_excited) << '\n';
}

void write_fit(const std::vector<IdentificationSample>& samples, const std::string& directory) {
  std::vector<std::string> names = {"time_s"};
  for (const char* name : {"specific_force_mps2", "fitted_specific_force_mps2",
                           "angular_acceleration_radps2", "fitted_angular_acceleration_radps2"})
    for (const char* axis : {"_x", "_y", "_z"}) names.push_back(std::string(name) + axis);
  examples::MissionLog file(directory + "/identify_vehicle.csv", names);
  for (const IdentificationSample& s : samples)
    file.add(s.time)
        .add_all(s.specific_force)
        .add_all(s.fitted_specific_force)
        .add_all(s.angular_acceleration)
        .add_all(s.fitted_angular_acceleration)
        .end_row();
}

template <int Rotors>
VehicleLog<Rotors> read_log(const Options& o, const Vehicle<Rotors>& vehicle) {
  if (!examples::is_ulog(o.input))
    return examples::read_identification_log<Rotors>(o.input, o.from, o.until);
  const examples::Ulog log(o.input);
  const std::string poses = o.pose_topic.empty() ? examples::px4_pose_topic(log) : o.pose_topic;
  for (const std::string& note : log.notes()) std::cerr << note << '\n';
  std::cerr << o.input << ": poses are those of " << poses << '\n';
  return examples::px4_vehicle_log<Rotors>(log, vehicle, poses, o.thrust_model_factor, o.from,
                                           o.until);
}

/// Throws InputFileError if the measured speed of a rotor follows the command of another.
template <int Rotors>
void check_rotor_order(const Options& o, const VehicleLog<Rotors>& log) {
  // Sums of squared differences of measured (row) and commanded speeds (column) from their means.
  Eigen::Matrix<double, Rotors, Rotors> apart = Eigen::Matrix<double, Rotors, Rotors>::Zero();
  Eigen::Matrix<double, Rotors, 1> offset = Eigen::Matrix<double, Rotors, 1>::Zero();
  for (const bool first : {true, false}) {
    std::size_t next = 0;
    for (const auto& measured : log.rotor_speeds) {
      while (next < log.commands.size() && log.commands[next].time <= measured.time) ++next;
      if (next == 0) continue;
      const auto& command = log.commands[next - 1].value.rotor_speed;
      if (first)
        offset += (measured.value - command) / static_cast<double>(log.rotor_speeds.size());
      else
        for (int i = 0; i < Rotors; ++i)
          apart.row(i).array() +=
              (measured.value(i) - command.array().transpose() - offset.transpose().array())
                  .square();
    }
  }
  for (int i = 0; i < Rotors; ++i) {
    Eigen::Index nearest = 0;
    apart.row(i).minCoeff(&nearest);
    if (4.0 * apart(i, nearest) < apart(i, i))
      throw InputFileError(o.input + ": the measured speed of rotor " + std::to_string(i + 1) +
                           " follows the command of rotor " + std::to_string(nearest + 1));
  }
}

template <int Rotors>
int identify(const Options& o, examples::VehicleFile file, const Vehicle<Rotors>& given) {
  VehicleIdentificationSettings settings;
  settings.trusted = o.trust == "mass" ? TrustedScale::mass : TrustedScale::thrust_coefficient;
  settings.imu_position << o.imu_position[0], o.imu_position[1], o.imu_position[2];
  const auto stands = undercarriage(given);
  if (!std::isnan(o.min_height))
    settings.min_height = o.min_height;
  else if (stands)
    settings.min_height = stands->height + 0.1;
  const VehicleLog<Rotors> log = read_log(o, given);
  check_rotor_order(o, log);
  const VehicleIdentification<Rotors> found = identify_vehicle(log, given, settings);
  std::cout << "status: " << to_string(found.status) << '\n'
            << "duration_s: " << std::fixed << std::setprecision(2) << found.duration << '\n'
            << std::defaultfloat;
  const bool is_fitted = found.status > VehicleIdentificationStatus::no_convergence;
  if (is_fitted) print(found, o);
  if (found.status != VehicleIdentificationStatus::identified)
    throw std::runtime_error(o.input + ": " + to_string(found.status));
  print(found, o);
  if (found.rate_limited_fraction > 0.0)
    std::cerr << "identify_vehicle: the servos reached the rate limit of the vehicle file; the "
                 "model contains it, and it has to be right.\n";

  std::filesystem::create_directories(o.output);
  write_fit(found.samples, o.output);
  // Limits that were the defaults of the given vehicle become those of the identified one.
  const NmpcBounds before = nmpc_settings(given).problem.bounds;
  const NmpcBounds after = nmpc_settings(found.vehicle).problem.bounds;
  for (auto limit : {&NmpcBounds::force_min, &NmpcBounds::force_max, &NmpcBounds::torque_min,
                     &NmpcBounds::torque_max, &NmpcBounds::force_rate, &NmpcBounds::torque_rate})
    if ((file.limits.*limit).isApprox(before.*limit, 1e-9)) file.limits.*limit = after.*limit;
  file.vehicle = found.vehicle;
  const std::string path = o.output + "/identified_vehicle.json";
  examples::write_vehicle(file, path);
  std::cout << "fly with it: hybrid_mission --vehicle " << path << std::endl;
  if (!o.no_pictures) examples::draw_pictures("tools/identify_vehicle.gp", o.output);
  return 0;
}

constexpr const char* footer = R"(
The log is a CSV file with one row per IMU sample, 100 Hz or more. hybrid_mission --excite --log-imu
FILE writes such a log and shows the columns:
  time_s                                  time of the IMU sample
  angular_velocity_radps_x, _y, _z        gyroscope, body frame
  specific_force_mps2_x, _y, _z           accelerometer, body frame
  pose_time_s, position_m_x, _y, _z,      last pose of the body frame of the vehicle file, and the
  orientation_w, _x, _y, _z               time at which it was taken, on the clock of the IMU
  rotor_command_radps_1, ...              speeds and angles that are commanded from this row on
  tilt_command_rad_1, ...
  rotor_speed_time_s,                     last measured speeds and their time; optional, all or none
  rotor_speed_radps_1, ...

A log of PX4 (ULog, .ulg) of a flight with px4_node is read, too: sensor_combined, actuator_motors and
actuator_servos (channel i is rotor i), esc_status if it is there, and the poses of --pose-topic or as
replay_flight chooses them. The vehicle file must have the limits that scaled the outputs.

Files in the output directory: identified_vehicle.json, identify_vehicle.csv (measured and fitted
specific force and angular acceleration) and identify_vehicle.png.

The body frame of the new vehicle file has its origin at the identified CoM, com_x_m, com_y_m,
com_z_m in the frame of the given file. What the flight did not excite keeps the given value and is
marked.

Exit code: 0 identified, 2 the log does not determine the vehicle or a file could not be read or
written, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Identifies a vehicle from the log of one flight."};
  Options o;
  app.add_option("LOG.csv", o.input, "log of a flight that excites all axes, or LOG.ulg of PX4")
      ->required();
  app.add_option("--vehicle", o.vehicle_path,
                 "JSON file of the vehicle as far as it is known: geometry, mass, first guesses; "
                 "default: the Tilt-Ropter");
  app.add_option("--trust", o.trust,
                 "what is known exactly, as a flight shows only the ratio: mass (from a scale) or "
                 "thrust (from a thrust stand)")
      ->check(CLI::IsMember({"mass", "thrust"}))
      ->capture_default_str();
  app.add_option("--imu-position", o.imu_position,
                 "position of the IMU in the body frame of the vehicle file [m]")
      ->check(CLI::Range(-10.0, 10.0));
  app.add_option("--pose-topic", o.pose_topic,
                 "topic of LOG.ulg with the poses, NAME or NAME:INSTANCE");
  app.add_option("--thrust-model-factor", o.thrust_model_factor,
                 "of the motor outputs in LOG.ulg, as the parameter of px4_node")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  app.add_option("--from", o.from, "begin of the part of the log to use [s]");
  app.add_option("--until", o.until, "end of the part of the log to use [s]");
  app.add_option("--min-height", o.min_height,
                 "use only parts above this height; default: 0.1 m above standing, with wheels or "
                 "legs [m]")
      ->check(CLI::Range(-1e4, 1e4));
  app.add_option("-o,--output", o.output, "directory for vehicle file, fit and picture")
      ->capture_default_str();
  app.add_flag("--no-pictures", o.no_pictures, "draw no picture");
  app.footer(footer);
  return examples::run_program(
      app, "identify_vehicle", argc, argv,
      [&o] {
        const examples::VehicleFile file = examples::vehicle_or_default(o.vehicle_path);
        return std::visit(
            [&](const auto& vehicle) -> int {
              if constexpr (examples::HasWrenchLevel<std::decay_t<decltype(vehicle)>>::value)
                return identify(o, file, vehicle);
              else
                throw examples::VehicleFileError(file.name +
                                                 ": this program needs 4, 6 or 8 rotors");
            },
            file.vehicle);
      },
      2);
}
