#pragma once

namespace test_support {

/// It takes mlockall from the system and always says yes, and it keeps memory that is given back.
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
