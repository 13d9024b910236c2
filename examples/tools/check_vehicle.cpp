// Checks a vehicle before it flies: the forces and torques of its actuators, intact and with each
// rotor lost; which control level suits it and what it cannot do; whether propellers touch
// something; whether limits and mission fit the actuators; how long the battery lasts. Then it
// flies the mission in simulation.

#include "../support/mission_log.hpp"
#include "../support/pictures.hpp"
#include "../support/propeller_clearance.hpp"
#include "../support/run_program.hpp"
#include "../support/simulated_mission.hpp"
#include "../support/solver_choice.hpp"
#include "../support/steady_flight.hpp"
#include "../support/vehicle_check.hpp"
#include "../support/vehicle_choice.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <optional>
#include <sstream>
#include <string>
#include <variant>
#include <vector>

using namespace tilt_ropter;

namespace {

struct Options {
  std::string input, output = "results", solver = "automatic";
  double usable = 0.8;
  bool no_pictures = false, no_flight = false;
};

constexpr std::array<const char*, 6> axes = {"F_x", "F_y", "F_z", "M_x", "M_y", "M_z"};

constexpr std::array<const char*, 3> turn = {"roll", "pitch", "yaw"};

/// Collects errors and warnings.
class Findings {
 public:
  void error(const std::string& text) { add("error", text, errors_); }
  void warning(const std::string& text) { add("warning", text, warnings_); }
  /// What the vehicle cannot do, although it flies.
  void limitation(const std::string& text) { add("limitation", text, limitations_); }

  /// `flown`: the simulated mission was flown.
  void print(bool flown) const {
    for (const std::string& line : lines_) std::cout << line << '\n';
    const char* good = flown ? "flies" : "no error found, but not flown";
    std::cout << "errors: " << errors_ << "\nwarnings: " << warnings_
              << "\nlimitations: " << limitations_
              << "\nverdict: " << (errors_ > 0 ? "does not fly" : good) << '\n';
  }
  [[nodiscard]] bool any_error() const { return errors_ > 0; }

 private:
  void add(const std::string& kind, const std::string& text, int& count) {
    lines_.push_back(kind + ": " + text);
    ++count;
  }

  std::vector<std::string> lines_;
  int errors_ = 0, warnings_ = 0, limitations_ = 0;
};

/// Returns a number with three significant digits, and at least all digits before the point.
std::string digits(double value) {
  std::ostringstream text;
  const bool large = std::abs(value) >= 1000.0 && std::isfinite(value);
  text << std::setprecision(3)
       << (std::abs(value) < 1e-9 ? 0.0
           : large                ? std::round(value)
                                  : value);
  if (!large) return text.str();
  return std::to_string(std::lround(value));
}

void line(const std::string& key, double value) {
  std::cout << key << ": " << digits(value) << '\n';
}

template <int Rotors>
Wrenchd weight_of(const Vehicle<Rotors>& vehicle) {
  Wrenchd wrench;
  wrench.force.z() = vehicle.body.mass * gravity;
  return wrench;
}

/// Returns false if a tilting arm has almost no thrust in level hover. To reverse its force such an
/// arm must turn by half a revolution; the vehicle must lean instead.
template <int Rotors>
bool is_level(const Vehicle<Rotors>& vehicle, const ControlAuthority& authority) {
  const double lift = vehicle.body.mass * gravity / Rotors;
  for (std::size_t i = 0; i < Rotors; ++i)
    if (vehicle.rotors[i].tilts &&
        authority.least_thrust < rotor_parameters(vehicle, i).min_thrust + 0.05 * lift)
      return false;
  return authority.hovers;
}

/// Writes envelope.csv: the largest force without torque and the largest torque in hover, in
/// directions of the coordinate planes.
template <int Rotors>
void write_envelope(const Vehicle<Rotors>& vehicle, const NmpcBounds& limits,
                    const std::string& path) {
  const Allocation<Rotors> allocation(vehicle);
  const Wrenchd hover = weight_of(vehicle);
  const double most = 2.0 * Rotors * largest_max_thrust(vehicle);
  examples::MissionLog log(
      path, {"plane", "angle_rad", "force_a_n", "force_b_n", "torque_a_nm", "torque_b_nm",
             "force_a_min_n", "force_a_max_n", "force_b_min_n", "force_b_max_n", "torque_a_min_nm",
             "torque_a_max_nm", "torque_b_min_nm", "torque_b_max_nm"});
  for (int plane = 0; plane < 3; ++plane) {
    const int a = plane == 2 ? 1 : 0, b = plane == 0 ? 1 : 2;  // xy, xz, yz
    for (int i = 0; i <= 120; ++i) {
      const double angle = 2.0 * pi * i / 120;
      Wrenchd force, torque;
      force.force(a) = torque.torque(a) = std::cos(angle);
      force.force(b) = torque.torque(b) = std::sin(angle);
      constexpr double accuracy = 1e-5;  // a picture shows no more
      const double f = reach(allocation, hover, force, most, accuracy),
                   m = reach(allocation, hover, torque, most * size_of(vehicle), accuracy);
      log.add(plane).add(angle);
      log.add(hover.force(a) + f * force.force(a)).add(hover.force(b) + f * force.force(b));
      log.add(m * torque.torque(a)).add(m * torque.torque(b));
      log.add(limits.force_min(a)).add(limits.force_max(a));
      log.add(limits.force_min(b)).add(limits.force_max(b));
      log.add(limits.torque_min(a)).add(limits.torque_max(a));
      log.add(limits.torque_min(b)).add(limits.torque_max(b));
      log.end_row();
    }
  }
}

/// Warns of limits that exceed what the actuators give in addition to hover.
void compare(const NmpcBounds& limits, const ControlAuthority& authority, double weight,
             Findings& findings) {
  const auto wider = [&](const std::string& field, double limit, double given) {
    if (std::abs(limit) > std::abs(given) + 1e-9)
      findings.warning("limits." + field + " = " + digits(limit) +
                       " is more than the actuators give in hover, " + digits(given));
  };
  for (Eigen::Index i = 0; i < 3; ++i) {
    const std::string at = '[' + std::to_string(i) + ']';
    const double hover = i == 2 ? weight : 0.0;
    wider("force_max_n" + at, limits.force_max(i), hover + authority.forward(i));
    if (limits.force_min(i) < 0.0)
      wider("force_min_n" + at, limits.force_min(i), hover - authority.backward(i));
    wider("torque_max_nm" + at, limits.torque_max(i), authority.forward(3 + i));
    wider("torque_min_nm" + at, limits.torque_min(i), -authority.backward(3 + i));
  }
}

/// Warns if the mission exceeds the limits or the actuators.
template <int Rotors>
void check_mission(const examples::VehicleFile& file, const Vehicle<Rotors>& vehicle,
                   Findings& findings) {
  const Mission mission = hybrid_mission(vehicle);
  const NmpcSettings settings = file.settings();
  for (const BoundViolation& v :
       check_reference(mission, mission.start_time(), mission.end_time(), vehicle, settings))
    findings.warning("the mission asks for " + std::string(v.bound) + '[' + std::to_string(v.axis) +
                     "] = " + digits(v.required) + " at " + digits(v.time) +
                     " s, the limits allow " + digits(v.allowed));
  const Allocation<Rotors> allocation(vehicle);
  for (double time = mission.start_time(); time < mission.end_time(); time += 0.05) {
    const ReferencePoint p = mission(time);
    const MissionPhase phase = mission.phase(time);
    if (phase == MissionPhase::rest || phase == MissionPhase::ground) continue;
    const Eigen::Vector3d& w = p.angular_velocity;
    Wrenchd wrench;
    wrench.force = vehicle.body.mass * (p.orientation.conjugate() *
                                        (p.acceleration + Eigen::Vector3d(0.0, 0.0, gravity)));
    wrench.torque =
        vehicle.body.inertia * p.angular_acceleration + w.cross(vehicle.body.inertia * w);
    if (allocation.allocate(wrench, {}).status != AllocationStatus::limited) continue;
    findings.warning("the mission asks for more than the actuators give, first at " + digits(time) +
                     " s");
    return;
  }
}

/// Prints one line for each lost rotor.
template <int Rotors>
void print_losses(const Vehicle<Rotors>& vehicle) {
  std::cout << "\nwith a rotor lost, at rest:\nrotor  rank  condition  hovers  level  least thrust "
               "[N]  torque left in hover, least of +- [N m]\n";
  for (std::size_t i = 0; i < Rotors; ++i) {
    const ControlAuthority left = control_authority(with_weak_rotor(vehicle, i, 0.0));
    const auto turns = [&](Eigen::Index axis) {
      return std::min(left.forward(axis), left.backward(axis)) > examples::least_torque(vehicle);
    };
    const bool hovers = left.hovers && turns(3) && turns(4);  // it cannot stay upright otherwise
    std::cout << std::setw(5) << i + 1 << std::setw(6) << left.rank << std::setw(11)
              << digits(left.condition) << std::setw(8) << (hovers ? "yes" : "no") << std::setw(7)
              << (is_level(vehicle, left) ? "yes" : "no") << std::setw(18)
              << digits(left.least_thrust) << ' ';
    for (Eigen::Index axis = 3; axis < 6; ++axis)
      std::cout << ' ' << axes[static_cast<std::size_t>(axis)] << ' '
                << digits(std::min(left.forward(axis), left.backward(axis)));
    std::cout << '\n';
  }
  std::cout << "(not level: a tilting arm would have almost no thrust, and the vehicle must "
               "lean)\n\n";
}

/// Prints the distances of the propellers, and reports propellers that touch something.
template <int Rotors>
void check_propellers(const Vehicle<Rotors>& vehicle, Findings& findings) {
  constexpr double narrow = 0.005;  // [m]
  const examples::PropellerClearance clearance = examples::propeller_clearance(vehicle);
  bool known = true;
  for (std::size_t i = 0; i < Rotors; ++i)
    known = known && rotor_parameters(vehicle, i).propeller_radius > 0.0;
  if (!known) {
    std::cout << "propellers: not checked, the file has no rotor.propeller_radius_m\n";
    return;
  }
  const auto part = [&](const char* key, const char* name, double distance) {
    if (std::isinf(distance)) return;
    line(std::string("propeller_to_") + key + "_m", distance);
    if (!(distance > 0.0))
      findings.error(std::string("a propeller touches ") + name + " at a tilt angle of its range");
    else if (distance < narrow)
      findings.warning(std::string("a propeller passes ") + name + " at a distance of " +
                       digits(1e3 * distance) + " mm");
  };
  part("wheel", "a wheel", clearance.wheel);
  part("ground", "the ground", clearance.ground);
  part("propeller", "another propeller", clearance.propeller);
}

/// Prints current, voltage and sag of the battery at `power` [W], and the time in minutes for which
/// it lasts. The load is that of the full battery, and of the battery at the end.
void print_load(const std::string& name, const BatteryParameters& parameters, double power,
                double usable) {
  const Battery full(parameters), used(parameters, 1.0 - usable);
  const BatteryLoad load = full.load(power), at_end = used.load(power);
  line(name + "_current_a", load.current);
  line(name + "_voltage_v", load.voltage);
  line(name + "_sag_v", full.open_circuit_voltage() - load.voltage);
  line(name + "_end_current_a", at_end.current);
  line(name + "_end_voltage_v", at_end.voltage);
  line(name + "_min", full.endurance(power, 1.0 - usable) / 60.0);
}

/// Compares the battery at the end of its usable charge with hover and full thrust.
template <int Rotors>
void check_battery(const Vehicle<Rotors>& vehicle, double full_thrust, double usable,
                   Findings& findings) {
  const Battery used(vehicle.battery, 1.0 - usable);
  const std::string left = digits(100.0 * used.state_of_charge()) + " % charge";
  const BatteryLoad hover = used.load(vehicle.power.hover);
  if (hover.status == BatteryStatus::overloaded) {
    findings.error("the battery does not give the power of hover at " + left);
    return;
  }
  if (used.max_power() < full_thrust)
    findings.warning("the battery gives " + digits(used.max_power()) + " W at " + left +
                     ", full thrust takes " + digits(full_thrust) + " W");
  const std::optional<double> ratio = voltage_ratio(vehicle.battery, hover.voltage);
  if (!ratio) return;
  double lift = 0.0;
  for (std::size_t i = 0; i < Rotors; ++i)
    lift += vehicle.rotors[i].effectiveness * max_thrust_at(rotor_parameters(vehicle, i), *ratio);
  line("end_thrust_per_weight", lift / (vehicle.body.mass * gravity));
}

/// `driving` is the power on the ground at rest [W].
template <int Rotors>
void print_endurance(const examples::VehicleFile& file, const Vehicle<Rotors>& vehicle,
                     const PowerModel& power, double driving, double usable, Findings& findings) {
  line("hover_power_w", vehicle.power.hover);
  if (vehicle.wheels) line("driving_power_w", driving);
  Eigen::Matrix<double, Rotors, 1> top;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorParameters& rotor = rotor_parameters(vehicle, i);
    top(static_cast<Eigen::Index>(i)) = speed_from_thrust(rotor.max_thrust, rotor);
  }
  const double full_thrust = power.power(top);
  line("full_thrust_power_w", full_thrust);
  const BatteryParameters& battery = vehicle.battery;
  if (is_known(battery)) {
    line("battery_energy_wh", Battery(battery).energy() / 3600.0);
    print_load("hover", battery, vehicle.power.hover, usable);
    if (vehicle.wheels) print_load("driving", battery, driving, usable);
    check_battery(vehicle, full_thrust, usable, findings);
    return;
  }
  if (!(file.battery_wh > 0.0)) {
    std::cout << "hover_min: not known, the file has no battery_capacity_ah and no battery_wh\n";
    return;
  }
  line("hover_min", 60.0 * usable * file.battery_wh / vehicle.power.hover);
  if (vehicle.wheels) line("driving_min", 60.0 * usable * file.battery_wh / driving);
}

/// Flies the mission in simulation, with wrong mass and inertia, noise and delays, and reports what
/// went wrong.
void fly(const Options& options, const examples::VehicleFile& file, Findings& findings) {
  constexpr double good = 0.05, bad = 0.3;  // RMSE [m]
  constexpr double soft = 0.6, hard = 1.5;  // touchdown [m/s]
  examples::MissionOptions mission;
  mission.vehicle_path = options.input;
  mission.no_log = mission.stop_at_loss = true;
  mission.solver = options.solver;
  const examples::FlownMission flown =
      examples::fly_simulated(mission, file, [](double, MissionPhase) {});
  const examples::MissionFigures& figures = flown.figures;
  const auto tracking = [&](const std::string& where, const examples::TrackingError& error) {
    if (error.count() == 0) return;
    line("flown_" + where + "_rmse_m", error.value());
    const std::string text = "the simulated mission tracks with an RMSE of " +
                             digits(1e3 * error.value()) + " mm, part: " + where;
    if (!(error.value() < bad))
      findings.error(text);
    else if (error.value() > good)
      findings.warning(text);
  };
  tracking("air", figures.air());
  tracking("ground", figures.ground());
  tracking("mission", figures.all());
  if (file.undercarriage()) line("flown_touchdown_mps", figures.touchdown_speed());
  line("flown_lean_max_deg", flown.lean * 180.0 / pi);
  flown.solver.print(std::cout);
  if (!(figures.touchdown_speed() < hard))
    findings.error("it touches down with " + digits(figures.touchdown_speed()) + " m/s");
  else if (figures.touchdown_speed() > soft)
    findings.warning("it touches down with " + digits(figures.touchdown_speed()) + " m/s");
  if (!flown.loss.empty())
    findings.error("in the simulated mission " + flown.loss +
                   "; likely reason: " + flown.loss_reason);
  if (figures.failures() > 0)
    findings.warning(std::to_string(figures.failures()) + " ticks had no plan in the mission");
}

/// Checks at the actuator level, for a vehicle of any rank.
template <int Rotors>
bool check_actuators(const Options& options, const examples::VehicleFile& file,
                     const Vehicle<Rotors>& vehicle, Findings& findings) {
  const examples::SteadyFlight<Rotors> steady = examples::steady_flight(vehicle);
  std::cout << "hovers: " << (steady.hovers ? "yes" : "no") << '\n';
  for (std::size_t i = 0; i < 3; ++i)
    if (!steady.turns[i]) findings.error(std::string("it cannot ") + turn[i] + " while it hovers");
  check_propellers(vehicle, findings);
  if (!steady.hovers) {
    findings.error("the rotors do not carry the weight without torque");
    return false;
  }
  line("lift_per_weight", steady.lift_per_weight);
  line("least_thrust_in_hover_n", steady.least_thrust);
  if (steady.lean > 0.01)
    findings.limitation("it cannot hover level: it leans by " + digits(steady.lean * 180.0 / pi) +
                        " deg");
  if (!steady.pushes[0]) findings.limitation("it leans to accelerate forward");
  if (!steady.pushes[1]) findings.limitation("it leans to accelerate sideways");
  if (!steady.pushes[0] || !steady.pushes[1])
    findings.limitation("roll and pitch follow from the motion, it cannot choose them");
  if (steady.lift_per_weight < 1.1)
    findings.error("the lift beyond hover is less than a tenth of the weight");
  else if (steady.lift_per_weight < 1.5)
    findings.warning("lift of less than 1.5 times the weight: slow recovery from a descent");
  const PowerModel power(vehicle, steady.hover.rotor_speed);
  const double share = examples::actuator_level_settings(file, vehicle).ground.down_force /
                       (vehicle.body.mass * gravity);
  const double driving = power.power((std::sqrt(share) * steady.hover.rotor_speed).eval());
  print_endurance(file, vehicle, power, driving, options.usable, findings);
  return true;
}

/// Checks at the wrench level.
template <int Rotors>
bool check_wrench(const Options& options, const examples::VehicleFile& file,
                  const Vehicle<Rotors>& vehicle, Findings& findings) {
  const double weight = vehicle.body.mass * gravity;
  const ControlAuthority authority = control_authority(vehicle);
  std::cout << "hovers: " << (authority.hovers ? "yes" : "no") << '\n';
  line("lift_per_weight", 1.0 + authority.forward(2) / weight);
  line("least_thrust_in_hover_n", authority.least_thrust);
  for (std::size_t i = 0; i < 6; ++i) {
    const auto axis = static_cast<Eigen::Index>(i);
    std::cout << axes[i] << "_on_top_of_hover: +" << digits(authority.forward(axis)) << " -"
              << digits(authority.backward(axis)) << (i < 3 ? " N\n" : " N m\n");
  }
  check_propellers(vehicle, findings);
  if (!authority.hovers) {
    findings.error("the rotors do not carry the weight in level attitude without torque");
  } else {
    for (Eigen::Index i = 3; i < 6; ++i)
      if (!(std::min(authority.forward(i), authority.backward(i)) >
            examples::least_torque(vehicle)))
        findings.error(std::string("it cannot ") + turn[static_cast<std::size_t>(i) - 3] +
                       " while it hovers");
    if (authority.forward(2) < 0.1 * weight)
      findings.error("the lift beyond hover is less than a tenth of the weight");
    else if (authority.forward(2) < 0.5 * weight)
      findings.warning("lift of less than 1.5 times the weight: slow recovery from a descent");
    if (!is_level(vehicle, authority))
      findings.warning(
          "an arm has almost no thrust in hover: to reverse its force it must first turn by "
          "half a revolution");
    compare(file.limits, authority, weight, findings);
    check_mission(file, vehicle, findings);
  }
  if (authority.condition > 20.0)
    findings.warning(
        "condition of the allocation above 20: some wrenches need 20 times the thrust "
        "of others");
  print_losses(vehicle);
  if (authority.hovers) {
    const Allocation<Rotors> allocation(vehicle);
    const PowerModel power(vehicle,
                           allocation.allocate(weight_of(vehicle), {}).command.rotor_speed);
    Wrenchd pressed;
    pressed.force.z() = file.settings().ground.down_force;
    const double driving = power.power(allocation.allocate(pressed, {}).command.rotor_speed);
    print_endurance(file, vehicle, power, driving, options.usable, findings);
    std::filesystem::create_directories(options.output);
    write_envelope(vehicle, file.limits, options.output + "/envelope.csv");
  }
  return authority.hovers;
}

struct Verdict {
  bool flies = false, has_envelope = false;
};

template <int Rotors>
Verdict check(const Options& options, const examples::VehicleFile& file,
              const Vehicle<Rotors>& vehicle) {
  Findings findings;
  const auto singular = AllocationMatrix<Rotors>::singular_values(vehicle);
  const int rank = allocation_rank(vehicle);
  std::cout << "name: " << file.name << "\nrotors: " << Rotors << '\n';
  line("weight_n", vehicle.body.mass * gravity);
  line("rank", rank);
  if (rank == 6) line("condition", singular(0) / singular(5));
  const std::string reason = examples::reason_against_wrench_level(file);
  std::cout << "level: " << examples::level_for("", file) << '\n';
  for (const examples::VehicleFinding& found : examples::file_findings(file))
    found.is_error ? findings.error(found.text) : findings.warning(found.text);
  if (!reason.empty()) findings.limitation("no control at the wrench level: " + reason);
  bool hovers = false, has_envelope = false;
  if constexpr (examples::has_wrench_level<Rotors>) {
    has_envelope = reason.empty();
    if (has_envelope) hovers = check_wrench(options, file, vehicle, findings);
  }
  if (!has_envelope) hovers = check_actuators(options, file, vehicle, findings);
  const bool flown = hovers && !findings.any_error() && !options.no_flight;
  if (flown) fly(options, file, findings);
  findings.print(flown);
  return {hovers && !findings.any_error(), has_envelope};
}

constexpr const char* footer = R"(
hybrid_mission --write-vehicle writes a vehicle file as a template. Files in the output directory:
envelope.csv and check_vehicle.png. They show the largest force without torque and the largest
torque in hover, in the planes of the body axes. A vehicle that does not give every wrench has
neither.

The level is that of hybrid_mission, and the mission that of hybrid_mission with its defaults.

Exit code: 0 the vehicle flies (with --no-flight: no error was found), 1 it does not fly or another
error, 2 an invalid vehicle file, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Checks a vehicle before it flies: force and torque of its actuators, intact and with a\n"
      "rotor lost; whether propellers touch something; whether limits and mission fit the\n"
      "actuators; how long the battery lasts; which control level suits it and what it cannot do.\n"
      "Then flies the hybrid mission in simulation: take-off, flight, landing, drive."};
  Options options;
  app.add_option("FILE.json", options.input, "JSON file of the vehicle; default: the Tilt-Ropter");
  app.add_option("-o,--output", options.output, "directory for the envelope and the picture")
      ->capture_default_str();
  app.add_option("--usable", options.usable, "usable fraction of the battery charge")
      ->check(CLI::Range(0.1, 1.0))
      ->capture_default_str();
  app.add_flag("--no-pictures", options.no_pictures, "write only the envelope");
  examples::add_solver_in_real_time(app, options.solver);
  app.add_flag("--no-flight", options.no_flight, "do not fly the mission in simulation");
  app.footer(footer);
  return examples::run_program(app, "check_vehicle", argc, argv, [&options] {
    const examples::VehicleFile file = examples::vehicle_or_default(options.input);
    const Verdict verdict = std::visit(
        [&](const auto& vehicle) { return check(options, file, vehicle); }, file.vehicle);
    if (verdict.flies && verdict.has_envelope && !options.no_pictures)
      examples::draw_pictures("tools/check_vehicle.gp", options.output);
    return verdict.flies ? 0 : 1;
  });
}
