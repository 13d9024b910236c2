#pragma once

#include <type_traits>
#include <utility>

/// Switches of the faults that tests/mutation.sh writes into its copy of the headers. The variables
/// are in a shared library of their own, so that a program and its libraries have them once.
extern "C" {
[[gnu::visibility("default")]] extern int tilt_ropter_mutant;
[[gnu::visibility("default")]] extern unsigned char* tilt_ropter_reached;
}

namespace tilt_ropter_mutation {

/// True if this fault is switched on. Notes that the program came here.
[[gnu::always_inline]] inline bool active(int number) noexcept {
  tilt_ropter_reached[number] = 1;
  return tilt_ropter_mutant == number;
}

/// The same where the compiler may evaluate the code: there every fault is off.
[[gnu::always_inline]] constexpr bool active_at_run_time(int number) noexcept {
  return !__builtin_is_constant_evaluated() && active(number);
}

/// Calls one of two functions. Eigen's expressions of different types become matrices.
template <typename Faulty, typename Original>
[[gnu::always_inline]] constexpr auto either(bool is_active, const Faulty& faulty,
                                             const Original& original) {
  using F = decltype(faulty());
  using O = decltype(original());
  if constexpr (std::is_same_v<F, O>) {
    if (is_active) return faulty();
    return original();
  } else if constexpr (std::is_arithmetic_v<F> && std::is_arithmetic_v<O>) {
    return is_active ? faulty() : original();
  } else {
    using Matrix = typename O::PlainObject;
    if (is_active) return Matrix(faulty());
    return Matrix(original());
  }
}

/// Another value of the same type.
template <typename Value>
[[nodiscard]] constexpr auto changed(const Value& value) {
  if constexpr (std::is_same_v<Value, bool>) {
    return !value;
  } else if constexpr (std::is_arithmetic_v<Value> || std::is_enum_v<Value>) {
    return value == Value{} ? static_cast<Value>(1) : Value{};
  } else {
    using Matrix = typename Value::PlainObject;
    return Matrix(-value);
  }
}

}  // namespace tilt_ropter_mutation
