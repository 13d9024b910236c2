// Filter: position, velocity and attitude from an IMU and a delayed, noisy pose measurement.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <cmath>
#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: filter    estimates a circle; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  ImuSensorParameters imu_parameters;
  imu_parameters.gyro_bias << 0.01, -0.02, 0.005;  // [rad/s], unknown to the filter
  ImuSensor imu(imu_parameters, 1);                // 1 kHz; your IMU driver goes here
  PoseSensorParameters pose_parameters;
  pose_parameters.delay = 0.02;          // [s]
  PoseSensor poses(pose_parameters, 2);  // 100 Hz; your motion capture goes here

  const auto circle = [](double t) {  // radius 1 m, speed 1 m/s, level
    BodyStated state;
    state.position << std::cos(t), std::sin(t), 1.5;
    state.velocity << -std::sin(t), std::cos(t), 0.0;
    return state;
  };
  Ekfd ekf;
  for (int i = 0; i < 10000; ++i) {
    const double t = 0.001 * i;
    const BodyStated truth = circle(t);
    const Eigen::Vector3d specific_force(-std::cos(t), -std::sin(t), gravity);  // [m/s^2]
    // Each measurement has the time when it was taken. The filter handles poses that are 20 ms
    // late.
    if (const auto m = imu.sample(t, truth.angular_velocity, specific_force))
      ekf.on_imu(m->time, *m);
    if (const auto m = poses.sample(t, truth)) ekf.on_pose(m->time, *m);
    if (i % 2500 != 2499 || !ekf.running()) continue;
    const BodyStated state = ekf.state(), then = circle(ekf.time());  // of the newest IMU sample
    std::printf("t %4.1f s  position error %4.1f mm  velocity error %4.1f mm/s\n", t,
                1e3 * (state.position - then.position).norm(),
                1e3 * (state.velocity - then.velocity).norm());
  }
  const Eigen::Vector3d bias = ekf.filter().state().gyro_bias;
  std::printf("gyro bias %.3f %.3f %.3f rad/s\n", bias.x(), bias.y(), bias.z());
}
