#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include "support/check_table.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <vector>

namespace tilt_ropter {
namespace {

using test_support::Random;

const double hover_speed = std::sqrt(1.5 * gravity / 4.0 / 1.4e-6);
const Vehicle<4> vehicle = tilt_ropter_vehicle();

ActuatorState<4> idle() {
  return {};
}

ActuatorState<4> hover() {
  ActuatorState<4> command;
  command.rotor_speed.setConstant(hover_speed);
  return command;
}

Wrench<> force(double x, double y, double z) {
  return {{x, y, z}, Eigen::Vector3d::Zero()};
}

template <int Rotors>
void run(Plant<Rotors>& plant, const ActuatorState<Rotors>& command, const Wrench<>& disturbance,
         double duration, double dt = 1e-3) {
  const int steps = static_cast<int>(std::lround(duration / dt));
  for (int i = 0; i < steps; ++i) ASSERT_TRUE(plant.step(command, disturbance, dt));
}

Eigen::Vector3d angular_momentum(const Plant<4>& plant, const Vehicle<4>& v, double wheel_inertia) {
  Eigen::Vector3d momentum = v.body.inertia * plant.body().angular_velocity;
  for (const WheelState& wheel : plant.state().wheels) momentum.y() += wheel_inertia * wheel.spin;
  return plant.body().orientation * momentum;
}

/// Kinetic, potential and elastic energy.
double energy(const Plant<4>& plant, const Vehicle<4>& v, WheelContactParameters p) {
  const BodyState<>& body = plant.body();
  double sum = 0.5 * v.body.mass * body.velocity.squaredNorm() +
               0.5 * body.angular_velocity.dot(v.body.inertia * body.angular_velocity) +
               v.body.mass * gravity * body.position.z();
  p.dissipation = 0.0;  // then the normal force tells the depth
  for (int i = 0; i < 2; ++i) {
    const WheelState& wheel = plant.state().wheels[static_cast<std::size_t>(i)];
    const double spring =
        wheel_contact(
            p,
            {{0.0, i == 0 ? -v.wheels->half_track : v.wheels->half_track, 0.0}, v.wheels->radius},
            body, body.orientation.toRotationMatrix(), wheel)
            .normal_force;
    sum += 0.5 * p.wheel_inertia * wheel.spin * wheel.spin + 0.5 * spring * spring / p.stiffness +
           0.5 * p.bristle_stiffness * wheel.bristle.squaredNorm();
  }
  return sum;
}

Vehicle<4> lopsided_vehicle() {
  Vehicle<4> v = vehicle;
  v.body.inertia << 0.0137, 0.0004, -0.0007, 0.0004, 0.0163, 0.0003, -0.0007, 0.0003, 0.0246;
  return v;
}

PlantState<4> tumbling(Random& random, double height) {
  PlantState<4> x;
  x.body.position.z() = height;
  x.body.velocity = random.vector(1.0);
  x.body.orientation = random.orientation();
  x.body.angular_velocity = random.vector(5.0);
  x.wheels[0].spin = random.uniform(-20.0, 20.0);
  x.wheels[1].spin = random.uniform(-20.0, 20.0);
  return x;
}

// ------------------------------------------------------------------------------------- free body

TEST(Plant, FreeBodyKeepsEnergyAndAngularMomentum) {
  Random random(1);
  const Vehicle<4> v = lopsided_vehicle();
  PlantParameters p;
  p.contact.bearing_friction = 0.0;
  for (int n = 0; n < 2; ++n) {
    Plant<4> plant(v, p);
    plant.reset(tumbling(random, 20000.0));
    const double e = energy(plant, v, p.contact);
    const Eigen::Vector3d h = angular_momentum(plant, v, p.contact.wheel_inertia);
    const double rotation =
        0.5 * plant.body().angular_velocity.dot(v.body.inertia * plant.body().angular_velocity);
    run(plant, idle(), {}, 60.0);
    const Eigen::Vector3d after = angular_momentum(plant, v, p.contact.wheel_inertia);
    const double turning =
        0.5 * plant.body().angular_velocity.dot(v.body.inertia * plant.body().angular_velocity);
    test_support::check_at_most(12, "plant: angular momentum lost in 60 s, relative",
                                (after - h).norm() / h.norm(), 1e-9);
    EXPECT_NEAR(energy(plant, v, p.contact), e, 1e-9 * e);
    test_support::check_at_most(12, "plant: energy of rotation lost in 60 s, relative",
                                std::abs(turning / rotation - 1.0), 1e-6);
    EXPECT_NEAR(plant.time(), 60.0, 1e-9);
    EXPECT_NEAR(plant.body().orientation.norm(), 1.0, 1e-12);
  }
}

TEST(Plant, BearingFrictionKeepsAngularMomentum) {
  Random random(2);
  const PlantParameters p;
  Plant<4> plant(vehicle, p);
  plant.reset(tumbling(random, 20000.0));
  const Eigen::Vector3d h = angular_momentum(plant, vehicle, p.contact.wheel_inertia);
  run(plant, idle(), {}, 20.0);
  EXPECT_LT((angular_momentum(plant, vehicle, p.contact.wheel_inertia) - h).norm(),
            1e-9 * h.norm());
}

TEST(Plant, BearingFrictionStopsTheWheelsOnTheBody) {
  const PlantParameters p;
  Plant<4> plant(vehicle, p);
  PlantState<4> x;
  x.body.position.z() = 100.0;
  x.wheels[0].spin = x.wheels[1].spin = 10.0;
  plant.reset(x);
  run(plant, idle(), {}, 3.0);
  const double rate = p.contact.bearing_friction * (1.0 / p.contact.wheel_inertia + 2.0 / 0.014);
  for (const std::size_t i : {0U, 1U})
    EXPECT_NEAR(plant.state().wheels[i].spin - plant.body().angular_velocity.y(),
                10.0 * std::exp(-3.0 * rate), 1e-6);
}

TEST(Plant, FreeFlightConvergesWithOrderFour) {
  const Vehicle<4> v = lopsided_vehicle();
  PlantParameters p;  // a slow and soft contact, far away, so that it does not limit the substep
  p.contact.stiffness = p.contact.bristle_stiffness = 1.0;
  p.contact.dissipation = p.contact.bristle_damping = p.contact.rolling_resistance = 0.0;
  p.contact.wheel_inertia = 0.01;
  p.linear_drag << 0.1, 0.2, 0.3;
  Random random(3);
  const PlantState<4> start = tumbling(random, 1000.0);
  ActuatorState<4> command;
  command.rotor_speed << 1500.0, 1600.0, 1700.0, 1800.0;
  command.tilt_angle << 0.3, -0.4, 0.2, 0.5;  // slow enough for the rate limit
  const auto end = [&](double substep) {
    p.max_substep = substep;
    Plant<4> plant(v, p);
    EXPECT_NEAR(plant.substep(), substep, 1e-12);
    plant.reset(start);
    EXPECT_TRUE(plant.step(command, force(0.5, 0.3, -0.2), 0.48));
    const BodyState<>& b = plant.body();
    Eigen::Matrix<double, 13, 1> x;
    x << b.position, b.velocity, b.orientation.coeffs(), b.angular_velocity;
    return x;
  };
  const Eigen::Matrix<double, 13, 1> a = end(0.004), b = end(0.002), c = end(0.001);
  for (const int first : {0, 3, 6, 10}) {  // position, velocity, orientation, angular velocity
    const int size = first == 6 ? 4 : 3;
    const double order =
        std::log2((a - b).segment(first, size).norm() / (b - c).segment(first, size).norm());
    test_support::check_at_most(12, "plant: order of convergence, off 4", std::abs(order - 4.0),
                                0.2);
  }
}

TEST(Plant, AccelerationsFollowFromNewtonAndEuler) {
  Random random(4);
  for (int n = 0; n < 200; ++n) {
    Vehicle<3> v;
    v.body.mass = random.uniform(0.5, 3.0);
    v.body.inertia = lopsided_vehicle().body.inertia * random.uniform(0.5, 2.0);
    v.wheels = {0.1, 0.2};
    v.rotor.thrust_coefficient = 1.3e-6;
    for (RotorGeometry& r : v.rotors) {
      r.position = random.vector(0.3);
      r.orientation = random.orientation().toRotationMatrix();
      r.spin = random.uniform(-1.0, 1.0) < 0.0 ? Spin::clockwise : Spin::counter_clockwise;
    }
    v.rotors[2].tilts = false;
    v.rotors[1].effectiveness = 0.4;
    PlantParameters p;
    p.linear_drag << 0.1, 0.2, 0.3;
    Plant<3> plant(v, p);
    PlantState<3> x;
    x.body.position.z() = 5.0;
    x.body.velocity = random.vector(3.0);
    x.body.orientation = random.orientation();
    x.body.angular_velocity = random.vector(5.0);
    for (int i = 0; i < 3; ++i) {
      x.actuators.rotor_speed(i) = random.uniform(0.0, 2500.0);
      x.actuators.tilt_angle(i) = random.uniform(-3.0, 3.0);
    }
    plant.reset(x);
    const Wrench<> disturbance{random.vector(5.0), random.vector(1.0)};
    const double dt = 1e-7;
    ASSERT_TRUE(plant.step(x.actuators, disturbance, dt));

    Eigen::Vector3d f = disturbance.force, m = disturbance.torque;
    for (int i = 0; i < 3; ++i) {
      const RotorGeometry& r = v.rotors[static_cast<std::size_t>(i)];
      const double angle = r.tilts ? x.actuators.tilt_angle(i) : 0.0;
      const Eigen::Vector3d axis =
          r.orientation * Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitX()).toRotationMatrix() *
          Eigen::Vector3d::UnitZ();
      const double thrust =
          r.effectiveness * 1.3e-6 * x.actuators.rotor_speed(i) * x.actuators.rotor_speed(i);
      f += thrust * axis;
      m += r.position.cross(thrust * axis);
      m += (r.spin == Spin::clockwise ? 0.016 : -0.016) * thrust * axis;
    }
    f -= p.linear_drag.asDiagonal() * (x.body.orientation.conjugate() * x.body.velocity);
    // The wheels stand still in the world, so bearing friction turns them and brakes the body.
    m.y() -= 2.0 * p.contact.bearing_friction * x.body.angular_velocity.y();
    const Eigen::Vector3d& w = x.body.angular_velocity;
    const Eigen::Vector3d acceleration =
        x.body.orientation * f / v.body.mass - Eigen::Vector3d(0.0, 0.0, gravity);
    const Eigen::Vector3d spin_up = v.body.inertia.ldlt().solve(m - w.cross(v.body.inertia * w));
    EXPECT_LT((plant.specific_force() - f / v.body.mass).norm(), 1e-4);
    EXPECT_LT((plant.loads().angular_acceleration - spin_up).norm(), 1e-3);
    EXPECT_LT(((plant.body().velocity - x.body.velocity) / dt - acceleration).norm(), 1e-4);
    EXPECT_LT(((plant.body().angular_velocity - w) / dt - spin_up).norm(), 1e-3);
    EXPECT_LT(((plant.body().position - x.body.position) / dt - x.body.velocity).norm(), 1e-4);
    const Eigen::Vector3d turned = quaternion_log(
        Eigen::Quaterniond(x.body.orientation.conjugate() * plant.body().orientation));
    EXPECT_LT((turned / dt - w).norm(), 1e-4);
  }
}

TEST(Plant, HoversAtTheHoverSpeeds) {
  Plant<4> plant(vehicle);
  PlantState<4> x;
  x.body.position << 1.0, 2.0, 3.0;
  x.body.orientation = quaternion_from_yaw(0.5);
  x.actuators = hover();
  plant.reset(x);
  run(plant, hover(), {}, 60.0);
  EXPECT_LT((plant.body().position - x.body.position).norm(), 1e-6);
  EXPECT_LT(plant.body().angular_velocity.norm(), 1e-9);
  EXPECT_NEAR(plant.specific_force().z(), gravity, 1e-9);
  EXPECT_NEAR(plant.actuator_wrench().force.z(), 1.5 * gravity, 1e-9);
  EXPECT_LT(plant.external_wrench().force.norm(), 1e-12);
}

TEST(Plant, LinearDragBrakesEachAxisExponentially) {
  PlantParameters p;
  p.linear_drag << 0.3, 0.6, 0.9;
  Plant<4> plant(vehicle, p);
  PlantState<4> x;
  x.body.position.z() = 5.0;
  x.body.velocity << 1.0, 2.0, 0.5;
  x.actuators = hover();
  plant.reset(x);
  run(plant, hover(), {}, 2.0);
  for (int i = 0; i < 3; ++i)
    EXPECT_NEAR(plant.body().velocity(i),
                x.body.velocity(i) * std::exp(-p.linear_drag(i) / 1.5 * 2.0), 1e-9);
}

// ------------------------------------------------------------------------------------- actuators

TEST(Plant, RotorsAndServosFollowTheirLagsInClosedForm) {
  Plant<4> plant(vehicle);
  ActuatorState<4> command;
  command.rotor_speed << 500.0, 1000.0, 1500.0, 2000.0;
  command.tilt_angle << 0.6, -0.5, 2.0, -2.5;  // the last two meet the rate limit
  const double tau = vehicle.servo.time_constant, rate = vehicle.servo.max_rate;
  for (int k = 1; k <= 500; ++k) {
    ASSERT_TRUE(plant.step(command, {}, 1e-3));
    const double t = 1e-3 * k;
    for (int i = 0; i < 4; ++i) {
      EXPECT_NEAR(plant.actuators().rotor_speed(i),
                  command.rotor_speed(i) * (1.0 - std::exp(-t / vehicle.rotor.time_constant)),
                  1e-6);
      const double size = std::abs(command.tilt_angle(i));
      const double limited = std::max(0.0, (size - rate * tau) / rate);
      const double expected =
          t < limited ? rate * t : size - (size - rate * limited) * std::exp(-(t - limited) / tau);
      EXPECT_NEAR(std::abs(plant.actuators().tilt_angle(i)), expected, 2e-6);
    }
  }
}

TEST(Plant, ServosWaitForTheirDeadTimeAndRotorsDoNot) {
  Vehicle<4> v = vehicle;
  v.servo.dead_time = 0.0235;
  Plant<4> plant(v);
  const auto wave = [](double t) { return 0.2 * std::sin(20.0 * t) + (t < 0.05 ? 0.0 : 0.1); };
  // The same commands to a vehicle without dead time, 23.5 ms later.
  Plant<4> prompt(vehicle);
  std::vector<double> late, expected;
  for (int k = 0; k < 1000; ++k) {
    ActuatorState<4> command;
    command.rotor_speed.setConstant(1000.0);
    command.tilt_angle.setConstant(wave(5e-4 * k));
    ASSERT_TRUE(plant.step(command, {}, 5e-4));
    ASSERT_TRUE(prompt.step(command, {}, 5e-4));
    EXPECT_NEAR(plant.actuators().rotor_speed(0), prompt.actuators().rotor_speed(0), 1e-12);
    late.push_back(plant.actuators().tilt_angle(0));
    expected.push_back(prompt.actuators().tilt_angle(0));
  }
  for (std::size_t k = 0; k < 46; ++k) EXPECT_NEAR(late[k], 0.0, 1e-15);
  for (std::size_t k = 47; k < 1000; ++k) EXPECT_NEAR(late[k], expected[k - 47], 1e-12);
}

TEST(Plant, DeadTimeHoldsForStepsLongerAndShorterThanTheSubstep) {
  Vehicle<4> v = vehicle;
  v.servo.dead_time = 0.05;
  for (const double dt : {1e-4, 1e-3, 0.02, 0.2}) {
    Plant<4> plant(v);
    ActuatorState<4> command;
    command.tilt_angle.setConstant(0.4);
    run(plant, command, {}, 0.2, dt);
    const double expected = 0.4 * (1.0 - std::exp(-(0.2 - 0.05) / v.servo.time_constant));
    EXPECT_NEAR(plant.actuators().tilt_angle(2), expected, 1e-6) << "dt " << dt;
  }
}

TEST(Plant, CommandsAreCutToTheActuatorsRange) {
  Vehicle<4> v = vehicle;
  v.servo.min_angle = -0.5;
  v.servo.max_angle = 0.7;
  v.rotor.min_thrust = 0.4;
  v.rotors[3].tilts = false;
  Plant<4> plant(v);
  ActuatorState<4> command;
  command.rotor_speed << 1e9, -1e9, 0.0, 1000.0;
  command.tilt_angle << 3.0, -3.0, 1e200, 0.3;
  for (int k = 0; k < 2000; ++k) {
    ASSERT_TRUE(plant.step(command, force(0.0, 0.0, -100.0), 1e-3));
    EXPECT_LE(plant.actuators().tilt_angle.maxCoeff(), 0.7);
    EXPECT_GE(plant.actuators().tilt_angle.minCoeff(), -0.5);
  }
  const double fastest = std::sqrt(12.0 / 1.4e-6), slowest = std::sqrt(0.4 / 1.4e-6);
  EXPECT_NEAR(plant.actuators().rotor_speed(0), fastest, 1e-6);
  EXPECT_NEAR(plant.actuators().rotor_speed(1), slowest, 1e-6);
  EXPECT_NEAR(plant.actuators().rotor_speed(2), slowest, 1e-6);
  EXPECT_NEAR(plant.actuators().rotor_speed(3), 1000.0, 1e-6);
  EXPECT_NEAR(plant.actuators().tilt_angle(0), 0.7, 1e-6);
  EXPECT_NEAR(plant.actuators().tilt_angle(1), -0.5, 1e-6);
  EXPECT_NEAR(plant.actuators().tilt_angle(2), 0.7, 1e-6);
  EXPECT_NEAR(plant.actuators().tilt_angle(3), 0.0, 1e-15);
}

// ---------------------------------------------------------------------------------------- ground

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

/// Lets a vehicle fall from `x` for two seconds and returns how often it bounced up in contact.
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

// Where the wheel's lowest point wanders all around it.
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

// Nothing takes energy here but the integration: it has to give none either.
TEST(Plant, ElasticBounceKeepsItsEnergy) {
  PlantParameters p;
  p.contact.dissipation = p.contact.bristle_damping = 0.0;
  p.contact.rolling_resistance = p.contact.bearing_friction = 0.0;
  p.contact.friction = 0.0;
  Random random(6);
  for (int n = 0; n < 5; ++n) {
    Plant<4> plant(vehicle, p);
    PlantState<4> x;
    x.body.position.z() = 0.16;
    if (n > 0) x.body.orientation = quaternion_exp(random.vector(0.1));
    plant.reset(x);
    const double start = energy(plant, vehicle, p.contact);
    run(plant, idle(), {}, 10.0);
    EXPECT_NEAR(energy(plant, vehicle, p.contact), start, 1e-4 * start) << "case " << n;
  }
}

// On ground that slopes down to +y, gravity has a part along it: here a force in the world frame.
void run_on_slope(Plant<4>& plant, double from, double to, double duration) {
  const int steps = static_cast<int>(std::lround(1e3 * duration));
  const double weight = 1.5 * gravity;
  for (int k = 1; k <= steps; ++k) {
    const double angle = from + (to - from) * k / steps;
    const Eigen::Vector3d pull(0.0, weight * std::sin(angle), weight * (1.0 - std::cos(angle)));
    const Wrench<> disturbance{plant.body().orientation.conjugate() * pull,
                               Eigen::Vector3d::Zero()};
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

TEST(Plant, SlidesAboveTheFrictionAngleAsCoulombSays) {
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

TEST(Plant, RollsTheDistanceOfItsWheelAngle) {
  Plant<4> plant(vehicle);
  PlantState<4> x = plant.state();
  x.body.velocity.x() = 1.5;  // with the wheels at rest: they skid first
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

TEST(Plant, OneLongStepIsManyShortOnes) {
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
  x.wheels[0].spin = 1.2 / 0.11;  // the right wheel runs outside
  x.wheels[1].spin = 0.8 / 0.11;
  plant.reset(x);
  for (int k = 0; k < 1500; ++k) {
    ASSERT_TRUE(plant.step(idle(), {}, 1e-3));
    const BodyState<>& body = plant.body();
    const Eigen::Vector3d v = body.orientation.conjugate() * body.velocity;
    if (k < 300) continue;  // until the tyres have taken up the side force
    EXPECT_NEAR(v.y(), 0.0, 1e-3);
    EXPECT_NEAR(0.11 * plant.state().wheels[0].spin, v.x() + 0.2 * body.angular_velocity.z(), 0.02);
  }
  const double ratio = plant.state().wheels[0].angle / plant.state().wheels[1].angle;
  EXPECT_NEAR(ratio, 1.5, 0.1);
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
  const double inertia = 1.5 + 2.0 * p.contact.wheel_inertia / (0.11 * 0.11);
  EXPECT_NEAR(plant.body().velocity.x(), 0.5 - 0.018 * 1.5 * gravity / inertia, 1e-3);
  run(plant, idle(), {}, 5.0);
  EXPECT_NEAR(plant.body().velocity.x(), 0.0, 1e-3);
}

TEST(Plant, BodyPitchesFreelyAboutTheAxle) {
  PlantParameters p;
  p.contact.bearing_friction = 0.0;
  Plant<4> plant(vehicle, p);
  const Wrench<> twist{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.01, 0.0)};
  run(plant, idle(), twist, 1.0);
  EXPECT_NEAR(plant.body().angular_velocity.y(), 0.01 / 0.014, 1e-6);
  EXPECT_LT(plant.body().position.head<2>().norm(), 1e-9);
  EXPECT_NEAR(plant.state().wheels[0].spin, 0.0, 1e-9);
  EXPECT_NEAR(plant.contact_wrench().torque.y(), 0.0, 1e-9);
}

TEST(Plant, BearingFrictionDragsThePitchingBody) {
  PlantParameters p;
  p.contact.bearing_friction = 1e-3;
  Plant<4> plant(vehicle, p);
  PlantState<4> x = plant.state();
  x.body.angular_velocity.y() = 2.0;
  plant.reset(x);
  EXPECT_NEAR(plant.external_wrench().torque.y(), -2.0 * 2e-3, 1e-9);
  EXPECT_NEAR(plant.contact_wrench().torque.y(), 0.0, 1e-9);
  run(plant, idle(), {}, 1.0);
  EXPECT_LT(plant.body().angular_velocity.y(), 1.9);
}

TEST(Plant, AxleAwayFromTheCentreOfMassTipsTheBody) {
  PlantParameters p;
  p.contact.axle_position << 0.01, 0.0, -0.005;
  Plant<4> plant(vehicle, p);
  EXPECT_NEAR(plant.normal_forces().sum(), 1.5 * gravity, 1e-9);
  EXPECT_NEAR(plant.contact_wrench().torque.y(), -0.01 * 1.5 * gravity, 1e-9);
  EXPECT_NEAR(plant.loads().angular_acceleration.y(), -0.01 * 1.5 * gravity / 0.014, 1e-6);
}

TEST(Plant, ExternalWrenchIsWhatThePapersBodyFeels) {
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

// ------------------------------------------------------------------------------------ robustness

std::vector<double> noisy_run(std::uint64_t seed) {
  std::vector<double> trace;
  Plant<4> plant(vehicle);
  StateSensor sensor({}, seed);
  ActuatorState<4> command = hover();
  for (int k = 0; k < 2000; ++k) {
    if (const auto m = sensor.sample(plant.time(), plant.body())) {
      command.rotor_speed.setConstant(hover_speed * (1.0 - m->body.velocity.z()));
      command.tilt_angle.setConstant(m->body.velocity.x());
    }
    plant.step(command, {}, 1e-3);
    const BodyState<>& b = plant.body();
    for (int i = 0; i < 3; ++i)
      trace.insert(trace.end(), {b.position(i), b.velocity(i), b.angular_velocity(i),
                                 b.orientation.coeffs()(i), plant.specific_force()(i)});
  }
  return trace;
}

TEST(Plant, SameSeedGivesTheSameTrajectoryBitForBit) {
  const std::vector<double> a = noisy_run(1), b = noisy_run(1), c = noisy_run(2);
  ASSERT_EQ(a.size(), b.size());
  EXPECT_EQ(std::memcmp(a.data(), b.data(), a.size() * sizeof(double)), 0);
  EXPECT_NE(std::memcmp(a.data(), c.data(), a.size() * sizeof(double)), 0);
}

bool same(const PlantState<4>& a, const PlantState<4>& b) {
  const auto equal = [](const auto& u, const auto& v) {
    return std::memcmp(u.data(), v.data(), sizeof(double) * std::size_t(u.size())) == 0;
  };
  return a.time == b.time && equal(a.body.position, b.body.position) &&
         equal(a.body.velocity, b.body.velocity) &&
         equal(a.body.orientation.coeffs(), b.body.orientation.coeffs()) &&
         equal(a.body.angular_velocity, b.body.angular_velocity) &&
         equal(a.actuators.rotor_speed, b.actuators.rotor_speed) &&
         equal(a.actuators.tilt_angle, b.actuators.tilt_angle) &&
         equal(a.wheels[0].bristle, b.wheels[0].bristle);
}

TEST(Plant, RefusesBadInputAndGoesOnWithGood) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double infinite = std::numeric_limits<double>::infinity();
  const std::vector<double> bad{nan, infinite, -infinite, 0.0, 5e-324, 1e300, -1e300, 1.0};
  Random random(8);
  const auto pick = [&] { return bad[static_cast<std::size_t>(random.uniform(0.0, 7.999))]; };
  Plant<4> plant(vehicle);
  int refused = 0;
  for (int n = 0; n < 20000; ++n) {
    ActuatorState<4> command = hover();
    Wrench<> disturbance;
    double dt = 1e-3;
    switch (n % 5) {
      case 0:
        command.rotor_speed(n % 4) = pick();
        break;
      case 1:
        command.tilt_angle(n % 4) = pick();
        break;
      case 2:
        disturbance.force(n % 3) = pick();
        break;
      case 3:
        disturbance.torque(n % 3) = pick();
        break;
      default:
        dt = random.uniform(0.0, 1.0) < 0.9 ? -1e-3 : pick();
    }
    const PlantState<4> before = plant.state();
    if (!plant.step(command, disturbance, dt)) {
      ++refused;
      EXPECT_TRUE(same(plant.state(), before));
    }
    ASSERT_TRUE(is_finite(plant.body()) && all_finite(plant.state().actuators.rotor_speed));
    ASSERT_TRUE(is_finite(plant.external_wrench()) && all_finite(plant.specific_force()));
    if (n % 10 == 0) plant.reset(Plant<4>(vehicle).state());
  }
  EXPECT_GT(refused, 8000);
  for (const double dt : {0.0, -1.0, 10.1, nan, infinite})
    EXPECT_FALSE(plant.step(hover(), {}, dt));
  EXPECT_TRUE(plant.step(hover(), {}, 1e-3));
  EXPECT_TRUE(plant.step(hover(), {}, 10.0));
}

TEST(Plant, StaysFiniteWhenItTipsOver) {
  Random random(9);
  for (int n = 0; n < 10; ++n) {
    Plant<4> plant(vehicle);
    PlantState<4> x = tumbling(random, 0.3);
    x.body.orientation = quaternion_exp(Eigen::Vector3d(pi / 2, 0.0, 0.0));
    x.body.angular_velocity.setZero();
    if (n > 0) x.body.angular_velocity = random.vector(3.0);
    plant.reset(x);
    for (int k = 0; k < 3000; ++k) {
      const Wrench<> gust{random.vector(9.0), Eigen::Vector3d::Zero()};
      ASSERT_TRUE(plant.step(hover(), gust, 1e-3));
    }
    EXPECT_TRUE(is_finite(plant.body()));
  }
}

TEST(Plant, StiffWheelsAndQuickActuatorsStayStable) {
  Vehicle<4> v = vehicle;
  v.rotor.time_constant = v.servo.time_constant = 1e-4;
  PlantParameters p;
  p.max_substep = 0.01;
  p.contact.wheel_inertia = 1e-5;
  p.contact.stiffness = 3e4;
  p.contact.dissipation = 20.0;
  Plant<4> plant(v, p);
  EXPECT_LE(plant.substep(), 1e-4);
  PlantState<4> x = plant.state();
  x.body.velocity.x() = 1.0;
  x.body.position.z() += 0.02;
  plant.reset(x);
  run(plant, idle(), {}, 0.5);
  EXPECT_NEAR(plant.body().position.z(), plant.standing_height(), 1e-5);
  EXPECT_NEAR(0.11 * plant.state().wheels[0].spin, plant.body().velocity.x(), 1e-3);
  EXPECT_GT(plant.body().velocity.x(), 0.3);
}

TEST(Plant, ResetSetsTheWholeStateAndDropsWaitingCommands) {
  Vehicle<4> v = vehicle;
  v.servo.dead_time = 0.1;
  v.rotors[0].tilts = false;
  Plant<4> plant(v);
  ActuatorState<4> command;
  command.tilt_angle.setConstant(1.0);
  run(plant, command, {}, 0.05);
  PlantState<4> x;
  x.time = 7.0;
  x.body.position.z() = 4.0;
  x.body.orientation.coeffs() << 0.0, 0.0, 0.0, 2.0;
  x.actuators.tilt_angle.setConstant(0.3);
  plant.reset(x);
  EXPECT_NEAR(plant.time(), 7.0, 0.0);
  EXPECT_NEAR(plant.body().orientation.w(), 1.0, 1e-15);
  EXPECT_NEAR(plant.actuators().tilt_angle(0), 0.0, 0.0);
  run(plant, idle(), {}, 0.09);
  EXPECT_NEAR(plant.actuators().tilt_angle(1), 0.3, 1e-15);
  EXPECT_NEAR(plant.time(), 7.09, 1e-9);
}

TEST(Plant, RejectsWhatCannotBe) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto bad_parameters = [](auto change) {
    PlantParameters p;
    change(p);
    EXPECT_THROW(Plant<4>(vehicle, p), std::invalid_argument);
  };
  bad_parameters([](auto& p) { p.max_substep = 0.0; });
  bad_parameters([](auto& p) { p.linear_drag.x() = -1.0; });
  bad_parameters([](auto& p) { p.contact.stiffness = 0.0; });
  bad_parameters([](auto& p) { p.contact.wheel_inertia = 1e-30; });
  Vehicle<4> v = vehicle;
  v.body.mass = 0.0;
  EXPECT_THROW(Plant<4>{v}, std::invalid_argument);
  Plant<4> plant(vehicle);
  const auto bad_state = [&](auto change) {
    PlantState<4> x;
    change(x);
    EXPECT_THROW(plant.reset(x), std::invalid_argument);
  };
  bad_state([nan](auto& x) { x.time = nan; });
  bad_state([nan](auto& x) { x.body.position.x() = nan; });
  bad_state([nan](auto& x) { x.body.velocity.x() = nan; });
  bad_state([](auto& x) { x.body.orientation.coeffs().setZero(); });
  bad_state([nan](auto& x) { x.body.angular_velocity.x() = nan; });
  bad_state([](auto& x) { x.actuators.rotor_speed(0) = -1.0; });
  bad_state([nan](auto& x) { x.actuators.tilt_angle(0) = nan; });
  bad_state([nan](auto& x) { x.wheels[1].spin = nan; });
}

}  // namespace
}  // namespace tilt_ropter
