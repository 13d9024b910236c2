// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Reference motion of the vehicle as a function of time.
namespace tilt_ropter {

/// One point of a time-parametrised reference. A reference is any callable that returns a point:
/// `ReferencePoint reference(double time)`. It must be defined for every time: it holds the first
/// point before its start and the last point after its end. It must be smooth enough that velocity
/// and angular velocity are the derivatives of position and orientation.
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
