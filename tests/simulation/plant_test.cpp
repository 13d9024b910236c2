// Flight without contact: free body, thrust, drag, and lags of the actuators.

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
#include <stdexcept>
#include <vector>

namespace tilt_ropter {
namespace plant_test {

using test_support::energy;
using test_support::hover;
using test_support::idle;
using test_support::Random;
using test_support::run;
using test_support::tumbling;

const Vehicle<4> vehicle = tilt_ropter_vehicle();

Wrenchd force(double x, double y, double z) {
  return {{x, y, z}, Eigen::Vector3d::Zero()};
}

Eigen::Vector3d angular_momentum(const Plant<4>& plant, const Vehicle<4>& v) {
  Eigen::Vector3d momentum = v.body.inertia * plant.body().angular_velocity;
  for (const WheelState& wheel : plant.state().wheels)
    momentum.y() += v.wheels->inertia * wheel.spin;
  return plant.body().orientation * momentum;
}

Vehicle<4> lopsided_vehicle() {
  Vehicle<4> v = vehicle;
  v.body.inertia << 0.0137, 0.0004, -0.0007, 0.0004, 0.0163, 0.0003, -0.0007, 0.0003, 0.0246;
  return v;
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
    const Eigen::Vector3d h = angular_momentum(plant, v);
    const double rotation =
        0.5 * plant.body().angular_velocity.dot(v.body.inertia * plant.body().angular_velocity);
    run(plant, idle(), {}, 60.0);
    const Eigen::Vector3d after = angular_momentum(plant, v);
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
  const Eigen::Vector3d h = angular_momentum(plant, vehicle);
  run(plant, idle(), {}, 20.0);
  EXPECT_LT((angular_momentum(plant, vehicle) - h).norm(), 1e-9 * h.norm());
}

TEST(Plant, BearingFrictionStopsTheWheelsRelativeToTheBody) {
  const PlantParameters p;
  Vehicle<4> v = vehicle;
  v.wheels->on_arms = false;  // an arm would give way
  Plant<4> plant(v, p);
  PlantState<4> x;
  x.body.position.z() = 100.0;
  x.wheels[0].spin = x.wheels[1].spin = 10.0;
  plant.reset(x);
  run(plant, idle(), {}, 3.0);
  const double rate = p.contact.bearing_friction *
                      (1.0 / vehicle.wheels->inertia + 2.0 / vehicle.body.inertia(1, 1));
  for (const std::size_t i : {0U, 1U})
    EXPECT_NEAR(plant.state().wheels[i].spin - plant.body().angular_velocity.y(),
                10.0 * std::exp(-3.0 * rate), 1e-6);
}

TEST(Plant, FreeFlightConvergesWithOrderFour) {
  Vehicle<4> v = lopsided_vehicle();
  PlantParameters p;  // a slow, soft and distant contact, which does not limit the substep
  p.contact.stiffness = p.contact.bristle_stiffness = 1.0;
  p.contact.dissipation = p.contact.bristle_damping = p.contact.rolling_resistance = 0.0;
  v.wheels->inertia = 0.01;
  p.linear_drag << 0.1, 0.2, 0.3;
  Random random(3);
  const PlantState<4> start = tumbling(random, 1000.0);
  ActuatorState<4> command;
  command.rotor_speed << 1500.0, 1600.0, 1700.0, 1800.0;
  command.tilt_angle << 0.3, -0.4, 0.2, 0.5;  // below the rate limit
  const auto end = [&](double substep) {
    p.max_substep = substep;
    Plant<4> plant(v, p);
    EXPECT_NEAR(plant.substep(), substep, 1e-12);
    plant.reset(start);
    EXPECT_TRUE(plant.step(command, force(0.5, 0.3, -0.2), 0.48));
    const BodyStated& b = plant.body();
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
    const Wrenchd disturbance{random.vector(5.0), random.vector(1.0)};
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
    // The wheels do not rotate in the world, so bearing friction turns the wheels and brakes the
    // body.
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

TEST(Plant, HoversAtHoverRotorSpeeds) {
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

TEST(Plant, RotorsAndServosMatchClosedFormLags) {
  PlantParameters p;
  p.contact.bearing_friction = 0.0;  // the wheels would hold their arms back
  Plant<4> plant(vehicle, p);
  ActuatorState<4> command;
  command.rotor_speed << 500.0, 1000.0, 1500.0, 2000.0;
  command.tilt_angle << 0.6, -0.5, 2.0, -2.5;  // the last two reach the rate limit
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

TEST(Plant, ServosHaveDeadTimeAndRotorsDoNot) {
  Vehicle<4> v = vehicle;
  v.wheels->on_arms = false;
  const Vehicle<4> at_once = v;
  v.servo.dead_time = 0.0235;
  Plant<4> plant(v);
  const auto wave = [](double t) { return 0.2 * std::sin(20.0 * t) + (t < 0.05 ? 0.0 : 0.1); };
  // The same commands to a vehicle without dead time; its angles are compared 23.5 ms later.
  Plant<4> prompt(at_once);
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

TEST(Plant, DeadTimeIsExactForLongAndShortSteps) {
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

TEST(Plant, CommandsAreClampedToActuatorRange) {
  Vehicle<4> v = vehicle;
  v.servo.min_angle = -0.5;
  v.servo.max_angle = 0.7;
  v.wheels->on_arms = false;  // a load can turn an arm past the range
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

// A rotor that fails changes neither the state nor the commands that wait for the servos.
TEST(Plant, RotorsCanBeReplacedInFlight) {
  Vehicle<4> slow = vehicle;
  slow.servo.dead_time = 0.05;
  Plant<4> plant(slow), whole(slow);
  ActuatorState<4> command = hover();
  command.tilt_angle.setConstant(0.3);
  run(plant, command, {}, 0.02);
  run(whole, command, {}, 0.02);
  plant.set_rotors(with_stuck_servo(with_weak_rotor(slow, 1, 0.0), 2, 0.5));
  run(plant, command, {}, 0.1);
  run(whole, command, {}, 0.1);
  EXPECT_EQ(plant.actuators().tilt_angle(2), 0.0);
  EXPECT_EQ(plant.actuators().tilt_angle(3), whole.actuators().tilt_angle(3));
  EXPECT_EQ(plant.actuators().rotor_speed, whole.actuators().rotor_speed);
  const Wrenchd left = plant.actuator_wrench();
  EXPECT_LT(left.force.z(), whole.actuator_wrench().force.z() - 0.2 * slow.body.mass * gravity);
  slow.rotors[0].effectiveness = -1.0;
  EXPECT_THROW(plant.set_rotors(slow), std::invalid_argument);
}

}  // namespace plant_test
}  // namespace tilt_ropter
