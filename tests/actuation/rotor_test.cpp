#include <tilt_ropter/actuation/rotor.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "support/autodiff.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

namespace rotor_test {

using namespace tilt_ropter;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double coefficient = 1.4e-6;

RotorParameters parameters() {
  RotorParameters p;
  p.thrust_coefficient = coefficient;
  p.min_thrust = 0.1;
  p.max_thrust = 12.0;
  p.time_constant = 0.03;
  return p;
}

TEST(Rotor, ThrustAndSpeedInvertEachOther) {
  test_support::Random random(1);
  for (int i = 0; i < 1000; ++i) {
    const double thrust = std::pow(10.0, random.uniform(-300.0, 3.0));
    const double speed = speed_from_thrust(thrust, parameters());
    EXPECT_NEAR(thrust_from_speed(speed, parameters()), thrust, 1e-14 * thrust);
  }
  EXPECT_NEAR(speed_from_thrust(1.4F, parameters()), 1000.0F, 1e-3F);
}

TEST(Rotor, ThrustAndSpeedOfInvalidInputAreZero) {
  for (const double bad : {-1.0, 0.0, -0.0, nan, infinity, -infinity, 1e300 * 1e300}) {
    EXPECT_EQ(thrust_from_speed(bad, parameters()), 0.0);
    EXPECT_EQ(speed_from_thrust(bad, parameters()), 0.0);
  }
  EXPECT_EQ(thrust_from_speed(1e300, parameters()), 0.0);
  EXPECT_TRUE(std::isfinite(speed_from_thrust(1e308, parameters())));
}

TEST(Rotor, DerivativesAreCorrectAndFiniteAtZero) {
  using Dual = test_support::Dual<1>;
  const Dual speed = thrust_from_speed(Dual(500.0, 1, 0), parameters());
  EXPECT_NEAR(speed.derivatives()(0), 2.0 * coefficient * 500.0, 1e-15);
  const Dual thrust = speed_from_thrust(Dual(2.0, 1, 0), parameters());
  EXPECT_NEAR(thrust.derivatives()(0), 0.5 / std::sqrt(coefficient * 2.0), 1e-10);
  const Dual zero = speed_from_thrust(Dual(0.0, 1, 0), parameters());
  for (Eigen::Index i = 0; i < zero.derivatives().size(); ++i)
    EXPECT_EQ(zero.derivatives()(i), 0.0);
}

// Linear thrust coefficients of both signs, from almost zero to the largest magnitude that
// validate() accepts.
RotorParameters curved(test_support::Random& random) {
  RotorParameters p = parameters();
  p.thrust_coefficient = std::pow(10.0, random.uniform(-8.0, -4.0));
  p.max_thrust = std::pow(10.0, random.uniform(-0.5, 3.0));
  const double size = std::sqrt(0.5 * p.thrust_coefficient * p.max_thrust) *
                      std::pow(10.0, random.uniform(-6.0, 0.0));
  p.linear_thrust_coefficient = random.uniform(0.0, 1.0) < 0.5 ? size : -size;
  EXPECT_NO_THROW(validate(p));
  return p;
}

TEST(ThrustCurve, IsPolynomialWithExactInverse) {
  test_support::Random random(4);
  for (int i = 0; i < 10000; ++i) {
    const RotorParameters p = curved(random);
    const double thrust = p.max_thrust * std::pow(10.0, random.uniform(-9.0, 0.0));
    const double speed = speed_from_thrust(thrust, p);
    const auto w = static_cast<long double>(speed),
               c = static_cast<long double>(p.thrust_coefficient),
               b = static_cast<long double>(p.linear_thrust_coefficient);
    // Change of the thrust for a relative error of 1e-15 in the speed.
    const auto rounding = static_cast<double>(1e-15L * w * (2.0L * c * w + std::abs(b)));
    EXPECT_NEAR(static_cast<double>(c * w * w + b * w), thrust, 4.0 * rounding);
    EXPECT_NEAR(thrust_from_speed(speed, p), thrust, 8.0 * rounding);
    EXPECT_GT(speed_from_thrust(1.001 * thrust, p), speed);
  }
  RotorParameters p = parameters();
  p.linear_thrust_coefficient = 1e-3;
  EXPECT_NEAR(speed_from_thrust(2.4F, p), 1000.0F, 1e-3F);  // 1.4 N + 1 N
  EXPECT_NEAR(thrust_from_speed(1000.0F, p), 2.4F, 1e-6F);
}

TEST(ThrustCurve, DerivativesEqualThrustSlope) {
  using Dual = test_support::Dual<1>;
  test_support::Random random(5);
  for (int i = 0; i < 1000; ++i) {
    const RotorParameters p = curved(random);
    const double thrust = p.max_thrust * random.uniform(0.01, 1.0);
    const double speed = speed_from_thrust(thrust, p);
    const double slope = 2.0 * p.thrust_coefficient * speed + p.linear_thrust_coefficient;
    EXPECT_NEAR(thrust_slope(thrust, p), slope, 1e-12 * slope);
    EXPECT_NEAR(thrust_from_speed(Dual(speed, 1, 0), p).derivatives()(0), slope, 1e-12 * slope);
    EXPECT_NEAR(speed_from_thrust(Dual(thrust, 1, 0), p).derivatives()(0), 1.0 / slope,
                1e-12 / slope);
  }
}

TEST(ThrustCurve, ZeroThrustSpeedFollowsLinearTerm) {
  RotorParameters p = parameters();
  p.linear_thrust_coefficient = -1.4e-4;  // 100 rad/s without thrust
  for (const double bad : {-1.0, 0.0, nan, infinity})
    EXPECT_NEAR(speed_from_thrust(bad, p), 100.0, 1e-12);
  EXPECT_NEAR(speed_from_thrust(1e-12, p), 100.0, 1e-6);  // continuous
  EXPECT_EQ(thrust_from_speed(99.0, p), 0.0);
  EXPECT_NEAR(thrust_from_speed(200.0, p), 0.028, 1e-15);
  p.linear_thrust_coefficient = 1.4e-4;
  for (const double bad : {-1.0, 0.0, nan, infinity}) EXPECT_EQ(speed_from_thrust(bad, p), 0.0);
}

TEST(ThrustCurve, WithoutLinearTermEqualsQuadraticLaw) {
  test_support::Random random(6);
  for (int i = 0; i < 10000; ++i) {
    const double x = std::pow(10.0, random.uniform(-8.0, 4.0));
    EXPECT_DOUBLE_EQ(thrust_from_speed(x, parameters()), coefficient * x * x);
    EXPECT_DOUBLE_EQ(speed_from_thrust(x, parameters()), std::sqrt(x) / std::sqrt(coefficient));
    EXPECT_DOUBLE_EQ(thrust_slope(x, parameters()), 2.0 * std::sqrt(coefficient * x));
  }
}

TEST(Rotor, MaxSpeedAndThrustFollowThrustCurve) {
  RotorParameters p = parameters();
  p.linear_thrust_coefficient = 2e-3;
  Rotord rotor(p);
  rotor.reset(1e9, 0.0);
  const double top = rotor.max_speed();
  EXPECT_NEAR(coefficient * top * top + 2e-3 * top, 12.0, 1e-12);
  EXPECT_EQ(rotor.speed(), top);
  EXPECT_LT(top, Rotord(parameters()).max_speed());
}

TEST(Rotor, MaxSpeedIsProportionalToVoltage) {
  test_support::Random random(7);
  for (int i = 0; i < 1000; ++i) {
    const RotorParameters p = curved(random);
    Rotord rotor(p);
    const double full = rotor.max_speed();
    rotor.reset(full, 0.0);
    rotor.set_voltage_ratio(0.8);
    EXPECT_NEAR(rotor.max_speed(), 0.8 * full, 1e-9 * full);
    EXPECT_EQ(rotor.speed(), rotor.max_speed());
    EXPECT_NEAR(max_thrust_at(p, 0.8), thrust_from_speed(0.8 * full, p), 1e-9 * p.max_thrust);
    for (const double more : {1.0, 1.2}) {
      rotor.set_voltage_ratio(more);
      EXPECT_EQ(rotor.max_speed(), full);
      EXPECT_EQ(max_thrust_at(p, more), p.max_thrust);
    }
  }
  RotorParameters idling = parameters();
  idling.min_thrust = 10.0;
  EXPECT_EQ(max_thrust_at(idling, 0.5), 10.0);
}

TEST(Rotor, StepResponseIsExponential) {
  Rotord rotor(parameters());
  rotor.reset(500.0, 2.0);
  EXPECT_EQ(rotor.update(2.0, 1500.0), 500.0);
  for (const double time : {2.001, 2.01, 2.05, 2.3})
    EXPECT_NEAR(rotor.update(time, 1500.0), 1500.0 - 1000.0 * std::exp(-(time - 2.0) / 0.03), 1e-9);
}

TEST(Rotor, ResultIsIndependentOfUpdateInterval) {
  test_support::Random random(2);
  for (int run = 0; run < 100; ++run) {
    Rotord coarse(parameters()), fine(parameters());
    double time = random.uniform(-5.0, 5.0);
    coarse.reset(900.0, time);
    fine.reset(900.0, time);
    for (int step = 0; step < 20; ++step) {
      const double command = random.uniform(0.0, 3000.0), end = time + random.uniform(0.0, 0.1);
      coarse.update(time, command);
      for (int i = 0; i < 7; ++i) fine.update(time + (end - time) * i / 7.0, command);
      time = end;
      EXPECT_NEAR(coarse.update(time, command), fine.update(time, command), 1e-9);
    }
  }
}

TEST(Rotor, StaysBetweenTheSpeedsOfMinAndMaxThrust) {
  Rotord rotor(parameters());
  const auto thrust = [&rotor] { return thrust_from_speed(rotor.speed(), parameters()); };
  EXPECT_NEAR(thrust(), 0.1, 1e-12);
  rotor.update(0.0, 1e300);
  rotor.update(10.0, -1e300);
  EXPECT_NEAR(thrust(), 12.0, 1e-9);
  EXPECT_LE(rotor.speed(), rotor.max_speed());
  rotor.update(20.0, 0.0);
  EXPECT_NEAR(thrust(), 0.1, 1e-9);
  EXPECT_GE(rotor.speed(), rotor.min_speed());
}

TEST(Rotor, IgnoresNonFiniteAndLateInput) {
  Rotord rotor(parameters()), undisturbed(parameters());
  for (Rotord* r : {&rotor, &undisturbed}) {
    r->reset(500.0, 0.0);
    r->update(0.0, 1000.0);
    r->update(0.01, 1500.0);
  }
  const double speed = rotor.speed();
  for (const double bad : {nan, infinity, -infinity}) {
    EXPECT_EQ(rotor.update(0.02, bad), speed);
    EXPECT_EQ(rotor.update(bad, 700.0), speed);
  }
  EXPECT_EQ(rotor.update(0.005, 700.0), speed);
  EXPECT_EQ(rotor.update(0.03, 800.0), undisturbed.update(0.03, 800.0));
}

// The call that sets the clock back has no duration.
TEST(Rotor, GoesOnAfterTheClockWasSetBack) {
  Rotord rotor(parameters()), undisturbed(parameters());
  for (int i = 0; i < 100; ++i) {
    const double command = 1000.0 + 300.0 * std::sin(0.3 * i);
    rotor.update(0.01 * i + (i < 50 ? 100.0 : -1e3), command);
    undisturbed.update(0.01 * (i < 50 ? i : i - 1), command);
    EXPECT_NEAR(rotor.speed(), undisturbed.speed(), 1e-6) << i;
  }
  EXPECT_GT(rotor.speed(), 700.0);
}

TEST(Rotor, KeepsLimitsForRandomInput) {
  test_support::Random random(3);
  const std::vector<double> pool{nan,    infinity, -infinity, 0.0,  5e-324, 1e300,
                                 -1e300, 10.0,     -1.0,      1e-9, 1000.0};
  const auto pick = [&] { return pool[static_cast<std::size_t>(random.uniform(0.0, 10.999))]; };
  Rotord rotor(parameters());
  const int calls = test_support::quick_or_full(200000, 1000000);
  for (int i = 0; i < calls; ++i) {
    if (i % 1000 == 0) rotor.reset(pick(), pick());
    rotor.update(pick(), pick());
    ASSERT_TRUE(rotor.speed() >= rotor.min_speed() && rotor.speed() <= rotor.max_speed());
  }
}

TEST(Rotor, FloatAndDualMatchDouble) {
  using Dual = test_support::Dual<1>;
  Rotord rotor(parameters());
  Rotor<float> single(parameters());
  Rotor<Dual> dual(parameters());
  dual.update(0.0, Dual(1000.0, 1, 0));
  rotor.update(0.0, 1000.0);
  single.update(0.0, 1000.0F);
  rotor.update(0.02, 1000.0);
  EXPECT_NEAR(single.update(0.02, 1000.0F), rotor.speed(), 1e-3);
  const Dual speed = dual.update(0.02, Dual(1000.0));
  EXPECT_NEAR(speed.value(), rotor.speed(), 1e-12);
  EXPECT_NEAR(speed.derivatives()(0), 1.0 - std::exp(-0.02 / 0.03), 1e-14);
}

}  // namespace rotor_test
