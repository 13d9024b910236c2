// A wall of which the controller knows nothing stops the vehicle in front of its reference.
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
#include <optional>
#include <tuple>

namespace tilt_ropter {
namespace wall_test {

constexpr double height = 1.5, wall_at = 0.6, never = std::numeric_limits<double>::infinity();

enum class Part { rotor, rim, hull };

struct Case {
  double behind = 0.5;  // the reference, from where the vehicle touches [m]
  Part part = Part::rotor;
  double speed = 0.2;  // of the reference towards the wall [m/s]
  double stiffness = 1e4, friction = 0.5;
  double wall_until = never;  // [s]

  [[nodiscard]] double yaw() const { return part == Part::rim ? 0.9 : 0.0; }
  [[nodiscard]] double hull_radius() const { return part == Part::hull ? 0.3 : 0.0; }
  // Position at which the vehicle touches [m].
  [[nodiscard]] double touch() const {
    const double reach = part == Part::rotor ? 0.17 + 0.0648
                         : part == Part::rim ? 0.26 * std::sin(0.9) + 0.11 * std::cos(0.9)
                                             : hull_radius();
    return wall_at - reach;
  }
};

struct Result {
  double blocked_after = never;          // of the first touch [s]
  double early = 0.0, late = 0.0;        // force in the first 0.3 s, and after a second [N]
  double drop = 0.0, lean = 0.0;         // after a second [m], [rad]
  double free_after = never, end = 0.0;  // of the wall's end [s], at the end [m]
  double forward = 0.0;                  // direction of the obstacle along x
};

// Flies towards the wall at x = 0.6 m after 1 s of hover; forces are means over 0.1 s.
template <typename Loop>
Result touch(Loop& loop, const Case& c, double duration = 6.0) {
  Wall wall;
  wall.point.x() = wall_at;
  wall.stiffness = c.stiffness;
  wall.friction = c.friction;
  wall.hull_radius = c.hull_radius();
  loop.set_wall(wall);
  const double end = c.touch() + c.behind;
  const auto reference = [&](double time) {
    ReferencePoint point;
    const double x = c.speed * (time - 1.0);
    point.position << std::clamp(x, 0.0, end), 0.0, height;
    if (x > 0.0 && x < end) point.velocity.x() = c.speed;
    point.orientation = quaternion_from_yaw(c.yaw());
    return point;
  };
  Result result;
  double touched_at = never;
  std::array<double, 10> forces{};
  for (std::size_t i = 0; loop.plant().time() < duration; ++i) {
    if (loop.plant().time() > c.wall_until) loop.set_wall(std::nullopt);
    EXPECT_TRUE(has_plan(loop.tick(reference).status));
    const double time = loop.plant().time();
    const BodyStated& body = loop.plant().body();
    const auto& blocked = loop.contact().estimate().blocked;
    forces[i % forces.size()] = loop.plant().wall_force();
    if (loop.plant().wall_force() > 0.0) touched_at = std::min(touched_at, time);
    double mean = 0.0;
    for (const double force : forces) mean += 0.1 * force;
    if (time < touched_at + 0.3) result.early = std::max(result.early, mean);
    if (blocked && result.blocked_after == never) {
      result.blocked_after = time - touched_at;
      result.forward = blocked->direction.x();
    }
    if (time > c.wall_until && !blocked)
      result.free_after = std::min(result.free_after, time - c.wall_until);
    if (time < touched_at + 1.0) continue;
    result.late = std::max(result.late, mean);
    result.drop = std::max(result.drop, std::abs(body.position.z() - height));
    const double up = (body.orientation * Eigen::Vector3d::UnitZ()).z();
    result.lean = std::max(result.lean, std::acos(std::min(1.0, up)));
  }
  result.end = loop.plant().body().position.x();
  return result;
}

Result touch(bool actuator_level, const Case& c) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  if (actuator_level) {
    test_support::ActuatorLoop<4> loop(vehicle, vehicle);
    loop.start({0.0, 0.0, height});
    return touch(loop, c);
  }
  test_support::ControlLoop<Plant<4>> loop(1);
  loop.start(height - 0.11, Eigen::Vector3d::Zero(), c.yaw());
  return touch(loop, c);
}

// At which level, how far behind the wall, with which part, how fast.
class Touch : public testing::TestWithParam<std::tuple<bool, double, Part, double>> {};

TEST_P(Touch, IsBlockedAndBounded) {
  Case c;
  bool actuator_level = false;
  std::tie(actuator_level, c.behind, c.part, c.speed) = GetParam();
  const double weight = tilt_ropter_vehicle().body.mass * gravity;
  for (const double stiffness : {1e3, 5e4}) {
    c.stiffness = stiffness;
    const Result r = touch(actuator_level, c);
    SCOPED_TRACE(stiffness);
    // A soft touch has to reach 0.05 weights first.
    EXPECT_LT(r.blocked_after, 1.2);
    EXPECT_GT(r.forward, 0.7);
    if (c.speed <= 0.2) {
      EXPECT_LT(r.early, 0.45 * weight);  // the momentum alone is 0.3 N s
    }
    EXPECT_LT(r.late, (c.speed > 0.2 ? 0.4 : 0.3) * weight);
    EXPECT_LT(r.drop, 0.05);
    EXPECT_LT(r.lean, 10.0 * pi / 180.0);
  }
}

INSTANTIATE_TEST_SUITE_P(Grid, Touch,
                         testing::Combine(testing::Bool(), testing::Values(0.02, 0.2, 1.0),
                                          testing::Values(Part::rotor, Part::rim, Part::hull),
                                          testing::Values(0.1, 0.2, 0.7)));

TEST(Wall, IsFreeAgainWhenTheWallGoes) {
  for (const bool actuator_level : {false, true}) {
    Case c;
    c.wall_until = 4.5;
    const Result r = touch(actuator_level, c);
    EXPECT_LT(r.blocked_after, 0.7);
    EXPECT_LT(r.free_after, 0.5);
    EXPECT_NEAR(r.end, c.touch() + c.behind, 0.1);
  }
}

// Hovers in a gust along x that grows for `ramp` [s] up to `force` [N].
template <typename Loop>
bool blocked_in_gust(Loop& loop, double force, double ramp) {
  ReferencePoint point;
  point.position.z() = height;
  bool blocked = false;
  while (loop.plant().time() < 2.0 + ramp) {
    Wrenchd gust;
    gust.force.x() = -force * std::clamp((loop.plant().time() - 1.5) / ramp, 0.0, 1.0);
    loop.disturbance = wrench_in_body(gust, loop.plant().body().orientation);
    (void)loop.tick([&point](double) { return point; });
    blocked = blocked || loop.contact().estimate().blocked;
  }
  return blocked;
}

TEST(Gust, IsNotAWall) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  for (const double force : {1.0, 2.0, 3.0})
    for (const double ramp : {0.05, 0.3, 1.0, 2.0, 3.0}) {
      SCOPED_TRACE(testing::Message() << force << " N in " << ramp << " s");
      test_support::ControlLoop<Plant<4>> loop(1);
      loop.start(height - 0.11, Eigen::Vector3d::Zero(), 0.0);
      EXPECT_FALSE(blocked_in_gust(loop, force, ramp));
      test_support::ActuatorLoop<4> actuators(vehicle, vehicle);
      actuators.start({0.0, 0.0, height});
      EXPECT_FALSE(blocked_in_gust(actuators, force, ramp));
    }
}

}  // namespace wall_test
}  // namespace tilt_ropter
