#pragma once

#include <tilt_ropter/control/nmpc_settings.hpp>

#include <limits>

namespace test_support {

/// Returns settings for a loop in which time stands still while the controller computes. They have
/// no time limit unless one is set, so the flight does not depend on other work of the machine.
inline tilt_ropter::NmpcSettings in_simulated_time(tilt_ropter::NmpcSettings settings = {}) {
  if (settings.time_limit == 0.0) settings.time_limit = std::numeric_limits<double>::infinity();
  return settings;
}

}  // namespace test_support
