#include <tilt_ropter/model/frames.hpp>

#include <gtest/gtest.h>

#include <stdexcept>

#include "support/autodiff.hpp"
#include "support/random.hpp"

namespace frames_test {

using namespace tilt_ropter;
using Eigen::Vector3d;

TEST(Frames, BodyInWorldMapsBodyPointsToTheWorld) {
  test_support::Random random(1);
  for (int i = 0; i < 100; ++i) {
    BodyStated body;
    body.position = random.vector(10.0);
    body.orientation = random.orientation();
    const Vector3d point = random.vector(1.0);
    const Vector3d expected = body.orientation * point + body.position;
    EXPECT_LT((body_in_world(body) * point - expected).norm(), 1e-14);
    EXPECT_LT((body_in_world(body).inverse() * expected - point).norm(), 1e-13);
  }
}

TEST(Frames, RotorFramesHaveXAlongTheArm) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const double arm = vehicle.rotors[0].position.norm();
  const Vector3d tips[] = {-Vector3d::UnitY(), Vector3d::UnitY(), Vector3d::UnitX(),
                           -Vector3d::UnitX()};
  for (std::size_t i = 0; i < 4; ++i) {
    EXPECT_LT((rotor_in_body(vehicle, i) * Vector3d::Zero() - arm * tips[i]).norm(), 1e-15);
    EXPECT_LT((rotor_in_body(vehicle, i).linear() * Vector3d::UnitX() - tips[i]).norm(), 1e-15);
  }
  EXPECT_THROW(static_cast<void>(rotor_in_body(vehicle, 4)), std::out_of_range);
}

TEST(Frames, WheelFramesHaveXAlongTheAxleAndZUp) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  for (std::size_t i = 0; i < 2; ++i) {
    const Eigen::Isometry3d wheel = wheel_in_body(vehicle, i);
    EXPECT_NEAR(wheel.linear().determinant(), 1.0, 1e-15);
    EXPECT_LT((wheel.linear() * Vector3d::UnitX() - Vector3d::UnitY()).norm(), 1e-15);
    EXPECT_LT((wheel.linear() * Vector3d::UnitZ() - Vector3d::UnitZ()).norm(), 1e-15);
    // The wheel and the rotor of the same number are on the same arm.
    EXPECT_GT(wheel.translation().dot(vehicle.rotors[i].position), 0.0);
    EXPECT_NEAR(wheel.translation().norm(), vehicle.wheels->half_track, 1e-15);
  }
}

TEST(Frames, PositiveTiltPushesToTheRightOfTheArm) {
  test_support::Random random(2);
  for (int i = 0; i < 100; ++i) {
    const double azimuth = random.uniform(-pi, pi), alpha = random.uniform(-pi, pi);
    const RotorGeometry rotor = rotor_on_arm(azimuth, 0.2, Spin::clockwise);
    const Vector3d thrust = rotor.orientation * thrust_direction(alpha);
    const Vector3d expected(std::sin(alpha) * std::sin(azimuth),
                            -std::sin(alpha) * std::cos(azimuth), std::cos(alpha));
    EXPECT_LT((thrust - expected).norm(), 1e-15);
    // The same result by rotating the vertical about the arm.
    const Vector3d turned = Eigen::AngleAxisd(alpha, rotor.orientation.col(0)) * Vector3d::UnitZ();
    EXPECT_LT((thrust - turned).norm(), 1e-15);
  }
}

TEST(Frames, ThrustDirectionWorksInFloatAndWithDerivatives) {
  EXPECT_LT((thrust_direction(0.7F).cast<double>() - thrust_direction(0.7)).norm(), 1e-7);
  const double alpha = 0.7;
  const auto derivative = test_support::jacobian_at_zero<3, 1>([&](const auto& dual) {
    const test_support::Dual<1> angle = alpha + dual(0);
    return thrust_direction(angle);
  });
  EXPECT_LT((derivative - Vector3d(0.0, -std::cos(alpha), -std::sin(alpha))).norm(), 1e-15);
}

}  // namespace frames_test
