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
#include <stdexcept>
#include <string>

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
      if ((follower.last.position - begin).head<2>().norm() > 1e-9)
        ASSERT_GT(follower.last.position.z(), 0.11) << "on the ground";
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
    if (far > 0.01 && far < 1.0) ASSERT_GT(follower.last.position.z(), 0.25);
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
