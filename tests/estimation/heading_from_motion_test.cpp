#include <tilt_ropter/estimation/detail/heading_from_motion.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <optional>

namespace tilt_ropter {
namespace heading_from_motion_test {

using Eigen::Vector3d;

struct Given {
  double error = 0.0;  // of the heading [rad]
  double noise = 0.1;  // of the receiver [m], [m/s]
  bool has_velocity = true;
  double scale = 1.0;       // of the accelerometer
  bool overflows = false;   // one position does
  bool of_another = false;  // the fixes are those of another vehicle
};

struct Found {
  double time;         // [s]
  double error;        // of the heading that was found [rad]
  double stddev;       // of this [rad]
  InertialStated off;  // errors of position and velocity
};

// For 20 s with fixes at 10 Hz.
std::optional<Found> fly(unsigned seed, const Given& given) {
  const test_support::Flight flight(seed), another(given.of_another ? seed + 1000 : seed);
  test_support::NoisyImu imu(flight, {}, 0.01, seed + 1);
  test_support::Random random(seed + 2);
  InertialStated start = flight.state(0.0);
  start.orientation = quaternion_from_yaw(given.error) * start.orientation;
  detail::HeadingFromMotion<double> heading;
  heading.begin(start);
  for (int i = 0; i <= 2000; ++i) {
    const double t = 0.01 * i;
    InertialSampled sample = imu(t - 0.005);
    sample.specific_force *= given.scale;
    if (i > 0) heading.predict(sample, 0.01);
    if (i % 10 != 5) continue;
    const InertialStated x = flight.state(t), seen = another.state(t);
    const auto noisy = [&](const Vector3d& v) {
      return Vector3d(v + test_support::normal_vector(random, given.noise));
    };
    InertialStated believed = x;
    believed.orientation = quaternion_from_yaw(given.error) * x.orientation;
    if (given.overflows && i == 25) {
      EXPECT_FALSE(heading.finds_error(true, Vector3d::Constant(1e300), given.noise, believed));
    }
    if (!heading.finds_error(true, noisy(seen.position), given.noise, believed) &&
        !(given.has_velocity &&
          heading.finds_error(false, noisy(seen.velocity), given.noise, believed)))
      continue;
    const InertialStated found = heading.state(x);
    Found result{t,
                 std::remainder(yaw_of(found.orientation) - yaw_of(x.orientation), 2.0 * pi),
                 heading.stddev(),
                 {}};
    result.off.position = found.position - x.position;
    result.off.velocity = found.velocity - x.velocity;
    return result;
  }
  return std::nullopt;
}

TEST(HeadingFromMotion, FindsAnyErrorWithinItsUncertainty) {
  double squares = 0.0;
  int count = 0;
  for (const double error : {0.8, -1.6, 2.5, 3.1})
    for (const double noise : {0.02, 0.3})
      for (const bool has_velocity : {true, false})
        for (unsigned seed = 0; seed < 10; ++seed) {
          const auto found = fly(seed, {error, noise, has_velocity});
          ASSERT_TRUE(found) << error << ' ' << noise << ' ' << has_velocity << ' ' << seed;
          EXPECT_LT(found->time, has_velocity ? 5.0 : 15.0) << error << ' ' << noise;
          EXPECT_LT(std::abs(found->error), 4.0 * found->stddev) << error << ' ' << noise;
          EXPECT_LT(found->off.position.norm(), 3.0 * noise) << error << ' ' << noise;
          EXPECT_LT(found->off.velocity.norm(), 3.0 * noise + (has_velocity ? 0.2 : 1.0))
              << error << ' ' << noise;
          squares += std::pow(found->error / found->stddev, 2);
          ++count;
        }
  EXPECT_LT(squares / count, 2.0);
}

TEST(HeadingFromMotion, ChangesNoRightHeading) {
  const unsigned seeds = test_support::full_run() ? 100 : 20;
  for (const double error : {0.0, 0.2, -0.2})
    for (const double noise : {0.02, 0.3, 1.0})
      for (unsigned seed = 0; seed < seeds; ++seed)
        EXPECT_FALSE(fly(seed, {error, noise})) << error << ' ' << noise << ' ' << seed;
}

TEST(HeadingFromMotion, SurvivesAPositionThatOverflows) {
  for (unsigned seed = 0; seed < 10; ++seed) {
    const auto found = fly(seed, {2.5, 0.1, true, 1.0, true});
    ASSERT_TRUE(found) << seed;
    EXPECT_LT(std::abs(found->error), 4.0 * found->stddev) << seed;
  }
}

// Two of a hundred; without the limits of |c| and of what is left, nearly all.
TEST(HeadingFromMotion, HardlyBelievesTheFixesOfAnotherVehicle) {
  int believed = 0;
  for (unsigned seed = 0; seed < 100; ++seed)
    believed += fly(seed, {0.0, 0.05, true, 1.0, false, true}).has_value();
  EXPECT_LE(believed, 4);
}

// The way of the IMU must be as long as that of the receiver.
TEST(HeadingFromMotion, BelievesNoWrongAccelerometer) {
  for (const double scale : {1.0 / 9.80665, -0.9, 9.80665})
    for (unsigned seed = 0; seed < 10; ++seed)
      EXPECT_FALSE(fly(seed, {0.0, 0.1, true, scale})) << scale << ' ' << seed;
}

}  // namespace heading_from_motion_test
}  // namespace tilt_ropter
