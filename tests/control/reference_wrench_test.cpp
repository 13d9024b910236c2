// Wrench of a reference, and the thrust on the ground.

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/detail/reference_wrench.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <utility>

namespace tilt_ropter {
namespace reference_wrench_test {

TEST(ReferenceWrench, AcceleratesAndCompensatesDisturbanceInAirAndOnGround) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ReferenceWrench<4> wrench(vehicle, {});
  ReferencePoint point;
  point.acceleration << 1.0, 2.0, 0.0;
  const Wrenchd wind{Eigen::Vector3d(0.5, 0.0, 0.0), Eigen::Vector3d(0.0, 0.05, 0.0)};
  const Wrenchd air = wrench(point, wind, false), ground = wrench(point, wind, true);
  EXPECT_LT((air.force - Eigen::Vector3d(1.0, 3.0, 1.5 * gravity)).norm(), 1e-12);
  EXPECT_EQ(air.torque, Eigen::Vector3d(0.0, -0.05, 0.0));
  EXPECT_EQ(ground.force.y(), 0.0);
  EXPECT_EQ(ground.force.z(), wrench.ground_thrust(ground));
  EXPECT_GT(ground.force.z(), 0.75);  // above down_force, because of the torque
}

// Lateral and upward component of each rotor's thrust for `wrench` with this vertical force [N].
Eigen::Matrix<double, 2, 4> thrusts(Wrenchd wrench, double force) {
  wrench.force.z() = force;
  Eigen::Matrix<double, 6, 1> packed;
  packed << wrench.force, wrench.torque;
  const Eigen::Matrix<double, 8, 1> all =
      AllocationMatrix<4>(tilt_ropter_vehicle()).pseudoinverse * packed;
  return Eigen::Map<const Eigen::Matrix<double, 2, 4>>(all.data());
}
Eigen::Vector4d vertical_thrusts(const Wrenchd& wrench, double force) {
  return thrusts(wrench, force).row(1).transpose();
}

TEST(GroundThrust, EqualsDownForceWithoutTorque) {
  const ReferenceWrench<4> needed(tilt_ropter_vehicle(), {});
  EXPECT_EQ(needed.ground_thrust({}), 0.75);
  EXPECT_EQ(needed.ground_thrust({Eigen::Vector3d(0.5, 0.0, 7.0), Eigen::Vector3d::Zero()}), 0.75);
  // Torque from noise of the estimate, or from a CoM that is half a millimetre off the axle.
  EXPECT_EQ(needed.ground_thrust({Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.0075, 0.0)}),
            0.75);
}

TEST(GroundThrust, KeepsEveryRotorPushingUpwardUnderTorque) {
  const ReferenceWrench<4> needed(tilt_ropter_vehicle(), {});
  for (const double torque : {-0.18, -0.1, 0.05, 0.147}) {  // last: CoM 1 cm off the axle
    const Wrenchd wrench{Eigen::Vector3d(1.0, 0.0, 0.0), Eigen::Vector3d(0.0, torque, 0.02)};
    const double force = needed.ground_thrust(wrench);
    const Eigen::Vector4d before = vertical_thrusts(wrench, 0.0);
    const double taken = -before.minCoeff();
    EXPECT_NEAR(vertical_thrusts(wrench, force).minCoeff(),
                std::min(2.0 * taken, GroundContactSettings{}.rotor_thrust), 1e-9)
        << torque;
  }
}

TEST(GroundThrust, RotorThrustTakesEffectUpToHalfTheWeight) {
  const Wrenchd pitched{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.147, 0.0)};
  GroundContactSettings settings;
  const auto thrust = [&settings](const Wrenchd& wrench) {
    return ReferenceWrench<4>(tilt_ropter_vehicle(), settings).ground_thrust(wrench);
  };
  settings.rotor_thrust = 0.0;
  const double none = thrust(pitched);
  EXPECT_NEAR(vertical_thrusts(pitched, none).minCoeff(), 0.0, 1e-9);
  settings.rotor_thrust = 0.5;
  EXPECT_NEAR(thrust(pitched), none + 4.0 * 0.5, 1e-9);
  settings.rotor_thrust = 100.0;
  const Wrenchd tipping{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 5.0, 0.0)};
  EXPECT_DOUBLE_EQ(thrust(tipping), 0.5 * 1.5 * gravity);
  settings.down_force = 10.0;  // the user's down_force is not limited
  EXPECT_EQ(thrust(tipping), 10.0);
}

// A servo that does not reach 90 degrees: the thrust of its rotor stays within half of the tangent
// of the nearer end of its range.
TEST(GroundThrust, KeepsNarrowServosAwayFromTheEndOfTheirRange) {
  for (const auto& [low, high] : {std::pair{-0.5, 0.9}, {-0.9, 0.5}}) {
    Vehicle<4> vehicle = tilt_ropter_vehicle();
    vehicle.servo.min_angle = low;
    vehicle.servo.max_angle = high;
    for (const double ahead : {0.6, -0.7}) {
      const Wrenchd wrench{Eigen::Vector3d(ahead, 0.0, 0.0), Eigen::Vector3d::Zero()};
      const double force = ReferenceWrench<4>(vehicle, {}).ground_thrust(wrench);
      EXPECT_LT(force, 0.5 * vehicle.body.mass * gravity);
      const auto given = thrusts(wrench, force);
      double steepest = 0.0;
      for (int i = 0; i < 4; ++i)
        steepest = std::max(steepest, std::abs(given(0, i)) / given(1, i));
      EXPECT_NEAR(steepest, 0.5 * std::tan(0.5), 1e-9) << low << ' ' << ahead;
    }
  }
}

}  // namespace reference_wrench_test
}  // namespace tilt_ropter
