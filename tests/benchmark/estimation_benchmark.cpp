// The wrench observer, the failure detector and the state estimator with an IMU at 1 kHz.

#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "support/flights.hpp"

#include <benchmark/benchmark.h>

#include <Eigen/Core>

#include <chrono>
#include <cstddef>
#include <vector>

namespace {

using namespace tilt_ropter;

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const Wrenchd applied{Eigen::Vector3d(0.0, 0.0, 14.7), Eigen::Vector3d(0.01, 0.0, 0.0)};
const Eigen::Vector3d specific_force(0.1, -0.2, 9.7);

void update(benchmark::State& state, WrenchObserverd& observer) {
  Eigen::Vector3d angular_velocity(0.1, 0.2, 0.3);
  double time = 0.0;
  for (auto _ : state) {
    time += 1e-3;
    angular_velocity.x() = -angular_velocity.x();
    benchmark::DoNotOptimize(observer.update(time, {angular_velocity, specific_force}, applied));
    benchmark::DoNotOptimize(observer.external());
  }
}

void observer_update(benchmark::State& state) {
  WrenchObserverd observer(vehicle.body);
  update(state, observer);
}

void observer_update_with_everything(benchmark::State& state) {
  WrenchObserverSettings settings;
  settings.force_dead_band.setConstant(0.1);
  settings.torque_dead_band.setConstant(0.01);
  settings.force_limit.setConstant(10.0);
  settings.torque_limit.setConstant(1.0);
  WrenchObserverd observer(vehicle.body, settings);
  observer.set_offset({Eigen::Vector3d(0.1, 0.1, 0.1), Eigen::Vector3d(0.01, 0.01, 0.01)});
  observer.begin_calibration();
  update(state, observer);
}

BENCHMARK(observer_update);
BENCHMARK(observer_update_with_everything);

void failure_detector_update(benchmark::State& state) {
  FailureDetector<4> detector(vehicle);
  ActuatorState<4> actuators;
  actuators.rotor_speed.setConstant(
      speed_from_thrust(0.25 * vehicle.body.mass * gravity, vehicle.rotor));
  double time = 0.0;
  for (auto _ : state) {
    time += 1e-3;
    actuators.tilt_angle(0) = -actuators.tilt_angle(0) + 0.1;
    benchmark::DoNotOptimize(detector.update(time, {Eigen::Vector3d(0.1, 0.2, 0.3), specific_force},
                                             actuators, actuators.rotor_speed, true));
  }
  if (detector.failure().kind != FailureKind::none) state.SkipWithError("it has found a failure");
}

BENCHMARK(failure_detector_update);

// Measurements of ten seconds of a flight.
struct Log {
  Log() {
    const test_support::Flight flight(1);
    for (int i = 0; i <= 10000; ++i) {
      imu.push_back(flight.imu(1e-3 * i));
      poses.push_back(flight.pose(1e-3 * i));
    }
  }
  std::vector<InertialSampled> imu;
  std::vector<MarkerPosed> poses;
};

const Log& log() {
  static const Log flight;
  return flight;
}

// Settings with which the marker frame is estimated, too.
EkfSettings settings() {
  EkfSettings s;
  s.marker_position_stddev = 0.01;
  s.marker_orientation_stddev = 0.02;
  return s;
}

ErrorStateFilterd started_filter() {
  ErrorStateFilterd filter(settings().imu_noise, settings().pose_noise);
  filter.reset({}, ErrorStateFilterd::Covariance::Identity() * 1e-4);
  return filter;
}

void filter_predict(benchmark::State& state) {
  ErrorStateFilterd filter = started_filter();
  InertialSampled sample = log().imu.front();
  for (auto _ : state) {
    benchmark::DoNotOptimize(sample);
    filter.predict(sample, 1e-9);  // short, to keep the covariance in range
    benchmark::DoNotOptimize(filter);
  }
}

void filter_innovation_and_update(benchmark::State& state) {
  const ErrorStateFilterd before = started_filter();
  MarkerPosed pose;
  pose.position.x() = 1e-3;
  for (auto _ : state) {
    ErrorStateFilterd filter = before;  // about 30 ns
    benchmark::DoNotOptimize(pose);
    filter.update(pose);
    benchmark::DoNotOptimize(filter);
  }
}

template <typename Function>
double seconds(const Function& function) {
  const auto start = std::chrono::steady_clock::now();
  function();
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

// Repeats ten IMU samples and one pose that is `delay` samples late. Times the mean IMU sample if
// `Imu` is true, else the pose.
template <bool Imu>
void ekf(benchmark::State& state) {
  const auto delay = static_cast<std::size_t>(state.range(0));
  Ekfd filter(settings());
  std::size_t i = 0;
  for (auto _ : state) {
    if (i + 10 >= log().imu.size()) {
      filter.reset();
      i = 0;
    }
    const double imu = seconds([&] {
      for (int k = 0; k < 10; ++k, ++i)
        benchmark::DoNotOptimize(filter.on_imu(1e-3 * static_cast<double>(i), log().imu[i]));
    });
    const std::size_t j = i - 1 - (i > delay ? delay : 0);
    const double pose = seconds([&] {
      benchmark::DoNotOptimize(filter.on_pose(1e-3 * static_cast<double>(j), log().poses[j]));
    });
    state.SetIterationTime(Imu ? imu / 10.0 : pose);
  }
  if (!filter.running()) state.SkipWithError("not the case that was meant");
}

void ekf_on_imu(benchmark::State& state) {
  ekf<true>(state);
}

void ekf_on_pose(benchmark::State& state) {
  ekf<false>(state);
}

BENCHMARK(filter_predict);
BENCHMARK(filter_innovation_and_update);
BENCHMARK(ekf_on_imu)->ArgName("delay_ms")->Arg(0)->Arg(20)->UseManualTime();
BENCHMARK(ekf_on_pose)->ArgName("delay_ms")->Arg(0)->Arg(20)->UseManualTime();

}  // namespace
