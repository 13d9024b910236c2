// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>

#include <Eigen/Core>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>

/// Checks of parameters and settings at construction. A failed check throws std::invalid_argument.
/// The message names the field, its value and the allowed values. A check that passes does not
/// allocate. Without exceptions (-fno-exceptions) a failed check prints the message to stderr and
/// calls abort().
namespace tilt_ropter {

namespace detail {

/// Builds the message and throws. This code exists only once to keep every check short.
[[noreturn, gnu::noinline, gnu::cold]] inline void refuse(std::string_view field,
                                                          std::string_view value,
                                                          std::string_view allowed) {
  std::string message(field);
  message.append(" = ").append(value).append(": must be ").append(allowed);
#if defined(__cpp_exceptions)
  throw std::invalid_argument(message);
#else
  std::fputs(("tilt_ropter: " + message + "\n").c_str(), stderr);
  std::abort();
#endif
}

/// Returns a number or a text as text; a floating-point number with `digits` digits. Streams would
/// add 170 kB to a program for a microcontroller.
template <typename Value>
[[nodiscard, gnu::noinline, gnu::cold]] std::string printed(const Value& value, int digits = 9) {
  if constexpr (std::is_floating_point_v<Value>) {
    char text[40];
    std::snprintf(text, sizeof text, "%.*g", digits, static_cast<double>(value));
    return text;
  } else if constexpr (std::is_integral_v<Value>) {
    return std::to_string(value);
  } else {
    return std::string(value);
  }
}
/// Returns a matrix as one line of text. Eigen's own printing would double the compile time of this
/// header.
template <typename Value>
[[nodiscard, gnu::noinline, gnu::cold]] std::string printed_matrix(const Value& value) {
  std::string text;
  const char* before = "(";
  for (Eigen::Index i = 0; i < value.rows(); ++i)
    for (Eigen::Index j = 0; j < value.cols(); ++j) {
      text += before + printed(value.coeff(i, j));
      before = j + 1 < value.cols() || value.cols() == 1 ? ", " : "; ";
    }
  return text + ")";
}

}  // namespace detail

/// Throws std::invalid_argument("`field` = `value`: must be `allowed`") unless `ok`. `value` is
/// a number, a text, or a vector or matrix, which is printed in one line.
template <typename Value>
void require(bool ok, std::string_view field, const Value& value, std::string_view allowed) {
  if (ok) return;
  if constexpr (std::is_base_of_v<Eigen::EigenBase<Value>, Value>)
    detail::refuse(field, detail::printed_matrix(value), allowed);
  else
    detail::refuse(field, detail::printed(value), allowed);
}

inline void require_finite(std::string_view field, double value) {
  require(std::isfinite(value), field, value, "finite");
}

inline void require_positive(std::string_view field, double value) {
  require(std::isfinite(value) && value > 0.0, field, value, "finite and > 0");
}

inline void require_non_negative(std::string_view field, double value) {
  require(std::isfinite(value) && value >= 0.0, field, value, "finite and >= 0");
}

inline void require_in(std::string_view field, double value, double low, double high) {
  if (value >= low && value <= high) return;
  detail::refuse(field, detail::printed(value),
                 "in [" + detail::printed(low, 6) + ", " + detail::printed(high, 6) + "]");
}

/// Calls validate(value), which throws for wrong values, and returns `value`. For the member
/// initialisers of constructors.
template <typename Checked>
[[nodiscard]] const Checked& validated(const Checked& value) {
  validate(value);
  return value;
}

/// Requires a time [s] of any clock within 1e10 s (300 years) of its zero. In this range a double
/// resolves 2 us.
inline void require_time(std::string_view field, double value) {
  require_in(field, value, -1e10, 1e10);
}

namespace detail {

/// Returns true if `condition` holds for every entry. Every program that uses a parameter compiles
/// this code. Eigen's reductions would take longer to compile.
template <typename Derived, typename Condition>
[[nodiscard]] bool all_entries(const Eigen::MatrixBase<Derived>& value,
                               const Condition& condition) {
  for (Eigen::Index j = 0; j < value.cols(); ++j)
    for (Eigen::Index i = 0; i < value.rows(); ++i)
      if (!condition(value(i, j))) return false;
  return true;
}

}  // namespace detail

template <typename Derived>
void require_finite(std::string_view field, const Eigen::MatrixBase<Derived>& value) {
  require(all_finite(value), field, value.derived(), "finite in every entry");
}

template <typename Derived>
void require_non_negative(std::string_view field, const Eigen::MatrixBase<Derived>& value) {
  require(detail::all_entries(value, [](const auto& x) { return std::isfinite(x) && x >= 0; }),
          field, value.derived(), "finite and >= 0 in every entry");
}

template <typename Derived>
void require_positive(std::string_view field, const Eigen::MatrixBase<Derived>& value) {
  require(detail::all_entries(value, [](const auto& x) { return std::isfinite(x) && x > 0; }),
          field, value.derived(), "finite and > 0 in every entry");
}

/// Infinite entries are allowed, NaN is not.
template <typename Derived>
void require_positive_or_infinite(std::string_view field, const Eigen::MatrixBase<Derived>& value) {
  require(detail::all_entries(value, [](const auto& x) { return x > 0; }), field, value.derived(),
          "> 0 in every entry");
}

/// Requires lower <= upper entry by entry. Infinite entries are allowed, NaN is not.
template <typename Lower, typename Upper>
void require_ordered(std::string_view field, const Eigen::MatrixBase<Lower>& lower,
                     const Eigen::MatrixBase<Upper>& upper) {
  bool ordered = true;
  for (Eigen::Index j = 0; j < lower.cols(); ++j)
    for (Eigen::Index i = 0; i < lower.rows(); ++i) ordered = ordered && lower(i, j) <= upper(i, j);
  if (!ordered)
    require(false, std::string(field) + " lower bound", lower.derived(),
            "<= the upper bound in every entry");
}

/// Requires the inertia [kg m^2] of a possible rigid body: symmetric, positive definite, and no
/// principal moment larger than the sum of the two others. The last condition is equivalent to a
/// positive semi-definite tr(I) / 2 - I, the second moment of the mass.
inline void require_inertia(std::string_view field, const Eigen::Matrix3d& inertia) {
  require_finite(field, inertia);
  double size = 0.0, asymmetry = 0.0;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      size = std::fmax(size, std::abs(inertia(i, j)));
      asymmetry = std::fmax(asymmetry, std::abs(inertia(i, j) - inertia(j, i)));
    }
  require(size >= 1e-12 && size <= 1e9, field, inertia, "of 1e-12 to 1e9 kg m^2");
  require(asymmetry <= 1e-9 * size, field, inertia, "symmetric");
  // Tests the leading minors (Sylvester). Every header of the model includes this code. An
  // eigenvalue decomposition would take the largest part of the header's compile time.
  const double xy = inertia(0, 1) / size, xz = inertia(0, 2) / size, yz = inertia(1, 2) / size;
  const auto positive = [=](double xx, double yy, double zz, double sign) {
    const double minor = xx * yy - xy * xy;
    return xx > 0.0 && minor > 0.0 &&
           minor * zz - xx * yz * yz - yy * xz * xz + 2.0 * sign * xy * xz * yz > 0.0;
  };
  const double xx = inertia(0, 0) / size, yy = inertia(1, 1) / size, zz = inertia(2, 2) / size;
  const double half = 0.5 * (xx + yy + zz) + 5e-10;  // rounded up to accept a flat plate
  require(positive(xx, yy, zz, 1.0) && positive(half - xx, half - yy, half - zz, -1.0), field,
          inertia,
          "positive definite with principal moments that obey the triangle inequality [kg m^2]");
}

}  // namespace tilt_ropter
