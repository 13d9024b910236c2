#pragma once

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include "support/benchmark_problem.hpp"

#include <Eigen/Core>

#include <ctime>

#include <cmath>

/// The closed loops of the benchmark's optimal-control problem, AIR and GROUND, 10 s at 50 Hz.
namespace benchmarks {

/// Processor time of this thread [us]: other programs on the machine change it less than the time.
inline double thread_us() {
  std::timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return 1e6 * static_cast<double>(now.tv_sec) + 1e-3 * static_cast<double>(now.tv_nsec);
}

using tilt_ropter::Stated;
using tilt_ropter::WheeledFlightProblem;
using Solver = tilt_ropter::optimal_control::MultipleShooting<WheeledFlightProblem<0>>;

struct Scenario {
  WheeledFlightProblem<0> problem;
  void (*set_reference)(WheeledFlightProblem<0>&, double time);
  Stated start;
  tilt_ropter::Wrenchd plant_wrench;  ///< external wrench on the true body, body frame
};

/// Figure eight in the air; a force acts that the controller does not know.
inline Scenario air(int intervals = 20,
                    const tilt_ropter::NmpcBounds& bounds = tilt_ropter::paper_bounds()) {
  tilt_ropter::WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.intervals = intervals;
  settings.bounds = bounds;
  return {WheeledFlightProblem<0>(test_support::benchmark_body(), settings),
          test_support::set_air_reference,
          test_support::air_start(),
          {Eigen::Vector3d(0.15, -0.10, 0.20), Eigen::Vector3d::Zero()}};
}

/// Figure eight on the ground, heading along the velocity. The wheels are conditions by weight and
/// a normal force that controller and plant both know; a yaw torque acts that only the plant knows.
namespace ground_data {

inline constexpr double wheel_radius = 0.12;  // [m]
inline const double weight = 1.5 * tilt_ropter::gravity;

inline tilt_ropter::BodyStated reference(double t) {
  tilt_ropter::BodyStated r;
  r.position << 1.6 * std::sin(0.5 * t), 0.8 * std::sin(t), wheel_radius;
  r.velocity << 0.8 * std::cos(0.5 * t), 0.8 * std::cos(t), 0.0;
  const Eigen::Vector2d v = r.velocity.head<2>();
  const Eigen::Vector2d a(-0.4 * std::sin(0.5 * t), -0.8 * std::sin(t));
  r.orientation = tilt_ropter::quaternion_from_yaw(std::atan2(v.y(), v.x()));
  r.angular_velocity.z() = (v.x() * a.y() - v.y() * a.x()) / v.squaredNorm();
  return r;
}

inline void set_reference(WheeledFlightProblem<0>& problem, double time) {
  for (int k = 0; k <= problem.horizon(); ++k) {
    tilt_ropter::WheeledFlightNode& node = problem.node(k);
    node.reference = reference(time + 0.1 * k);
    node.wrench_reference.force << 0.0, 0.0, 0.2 * weight;
    node.external.force << 0.0, 0.0, 0.8 * weight;
    node.on_ground = true;
    node.com_plane.height = wheel_radius;
  }
}

}  // namespace ground_data

inline Scenario ground() {
  tilt_ropter::WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.bounds = tilt_ropter::paper_bounds();
  settings.bounds.force_min.head<2>().setConstant(-3.0);
  settings.bounds.force_max.head<2>().setConstant(3.0);
  Stated start;
  start.wrench.force << 0.0, 0.0, 0.2 * ground_data::weight;
  start.body = ground_data::reference(0.0);
  return {WheeledFlightProblem<0>(test_support::benchmark_body(), settings),
          ground_data::set_reference,
          start,
          {Eigen::Vector3d(0.0, 0.0, 0.8 * ground_data::weight), Eigen::Vector3d(0.0, 0.0, 0.01)}};
}

/// Hover at a reference that steps by `metres` along x every two seconds.
template <int metres>
Scenario steps(const tilt_ropter::NmpcBounds& bounds) {
  Scenario scenario = air(20, bounds);
  scenario.set_reference = [](WheeledFlightProblem<0>& problem, double time) {
    for (int k = 0; k <= problem.horizon(); ++k) {
      tilt_ropter::WheeledFlightNode& node = problem.node(k);
      node.reference = {};
      node.reference.position << (std::fmod(time, 4.0) < 2.0 ? 0.0 : metres), 0.0, 1.0;
      node.wrench_reference.force << 0.0, 0.0, ground_data::weight;
    }
  };
  scenario.start = {};
  scenario.start.body.position.z() = 1.0;
  scenario.start.wrench.force << 0.0, 0.0, ground_data::weight;
  return scenario;
}

/// Solver and plant in a loop that starts over after its last tick.
template <typename Solver>
class BasicClosedLoop {
 public:
  static constexpr int ticks = 500;
  static constexpr double period = 0.02;  // [s]

  explicit BasicClosedLoop(const Scenario& scenario)
      : scenario_(scenario),
        plant_(test_support::benchmark_body()),
        solver_(scenario.problem, settings()) {
    restart();
  }

  /// One real-time iteration and what follows it in the plant; processor time of the former [us].
  double iterate() {
    return tick([this] {
      sound_ = solver_.prepare() == tilt_ropter::optimal_control::PrepareStatus::prepared &&
               solver_.feedback(x_).status == Status::iterated && sound_;
    });
  }

  /// The same with iterations to KKT 1e-6.
  double converge() {
    return tick([this] { sound_ = solver_.solve(x_).status == Status::converged && sound_; });
  }

  [[nodiscard]] const tilt_ropter::optimal_control::SolveReport& report() const {
    return solver_.report();
  }
  /// False after a solve that did not do as asked.
  [[nodiscard]] bool sound() const { return sound_; }
  /// Of the position, over all ticks so far [m].
  [[nodiscard]] double rmse() const { return std::sqrt(squares_ / count_); }

 private:
  using Status = tilt_ropter::optimal_control::SolveStatus;

  static tilt_ropter::optimal_control::SolverSettings settings() {
    tilt_ropter::optimal_control::SolverSettings s;
    s.max_time = 60.0;             // not what a loaded machine achieves in a second
    s.update_multipliers = false;  // the benchmark has the ground's conditions by weight alone
    return s;
  }

  void restart() {
    tick_ = 0;
    x_ = scenario_.start;
    scenario_.set_reference(solver_.problem(), 0.0);
    solver_.reset(x_);
    sound_ = solver_.solve(x_).status == Status::converged && sound_;
  }

  template <typename Control>
  double tick(const Control& control) {
    if (tick_ == ticks) restart();
    scenario_.set_reference(solver_.problem(), period * tick_);
    const double start = thread_us();
    control();
    const double us = thread_us() - start;
    for (int i = 0; i < 4; ++i)
      x_ = plant_.step(x_, solver_.input(0), scenario_.plant_wrench, period / 4);
    ++tick_;
    scenario_.set_reference(solver_.problem(), period * tick_);
    squares_ += (x_.body.position - solver_.problem().node(0).reference.position).squaredNorm();
    count_ += 1.0;
    return us;
  }

  Scenario scenario_;
  tilt_ropter::RigidBodyd plant_;
  Solver solver_;
  Stated x_;
  int tick_ = 0;
  double squares_ = 0.0, count_ = 0.0;
  bool sound_ = true;
};
using ClosedLoop = BasicClosedLoop<Solver>;

}  // namespace benchmarks
