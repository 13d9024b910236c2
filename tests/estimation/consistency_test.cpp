#include <tilt_ropter/estimation/consistency.hpp>

#include <gtest/gtest.h>

#include "support/random.hpp"

#include <Eigen/Core>

#include <cmath>
#include <limits>

namespace consistency_test {

using namespace tilt_ropter;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double weight = 50.0, standing = 0.2;

TEST(Consistency, RotorSpeedNamesTheRotorThatIsFarthestOff) {
  const Eigen::Vector4d modelled(1500.0, 1600.0, 1400.0, 1500.0);
  Eigen::Vector4d measured = modelled;
  EXPECT_EQ(rotor_speed_residual<4>(measured, modelled).ratio(), 0.0);
  measured(1) -= 30.0;
  measured(2) += 200.0;
  const Residual residual = rotor_speed_residual<4>(measured, modelled);
  EXPECT_DOUBLE_EQ(residual.value, 200.0);
  EXPECT_GT(residual.ratio(), 3.0);
  measured(2) = -1.0;  // stopped, or its sensor
  EXPECT_LT(rotor_speed_residual<4>(measured, modelled).ratio(), -30.0);
}

TEST(Consistency, NothingIsNotFinite) {
  const Eigen::Vector4d lost(nan, nan, nan, nan);
  EXPECT_EQ(rotor_speed_residual<4>(lost, lost).ratio(), 0.0);
  EXPECT_EQ(battery_residual<4>(lost, lost).ratio(), 0.0);
  EXPECT_EQ(wrench_residual(lost.head<3>(), weight, false).ratio(), 0.0);
  EXPECT_EQ(pose_residual(std::numeric_limits<double>::infinity()).ratio(), 0.0);
  BodyStated body;
  body.position.z() = nan;
  EXPECT_EQ(load_residual({}, body, weight, standing).ratio(), 0.0);
}

TEST(Consistency, WrenchCountsInTheAirOnly) {
  const Eigen::Vector3d force(3.0, 0.0, -4.0);
  EXPECT_DOUBLE_EQ(wrench_residual(force, weight, false).ratio(), 2.0);
  EXPECT_EQ(wrench_residual(force, weight, true).ratio(), 0.0);
}

// The sum of n squares of standard normal numbers has the mean n and the variance 2 n.
TEST(Consistency, PoseIsOfUnitSpreadForAConsistentFilter) {
  test_support::Random random(1);
  double sum = 0.0, squares = 0.0;
  constexpr int count = 20000;
  for (int i = 0; i < count; ++i) {
    double nis = 0.0;
    for (int k = 0; k < 6; ++k) nis += std::pow(random.normal(1.0), 2);
    const double ratio = pose_residual(nis).ratio();
    sum += ratio;
    squares += ratio * ratio;
  }
  EXPECT_NEAR(sum / count, 0.0, 0.03);
  EXPECT_NEAR(squares / count, 1.0, 0.05);
}

TEST(Consistency, LoadIsExcludedByHeightAndBySpeed) {
  BodyStated body;
  ContactEstimate contact;
  contact.external.force.z() = 0.8 * weight;
  contact.ground = {0.0, Eigen::Vector2d::Zero()};
  contact.on_ground = true;  // at rest on the ground
  body.position.z() = standing;
  EXPECT_EQ(load_residual(contact, body, weight, standing).ratio(), 0.0);
  body.velocity.z() = -2.0;  // "on the ground", but it falls
  EXPECT_NEAR(load_residual(contact, body, weight, standing).ratio(), 8.0, 1e-9);
  body.velocity.setZero();
  contact.on_ground = false;
  body.position.z() = standing + 1.0;  // load in the air, as an aliased accelerometer shows it
  EXPECT_NEAR(load_residual(contact, body, weight, standing).ratio(), 8.0, 1e-9);
  body.position.z() = standing + 0.02;  // it may touch
  EXPECT_EQ(load_residual(contact, body, weight, standing).ratio(), 0.0);
  body.position.z() = standing + 0.02 + 1.0;
  contact.ground = {1.0, Eigen::Vector2d::Zero()};
  EXPECT_EQ(load_residual(contact, body, weight, standing).ratio(), 0.0);
}

TEST(Consistency, BatteryIsSilentBelowTheTopSpeed) {
  const Eigen::Vector4d top = Eigen::Vector4d::Constant(2000.0);
  Eigen::Vector4d measured = Eigen::Vector4d::Constant(1990.0);
  EXPECT_EQ(battery_residual<4>(measured, top).ratio(), 0.0);
  measured(3) = 2200.0;  // the voltage that is read cannot be true
  EXPECT_DOUBLE_EQ(battery_residual<4>(measured, top).ratio(), 5.0);
}

}  // namespace consistency_test
