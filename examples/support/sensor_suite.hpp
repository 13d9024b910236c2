#pragma once

#include "mission_sensors.hpp"

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <Eigen/Core>

#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

namespace examples {

/// The sensors beside the IMU that a mission is flown with.
enum class SensorSuite {
  mocap,  ///< motion capture at 100 Hz
  vio,    ///< visual-inertial odometry at 30 Hz: poses whose frame drifts
  gps,    ///< GPS with corrections and two antennas at 10 Hz, and a range finder at 50 Hz
  wheels  ///< motion capture in the air, only wheels on the ground
};

[[nodiscard]] inline SensorSuite sensor_suite(const std::string& name) {
  return name == "vio"      ? SensorSuite::vio
         : name == "gps"    ? SensorSuite::gps
         : name == "wheels" ? SensorSuite::wheels
                            : SensorSuite::mocap;
}

/// Simulates the sensors of a suite that MissionSensors does not have.
template <int Rotors>
class SuiteSensors {
 public:
  SuiteSensors(SensorSuite suite, const tilt_ropter::Vehicle<Rotors>& vehicle, std::uint64_t seed)
      : suite_(suite), vehicle_(vehicle), noise_(seed + 3000), fixes_(64) {}

  /// Settings of the estimator for this suite.
  [[nodiscard]] tilt_ropter::EkfSettings estimation() const {
    tilt_ropter::EkfSettings s = MissionSensors<Rotors>::estimation();
    if (suite_ == SensorSuite::vio) s.pose_noise = {5e-3, 5e-3};
    if (suite_ == SensorSuite::gps) s.fusion_delay = gps_delay;
    if (suite_ == SensorSuite::gps || suite_ == SensorSuite::wheels) {
      s.trust.position_error = 1.0;  // centimetres cannot be expected
      s.trust.lost_position_error = 3.0;
      s.trust.orientation_error = 0.3;
      s.trust.position_age = 0.3;
    }
    return s;
  }

  /// Changes the sensors of the mission to those of the suite.
  void set_up(MissionSensors<Rotors>& sensors, std::uint64_t seed) const {
    sensors.has_poses = suite_ != SensorSuite::gps;
    if (suite_ != SensorSuite::vio) return;
    tilt_ropter::PoseSensorParameters p;
    p.rate = 30.0;
    p.delay = 0.03;
    p.position_noise = p.orientation_noise = 5e-3;
    sensors.poses = tilt_ropter::PoseSensor(p, seed + 2000);
  }

  /// Passes the measurements at the time of `plant` to `controller`. Call it every millisecond.
  template <typename Plant, typename Controller>
  void sense(const Plant& plant, MissionSensors<Rotors>& sensors, Controller& controller) {
    if (suite_ == SensorSuite::vio) {  // random walk: 1 cm and 3 mrad after a second
      constexpr double root = 0.0316;
      sensors.pose_drift += noise_.draw<3>(0.01 * root);
      sensors.yaw_drift += 0.003 * root * noise_.draw();
    }
    if (suite_ == SensorSuite::gps) sense_gps(plant, sensors.faults, controller);
    if (suite_ == SensorSuite::wheels) sense_wheels(plant, sensors, controller);
    ++tick_;
  }

 private:
  static constexpr double gps_delay = 0.1;  // [s]

  struct Fix {
    double time = 0.0;
    tilt_ropter::PositionMeasurement<double> position;
    tilt_ropter::WorldVelocityMeasurement<double> velocity;
    tilt_ropter::HeadingMeasurement<double> heading;
  };

  /// The faults of poses are those of the fixes. Returns false if there is no fix.
  bool disturb(const std::vector<tilt_ropter::SensorFault>& faults, double now, Fix& fix) {
    using Kind = tilt_ropter::SensorFaultKind;
    bool sent = true;
    for (const tilt_ropter::SensorFault& fault : faults) {
      if (!fault.acts(now)) continue;
      if (fault.kind == Kind::pose_dropout) sent = false;
      if (fault.kind == Kind::pose_freeze) {
        fix = last_fix_;
        fix.time = now;
      }
      if (fault.kind == Kind::pose_jump) fix.position.position.x() += fault.size;
      if (fault.kind == Kind::pose_ghost) fix.position.position << fault.size, 0.0, 0.0;
      if (fault.kind == Kind::pose_clock_step) fix.time += fault.size;
      if (fault.kind == Kind::pose_jitter) fix.time += fault.size * noise_.draw();
    }
    return sent;
  }

  template <typename Plant, typename Controller>
  void sense_gps(const Plant& plant, const std::vector<tilt_ropter::SensorFault>& faults,
                 Controller& controller) {
    const double time = plant.time();
    const tilt_ropter::BodyStated& truth = plant.body();
    if (!started_ && controller.ekf().time() > 0.0) {  // the place of the start is known
      tilt_ropter::BodyStated start = truth;
      start.velocity.setZero();
      start.angular_velocity.setZero();
      controller.start_estimate(start, {0.02, 0.05, 0.02});
      started_ = true;
    }
    if (tick_ % 100 == 0) {
      const Eigen::Vector3d antenna(0.0, 0.0, 0.08);
      Fix fix;
      fix.time = time;
      fix.position.antenna = fix.velocity.antenna = antenna;
      const Eigen::Vector3d stddev(0.02, 0.02, 0.03);
      fix.position.position =
          truth.position + truth.orientation * antenna + stddev.cwiseProduct(noise_.draw<3>(1.0));
      fix.position.covariance = stddev.cwiseAbs2().asDiagonal();
      fix.velocity.velocity =
          truth.velocity +
          truth.orientation * Eigen::Vector3d(truth.angular_velocity.cross(antenna)) +
          noise_.draw<3>(0.05);
      fix.velocity.covariance = 0.05 * 0.05 * Eigen::Matrix3d::Identity();
      fix.heading = {tilt_ropter::yaw_of(truth.orientation) + 0.01 * noise_.draw(), 0.01};
      if (disturb(faults, time, fix)) fixes_.push(time + gps_delay, fix);
      last_fix_ = fix;
    }
    if (const auto fix = fixes_.pop(time)) {
      controller.on_measurement(fix->time, fix->position);
      controller.on_measurement(fix->time, fix->velocity);
      controller.on_measurement(fix->time, fix->heading);
    }
    if (tick_ % 20 == 0) {
      tilt_ropter::RangeMeasurement<double> range;
      const double up = (truth.orientation * Eigen::Vector3d::UnitZ()).z();
      range.range = truth.position.z() / up + 0.01 * noise_.draw();
      range.stddev = 0.01;
      if (up > 0.5) controller.on_measurement(time, range);
    }
  }

  template <typename Plant, typename Controller>
  void sense_wheels(const Plant& plant, MissionSensors<Rotors>& sensors, Controller& controller) {
    const bool drives = vehicle_.wheels && controller.contact().estimate().on_ground &&
                        plant.time() > 5.0;  // the first poses start the filter
    sensors.has_poses = !drives;
    if (!drives || tick_ % 20 != 0) return;
    const double time = plant.time(), radius = vehicle_.wheels->radius;
    const tilt_ropter::BodyStated& truth = plant.body();
    const Eigen::Vector3d velocity = truth.orientation.conjugate() * truth.velocity;
    const Eigen::Vector3d up = truth.orientation.conjugate() * Eigen::Vector3d::UnitZ();
    const Eigen::Vector3d forward = Eigen::Vector3d::UnitY().cross(up).normalized();
    for (const double side : {1.0, -1.0}) {
      tilt_ropter::WheelSpeedMeasurement<double> encoder;
      encoder.wheel << 0.0, side * vehicle_.wheels->half_track, 0.0;
      encoder.radius = radius;
      const Eigen::Vector3d hub = velocity + truth.angular_velocity.cross(encoder.wheel);
      encoder.speed = forward.dot(hub) / radius - truth.angular_velocity.y() + 0.1 * noise_.draw();
      controller.on_measurement(time, encoder);
      tilt_ropter::WheelHeightMeasurement<double> height;
      height.radius = radius;
      height.wheel = encoder.wheel;
      controller.on_measurement(time, height);
    }
    controller.on_measurement(time, tilt_ropter::NoSlipMeasurement<double>());
  }

  SensorSuite suite_;
  tilt_ropter::Vehicle<Rotors> vehicle_;
  tilt_ropter::GaussianNoise noise_;
  tilt_ropter::detail::DelayQueue<Fix> fixes_;
  Fix last_fix_;
  long tick_ = 0;
  bool started_ = false;
};

}  // namespace examples
