#pragma once

#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>

/// Other vehicles than the Tilt-Ropter, to keep the model general.
namespace test_support {

/// Six tilting rotors on arms 60 degrees apart.
inline tilt_ropter::Vehicle<6> tilting_hexacopter() {
  using namespace tilt_ropter;
  Vehicle<6> v;
  for (std::size_t i = 0; i < 6; ++i)
    v.rotors[i] = rotor_on_arm(pi / 3.0 * static_cast<double>(i), 0.25,
                               i % 2 == 0 ? Spin::clockwise : Spin::counter_clockwise);
  v.rotor.max_thrust = 12.0;
  return v;
}

/// Eight rotors in the corners of a cube; no rotor tilts or reverses. The model follows D.
/// Brescianini and R. D'Andrea, "An omni-directional multirotor vehicle", 2018, with spin
/// directions such that equal thrusts cancel completely. Every wrench with thrusts >= 0 then needs
/// the null space.
inline tilt_ropter::Vehicle<8> omnidirectional_octocopter() {
  using namespace tilt_ropter;
  const double a = 0.5 + 1.0 / std::sqrt(12.0), b = 0.5 - 1.0 / std::sqrt(12.0),
               c = 1.0 / std::sqrt(3.0);
  Eigen::Matrix<double, 3, 8> axes, corners;
  axes << -a, b, -b, a, a, -b, b, -a,  //
      b, a, -a, -b, -b, -a, a, b,      //
      c, -c, -c, c, c, -c, -c, c;
  corners << 1, -1, 1, -1, 1, -1, 1, -1,  //
      1, 1, -1, -1, 1, 1, -1, -1,         //
      1, 1, 1, 1, -1, -1, -1, -1;
  Vehicle<8> v;
  for (std::size_t i = 0; i < 8; ++i) {
    RotorGeometry& rotor = v.rotors[i];
    const auto column = static_cast<Eigen::Index>(i);
    rotor.position = 0.2 * corners.col(column).normalized();
    const Eigen::Vector3d axis = axes.col(column), about = Eigen::Vector3d::UnitZ().cross(axis);
    rotor.orientation =
        Eigen::AngleAxisd(std::acos(axis.z()), about.normalized()).toRotationMatrix();
    rotor.spin = i < 4 ? Spin::counter_clockwise : Spin::clockwise;
    rotor.tilts = false;
  }
  v.rotor.max_thrust = 12.0;
  return v;
}

/// The Tilt-Ropter with its arms locked: a flat quadrotor.
inline tilt_ropter::Vehicle<4> flat_quadrotor() {
  auto v = tilt_ropter::tilt_ropter_vehicle();
  for (auto& rotor : v.rotors) rotor.tilts = false;
  return v;
}

/// The Tilt-Ropter with other tilt ranges [rad].
inline tilt_ropter::Vehicle<4> with_tilt_range(double lower, double upper) {
  auto v = tilt_ropter::tilt_ropter_vehicle();
  v.servo.min_angle = lower;
  v.servo.max_angle = upper;
  return v;
}

}  // namespace test_support
