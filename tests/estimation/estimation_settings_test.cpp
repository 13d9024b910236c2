// Every limit of the settings of filters, observers and calibrations, by the name in the message.

#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/identification/clock_calibration.hpp>
#include <tilt_ropter/identification/log_calibration.hpp>
#include <tilt_ropter/identification/servo_identification.hpp>
#include <tilt_ropter/identification/vehicle_identification.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace tilt_ropter {
namespace estimation_settings_test {

using namespace test_support;

const RigidBodyParameters body = tilt_ropter_vehicle().body, massless{0.0, body.inertia};
const char* const mass = "RigidBodyParameters.mass [kg]";

TEST(EstimationSettings, NoiseNamesEachField) {
  using I = InertialNoise;
  const Fields<I> imu;
  imu("InertialNoise.gyro_density [rad/s/sqrt(Hz)]", &I::gyro_density, in_range(0.0, 1e3));
  imu("InertialNoise.accelerometer_density [m/s^2/sqrt(Hz)]", &I::accelerometer_density,
      in_range(0.0, 1e3));
  imu("InertialNoise.gyro_bias_walk [rad/s^2/sqrt(Hz)]", &I::gyro_bias_walk, in_range(0.0, 1e3));
  imu("InertialNoise.accelerometer_bias_walk [m/s^3/sqrt(Hz)]", &I::accelerometer_bias_walk,
      in_range(0.0, 1e3));
  using P = MarkerPoseNoise;
  const Fields<P> pose;
  pose("MarkerPoseNoise.position [m]", &P::position, in_range(1e-6, 1e3));
  pose("MarkerPoseNoise.orientation [rad]", &P::orientation, in_range(1e-6, 10.0));
  expect_refused("InertialNoise.gyro_density [rad/s/sqrt(Hz)]", [] {
    ErrorStateFilterd({-1.0, 0.0, 0.0, 0.0}, {});
  });
  expect_refused("MarkerPoseNoise.position [m]", [] { ErrorStateFilterd({}, {0.0, 1.0}); });
}

TEST(EstimationSettings, EkfTrustNamesEachField) {
  using S = EkfTrustLimits;
  S valid;
  valid.position_error = 0.5;
  const Fields<S> check{valid};
  check("EkfTrustLimits.lost_position_error [m]", &S::lost_position_error,
        {{0.5, 1e300}, {below(0.5), 0.0, not_a_number, infinite}});
  valid.lost_position_error = 1e300;
  Fields<S>{valid}("EkfTrustLimits.position_error [m]", &S::position_error, positive());
  check("EkfTrustLimits.orientation_error [rad]", &S::orientation_error, positive());
  check("EkfTrustLimits.position_age [s]", &S::position_age, positive());
  check("EkfTrustLimits.imu_age [s]", &S::imu_age, positive());
}

TEST(EstimationSettings, EkfNamesEachField) {
  using S = EkfSettings;
  const Fields<S> check;
  check.refuse("InertialNoise.gyro_bias_walk [rad/s^2/sqrt(Hz)]",
               [](S& s) { s.imu_noise.gyro_bias_walk = -1.0; });
  check.refuse("MarkerPoseNoise.orientation [rad]", [](S& s) { s.pose_noise.orientation = 0.0; });
  check.refuse("EkfTrustLimits.imu_age [s]", [](S& s) { s.trust.imu_age = 0.0; });
  check("EkfSettings.imu_position [m]", &S::imu_position, in_range(-100.0, 100.0));
  check("EkfSettings.marker_position [m]", &S::marker_position, in_range(-100.0, 100.0));
  const Range unit{{1.0 - 0.9e-6, 1.0 + 0.9e-6, -1.0},
                   {1.0 - 1.1e-6, 1.0 + 1.1e-6, 0.0, 2.0, not_a_number, infinite}};
  check(
      "EkfSettings.imu_orientation", [](S& s, double v) { s.imu_orientation.w() = v; }, unit);
  check(
      "EkfSettings.marker_orientation",
      [](S& s, double v) { s.marker_orientation.coeffs() << v, 0.0, 0.0, 0.0; }, unit);
  check("EkfSettings.imu_position_stddev [m]", &S::imu_position_stddev, in_range(0.0, 100.0));
  check("EkfSettings.marker_position_stddev [m]", &S::marker_position_stddev, in_range(0.0, 100.0));
  expect_refused(
      "EkfSettings.marker_position_stddev [m]",
      [] {
        S both;
        both.imu_position_stddev = both.marker_position_stddev = 1e-9;
        Ekfd{both};
      },
      "1e-09: must be 0 if imu_position_stddev is above 0");
  check("EkfSettings.marker_orientation_stddev [rad]", &S::marker_orientation_stddev,
        in_range(0.0, 10.0));
  check("EkfSettings.clock_offset [s]", &S::clock_offset, in_range(-1e10, 1e10));
  check("EkfSettings.gyro_bias [rad/s]", &S::gyro_bias, in_range(-1e3, 1e3));
  check("EkfSettings.accelerometer_bias [m/s^2]", &S::accelerometer_bias, in_range(-1e3, 1e3));
  check("EkfSettings.velocity_stddev [m/s]", &S::velocity_stddev, in_range(1e-6, 1e3));
  check("EkfSettings.gyro_bias_stddev [rad/s]", &S::gyro_bias_stddev, in_range(0.0, 1e3));
  check("EkfSettings.accelerometer_bias_stddev [m/s^2]", &S::accelerometer_bias_stddev,
        in_range(0.0, 1e3));
  check("EkfSettings.gate", &S::gate, positive());
  check("EkfSettings.max_rejections", &S::max_rejections, at_least(1));
  check("EkfSettings.restart_distance [m]", &S::restart_distance, in_range(0.0, 1e6));
  check("EkfSettings.full_restart_time [s]", &S::full_restart_time,
        in_range(S().restart_time, 600.0));
  check("EkfSettings.max_delay [s]", &S::max_delay, in_range(1e-6, 10.0));
  check("EkfSettings.max_imu_rate [Hz]", &S::max_imu_rate, in_range(1.0, 1e5));
  check("EkfSettings.fusion_delay [s]", &S::fusion_delay, in_range(0.0, S().max_delay));
  check("EkfSettings.max_imu_gap [s]", &S::max_imu_gap, in_range(1e-6, 1.0));
  S patient;
  patient.full_restart_time = 600.0;
  Fields<S>{patient}("EkfSettings.restart_time [s]", &S::restart_time, in_range(0.0, 60.0));
}

TEST(EstimationSettings, ClockCalibrationNamesEachField) {
  using S = ClockCalibrationSettings;
  const Fields<S> check;
  check("ClockCalibrationSettings.max_offset [s]", &S::max_offset, above_up_to(0.0, 60.0));
  check("ClockCalibrationSettings.window [s]", &S::window,
        {{1e-3, 1e300}, {below(1e-3), 0.0, not_a_number, infinite}});
  check("ClockCalibrationSettings.max_stddev [s]", &S::max_stddev, positive());
  expect_refused("ClockCalibrationSettings.max_stddev [s]", [] {
    (void)calibrate_clock<double>({}, {}, {0.5, 0.05, 0.0});
  });
}

TEST(EstimationSettings, LogCalibrationNamesEachField) {
  using S = LogCalibrationSettings;
  const Fields<S> check;
  check.refuse("InertialNoise.gyro_bias_walk [rad/s^2/sqrt(Hz)]",
               [](S& s) { s.imu_noise.gyro_bias_walk = -1.0; });
  check.refuse("MarkerPoseNoise.position [m]", [](S& s) { s.pose_noise.position = 0.0; });
  check.refuse("ClockCalibrationSettings.window [s]", [](S& s) { s.clock.window = 0.0; });
  const Range density{{1e-300, 1e3}, {0.0}};
  check(
      "LogCalibrationSettings.imu_noise.gyro_density",
      [](S& s, double v) { s.imu_noise.gyro_density = v; }, density);
  check(
      "LogCalibrationSettings.imu_noise.accelerometer_density",
      [](S& s, double v) { s.imu_noise.accelerometer_density = v; }, density);
  check("LogCalibrationSettings.gravity_stddev [rad]", &S::gravity_stddev, in_range(0.0, 1.0));
  check("LogCalibrationSettings.max_marker_position_stddev [m]", &S::max_marker_position_stddev,
        positive());
  check("LogCalibrationSettings.max_marker_orientation_stddev [rad]",
        &S::max_marker_orientation_stddev, positive());
  check("LogCalibrationSettings.max_gyro_bias_stddev [rad/s]", &S::max_gyro_bias_stddev,
        positive());
  check("LogCalibrationSettings.max_accelerometer_bias_stddev [m/s^2]",
        &S::max_accelerometer_bias_stddev, positive());
  check("LogCalibrationSettings.max_iterations", &S::max_iterations, at_least(1));
  S bad;
  bad.max_iterations = 0;
  expect_refused("LogCalibrationSettings.max_iterations",
                 [&] { (void)calibrate_log<double>({}, {}, bad); });
}

TEST(EstimationSettings, ContactEstimatorNamesWhatItRefuses) {
  const Undercarriage wheels, sunk{0.0, true, true, true};
  for (const double height : {infinite, not_a_number})
    expect_refused("ContactEstimator.assumed_ground.height [m]", [&] {
      ContactEstimator(body, wheels, GroundPlane{height, Eigen::Vector2d::Zero()});
    });
  expect_refused("Undercarriage.height [m]", [&] { ContactEstimator(body, sunk); });
  expect_refused(mass, [&] { ContactEstimator(massless, wheels); });
}

TEST(EstimationSettings, ServoIdentificationNamesEachField) {
  using S = ServoIdentificationSettings;
  const Fields<S> check;
  check("ServoIdentificationSettings.max_dead_time [s]", &S::max_dead_time, not_negative());
  check("ServoIdentificationSettings.max_iterations", &S::max_iterations, at_least(1));
  S bad;
  bad.max_iterations = 0;
  expect_refused("ServoIdentificationSettings.max_iterations",
                 [&] { (void)identify_servo({}, bad); });
}

TEST(EstimationSettings, VehicleIdentificationNamesEachField) {
  using S = VehicleIdentificationSettings;
  const Fields<S> check;
  check("VehicleIdentificationSettings.imu_position [m]", &S::imu_position, any_finite());
  check("VehicleIdentificationSettings.min_height [m]", &S::min_height,
        {{-infinite, 0.0, infinite}, {not_a_number}});
  S bad;
  bad.min_height = not_a_number;
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  const VehicleLog<4> log;
  expect_refused("VehicleIdentificationSettings.min_height [m]",
                 [&] { (void)identify_vehicle(log, vehicle, bad); });
  vehicle.body.mass = 0.0;
  expect_refused(mass, [&] { (void)identify_vehicle(log, vehicle); });
}

TEST(EstimationSettings, WrenchObserverNamesEachField) {
  using S = WrenchObserverSettings;
  const Fields<S> check;
  check("WrenchObserverSettings.force_bandwidth [1/s]", &S::force_bandwidth, positive());
  check("WrenchObserverSettings.torque_bandwidth [1/s]", &S::torque_bandwidth, positive());
  check("WrenchObserverSettings.force_dead_band [N]", &S::force_dead_band, not_negative());
  check("WrenchObserverSettings.torque_dead_band [N m]", &S::torque_dead_band, not_negative());
  check("WrenchObserverSettings.force_limit [N]", &S::force_limit, positive_or_infinite());
  check("WrenchObserverSettings.torque_limit [N m]", &S::torque_limit, positive_or_infinite());
  check("WrenchObserverSettings.max_gap [s]", &S::max_gap, positive());
  expect_refused("WrenchObserverSettings.force_bandwidth [1/s]",
                 [] { WrenchObserverd(body, observer_settings(0.0)); });
  expect_refused(mass, [] { WrenchObserverd{massless}; });
}

}  // namespace estimation_settings_test
}  // namespace tilt_ropter
