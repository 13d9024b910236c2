// A wall stops the vehicle in front of its reference.
// CTest: flight

#include "support/control_loop.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace tilt_ropter {
namespace {

constexpr double wall = 0.5;  // [m]

struct Touch {
  double force = 0.0, drop = 0.0, lean = 0.0;  // largest, after the first second on the wall
  bool limited = false;
};

// Hovers in front of the wall, then follows a reference `behind` it for 30 s.
Touch touch(double behind, double friction) {
  test_support::ControlLoop<Plant<4>> loop(1);
  constexpr double height = 1.5;
  loop.start(height - 0.11, Eigen::Vector3d::Zero(), 0.0);
  Touch result;
  double touched_at = 1e9;
  for (int i = 0; i < 3300; ++i) {
    const BodyStated& body = loop.plant().body();
    const double deep = body.position.x() - wall;
    Wrenchd reaction;
    if (deep > 0.0) {
      const double push = std::max(0.0, 2000.0 * deep + 40.0 * body.velocity.x());
      const Eigen::Vector2d slide = body.velocity.tail<2>();
      reaction.force.x() = -push;
      reaction.force.tail<2>() = -friction * push * slide / (slide.norm() + 0.02);
      touched_at = std::min(touched_at, loop.plant().time());
    }
    loop.disturbance = wrench_in_body(reaction, body.orientation);
    ReferencePoint point;
    point.position << (i < 100 ? 0.0 : std::min(wall + behind, 0.005 * (i - 100))), 0.0, height;
    EXPECT_TRUE(has_plan(loop.tick([&point](double) { return point; }).status));
    if (loop.plant().time() < touched_at + 1.0) continue;
    result.force = std::max(result.force, -reaction.force.x());
    result.drop = std::max(result.drop, height - body.position.z());
    const double up = (body.orientation * Eigen::Vector3d::UnitZ()).z();
    result.lean = std::max(result.lean, std::acos(std::min(1.0, up)));
    result.limited = result.limited || loop.contact().estimate().limited;
  }
  std::printf("%.2f m behind, friction %.1f: %.1f N, %.3f m lower, %.1f deg\n", behind, friction,
              result.force, result.drop, result.lean * 180.0 / pi);
  return result;
}

TEST(Wall, TheForceOfAReferenceBehindItHasAnEnd) {
  for (const double behind : {0.02, 0.05, 0.2, 0.5})
    for (const double friction : {0.0, 0.3}) {
      const Touch t = touch(behind, friction);
      EXPECT_LT(t.force, 12.0) << behind;
      EXPECT_LT(t.drop, 0.05) << behind;
      EXPECT_LT(t.lean, 0.2) << behind;
      EXPECT_TRUE(t.limited);
    }
}

}  // namespace
}  // namespace tilt_ropter
