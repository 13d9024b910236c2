#pragma once

#include <tilt_ropter/control/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

/// The benchmark optimal-control problem with known optima, on which solvers are compared: STEP, a
/// cold solve far from the reference, and AIR, a closed loop at 50 Hz along a figure eight.
namespace test_support {

using tilt_ropter::BodyState;
using tilt_ropter::State;
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

/// STEP: hover at (0, 0, 1.5) from a displaced, turned and moving start; wide bounds.
inline WheeledFlightProblem<> step_problem(const WheeledFlightSettings& settings = {}) {
  WheeledFlightProblem<> problem(benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.node(k).reference.position << 0.0, 0.0, 1.5;
    problem.node(k).wrench_reference.force = benchmark_hover_force();
  }
  return problem;
}

inline State<> step_start() {
  const double degree = tilt_ropter::pi / 180.0;
  State<> x;
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

/// AIR: bounds of the paper's table.
inline WheeledFlightProblem<> air_problem() {
  WheeledFlightSettings settings;
  settings.bounds = tilt_ropter::paper_bounds();
  return WheeledFlightProblem<>(benchmark_body(), settings);
}

inline void set_air_reference(WheeledFlightProblem<>& problem, double time) {
  for (int k = 0; k <= problem.horizon(); ++k) {
    const double t = time + 0.1 * k;
    problem.node(k).reference.position = air_position(t);
    problem.node(k).reference.velocity = air_velocity(t);
    problem.node(k).wrench_reference.force = benchmark_hover_force();
  }
}

inline State<> air_start() {
  State<> x;
  x.wrench.force = benchmark_hover_force();
  x.body.position = air_position(0.0);
  x.body.velocity = air_velocity(0.0);
  return x;
}

/// The plant of AIR: the same equations in fine steps and a force that the controller does not
/// know.
inline State<> air_plant(const State<>& start, const Eigen::Matrix<double, 6, 1>& u) {
  static const tilt_ropter::RigidBody<> body(benchmark_body());
  const tilt_ropter::Wrench<> unknown{Eigen::Vector3d(0.15, -0.10, 0.20), Eigen::Vector3d::Zero()};
  State<> x = start;
  for (int i = 0; i < 4; ++i) x = body.step(x, u, unknown, 0.005);
  return x;
}

}  // namespace test_support
