#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "support/random.hpp"

namespace battery_test {

using namespace tilt_ropter;
using test_support::Random;

BatteryParameters paper_battery() {
  return tilt_ropter_vehicle().battery;
}

BatteryParameters any_battery(Random& random) {
  BatteryParameters p;
  p.capacity = std::exp(random.uniform(-2.0, 3.0));
  p.full_voltage = random.uniform(5.0, 60.0);
  p.empty_voltage = p.full_voltage * random.uniform(0.6, 1.0);
  p.resistance = std::exp(random.uniform(-8.0, -3.0));
  return p;
}

/// Reference: the differential equation dS/dt = -I / (3600 capacity) with I from the quadratic
/// equation R I^2 - U I + P = 0, integrated by RK4.
double charge_after(const BatteryParameters& p, double charge, double power, double time,
                    int steps) {
  const auto slope = [&](double s) {
    const double u = p.empty_voltage + s * (p.full_voltage - p.empty_voltage);
    const double current = 2.0 * power / (u + std::sqrt(u * u - 4.0 * p.resistance * power));
    return -current / (3600.0 * p.capacity);
  };
  const double h = time / steps;
  for (int i = 0; i < steps; ++i) {
    const double a = slope(charge), b = slope(charge + 0.5 * h * a),
                 c = slope(charge + 0.5 * h * b), d = slope(charge + h * c);
    charge += h / 6.0 * (a + 2.0 * b + 2.0 * c + d);
  }
  return charge;
}

TEST(Battery, LoadObeysKirchhoffAndGivesThePower) {
  Random random(1);
  for (int i = 0; i < 10000; ++i) {
    const BatteryParameters p = any_battery(random);
    const Battery battery(p, random.uniform(0.01, 1.0));
    const double u = battery.open_circuit_voltage(),
                 power = battery.max_power() * random.uniform(0.0, 1.0);
    const BatteryLoad load = battery.load(power);
    ASSERT_EQ(load.status, BatteryStatus::ok);
    ASSERT_NEAR(load.voltage, u - p.resistance * load.current, 1e-9 * u);
    ASSERT_NEAR(load.voltage * load.current, power, 1e-9 * power);
    ASSERT_GE(load.voltage, 0.5 * u);  // the stable one of two solutions
  }
}

TEST(Battery, OpenCircuitVoltageIsLinearInCharge) {
  const BatteryParameters p = paper_battery();
  EXPECT_EQ(Battery(p, 1.0).load(0.0).voltage, p.full_voltage);
  EXPECT_EQ(Battery(p, 0.0).open_circuit_voltage(), p.empty_voltage);
  EXPECT_NEAR(Battery(p, 0.25).open_circuit_voltage(),
              0.25 * p.full_voltage + 0.75 * p.empty_voltage, 1e-12);
}

TEST(Battery, ReportsMorePowerThanItCanGive) {
  const BatteryParameters p = paper_battery();
  const Battery battery(p, 0.5);
  const double most = battery.max_power(), u = battery.open_circuit_voltage();
  EXPECT_EQ(battery.load(0.999 * most).status, BatteryStatus::ok);
  const BatteryLoad load = battery.load(1.001 * most);
  EXPECT_EQ(load.status, BatteryStatus::overloaded);
  EXPECT_NEAR(load.voltage, 0.5 * u, 1e-12);
  EXPECT_NEAR(load.current * load.voltage, most, 1e-9 * most);
  EXPECT_EQ(battery.endurance(1.001 * most), 0.0);
}

TEST(Battery, EnduranceMatchesNumericalIntegration) {
  Random random(2);
  for (int i = 0; i < 50; ++i) {
    const BatteryParameters p = any_battery(random);
    const double until = random.uniform(0.0, 0.5), from = random.uniform(0.6, 1.0);
    const Battery battery(p, from);
    const double power = Battery(p, until).max_power() * random.uniform(0.01, 0.95);
    const double time = battery.endurance(power, until);
    EXPECT_NEAR(charge_after(p, from, power, time, 2000), until, 1e-9) << i;
  }
}

TEST(Battery, EnduranceEndsWhereThePowerIsTooMuch) {
  BatteryParameters p = paper_battery();
  p.resistance = 0.05;
  const double power = Battery(p, 0.4).max_power();
  EXPECT_NEAR(Battery(p).endurance(power), Battery(p).endurance(power, 0.4), 1e-6);
  EXPECT_GT(Battery(p).endurance(power, 0.5), 0.0);
  EXPECT_LT(Battery(p).endurance(power, 0.5), Battery(p).endurance(power));
}

TEST(Battery, EnduranceWithoutResistanceIsEnergyOverPower) {
  BatteryParameters p = paper_battery();
  p.resistance = 0.0;
  const double energy = 3600.0 * 5.3 * 0.5 * (16.8 + 13.2);
  EXPECT_NEAR(Battery(p).energy(), energy, 1e-6);
  EXPECT_NEAR(Battery(p).endurance(653.64), energy / 653.64, 1e-9);
  EXPECT_EQ(Battery(p).max_power(), std::numeric_limits<double>::infinity());
  EXPECT_EQ(Battery(p).endurance(0.0), std::numeric_limits<double>::infinity());
}

TEST(Battery, EnduranceAtConstantVoltageIsChargeOverCurrent) {
  BatteryParameters p = paper_battery();
  p.empty_voltage = p.full_voltage;
  const Battery battery(p);
  EXPECT_NEAR(battery.endurance(500.0), 3600.0 * 5.3 / battery.load(500.0).current, 1e-9);
  p.empty_voltage *= 1.0 - 1e-13;  // almost constant
  EXPECT_NEAR(Battery(p).endurance(500.0), battery.endurance(500.0), 1e-6);
}

TEST(Battery, StateOfChargeMatchesNumericalIntegration) {
  Random random(3);
  for (int i = 0; i < 50; ++i) {
    const BatteryParameters p = any_battery(random);
    Battery battery(p, random.uniform(0.6, 1.0));
    const double power = Battery(p, 0.3).max_power() * random.uniform(0.01, 0.95);
    const double from = battery.state_of_charge(),
                 time = battery.endurance(power, 0.3) * random.uniform(0.0, 1.0);
    EXPECT_EQ(battery.update(7.0, power), BatteryStatus::ok);
    EXPECT_EQ(battery.state_of_charge(), from);  // only starts the clock
    EXPECT_EQ(battery.update(7.0 + time, power), BatteryStatus::ok);
    EXPECT_NEAR(battery.state_of_charge(), charge_after(p, from, power, time, 2000), 1e-9) << i;
  }
}

TEST(Battery, ManyStepsEqualOneStep) {
  Battery once(paper_battery()), often(paper_battery());
  (void)once.update(0.0, 0.0);
  (void)once.update(200.0, 653.64);
  for (int i = 0; i <= 200000; ++i) (void)often.update(1e-3 * i, 653.64);
  EXPECT_NEAR(often.state_of_charge(), once.state_of_charge(), 1e-9);
  EXPECT_LT(once.state_of_charge(), 0.6);
}

TEST(Battery, EmptiesAfterItsEnduranceAndStaysEmpty) {
  Battery battery(paper_battery());
  const double time = battery.endurance(653.64);
  (void)battery.update(0.0, 653.64);
  EXPECT_EQ(battery.update(0.999 * time, 653.64), BatteryStatus::ok);
  EXPECT_EQ(battery.update(1.001 * time, 653.64), BatteryStatus::empty);
  EXPECT_EQ(battery.update(2.0 * time, 653.64), BatteryStatus::empty);
  EXPECT_EQ(battery.state_of_charge(), 0.0);
  EXPECT_NEAR(battery.load(0.0).voltage, 13.2, 1e-12);
}

// Reference: at half of its voltage the source gives the current U / (2 R).
TEST(Battery, OverloadedBatteryGivesItsLargestPower) {
  for (const double empty : {13.2, 16.8}) {
    BatteryParameters p = paper_battery();
    p.empty_voltage = empty;
    Battery battery(p);
    (void)battery.update(0.0, 1e6);
    const double step = 1e-3;
    double charge = 1.0;
    for (int i = 1; i <= 10000; ++i) {
      const double voltage = empty + charge * (16.8 - empty);
      charge -= step * voltage / (2.0 * p.resistance) / (3600.0 * p.capacity);
    }
    EXPECT_EQ(battery.update(10.0, 1e6), BatteryStatus::overloaded);
    EXPECT_NEAR(battery.state_of_charge(), charge, 1e-5);
    EXPECT_LT(charge, 0.7);
  }
}

TEST(Battery, InvalidInputChangesNothing) {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN(),
                   infinity = std::numeric_limits<double>::infinity();
  Battery battery(paper_battery());
  (void)battery.update(0.0, 500.0);
  (void)battery.update(10.0, 500.0);
  const double charge = battery.state_of_charge();
  for (const double bad : {nan, infinity, -infinity, -1.0, 1e300}) {
    EXPECT_EQ(battery.update(20.0, bad), BatteryStatus::rejected);
    EXPECT_EQ(battery.load(bad).status, BatteryStatus::rejected);
    EXPECT_TRUE(std::isfinite(battery.load(bad).voltage));
    EXPECT_EQ(battery.endurance(bad), 0.0);
  }
  for (const double bad : {nan, infinity, -infinity, 9.95})
    EXPECT_EQ(battery.update(bad, 500.0), BatteryStatus::rejected);
  EXPECT_EQ(battery.endurance(500.0, nan), 0.0);
  EXPECT_EQ(battery.state_of_charge(), charge);
  EXPECT_EQ(battery.update(11.0, 500.0), BatteryStatus::ok);
  EXPECT_LT(battery.state_of_charge(), charge);
}

TEST(Battery, GoesOnAfterTheClockWasSetBack) {
  Battery battery(paper_battery()), undisturbed(paper_battery());
  for (const double time : {100.0, 110.0, 10.0, 20.0}) (void)battery.update(time, 500.0);
  for (const double time : {0.0, 20.0}) (void)undisturbed.update(time, 500.0);
  EXPECT_NEAR(battery.state_of_charge(), undisturbed.state_of_charge(), 1e-12);
  EXPECT_LT(battery.state_of_charge(), 1.0);
}

TEST(Battery, AnyInputGivesFiniteResults) {
  Random random(4);
  Battery battery(paper_battery());
  for (int i = 0; i < 100000; ++i) {
    const double power = std::pow(10.0, random.uniform(-320.0, 320.0)),
                 time = std::pow(10.0, random.uniform(-3.0, 12.0));
    if (i % 10 == 0) battery = Battery(any_battery(random), random.uniform(0.0, 1.0));
    (void)battery.update(time, power);
    const BatteryLoad load = battery.load(power);
    ASSERT_TRUE(std::isfinite(load.current) && std::isfinite(load.voltage));
    ASSERT_TRUE(battery.state_of_charge() >= 0.0 && battery.state_of_charge() <= 1.0);
    ASSERT_FALSE(std::isnan(battery.endurance(power)));
  }
}

// The paper's battery weighs 485 g (paper, Sec. Hardware System Design).
TEST(Battery, PaperBatteryHasThePaperCapacityAndAPossibleEnergyPerMass) {
  const Battery battery(paper_battery());
  EXPECT_EQ(battery.parameters().capacity, 5.3);
  const double per_kilogram = battery.energy() / 3600.0 / 0.485;
  EXPECT_GT(per_kilogram, 150.0);
  EXPECT_LT(per_kilogram, 190.0);
  EXPECT_EQ(battery.load(653.64).status, BatteryStatus::ok);
}

TEST(Battery, StatusHasAName) {
  EXPECT_STREQ(to_string(BatteryStatus::ok), "ok");
  EXPECT_STREQ(to_string(BatteryStatus::overloaded), "overloaded");
  EXPECT_STREQ(to_string(BatteryStatus::empty), "empty");
  EXPECT_STREQ(to_string(BatteryStatus::rejected), "rejected");
  EXPECT_STREQ(to_string(static_cast<BatteryStatus>(99)), "unknown");
}

}  // namespace battery_test
