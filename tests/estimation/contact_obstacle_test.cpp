// The contact estimator tells an obstacle from wind, a payload and a slow vehicle.

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <limits>
#include <optional>

namespace tilt_ropter {
namespace contact_obstacle_test {

constexpr double tick = 0.01;

class ContactObstacle : public testing::Test {
 protected:
  // A second of flight with the external force `force(t)` [N] and the position `place(t)` [m].
  template <typename Force, typename Place>
  bool ever_blocked(const Force& force, const Place& place, bool with_reference = true) {
    bool blocked = false;
    for (double t = 0.0; t < 1.0; t += tick, time += tick) {
      BodyStated body;
      body.position = Eigen::Vector3d(0.0, 0.0, 2.0) + place(t);
      body.velocity = (place(t + 1e-4) - place(t)) / 1e-4;
      ObservedWrenchd observed;
      observed.external.force = observed.raw.force = force(t);
      std::optional<ReferencePoint> reference;
      if (with_reference) reference.emplace().position << behind, 0.0, 2.0;
      const ContactEstimate& estimate = contact.update(time, body, observed, reference);
      blocked = blocked || estimate.blocked;
    }
    return blocked;
  }
  static Eigen::Vector3d along_x(double x) { return {x, 0.0, 0.0}; }
  static Eigen::Vector3d nothing(double) { return Eigen::Vector3d::Zero(); }
  // The wall starts to push at 0.2 s.
  static Eigen::Vector3d wall(double t) { return along_x(t < 0.2 ? 0.0 : -4.0); }

  double time = 0.0, behind = 0.1;  // [s], the reference [m]
  ContactEstimator contact{tilt_ropter_vehicle()};
};

TEST_F(ContactObstacle, IsSeenWithItsDirectionAndNotCompensated) {
  EXPECT_TRUE(ever_blocked(wall, nothing));
  const ContactEstimate& estimate = contact.estimate();
  ASSERT_TRUE(estimate.blocked);
  EXPECT_NEAR(estimate.blocked->direction.x(), 1.0, 1e-6);
  EXPECT_NEAR(estimate.blocked->reach, 0.0, 1e-6);
  const double weight = tilt_ropter_vehicle().body.mass * gravity;
  EXPECT_NEAR(estimate.disturbance.force.x(), -0.1 * weight, 0.03 * weight);
  EXPECT_FALSE(ever_blocked(nothing, nothing) && contact.estimate().blocked);
}

// A vehicle at 0.8 m/s is stopped at 0.2 s and bounces off at 0.3 m/s.
TEST_F(ContactObstacle, IsSeenInTheImpactAndKeptUntilTheVehicleIsBack) {
  behind = 1.0;
  const auto hit = [](double t) { return along_x(t < 0.2 || t > 0.22 ? 0.0 : -60.0); };
  const auto bounce = [](double t) { return along_x(t < 0.21 ? 0.8 * t : 0.231 - 0.3 * t); };
  EXPECT_FALSE(ever_blocked([](double) { return along_x(-60.0); },
                            [](double t) { return along_x(0.8 * t); }));
  contact = ContactEstimator(tilt_ropter_vehicle());
  EXPECT_TRUE(ever_blocked(hit, bounce));
  EXPECT_TRUE(contact.estimate().blocked);
}

TEST_F(ContactObstacle, IsFreeOnceTheVehicleIsBeyondItsPlace) {
  ASSERT_TRUE(ever_blocked(wall, nothing));
  behind = 2.0;
  ever_blocked(nothing, [](double t) { return along_x(0.05 * t); });
  EXPECT_FALSE(contact.estimate().blocked);
}

// Only the part along the wheels counts, and neither the ground's force nor a side force.
TEST_F(ContactObstacle, StopsWheelsAndIsNotCompensated) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const double weight = vehicle.body.mass * gravity;
  for (const bool in_front : {true, false}) {
    contact = ContactEstimator(vehicle);
    for (time = 0.0; time < 1.0; time += tick) {
      BodyStated body;
      body.position.z() = undercarriage(vehicle)->height;
      ObservedWrenchd observed;
      const double push = time < 0.2 ? 0.0 : -4.0;
      observed.external.force << (in_front ? push : 0.0), (in_front ? 0.0 : push), weight;
      observed.raw = observed.external;
      ReferencePoint reference;
      reference.position << (in_front ? 0.5 : 0.0), (in_front ? 0.0 : 0.5), body.position.z();
      contact.update(time, body, observed, reference);
    }
    const ContactEstimate& estimate = contact.estimate();
    EXPECT_TRUE(estimate.on_ground);
    EXPECT_EQ(estimate.blocked.has_value(), in_front);
    if (in_front) {
      EXPECT_NEAR(estimate.rolling.force.x(), -0.1 * weight, 0.03 * weight);
    }
  }
}

TEST_F(ContactObstacle, NeedsAReference) {
  EXPECT_FALSE(ever_blocked(wall, nothing, false));
}

TEST_F(ContactObstacle, IsNotWindThatMovesTheVehicle) {
  behind = 0.0;
  const auto driven = [](double t) { return along_x(t < 0.2 ? 0.0 : -0.1 * (t - 0.2)); };
  EXPECT_FALSE(ever_blocked(wall, driven));
}

TEST_F(ContactObstacle, IsNotASlowApproachAgainstTheWind) {
  EXPECT_FALSE(ever_blocked(wall, [](double t) { return along_x(0.08 * t); }));
}

// 16 obstacles in 24 s of a flight with a vibration that the IMU's rate turns into one of 12.5 Hz.
TEST_F(ContactObstacle, IsNotAForceThatSwings) {
  behind = 1.0;
  const double rate = 2.0 * pi * 12.5;
  EXPECT_FALSE(
      ever_blocked([=](double t) { return along_x(9.0 * std::sin(rate * t)); },
                   [=](double t) { return along_x(0.2 * t - 0.002 * std::sin(rate * t)); }));
}

TEST_F(ContactObstacle, IsNotAPayload) {
  EXPECT_FALSE(ever_blocked(
      [](double t) { return Eigen::Vector3d(0.0, 0.0, t < 0.2 ? 0.0 : -4.0); }, nothing));
}

TEST(Obstacle, LimitsTheReferenceInFrontOfIt) {
  const Obstacle obstacle{Eigen::Vector3d::UnitX(), 1.0};
  ReferencePoint point;
  point.position << 3.0, 2.0, 1.0;
  point.velocity << 1.0, 0.5, 0.0;
  const ReferencePoint front = in_front_of(obstacle, point);
  EXPECT_EQ(front.position, Eigen::Vector3d(1.0, 2.0, 1.0));
  EXPECT_EQ(front.velocity, Eigen::Vector3d(0.0, 0.5, 0.0));
  point.position.x() = 0.5;
  EXPECT_EQ(in_front_of(obstacle, point).velocity, point.velocity);
}

TEST(Obstacle, LetsWheelsStandWhereTheyAre) {
  BodyStated body;
  body.position << 1.0, 2.0, 0.1;
  body.orientation = quaternion_from_yaw(0.5);
  ReferencePoint point;
  point.position << 3.0, 0.0, 0.11;
  point.velocity << 1.0, 0.5, 0.1;
  const ReferencePoint stop = standing_at(body, point);
  EXPECT_EQ(stop.position, Eigen::Vector3d(1.0, 2.0, 0.11));
  EXPECT_EQ(stop.velocity, Eigen::Vector3d(0.0, 0.0, 0.1));
  EXPECT_NEAR(stop.orientation.angularDistance(body.orientation), 0.0, 1e-9);
}

TEST(Obstacle, MustBeFinite) {
  ContactEstimate estimate = in_the_air({});
  estimate.blocked.emplace().reach = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(is_finite(estimate));
}

}  // namespace contact_obstacle_test
}  // namespace tilt_ropter
