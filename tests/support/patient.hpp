#pragma once

#include <tilt_ropter/optimal_control/solve_report.hpp>

namespace test_support {

/// Settings of a solver whose clock has no say in the result: where nothing is optimised, or under
/// sanitizers, a solve can take longer than the default's second.
inline tilt_ropter::SolverSettings patient() {
  tilt_ropter::SolverSettings settings;
  settings.max_time = 600.0;
  return settings;
}

}  // namespace test_support
