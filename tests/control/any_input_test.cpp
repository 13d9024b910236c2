// Numbers that nobody means (CHECKS 2), into the controller: it says so, gives a wrench within its
// bounds, and flies on as before as soon as the numbers are good again; and into the functions
// around it whose own tests do not do the same.

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/hovering.hpp"
#include "support/random.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/control/ground_contact.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>

namespace tilt_ropter {
namespace {

using test_support::hover;
using test_support::hovering;

class AnyNumber {
 public:
  explicit AnyNumber(unsigned seed) : random_(seed) {}

  /// `good`, or with the likelihood `share` one of the others.
  double operator()(double good, double share) {
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
    if (random_.uniform(0.0, 1.0) >= share) return good;
    return others[static_cast<std::size_t>(random_.uniform(0.0, others.size()))];
  }
  Eigen::Vector3d operator()(const Eigen::Vector3d& good, double share) {
    return good.unaryExpr([&](double x) { return (*this)(x, share); });
  }
  Eigen::Quaterniond operator()(const Eigen::Quaterniond& good, double share) {
    Eigen::Quaterniond q = good;
    for (int i = 0; i < 4; ++i) q.coeffs()(i) = (*this)(q.coeffs()(i), share);
    return q;
  }
  BodyState<> operator()(const BodyState<>& good, double share) {
    BodyState<> x;
    x.position = (*this)(good.position, share);
    x.velocity = (*this)(good.velocity, share);
    x.orientation = (*this)(good.orientation, share);
    x.angular_velocity = (*this)(good.angular_velocity, share);
    return x;
  }
  Wrench<> operator()(const Wrench<>& good, double share) {
    const Eigen::Vector3d force = (*this)(good.force, share);
    return {force, (*this)(good.torque, share)};
  }

 private:
  test_support::Random random_;
};

/// Of bad numbers, in turn: hardly one that is good, some, a single one now and then.
double share_of(int call) {
  return call % 3 == 0 ? 0.5 : call % 3 == 1 ? 0.05 : 0.005;
}

TEST(AnyInput, ToTheControllerIsSurvived) {
  const int ticks = test_support::quick_or_full(200, 10000);
  AnyNumber any(2);
  NmpcSettings settings;
  settings.solver.max_feedback_time = 0.05;
  Nmpc<4> nmpc(tilt_ropter_vehicle(), settings);
  const NmpcBounds& bounds = settings.problem.bounds;
  int rejected = 0, not_finite = 0, out_of_bounds = 0;
  double longest = 0.0, time = 0.0, worst_way = 0.0, worst_error = 0.0;
  const RigidBody<> plant(tilt_ropter_vehicle().body);
  for (int i = 0; i < ticks; ++i) {
    const double share = share_of(i);
    const double now = any(time, share);
    const auto reference = [&](double t) {
      ReferencePoint point = hover(t);
      point.position = any(point.position, share);
      point.velocity = any(point.velocity, share);
      point.acceleration = any(point.acceleration, share);
      point.orientation = any(point.orientation, share);
      point.angular_velocity = any(point.angular_velocity, share);
      point.angular_acceleration = any(point.angular_acceleration, share);
      return point;
    };
    const BodyState<> state = any(hovering(), share);
    const Wrench<> external = any(Wrench<>{}, share);
    const auto begin = std::chrono::steady_clock::now();
    (void)nmpc.prepare(now, reference, in_the_air(external));
    const NmpcResult result = nmpc.feedback(any(time, share), state);
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
    // Good numbers again, from a vehicle that hovers and gets what is commanded from now on.
    State<> x;
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

TEST(AnyInput, ToTheContactEstimatorIsSurvived) {
  const int calls = test_support::quick_or_full(100000, 1000000);
  AnyNumber any(3);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  ContactEstimator contact(vehicle);
  const Eigen::Vector3d k = Eigen::Vector3d::Constant(5.0);
  Wrench<> weight;
  weight.force.z() = vehicle.body.mass * gravity;
  int rejected = 0;
  double now = 0.0;
  for (int i = 0; i < calls; ++i) {
    const double share = share_of(i);
    const BodyState<> state = any(hovering(), share);
    const Wrench<> external = any(Wrench<>{}, share);
    const ContactEstimate before = contact.estimate();
    now += 0.01;
    const ContactEstimate& after =
        contact.update(any(now, share), state, external, k, k, external.force);
    ASSERT_TRUE(is_finite(after));
    if (!is_finite(state) || !is_finite(external)) {
      ++rejected;
      ASSERT_EQ(after.on_ground, before.on_ground);
      ASSERT_EQ(after.ground.height, before.ground.height);
      ASSERT_EQ(after.disturbance.force, before.disturbance.force);
    }
    if (i % 1000 != 0) continue;
    // Good numbers again, in the air and on the wheels.
    now += 10.0;  // or the clock has been set
    BodyState<> good = hovering();
    const auto feed = [&](const Wrench<>& shown) {
      for (int j = 0; j < 300; ++j) contact.update(now += 0.01, good, shown, k, k, shown.force);
    };
    good.position.z() = 50.0;  // where no number was
    feed({});
    ASSERT_FALSE(contact.estimate().on_ground);
    good.position.z() = vehicle.wheels->radius;
    feed(weight);
    ASSERT_TRUE(contact.estimate().on_ground);
    ASSERT_NEAR(contact.estimate().ground.height, 0.0, 1e-6);
  }
  EXPECT_GT(rejected, calls / 10);
}

TEST(AnyInput, ToTheActuatorModelIsSurvived) {
  const int calls = test_support::quick_or_full(100000, 1000000);
  AnyNumber any(4);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Rotor<> rotor(vehicle.rotor);
  ActuatorModel<4> actuators(vehicle);
  ActuatorState<4> command;
  for (int i = 0; i < calls; ++i) {
    const double time = 0.001 * i;
    for (int k = 0; k < 4; ++k) {
      command.rotor_speed(k) = any(1000.0, share_of(i));
      command.tilt_angle(k) = any(0.3, share_of(i));
    }
    if (i % 1000 == 0) actuators.reset(command, any(time, 0.5));
    const ActuatorState<4>& state = actuators.update(any(time, 0.01), command);
    ASSERT_TRUE((state.rotor_speed.array() >= rotor.min_speed()).all() &&
                (state.rotor_speed.array() <= rotor.max_speed()).all());
    ASSERT_TRUE((state.tilt_angle.array() >= vehicle.servo.min_angle).all() &&
                (state.tilt_angle.array() <= vehicle.servo.max_angle).all());
  }
}

TEST(AnyInput, TimesToAMissionGiveFinitePoints) {
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

}  // namespace
}  // namespace tilt_ropter
