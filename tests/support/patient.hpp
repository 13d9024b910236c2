#pragma once

#include <tilt_ropter/optimal_control/solver_settings.hpp>

namespace test_support {

/// Settings of a solver without influence of the clock on the result. Without compiler optimisation
/// or under sanitizers, a solve can take longer than the default limit of one second.
inline tilt_ropter::optimal_control::SolverSettings patient() {
  tilt_ropter::optimal_control::SolverSettings settings;
  settings.max_time = 600.0;
  return settings;
}

}  // namespace test_support
