// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/standard.hpp>

/// Time that goes back.
namespace tilt_ropter {

/// Returns true if `time` [s] is more than 0.1 s before the `last` time of the same caller. The
/// clock was then set back, or a simulation has begun again. A smaller difference is a late call:
/// measurements reach a loop with different delays. False for NaN.
[[nodiscard]] inline bool clock_was_set_back(double time, double last) noexcept {
  return last - time > 0.1;
}

}  // namespace tilt_ropter
