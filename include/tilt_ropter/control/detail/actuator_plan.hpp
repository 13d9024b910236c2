// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/detail/actuated_state.hpp>
#include <tilt_ropter/control/detail/actuator_level_problem.hpp>
#include <tilt_ropter/control/detail/plan_in_force.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <Eigen/Core>

#include <algorithm>

/// Output of ActuatorNmpc, and the plan from which it comes.
namespace tilt_ropter {

/// Output of ActuatorNmpc.
template <int Rotors>
struct ActuatorNmpcResult {
  NmpcStatus status = NmpcStatus::no_plan;  ///< source of the command
  ActuatorState<Rotors> command;            ///< to send now; finite and within the limits
  /// Thrusts [N] and tilt angles [rad] of the plan at the time of the command, and their rates.
  Eigen::Matrix<double, Rotors, 1> thrust = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                   tilt_angle = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                   thrust_rate = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                   tilt_rate = Eigen::Matrix<double, Rotors, 1>::Zero();
  Wrenchd wrench;                       ///< of these thrusts and angles, body frame [N; N m]
  bool on_ground = false;               ///< contact mode
  optimal_control::SolveReport report;  ///< of the last call of the solver
};

/// The plan of ActuatorNmpc that is commanded until the next plan replaces it.
template <int Rotors>
class ActuatorPlan : public PlanTime {
 public:
  using Problem = ActuatorLevelProblem<Rotors>;
  using Solver = optimal_control::MultipleShooting<Problem>;

  /// Takes the plan that `solver` made for the measurement at `time` [s].
  void begin(const Solver& solver, double time) noexcept {
    begin_at(time);
    start_ = solver.state(0);
  }
  /// Call this after solver.reset(x).
  void reset(const ActuatedState<Rotors>& x) noexcept { start_ = x; }

  /// Thrusts and angles `age` >= 0 [s] after the measurement, linear in each interval. The body
  /// state is that of the start of the interval.
  [[nodiscard]] ActuatedState<Rotors> planned(const Solver& solver, double age) const noexcept {
    const double interval = solver.problem().settings().interval,
                 clamped = std::min(std::max(age, 0.0), interval * solver.horizon());
    const int k = interval_at(solver, clamped);
    ActuatedState<Rotors> x = k == 0 ? start_ : solver.state(k);
    const double passed = clamped - interval * k;
    for (int i = 0; i < Rotors; ++i) {
      x.thrust(i) += passed * solver.input(k)(i);
      x.tilt_angle(i) += passed * solver.input(k)(Rotors + i);
    }
    return x;
  }

  /// Rates of the plan `age` >= 0 [s] after its measurement.
  [[nodiscard]] const typename Problem::Input& rates(const Solver& solver,
                                                     double age) const noexcept {
    return solver.input(interval_at(solver, std::max(age, 0.0)));
  }

 private:
  [[nodiscard]] static int interval_at(const Solver& solver, double age) noexcept {
    const double interval = solver.problem().settings().interval;
    return static_cast<int>(std::min(age / interval, solver.horizon() - 1.0));
  }

  ActuatedState<Rotors> start_;
};

}  // namespace tilt_ropter
