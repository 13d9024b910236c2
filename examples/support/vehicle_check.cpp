#include "vehicle_check.hpp"

#include "steady_flight.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <sstream>
#include <string>
#include <variant>
#include <vector>

namespace examples {
namespace {

using namespace tilt_ropter;

std::string shown(double value) {
  std::ostringstream text;
  text.precision(3);
  text << value;
  return text.str();
}

template <int Rotors>
void check_places(const Vehicle<Rotors>& vehicle, std::vector<VehicleFinding>& findings) {
  constexpr double near = 0.01;  // [m]
  for (std::size_t i = 0; i < Rotors; ++i)
    for (std::size_t k = i + 1; k < Rotors; ++k) {
      const RotorGeometry &a = vehicle.rotors[i], &b = vehicle.rotors[k];
      if ((a.position - b.position).norm() < near)
        findings.push_back({true, "the rotors " + std::to_string(i + 1) + " and " +
                                      std::to_string(k + 1) + " are in one place"});
    }
}

template <int Rotors>
void check_spins(const Vehicle<Rotors>& vehicle, std::vector<VehicleFinding>& findings) {
  int lifting = 0, counter_clockwise = 0;
  for (const RotorGeometry& rotor : vehicle.rotors) {
    if (!(rotor.orientation(2, 2) > 0.5)) continue;
    ++lifting;
    if (rotor.spin == Spin::counter_clockwise) ++counter_clockwise;
  }
  if (lifting < 2 || (counter_clockwise > 0 && counter_clockwise < lifting)) return;
  const double torque = vehicle.body.mass * gravity * rotor_parameters(vehicle, 0).torque_ratio;
  findings.push_back({false,
                      "all rotors turn the same way: their torques cancel no yaw and add up "
                      "to " +
                          shown(torque) + " N m in hover"});
}

template <int Rotors>
void check_servo(const Vehicle<Rotors>& vehicle, std::vector<VehicleFinding>& findings) {
  constexpr double degree = pi / 180.0, narrow = 7.0 * degree;
  const bool tilts = std::any_of(vehicle.rotors.begin(), vehicle.rotors.end(),
                                 [](const RotorGeometry& rotor) { return rotor.tilts; });
  const double least = vehicle.servo.min_angle, most = vehicle.servo.max_angle;
  if (!tilts || most - least > 2.0 * narrow) return;
  findings.push_back({false, "servo.min_angle_deg = " + shown(least / degree) +
                                 " and max_angle_deg = " + shown(most / degree) +
                                 " look like radians: " + shown(least / degree / degree) + " to " +
                                 shown(most / degree / degree) + " degrees"});
}

/// Numbers that no vehicle has in the right units: the inertia beside mass and size; the thrust,
/// speed and torque of a rotor that carries its part of the weight. An ideal rotor needs the power
/// T^1.5 / sqrt(2 density area), and a real one two to three times as much.
template <int Rotors>
void check_units(const Vehicle<Rotors>& vehicle, std::vector<VehicleFinding>& findings) {
  const auto warn = [&findings](const std::string& text) {
    findings.push_back({false, text + ": is the unit right?"});
  };
  double size = 0.0;  // [m]
  const RotorParameters* rotor = nullptr;
  int lifting = 0;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorParameters& p = rotor_parameters(vehicle, i);
    size = std::max(size, vehicle.rotors[i].position.norm() + p.propeller_radius);
    if (!(vehicle.rotors[i].orientation(2, 2) > 0.5)) continue;
    ++lifting;
    if (rotor == nullptr) rotor = &p;
  }
  const Eigen::Vector3d spread = (vehicle.body.inertia.diagonal() / vehicle.body.mass).cwiseSqrt();
  if (!(spread.maxCoeff() <= 1.5 * size) || !(spread.minCoeff() >= 0.03 * size))
    warn("body.inertia_kg_m2 is that of a mass " + shown(spread.minCoeff()) + " to " +
         shown(spread.maxCoeff()) + " m from the axes, of a vehicle that reaches " + shown(size) +
         " m");
  if (rotor == nullptr) return;
  const double thrust = vehicle.body.mass * gravity / lifting;
  const double speed = speed_from_thrust(thrust, *rotor), radius = rotor->propeller_radius;
  if (rotor->max_thrust > 20.0 * thrust)
    warn("rotor.max_thrust_n is " + shown(rotor->max_thrust / thrust) + " times that of hover");
  if (radius > 0.0 && speed * radius > 300.0)
    warn("rotor.thrust_coefficient_n_s2_per_rad2: in hover the propeller tips move at " +
         shown(speed * radius) + " m/s");
  if (!(radius > 0.0) || !(rotor->torque_ratio > 0.0)) return;
  constexpr double density = 1.225;  // of air [kg/m^3]
  const double merit =
      std::sqrt(thrust / (2.0 * density * pi * radius * radius)) / (rotor->torque_ratio * speed);
  if (merit < 0.1 || merit > 1.0)
    warn("in hover a rotor turns at " + shown(speed) + " rad/s with " +
         shown(rotor->torque_ratio * thrust) + " N m, " + shown(1.0 / merit) +
         " times the power of an ideal one (thrust coefficient, torque ratio, propeller radius)");
}

template <int Rotors>
void check_hover(const VehicleFile& file, const Vehicle<Rotors>& vehicle,
                 std::vector<VehicleFinding>& findings) {
  bool hovers = false;
  std::array<bool, 3> turns = {true, true, true};
  if constexpr (has_wrench_level<Rotors>) {
    if (reason_against_wrench_level(file).empty()) {
      const ControlAuthority authority = control_authority(vehicle);
      hovers = authority.hovers;
      for (int i = 0; i < 3 && hovers; ++i)
        turns[static_cast<std::size_t>(i)] =
            std::min(authority.forward(3 + i), authority.backward(3 + i)) > least_torque(vehicle);
    }
  }
  if (!reason_against_wrench_level(file).empty()) {
    const SteadyFlight<Rotors> steady = steady_flight(vehicle);
    hovers = steady.hovers;
    turns = steady.turns;
  }
  constexpr std::array<const char*, 3> names = {"roll", "pitch", "yaw"};
  for (std::size_t i = 0; i < 3; ++i)
    if (!turns[i])
      findings.push_back({true, std::string("it cannot ") + names[i] + " while it hovers"});
  if (!hovers) findings.push_back({true, "the rotors do not carry the weight without torque"});
}

}  // namespace

std::vector<VehicleFinding> file_findings(const VehicleFile& file) {
  std::vector<VehicleFinding> findings;
  std::visit(
      [&findings](const auto& vehicle) {
        check_places(vehicle, findings);
        check_spins(vehicle, findings);
        check_servo(vehicle, findings);
        check_units(vehicle, findings);
      },
      file.vehicle);
  return findings;
}

std::vector<VehicleFinding> static_findings(const VehicleFile& file) {
  std::vector<VehicleFinding> findings = file_findings(file);
  std::visit([&](const auto& vehicle) { check_hover(file, vehicle, findings); }, file.vehicle);
  return findings;
}

}  // namespace examples
