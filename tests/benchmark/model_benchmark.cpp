// The model, the plant, and a plain dense Riccati pass as a measure of the machine's speed.

#include "dense_riccati.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/benchmark_problem.hpp"

#include <benchmark/benchmark.h>

#include <Eigen/Core>

namespace {

using namespace tilt_ropter;

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const RigidBodyd body(vehicle.body);
const Wrenchd external{Eigen::Vector3d(0.1, -0.2, 0.3), Eigen::Vector3d(0.01, 0.02, -0.03)};

RigidBodyd::WrenchRate wrench_rate() {
  RigidBodyd::WrenchRate u;
  u << 1.0, -2.0, 3.0, 0.1, -0.2, 0.3;
  return u;
}

void rigid_body_step(benchmark::State& state) {
  Stated x = test_support::step_start();
  const auto u = wrench_rate();
  for (auto _ : state) {
    benchmark::DoNotOptimize(x);
    benchmark::DoNotOptimize(body.step(x, u, external, 0.1));
  }
}

void rigid_body_step_with_sensitivity(benchmark::State& state) {
  Stated x = test_support::step_start();
  const auto u = wrench_rate();
  RigidBodyd::StateJacobian A;
  RigidBodyd::InputJacobian B;
  for (auto _ : state) {
    benchmark::DoNotOptimize(x);
    benchmark::DoNotOptimize(body.step(x, u, external, 0.1, {}, A, B));
    benchmark::DoNotOptimize(A);
    benchmark::DoNotOptimize(B);
  }
}

ActuatorState<4> hovering() {
  ActuatorState<4> state;
  state.rotor_speed.setConstant(
      speed_from_thrust(vehicle.body.mass * gravity / 4.0, vehicle.rotor));
  return state;
}

void allocate(benchmark::State& state, const Wrenchd& wanted, AllocationStatus expected) {
  const Allocation<4> allocation(vehicle);
  const ActuatorState<4> last = hovering();
  Wrenchd input = wanted;
  AllocationResult<4> result;
  for (auto _ : state) {
    benchmark::DoNotOptimize(input);
    result = allocation.allocate(input, last);
    benchmark::DoNotOptimize(result);
  }
  if (result.status != expected) state.SkipWithError("not the case that was meant");
}

void servo_update(benchmark::State& state) {
  Servod servo(vehicle.servo);
  double time = 0.0, command = 0.5;
  for (auto _ : state) {
    time += 1e-3;
    command = -command;
    benchmark::DoNotOptimize(servo.update(time, command));
  }
}

/// Allocation with commands that lead the actuators, as in a control loop.
void allocate_moving(benchmark::State& state) {
  const Allocation<4> allocation(vehicle);
  Wrenchd input{Eigen::Vector3d(0.0, 0.0, 14.7), Eigen::Vector3d(0.1, -0.1, 0.05)};
  const AllocationResult<4> sent = allocation.allocate(0.0, input, {}, {});
  const Wrenchd rate{Eigen::Vector3d(1.0, -2.0, 3.0), Eigen::Vector3d(0.1, -0.2, 0.3)};
  for (auto _ : state) {
    benchmark::DoNotOptimize(input);
    benchmark::DoNotOptimize(allocation.allocate(0.01, input, rate, sent));
  }
}

void actuator_model_update(benchmark::State& state) {
  ActuatorModel<4> model(vehicle);
  ActuatorState<4> command = hovering();
  command.tilt_angle.setConstant(0.5);
  double time = 0.0;
  for (auto _ : state) {
    time += 1e-3;
    command.rotor_speed = -(command.rotor_speed.array() - 3000.0);
    command.tilt_angle = -command.tilt_angle;
    benchmark::DoNotOptimize(model.update(time, command));
  }
}

/// Steps of 1 ms. The plant returns to `start` after 0.5 s of simulated time.
void plant_step(benchmark::State& state, const PlantState<4>& start,
                const ActuatorState<4>& command) {
  Plant<4> plant(vehicle);
  plant.reset(start);
  for (auto _ : state) {
    if (plant.time() > 0.5) plant.reset(start);
    if (!plant.step(command, {}, 1e-3)) state.SkipWithError("the plant rejected a step");
  }
}

void plant_step_in_hover(benchmark::State& state) {
  PlantState<4> start;
  start.body.position.z() = 2.0;
  start.actuators = hovering();
  plant_step(state, start, hovering());
}

void plant_step_on_wheels(benchmark::State& state) {
  PlantState<4> start;
  start.body.position.z() = Plant<4>(vehicle).standing_height();
  plant_step(state, start, {});
}

void dense_riccati_pass(benchmark::State& state) {
  benchmarks::DenseRiccati riccati;
  for (auto _ : state) {
    benchmark::DoNotOptimize(riccati);
    benchmark::DoNotOptimize(riccati.pass());
  }
}

const Eigen::Vector3d weight(0.0, 0.0, 14.7);

BENCHMARK(rigid_body_step);
BENCHMARK(rigid_body_step_with_sensitivity);
BENCHMARK_CAPTURE(allocate, free, {weight, Eigen::Vector3d(0.1, -0.1, 0.05)}, AllocationStatus::ok);
BENCHMARK_CAPTURE(allocate, limited, {3.0 * weight, Eigen::Vector3d(1.0, -1.0, 0.5)},
                  AllocationStatus::limited);
BENCHMARK(allocate_moving);
BENCHMARK(servo_update);
BENCHMARK(actuator_model_update);
BENCHMARK(plant_step_in_hover);
BENCHMARK(plant_step_on_wheels);
BENCHMARK(dense_riccati_pass);

}  // namespace
