#pragma once

namespace test_support {

/// True if the program is compiled with AddressSanitizer. The sanitizer replaces mlockall with a
/// function that always succeeds, and it does not return freed memory.
constexpr bool under_address_sanitizer() {
#if defined(__SANITIZE_ADDRESS__)
  return true;
#elif defined(__has_feature)
  return __has_feature(address_sanitizer);
#else
  return false;
#endif
}

}  // namespace test_support
