// Arbitrary input numbers (check 2), for example NaN, infinity and huge numbers. The controller
// must report them, return a wrench within its bounds, and fly as before once the inputs are good
// again. The other tests cover functions around the controller whose own tests lack this check.

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/hovering.hpp"
#include "support/random.hpp"
#include "support/simulated_time.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>

namespace tilt_ropter {
namespace any_input_test {

using test_support::hover;
using test_support::hovering;

class AnyNumber {
 public:
  explicit AnyNumber(unsigned seed) : random_(seed) {}

  /// Returns `good`, or with the probability `fraction` one of the other numbers.
  double operator()(double good, double fraction) {
    using Limits = std::numeric_limits<double>;
    constexpr std::array<double, 12> others = {Limits::quiet_NaN(),
                                               Limits::infinity(),
                                               -Limits::infinity(),
                                               0.0,
                                               Limits::denorm_min(),
                                               1e300,
                                               -1e300,
                                               1e9,
                                               -1e9,
                                               1e3,
                                               -10.0,
                                               1.0};
    if (random_.uniform(0.0, 1.0) >= fraction) return good;
    return others[static_cast<std::size_t>(random_.uniform(0.0, others.size()))];
  }
  Eigen::Vector3d operator()(const Eigen::Vector3d& good, double fraction) {
    return good.unaryExpr([&](double x) { return (*this)(x, fraction); });
  }
  Eigen::Quaterniond operator()(const Eigen::Quaterniond& good, double fraction) {
    Eigen::Quaterniond q = good;
    for (int i = 0; i < 4; ++i) q.coeffs()(i) = (*this)(q.coeffs()(i), fraction);
    return q;
  }
  BodyStated operator()(const BodyStated& good, double fraction) {
    BodyStated x;
    x.position = (*this)(good.position, fraction);
    x.velocity = (*this)(good.velocity, fraction);
    x.orientation = (*this)(good.orientation, fraction);
    x.angular_velocity = (*this)(good.angular_velocity, fraction);
    return x;
  }
  Wrenchd operator()(const Wrenchd& good, double fraction) {
    const Eigen::Vector3d force = (*this)(good.force, fraction);
    return {force, (*this)(good.torque, fraction)};
  }

 private:
  test_support::Random random_;
};

/// Fraction of bad numbers in this call. The calls cycle through 50 %, 5 % and 0.5 %.
double fraction_of(int call) {
  return call % 3 == 0 ? 0.5 : call % 3 == 1 ? 0.05 : 0.005;
}

TEST(AnyInput, ControllerSurvivesArbitraryInput) {
  const int ticks = test_support::quick_or_full(200, 10000);
  AnyNumber any(2);
  const NmpcSettings settings = test_support::in_simulated_time();
  Nmpc<4> nmpc(tilt_ropter_vehicle(), settings);
  const NmpcBounds& bounds = settings.problem.bounds;
  int rejected = 0, not_finite = 0, out_of_bounds = 0;
  double longest = 0.0, time = 0.0, worst_way = 0.0, worst_error = 0.0;
  const RigidBodyd plant(tilt_ropter_vehicle().body);
  for (int i = 0; i < ticks; ++i) {
    const double fraction = fraction_of(i);
    const double now = any(time, fraction);
    const auto reference = [&](double t) {
      ReferencePoint point = hover(t);
      point.position = any(point.position, fraction);
      point.velocity = any(point.velocity, fraction);
      point.acceleration = any(point.acceleration, fraction);
      point.orientation = any(point.orientation, fraction);
      point.angular_velocity = any(point.angular_velocity, fraction);
      point.angular_acceleration = any(point.angular_acceleration, fraction);
      return point;
    };
    const BodyStated state = any(hovering(), fraction);
    const Wrenchd external = any(Wrenchd{}, fraction);
    const auto begin = std::chrono::steady_clock::now();
    (void)nmpc.prepare(now, reference, in_the_air(external));
    const NmpcResult result = nmpc.feedback(any(time, fraction), state);
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begin;
    longest = std::max(longest, took.count());
    not_finite += !is_finite(result.wrench) || !is_finite(result.rate);
    out_of_bounds += !test_support::is_within_bounds(result.wrench, bounds);
    rejected += !has_plan(result.status);
    if (!is_finite(state) || !std::isfinite(now)) {
      EXPECT_FALSE(has_plan(result.status));
    }
    time += 0.01;
    if (i % 10 != 0) continue;
    // Good inputs again, from a vehicle that hovers and receives the commanded wrench from now on.
    Stated x;
    x.body = hovering();
    double worst = 0.0;
    for (int k = 0; k < 300; ++k) {
      (void)nmpc.prepare(time, hover, {});
      const NmpcResult& back = nmpc.feedback(time, x.body);
      x.wrench = back.wrench;
      Eigen::Matrix<double, 6, 1> rate;
      rate << back.rate.force, back.rate.torque;
      x = plant.step(x, rate, {}, 0.01);
      time += 0.01;
      worst = std::max(worst, (x.body.position - hovering().position).norm());
    }
    worst_error = std::max(worst_error, (x.body.position - hovering().position).norm());
    worst_way = std::max(worst_way, worst);
  }
  EXPECT_GT(rejected, ticks / 10);
  test_support::check_at_most(2, "NMPC: wrenches not finite", not_finite, 0);
  test_support::check_at_most(2, "NMPC: wrenches out of bounds", out_of_bounds, 0);
  test_support::check_at_most(2, "NMPC: error 3 s after bad input [m]", worst_error, 0.01);
  RecordProperty("worst_way_m", std::to_string(worst_way));
  RecordProperty("longest_tick_ms", std::to_string(1e3 * longest));
}

TEST(AnyInput, ContactEstimatorSurvivesArbitraryInput) {
  const int calls = test_support::quick_or_full(100000, 1000000);
  AnyNumber any(3);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  ContactEstimator contact(vehicle);
  ObservedWrenchd observed;
  const auto see = [&](double time, const Wrenchd& external) {
    observed = unfiltered_wrench(observed, time, external);
    observed.external = external;  // also what unfiltered_wrench() rejects
    return observed;
  };
  Wrenchd weight;
  weight.force.z() = vehicle.body.mass * gravity;
  int rejected = 0;
  double now = 0.0;
  for (int i = 0; i < calls; ++i) {
    const double fraction = fraction_of(i);
    const BodyStated state = any(hovering(), fraction);
    const Wrenchd external = any(Wrenchd{}, fraction);
    const ContactEstimate before = contact.estimate();
    now += 0.01;
    const double time = any(now, fraction);
    const ContactEstimate& after = contact.update(time, state, see(time, external));
    ASSERT_TRUE(is_finite(after));
    if (!is_finite(state) || !is_finite(external)) {
      ++rejected;
      ASSERT_EQ(after.on_ground, before.on_ground);
      ASSERT_EQ(after.ground.height, before.ground.height);
      ASSERT_EQ(after.disturbance.force, before.disturbance.force);
    }
    if (i % 1000 != 0) continue;
    // Good inputs again, in the air and on the wheels.
    now += 10.0;  // later than the last time, or the clock was set
    BodyStated good = hovering();
    const auto feed = [&](const Wrenchd& shown) {
      for (int j = 0; j < 300; ++j) {
        now += 0.01;
        contact.update(now, good, see(now, shown));
      }
    };
    good.position.z() = 50.0;  // not one of the bad numbers
    feed({});
    ASSERT_FALSE(contact.estimate().on_ground);
    good.position.z() = vehicle.wheels->radius;
    feed(weight);
    ASSERT_TRUE(contact.estimate().on_ground);
    ASSERT_NEAR(contact.estimate().ground.height, 0.0, 1e-6);
  }
  EXPECT_GT(rejected, calls / 10);
}

TEST(AnyInput, ActuatorModelSurvivesArbitraryInput) {
  const int calls = test_support::quick_or_full(100000, 1000000);
  AnyNumber any(4);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Rotord rotor(vehicle.rotor);
  ActuatorModel<4> actuators(vehicle);
  ActuatorState<4> command;
  for (int i = 0; i < calls; ++i) {
    const double time = 0.001 * i;
    for (int k = 0; k < 4; ++k) {
      command.rotor_speed(k) = any(1000.0, fraction_of(i));
      command.tilt_angle(k) = any(0.3, fraction_of(i));
    }
    if (i % 1000 == 0) actuators.reset(command, any(time, 0.5));
    const ActuatorState<4>& state = actuators.update(any(time, 0.01), command);
    ASSERT_TRUE((state.rotor_speed.array() >= rotor.min_speed()).all() &&
                (state.rotor_speed.array() <= rotor.max_speed()).all());
    ASSERT_TRUE((state.tilt_angle.array() >= vehicle.servo.min_angle).all() &&
                (state.tilt_angle.array() <= vehicle.servo.max_angle).all());
  }
}

TEST(AnyInput, MissionReturnsFinitePointsForArbitraryTimes) {
  const int calls = test_support::quick_or_full(100000, 1000000);
  AnyNumber any(5);
  const Mission mission = hybrid_mission(tilt_ropter_vehicle());
  for (int i = 0; i < calls; ++i) {
    const ReferencePoint point = mission(any(1e-5 * (i % 100000) * mission.duration(), 0.5));
    ASSERT_TRUE(all_finite(point.position) && all_finite(point.velocity) &&
                all_finite(point.acceleration) && all_finite(point.angular_velocity) &&
                all_finite(point.angular_acceleration));
    ASSERT_NEAR(point.orientation.norm(), 1.0, 1e-12);
  }
}

}  // namespace any_input_test
}  // namespace tilt_ropter
