#include <tilt_ropter/model/state.hpp>

#include "support/autodiff.hpp"
#include "support/random.hpp"

#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

namespace tilt_ropter {
namespace wrench_test {

using Eigen::Vector3d;
using test_support::Random;

Wrenchd random_wrench(Random& random) {
  const Vector3d force = random.vector(10.0);
  return {force, random.vector(1.0)};
}

double distance(const Wrenchd& a, const Wrenchd& b) {
  return (a.force - b.force).norm() + (a.torque - b.torque).norm();
}

TEST(Wrench, TransportGivesTorqueOfForceAboutCom) {
  // An upward force at the front raises the nose, a rotation about -y.
  const Wrenchd at_com =
      transport(Wrenchd{Vector3d(0, 0, 2.0), Vector3d(0, 0, 0.1)}, Vector3d(0.5, 0, 0));
  EXPECT_EQ(at_com.force, Vector3d(0, 0, 2.0));
  EXPECT_EQ(at_com.torque, Vector3d(0, -1.0, 0.1));
}

TEST(Wrench, PowerIsInvariantUnderTransport) {
  Random random(71);
  for (int i = 0; i < 1000; ++i) {
    const Wrenchd at_tool = random_wrench(random);
    const Vector3d tool = random.vector(1.0), v = random.vector(3.0), w = random.vector(5.0);
    const Wrenchd at_com = transport(at_tool, tool);
    const Vector3d v_tool = v + w.cross(tool);
    EXPECT_NEAR(at_com.force.dot(v) + at_com.torque.dot(w),
                at_tool.force.dot(v_tool) + at_tool.torque.dot(w), 1e-12);
  }
}

TEST(Wrench, PowerIsInvariantUnderRotation) {
  Random random(72);
  for (int i = 0; i < 1000; ++i) {
    const Wrenchd in_body = random_wrench(random);
    const Vector3d v = random.vector(3.0), w = random.vector(5.0);
    const Eigen::Quaterniond q = random.orientation();
    const Wrenchd in_world = wrench_in_world(in_body, q);
    EXPECT_NEAR(in_world.force.dot(q * v) + in_world.torque.dot(q * w),
                in_body.force.dot(v) + in_body.torque.dot(w), 1e-12);
  }
}

TEST(Wrench, RoundTripIsIdentity) {
  Random random(73);
  for (int i = 0; i < 1000; ++i) {
    const Wrenchd wrench = random_wrench(random);
    const Vector3d lever = random.vector(1.0);
    const Eigen::Quaterniond q = random.orientation();
    EXPECT_LT(distance(transport(transport(wrench, lever), Vector3d(-lever)), wrench), 1e-14);
    EXPECT_LT(distance(wrench_in_body(wrench_in_world(wrench, q), q), wrench), 1e-13);
  }
}

TEST(Wrench, WrenchInWorldMatchesBodyAxes) {
  // Facing left: body x is world y.
  const Eigen::Quaterniond left = quaternion_from_yaw(pi / 2.0);
  const Wrenchd in_world = wrench_in_world(Wrenchd{Vector3d(1, 2, 3), Vector3d(4, 5, 6)}, left);
  EXPECT_LT((in_world.force - Vector3d(-2, 1, 3)).norm(), 1e-14);
  EXPECT_LT((in_world.torque - Vector3d(-5, 4, 6)).norm(), 1e-14);
}

TEST(Wrench, AgreesWithWheelFramePose) {
  // Wrench of a wheel's ground contact in the wheel frame: its power at the wheel equals its power
  // at the CoM.
  Random random(74);
  const Eigen::Isometry3d wheel = wheel_in_body(tilt_ropter_vehicle(), 1);
  const Eigen::Quaterniond turn(wheel.linear());
  for (int i = 0; i < 100; ++i) {
    const Vector3d force = random.vector(10.0), v = random.vector(3.0), w = random.vector(5.0);
    const Wrenchd at_com = transport(wrench_in_world(Wrenchd{force, Vector3d::Zero()}, turn),
                                     Vector3d(wheel.translation()));
    const Vector3d v_wheel = wheel.linear().transpose() * (v + w.cross(wheel.translation()));
    EXPECT_NEAR(at_com.force.dot(v) + at_com.torque.dot(w), force.dot(v_wheel), 1e-12);
  }
}

TEST(Wrench, WorksInSinglePrecisionAndWithDerivatives) {
  const Wrench<float> single =
      transport(wrench_in_world(Wrench<float>{Eigen::Vector3f(1, 2, 3), Eigen::Vector3f(4, 5, 6)},
                                quaternion_from_yaw(0.3F)),
                Eigen::Vector3f(0.1F, 0.2F, 0.3F));
  const Wrenchd wrench{Vector3d(1, 2, 3), Vector3d(4, 5, 6)};
  const Vector3d lever(0.1, 0.2, 0.3);
  const Wrenchd twice = transport(wrench_in_world(wrench, quaternion_from_yaw(0.3)), lever);
  EXPECT_LT((single.force.cast<double>() - twice.force).norm(), 1e-6);
  EXPECT_LT((single.torque.cast<double>() - twice.torque).norm(), 1e-6);

  // The derivative of the torque with respect to the lever arm is -[F]x. With respect to a small
  // rotation of the body the derivative of the force is R [-F]x.
  using Dual = test_support::Dual<3>;
  const Eigen::Matrix3d by_lever = test_support::jacobian_at_zero<3, 3>([&](const auto& step) {
    return transport(Wrench<Dual>{wrench.force.cast<Dual>(), wrench.torque.cast<Dual>()},
                     Vector3<Dual>(lever.cast<Dual>() + step))
        .torque;
  });
  EXPECT_LT((by_lever + skew(wrench.force)).norm(), 1e-14);
  const Eigen::Quaterniond q = Random(75).orientation();
  const Eigen::Matrix3d by_turn = test_support::jacobian_at_zero<3, 3>([&](const auto& step) {
    const Eigen::Quaternion<Dual> turned = q.cast<Dual>() * quaternion_exp(step);
    return wrench_in_world(Wrench<Dual>{wrench.force.cast<Dual>(), wrench.torque.cast<Dual>()},
                           turned)
        .force;
  });
  EXPECT_LT((by_turn + q.toRotationMatrix() * skew(wrench.force)).norm(), 1e-14);
}

}  // namespace wrench_test
}  // namespace tilt_ropter
