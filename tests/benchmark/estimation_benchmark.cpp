// The wrench observer at 1 kHz.

#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <benchmark/benchmark.h>

#include <Eigen/Core>

namespace {

using namespace tilt_ropter;

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const Wrench<> applied{Eigen::Vector3d(0.0, 0.0, 14.7), Eigen::Vector3d(0.01, 0.0, 0.0)};
const Eigen::Vector3d specific_force(0.1, -0.2, 9.7);

void update(benchmark::State& state, WrenchObserver<>& observer) {
  Eigen::Vector3d angular_velocity(0.1, 0.2, 0.3);
  double time = 0.0;
  for (auto _ : state) {
    time += 1e-3;
    angular_velocity.x() = -angular_velocity.x();
    benchmark::DoNotOptimize(observer.update(time, specific_force, angular_velocity, applied));
    benchmark::DoNotOptimize(observer.external());
  }
}

void observer_update(benchmark::State& state) {
  WrenchObserver<> observer(vehicle.body);
  update(state, observer);
}

BENCHMARK(observer_update);

}  // namespace
