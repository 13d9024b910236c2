#include <tilt_ropter/simulation/detail/wheel_contact.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace wheel_contact_test {

using test_support::Random;

constexpr int right = 0, left = 1;

struct Case {
  BodyStated body;
  WheelState wheel;
  int side = right;
  bool locked = false;
};

/// A body near the ground in any attitude, in contact or not.
Case random_case(Random& random, double tilt) {
  Case c;
  c.body.position = random.vector(1.0);
  c.body.position.z() = random.uniform(0.06, 0.16);
  c.body.velocity = random.vector(1.0);
  c.body.orientation =
      quaternion_from_yaw(random.uniform(-pi, pi)) * quaternion_exp(random.vector(tilt));
  c.body.angular_velocity = random.vector(3.0);
  c.wheel.spin = random.uniform(-20.0, 20.0);
  c.side = random.uniform(-1.0, 1.0) < 0.0 ? right : left;
  return c;
}

WheelForces contact(const WheelContactParameters& p, const Case& c) {
  const double y = c.side == right ? -0.2 : 0.2;
  const WheelMount mount{p.axle_position + Eigen::Vector3d(0.0, y, 0.0), 0.11, 4.0e-4, c.locked};
  return wheel_contact(p, mount, c.body, c.body.orientation.toRotationMatrix(), c.wheel);
}

/// Returns the depth of the disc's lowest point, from the spring force alone [m].
double depth(WheelContactParameters p, const Case& c) {
  p.dissipation = 0.0;
  return contact(p, c).normal_force / p.stiffness;
}

TEST(WheelContact, TouchesAtTheLowestPointOfTheDisc) {
  Random random(1);
  const WheelContactParameters p;
  int touching = 0;
  for (int n = 0; n < 300; ++n) {
    const Case c = random_case(random, 1.0);
    const Eigen::Vector3d side(0.0, c.side == right ? -0.2 : 0.2, 0.0);
    double lowest = 1.0;
    for (int k = 0; k < 4000; ++k) {
      const double angle = 2.0 * pi * k / 4000.0;
      const Eigen::Vector3d rim(0.11 * std::sin(angle), 0.0, 0.11 * std::cos(angle));
      lowest = std::min(lowest, (c.body.position + c.body.orientation * (side + rim)).z());
    }
    EXPECT_NEAR(depth(p, c), std::max(0.0, -lowest), 1e-6);
    touching += lowest < 0.0;
  }
  EXPECT_GT(touching, 50);
  EXPECT_LT(touching, 250);
}

TEST(WheelContact, NormalForceNeverPullsAndFrictionStaysInFrictionCircle) {
  Random random(2);
  const WheelContactParameters p;
  int released = 0, sticking = 0;
  for (int n = 0; n < 20000; ++n) {
    Case c = random_case(random, 0.4);
    if (n % 2 == 0) {  // slow cases, in which the wheel sticks
      c.body.velocity *= 1e-2;
      c.body.angular_velocity *= 1e-2;
      c.wheel.spin *= 1e-2;
    }
    c.wheel.bristle = random.vector(1e-3).head<2>();
    const WheelForces forces = contact(p, c);
    const Eigen::Vector3d world = c.body.orientation * forces.ground.force;
    EXPECT_GE(forces.normal_force, 0.0);
    EXPECT_NEAR(world.z(), forces.normal_force, 1e-9);
    EXPECT_LE(world.head<2>().norm(), p.friction * forces.normal_force + 1e-9);
    EXPECT_LE(p.bristle_stiffness * forces.bristle.norm(), p.friction * forces.normal_force + 1e-9);
    released += depth(p, c) > 0.0 && forces.normal_force <= 0.0;
    sticking += world.head<2>().norm() < 0.99 * p.friction * forces.normal_force;
  }
  EXPECT_GT(released, 50);  // fast rebounds, in which a linear damper would pull
  EXPECT_GT(sticking, 100);
}

TEST(WheelContact, DissipatesEnergyBeyondSpringStorage) {
  Random random(3);
  const WheelContactParameters p;
  const double dt = 1e-7;
  int checked = 0;
  for (int n = 0; n < 20000; ++n) {
    const Case c = random_case(random, 0.6);
    const double before = depth(p, c);
    if (before < 1e-4) continue;
    Case later = c;
    later.body.position += dt * c.body.velocity;
    later.body.orientation = c.body.orientation * quaternion_exp(dt * c.body.angular_velocity);
    const double stored = p.stiffness * before * (depth(p, later) - before) / dt;
    const WheelForces f = contact(p, c);
    const double power = f.ground.force.dot(c.body.orientation.conjugate() * c.body.velocity) +
                         f.ground.torque.dot(c.body.angular_velocity) +
                         f.bearing_torque * c.body.angular_velocity.y() +
                         f.axle_torque * c.wheel.spin;
    EXPECT_LE(power + stored, 1e-3 * (1.0 + std::abs(power)));
    ++checked;
  }
  EXPECT_GT(checked, 5000);
}

TEST(WheelContact, AxleTransmitsOnlyBearingFrictionAboutItself) {
  Random random(4);
  const WheelContactParameters p;
  for (int n = 0; n < 1000; ++n) {
    const Case c = random_case(random, 0.4);
    const WheelForces f = contact(p, c);
    EXPECT_NEAR(f.ground.torque.y(), 0.0, 1e-10);
    EXPECT_NEAR(f.bearing_torque, p.bearing_friction * (c.wheel.spin - c.body.angular_velocity.y()),
                1e-15);
  }
}

TEST(WheelContact, RollsForwardWithoutSlipAtPositiveSpin) {
  const WheelContactParameters p;
  for (const int side : {right, left}) {
    Case c;
    c.side = side;
    c.body.position.z() = 0.109;
    c.body.orientation = quaternion_from_yaw(0.7);
    c.body.velocity << 1.1 * std::cos(0.7), 1.1 * std::sin(0.7), 0.0;
    c.wheel.spin = 10.0;
    EXPECT_NEAR(contact(p, c).slip.norm(), 0.0, 1e-12);
    c.body.angular_velocity.y() = 3.0;  // pitch of the body does not turn the wheel
    EXPECT_NEAR(contact(p, c).slip.norm(), 0.0, 1e-12);
    c.body.angular_velocity << 0.0, 0.0, 2.0;  // turning moves the left wheel backward
    EXPECT_NEAR(contact(p, c).slip.x(), side == left ? -0.4 : 0.4, 1e-12);
    EXPECT_NEAR(contact(p, c).slip.y(), 0.0, 1e-12);
  }
}

TEST(WheelContact, StaysFiniteWhenTheWheelLiesFlat) {
  const WheelContactParameters p;
  for (const double off : {0.0, 1e-12, 1e-4, 1e-3, 1e-2})
    for (const double roll : {pi / 2, -pi / 2})
      for (const int side : {right, left}) {
        Case c;
        c.side = side;
        c.body.position.z() = 0.05;
        c.body.velocity << 1.0, 2.0, -1.0;
        c.body.orientation = quaternion_exp(Eigen::Vector3d(roll + off, 0.0, 0.0));
        c.body.angular_velocity << 1.0, 2.0, 3.0;
        c.wheel.spin = 5.0;
        const WheelForces f = contact(p, c);
        EXPECT_TRUE(is_finite(f.ground));
        EXPECT_TRUE(std::isfinite(f.axle_torque) && all_finite(f.slip));
        EXPECT_LT(f.ground.force.norm(), 1e5);
      }
}

TEST(WheelContact, EveryParameterActsOnTheForces) {
  Case c;
  c.body.position.z() = 0.105;
  c.body.velocity << 0.001, 0.002, -0.1;
  c.body.orientation = quaternion_exp(Eigen::Vector3d(0.05, 0.1, 0.3));
  c.wheel.spin = 0.05;
  c.wheel.bristle << 2e-4, -1e-4;
  const auto moves = [&](auto change, bool sliding = false) {
    Case d = c;
    if (sliding) d.body.velocity.x() = 5.0;
    WheelContactParameters p;
    const WheelForces a = contact(p, d);
    change(p);
    const WheelForces b = contact(p, d);
    return (a.ground.force - b.ground.force).norm() + (a.ground.torque - b.ground.torque).norm() +
               std::abs(a.axle_torque - b.axle_torque) >
           1e-7;
  };
  EXPECT_FALSE(moves([](auto&) {}));
  EXPECT_TRUE(moves([](auto& p) { p.stiffness *= 1.1; }));
  EXPECT_TRUE(moves([](auto& p) { p.dissipation *= 1.1; }));
  EXPECT_TRUE(moves([](auto& p) { p.friction *= 1.1; }, true));
  EXPECT_TRUE(moves([](auto& p) { p.bristle_stiffness *= 1.1; }));
  EXPECT_TRUE(moves([](auto& p) { p.bristle_damping *= 1.1; }));
  EXPECT_TRUE(moves([](auto& p) { p.rolling_resistance *= 1.1; }));
  EXPECT_TRUE(moves([](auto& p) { p.rolling_regularisation *= 1.1; }));
  EXPECT_TRUE(moves([](auto& p) { p.bearing_friction *= 1.1; }));
  EXPECT_TRUE(moves([](auto& p) { p.axle_position.x() = 0.01; }));
}

// Each term alone, of a body that does not turn and stands on two wheels.
TEST(WheelContact, FastestRateHasAClosedForm) {
  RigidBodyParameters body;
  body.mass = 5.0;
  body.inertia = 1e9 * Eigen::Matrix3d::Identity();
  WheelMount mount{Eigen::Vector3d::Zero(), 0.1, 4.0e-4, false};
  const double load = 3.0 * 5.0 * gravity, of_body = 1.0 / 5.0, of_spin = 0.1 * 0.1 / 4.0e-4;
  WheelContactParameters none;
  none.stiffness = none.bristle_stiffness = 1e-9;
  none.dissipation = none.bristle_damping = none.rolling_resistance = none.bearing_friction = 0.0;
  const auto expect_rate = [&](const WheelContactParameters& p, double rate) {
    EXPECT_NEAR(fastest_contact_rate(p, mount, body), rate, 2e-3 * rate);
  };
  WheelContactParameters p = none;
  p.dissipation = 40.0;
  expect_rate(p, 40.0 * load * of_body);
  p = none;
  p.bearing_friction = 0.01;
  expect_rate(p, 0.01 / 4.0e-4);
  p = none;
  p.stiffness = 3000.0;
  expect_rate(p, std::sqrt(2.0 * 3000.0 * of_body));
  for (const bool locked : {false, true}) {
    mount.locked = locked;
    const double slip = of_body + (locked ? 0.0 : of_spin);
    p = none;
    p.bristle_damping = 20.0;
    expect_rate(p, 20.0 * slip);
    p = none;
    p.bristle_stiffness = 1e4;
    expect_rate(p, std::sqrt(1e4 * slip));
  }
  mount.locked = false;
  p = none;
  p.rolling_resistance = 0.02;
  expect_rate(p, 0.02 * load * of_spin / p.rolling_regularisation);
}

}  // namespace wheel_contact_test
}  // namespace tilt_ropter
