#include <tilt_ropter/actuation/power.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <stdexcept>

#include "support/autodiff.hpp"

namespace {

using namespace tilt_ropter;

double hover_speed(const Vehicle<4>& v) {
  return std::sqrt(v.body.mass * gravity / 4.0 / v.rotor.thrust_coefficient);
}

TEST(Power, HoverPowerMatchesPaper) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const PowerModel model(vehicle);
  EXPECT_NEAR(model.power(Eigen::Vector4d::Constant(hover_speed(vehicle))), 653.64, 1e-9);
}

TEST(Power, PowerAtRestIsElectronicsOnly) {
  const PowerModel model(tilt_ropter_vehicle());
  EXPECT_EQ(model.power(Eigen::Vector4d::Zero()), 20.0);
}

TEST(Power, GrowsWithCubeOfRotorSpeed) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const PowerModel model(vehicle);
  const double once = model.power(Eigen::Vector4d::Constant(400.0)) - 20.0;
  EXPECT_NEAR(model.power(Eigen::Vector4d::Constant(800.0)) - 20.0, 8.0 * once, 1e-9);
  EXPECT_NEAR(model.power(Eigen::Vector4d(400.0, 0.0, 0.0, 0.0)) - 20.0, 0.25 * once, 1e-12);
  EXPECT_NEAR(once, 4.0 * model.coefficient() * 400.0 * 400.0 * 400.0, 1e-12);
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
  EXPECT_NEAR(model.power(speed).derivatives()(0), 3.0 * model.coefficient() * 900.0 * 900.0,
              1e-12);
}

TEST(Power, RejectsInvalidParameters) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.power.hover = vehicle.power.electronics;
  EXPECT_THROW(PowerModel{vehicle}, std::invalid_argument);
  vehicle = tilt_ropter_vehicle();
  vehicle.body.mass = 0.0;
  EXPECT_THROW(PowerModel{vehicle}, std::invalid_argument);
  vehicle = tilt_ropter_vehicle();
  vehicle.rotor.thrust_coefficient = 0.0;
  EXPECT_THROW(PowerModel{vehicle}, std::invalid_argument);
  vehicle.rotor.thrust_coefficient = 1e300;  // hover at 2e-150 rad/s: overflow of the coefficient
  EXPECT_THROW(PowerModel{vehicle}, std::invalid_argument);
}

}  // namespace
