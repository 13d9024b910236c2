#include <tilt_ropter/actuation/power.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "support/autodiff.hpp"

namespace power_test {

using namespace tilt_ropter;

double hover_speed(const Vehicle<4>& v) {
  return std::sqrt(v.body.mass * gravity / 4.0 / v.rotor.thrust_coefficient);
}

TEST(Power, HoverPowerMatchesPaper) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const PowerModel model(vehicle);
  EXPECT_NEAR(model.power(Eigen::Vector4d::Constant(hover_speed(vehicle))), 653.64, 1e-9);
}

TEST(Power, PowerAtRestIsElectronicsAndServosOnly) {
  const PowerModel model(tilt_ropter_vehicle());
  EXPECT_EQ(model.power(Eigen::Vector4d::Zero()), 20.0);
}

TEST(Power, EveryRotorThatTiltsHasAServo) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.power.electronics = 10.0;
  vehicle.power.servo_hold = 2.0;
  EXPECT_EQ(PowerModel(vehicle).power(Eigen::Vector4d::Zero()), 18.0);
  vehicle.rotors[1].tilts = false;
  const PowerModel three(vehicle);
  EXPECT_EQ(three.power(Eigen::Vector4d::Zero()), 16.0);
  const Eigen::Vector4d hover = Eigen::Vector4d::Constant(hover_speed(vehicle));
  EXPECT_NEAR(three.power(hover), 653.64, 1e-9);
  EXPECT_EQ(PowerModel(vehicle, hover).power(Eigen::Vector4d::Zero()), 16.0);
}

TEST(Power, MovingServosTakePowerInProportionToTheirSpeeds) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const PowerModel model(vehicle);
  const Eigen::Vector4d speed = Eigen::Vector4d::Constant(900.0);
  const double still = model.power(speed), move = vehicle.power.servo_move;
  EXPECT_GT(move, 0.0);
  EXPECT_EQ(model.power(speed, Eigen::Vector4d::Zero()), still);
  EXPECT_NEAR(model.power(speed, Eigen::Vector4d(1.0, -2.0, 0.0, 4.0)), still + 7.0 * move, 1e-12);
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(), -1e300})
    EXPECT_NEAR(model.power(speed, Eigen::Vector4d(bad, 1.0, 0.0, bad)), still + move, 1e-12);
}

TEST(Power, GrowsWithCubeOfRotorSpeed) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const PowerModel model(vehicle);
  const double once = model.power(Eigen::Vector4d::Constant(400.0)) - 20.0;
  EXPECT_NEAR(model.power(Eigen::Vector4d::Constant(800.0)) - 20.0, 8.0 * once, 1e-9);
  EXPECT_NEAR(model.power(Eigen::Vector4d(400.0, 0.0, 0.0, 0.0)) - 20.0, 0.25 * once, 1e-12);
}

TEST(Power, InvalidSpeedsCountAsZero) {
  const PowerModel model(tilt_ropter_vehicle());
  for (const double bad : {std::numeric_limits<double>::quiet_NaN(),
                           std::numeric_limits<double>::infinity(), 1e300, -500.0})
    EXPECT_EQ(model.power(Eigen::Vector4d(bad, 700.0, 0.0, bad)),
              model.power(Eigen::Vector4d(0.0, 700.0, 0.0, 0.0)));
}

TEST(Power, FloatMatchesDoubleAndDerivativeIsCorrect) {
  using Dual = test_support::Dual<1>;
  const PowerModel model(tilt_ropter_vehicle());
  EXPECT_NEAR(model.power(Eigen::Vector4f::Constant(1600.0F)),
              model.power(Eigen::Vector4d::Constant(1600.0)), 1e-2);
  Eigen::Matrix<Dual, 1, 1> speed(Dual(900.0, 1, 0));
  const double cubic = model.power(Eigen::Matrix<double, 1, 1>::Constant(900.0)) - 20.0;
  EXPECT_NEAR(model.power(speed).derivatives()(0), 3.0 * cubic / 900.0, 1e-12);
}

}  // namespace power_test
