#pragma once

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

/// The benchmark optimal-control problems with known optima, for comparing solvers. STEP is a cold
/// solve far from the reference. AIR is a closed loop at 50 Hz along a figure eight.
namespace test_support {

using tilt_ropter::BodyState;
using tilt_ropter::Stated;
using tilt_ropter::WheeledFlightProblem;
using tilt_ropter::WheeledFlightSettings;

inline tilt_ropter::RigidBodyParameters benchmark_body() {
  tilt_ropter::RigidBodyParameters body;
  body.mass = 1.5;
  body.inertia = Eigen::Vector3d(0.0137, 0.0143, 0.0246).asDiagonal();
  return body;
}

inline Eigen::Vector3d benchmark_hover_force() {
  return {0.0, 0.0, 1.5 * tilt_ropter::gravity};
}

/// Weights and wide bounds of the benchmark.
inline WheeledFlightSettings benchmark_settings() {
  WheeledFlightSettings settings;
  settings.weights.position << 60.0, 60.0, 80.0;
  settings.weights.velocity << 6.0, 6.0, 8.0;
  settings.weights.angular_velocity.setConstant(0.6);
  settings.weights.ground_thrust = 0.0;
  return settings;
}

/// STEP: hover at (0, 0, 1.5) from a displaced, rotated and moving start, with wide bounds.
inline WheeledFlightProblem<0> step_problem(
    const WheeledFlightSettings& settings = benchmark_settings()) {
  WheeledFlightProblem<0> problem(benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.node(k).reference.position << 0.0, 0.0, 1.5;
    problem.node(k).wrench_reference.force = benchmark_hover_force();
  }
  return problem;
}

inline Stated step_start() {
  const double degree = tilt_ropter::pi / 180.0;
  Stated x;
  x.wrench.force = benchmark_hover_force();
  x.body.position << 1.0, -0.8, 0.7;
  x.body.velocity << 0.5, 0.0, -0.3;
  x.body.orientation = Eigen::AngleAxisd(90.0 * degree, Eigen::Vector3d::UnitZ()) *
                       Eigen::AngleAxisd(25.0 * degree, Eigen::Vector3d::UnitX());
  x.body.angular_velocity << 0.5, -0.3, 0.2;
  return x;
}

inline Eigen::Vector3d air_position(double t) {
  return {1.6 * std::sin(0.65 * t), 0.8 * std::sin(1.3 * t), 1.5 + 0.3 * std::sin(0.65 * t)};
}

inline Eigen::Vector3d air_velocity(double t) {
  return {1.6 * 0.65 * std::cos(0.65 * t), 0.8 * 1.3 * std::cos(1.3 * t),
          0.3 * 0.65 * std::cos(0.65 * t)};
}

/// AIR: with the bounds of the paper's table.
inline WheeledFlightProblem<0> air_problem() {
  WheeledFlightSettings settings = benchmark_settings();
  settings.bounds = tilt_ropter::paper_bounds();
  return WheeledFlightProblem<0>(benchmark_body(), settings);
}

inline void set_air_reference(WheeledFlightProblem<0>& problem, double time) {
  for (int k = 0; k <= problem.horizon(); ++k) {
    const double t = time + 0.1 * k;
    problem.node(k).reference.position = air_position(t);
    problem.node(k).reference.velocity = air_velocity(t);
    problem.node(k).wrench_reference.force = benchmark_hover_force();
  }
}

inline Stated air_start() {
  Stated x;
  x.wrench.force = benchmark_hover_force();
  x.body.position = air_position(0.0);
  x.body.velocity = air_velocity(0.0);
  return x;
}

/// The plant of AIR: the same equations with finer steps and a force that the controller does not
/// know.
inline Stated air_plant(const Stated& start, const Eigen::Matrix<double, 6, 1>& u) {
  static const tilt_ropter::RigidBodyd body(benchmark_body());
  const tilt_ropter::Wrenchd unknown{Eigen::Vector3d(0.15, -0.10, 0.20), Eigen::Vector3d::Zero()};
  Stated x = start;
  for (int i = 0; i < 4; ++i) x = body.step(x, u, unknown, 0.005);
  return x;
}

}  // namespace test_support
