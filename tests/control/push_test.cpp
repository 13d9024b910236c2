// The vehicle pushes on a surface with a given force, slides along it, and leaves it again.
// CTest: flight

#include "support/actuator_loop.hpp"
#include "support/control_loop.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace tilt_ropter {
namespace push_test {

constexpr double height = 1.5, wall_at = 1.0, reach = 0.28;

struct Case {
  double force = 5.0;                         // [N]
  double declared = wall_at, friction = 0.5;  // of the surface that the controller is told
  double wall = wall_at;                      // where it is [m]
};

// Means and standard deviation of the force from 2 s after the touch on, errors of a slide.
struct Result {
  double mean = 0.0, stddev = 0.0, touch_down = 0.0;  // [N]
  double least = 1e9, most = 0.0, error = 0.0;        // in the slide, means over 0.1 s [N]; [m]
  double end = 0.0, foremost = 0.0;                   // x [m]
  double after = 0.0;                                 // error at the end of the push [m]
  bool touches_at_end = true;
};

constexpr double start = 1.0, rests = 8.0, slides = 10.5, ends = 13.0, back = 14.5;  // [s]

// From 1 s on pushes, from 8 s on slides 0.3 m at 0.2 m/s, from 13 s on flies back.
ReferencePoint reference_at(double time, const Case& c) {
  ReferencePoint point;
  point.position << wall_at - reach - 0.08, 0.0, height;
  if (time >= start && time < ends) {
    SurfacePush push;
    push.surface.point.x() = c.declared;
    push.surface.tool.x() = reach;
    push.surface.friction = c.friction;
    push.force = c.force;
    point.push = push;
  }
  const double u = std::clamp(time - rests, 0.0, slides - rests), a = 0.2;
  const bool speeds_up = u<1.0, slows_down = u> 1.5;
  const double left = slides - rests - u;
  point.position.y() = speeds_up    ? 0.5 * a * u * u
                       : slows_down ? 0.3 - 0.5 * a * left * left
                                    : 0.1 + 0.2 * (u - 1.0);
  if (time > rests && time < slides) {
    point.velocity.y() = speeds_up ? a * u : slows_down ? a * left : 0.2;
    point.acceleration.y() = speeds_up ? a : slows_down ? -a : 0.0;
  }
  return point;
}

template <typename Loop>
Result fly(Loop& loop, const Case& c) {
  Wall wall;
  wall.point.x() = c.wall;
  wall.hull_centre.x() = reach;
  loop.set_wall(wall);
  const auto reference = [&c](double time) { return reference_at(time, c); };
  Result r;
  double touched_at = std::numeric_limits<double>::infinity(), sum = 0.0, squares = 0.0;
  int count = 0;
  std::array<double, 10> forces{};
  for (std::size_t i = 0; loop.plant().time() < back; ++i) {
    EXPECT_TRUE(has_plan(loop.tick(reference).status));
    const double time = loop.plant().time(), force = loop.plant().wall_force();
    if (force > 0.0) touched_at = std::min(touched_at, time);
    forces[i % forces.size()] = force;
    double mean = 0.0;
    for (const double f : forces) mean += 0.1 * f;
    const Eigen::Vector3d& position = loop.plant().body().position;
    r.foremost = std::max(r.foremost, position.x());
    if (time < touched_at + 2.0) {
      r.touch_down = std::max(r.touch_down, mean);
    } else if (time < rests) {
      sum += force;
      squares += force * force;
      ++count;
    } else if (time < slides) {
      r.least = std::min(r.least, mean);
      r.most = std::max(r.most, mean);
      const Eigen::Vector3d off = position - reference(time).position;
      r.error = std::max(r.error, off.tail<2>().norm());
    } else if (time < ends) {
      const Eigen::Vector3d off = position - reference(time).position;
      r.after = off.tail<2>().norm();
    }
  }
  r.mean = sum / std::max(count, 1);
  r.stddev = std::sqrt(std::max(0.0, squares / std::max(count, 1) - r.mean * r.mean));
  r.end = loop.plant().body().position.x();
  r.touches_at_end = loop.contact().estimate().touches_for > 0.0;
  return r;
}

Result fly_at(bool actuator_level, const Case& c, double mass = 1.0, double thrust = 1.0) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  if (actuator_level) {
    Vehicle<4> truth = vehicle;
    truth.body.mass *= mass;
    for (double* value : {&truth.rotor.thrust_coefficient, &truth.rotor.max_thrust})
      *value *= thrust;
    test_support::ActuatorLoop<4> loop(truth, vehicle);
    loop.start({wall_at - reach - 0.08, 0.0, height});
    return fly(loop, c);
  }
  test_support::ControlLoop<Plant<4>> loop(1);
  loop.start(height - 0.11, Eigen::Vector3d::Zero(), 0.0);
  BodyStated body = loop.plant().body();
  body.position.x() = wall_at - reach - 0.08;
  loop.put(body);
  return fly(loop, c);
}

class PushAt : public testing::TestWithParam<bool> {};
INSTANTIATE_TEST_SUITE_P(Levels, PushAt, testing::Bool());

TEST_P(PushAt, HoldsTheForceSlidesAndLeaves) {
  const Result r = fly_at(GetParam(), {});
  EXPECT_NEAR(r.mean, 5.0, 0.1);
  EXPECT_LT(r.stddev, 0.15);
  EXPECT_LT(r.touch_down, 6.0);
  EXPECT_GT(r.least, 4.4);
  EXPECT_LT(r.most, 5.6);
  EXPECT_LT(r.error, 0.012);
  EXPECT_LT(r.after, 0.015);
  EXPECT_NEAR(r.end, wall_at - reach - 0.08, 0.02);
  EXPECT_FALSE(r.touches_at_end);
}

TEST_P(PushAt, FindsSurfaceAndFrictionThatAreNotAsDeclared) {
  for (const double off : {-0.02, 0.02}) {
    const Result r = fly_at(GetParam(), {3.0, wall_at + off, off < 0.0 ? 0.3 : 0.8, wall_at});
    EXPECT_NEAR(r.mean, 3.0, 0.2) << off;
    EXPECT_LT(r.error, 0.03) << off;
  }
}

TEST_P(PushAt, StopsBehindASurfaceThatIsNotThere) {
  const Result r = fly_at(GetParam(), {5.0, wall_at, 0.5, wall_at + 1.0});
  EXPECT_EQ(r.mean, 0.0);
  EXPECT_NEAR(r.foremost, wall_at - reach + 0.05, 0.02);
  EXPECT_NEAR(r.end, wall_at - reach - 0.08, 0.02);
}

TEST(Push, ToleratesWrongMassAndThrust) {
  for (const double off : {0.9, 1.1}) {
    EXPECT_NEAR(fly_at(true, {}, off, 1.0).mean, 5.0, 0.5) << off;
    EXPECT_NEAR(fly_at(true, {}, 1.0, off).mean, 5.0, 0.5) << off;
  }
}

TEST(Push, IgnoresAnUnusableOne) {
  SurfacePush push;
  push.force = 5.0;
  EXPECT_TRUE(is_usable(push));
  const auto unusable = [push](auto&& change) {
    SurfacePush changed = push;
    change(changed);
    return !is_usable(changed);
  };
  const double nan = std::numeric_limits<double>::quiet_NaN();
  EXPECT_TRUE(unusable([](SurfacePush& p) { p.force = 0.0; }));
  EXPECT_TRUE(unusable([nan](SurfacePush& p) { p.force = nan; }));
  EXPECT_TRUE(unusable([](SurfacePush& p) { p.surface.normal *= 1.1; }));
  EXPECT_TRUE(unusable([nan](SurfacePush& p) { p.surface.point.y() = nan; }));
  EXPECT_TRUE(unusable([nan](SurfacePush& p) { p.surface.tool.z() = nan; }));
  EXPECT_TRUE(unusable([](SurfacePush& p) { p.surface.friction = -0.1; }));
}

TEST(Push, ASlideIsAlongTheSurface) {
  Surface surface;
  surface.normal << -0.6, 0.0, 0.8;
  const Eigen::Vector3d along(0.8, 0.0, 0.6);
  EXPECT_TRUE(
      slide_along(surface, 0.2 * along + 0.3 * surface.normal).isApprox(0.2 * along, 1e-12));
  EXPECT_TRUE(slide_along(surface, surface.normal).isZero(0.0));
}

}  // namespace push_test
}  // namespace tilt_ropter
