// Every limit of the solvers' settings, by the name in the message.

#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

namespace tilt_ropter::optimal_control {
namespace solver_settings_test {

using namespace test_support;

TEST(SolverSettings, QuadraticProgramNamesEachField) {
  using S = QuadraticProgramSettings;
  const Fields<S> check;
  check("QuadraticProgramSettings.tolerance", &S::tolerance, positive());
  check("QuadraticProgramSettings.max_dual_constraints", &S::max_dual_constraints,
        whole_numbers(0, 1000));
  check("QuadraticProgramSettings.max_passes", &S::max_passes, at_least(1));
}

TEST(SolverSettings, SolverNamesEachField) {
  using S = SolverSettings;
  const Fields<S> check;
  check("SolverSettings.max_iterations", &S::max_iterations, at_least(1));
  check("SolverSettings.max_time [s]", &S::max_time, positive());
  check("SolverSettings.max_feedback_time [s]", &S::max_feedback_time,
        {{1e-300, 1000.0, infinite}, {0.0, -1.0, above(1000.0), -infinite, not_a_number}});
  check("SolverSettings.tolerance", &S::tolerance, positive());
  check("SolverSettings.memory", &S::memory, whole_numbers(0, 100));
  check.refuse("QuadraticProgramSettings.max_passes", [](S& s) { s.program.max_passes = 0; });
}

}  // namespace solver_settings_test
}  // namespace tilt_ropter::optimal_control
