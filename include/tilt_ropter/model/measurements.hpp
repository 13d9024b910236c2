// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// What sensors say: made by a driver or by the simulated sensors, taken by the estimators.
namespace tilt_ropter {

/// What an IMU reports, in its own frame, which is the body frame.
template <typename Scalar = double>
struct InertialSample {
  Vector3<Scalar> angular_velocity = Vector3<Scalar>::Zero();  ///< [rad/s]
  Vector3<Scalar> specific_force = Vector3<Scalar>::Zero();    ///< q^-1 (dv/dt - g) [m/s^2]
};

/// Pose of the marker frame M in the world, as motion capture reports it. q and -q are the same.
template <typename Scalar = double>
struct MarkerPose {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< origin of M in the world [m]
  Eigen::Quaternion<Scalar> orientation = Eigen::Quaternion<Scalar>::Identity();  ///< M -> world
};

/// A measurement and the time at which it was taken [s].
template <typename Value>
struct Timed {
  double time = 0.0;
  Value value;
};

}  // namespace tilt_ropter
