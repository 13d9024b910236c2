#pragma once

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <CLI/CLI.hpp>

#include <map>
#include <ostream>
#include <stdexcept>
#include <string>

/// What solves the problem of each tick, as chosen, and who solved it, as counted.
namespace examples {

/// The values of --solver that are methods of MultipleShooting.
[[nodiscard]] inline const std::map<std::string, tilt_ropter::optimal_control::ProgramMethod>&
program_methods() {
  using Method = tilt_ropter::optimal_control::ProgramMethod;
  static const std::map<std::string, Method> methods{{"automatic", Method::automatic},
                                                     {"nlopt", Method::nlopt},
                                                     {"structured", Method::structured}};
  return methods;
}

/// The value of --solver with which NLopt solves the whole problem, without quadratic programs.
inline constexpr const char* nlopt_alone = "nlopt_alone";

/// Adds the option --solver to `app`; parsing fills `solver`.
inline CLI::Option* add_solver_in_real_time(CLI::App& app, std::string& solver) {
  return app
      .add_option("--solver", solver,
                  "what solves the quadratic program of a tick if constraints are active: NLopt up "
                  "to 16 of them, otherwise methods that use its structure (automatic); NLopt "
                  "(nlopt); or these methods (structured)")
      ->check(CLI::IsMember(program_methods()))
      ->capture_default_str();
}

/// The same, with a choice that is too slow for real time.
inline void add_solver(CLI::App& app, std::string& solver) {
  app.add_option("--solver", solver,
                 "what solves the quadratic program of a tick if constraints are active: NLopt up "
                 "to 16 of them, otherwise methods that use its structure (automatic); NLopt "
                 "(nlopt); or these methods (structured). nlopt_alone: NLopt's SLSQP solves the "
                 "whole problem instead, at the wrench level, in milliseconds to seconds per tick")
      ->check(CLI::IsMember({"automatic", "nlopt", "structured", nlopt_alone}))
      ->capture_default_str();
}

/// Sets the method of `solver`. NLopt alone needs another controller, see FlightController.
inline void set_solver(const std::string& solver,
                       tilt_ropter::optimal_control::SolverSettings& settings) {
  const auto found = program_methods().find(solver);
  if (found != program_methods().end()) settings.program.method = found->second;
}

/// Throws std::invalid_argument if `solver` is NLopt alone, which there is at the wrench level
/// only.
inline void require_no_nlopt_alone(const std::string& solver) {
  if (solver == nlopt_alone)
    throw std::invalid_argument(
        "--solver nlopt_alone flies at the wrench level only; allowed at the actuator level: "
        "automatic, nlopt, structured");
}

/// Numbers of ticks by what solved them.
struct SolverTicks {
  long active = 0;                              ///< with active constraints
  long riccati = 0, nlopt = 0, structured = 0;  ///< solved by
  long unsolved = 0;                            ///< without the status `solved`

  void add(tilt_ropter::NmpcStatus status,
           const tilt_ropter::optimal_control::SolveReport& report) {
    using tilt_ropter::optimal_control::ProgramSolver;
    if (status != tilt_ropter::NmpcStatus::solved) ++unsolved;
    if (!has_plan(status)) return;
    if (report.active_constraints > 0) ++active;
    switch (report.solved_by) {
      case ProgramSolver::riccati:
        ++riccati;
        break;
      case ProgramSolver::nlopt:
        ++nlopt;
        break;
      case ProgramSolver::active_set:
      case ProgramSolver::interior_point:
        ++structured;
        break;
    }
  }

  void add(const SolverTicks& other) {
    active += other.active;
    riccati += other.riccati;
    nlopt += other.nlopt;
    structured += other.structured;
    unsolved += other.unsolved;
  }

  /// Prints lines "key: value", with `prefix` before each key.
  void print(std::ostream& out, const std::string& prefix = "") const {
    out << prefix << "active_ticks: " << active << '\n'
        << prefix << "riccati_ticks: " << riccati << '\n'
        << prefix << "nlopt_ticks: " << nlopt << '\n'
        << prefix << "structured_ticks: " << structured << '\n'
        << prefix << "unsolved_ticks: " << unsolved << '\n';
  }
};

}  // namespace examples
