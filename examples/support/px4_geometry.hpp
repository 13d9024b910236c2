#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/SVD>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

/// The vehicle as PX4's own control allocation describes it.
namespace examples {

struct Px4Parameters {
  std::vector<std::pair<std::string, double>> values;  ///< name and value, in the order to set them
  std::vector<std::string> warnings;
};

namespace detail {

// Torques about x, y, z (FRD) of upright rotors with a thrust of one each, as columns.
template <int Rotors>
Eigen::Matrix<double, 3, Rotors> upright_torques(const tilt_ropter::Vehicle<Rotors>& vehicle) {
  Eigen::Matrix<double, 3, Rotors> torques;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const tilt_ropter::RotorGeometry& rotor = vehicle.rotors[i];
    const Eigen::Vector3d axis = rotor.orientation.col(2);
    const double spin = rotor.spin == tilt_ropter::Spin::counter_clockwise ? 1.0 : -1.0;
    torques.col(static_cast<Eigen::Index>(i)) =
        rotor.position.cross(axis) -
        spin * rotor_parameters(vehicle, i).torque_ratio * axis;  // reaction
  }
  return torques;
}

// Whether upright rotors turn the vehicle about axis k without a change of lift, roll and pitch.
template <int Rotors>
bool turns(const Eigen::Matrix<double, 3, Rotors>& torques, int k) {
  Eigen::MatrixXd others = Eigen::MatrixXd::Zero(Rotors, 3);
  others.col(0).setOnes();
  for (int i = 0; i < 2; ++i)
    if (i != k) others.col(i + 1) = torques.row(i).transpose();
  const Eigen::VectorXd row = torques.row(k).transpose();
  const Eigen::JacobiSVD<Eigen::MatrixXd> svd(others, Eigen::ComputeThinU | Eigen::ComputeThinV);
  return row.norm() > 1e-6 && (row - others * svd.solve(row)).norm() > 1e-3 * row.norm();
}

}  // namespace detail

/// Returns the parameters of PX4 for `vehicle`: geometry (CA_*), functions of the first outputs of
/// the main port, thrust in hover, and failsafe. Rotors are motors in the order of the vehicle,
/// tilting rotors are servos in the same order. PX4's own modes keep all rotors upright, but for
/// axes about which upright rotors do not turn the vehicle.
template <int Rotors>
[[nodiscard]] Px4Parameters px4_parameters(const tilt_ropter::Vehicle<Rotors>& vehicle) {
  using namespace tilt_ropter;
  constexpr int most_tilts = 4;
  constexpr double degree = pi / 180.0;
  Px4Parameters result;
  const auto set = [&result](const std::string& name, double value) {
    result.values.emplace_back(name, value);
  };
  const int tilts = servo_count(vehicle);
  const bool has_tilts = tilts > 0 && tilts <= most_tilts;
  set("CA_AIRFRAME", has_tilts ? 8 : 0);
  set("CA_ROTOR_COUNT", Rotors);
  const Eigen::Vector3d frd(1.0, -1.0, -1.0);
  int servo = 0;
  double lift = 0.0;  // of upright rotors [N]
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[i];
    const RotorParameters& p = rotor_parameters(vehicle, i);
    const std::string name = "CA_ROTOR" + std::to_string(i) + "_";
    const Eigen::Vector3d position = frd.cwiseProduct(rotor.position),
                          axis = frd.cwiseProduct(rotor.orientation.col(2));
    const auto components = [&](const char* letter, const Eigen::Vector3d& v) {
      for (int k = 0; k < 3; ++k) set(name + letter + "XYZ"[k], v(k));
    };
    components("P", position);
    components("A", axis);
    set(name + "CT", std::min(100.0, p.max_thrust * rotor.effectiveness));
    set(name + "KM", rotor.spin == Spin::counter_clockwise ? p.torque_ratio : -p.torque_ratio);
    set(name + "TILT", has_tilts && rotor.tilts ? ++servo : 0);
    lift += p.max_thrust * rotor.effectiveness * std::max(0.0, rotor.orientation(2, 2));
  }
  if (tilts > most_tilts)
    result.warnings.push_back("PX4 knows " + std::to_string(most_tilts) +
                              " tilt servos, this vehicle has " + std::to_string(tilts) +
                              ": PX4's own modes leave them where they are");
  const auto torques = detail::upright_torques(vehicle);
  const bool pitches = detail::turns<Rotors>(torques, 1), yaws = detail::turns<Rotors>(torques, 2);
  if (!detail::turns<Rotors>(torques, 0))
    result.warnings.emplace_back("upright rotors give no roll: PX4's own modes cannot fly it");
  set("CA_SV_TL_COUNT", has_tilts ? tilts : 0);
  const double low = vehicle.servo.min_angle / degree, high = vehicle.servo.max_angle / degree;
  const bool fits = low >= -90.0 && high <= 90.0;
  const int control = (yaws ? 0 : 1) + (pitches ? 0 : 2);
  servo = 0;
  for (std::size_t i = 0; has_tilts && i < Rotors; ++i) {
    if (!vehicle.rotors[i].tilts) continue;
    const std::string name = "CA_SV_TL" + std::to_string(servo++) + "_";
    // At a positive angle the thrust leans towards -y of the rotor.
    const Eigen::Vector3d towards = -frd.cwiseProduct(vehicle.rotors[i].orientation.col(1));
    const double direction = std::atan2(towards.y(), towards.x()) / degree;
    set(name + "CT", fits ? control : 0);
    set(name + "MINA", fits ? low : -90.0);
    set(name + "MAXA", fits ? high : 90.0);
    set(name + "TD", std::fmod(std::round(direction) + 360.0, 360.0));
  }
  if (has_tilts && !fits)
    result.warnings.emplace_back(
        "the servos turn farther than PX4's 90 deg: its own modes do not move them" +
        std::string(control > 0 ? ", and cannot fly the vehicle without them" : ""));
  for (int i = 0; i < Rotors; ++i) set("PWM_MAIN_FUNC" + std::to_string(i + 1), 101 + i);
  for (int i = 0; i < tilts; ++i) set("PWM_MAIN_FUNC" + std::to_string(Rotors + i + 1), 201 + i);
  if (Rotors + tilts > 8)
    result.warnings.push_back(std::to_string(Rotors + tilts) +
                              " outputs: a main port has 8 or more; move the rest to PWM_AUX_FUNC");
  // PX4's own modes take over with this thrust.
  if (lift > 0.0) set("MPC_THR_HOVER", std::clamp(vehicle.body.mass * gravity / lift, 0.1, 0.8));
  set("COM_OF_LOSS_T", 0.5);
  set("COM_OBL_RC_ACT", 4);
  set("NAV_RCL_ACT", 3);
  set("UXRCE_DDS_SYNCT", 1);
  return result;
}

}  // namespace examples
