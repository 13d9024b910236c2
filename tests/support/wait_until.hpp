#pragma once

#include <chrono>
#include <thread>

namespace test_support {

/// Waits until `ready()` returns true, for `longest`. Returns whether it did. The default is far
/// longer than any event takes on a busy machine, so that only a missing event fails a test.
template <typename Ready>
bool wait_until(const Ready& ready,
                std::chrono::steady_clock::duration longest = std::chrono::minutes(4)) {
  for (const auto end = std::chrono::steady_clock::now() + longest; !ready();) {
    if (std::chrono::steady_clock::now() > end) return false;
    std::this_thread::sleep_for(std::chrono::microseconds(200));
  }
  return true;
}

}  // namespace test_support
