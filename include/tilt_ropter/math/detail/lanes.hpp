// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/packet.hpp>

#include <Eigen/Core>

#include <cmath>

/// Scalar type that holds four doubles. A function template on the scalar type then computes four
/// results at once. On processors with vector registers this takes little more time than one
/// result.
namespace tilt_ropter {

/// Four doubles. Each arithmetic operator acts on all four. There are no comparison operators.
struct Lanes {
  static constexpr int count = 4;

  // Aligned like a double: Eigen aligns to fewer bytes if the program is compiled for shorter
  // registers.
  using Packet = detail::PacketType<count>::anywhere;
  Packet packet;

  Lanes() = default;
  [[gnu::always_inline]] Lanes(double all) : packet{all, all, all, all} {}
  [[gnu::always_inline]] Lanes(double a, double b, double c, double d) : packet{a, b, c, d} {}
  [[gnu::always_inline]] explicit Lanes(const Packet& numbers) : packet(numbers) {}

  [[gnu::always_inline]] double operator[](int i) const { return packet[i]; }

  [[gnu::always_inline]] Lanes& operator+=(const Lanes& b) {
    packet += b.packet;
    return *this;
  }
  [[gnu::always_inline]] Lanes& operator-=(const Lanes& b) {
    packet -= b.packet;
    return *this;
  }
  [[gnu::always_inline]] Lanes& operator*=(const Lanes& b) {
    packet *= b.packet;
    return *this;
  }
  [[gnu::always_inline]] Lanes& operator/=(const Lanes& b) {
    packet /= b.packet;
    return *this;
  }
};

[[gnu::always_inline]] inline Lanes operator+(const Lanes& a, const Lanes& b) {
  return Lanes(a.packet + b.packet);
}
[[gnu::always_inline]] inline Lanes operator-(const Lanes& a, const Lanes& b) {
  return Lanes(a.packet - b.packet);
}
[[gnu::always_inline]] inline Lanes operator*(const Lanes& a, const Lanes& b) {
  return Lanes(a.packet * b.packet);
}
[[gnu::always_inline]] inline Lanes operator/(const Lanes& a, const Lanes& b) {
  return Lanes(a.packet / b.packet);
}
[[gnu::always_inline]] inline Lanes operator-(const Lanes& a) {
  return Lanes(-a.packet);
}
[[gnu::always_inline]] inline Lanes sqrt(const Lanes& a) {
  return {std::sqrt(a[0]), std::sqrt(a[1]), std::sqrt(a[2]), std::sqrt(a[3])};
}
[[gnu::always_inline]] inline Lanes sin(const Lanes& a) {
  return {std::sin(a[0]), std::sin(a[1]), std::sin(a[2]), std::sin(a[3])};
}
[[gnu::always_inline]] inline Lanes cos(const Lanes& a) {
  return {std::cos(a[0]), std::cos(a[1]), std::cos(a[2]), std::cos(a[3])};
}

/// Returns Lanes whose lane i is function(i).
template <typename Function>
[[gnu::always_inline]] inline Lanes gather(const Function& function) {
  return {function(0), function(1), function(2), function(3)};
}
/// The same for vectors and matrices of equal size, coefficient by coefficient, into `result`.
template <typename Result, typename Function>
[[gnu::always_inline]] inline void gather_into(Result& result, const Function& function) {
  for (Eigen::Index j = 0; j < result.cols(); ++j)
    for (Eigen::Index i = 0; i < result.rows(); ++i)
      result(i, j) = gather([&](int lane) { return function(lane)(i, j); });
}

}  // namespace tilt_ropter

namespace Eigen {
/// Lets Eigen's matrices have entries of type Lanes.
template <>
struct NumTraits<tilt_ropter::Lanes> : NumTraits<double> {
  using Real = tilt_ropter::Lanes;
  using NonInteger = tilt_ropter::Lanes;
  using Nested = tilt_ropter::Lanes;
  using Literal = double;
};
}  // namespace Eigen
