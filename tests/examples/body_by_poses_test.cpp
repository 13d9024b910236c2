// BodyByPoses against a rigid body that is integrated here, pushed and turned by an unknown wrench.

#include "../../examples/support/body_by_poses.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <deque>

namespace body_by_poses_test {

using namespace tilt_ropter;
using Eigen::Vector3d;

struct Errors {
  double position = 0.0, velocity = 0.0, orientation = 0.0, rate = 0.0, force = 0.0, torque = 0.0;
};

struct Given {
  double delay = 0.03;                                         // of the poses [s]
  double poses_end = 10.0;                                     // [s]
  int outlier_every = 0;                                       // poses; 0: none
  double jump = 0.0;                                           // of all poses from 4 s on [m]
  Vector3d imu_force{0.0, 0.0, 0.0}, imu_rate{0.0, 0.0, 0.0};  // errors [m/s^2], [rad/s]
  double imu_start = 4.0, imu_end = 10.0;                      // of these [s]
  double imu_swing = 0.0;                                      // their frequency [Hz]; 0: constant
  bool in_the_air = true;
};

// Flies for 6 s with actuators that hold the body and shake it. Returns the largest errors of the
// last second.
Errors fly(examples::BodyByPoses& by_poses, const Given& given = {}) {
  const RigidBodyParameters body = tilt_ropter_vehicle().body;
  const Vector3d force(1.0, -2.0, 0.5), torque(0.05, -0.04, 0.03);  // external: world, body
  constexpr double dt = 1e-3;
  BodyStated x;
  x.position = {0.3, 0.2, 1.0};
  struct Seen {
    double time;
    BodyStated body;
  };
  std::deque<Seen> seen;
  Errors e;
  for (int i = 0; i < 6000; ++i) {
    const double t = dt * i;
    const Vector3d shake(std::sin(3.0 * t), std::cos(2.0 * t), std::sin(t));
    Wrenchd applied;
    applied.force = x.orientation.conjugate() *
                    Vector3d(3.0 * shake + body.mass * gravity * Vector3d::UnitZ() - force);
    applied.torque = 0.1 * shake - torque - 0.2 * x.angular_velocity;
    by_poses.predict(t, applied);
    const Vector3d acceleration =
        (x.orientation * applied.force + force) / body.mass - gravity * Vector3d::UnitZ();
    const Vector3d turning =
        body.inertia.inverse() *
        (applied.torque + torque - x.angular_velocity.cross(body.inertia * x.angular_velocity));
    const double swing = std::cos(2.0 * pi * given.imu_swing * t),
                 lies = t > given.imu_start && t < given.imu_end ? swing : 0.0;
    InertialSampled imu;
    imu.angular_velocity = x.angular_velocity + lies * given.imu_rate;
    imu.specific_force = applied.force / body.mass + x.orientation.conjugate() * force / body.mass +
                         lies * given.imu_force;
    by_poses.compare(imu, applied, given.in_the_air);
    if (t > 5.0 && t <= given.poses_end) {
      const BodyStated& b = by_poses.body();
      const Wrenchd external = by_poses.external();
      e.position = std::max(e.position, (b.position - x.position).norm());
      e.velocity = std::max(e.velocity, (b.velocity - x.velocity).norm());
      e.orientation = std::max(e.orientation, b.orientation.angularDistance(x.orientation));
      e.rate = std::max(e.rate, (b.angular_velocity - x.angular_velocity).norm());
      e.force = std::max(e.force, (b.orientation * external.force - force).norm());
      e.torque = std::max(e.torque, (external.torque - torque).norm());
    }
    seen.push_back({t, x});
    if (i % 10 == 0 && t <= given.poses_end && t > given.delay) {
      while (seen.front().time < t - given.delay - 0.5 * dt) seen.pop_front();
      const bool is_outlier = given.outlier_every > 0 && (i / 10) % given.outlier_every == 0;
      const double off = (is_outlier ? 0.5 : 0.0) + (t > 4.0 ? given.jump : 0.0);
      by_poses.correct(seen.front().time, seen.front().body.position + off * Vector3d::UnitX(),
                       seen.front().body.orientation);
    }
    x.position += dt * x.velocity + 0.5 * dt * dt * acceleration;
    x.velocity += dt * acceleration;
    x.orientation =
        x.orientation * quaternion_exp(Vector3d(dt * x.angular_velocity + 0.5 * dt * dt * turning));
    x.angular_velocity += dt * turning;
  }
  return e;
}

void expect_known(const Errors& e) {
  EXPECT_LT(e.position, 0.005);
  EXPECT_LT(e.velocity, 0.03);
  EXPECT_LT(e.orientation, 0.005);
  EXPECT_LT(e.rate, 0.05);
  EXPECT_LT(e.force, 0.2);
  EXPECT_LT(e.torque, 0.02);
}

TEST(BodyByPoses, KnowsMotionAndExternalWrenchFromLatePoses) {
  for (const double delay : {0.0, 0.03, 0.1}) {
    SCOPED_TRACE(delay);
    examples::BodyByPoses by_poses(tilt_ropter_vehicle().body);
    EXPECT_FALSE(by_poses.is_valid());
    Given given;
    given.delay = delay;
    expect_known(fly(by_poses, given));
    EXPECT_TRUE(by_poses.is_valid());
  }
}

TEST(BodyByPoses, IgnoresOutliersAndFollowsAJump) {
  Given given;
  given.outlier_every = 7;
  examples::BodyByPoses by_poses(tilt_ropter_vehicle().body);
  expect_known(fly(by_poses, given));
  given.outlier_every = 0;
  given.jump = 0.4;
  examples::BodyByPoses displaced(tilt_ropter_vehicle().body);
  const Errors e = fly(displaced, given);
  EXPECT_NEAR(e.position, 0.4, 0.05);
  EXPECT_LT(e.orientation, 0.02);
}

bool contradicts(const Given& given) {
  examples::BodyByPoses by_poses(tilt_ropter_vehicle().body);
  fly(by_poses, given);
  return by_poses.contradicts_imu();
}

// The ground pushes as well, and an impact passes.
TEST(BodyByPoses, ContradictsAWrongImuOnly) {
  EXPECT_FALSE(contradicts({}));
  Given force, rate, impact;
  force.imu_force = {0.0, 1.2, 0.0};
  EXPECT_TRUE(contradicts(force));
  force.in_the_air = false;
  EXPECT_FALSE(contradicts(force));
  rate.imu_rate = {0.4, 0.0, 0.0};
  rate.in_the_air = false;
  EXPECT_TRUE(contradicts(rate));
  impact.imu_force = {0.0, 0.0, 40.0};
  impact.imu_rate = {0.0, 5.0, 0.0};
  impact.imu_start = 5.96;
  impact.imu_end = 5.98;
  EXPECT_FALSE(contradicts(impact));
  impact.imu_end = 10.0;
  impact.imu_start = 5.5;
  EXPECT_TRUE(contradicts(impact));
}

bool vibrates(const Given& given) {
  examples::BodyByPoses by_poses(tilt_ropter_vehicle().body);
  fly(by_poses, given);
  return by_poses.imu_vibrates();
}

TEST(BodyByPoses, FindsAnImuThatSwingsWithWhatTheBodyWouldFollow) {
  Given rate, force;
  rate.imu_rate = {0.0, 0.7, 0.0};
  force.imu_force = {0.0, 0.0, 3.5};
  for (Given* given : {&rate, &force}) {
    EXPECT_FALSE(vibrates(*given));  // an offset, or something pushes
    for (const double frequency : {5.0, 12.5, 20.0}) {
      given->imu_swing = frequency;
      EXPECT_TRUE(vibrates(*given)) << frequency;
    }
    for (const double frequency : {1.0, 150.0}) {
      given->imu_swing = frequency;
      EXPECT_FALSE(vibrates(*given)) << frequency;
    }
  }
  force.imu_swing = 12.5;
  force.in_the_air = false;
  EXPECT_FALSE(vibrates(force));
  rate.imu_swing = 12.5;
  rate.imu_rate *= 0.4;
  EXPECT_FALSE(vibrates(rate));
}

TEST(BodyByPoses, IsInvalidWithoutPoses) {
  Given given;
  given.poses_end = 5.7;
  examples::BodyByPoses by_poses(tilt_ropter_vehicle().body);
  fly(by_poses, given);
  EXPECT_FALSE(by_poses.is_valid());
}

}  // namespace body_by_poses_test
