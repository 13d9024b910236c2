#include <tilt_ropter/actuation/allocation.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "support/vehicles.hpp"

namespace control_authority_test {

using namespace tilt_ropter;
using Vector6 = Eigen::Matrix<double, 6, 1>;

/// The vehicle without reaction torque, for which closed forms exist.
Vehicle<4> plain_vehicle() {
  Vehicle<4> v = tilt_ropter_vehicle();
  v.rotor.torque_ratio = 0.0;
  return v;
}

constexpr double weight = 1.5 * gravity, most = 12.0, arm = 0.17;

TEST(ControlAuthority, MatchesClosedFormsForIntactVehicle) {
  const ControlAuthority a = control_authority(plain_vehicle());
  EXPECT_EQ(a.rank, 6);
  // In units of the arm length: forces along x and y use two rotors, all other components use two
  // or four. A A' is diagonal with the squares 2, 2, 4, 2, 2, 4.
  EXPECT_NEAR(a.condition, std::sqrt(2.0), 1e-9);
  EXPECT_TRUE(a.hovers);
  EXPECT_NEAR(a.least_thrust, weight / 4.0, 1e-9);
  // Two rotors push sideways or turn the body while the other two carry the weight. All four rotors
  // contribute to a yaw torque.
  const double yaw = 4.0 * arm * std::sqrt(most * most - weight * weight / 16.0);
  Vector6 forward, backward;
  forward << 2.0 * most, 2.0 * most, 4.0 * most - weight, 2.0 * most * arm, 2.0 * most * arm, yaw;
  backward = forward;
  backward(2) = 4.0 * most + weight;
  EXPECT_LT((a.forward - forward).cwiseAbs().maxCoeff(), 1e-5) << a.forward.transpose();
  EXPECT_LT((a.backward - backward).cwiseAbs().maxCoeff(), 1e-5) << a.backward.transpose();
}

TEST(ControlAuthority, ReachIsAsExactAsAsked) {
  const Allocation<4> allocation(plain_vehicle());
  const Wrenchd hover{Eigen::Vector3d(0.0, 0.0, weight), Eigen::Vector3d::Zero()},
      up{Eigen::Vector3d::UnitZ(), Eigen::Vector3d::Zero()};
  const double end = 96.0, largest = 4.0 * most - weight;
  for (const double accuracy : {0.1, 1e-3, 1e-7}) {
    const double found = reach(allocation, hover, up, end, accuracy);
    EXPECT_LE(found, largest + 1e-9);
    EXPECT_GE(found, largest - accuracy * end) << accuracy;
    EXPECT_LT(found, largest - 1e-3 * accuracy * end) << accuracy;  // and no more exact
  }
  const double exact = reach(allocation, hover, up, end);
  for (const double none : {0.0, -1.0, std::numeric_limits<double>::quiet_NaN()})
    EXPECT_EQ(reach(allocation, hover, up, end, none), exact);
}

TEST(ControlAuthority, ReactionTorqueReducesSideForce) {
  // Arms that push along x also exert a reaction torque about x. To balance it, they need a
  // vertical thrust of torque_ratio / arm of their lateral thrust, one up and one down.
  const ControlAuthority a = control_authority(tilt_ropter_vehicle());
  const double slant = 0.016 / arm;
  EXPECT_NEAR(a.forward(0), 2.0 * most / std::sqrt(1.0 + slant * slant), 1e-5);
}

TEST(ControlAuthority, MatchesClosedFormsForStuckServoWeakAndLostRotor) {
  // An arm stuck upright gives only vertical thrust upwards, and no sideways force.
  const ControlAuthority stuck = control_authority(with_stuck_servo(plain_vehicle(), 0, 0.0));
  EXPECT_EQ(stuck.rank, 6);
  EXPECT_NEAR(stuck.forward(0), most, 1e-5);
  EXPECT_NEAR(stuck.backward(2), 2.0 * most + weight, 1e-5);  // the opposite arm must give nothing

  // For balance, two arms give at most half thrust.
  const ControlAuthority weak = control_authority(with_weak_rotor(plain_vehicle(), 0, 0.5));
  EXPECT_NEAR(weak.forward(2), 3.0 * most - weight, 1e-5);
  EXPECT_NEAR(weak.forward(3), 1.5 * most * arm, 1e-5);
  EXPECT_NEAR(weak.least_thrust, weight / 4.0, 1e-9);

  // Two rotors carry the weight. The rotor opposite the lost rotor gives no thrust: to push the
  // other way, its servo must turn by half a turn.
  const ControlAuthority lost = control_authority(with_weak_rotor(plain_vehicle(), 2, 0.0));
  EXPECT_EQ(lost.rank, 6);
  EXPECT_TRUE(lost.hovers);
  EXPECT_NEAR(lost.least_thrust, 0.0, 1e-9);
  EXPECT_NEAR(lost.forward(2), 2.0 * most - weight, 1e-5);
}

TEST(ControlAuthority, ReportsNoHoverIfTooHeavyOrRankBelowSix) {
  Vehicle<4> heavy = plain_vehicle();
  heavy.body.mass = 4.9;
  const ControlAuthority a = control_authority(heavy);
  EXPECT_EQ(a.rank, 6);
  EXPECT_FALSE(a.hovers);
  EXPECT_EQ(a.forward, Vector6::Zero());
  EXPECT_EQ(a.backward, Vector6::Zero());
  heavy.body.mass = 4.89;
  EXPECT_TRUE(control_authority(heavy).hovers);

  const ControlAuthority flat = control_authority(test_support::flat_quadrotor());
  EXPECT_EQ(flat.rank, 4);
  EXPECT_EQ(flat.condition, std::numeric_limits<double>::infinity());
  EXPECT_FALSE(flat.hovers);
  const auto two = with_weak_rotor(with_weak_rotor(plain_vehicle(), 0, 0.0), 1, 0.0);
  EXPECT_EQ(control_authority(two).rank, 4);
}

TEST(ControlAuthority, WorksForSixRotorsAndWithOneLost) {
  const auto hexacopter = test_support::tilting_hexacopter();
  const ControlAuthority a = control_authority(hexacopter);
  EXPECT_EQ(a.rank, 6);
  EXPECT_NEAR(a.forward(2), 6.0 * 12.0 - hexacopter.body.mass * gravity, 1e-5);
  const ControlAuthority five = control_authority(with_weak_rotor(hexacopter, 2, 0.0));
  EXPECT_EQ(five.rank, 6);
  EXPECT_GT(five.least_thrust, 0.5);  // of the remaining rotors
}

}  // namespace control_authority_test
