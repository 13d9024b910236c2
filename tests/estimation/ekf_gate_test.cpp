// Measurements above the gate, of something at rest: poses of another object, fixes that stand
// still.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>

#include "support/level_circle.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace ekf_gate_test {

using Eigen::Vector3d;
using Circle = test_support::LevelCircle;

struct AtRest {
  EkfCounts counts;
  double speed;                  // along x, at the end [m/s]
  EstimateTrust before, at_end;  // before the motion, at the end
};

// Hovers. From 4 s on the poses are those of something at rest, `away` from the vehicle. From 8 s
// to 9 s the vehicle accelerates to 1 m/s.
AtRest hover_beside(const Vector3d& away) {
  Ekfd ekf;
  test_support::Random random(5);
  const Vector3d start(0.0, 0.0, 1.5);
  Vector3d position = start, velocity = Vector3d::Zero();
  AtRest result;
  for (int i = 0; i <= 14000; ++i) {
    const double t = 1e-3 * i;
    const Vector3d acceleration = t > 8.0 && t < 9.0 ? Vector3d(1.0, 0.0, 0.0) : Vector3d::Zero();
    velocity += 1e-3 * acceleration;
    position += 1e-3 * velocity;
    ekf.on_imu(
        t, {random.vector(2e-3), acceleration + Vector3d(0.0, 0.0, gravity) + random.vector(0.02)});
    if (i % 10 != 0) continue;
    const Vector3d there = t < 4.0 ? position : start + away;
    ekf.on_pose(t, {there + random.vector(1e-3), quaternion_exp(random.vector(3e-3))});
    if (i == 7900) result.before = ekf.trust(t);
  }
  result.counts = ekf.counts();
  result.speed = ekf.state().velocity.x();
  result.at_end = ekf.trust(14.0);
  return result;
}

// At rest another object at rest cannot be told from a moved origin. The first motion tells it.
TEST(EkfGate, OneShortRestartAtRestIsAllowed) {
  const AtRest near = hover_beside({0.5, 0.0, 0.0});
  EXPECT_EQ(near.counts.restarts, 1);
  EXPECT_EQ(near.before.state, EstimateState::good);
  EXPECT_TRUE(near.before.unconfirmed);
  EXPECT_GT(near.speed, 0.4);  // true: 1 m/s; that of the object: 0
  EXPECT_NE(near.at_end.state, EstimateState::good);
  const AtRest far = hover_beside({0.0, 0.0, -1.5});
  EXPECT_EQ(far.counts.restarts, 0);
  EXPECT_NE(far.before.state, EstimateState::good);
  EXPECT_FALSE(far.before.unconfirmed);
  EXPECT_NEAR(far.speed, 1.0, 0.5);
}

// Flies the circle for 24 s by IMU. Calls sense(i, t, truth, random) after each sample, at 1 kHz.
template <typename Sense>
void fly_circle(Ekfd& ekf, unsigned seed, const Sense& sense) {
  const Circle circle;
  test_support::Random random(seed);
  for (int i = 0; i <= 24000; ++i) {
    const double t = 1e-3 * i;
    const BodyStated truth = circle.body(t);
    ekf.on_imu(t, {random.vector(2e-3), circle.specific_force(t) + random.vector(0.02)});
    if (i == 0) ekf.start(truth, {0.02, 0.05, 0.02});
    sense(i, t, truth, random);
  }
}

// A receiver that repeats its last fix, bit for bit or with noise.
TEST(EkfGate, FixesThatStandStillAreNotFollowed) {
  struct Case {
    double noise, duration, limit;
  };
  for (const auto& [noise, duration, limit] :
       {Case{0.0, 2.0, 0.15}, Case{0.0, 10.0, 3.0}, Case{1.0, 2.0, 0.15}, Case{1.0, 10.0, 3.0}}) {
    Ekfd ekf;
    const double width = noise, until = 10.0 + duration;  // lambdas capture no structured bindings
    BodyStated frozen;
    double largest = 0.0, at_end = 0.0;
    int repeated = 0;
    fly_circle(ekf, 6, [&](int i, double t, const BodyStated& truth, test_support::Random& random) {
      if (i % 100 != 50) return;
      const bool stands = t > 10.0 && t < until;
      BodyStated fix = frozen;
      if (!stands || width > 0.0) {
        if (!stands) fix = truth;
        fix.position += random.vector(0.03);
        fix.velocity += random.vector(0.08);
        if (!stands) frozen = fix;
      }
      PositionMeasurement<double> place{fix.position, 4e-4 * Eigen::Matrix3d::Identity()};
      WorldVelocityMeasurement<double> speed{fix.velocity, 25e-4 * Eigen::Matrix3d::Identity()};
      if (ekf.on_measurement(t, place) == EkfStatus::frozen) ++repeated;
      if (ekf.on_measurement(t, speed) == EkfStatus::frozen) ++repeated;
      ekf.on_measurement(t, HeadingMeasurement<double>{0.01 * random.uniform(-1.0, 1.0), 0.01});
      EXPECT_EQ(ekf.trust(t).poses_frozen, stands && width == 0.0) << t;
      at_end = (ekf.state().position - truth.position).norm();
      if (t > 2.0) largest = std::max(largest, at_end);
    });
    EXPECT_LT(largest, limit) << noise << ' ' << duration;
    EXPECT_LT(at_end, 0.1) << noise << ' ' << duration;
    EXPECT_EQ(repeated, noise > 0.0 ? 0 : static_cast<int>(20.0 * duration));
  }
}

// Poses that come through on_measurement(). From 8 s to 8 s + duration they are those of an object
// at rest, or displaced by `origin`.
struct Measured {
  int restarts = 0;
  double largest = 0.0, at_end = 0.0;  // error, without the displacement [m]
};
Measured fly_by_measurements(double duration, bool is_object, const Vector3d& origin) {
  Ekfd ekf;
  Measured result;
  fly_circle(ekf, 8, [&](int i, double t, const BodyStated& truth, test_support::Random& random) {
    if (i % 20 != 10) return;
    const bool acts = t > 8.0 && t < 8.0 + duration;
    PoseMeasurement<double> m;
    m.position = acts && is_object ? Vector3d(1.0, 0.0, 1.5) : truth.position;
    if (acts && !is_object) m.position += origin;
    m.position += random.vector(2e-3);
    m.orientation = quaternion_exp(random.vector(5e-3));
    m.covariance.diagonal() << Vector3d::Constant(4e-6), Vector3d::Constant(25e-6);
    if (ekf.on_measurement(t, m) == EkfStatus::restarted) ++result.restarts;
    result.at_end = (ekf.state().position - truth.position).norm();
    if (t > 2.0) result.largest = std::max(result.largest, result.at_end);
  });
  return result;
}

TEST(EkfGate, MeasuredPosesOfAnotherObjectAreNotFollowed) {
  for (const double duration : {1.0, 4.0, 8.0}) {
    const Measured object = fly_by_measurements(duration, true, Vector3d::Zero());
    EXPECT_EQ(object.restarts, 0) << duration;
    EXPECT_LT(object.largest, 0.05 * duration * duration) << duration;  // by the IMU alone
    EXPECT_LT(object.at_end, 0.02) << duration;
  }
}

TEST(EkfGate, MeasuredPosesOfAMovedOriginAreFollowed) {
  const Measured moved = fly_by_measurements(100.0, false, {0.0, 3.0, 0.0});
  EXPECT_EQ(moved.restarts, 1);
  EXPECT_NEAR(moved.at_end, 3.0, 0.02);
}

// A vehicle that is known to stand has the velocity zero at every measurement.
TEST(EkfGate, VelocityZeroMayRepeat) {
  Ekfd ekf;
  test_support::Random random(7);
  for (int i = 0; i <= 3000; ++i) {
    ekf.on_imu(1e-3 * i, {random.vector(2e-3), Vector3d(0.0, 0.0, gravity) + random.vector(0.02)});
    if (i == 0) ekf.start({}, {});
    if (i % 100 != 50) continue;
    const EkfStatus status = ekf.on_measurement(
        1e-3 * i,
        WorldVelocityMeasurement<double>{Vector3d::Zero(), 1e-4 * Eigen::Matrix3d::Identity()});
    EXPECT_EQ(status, EkfStatus::updated);
  }
}

}  // namespace ekf_gate_test
}  // namespace tilt_ropter
