#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/detail/thrust_inverse.hpp>

#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace tilt_ropter {
namespace thrust_inverse_test {

using test_support::Random;

template <int Rotors>
void expect_pseudoinverse(const Vehicle<Rotors>& vehicle) {
  const auto truth = AllocationMatrix<Rotors>(vehicle).pseudoinverse;
  EXPECT_LT((ThrustInverse<Rotors>(vehicle).matrix() - truth).cwiseAbs().maxCoeff(),
            1e-6 * truth.cwiseAbs().maxCoeff());
}

TEST(ThrustInverse, EqualsThePseudoInverseAtFullRank) {
  expect_pseudoinverse(tilt_ropter_vehicle());
  expect_pseudoinverse(test_support::tilting_hexacopter());
  expect_pseudoinverse(with_stuck_servo(tilt_ropter_vehicle(), 1, 0.5));
  expect_pseudoinverse(with_weak_rotor(tilt_ropter_vehicle(), 2, 0.0));
}

TEST(ThrustInverse, GivesThePossiblePartOfAWrench) {
  const ThrustInverse<4> inverse(test_support::flat_quadrotor());
  const auto thrusts = inverse({{3.0, -2.0, 8.0}, {0.0, 0.0, 0.0}});
  for (int i = 0; i < 4; ++i) {
    EXPECT_EQ(thrusts(2 * i), 0.0);
    EXPECT_NEAR(thrusts(2 * i + 1), 2.0, 1e-6);
  }
}

TEST(ThrustInverse, KnowsWhichForcesNeedNoLeaning) {
  EXPECT_FALSE(ThrustInverse<4>(tilt_ropter_vehicle()).leans());
  EXPECT_FALSE(ThrustInverse<8>(test_support::omnidirectional_octocopter()).leans());
  const ThrustInverse<4> flat(test_support::flat_quadrotor());
  EXPECT_TRUE(flat.leans());
  const Eigen::Matrix3d along_z = Eigen::Vector3d::UnitZ() * Eigen::Vector3d::UnitZ().transpose();
  EXPECT_LT((flat.steady_forces() - along_z).norm(), 1e-6);
  // Both rotors above the CoM: a force forward also gives a torque.
  Vehicle<2> bicopter;
  bicopter.rotors = {rotor_on_arm(-pi / 2.0, 0.2, Spin::counter_clockwise),
                     rotor_on_arm(pi / 2.0, 0.2, Spin::clockwise)};
  for (RotorGeometry& rotor : bicopter.rotors) rotor.position.z() = 0.06;
  EXPECT_LT((ThrustInverse<2>(bicopter).steady_forces() - along_z).norm(), 1e-3);
}

TEST(ThrustInverse, ThrustsOfFixedRotorsStayWithinTheirLimits) {
  const Vehicle<8> vehicle = test_support::omnidirectional_octocopter();
  const ThrustInverse<8> inverse(vehicle);
  const auto matrix = AllocationMatrix<8>(vehicle).matrix;
  const Eigen::Matrix<double, 8, 1> least = Eigen::Matrix<double, 8, 1>::Zero(),
                                    most = Eigen::Matrix<double, 8, 1>::Constant(12.0);
  Random random(3);
  for (int i = 0; i < 200; ++i) {
    const Wrenchd wrench{Eigen::Vector3d(0.0, 0.0, 15.0) + random.vector(3.0), random.vector(0.2)};
    const auto thrusts = inverse.within(wrench, least, most);
    Eigen::Matrix<double, 6, 1> wanted;
    wanted << wrench.force, wrench.torque;
    EXPECT_GE(thrusts.minCoeff(), 0.0);
    EXPECT_LE(thrusts.maxCoeff(), 12.0);
    EXPECT_LT((matrix * thrusts - wanted).norm(), 0.1);
  }
}

}  // namespace thrust_inverse_test
}  // namespace tilt_ropter
