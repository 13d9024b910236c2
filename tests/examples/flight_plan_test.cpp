// What the nodes fly: points and missions, begun, interrupted and moved without a jump.
// CTest: dds

#include "../../examples/integrations/flight_plan.hpp"
#include "support/program.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

namespace loops {
namespace flight_plan_test {

using Eigen::Vector3d;
using tilt_ropter::BodyStated;
using tilt_ropter::ReferencePoint;
using tilt_ropter::yaw_of;

FlightPlan plan_of(Parameters parameters) {
  return {parameters, examples::VehicleFile{}};
}

BodyStated body_at(const Vector3d& position, double yaw = 0.0) {
  BodyStated body;
  body.position = position;
  body.orientation = tilt_ropter::quaternion_from_yaw(yaw);
  return body;
}

BodyStated body_of(const ReferencePoint& point) {
  return body_at(point.position, yaw_of(point.orientation));
}

geometry_msgs::msg::Pose pose_at(double x, double y, double z) {
  return {{x, y, z}, {0.0, 0.0, 0.0, 1.0}};
}

/// Follows the plan, and expects that position and velocity do not jump.
struct Follower {
  const FlightPlan& plan;
  double time = 0.0;
  ReferencePoint last = plan(time);

  void begin_at(double t) {
    time = t;
    last = plan(time);
  }
  void follow(double until, const Vector3d& step = Vector3d::Zero()) {
    constexpr double dt = 0.01;
    last.position += step;
    for (; time < until; time += dt) {
      const ReferencePoint next = plan(time + dt);
      const Vector3d mean = 0.5 * (last.velocity + next.velocity);
      ASSERT_LT((next.position - last.position - dt * mean).norm(), 2e-5) << time;
      ASSERT_LT((next.velocity - last.velocity).norm(), 4.0 * dt) << time;
      ASSERT_LT(next.orientation.angularDistance(last.orientation), 1.6 * dt) << time;
      lowest = std::min(lowest, next.position.z());
      fastest = std::max(fastest, next.velocity.norm());
      last = next;
    }
  }
  double lowest = 1e9, fastest = 0.0;
};

TEST(FlightPlan, FliesFromWhereTheVehicleIsToAPoint) {
  FlightPlan plan = plan_of({{"hover_x", "2"}, {"hover_z", "1"}});
  EXPECT_EQ(plan(-5.0).position, Vector3d(2.0, 0.0, 1.0));
  plan.start(body_at({0.0, 1.0, 0.1}, 1.0), 3.0);
  EXPECT_LT((plan(3.0).position - Vector3d(0.0, 1.0, 0.1)).norm(), 1e-12);
  EXPECT_STREQ(plan.activity(4.0), "way");
  Follower follower{plan, 3.0};
  follower.follow(20.0);
  EXPECT_LT(follower.fastest, 1.001);
  EXPECT_LT((follower.last.position - Vector3d(2.0, 0.0, 1.0)).norm(), 1e-12);
  EXPECT_STREQ(plan.activity(20.0), "hover point");
}

TEST(FlightPlan, AStreamOfTheSamePointArrives) {
  FlightPlan plan = plan_of({});
  for (double time = 0.0; time < 5.0; time += 0.1)
    ASSERT_TRUE(plan.fly_to(pose_at(1.0, 0.0, 1.5), time));
  EXPECT_LT((plan(5.0).position - Vector3d(1.0, 0.0, 1.5)).norm(), 1e-12);
  EXPECT_FALSE(plan.fly_to(pose_at(std::nan(""), 0.0, 1.5), 5.0));
  EXPECT_FALSE(plan.fly_to(pose_at(2e4, 0.0, 1.5), 5.0));
}

// On the ground, wheels do not go sideways: the vehicle flies there.
TEST(FlightPlan, BeginsAMissionWhereverTheVehicleStands) {
  FlightPlan plan = plan_of({{"mission", "hybrid"}});
  const Vector3d begin = plan(0.0).position;  // on the wheels
  ASSERT_NEAR(begin.z(), 0.11, 1e-9);
  plan.start(body_at(begin + Vector3d(0.02, -0.01, 0.0), 0.05), 7.0);
  EXPECT_STREQ(plan.activity(7.5), "rest");  // at once
  for (const Vector3d& from : {Vector3d(1.0, -1.0, 0.11), Vector3d(0.5, 0.0, 2.0)}) {
    plan.start(body_at(from, 2.0), 100.0);
    Follower follower{plan, 100.0};
    while (std::string(plan.activity(follower.time)) == "way") {
      follower.follow(follower.time + 0.1);
      if ((follower.last.position - begin).head<2>().norm() > 1e-9) {
        ASSERT_GT(follower.last.position.z(), 0.11) << "on the ground";
      }
    }
    EXPECT_LT((follower.last.position - begin).norm(), 1e-6);
    EXPECT_NEAR(yaw_of(follower.last.orientation), 0.0, 1e-9);
    const double first = follower.time;
    follower.follow(first + 20.0);
    EXPECT_GE(follower.lowest, 0.11 - 1e-9);
    EXPECT_STREQ(plan.activity(first + 20.0), "air");
    EXPECT_STREQ(plan.activity(first + 1000.0), "mission is over");
  }
}

// In a mission, on the way back to it, and again before the vehicle has stopped.
TEST(FlightPlan, PausesLandsAndGoesOn) {
  FlightPlan plan = plan_of({{"mission", "air"}});
  plan.start(body_at({0.0, 0.0, 1.5}), 0.0);
  Follower follower{plan};
  follower.follow(8.0);
  plan.pause(follower.time);
  follower.follow(8.4);
  plan.resume(follower.time);
  follower.follow(8.8);
  plan.pause(follower.time);
  follower.follow(12.0);
  EXPECT_STREQ(plan.activity(12.0), "paused");
  const Vector3d there = plan(12.0).position;
  plan.start(body_at(there + Vector3d(0.3, 0.0, 0.0)), 12.0);
  follower.begin_at(12.0);
  EXPECT_STREQ(plan.activity(12.5), "paused");
  plan.resume(12.0);
  follower.follow(12.3);
  plan.land(follower.time);
  follower.follow(14.0);
  plan.stop(14.0);  // a silence does not end the landing
  plan.start(body_of(plan(14.0)), 14.0);
  follower.begin_at(14.0);
  follower.follow(30.0);
  EXPECT_STREQ(plan.activity(30.0), "landed");
  EXPECT_NEAR(follower.lowest, 0.11, 1e-9);
  EXPECT_LT((plan(30.0).position - there).head<2>().norm(), 0.31);
  plan.stop(30.0);
  plan.start(body_at({0.0, 0.0, 1.0}), 30.0);  // a pilot has taken it up again
  EXPECT_EQ(plan(40.0).position.z(), 1.0);
  follower.begin_at(30.0);
  plan.resume(30.0);
  follower.follow(36.0);
  EXPECT_STREQ(plan.activity(36.0), "air");
  plan.land(36.0);
  ASSERT_TRUE(plan.fly_to(pose_at(0.0, 0.0, 1.5), 36.0));
  EXPECT_STREQ(plan.activity(70.0), "hover point");
}

TEST(FlightPlan, AMissionWaitsForTheVehicleAndGoesOn) {
  FlightPlan plan = plan_of({{"mission", "air"}});
  plan.start(body_at({0.0, 0.0, 1.5}), 0.0);
  Follower follower{plan};
  follower.follow(8.0);
  const ReferencePoint left = plan(8.0);
  ASSERT_GT(left.velocity.norm(), 0.5);
  plan.stop(8.0);
  plan.start(body_at({3.0, 2.0, 1.0}), 20.0);
  follower.begin_at(20.0);
  EXPECT_LT((plan(20.0).position - Vector3d(3.0, 2.0, 1.0)).norm(), 1e-12);
  while (std::string(plan.activity(follower.time)) == "way") follower.follow(follower.time + 0.01);
  EXPECT_LT((plan(follower.time).position - left.position).norm(), 0.01);
  const double again = follower.time;
  follower.follow(again + 3.0);
  // The pace comes back within a second, which costs half of it.
  const Vector3d where = follower.last.position;
  FlightPlan other = plan_of({{"mission", "air"}});
  other.start(body_at({0.0, 0.0, 1.5}), 0.0);
  EXPECT_LT((other(8.0 + 3.0 - 0.5).position - where).norm(), 0.03);

  plan.stop(follower.time);
  plan.restart();
  plan.start(body_at({0.0, 0.0, 1.5}), 50.0);
  EXPECT_LT((plan(51.0).position - Vector3d(0.0, 0.0, 1.5)).norm(), 1e-9);
}

// Interrupted just after the take-off, and landed elsewhere.
TEST(FlightPlan, DoesNotFlyAlongTheGround) {
  FlightPlan plan = plan_of({{"mission", "hybrid"}});
  plan.start(body_of(plan(0.0)), 0.0);
  double time = 0.0;
  while (plan(time).position.z() < 0.2) time += 0.01;
  const Vector3d left = plan(time).position;
  plan.stop(time);
  plan.start(body_at({1.0, -1.0, 0.11}), 10.0);
  Follower follower{plan, 10.0};
  while (std::string(plan.activity(follower.time)) == "way") {
    follower.follow(follower.time + 0.01);
    const double far = (follower.last.position - left).head<2>().norm();
    if (far > 0.01 && far < 1.0) {
      ASSERT_GT(follower.last.position.z(), 0.25);
    }
  }
  EXPECT_LT((follower.last.position - left).norm(), 1e-3);
}

TEST(FlightPlan, AHoverPointEndsAMissionWithoutAJump) {
  for (const char* name : {"air", "hybrid", "rolling"})
    for (const double when : {0.5, 3.0, 9.0, 15.0, 31.3, 45.0, 300.0}) {
      SCOPED_TRACE(when);
      FlightPlan plan = plan_of({{"mission", name}});
      plan.start(body_of(plan(0.0)), 0.0);
      Follower follower{plan};
      follower.begin_at(when - 0.1);
      follower.follow(when);
      ASSERT_TRUE(plan.fly_to(pose_at(1.0, 1.0, 1.2), follower.time));
      follower.follow(when + 25.0);
      EXPECT_LT((follower.last.position - Vector3d(1.0, 1.0, 1.2)).norm(), 1e-9);
      EXPECT_STREQ(plan.activity(follower.time), "hover point");
      plan.start(body_at({0.0, 0.0, 1.0}), 500.0);  // the mission does not come back
      EXPECT_LT((plan(520.0).position - Vector3d(1.0, 1.0, 1.2)).norm(), 1e-9);
    }
}

TEST(FlightPlan, MovesWithTheFrame) {
  FlightPlan plan = plan_of({{"mission", "air"}});
  plan.start(body_at({0.0, 0.0, 1.5}), 0.0);
  const Vector3d step(1.0, -2.0, 0.5);
  Follower follower{plan};
  follower.follow(8.0);
  const double yaw = yaw_of(follower.last.orientation);
  plan.move(step, 0.3);
  EXPECT_NEAR(yaw_of(plan(8.0).orientation), yaw + 0.3, 1e-9);
  EXPECT_LT((plan(follower.time).position - follower.last.position - step).norm(), 1e-9);
  // In the new frame, from where the vehicle is there.
  plan.stop(8.0);
  plan.start(body_at({0.0, 0.0, 1.5}, 0.2), 9.0);
  EXPECT_LT((plan(9.0).position - Vector3d(0.0, 0.0, 1.5)).norm(), 1e-12);
  EXPECT_NEAR(yaw_of(plan(9.0).orientation), 0.2, 1e-12);
  ASSERT_TRUE(plan.fly_to(pose_at(1.0, 1.0, 1.0), 9.0));
  EXPECT_LT((plan(30.0).position - Vector3d(1.0, 1.0, 1.0)).norm(), 1e-12);
}

SetPoint set_point(double time, const Vector3d& position, const Vector3d& velocity) {
  SetPoint p;
  p.time = time;
  p.position = position;
  p.velocity = velocity;
  return p;
}

// A planner that sends a point of a circle at 20 Hz, and then ends.
TEST(FlightPlan, FollowsAStreamOfSetPointsWithoutAJump) {
  for (const double far : {0.0, 0.3, 4.0}) {
    SCOPED_TRACE(far);
    FlightPlan plan = plan_of({{"hover_x", "0"}, {"hover_z", "1"}});
    plan.start(body_at({0.0, 0.0, 1.0}), 0.0);
    Follower follower{plan};
    const auto circle = [far](double t) {
      const double a = 0.5 * t;
      return set_point(0.0, {far + 1.0 - std::cos(a), std::sin(a), 1.0},
                       {0.5 * std::sin(a), 0.5 * std::cos(a), 0.0});
    };
    for (double time = 1.0; time < 26.0; time += 0.05) {
      follower.follow(time);
      ASSERT_TRUE(plan.follow({circle(time - 1.0)}, follower.time));
      follower.begin_at(follower.time);
    }
    EXPECT_STREQ(plan.activity(follower.time), "set points");
    const Vector3d error = plan(26.0).position - circle(25.0).position;
    EXPECT_LT(error.norm(), 0.02);
    const double until = follower.time + SetPoints::patience + Braking::duration;
    follower.follow(until + 1.0);
    EXPECT_LT(follower.last.velocity.norm(), 1e-9);
    EXPECT_LT((follower.last.position - circle(25.0).position).norm(), 0.6);
    EXPECT_STREQ(plan.activity(follower.time), "hover point");
  }
}

TEST(FlightPlan, FliesToATrajectoryAndAlongIt) {
  FlightPlan plan = plan_of({{"mission", "air"}});
  plan.start(body_at({0.0, 0.0, 1.5}), 0.0);
  Follower follower{plan};
  follower.follow(8.0);
  const Vector3d a(3.0, 0.0, 2.0), b(4.0, 1.0, 2.0), c(5.0, 0.0, 1.0), v(1.0, 0.0, 0.0);
  ASSERT_TRUE(plan.follow({set_point(0.0, a, Vector3d::Zero()), set_point(2.0, b, v),
                           set_point(4.5, c, Vector3d::Zero())},
                          8.0));
  plan.move({0.0, 0.0, 1.0}, 0.0);
  follower.begin_at(8.0);
  while (std::string(plan.activity(follower.time)) != "set points")
    follower.follow(follower.time + 0.01);
  const double start = follower.time;
  EXPECT_LT((plan(start).position - a - Vector3d::UnitZ()).norm(), 0.02);
  EXPECT_LT((plan(start + 2.0).position - b - Vector3d::UnitZ()).norm(), 0.02);
  EXPECT_LT((plan(start + 2.0).velocity - v).norm(), 0.05);
  follower.follow(start + 8.0);
  EXPECT_LT((follower.last.position - c - Vector3d::UnitZ()).norm(), 1e-9);
}

TEST(FlightPlan, IgnoresSetPointsThatAreNone) {
  FlightPlan plan = plan_of({});
  const Vector3d p(0.0, 0.0, 1.5), zero = Vector3d::Zero();
  EXPECT_FALSE(plan.follow({}, 1.0));
  EXPECT_FALSE(plan.follow({set_point(0.0, {0.0, std::nan(""), 1.0}, zero)}, 1.0));
  EXPECT_FALSE(plan.follow({set_point(0.0, p, {0.0, 0.0, HUGE_VAL})}, 1.0));
  EXPECT_FALSE(plan.follow({set_point(0.0, {2e4, 0.0, 1.0}, zero)}, 1.0));
  EXPECT_FALSE(plan.follow({set_point(1.0, p, zero), set_point(1.0, p, zero)}, 1.0));
  EXPECT_EQ(plan(20.0).position, p);
}

// A point with z down, as of NED, would be a dive into the ground.
TEST(FlightPlan, KnowsTheGround) {
  EXPECT_THROW(plan_of({{"hover_z", "-1.5"}}), std::invalid_argument);
  EXPECT_THROW(plan_of({{"hover_x", "48100"}}), std::invalid_argument);  // [mm]
  EXPECT_THROW(plan_of({{"hover_yaw", "90"}}), std::invalid_argument);   // [deg]
  FlightPlan plan = plan_of({});
  const double stands = tilt_ropter::tilt_ropter_vehicle().wheels->radius;
  const Vector3d zero = Vector3d::Zero();
  EXPECT_FALSE(plan.fly_to(pose_at(1.0, 0.0, -1.5), 1.0));
  EXPECT_FALSE(plan.follow({set_point(0.0, {1.0, 0.0, -1.5}, zero)}, 1.0));
  EXPECT_FALSE(plan.follow(
      {set_point(0.0, {1.0, 0.0, 1.5}, zero), set_point(3.0, {1.0, 0.0, -1.5}, zero)}, 1.0));
  EXPECT_EQ(plan(20.0).position, Vector3d(0.0, 0.0, 1.5));
  EXPECT_TRUE(plan.fly_to(pose_at(0.0, 0.0, stands), 20.0));  // to land there

  // What goes on after a set point, and the way to a stop, ends on the ground.
  double lowest = 1e9;
  ASSERT_TRUE(plan.follow({set_point(0.0, {0.0, 0.0, 1.0}, {0.0, 0.0, -3.0})}, 20.5));
  for (double t = 20.5; t < 25.0; t += 0.01) {
    const ReferencePoint point = plan(t);
    lowest = std::min(lowest, point.position.z());
    if (point.position.z() == stands) {
      EXPECT_GE(point.velocity.z(), 0.0);
    }
  }
  EXPECT_EQ(lowest, stands);
  plan.start(body_at({0.0, 0.0, stands}), 25.0);
  EXPECT_EQ(plan(40.0).position.z(), stands);
}

TEST(SetPoints, ComeFromMessages) {
  px4_msgs::msg::TrajectorySetpoint px4{};
  const float nan = std::nanf("");
  px4 = {0, {1.0F, 2.0F, -3.0F}, {0.5F, nan, -0.25F}, {nan, nan, nan}, {}, 0.5F, nan};
  const SetPoint p = set_points(px4, 0.1, 7.0).front();
  EXPECT_EQ(p.position, Vector3d(2.0, 1.0, 3.1));
  EXPECT_EQ(p.velocity, Vector3d(0.0, 0.5, 0.25));
  EXPECT_EQ(p.acceleration, Vector3d::Zero());
  EXPECT_NEAR(p.yaw, tilt_ropter::pi / 2.0 - 0.5, 1e-7);
  px4.yaw = nan;
  EXPECT_EQ(set_points(px4, 0.1, 7.0).front().yaw, 7.0);

  using trajectory_msgs::msg::MultiDOFJointTrajectoryPoint;
  std::vector<std::vector<geometry_msgs::msg::Transform>> transforms;
  transforms.reserve(3);
  std::vector<MultiDOFJointTrajectoryPoint> points(3);
  for (int i = 0; i < 3; ++i)
    transforms.push_back(
        {{{0.5 * i * i, 1.0, 2.0}, {0.0, 0.0, std::sin(0.1 * i), std::cos(0.1 * i)}}});
  for (std::size_t i = 0; i < 3; ++i) {
    refer_to(points[i].transforms, transforms[i]);
    points[i].time_from_start = {static_cast<std::int32_t>(2 * i), 500000000U};
  }
  trajectory_msgs::msg::MultiDOFJointTrajectory m{};
  refer_to(m.points, points);
  const std::vector<SetPoint> read = set_points(m);
  ASSERT_EQ(read.size(), 3U);
  EXPECT_EQ(read[1].time, 2.5);
  EXPECT_EQ(read[1].position, Vector3d(0.5, 1.0, 2.0));
  EXPECT_LT((read[1].velocity - Vector3d(0.5, 0.0, 0.0)).norm(), 1e-12);
  EXPECT_NEAR(read[2].yaw, 0.4, 1e-12);
  EXPECT_NEAR(read[1].yaw_rate, 0.1, 1e-12);
  EXPECT_EQ(read[2].velocity, Vector3d::Zero());
  transforms[1][0].rotation.w = 2.0;
  EXPECT_TRUE(set_points(m).empty());
}

TEST(FlightPlan, ReadsMissionsAndTrajectories) {
  const test_support::Directory directory("flight_plan");
  const auto activity = [](const char* parameter, const std::string& value) {
    FlightPlan plan = plan_of({{parameter, value}});
    plan.start(body_of(plan(0.0)), 0.0);
    return std::string(plan.activity(1.0));
  };
  EXPECT_EQ(activity("mission", "ground"), "rest");
  EXPECT_EQ(activity("mission", MISSIONS_DIR "/tour.json"), "rest");
  EXPECT_EQ(activity("trajectory",
                     directory.write("a.csv", "time_s,x_m,y_m,z_m\n0,0,0,1\n1,0.2,0,1\n2,0,0,1\n")),
            "air");
  EXPECT_THROW((void)activity("mission", "nowhere.json"), tilt_ropter::InputFileError);
  EXPECT_THROW((void)plan_of({{"mission", "air"}, {"trajectory", "a.csv"}}), std::invalid_argument);
}

}  // namespace flight_plan_test
}  // namespace loops
