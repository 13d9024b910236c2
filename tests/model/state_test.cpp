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

}  // namespace state_test
}  // namespace tilt_ropter
