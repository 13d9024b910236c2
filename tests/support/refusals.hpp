#pragma once

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <cstdio>
#include <functional>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

namespace test_support {

inline constexpr double not_a_number = std::numeric_limits<double>::quiet_NaN();
inline constexpr double infinite = std::numeric_limits<double>::infinity();

/// Message of the std::invalid_argument that `call` throws, or "accepted".
inline std::string refusal(const std::function<void()>& call) {
  try {
    call();
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return "accepted";
}

inline void expect_accepted(const std::function<void()>& call) {
  EXPECT_EQ(refusal(call), "accepted");
}

/// Expects that `call` throws a message that begins with "`field` = `value`". `value` may be only
/// the beginning of the printed value.
inline void expect_refused(const std::string& field, const std::function<void()>& call,
                           const std::string& value = "") {
  const std::string text = refusal(call), start = field + " = " + value;
  EXPECT_EQ(text.rfind(start, 0), 0U) << "expected: " << start << "\nmessage: " << text;
  EXPECT_NE(text.find(": must be "), std::string::npos) << text;
}

/// Values next to the limits of a field, on both sides.
struct Range {
  std::vector<double> accepted, refused;
};

/// The next value above or below `limit` that counts as another value.
inline double above(double limit) {
  return limit == 0.0 ? 1e-12 : limit + 1e-9 * std::abs(limit);
}
inline double below(double limit) {
  return -above(-limit);
}

inline Range in_range(double low, double high) {
  return {{low, high}, {below(low), above(high), not_a_number}};
}
/// Above `low`, at most `high`.
inline Range above_up_to(double low, double high) {
  return {{above(low), high}, {low, below(low), above(high), not_a_number}};
}
inline Range whole_numbers(int low, int high) {
  return {{double(low), double(high)}, {low - 1.0, high + 1.0}};
}
inline Range at_least(int low) {
  return {{double(low), 1e9}, {low - 1.0, -1000.0}};
}
inline Range any_finite() {
  return {{-1e300, 1e300}, {not_a_number, infinite, -infinite}};
}
inline Range positive() {
  return {{1e-300, 1e300}, {0.0, -1e-300, not_a_number, infinite}};
}
inline Range not_negative() {
  return {{0.0, 1e300}, {-1e-300, not_a_number, infinite}};
}
inline Range positive_or_infinite() {
  return {{1e-300, infinite}, {0.0, -1e-300, not_a_number, -infinite}};
}

/// Expects that `check` accepts and refuses the values of `range`, and names `field` in front of
/// each refused value if it is `printed` alone.
inline void expect_range(const std::string& field, const Range& range, bool printed,
                         const std::function<void(double)>& check) {
  for (const double value : range.accepted)
    EXPECT_EQ(refusal([&] { check(value); }), "accepted") << field << ", value " << value;
  for (const double value : range.refused) {
    char text[32] = "";
    if (printed) std::snprintf(text, sizeof(text), "%.9g: must be ", value);
    expect_refused(
        field, [&] { check(value); }, text);
  }
}

/// Checks the fields of settings by validate(), one field after the other: every other field keeps
/// its value in `valid`.
template <typename Settings>
struct Fields {
  Settings valid{};

  void operator()(const char* name, double Settings::*field, const Range& range) const {
    expect_range(name, range, true, [&](double value) {
      Settings s = valid;
      s.*field = value;
      validate(s);
    });
  }
  void operator()(const char* name, int Settings::*field, const Range& range) const {
    expect_range(name, range, true, [&](double value) {
      Settings s = valid;
      s.*field = static_cast<int>(value);
      validate(s);
    });
  }
  /// Each entry of the vector.
  void operator()(const char* name, Eigen::Vector3d Settings::*field, const Range& range) const {
    for (int i = 0; i < 3; ++i)
      expect_range(name, range, false, [&](double value) {
        Settings s = valid;
        (s.*field)(i) = value;
        validate(s);
      });
  }
  void operator()(const char* name, void (*set)(Settings&, double), const Range& range) const {
    expect_range(name, range, false, [&](double value) {
      Settings s = valid;
      set(s, value);
      validate(s);
    });
  }
  /// Expects that validate() refuses `name` after `spoil`.
  void refuse(const char* name, void (*spoil)(Settings&)) const {
    expect_refused(name, [&] {
      Settings s = valid;
      spoil(s);
      validate(s);
    });
  }
};

}  // namespace test_support
