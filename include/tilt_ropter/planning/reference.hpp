// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Where the vehicle should be, as a function of time.
namespace tilt_ropter {

/// One point of a time-parametrised reference. A reference is any callable that returns one:
/// `ReferencePoint reference(double time)`, defined for every time (before its start and after its
/// end it holds the first and last point), smooth enough that velocity and angular velocity are the
/// derivatives of position and orientation.
struct ReferencePoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();               ///< CoM, world frame [m]
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();               ///< world frame [m/s]
  Eigen::Vector3d acceleration = Eigen::Vector3d::Zero();           ///< world frame [m/s^2]
  Eigen::Quaterniond orientation = Eigen::Quaterniond::Identity();  ///< body -> world
  Eigen::Vector3d angular_velocity = Eigen::Vector3d::Zero();       ///< body frame [rad/s]
  Eigen::Vector3d angular_acceleration =
      Eigen::Vector3d::Zero();  ///< derivative of angular_velocity, body frame [rad/s^2]
};

}  // namespace tilt_ropter
