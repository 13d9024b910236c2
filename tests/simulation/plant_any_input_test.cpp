// The plant stays finite, keeps its state when input is invalid, and repeats a run bit for bit.

#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include "support/plant_runs.hpp"
#include "support/random.hpp"
#include "support/state_sensor.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

namespace tilt_ropter {
namespace plant_any_input_test {

using test_support::hover;
using test_support::hover_speed;
using test_support::idle;
using test_support::Random;
using test_support::run;
using test_support::StateSensor;
using test_support::tumbling;

const Vehicle<4> vehicle = tilt_ropter_vehicle();

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
    const BodyStated& b = plant.body();
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

TEST(Plant, RejectsInvalidInputAndContinuesWithValid) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double infinite = std::numeric_limits<double>::infinity();
  const std::vector<double> bad{nan, infinite, -infinite, 0.0, 5e-324, 1e300, -1e300, 1.0};
  Random random(8);
  const auto pick = [&] { return bad[static_cast<std::size_t>(random.uniform(0.0, 7.999))]; };
  Plant<4> plant(vehicle);
  int refused = 0;
  for (int n = 0; n < 20000; ++n) {
    ActuatorState<4> command = hover();
    Wrenchd disturbance;
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
      const Wrenchd gust{random.vector(9.0), Eigen::Vector3d::Zero()};
      ASSERT_TRUE(plant.step(hover(), gust, 1e-3));
    }
    EXPECT_TRUE(is_finite(plant.body()));
  }
}

TEST(Plant, StiffWheelsAndFastActuatorsStayStable) {
  Vehicle<4> v = vehicle;
  v.rotor.time_constant = v.servo.time_constant = 1e-4;
  PlantParameters p;
  p.max_substep = 0.01;
  v.wheels->inertia = 1e-5;
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

}  // namespace plant_any_input_test
}  // namespace tilt_ropter
