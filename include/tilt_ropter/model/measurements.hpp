// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Sensor measurements. Drivers or the simulated sensors produce them, the estimators use them.
namespace tilt_ropter {

/// Kinds of measurements, for reports about them.
enum class MeasurementKind { pose, position, velocity, height, flow, heading, wheel, other };
inline constexpr int measurement_kinds = 8;

/// IMU measurement in the IMU frame. Without a mounting pose (EkfSettings) this is the body frame.
template <typename Scalar>
struct InertialSample {
  Vector3<Scalar> angular_velocity = Vector3<Scalar>::Zero();  ///< [rad/s]
  Vector3<Scalar> specific_force = Vector3<Scalar>::Zero();    ///< q^-1 (dv/dt - g) [m/s^2]
};
using InertialSampled = InertialSample<double>;  ///< in double precision

/// Pose of the marker frame M in the world, from motion capture. q and -q are the same orientation.
template <typename Scalar>
struct MarkerPose {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< origin of M in the world [m]
  Eigen::Quaternion<Scalar> orientation = Eigen::Quaternion<Scalar>::Identity();  ///< M -> world
};
using MarkerPosed = MarkerPose<double>;  ///< in double precision

/// Position in the world, such as GPS in local coordinates (ENU).
template <typename Scalar>
struct PositionMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::position;
  Vector3<Scalar> position = Vector3<Scalar>::Zero();        ///< of the antenna [m]
  Matrix3<Scalar> covariance = Matrix3<Scalar>::Identity();  ///< world frame [m^2]
  Vector3<Scalar> antenna = Vector3<Scalar>::Zero();         ///< antenna in the body frame [m]
};

/// Velocity in the world frame, such as the Doppler velocity of GPS.
template <typename Scalar>
struct WorldVelocityMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::velocity;
  Vector3<Scalar> velocity = Vector3<Scalar>::Zero();        ///< of the antenna [m/s]
  Matrix3<Scalar> covariance = Matrix3<Scalar>::Identity();  ///< world frame [m^2/s^2]
  Vector3<Scalar> antenna = Vector3<Scalar>::Zero();         ///< antenna in the body frame [m]
};

/// Velocity relative to the world in the body frame, such as the twist of an odometry.
template <typename Scalar>
struct BodyVelocityMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::velocity;
  Vector3<Scalar> velocity = Vector3<Scalar>::Zero();        ///< of the sensor, body frame [m/s]
  Matrix3<Scalar> covariance = Matrix3<Scalar>::Identity();  ///< body frame [m^2/s^2]
  Vector3<Scalar> sensor = Vector3<Scalar>::Zero();          ///< sensor in the body frame [m]
};

/// Height above z = 0 of the world, such as a barometer minus its offset. The drift of a barometer
/// is part of `stddev`; see white_stddev().
template <typename Scalar>
struct HeightMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::height;
  Scalar height = Scalar(0);                         ///< of the sensor [m]
  Scalar stddev = Scalar(1);                         ///< standard deviation [m]
  Vector3<Scalar> sensor = Vector3<Scalar>::Zero();  ///< sensor in the body frame [m]
};

/// A plane of the ground: normal' * x = offset, with the upward unit normal (world frame).
template <typename Scalar>
struct MeasuredPlane {
  Vector3<Scalar> normal = Vector3<Scalar>::UnitZ();
  Scalar offset = Scalar(0);  ///< distance from the origin along the normal [m]
};

/// Distance to the ground along an axis of the body, such as an ultrasonic or laser range finder.
template <typename Scalar>
struct RangeMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::height;
  Scalar range = Scalar(0);                               ///< [m]
  Scalar stddev = Scalar(1);                              ///< standard deviation [m]
  Vector3<Scalar> sensor = Vector3<Scalar>::Zero();       ///< sensor in the body frame [m]
  Vector3<Scalar> direction = -Vector3<Scalar>::UnitZ();  ///< of the beam, body frame, unit
  MeasuredPlane<Scalar> ground;
};

/// Optical flow of a camera that looks along body -z: angular velocity at which the ground in the
/// middle of the image moves along body x and y. A vehicle that only turns at rate w sees
/// (w_y, -w_x); a level vehicle that only moves at velocity v at height h sees (-v_x, -v_y) / h.
template <typename Scalar>
struct FlowMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::flow;
  Eigen::Matrix<Scalar, 2, 1> flow = Eigen::Matrix<Scalar, 2, 1>::Zero();  ///< [rad/s]
  Scalar stddev = Scalar(1);                         ///< standard deviation per axis [rad/s]
  Vector3<Scalar> camera = Vector3<Scalar>::Zero();  ///< camera in the body frame [m]
  MeasuredPlane<Scalar> ground;
};

/// Heading of body x in the world's xy plane (yaw_of), such as a compass or two GPS antennas.
/// Ekf counts it less while it contradicts gyroscope and positions.
template <typename Scalar>
struct HeadingMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::heading;
  Scalar heading = Scalar(0);  ///< counter-clockwise from world x (east) [rad]
  Scalar stddev = Scalar(1);   ///< standard deviation [rad]
};

/// Pose of a sensor in the world with its own covariance, such as visual-inertial odometry. The
/// world is then the frame of the odometry, with its drift.
template <typename Scalar>
struct PoseMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::pose;
  Vector3<Scalar> position = Vector3<Scalar>::Zero();                             ///< [m]
  Eigen::Quaternion<Scalar> orientation = Eigen::Quaternion<Scalar>::Identity();  ///< -> world
  /// Position in the world frame [m^2], then orientation in the sensor frame [rad^2].
  Eigen::Matrix<Scalar, 6, 6> covariance = Eigen::Matrix<Scalar, 6, 6>::Identity();
  Vector3<Scalar> sensor = Vector3<Scalar>::Zero();  ///< sensor in the body frame [m]
  /// Sensor frame -> body.
  Eigen::Quaternion<Scalar> sensor_orientation = Eigen::Quaternion<Scalar>::Identity();
};

/// A wheel that does not slip sideways: the axle has no velocity along itself. On the ground only.
template <typename Scalar>
struct NoSlipMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::wheel;
  Scalar stddev = Scalar(0.05);                      ///< of the sideways velocity [m/s]
  Vector3<Scalar> axle = Vector3<Scalar>::Zero();    ///< middle of the axle, body frame [m]
  Vector3<Scalar> along = Vector3<Scalar>::UnitY();  ///< direction of the axle, body frame, unit
};

/// A wheel that stands on the ground: its centre is one radius above the plane.
template <typename Scalar>
struct WheelHeightMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::wheel;
  Scalar radius = Scalar(0.11);                     ///< [m]
  Scalar stddev = Scalar(0.01);                     ///< of the height [m]
  Vector3<Scalar> wheel = Vector3<Scalar>::Zero();  ///< wheel centre in the body frame [m]
  MeasuredPlane<Scalar> ground;
};

/// Speed of a wheel without slip, from an encoder at the body, about body y; forward is positive.
template <typename Scalar>
struct WheelSpeedMeasurement {
  static constexpr MeasurementKind kind = MeasurementKind::wheel;
  Scalar speed = Scalar(0);                                  ///< relative to the body [rad/s]
  Scalar radius = Scalar(0.11);                              ///< [m]
  Scalar stddev = Scalar(0.1);                               ///< standard deviation [rad/s]
  Vector3<Scalar> wheel = Vector3<Scalar>::Zero();           ///< wheel centre in the body frame [m]
  Vector3<Scalar> ground_normal = Vector3<Scalar>::UnitZ();  ///< upward, world frame, unit
};

/// Measurement with the time at which it was taken [s].
template <typename Value>
struct Timed {
  double time = 0.0;
  Value value;
};

}  // namespace tilt_ropter
