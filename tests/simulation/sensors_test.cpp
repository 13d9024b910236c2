#include <tilt_ropter/simulation/sensors.hpp>

#include "support/random.hpp"
#include "support/state_sensor.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

namespace tilt_ropter {
namespace sensors_test {

using test_support::Random;
using test_support::StateSensor;
using test_support::StateSensorParameters;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
const Eigen::Vector3d zero = Eigen::Vector3d::Zero();

BodyStated random_body(Random& random) {
  BodyStated body;
  body.position = random.vector(3.0);
  body.velocity = random.vector(2.0);
  body.orientation = random.orientation();
  body.angular_velocity = random.vector(4.0);
  return body;
}

/// Mean and standard deviation of the samples, over all entries together.
class Statistics {
 public:
  template <typename Derived>
  void add(const Eigen::MatrixBase<Derived>& sample) {
    for (Eigen::Index i = 0; i < sample.size(); ++i) {
      sum_ += sample(i);
      square_ += sample(i) * sample(i);
      ++count_;
    }
  }
  double mean() const { return sum_ / count_; }
  double deviation() const { return std::sqrt(square_ / count_ - mean() * mean()); }

 private:
  double sum_ = 0.0, square_ = 0.0, count_ = 0.0;
};

TEST(GaussianNoise, MatchesMomentsAndTailsOfNormalDistribution) {
  GaussianNoise noise(7);
  const int n = 1000000;
  double m1 = 0, m2 = 0, m3 = 0, m4 = 0, previous = 0, correlation = 0;
  int beyond_one = 0, beyond_three = 0;
  for (int i = 0; i < n; ++i) {
    const double x = noise.draw();
    m1 += x / n;
    m2 += x * x / n;
    m3 += x * x * x / n;
    m4 += x * x * x * x / n;
    correlation += x * previous / n;
    previous = x;
    beyond_one += std::abs(x) > 1.0;
    beyond_three += std::abs(x) > 3.0;
  }
  EXPECT_NEAR(m1, 0.0, 0.004);
  EXPECT_NEAR(m2, 1.0, 0.006);
  EXPECT_NEAR(m3, 0.0, 0.016);
  EXPECT_NEAR(m4, 3.0, 0.05);
  EXPECT_NEAR(correlation, 0.0, 0.004);
  EXPECT_NEAR(beyond_one / double(n), 0.317311, 0.002);
  EXPECT_NEAR(beyond_three / double(n), 0.0026998, 0.0002);
}

// The random generator is from the C++ standard and the transform is our own. Therefore these
// numbers hold for every standard library.
TEST(GaussianNoise, GivesSameNumbersOnEveryPlatform) {
  GaussianNoise noise(1);
  EXPECT_NEAR(noise.draw(), -0.039399956754155314, 1e-15);
  EXPECT_NEAR(noise.draw(), -0.38683176162103955, 1e-15);
  EXPECT_NEAR(noise.draw(), -0.24894784633514516, 1e-15);
  EXPECT_NEAR(noise.draw(), 0.6868236391793252, 1e-15);
}

template <typename Sensor, typename Sample>
void expect_rate_and_delay(Sensor sensor, double rate, double delay, Sample sample) {
  std::vector<double> stamps;
  for (int k = 0; k <= 2000; ++k) {
    const double time = 100.0 + 1e-3 * k;
    if (const auto m = sample(sensor, time)) {
      stamps.push_back(m->time);
      EXPECT_GE(time, m->time + delay - 1e-8);
      EXPECT_LT(time, m->time + delay + 1e-3 - 1e-8) << "later than the first call it could be at";
    }
  }
  const double expected = (2.0 - delay) * rate + 1.0;
  EXPECT_NEAR(double(stamps.size()), expected, 1.0);
  for (std::size_t i = 0; i < stamps.size(); ++i) {
    const double instant = 100.0 + double(i) / rate;
    EXPECT_GT(stamps[i], instant - 1e-5);
    EXPECT_LT(stamps[i], instant + 1e-3);
  }
}

TEST(Sensors, KeepTheirRateAndDelay) {
  for (const double rate : {30.0, 100.0, 200.0, 333.0, 1000.0})
    for (const double delay : {0.0, 0.0005, 0.007, 0.05}) {
      ImuSensorParameters imu;
      PoseSensorParameters pose;
      RotorSpeedSensorParameters rotors;
      StateSensorParameters state;
      imu.rate = pose.rate = rotors.rate = state.rate = rate;
      imu.delay = pose.delay = rotors.delay = state.delay = delay;
      expect_rate_and_delay(ImuSensor(imu, 1), rate, delay,
                            [](auto& s, double t) { return s.sample(t, zero, zero); });
      expect_rate_and_delay(PoseSensor(pose, 1), rate, delay,
                            [](auto& s, double t) { return s.sample(t, BodyStated{}); });
      expect_rate_and_delay(RotorSpeedSensor<3>(rotors, 1), rate, delay,
                            [](auto& s, double t) { return s.sample(t, zero); });
      expect_rate_and_delay(StateSensor(state, 1), rate, delay,
                            [](auto& s, double t) { return s.sample(t, BodyStated{}); });
    }
}

TEST(Sensors, DelayedMeasurementMatchesTruthAtItsStamp) {
  StateSensorParameters p;
  p.position_noise = 0.0;
  p.rate = 250.0;
  p.delay = 0.033;
  StateSensor sensor(p, 3);
  int count = 0;
  for (int k = 0; k < 3000; ++k) {
    BodyStated truth;
    truth.position.x() = 1e-3 * k;
    if (const auto m = sensor.sample(1e-3 * k, truth)) {
      EXPECT_NEAR(m->body.position.x(), m->time, 1e-12);
      ++count;
    }
  }
  EXPECT_GT(count, 700);
}

TEST(Sensors, TolerateIrregularAndSparseCalls) {
  PoseSensorParameters p;
  p.delay = 0.02;
  PoseSensor sensor(p, 4);
  Random random(4);
  double time = 0.0, last = -1.0;
  int count = 0;
  for (int k = 0; k < 20000; ++k) {
    time += k % 1000 == 0 ? 5.0 : random.uniform(0.0, 0.01);
    if (const auto m = sensor.sample(time, BodyStated{})) {
      EXPECT_GT(m->time, last);
      EXPECT_LE(m->time + p.delay, time + 1e-8);
      last = m->time;
      ++count;
    }
  }
  EXPECT_GT(count, 6000);
}

TEST(Sensors, ReturnNothingForNonFiniteInput) {
  BodyStated lost;
  lost.velocity.y() = nan;
  const Eigen::Vector3d bad(0.0, nan, 0.0);
  ImuSensor imu({}, 1);
  PoseSensor pose({}, 1);
  RotorSpeedSensor<3> rotors({}, 1);
  StateSensor state({}, 1);
  for (int k = 0; k < 100; ++k) {
    EXPECT_FALSE(imu.sample(k, bad, zero));
    EXPECT_FALSE(imu.sample(k, zero, bad));
    EXPECT_FALSE(imu.sample(nan, zero, zero));
    EXPECT_FALSE(imu.sample(std::numeric_limits<double>::infinity(), zero, zero));
    EXPECT_FALSE(pose.sample(k, lost));
    EXPECT_FALSE(rotors.sample(k, bad));
    EXPECT_FALSE(state.sample(k, lost));
  }
  EXPECT_TRUE(imu.sample(100.0, zero, zero));
  EXPECT_TRUE(rotors.sample(100.0, zero));
  EXPECT_TRUE(state.sample(100.0, BodyStated{}));
}

TEST(Sensors, SameSeedGivesSameBitsAndOtherSeedDiffers) {
  const auto run = [](std::uint64_t seed) {
    std::vector<double> values;
    ImuSensor imu({}, seed);
    PoseSensor pose({}, seed);
    RotorSpeedSensor<3> rotors({}, seed);
    StateSensor state({}, seed);
    Random random(5);
    for (int k = 0; k < 500; ++k) {
      const double time = 1e-3 * k;
      const BodyStated body = random_body(random);
      const auto add = [&](const auto& v) {
        for (Eigen::Index i = 0; i < v.size(); ++i) values.push_back(v(i));
      };
      if (const auto m = imu.sample(time, body.angular_velocity, body.velocity))
        add(m->angular_velocity), add(m->specific_force);
      if (const auto m = pose.sample(time, body)) add(m->position), add(m->orientation.coeffs());
      if (const auto m = rotors.sample(time, Eigen::Vector3d(900.0, 1000.0, 1100.0)))
        add(m->rotor_speed);
      if (const auto m = state.sample(time, body))
        add(m->body.velocity), add(m->body.orientation.coeffs());
    }
    return values;
  };
  const std::vector<double> a = run(11), b = run(11), c = run(12);
  ASSERT_EQ(a.size(), b.size());
  ASSERT_GT(a.size(), 3000u);
  EXPECT_EQ(std::memcmp(a.data(), b.data(), a.size() * sizeof(double)), 0);
  EXPECT_NE(std::memcmp(a.data(), c.data(), a.size() * sizeof(double)), 0);
}

TEST(StateSensor, HasTheNoiseItIsGiven) {
  const StateSensorParameters p;
  StateSensor sensor(p, 21);
  Random random(6);
  Statistics position, velocity, orientation, rate;
  for (int k = 0; k < 20000; ++k) {
    const BodyStated truth = random_body(random);
    const auto m = sensor.sample(1e-3 * k, truth);
    ASSERT_TRUE(m);
    EXPECT_NEAR(m->body.orientation.norm(), 1.0, 1e-12);
    position.add(m->body.position - truth.position);
    velocity.add(m->body.velocity - truth.velocity);
    orientation.add(
        quaternion_log(Eigen::Quaterniond(truth.orientation.conjugate() * m->body.orientation)));
    rate.add(m->body.angular_velocity - truth.angular_velocity);
  }
  const auto expect = [](const Statistics& s, double deviation) {
    EXPECT_NEAR(s.mean(), 0.0, 0.02 * deviation);
    EXPECT_NEAR(s.deviation(), deviation, 0.015 * deviation);
  };
  expect(position, p.position_noise);
  expect(velocity, p.velocity_noise);
  expect(orientation, p.orientation_noise);
  expect(rate, p.angular_velocity_noise);
  EXPECT_NEAR(p.position_noise, 1e-3, 1e-12);
  EXPECT_NEAR(p.velocity_noise, 1e-2, 1e-12);
  EXPECT_NEAR(p.orientation_noise, 3e-3, 1e-12);
  EXPECT_NEAR(p.angular_velocity_noise, 1e-2, 1e-12);
}

TEST(PoseSensor, HasTheNoiseItIsGiven) {
  PoseSensorParameters p;
  p.position_noise = 0.002;
  p.orientation_noise = 0.01;
  p.delay = 0.0;
  PoseSensor sensor(p, 22);
  Random random(7);
  Statistics position, orientation;
  for (int k = 0; k < 20000; ++k) {
    const BodyStated truth = random_body(random);
    const auto m = sensor.sample(0.01 * k, truth);
    ASSERT_TRUE(m);
    position.add(m->position - truth.position);
    orientation.add(
        quaternion_log(Eigen::Quaterniond(truth.orientation.conjugate() * m->orientation)));
  }
  EXPECT_NEAR(position.deviation(), 0.002, 3e-5);
  EXPECT_NEAR(position.mean(), 0.0, 4e-5);
  EXPECT_NEAR(orientation.deviation(), 0.01, 1.5e-4);
  EXPECT_NEAR(orientation.mean(), 0.0, 2e-4);
}

TEST(RotorSpeedSensor, HasTheNoiseItIsGivenAndNeverGoesNegative) {
  RotorSpeedSensorParameters p;
  p.noise = 8.0;
  p.rate = 1000.0;
  RotorSpeedSensor<4> sensor(p, 23);
  Statistics speed;
  for (int k = 0; k < 20000; ++k) {
    const auto m = sensor.sample(1e-3 * k, Eigen::Vector4d::Constant(1600.0));
    ASSERT_TRUE(m);
    speed.add(m->rotor_speed);
  }
  EXPECT_NEAR(speed.mean(), 1600.0, 0.15);
  EXPECT_NEAR(speed.deviation(), 8.0, 0.1);
  double smallest = 1.0;
  for (int k = 0; k < 100; ++k)
    smallest = std::min(smallest,
                        sensor.sample(50.0 + k, Eigen::Vector4d::Zero())->rotor_speed.minCoeff());
  EXPECT_GE(smallest, 0.0);
}

// White noise of density N, sampled at any rate f, has the standard deviation N sqrt(f).
TEST(ImuSensor, NoiseHasTheGivenDensityAtAnyRate) {
  for (const double rate : {100.0, 1000.0}) {
    ImuSensorParameters p;
    p.rate = rate;
    p.gyro_noise_density = 3e-3;
    p.accelerometer_noise_density = 2e-2;
    p.gyro_bias_walk = p.accelerometer_bias_walk = 0.0;
    p.gyro_bias << 0.1, -0.2, 0.3;
    p.accelerometer_bias << -0.4, 0.5, 0.6;
    ImuSensor sensor(p, 24);
    Statistics gyro, accelerometer;
    const Eigen::Vector3d w(1.0, 2.0, 3.0), f(0.0, 1.0, 9.8);
    for (int k = 0; k < 20000; ++k) {
      const auto m = sensor.sample(k / rate, w, f);
      ASSERT_TRUE(m);
      gyro.add(m->angular_velocity - w - p.gyro_bias);
      accelerometer.add(m->specific_force - f - p.accelerometer_bias);
    }
    EXPECT_NEAR(gyro.deviation() / (3e-3 * std::sqrt(rate)), 1.0, 0.015);
    EXPECT_NEAR(gyro.mean() / (3e-3 * std::sqrt(rate)), 0.0, 0.02);
    EXPECT_NEAR(accelerometer.deviation() / (2e-2 * std::sqrt(rate)), 1.0, 0.015);
    EXPECT_NEAR(accelerometer.mean() / (2e-2 * std::sqrt(rate)), 0.0, 0.02);
  }
}

// A random walk of density N has the standard deviation N sqrt(t) after the time t.
TEST(ImuSensor, BiasWalksWithTheGivenDensity) {
  ImuSensorParameters p;
  p.gyro_bias_walk = 0.01;
  p.accelerometer_bias_walk = 0.05;
  Statistics gyro, accelerometer;
  for (std::uint64_t seed = 0; seed < 1500; ++seed) {
    ImuSensor sensor(p, seed);
    for (int k = 0; k < 400; ++k) (void)sensor.sample(k / p.rate, zero, zero);
    gyro.add(sensor.gyro_bias());
    accelerometer.add(sensor.accelerometer_bias());
  }
  EXPECT_NEAR(gyro.deviation(), 0.01 * std::sqrt(2.0), 0.01 * 0.06);
  EXPECT_NEAR(accelerometer.deviation(), 0.05 * std::sqrt(2.0), 0.05 * 0.06);
  EXPECT_NEAR(gyro.mean(), 0.0, 0.01 * 0.1);
}

TEST(Sensors, ResetAllowsTimeToStartAnew) {
  PoseSensorParameters p;
  p.delay = 0.05;
  PoseSensor sensor(p, 1);
  for (int i = 0; i < 100; ++i) (void)sensor.sample(10.0 + 0.01 * i, {});
  EXPECT_FALSE(sensor.sample(0.0, {}));
  EXPECT_FALSE(sensor.sample(0.2, {}));  // without a reset the grid waits for the old time
  sensor.reset();
  int count = 0;
  for (int i = 0; i < 100; ++i)
    if (const auto m = sensor.sample(0.01 * i, {})) {
      ++count;
      EXPECT_LT(m->time, 1.0);
    }
  EXPECT_EQ(count, 95);
}

}  // namespace sensors_test
}  // namespace tilt_ropter
