// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Sensor measurements. Drivers or the simulated sensors produce them, the estimators use them.
namespace tilt_ropter {

/// IMU measurement in the IMU frame, which is the body frame.
template <typename Scalar>
struct InertialSample {
  Vector3<Scalar> angular_velocity = Vector3<Scalar>::Zero();  ///< [rad/s]
  Vector3<Scalar> specific_force = Vector3<Scalar>::Zero();    ///< q^-1 (dv/dt - g) [m/s^2]
};
using InertialSampled = InertialSample<double>;  ///< in double precision

/// Pose of the marker frame M in the world, measured by motion capture. q and -q are the same
/// orientation.
template <typename Scalar>
struct MarkerPose {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< origin of M in the world [m]
  Eigen::Quaternion<Scalar> orientation = Eigen::Quaternion<Scalar>::Identity();  ///< M -> world
};
using MarkerPosed = MarkerPose<double>;  ///< in double precision

/// Measurement with the time at which it was taken [s].
template <typename Value>
struct Timed {
  double time = 0.0;
  Value value;
};

}  // namespace tilt_ropter
