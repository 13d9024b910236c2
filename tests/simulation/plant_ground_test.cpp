// On the ground: standing, bouncing, friction and rolling.

#include <tilt_ropter/simulation/plant.hpp>

#include "support/check_table.hpp"
#include "support/plant_runs.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace tilt_ropter {
namespace plant_ground_test {

using test_support::energy;
using test_support::hover;
using test_support::idle;
using test_support::Random;
using test_support::run;
using test_support::tumbling;

const Vehicle<4> vehicle = tilt_ropter_vehicle();

TEST(Plant, StandsOnItsWheels) {
  Plant<4> plant(vehicle);
  run(plant, idle(), {}, 20.0);
  EXPECT_NEAR(plant.body().position.z(), plant.standing_height(), 1e-9);
  EXPECT_GT(vehicle.wheels->radius - plant.standing_height(), 1e-3);
  EXPECT_LT(vehicle.wheels->radius - plant.standing_height(), 3e-3);
  EXPECT_LT(plant.body().velocity.norm(), 1e-9);
  EXPECT_NEAR(plant.normal_forces().sum(), 1.5 * gravity, 1e-9);
  EXPECT_NEAR(plant.contact_wrench().force.z(), 1.5 * gravity, 1e-9);
  EXPECT_NEAR(plant.specific_force().z(), gravity, 1e-9);
}

TEST(Plant, TouchesDownSoftly) {
  for (const double speed : {0.3, 0.6}) {
    Plant<4> plant(vehicle);
    PlantState<4> x;
    x.body.position.z() = vehicle.wheels->radius;
    x.body.velocity.z() = -speed;
    x.body.velocity.y() = speed;
    plant.reset(x);
    double peak = 0.0, highest = 0.0;
    for (int k = 0; k < 2000; ++k) {
      ASSERT_TRUE(plant.step(idle(), {}, 1e-3));
      peak = std::max(peak, plant.normal_forces().sum());
      if (k > 20) highest = std::max(highest, plant.body().position.z());
    }
    EXPECT_LT(highest - vehicle.wheels->radius, 3e-3);
    EXPECT_LT(peak, (speed < 0.5 ? 4.0 : 10.0) * 1.5 * gravity);
    EXPECT_NEAR(plant.body().position.z(), plant.standing_height(), 1e-6);
  }
}

/// Drops a vehicle from `x` for two seconds. Returns the number of steps in which it rises in
/// contact.
int bounce(const PlantState<4>& x, int name) {
  const PlantParameters p;
  Plant<4> plant(vehicle, p);
  plant.reset(x);
  const double start = energy(plant, vehicle, p.contact);
  double last = start;
  int bounced = 0;
  for (int k = 0; k < 2000; ++k) {
    const double height = plant.body().position.z();
    EXPECT_TRUE(plant.step(idle(), {}, 1e-3));
    const double now = energy(plant, vehicle, p.contact);
    EXPECT_LE(now, last + 1e-9 * start) << "case " << name << " at " << plant.time();
    if (plant.normal_forces().sum() > 0.0 && plant.body().position.z() > height) ++bounced;
    last = now;
  }
  EXPECT_LT(last, start);
  return bounced;
}

TEST(Plant, PassiveBounceNeverGainsEnergy) {
  Random random(5);
  int bounced = 0;
  for (int n = 0; n < 40; ++n) {
    PlantState<4> x = tumbling(random, 0.5);
    if (n % 2 == 0) x.body.orientation = quaternion_exp(random.vector(0.3));
    bounced += bounce(x, n);
  }
  EXPECT_GT(bounced, 100);
}

// The lowest point of the wheel moves all around its rim.
TEST(Plant, RockingOnAFlatWheelNeverGainsEnergy) {
  Random random(6);
  int bounced = 0;
  for (int n = 0; n < 20; ++n) {
    PlantState<4> x;
    x.body.position.z() = vehicle.wheels->half_track + 0.002;
    const double side = n % 2 == 0 ? 0.5 : -0.5;
    x.body.orientation =
        quaternion_exp(random.vector(2e-3)) * quaternion_exp(Eigen::Vector3d(side * pi, 0.0, 0.0));
    x.body.angular_velocity = random.vector(0.2);
    bounced += bounce(x, n);
  }
  EXPECT_GT(bounced, 100);
}

// Without dissipation only the integration can change the energy, and it must not. The bounces are
// chaotic: rounding decides how much a single flight changes.
TEST(Plant, ElasticBounceConservesEnergy) {
  PlantParameters p;
  p.contact.dissipation = p.contact.bristle_damping = 0.0;
  p.contact.rolling_resistance = p.contact.bearing_friction = 0.0;
  p.contact.friction = 0.0;
  Random random(6);
  constexpr int flights = 16;
  double sum = 0.0, square = 0.0;
  for (int n = 0; n < flights; ++n) {
    Plant<4> plant(vehicle, p);
    PlantState<4> x;
    x.body.position.z() = 0.16;
    if (n > 0) x.body.orientation = quaternion_exp(random.vector(0.1));
    plant.reset(x);
    const double start = energy(plant, vehicle, p.contact);
    run(plant, idle(), {}, 10.0);
    const double change = energy(plant, vehicle, p.contact) / start - 1.0;
    sum += change;
    square += change * change;
  }
  EXPECT_LT(std::sqrt(square / flights), 1e-4);
  EXPECT_NEAR(sum / flights, 0.0, 5e-5);
}

// On ground that slopes down towards +y, gravity has a component along the ground. Here it is a
// force in the world frame.
void run_on_slope(Plant<4>& plant, double from, double to, double duration) {
  const int steps = static_cast<int>(std::lround(1e3 * duration));
  const double weight = 1.5 * gravity;
  for (int k = 1; k <= steps; ++k) {
    const double angle = from + (to - from) * k / steps;
    const Eigen::Vector3d pull(0.0, weight * std::sin(angle), weight * (1.0 - std::cos(angle)));
    const Wrenchd disturbance{plant.body().orientation.conjugate() * pull, Eigen::Vector3d::Zero()};
    ASSERT_TRUE(plant.step(idle(), disturbance, 1e-3));
  }
}

TEST(Plant, StaticFrictionHoldsBelowTheFrictionAngleWithoutCreep) {
  for (const double friction : {0.3, 0.8}) {
    PlantParameters p;
    p.contact.friction = friction;
    Plant<4> plant(vehicle, p);
    const double angle = 0.97 * std::atan(friction);
    run_on_slope(plant, 0.0, angle, 2.0);
    run_on_slope(plant, angle, angle, 1.0);
    const Eigen::Vector3d settled = plant.body().position;
    EXPECT_LT(settled.head<2>().norm(), 3e-3);
    run_on_slope(plant, angle, angle, 20.0);
    test_support::check_at_most(12, "plant: creep below the friction angle in 20 s [m]",
                                (plant.body().position - settled).norm(), 1e-6);
  }
}

TEST(Plant, SlidesAboveTheFrictionAngleByCoulombsLaw) {
  for (const double friction : {0.3, 0.8}) {
    PlantParameters p;
    p.contact.friction = friction;
    Plant<4> plant(vehicle, p);
    const double angle = 1.03 * std::atan(friction);
    run_on_slope(plant, 0.0, angle, 1.0);
    run_on_slope(plant, angle, angle, 1.0);
    const double before = plant.body().velocity.y();
    run_on_slope(plant, angle, angle, 1.0);
    const double expected = gravity * (std::sin(angle) - friction * std::cos(angle));
    EXPECT_NEAR(plant.body().velocity.y() - before, expected, 0.01 * expected);
    const Eigen::Vector3d contact = plant.body().orientation * plant.contact_wrench().force;
    EXPECT_NEAR(contact.y(), -friction * contact.z(), 1e-3);
  }
}

TEST(Plant, RolledDistanceMatchesWheelAngle) {
  Plant<4> plant(vehicle);
  PlantState<4> x = plant.state();
  x.body.velocity.x() = 1.5;  // the wheels are at rest and skid first
  plant.reset(x);
  run(plant, idle(), {}, 0.5);
  const PlantState<4> start = plant.state();
  run(plant, idle(), {}, 2.0);
  const double distance = plant.body().position.x() - start.body.position.x();
  EXPECT_GT(distance, 1.0);
  for (std::size_t i = 0; i < 2; ++i)
    EXPECT_NEAR(0.11 * (plant.state().wheels[i].angle - start.wheels[i].angle), distance,
                1e-3 * distance);
  EXPECT_NEAR(plant.body().position.y(), 0.0, 1e-9);
}

TEST(Plant, OneLongStepEqualsManyShortSteps) {
  Plant<4> fine(vehicle), coarse(vehicle);
  PlantState<4> x = fine.state();
  x.body.velocity << 1.5, 1.0, -0.3;
  x.body.angular_velocity << 0.5, 0.2, 2.0;
  fine.reset(x);
  coarse.reset(x);
  run(fine, hover(), {}, 0.2, 1e-3);
  run(coarse, hover(), {}, 0.2, 0.2);
  EXPECT_LT((fine.body().position - coarse.body().position).norm(), 1e-9);
  EXPECT_LT((fine.body().velocity - coarse.body().velocity).norm(), 1e-9);
  EXPECT_LT((fine.body().angular_velocity - coarse.body().angular_velocity).norm(), 1e-9);
}

TEST(Plant, TurnsAboutTheMiddleOfTheAxleWithoutScrubbing) {
  Plant<4> plant(vehicle);
  PlantState<4> x = plant.state();
  x.body.velocity.x() = 1.0;
  x.body.angular_velocity.z() = 1.0;
  x.wheels[0].spin =
      (1.0 + vehicle.wheels->half_track) / 0.11;  // the right wheel is on the outside of the turn
  x.wheels[1].spin = (1.0 - vehicle.wheels->half_track) / 0.11;
  plant.reset(x);
  for (int k = 0; k < 1500; ++k) {
    ASSERT_TRUE(plant.step(idle(), {}, 1e-3));
    const BodyStated& body = plant.body();
    const Eigen::Vector3d v = body.orientation.conjugate() * body.velocity;
    if (k < 300) continue;  // until the tyres carry the side force
    EXPECT_NEAR(v.y(), 0.0, 1e-3);
    EXPECT_NEAR(0.11 * plant.state().wheels[0].spin,
                v.x() + vehicle.wheels->half_track * body.angular_velocity.z(),
                0.1 * vehicle.wheels->half_track);
  }
  const double ratio = plant.state().wheels[0].angle / plant.state().wheels[1].angle;
  const double half_track = vehicle.wheels->half_track;  // on a circle of 1 m
  EXPECT_NEAR(ratio, (1.0 + half_track) / (1.0 - half_track), 0.1);
  EXPECT_GT(plant.body().position.y(), 0.3);
}

TEST(Plant, CoastsToRestUnderRollingResistance) {
  PlantParameters p;
  p.contact.bearing_friction = 0.0;
  Plant<4> plant(vehicle, p);
  PlantState<4> x = plant.state();
  x.body.velocity.x() = 0.5;
  x.wheels[0].spin = x.wheels[1].spin = 0.5 / 0.11;
  plant.reset(x);
  run(plant, idle(), {}, 1.0);
  const double inertia = 1.5 + 2.0 * vehicle.wheels->inertia / (0.11 * 0.11);
  EXPECT_NEAR(plant.body().velocity.x(), 0.5 - 0.018 * 1.5 * gravity / inertia, 1e-3);
  run(plant, idle(), {}, 5.0);
  EXPECT_NEAR(plant.body().velocity.x(), 0.0, 1e-3);
}

TEST(Plant, BodyPitchesFreelyAboutTheAxle) {
  PlantParameters p;
  p.contact.bearing_friction = 0.0;
  Plant<4> plant(vehicle, p);
  const Wrenchd twist{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.01, 0.0)};
  run(plant, idle(), twist, 1.0);
  EXPECT_NEAR(plant.body().angular_velocity.y(), 0.01 / vehicle.body.inertia(1, 1), 1e-6);
  EXPECT_LT(plant.body().position.head<2>().norm(), 1e-9);
  EXPECT_NEAR(plant.state().wheels[0].spin, 0.0, 1e-9);
  EXPECT_NEAR(plant.contact_wrench().torque.y(), 0.0, 1e-9);
}

TEST(Plant, BearingFrictionDragsThePitchingBody) {
  PlantParameters p;
  p.contact.bearing_friction = 1e-3;
  Vehicle<4> v = vehicle;
  v.wheels->on_arms = false;
  Plant<4> plant(v, p);
  PlantState<4> x = plant.state();
  x.body.angular_velocity.y() = 2.0;
  plant.reset(x);
  EXPECT_NEAR(plant.external_wrench().torque.y(), -2.0 * 2e-3, 1e-9);
  EXPECT_NEAR(plant.contact_wrench().torque.y(), 0.0, 1e-9);
  run(plant, idle(), {}, 1.0);
  EXPECT_LT(plant.body().angular_velocity.y(), 1.9);
}

// The right arm points along -y and the left arm along +y, so the same drag turns them in opposite
// directions.
TEST(Plant, BearingsOfWheelsOnTiltingArmsLoadTheServos) {
  for (const bool on_arms : {true, false}) {
    Vehicle<4> v = vehicle;
    v.wheels->on_arms = on_arms;
    PlantParameters p;
    p.contact.rolling_resistance = 0.0;
    Plant<4> plant(v, p);
    PlantState<4> x = plant.state();
    x.body.velocity.x() = 1.5;
    x.wheels[0].spin = x.wheels[1].spin = 1.5 / 0.11;
    plant.reset(x);
    run(plant, idle(), {}, 0.5);
    const double torque = p.contact.bearing_friction *
                          (plant.state().wheels[1].spin - plant.body().angular_velocity.y());
    const double expected = on_arms ? torque : 0.0;
    EXPECT_NEAR(plant.loads().servo_torque[0], -expected, 1e-9);
    EXPECT_NEAR(plant.loads().servo_torque[1], expected, 1e-9);
    EXPECT_NEAR(plant.bearing_torque(), std::abs(expected), 1e-9);
    EXPECT_NEAR(plant.actuators().tilt_angle(1), expected / p.servo_stiffness, 2e-5);
    EXPECT_NEAR(plant.actuators().tilt_angle(0), -expected / p.servo_stiffness, 2e-5);
    EXPECT_GT(torque, 1e-3);
    EXPECT_EQ(plant.actuators().tilt_angle(2), 0.0);
  }
}

// A servo that turns its arm drags the wheel on it by the bearing.
TEST(Plant, TiltingArmDragsItsWheel) {
  PlantParameters p;
  p.contact.bearing_friction = 1e-3;
  Plant<4> plant(vehicle, p);
  PlantState<4> x;
  x.body.position.z() = 50.0;
  plant.reset(x);
  ActuatorState<4> command = idle();
  command.tilt_angle << 0.5, 0.5, 0.0, 0.0;
  run(plant, command, {}, 0.1);
  EXPECT_LT(plant.state().wheels[0].spin, -0.1);  // arm 1 turns about -y
  EXPECT_GT(plant.state().wheels[1].spin, 0.1);
}

TEST(Plant, AxleAwayFromTheCentreOfMassTipsTheBody) {
  PlantParameters p;
  p.contact.axle_position << 0.01, 0.0, -0.005;
  Plant<4> plant(vehicle, p);
  EXPECT_NEAR(plant.normal_forces().sum(), 1.5 * gravity, 1e-9);
  EXPECT_NEAR(plant.contact_wrench().torque.y(), -0.01 * 1.5 * gravity, 1e-9);
  EXPECT_NEAR(plant.loads().angular_acceleration.y(),
              -0.01 * 1.5 * gravity / vehicle.body.inertia(1, 1), 1e-6);
}

TEST(Plant, ExternalWrenchMatchesEquationsOfMotionOfPaper) {
  Random random(7);
  Plant<4> plant(vehicle);
  PlantState<4> x = plant.state();
  x.body.velocity << 1.0, 0.1, 0.0;
  x.body.angular_velocity << 0.1, 0.5, 1.0;
  plant.reset(x);
  for (int k = 0; k < 200; ++k) {
    ActuatorState<4> command = hover();
    command.rotor_speed *= 0.7;
    command.tilt_angle = Eigen::Vector4d::Constant(0.1 * std::sin(0.1 * k));
    ASSERT_TRUE(plant.step(command, {random.vector(1.0), random.vector(0.1)}, 1e-3));
    const Eigen::Vector3d& w = plant.body().angular_velocity;
    const Eigen::Vector3d torque = vehicle.body.inertia * plant.loads().angular_acceleration +
                                   w.cross(vehicle.body.inertia * w);
    EXPECT_LT((torque - plant.actuator_wrench().torque - plant.external_wrench().torque).norm(),
              1e-12);
    EXPECT_LT((1.5 * plant.specific_force() - plant.actuator_wrench().force -
               plant.external_wrench().force)
                  .norm(),
              1e-12);
    EXPECT_GT(plant.normal_forces().head<2>().minCoeff(), 0.0);
  }
}

}  // namespace plant_ground_test
}  // namespace tilt_ropter
