#pragma once

#include <cstdlib>

namespace test_support {

/// True in tests/run.sh --full, which sets TILT_ROPTER_FULL.
inline bool full_run() {
  return std::getenv("TILT_ROPTER_FULL") != nullptr;
}

/// Returns `quick` in a plain run and `full` in a full run.
inline int quick_or_full(int quick, int full) {
  return full_run() ? full : quick;
}

}  // namespace test_support
