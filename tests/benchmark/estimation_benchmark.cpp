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

void observer_update_with_everything(benchmark::State& state) {
  WrenchObserverSettings settings;
  settings.force_dead_band.setConstant(0.1);
  settings.torque_dead_band.setConstant(0.01);
  settings.force_limit.setConstant(10.0);
  settings.torque_limit.setConstant(1.0);
  WrenchObserver<> observer(vehicle.body, settings);
  observer.set_offset({Eigen::Vector3d(0.1, 0.1, 0.1), Eigen::Vector3d(0.01, 0.01, 0.01)});
  observer.begin_calibration();
  update(state, observer);
}

BENCHMARK(observer_update);
BENCHMARK(observer_update_with_everything);

}  // namespace
