#include <tilt_ropter/model/state.hpp>

#include "support/random.hpp"
#include "support/states.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace state_test {

using test_support::Random;
using test_support::random_state;

TEST(State, DifferenceUndoesRetract) {
  Random random(61);
  for (int i = 0; i < 1000; ++i) {
    const Stated x = random_state(random);
    StateTangentd dx;
    for (int j = 0; j < 18; ++j) dx(j) = random.normal(0.5);
    if (i % 10 == 0) dx *= 1e-8;
    EXPECT_LT((difference(retract(x, dx), x) - dx).norm(), 1e-12 * (1.0 + dx.norm()) + 1e-14);
  }
}

TEST(State, RetractUndoesDifferenceEvenForOppositeQuaternions) {
  Random random(62);
  for (int i = 0; i < 1000; ++i) {
    const Stated x = random_state(random);
    Stated y = random_state(random);
    if (i % 10 == 0) y.body.orientation.coeffs() = -x.body.orientation.coeffs();
    const Stated z = retract(x, difference(y, x));
    EXPECT_LT(difference(z, y).norm(), 1e-12);
  }
}

TEST(State, OrientationErrorIsInTheBodyFrame) {
  Stated x;
  x.body.orientation = Eigen::AngleAxisd(1.0, Eigen::Vector3d::UnitZ());
  Stated y = x;
  y.body.orientation = x.body.orientation * Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitX());
  EXPECT_LT(
      (difference(y, x).segment<3>(TangentIndex::orientation) - Eigen::Vector3d(0.3, 0, 0)).norm(),
      1e-15);
}

TEST(State, IsFiniteChecksEveryNumber) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  BodyStated state;
  EXPECT_TRUE(is_finite(state));
  state.position.z() = nan;
  EXPECT_FALSE(is_finite(state));
  state = {};
  state.velocity.x() = std::numeric_limits<double>::infinity();
  EXPECT_FALSE(is_finite(state));
  state = {};
  state.angular_velocity.y() = nan;
  EXPECT_FALSE(is_finite(state));
  state = {};
  state.orientation.w() = nan;
  EXPECT_FALSE(is_finite(state));
  state.orientation.coeffs().setZero();
  EXPECT_FALSE(is_finite(state));
  Wrenchd wrench;
  EXPECT_TRUE(is_finite(wrench));
  wrench.torque.y() = nan;
  EXPECT_FALSE(is_finite(wrench));
}

TEST(HalfSpace, HoldsAReferenceInFrontOfASurface) {
  Surface ceiling;
  ceiling.point << 1.0, 2.0, 3.0;
  ceiling.normal << 0.6, 0.0, -0.8;
  const HalfSpace h = in_front_of(ceiling, 0.5);
  const Eigen::Vector3d touches = ceiling.point + 0.5 * ceiling.normal;
  EXPECT_NEAR(h.beyond(touches), 0.0, 1e-12);
  ReferencePoint point;
  point.position = touches - 0.2 * ceiling.normal + Eigen::Vector3d(0.8, 0.0, 0.6);
  point.velocity << 1.0, 2.0, 3.0;
  point.acceleration << -1.0, 0.5, 2.0;
  point.inside[0] = h;
  const ReferencePoint held = held_inside(h, point);
  EXPECT_NEAR(h.beyond(point.position), 0.2, 1e-12);
  EXPECT_LT((held.position - touches - Eigen::Vector3d(0.8, 0.0, 0.6)).norm(), 1e-12);
  EXPECT_NEAR(held.velocity.dot(ceiling.normal), 0.0, 1e-12);
  EXPECT_NEAR(held.acceleration.dot(ceiling.normal), 0.0, 1e-12);
  EXPECT_NEAR(held.velocity.y(), 2.0, 1e-12);
  point.position = touches + 0.1 * ceiling.normal;
  EXPECT_EQ(held_inside(h, point).velocity, point.velocity);
  EXPECT_EQ(held_inside({}, point).position, point.position);
  EXPECT_TRUE(is_usable(h));
  EXPECT_TRUE(is_usable(HalfSpace{}));
}

}  // namespace state_test
}  // namespace tilt_ropter
