// Every limit of the parameters of sensors, plant and wheels, by the name in the message.

#include <tilt_ropter/simulation/detail/wheel_contact.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <string>

namespace tilt_ropter {
namespace simulation_settings_test {

using namespace test_support;

template <typename S>
void check_timing(const std::string& name) {
  S valid;
  valid.delay = 0.0;
  const Fields<S> check{valid};
  check((name + ".rate [Hz]").c_str(), &S::rate, positive());
  valid.rate = 100.0;
  const Fields<S> at_100_hz{valid};
  at_100_hz((name + ".delay [s]").c_str(), &S::delay,
            {{0.0, 1000.0}, {below(0.0), above(1000.0), not_a_number, infinite}});
}

TEST(SimulationSettings, ImuNamesEachField) {
  using S = ImuSensorParameters;
  check_timing<S>("ImuSensorParameters");
  const Fields<S> check;
  check("ImuSensorParameters.gyro_noise_density [rad/s/sqrt(Hz)]", &S::gyro_noise_density,
        not_negative());
  check("ImuSensorParameters.accelerometer_noise_density [m/s^2/sqrt(Hz)]",
        &S::accelerometer_noise_density, not_negative());
  check("ImuSensorParameters.gyro_bias_walk [rad/s^2/sqrt(Hz)]", &S::gyro_bias_walk,
        not_negative());
  check("ImuSensorParameters.accelerometer_bias_walk [m/s^3/sqrt(Hz)]", &S::accelerometer_bias_walk,
        not_negative());
  check("ImuSensorParameters.gyro_bias [rad/s]", &S::gyro_bias, any_finite());
  check("ImuSensorParameters.accelerometer_bias [m/s^2]", &S::accelerometer_bias, any_finite());
  check("ImuSensorParameters.position [m]", &S::position, any_finite());
  S bad;
  bad.rate = 0.0;
  expect_refused("ImuSensorParameters.rate [Hz]", [&] { ImuSensor(bad, 1); });
}

TEST(SimulationSettings, OtherSensorsNameEachField) {
  using P = PoseSensorParameters;
  check_timing<P>("PoseSensorParameters");
  const Fields<P> pose;
  pose("PoseSensorParameters.position_noise [m]", &P::position_noise, not_negative());
  pose("PoseSensorParameters.orientation_noise [rad]", &P::orientation_noise, not_negative());
  using R = RotorSpeedSensorParameters;
  check_timing<R>("RotorSpeedSensorParameters");
  Fields<R>{}("RotorSpeedSensorParameters.noise [rad/s]", &R::noise, not_negative());
  P bad_pose;
  bad_pose.position_noise = -1.0;
  expect_refused("PoseSensorParameters.position_noise [m]", [&] { PoseSensor(bad_pose, 1); });
  R bad_speed;
  bad_speed.noise = -1.0;
  expect_refused("RotorSpeedSensorParameters.noise [rad/s]",
                 [&] { RotorSpeedSensor<4>(bad_speed, 1); });
}

TEST(SimulationSettings, SensorFaultNamesEachField) {
  using S = SensorFault;
  const Fields<S> check;
  check("SensorFault.start [s]", &S::start, any_finite());
  check("SensorFault.duration [s]", &S::duration, positive_or_infinite());
  check("SensorFault.size", &S::size, in_range(-1e3, 1e3));
  check("SensorFault.frequency [Hz]", &S::frequency, in_range(1e-3, 1e4));
  for (std::size_t i = 0; i < sensor_fault_names.size(); ++i) {
    S fault;
    fault.kind = static_cast<SensorFaultKind>(i);
    const bool size_is_positive = fault.kind == SensorFaultKind::pose_jitter ||
                                  fault.kind == SensorFaultKind::imu_vibration ||
                                  fault.kind == SensorFaultKind::imu_saturation ||
                                  fault.kind == SensorFaultKind::accelerometer_clip ||
                                  fault.kind == SensorFaultKind::pose_late ||
                                  fault.kind == SensorFaultKind::pose_burst;
    Fields<S>{fault}("SensorFault.size", &S::size,
                     size_is_positive ? Range{{1e-12}, {0.0, -1.0}} : Range{{0.0, -1.0}, {}});
  }
  PoseSensor sensor({}, 1);
  S bad;
  bad.duration = 0.0;
  expect_refused("SensorFault.duration [s]", [&] { sensor.add_fault(bad); });
}

TEST(SimulationSettings, WheelContactNamesEachField) {
  using S = WheelContactParameters;
  const Fields<S> check;
  check("WheelContactParameters.stiffness [N/m]", &S::stiffness, positive());
  check("WheelContactParameters.dissipation [s/m]", &S::dissipation, not_negative());
  check("WheelContactParameters.friction", &S::friction, not_negative());
  check("WheelContactParameters.bristle_stiffness [N/m]", &S::bristle_stiffness, positive());
  check("WheelContactParameters.bristle_damping [N s/m]", &S::bristle_damping, not_negative());
  check("WheelContactParameters.rolling_resistance", &S::rolling_resistance, not_negative());
  check("WheelContactParameters.rolling_regularisation [m/s]", &S::rolling_regularisation,
        positive());
  check("WheelContactParameters.bearing_friction [N m s]", &S::bearing_friction, not_negative());
  check("WheelContactParameters.axle_position [m]", &S::axle_position, any_finite());
}

TEST(SimulationSettings, PlantNamesEachField) {
  using S = PlantParameters;
  const Fields<S> check;
  check.refuse("WheelContactParameters.friction", [](S& s) { s.contact.friction = -1.0; });
  check("PlantParameters.linear_drag [N s/m]", &S::linear_drag, not_negative());
  check("PlantParameters.servo_stiffness [N m/rad]", &S::servo_stiffness, positive());
  check("PlantParameters.max_substep [s]", &S::max_substep,
        {{1e-7, 1e300}, {below(1e-7), 0.0, not_a_number, infinite}});
  S bad;
  bad.linear_drag.x() = -1.0;
  expect_refused("PlantParameters.linear_drag [N s/m]",
                 [&] { Plant<4>(tilt_ropter_vehicle(), bad); });
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.power.servo_move = -1.0;
  expect_refused("PowerParameters.servo_move [J/rad]", [&] { Plant<4>{vehicle}; });
  vehicle = tilt_ropter_vehicle();
  expect_range("Plant: fastest rate of rotors, servos and contact [1/s]", {{0.99e7}, {1.01e7}},
               true, [&](double rate) {
                 S fast;
                 fast.contact.bearing_friction = rate * vehicle.wheels->inertia;
                 Plant<4>(vehicle, fast);
               });
}

TEST(SimulationSettings, PlantStateNamesEachField) {
  using S = PlantState<4>;
  const Fields<S> check;
  const auto position = [](S& s, double v) { s.body.position.x() = v; };
  check("PlantState.time [s]", &S::time, any_finite());
  check("PlantState.body.position [m]", position, any_finite());
  check(
      "PlantState.body.velocity [m/s]", [](S& s, double v) { s.body.velocity.y() = v; },
      any_finite());
  check("PlantState.body.orientation",
        [](S& s, double v) { s.body.orientation.coeffs() << 0.0, v, 0.0, 0.0; },
        {{1.001e-3, 1e150, -1.0}, {0.999e-3, 0.0, not_a_number, infinite}});
  check(
      "PlantState.body.angular_velocity [rad/s]",
      [](S& s, double v) { s.body.angular_velocity.z() = v; }, any_finite());
  check(
      "PlantState.actuators.rotor_speed [rad/s]",
      [](S& s, double v) { s.actuators.rotor_speed(3) = v; }, not_negative());
  check(
      "PlantState.actuators.tilt_angle [rad]",
      [](S& s, double v) { s.actuators.tilt_angle(1) = v; }, any_finite());
  const char* wheels = "PlantState.wheels (angle, spin, bristle)";
  check(
      wheels, [](S& s, double v) { s.wheels.front().angle = v; }, any_finite());
  check(
      wheels, [](S& s, double v) { s.wheels.back().spin = v; }, any_finite());
  check(
      wheels, [](S& s, double v) { s.wheels[1].bristle.x() = v; }, any_finite());
  check(
      wheels, [](S& s, double v) { s.wheels[1].bristle.y() = v; }, any_finite());
  Plant<4> plant(tilt_ropter_vehicle());
  S bad;
  bad.time = not_a_number;
  expect_refused("PlantState.time [s]", [&] { plant.reset(bad); });
}

}  // namespace simulation_settings_test
}  // namespace tilt_ropter
