// Derivatives of the maps between wrench and actuators, and the compensation of lag that uses them.

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>

#include "support/allocation_checks.hpp"
#include "support/autodiff.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>

namespace allocation_rates_test {

using namespace tilt_ropter;
using Eigen::Vector3d;
using test_support::expect_within_limits;
using test_support::hovering;
using test_support::Random;
using test_support::random_wrench;
using test_support::runs;
using test_support::with_tilt_range;

using Status = AllocationStatus;
constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

TEST(Allocation, ForwardMapDerivativesMatchMatrixColumns) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  Random random(14);
  for (int run = 0; run < runs(1000); ++run) {
    ActuatorState<4> at;
    for (int i = 0; i < 4; ++i) {
      at.rotor_speed(i) = run % 10 == 0 ? 0.0 : random.uniform(0.0, 3000.0);
      at.tilt_angle(i) = random.uniform(-pi, pi);
    }
    const auto jacobian = test_support::jacobian_at_zero<6, 8>([&](const auto& dual) {
      using Dual = test_support::Dual<8>;
      ActuatorState<4, Dual> moved;
      for (int i = 0; i < 4; ++i) {
        moved.rotor_speed(i) = at.rotor_speed(i) + dual(2 * i);
        moved.tilt_angle(i) = at.tilt_angle(i) + dual(2 * i + 1);
      }
      const Wrench<Dual> wrench = allocation.wrench(moved);
      Eigen::Matrix<Dual, 6, 1> packed;
      packed << wrench.force, wrench.torque;
      return packed;
    });
    for (int i = 0; i < 4; ++i) {
      const double c = vehicle.rotor.thrust_coefficient, speed = at.rotor_speed(i);
      const double sine = std::sin(at.tilt_angle(i)), cosine = std::cos(at.tilt_angle(i));
      const auto lateral = allocation.matrix().col(2 * i);
      const auto vertical = allocation.matrix().col(2 * i + 1);
      EXPECT_LT(
          (jacobian.col(2 * i) - 2.0 * c * speed * (sine * lateral + cosine * vertical)).norm(),
          1e-15);
      EXPECT_LT((jacobian.col(2 * i + 1) - c * speed * speed * (cosine * lateral - sine * vertical))
                    .norm(),
                1e-12);
    }
  }
}

TEST(Allocation, RatesMatchDerivativesOfInverseMap) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  Random random(15);
  using Dual = test_support::Dual<1>;
  for (int run = 0; run < runs(2000); ++run) {
    const Wrenchd wrench = random_wrench(random, 8.0, 0.5), rate = random_wrench(random, 5.0, 2.0);
    const ActuatorRates<4> rates = allocation.rates(wrench, rate);
    Eigen::Matrix<Dual, 6, 1> packed;
    for (int i = 0; i < 3; ++i) {
      packed(i) = Dual(wrench.force(i), Eigen::Matrix<double, 1, 1>(rate.force(i)));
      packed(i + 3) = Dual(wrench.torque(i), Eigen::Matrix<double, 1, 1>(rate.torque(i)));
    }
    const Eigen::Matrix<Dual, 8, 1> thrusts = allocation.pseudoinverse().cast<Dual>() * packed;
    for (int i = 0; i < 4; ++i) {
      const Dual size =
          sqrt(Dual(thrusts(2 * i) * thrusts(2 * i) + thrusts(2 * i + 1) * thrusts(2 * i + 1)));
      if (size.value() < 0.02) continue;
      const Dual angle = atan2(thrusts(2 * i), thrusts(2 * i + 1));
      const Dual speed = speed_from_thrust(size, vehicle.rotor);
      EXPECT_NEAR(rates.tilt_rate(i), angle.derivatives()(0),
                  1e-11 * (1.0 + std::abs(rates.tilt_rate(i))));
      EXPECT_NEAR(rates.rotor_acceleration(i), speed.derivatives()(0),
                  1e-11 * (1.0 + std::abs(rates.rotor_acceleration(i))));
    }
  }
}

TEST(Allocation, RatesMatchFiniteDifferencesOfCommands) {
  const Allocation allocation(with_tilt_range(-6.0 * pi, 6.0 * pi));
  Random random(16);
  for (int run = 0; run < 200; ++run) {
    const Wrenchd wrench = random_wrench(random, 8.0, 0.5), rate = random_wrench(random, 5.0, 2.0);
    const auto at = [&](double t) {
      return Wrenchd{wrench.force + t * rate.force, wrench.torque + t * rate.torque};
    };
    const auto now = allocation.allocate(wrench, {});
    const auto before = allocation.allocate(at(-1e-6), now.command).command;
    const auto after = allocation.allocate(at(1e-6), now.command).command;
    const ActuatorRates<4> rates = allocation.rates(wrench, rate);
    for (int i = 0; i < 4; ++i) {
      const double tilt = (after.tilt_angle(i) - before.tilt_angle(i)) / 2e-6;
      const double speed = (after.rotor_speed(i) - before.rotor_speed(i)) / 2e-6;
      if (now.command.rotor_speed(i) < 400.0) continue;
      EXPECT_NEAR(rates.tilt_rate(i), tilt, 1e-5 * (1.0 + std::abs(tilt)));
      EXPECT_NEAR(rates.rotor_acceleration(i), speed, 1e-4 * (1.0 + std::abs(speed)));
    }
  }
}

TEST(Allocation, RatesAreFiniteAtZeroThrustAndZeroForInvalidInput) {
  const Allocation allocation(tilt_ropter_vehicle());
  Wrenchd rate;
  rate.force << 1.0, 2.0, 3.0;
  const ActuatorRates<4> at_rest = allocation.rates({}, rate);
  EXPECT_EQ(at_rest.tilt_rate.norm() + at_rest.rotor_acceleration.norm(), 0.0);
  for (const double bad : {nan, infinity, 1e300}) {
    Wrenchd wrench;
    wrench.force.setConstant(bad);
    EXPECT_EQ(allocation.rates(wrench, wrench).tilt_rate.norm(), 0.0);
    EXPECT_TRUE(all_finite(allocation.rates(wrench, rate).rotor_acceleration));
  }
}

/// Returns the largest error [N] of the force from lagging actuators along a smooth path of
/// wrenches.
double lag_error(double lag_compensation) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  AllocationSettings settings;
  settings.lag_compensation = lag_compensation;
  const Allocation allocation(vehicle, settings);
  ActuatorModel<4> actuators(vehicle);
  AllocationResult<4> last;
  last.command = hovering(vehicle);
  actuators.reset(last.command, 0.0);
  double error = 0.0;
  for (int i = 0; i < 2000; ++i) {
    const double time = 0.002 * i;
    Wrenchd wanted, rate;
    wanted.force << 3.0 * std::sin(3.0 * time), 0.0, 15.0 + std::cos(2.0 * time);
    rate.force << 9.0 * std::cos(3.0 * time), 0.0, -2.0 * std::sin(2.0 * time);
    last = allocation.allocate(time, wanted, rate, last);
    const Wrenchd applied = allocation.wrench(actuators.update(time, last.command));
    if (time > 1.0) error = std::max(error, (applied.force - wanted.force).norm());
  }
  return error;
}

TEST(Allocation, LagCompensationCancelsActuatorLag) {
  const double lagging = lag_error(0.0);
  EXPECT_GT(lagging, 0.3);
  EXPECT_LT(lag_error(1.0), 0.1 * lagging);
  EXPECT_NEAR(lag_error(0.5), 0.5 * lagging, 0.15 * lagging);
}

TEST(Allocation, LagCompensationKeepsLimits) {
  const Vehicle<4> vehicle = with_tilt_range(-1.0, 1.0);
  const Allocation allocation(vehicle);
  Random random(18);
  AllocationResult<4> last;
  for (int i = 0; i < 20000; ++i) {
    const Wrenchd wanted = random_wrench(random, 15.0, 1.0);
    const Wrenchd rate = random_wrench(random, i % 2 == 0 ? 1e300 : 500.0, 500.0);
    last = allocation.allocate(0.01 * i, wanted, rate, last);
    expect_within_limits(vehicle, last.command);
  }
  const auto rejected =
      allocation.allocate(300.0, {Vector3d(nan, 0.0, 0.0), Vector3d::Zero()}, {}, last);
  EXPECT_EQ(rejected.status, Status::rejected);
  EXPECT_EQ(rejected.command.tilt_angle, last.command.tilt_angle);
}

TEST(Allocation, LagCompensationIsReducedAtSmallThrust) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  // One hundredth of the hover thrust is a tenth of the thrust at which calm_fraction acts.
  const Wrenchd faint{Vector3d(0.0, 0.0, 0.01 * vehicle.body.mass * gravity), Vector3d::Zero()};
  const Wrenchd sideways{Vector3d(0.2, 0.0, 0.0), Vector3d::Zero()};
  const double full = vehicle.servo.time_constant * allocation.rates(faint, sideways).tilt_rate(0);
  EXPECT_GT(std::abs(full), 0.01);
  EXPECT_NEAR(allocation.allocate(0.0, faint, sideways, {}).command.tilt_angle(0), 0.01 * full,
              1e-9);
}

}  // namespace allocation_rates_test
