// Faults of simulated sensors, and an IMU beside the CoM.

#include <tilt_ropter/simulation/sensors.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <vector>

namespace tilt_ropter {
namespace broken_sensors_test {

// This fault from 1 s to 2 s.
SensorFault fault_of(SensorFaultKind kind, double size) {
  SensorFault fault;
  fault.kind = kind;
  fault.start = 1.0;
  fault.duration = 1.0;
  fault.size = size;
  return fault;
}

// Measurements of a pose sensor at 100 Hz with this fault; the truth moves along x.
std::vector<PoseSensor::Measurement> broken_poses(SensorFaultKind kind, double size) {
  PoseSensorParameters p;
  p.delay = 0.0;
  PoseSensor sensor(p, 9);
  sensor.add_fault(fault_of(kind, size));
  std::vector<PoseSensor::Measurement> all;
  for (int i = 0; i < 300; ++i) {
    BodyStated truth;
    truth.position.x() = 0.01 * i;
    if (const auto m = sensor.sample(0.01 * i, truth)) all.push_back(*m);
  }
  return all;
}

TEST(SensorFaults, PoseFaultsActDuringTheirTimeOnly) {
  using Kind = SensorFaultKind;
  const auto healthy = broken_poses(Kind::imu_dropout, 1.0);  // not a fault of poses
  ASSERT_EQ(healthy.size(), 300U);
  EXPECT_EQ(broken_poses(Kind::pose_dropout, 0.0).size(), 200U);
  const auto frozen = broken_poses(Kind::pose_freeze, 0.0);
  const auto jump = broken_poses(Kind::pose_jump, 0.5);
  const auto step = broken_poses(Kind::pose_clock_step, -1.0);
  const auto jitter = broken_poses(Kind::pose_jitter, 0.004);
  const auto ghost = broken_poses(Kind::pose_ghost, 7.0);
  double squares = 0.0;
  for (std::size_t i = 0; i < 300; ++i) {
    const bool acts = i >= 100 && i < 200;
    EXPECT_EQ(frozen[i].position, acts ? healthy[99].position : healthy[i].position);
    EXPECT_EQ(frozen[i].time, healthy[i].time);
    EXPECT_NEAR(jump[i].position.x() - healthy[i].position.x(), acts ? 0.5 : 0.0, 1e-12);
    EXPECT_NEAR(step[i].time - healthy[i].time, acts ? -1.0 : 0.0, 1e-12);
    EXPECT_NEAR(ghost[i].position.x(), acts ? 7.0 : healthy[i].position.x(), 0.01);
    if (acts) squares += std::pow(jitter[i].time - healthy[i].time, 2);
    if (!acts) {
      EXPECT_EQ(jitter[i].time, healthy[i].time);
    }
  }
  EXPECT_NEAR(std::sqrt(squares / 100.0), 0.004, 0.001);
}

TEST(SensorFaults, ImuFaultsActDuringTheirTimeOnly) {
  using Kind = SensorFaultKind;
  const auto samples = [](Kind kind, double size) {
    ImuSensorParameters p;
    p.rate = 1000.0;
    p.gyro_noise_density = p.accelerometer_noise_density = 0.0;
    p.gyro_bias_walk = p.accelerometer_bias_walk = 0.0;
    ImuSensor sensor(p, 4);
    sensor.add_fault(fault_of(kind, size));
    std::vector<ImuSensor::Measurement> all;
    for (int i = 0; i < 3000; ++i)
      if (const auto m = sensor.sample(1e-3 * i, {3.0, 0.0, 0.0}, {0.0, 0.0, 9.81}))
        all.push_back(*m);
    return all;
  };
  EXPECT_EQ(samples(Kind::imu_dropout, 0.0).size(), 2000U);
  const auto step = samples(Kind::imu_clock_step, 1.0);
  EXPECT_NEAR(step[1500].time, 2.5, 1e-9);
  EXPECT_NEAR(step[2500].time, 2.5, 1e-9);
  const auto cut = samples(Kind::imu_saturation, 0.5);
  EXPECT_EQ(cut[500].angular_velocity.x(), 3.0);
  EXPECT_EQ(cut[1500].angular_velocity.x(), 0.5);
  EXPECT_EQ(cut[1500].specific_force.z(), 5.0);
  const auto vibration = samples(Kind::imu_vibration, 0.2);
  double rate = 0.0, force = 0.0;
  for (std::size_t i = 1000; i < 2000; ++i) {
    rate += std::pow(vibration[i].angular_velocity.y(), 2) / 1000.0;
    force += std::pow(vibration[i].specific_force.x(), 2) / 1000.0;
  }
  EXPECT_NEAR(std::sqrt(rate), 0.2, 0.005);
  EXPECT_NEAR(std::sqrt(force), 2.0, 0.05);
  EXPECT_EQ(vibration[2500].specific_force.x(), 0.0);
}

TEST(SensorFaults, ImuBesideTheComFeelsRotation) {
  ImuSensorParameters p;
  p.rate = 1000.0;
  p.gyro_noise_density = p.accelerometer_noise_density = 0.0;
  p.gyro_bias_walk = p.accelerometer_bias_walk = 0.0;
  p.position << 0.1, 0.0, 0.0;
  ImuSensor sensor(p, 4);
  for (int i = 0; i < 100; ++i) {
    const double rate = 2.0 + 0.003 * i;  // 3 rad/s^2 about z
    const auto m = sensor.sample(1e-3 * i, {0.0, 0.0, rate}, Eigen::Vector3d::Zero());
    ASSERT_TRUE(m);
    if (i == 0) continue;
    EXPECT_NEAR(m->specific_force.x(), -0.1 * rate * rate, 1e-9);
    EXPECT_NEAR(m->specific_force.y(), 0.3, 1e-9);
  }
}

TEST(SensorFaults, HaveNames) {
  for (const auto name : sensor_fault_names) EXPECT_EQ(to_string(*sensor_fault_kind(name)), name);
  EXPECT_FALSE(sensor_fault_kind("pose_melt"));
}

}  // namespace broken_sensors_test
}  // namespace tilt_ropter
