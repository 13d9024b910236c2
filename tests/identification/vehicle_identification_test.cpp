// CTest: optimised
// Identifies a vehicle from a flight with a controller of a few lines, so that nothing but the
// plant and the sensors' noise is in the log.

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/identification/vehicle_identification.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>

namespace tilt_ropter {
namespace vehicle_identification_test {

using Eigen::Vector3d;
using P = VehicleParameter;
using Status = VehicleIdentificationStatus;
using test_support::Random;

const Vector3d drag(0.2, 0.3, 0.1);  // [N s/m]

// What the vehicle is, and what is believed: other thrust, inertia, lags and drag.
Vehicle<4> real_vehicle() {
  Vehicle<4> v = tilt_ropter_vehicle();
  v.body.inertia.diagonal() = v.body.inertia.diagonal().cwiseProduct(Vector3d(1.1, 1.2, 0.85));
  v.rotor.thrust_coefficient *= 0.95;
  v.rotor.min_thrust *= 0.95;
  v.rotor.max_thrust *= 0.95;
  v.rotor.torque_ratio *= 1.1;
  v.rotor.time_constant *= 1.2;
  v.servo.time_constant *= 0.8;
  v.servo.dead_time = 0.01;
  return v;
}

// Position and attitude swing about each axis.
Vector3d swing(double time, double size, const Vector3d& frequencies) {
  return size * Vector3d(std::sin(frequencies.x() * time), std::sin(frequencies.y() * time),
                         std::sin(frequencies.z() * time));
}

VehicleLog<4> record(double duration, bool moves, unsigned seed) {
  constexpr double step = 1e-3;
  const Vehicle<4> believed = tilt_ropter_vehicle();
  const Allocation<4> allocation(believed);
  PlantParameters parameters;
  parameters.linear_drag = drag;
  Plant<4> plant(real_vehicle(), parameters);
  BodyStated start;
  start.position.z() = 1.5;
  Wrenchd wrench;
  wrench.force.z() = believed.body.mass * gravity;
  ActuatorState<4> command = allocation.allocate(wrench, {}).command;
  plant.reset(start, command);
  Random random(seed);
  VehicleLog<4> log;
  for (int i = 0; i <= static_cast<int>(duration / step); ++i) {
    const double time = step * i;
    const BodyStated& x = plant.body();
    if (i % 10 == 0) {
      const Vector3d place = moves ? swing(time, 0.4, {3.1, 3.7, 4.3}) : Vector3d::Zero(),
                     turn = moves ? swing(time, 0.25, {5.3, 4.7, 5.9}) : Vector3d::Zero();
      const Vector3d force = believed.body.mass * (12.0 * (start.position + place - x.position) -
                                                   6.0 * x.velocity + Vector3d(0.0, 0.0, gravity));
      const Eigen::Quaterniond error = x.orientation.conjugate() * quaternion_exp(turn);
      wrench.force = x.orientation.conjugate() * force;
      wrench.torque =
          believed.body.inertia * (60.0 * quaternion_log(error) - 14.0 * x.angular_velocity);
      command = allocation.allocate(wrench, command).command;
      log.commands.push_back({time, command});
      log.poses.push_back({time, {x.position + random.vector(1e-3), x.orientation}});
    }
    if (i % 2 == 0)
      log.imu.push_back({time,
                         {x.angular_velocity + random.vector(2e-3),
                          plant.specific_force() + random.vector(0.02)}});
    if (i % 5 == 0) log.rotor_speeds.push_back({time, plant.actuators().rotor_speed});
    EXPECT_TRUE(plant.step(command, {}, step));
  }
  return log;
}

// Value within `share` of the truth or `least`, and an interval that is not much wider.
void expect_found(const VehicleIdentification<4>& found, P parameter, double truth, double share,
                  double least = 0.0) {
  const IdentifiedParameter& p = found[parameter];
  const double allowed = std::max(share * std::abs(truth), least);
  const std::string name = to_string(parameter);
  EXPECT_TRUE(p.excited) << name;
  EXPECT_NEAR(p.value, truth, allowed) << name;
  EXPECT_GT(p.half_width, 0.0) << name;
  EXPECT_LT(p.half_width, 3.0 * allowed) << name;
}

TEST(IdentifyVehicle, FindsEveryParameterAndTheVehicle) {
  const Vehicle<4> given = tilt_ropter_vehicle(), truth = real_vehicle();
  const VehicleLog<4> log = record(16.0, true, 1);
  const auto found = identify_vehicle(log, given);
  ASSERT_EQ(found.status, Status::identified);
  expect_found(found, P::thrust_per_mass, 0.95, 0.005);
  for (const P com : {P::com_x, P::com_y, P::com_z}) expect_found(found, com, 0.0, 0.0, 1e-3);
  const Vector3d moments = truth.body.inertia.diagonal();
  expect_found(found, P::inertia_x, moments.x(), 0.03);
  expect_found(found, P::inertia_y, moments.y(), 0.03);
  expect_found(found, P::inertia_z, moments.z(), 0.03);
  expect_found(found, P::torque_ratio, truth.rotor.torque_ratio, 0.05);
  expect_found(found, P::servo_time_constant, truth.servo.time_constant, 0.03);
  expect_found(found, P::servo_dead_time, 0.01, 0.0, 1e-3);
  expect_found(found, P::rotor_time_constant, truth.rotor.time_constant, 0.03);
  expect_found(found, P::drag_x, drag.x(), 0.0, 0.1);
  expect_found(found, P::drag_y, drag.y(), 0.0, 0.1);
  expect_found(found, P::drag_z, drag.z(), 0.0, 0.1);

  const Vehicle<4>& v = found.vehicle;
  const auto value = [&](P parameter) { return found[parameter].value; };
  EXPECT_EQ(v.body.mass, given.body.mass);
  EXPECT_DOUBLE_EQ(v.body.inertia(0, 0), value(P::inertia_x));
  EXPECT_DOUBLE_EQ(v.body.inertia(1, 1), value(P::inertia_y));
  EXPECT_DOUBLE_EQ(v.body.inertia(2, 2), value(P::inertia_z));
  const double scale = value(P::thrust_per_mass);
  EXPECT_DOUBLE_EQ(v.rotor.thrust_coefficient, scale * given.rotor.thrust_coefficient);
  EXPECT_DOUBLE_EQ(v.rotor.max_thrust, scale * given.rotor.max_thrust);
  EXPECT_DOUBLE_EQ(v.rotor.torque_ratio, value(P::torque_ratio));
  EXPECT_DOUBLE_EQ(v.rotor.time_constant, value(P::rotor_time_constant));
  EXPECT_DOUBLE_EQ(v.servo.time_constant, value(P::servo_time_constant));
  EXPECT_DOUBLE_EQ(v.servo.dead_time, value(P::servo_dead_time));
  EXPECT_DOUBLE_EQ(v.rotors[2].position.y(), given.rotors[2].position.y() - value(P::com_y));

  // Residuals are those of the noise: [m/s^2] and [rad/s^2] of windows of 20 samples.
  EXPECT_LT(found.force_residual_rms, 0.03);
  EXPECT_LT(found.angular_acceleration_residual_rms, 0.5);
  EXPECT_GT(found.duration, 15.0);
  ASSERT_FALSE(found.samples.empty());
  double squares = 0.0;
  for (const IdentificationSample& s : found.samples)
    squares += (s.specific_force - s.fitted_specific_force).squaredNorm() / 3.0;
  EXPECT_NEAR(std::sqrt(squares / static_cast<double>(found.samples.size())),
              found.force_residual_rms, 0.2 * found.force_residual_rms);
}

TEST(IdentifyVehicle, TrustedThrustGivesTheMassAndMotionTheLagOfTheRotors) {
  VehicleLog<4> log = record(16.0, true, 2);
  log.rotor_speeds.clear();
  VehicleIdentificationSettings settings;
  settings.trusted = TrustedScale::thrust_coefficient;
  const Vehicle<4> given = tilt_ropter_vehicle(), truth = real_vehicle();
  const auto found = identify_vehicle(log, given, settings);
  ASSERT_EQ(found.status, Status::identified);
  EXPECT_NEAR(found.vehicle.body.mass, given.body.mass / 0.95, 0.01 * given.body.mass);
  EXPECT_EQ(found.vehicle.rotor.thrust_coefficient, given.rotor.thrust_coefficient);
  expect_found(found, P::rotor_time_constant, truth.rotor.time_constant, 0.1);
}

TEST(IdentifyVehicle, SaysWhatAHoverDoesNotExcite) {
  const Vehicle<4> given = tilt_ropter_vehicle();
  const auto found = identify_vehicle(record(8.0, false, 3), given);
  ASSERT_EQ(found.status, Status::identified);
  EXPECT_TRUE(found[P::thrust_per_mass].excited);
  for (const P p : {P::inertia_x, P::inertia_z, P::servo_time_constant}) {
    EXPECT_FALSE(found[p].excited) << to_string(p);
    EXPECT_GT(found[p].half_width, 0.0) << to_string(p);
  }
  EXPECT_EQ(found[P::servo_time_constant].value, given.servo.time_constant);
  EXPECT_EQ(found.vehicle.servo.time_constant, given.servo.time_constant);
}

// Units, axes, order of the rotors and times that are wrong do not give a vehicle.
TEST(IdentifyVehicle, LogsThatLieAreNotIdentified) {
  const VehicleLog<4> good = record(8.0, true, 6);
  const auto with = [&good](const auto& lie) {
    VehicleLog<4> log = good;
    lie(log);
    return identify_vehicle(log, tilt_ropter_vehicle()).status;
  };
  EXPECT_EQ(with([](VehicleLog<4>&) {}), Status::identified);
  EXPECT_NE(with([](VehicleLog<4>& log) {
              for (auto& s : log.imu) s.time *= 1e3;
              for (auto& s : log.poses) s.time *= 1e3;
              for (auto& s : log.commands) s.time *= 1e3;
              for (auto& s : log.rotor_speeds) s.time *= 1e3;
            }),
            Status::identified);
  const auto scale = [](double rate, double force) {
    return [rate, force](VehicleLog<4>& log) {
      for (auto& s : log.imu) {
        s.value.angular_velocity *= rate;
        s.value.specific_force *= force;
      }
    };
  };
  EXPECT_EQ(with(scale(1.0, 1.0 / gravity)), Status::implausible);
  EXPECT_NE(with(scale(180.0 / pi, 1.0)), Status::identified);
  EXPECT_EQ(with(scale(1.0, -1.0)), Status::does_not_fit);
  const auto exchange = [](int a, int b) {
    return [a, b](VehicleLog<4>& log) {
      for (auto& s : log.commands) std::swap(s.value.rotor_speed(a), s.value.rotor_speed(b));
      for (auto& s : log.rotor_speeds) std::swap(s.value(a), s.value(b));
    };
  };
  EXPECT_EQ(with(exchange(0, 1)), Status::does_not_fit);
  EXPECT_EQ(with(exchange(0, 2)), Status::does_not_fit);
  EXPECT_EQ(with([](VehicleLog<4>& log) {
              for (auto& s : log.commands) s.time += 0.05;
            }),
            Status::commands_late);
}

TEST(IdentifyVehicle, BadLogsHaveAStatus) {
  const VehicleLog<4> good = record(6.0, false, 4);
  const auto status = [](const VehicleLog<4>& log) {
    return identify_vehicle(log, tilt_ropter_vehicle()).status;
  };
  VehicleLog<4> log = good;
  log.imu[7].time = log.imu[6].time;
  EXPECT_EQ(status(log), Status::bad_log);
  log = good;
  log.commands.resize(1);
  EXPECT_EQ(status(log), Status::no_commands);
  log = good;
  log.imu.resize(99);
  EXPECT_EQ(status(log), Status::no_commands);
  EXPECT_EQ(status(record(4.0, false, 5)), Status::too_short);
  EXPECT_STREQ(to_string(P::count), "unknown");
  EXPECT_STREQ(to_string(P::arm_moment), "arm_moment");
}

}  // namespace vehicle_identification_test
}  // namespace tilt_ropter
