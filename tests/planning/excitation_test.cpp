// The derivatives of Excitation are those of its position and orientation, and it stays small.

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/planning/excitation.hpp>

#include <gtest/gtest.h>
#include <Eigen/Core>

#include <cmath>
#include <limits>

namespace excitation_test {

using namespace tilt_ropter;

TEST(Excitation, DerivativesAreThoseOfPositionAndOrientation) {
  ExcitationSettings settings;
  settings.center.yaw = 0.7;
  Excitation motion(settings);
  motion.set_start_time(3.0);
  constexpr double h = 1e-4;
  for (double time = 3.0 + 0.01; time < 3.0 + settings.duration; time += 0.0837) {
    const ReferencePoint before = motion(time - h), now = motion(time), after = motion(time + h);
    const Eigen::Vector3d velocity = (after.position - before.position) / (2.0 * h);
    const Eigen::Vector3d acceleration = (after.velocity - before.velocity) / (2.0 * h);
    const Eigen::Vector3d rates =
        (quaternion_log(Eigen::Quaterniond(now.orientation.conjugate() * after.orientation)) -
         quaternion_log(Eigen::Quaterniond(now.orientation.conjugate() * before.orientation))) /
        (2.0 * h);
    const Eigen::Vector3d turning = (after.angular_velocity - before.angular_velocity) / (2.0 * h);
    EXPECT_LT((now.velocity - velocity).norm(), 1e-5) << time;
    EXPECT_LT((now.acceleration - acceleration).norm(), 1e-4) << time;
    EXPECT_LT((now.angular_velocity - rates).norm(), 1e-5) << time;
    EXPECT_LT((now.angular_acceleration - turning).norm(), 1e-4) << time;
  }
}

TEST(Excitation, StartsAndEndsAtRestAtItsCenterAndStaysSmall) {
  ExcitationSettings settings;
  settings.center.position << 1.0, -2.0, 1.5;
  settings.center.yaw = -0.4;
  const Excitation motion(settings);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (const double time : {nan, -1.0, 0.0, settings.duration, settings.duration + 5.0}) {
    const ReferencePoint point = motion(time);
    EXPECT_LT((point.position - settings.center.position).norm(), 1e-12);
    EXPECT_LT(point.velocity.norm() + point.acceleration.norm(), 1e-12);
    EXPECT_LT(point.angular_velocity.norm() + point.angular_acceleration.norm(), 1e-12);
    EXPECT_NEAR(yaw_of(point.orientation), settings.center.yaw, 1e-12);
  }
  double farthest = 0.0, widest = 0.0;
  for (double time = 0.0; time < settings.duration; time += 0.01) {
    const ReferencePoint point = motion(time);
    farthest = std::max(farthest, (point.position - settings.center.position).norm());
    widest = std::max(widest, std::acos(point.orientation.toRotationMatrix()(2, 2)));
  }
  EXPECT_GT(farthest, 0.05);
  EXPECT_LT(farthest, 0.3);
  EXPECT_GT(widest, 0.1);
  EXPECT_LT(widest, 0.35);
}

TEST(Excitation, ZeroAccelerationsKeepTheirAxesStill) {
  ExcitationSettings moves, turns;
  moves.angular_acceleration = 0.0;
  turns.acceleration = 0.0;
  const ReferencePoint moved = Excitation(moves)(6.3), turned = Excitation(turns)(6.3);
  EXPECT_GT(moved.velocity.norm(), 0.01);
  EXPECT_EQ(moved.angular_velocity.norm(), 0.0);
  EXPECT_GT(turned.angular_velocity.norm(), 0.01);
  EXPECT_EQ(turned.velocity.norm(), 0.0);
}

}  // namespace excitation_test
