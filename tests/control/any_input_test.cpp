// Numbers that nobody means, into the controller (CHECKS 2): it says so, gives a wrench within its
// bounds, and flies on as before as soon as the numbers are good again. TILT_ROPTER_FULL=1 tries
// 10 000 ticks instead of 200.

#include "support/check_table.hpp"
#include "support/hovering.hpp"
#include "support/random.hpp"

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <cstdlib>
#include <limits>

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

 private:
  test_support::Random random_;
};

TEST(AnyInput, ToTheControllerIsSurvived) {
  const int ticks = std::getenv("TILT_ROPTER_FULL") != nullptr ? 10000 : 200;
  AnyNumber any(2);
  NmpcSettings settings;
  settings.solver.max_feedback_time = 0.05;
  Nmpc<4> nmpc(tilt_ropter_vehicle(), settings);
  const NmpcBounds& bounds = settings.problem.bounds;
  int rejected = 0, not_finite = 0, out_of_bounds = 0;
  double longest = 0.0, time = 0.0, worst_way = 0.0, worst_error = 0.0;
  const RigidBody<> plant(tilt_ropter_vehicle().body);
  for (int i = 0; i < ticks; ++i) {
    const double share = i % 3 == 0 ? 0.5 : i % 3 == 1 ? 0.05 : 0.005;
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
    BodyState<> state = hovering();
    state.position = any(state.position, share);
    state.velocity = any(state.velocity, share);
    state.orientation = any(state.orientation, share);
    state.angular_velocity = any(state.angular_velocity, share);
    const Wrench<> external{any(Eigen::Vector3d::Zero().eval(), share),
                            any(Eigen::Vector3d::Zero().eval(), share)};
    const auto begin = std::chrono::steady_clock::now();
    nmpc.prepare(now, reference, external);
    const NmpcResult result = nmpc.feedback(any(time, share), state);
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begin;
    longest = std::max(longest, took.count());
    not_finite += !is_finite(result.wrench) || !is_finite(result.rate);
    out_of_bounds += !test_support::is_within_bounds(result.wrench, bounds);
    rejected += result.status != NmpcStatus::solved;
    if (!is_finite(state) || !std::isfinite(now)) {
      EXPECT_NE(result.status, NmpcStatus::solved);
    }
    time += 0.01;
    if (i % 10 != 0) continue;
    // Good numbers again, from a vehicle that hovers and gets what is commanded from now on.
    State<> x;
    x.body = hovering();
    double worst = 0.0;
    for (int k = 0; k < 300; ++k) {
      nmpc.prepare(time, hover, {});
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

}  // namespace
}  // namespace tilt_ropter
