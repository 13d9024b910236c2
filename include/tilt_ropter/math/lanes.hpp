// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/packet.hpp>

#include <Eigen/Core>

#include <cmath>

/// Four numbers side by side as one scalar: a function that is a template on its scalar does four
/// times the work in little more than the time, where processors have registers for that.
namespace tilt_ropter {

/// Has the operators of a number, each of them on all four. There is no comparison.
struct Lanes {
  static constexpr int count = 4;

  // At any address, since Eigen aligns to less where registers are taken to be short.
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

/// Lane i is function(i).
template <typename Function>
[[gnu::always_inline]] inline Lanes gather(const Function& function) {
  return {function(0), function(1), function(2), function(3)};
}
/// The same for vectors and matrices of one size, coefficient by coefficient.
template <typename Result, typename Function>
[[gnu::always_inline]] inline void gather_into(Result& result, const Function& function) {
  for (Eigen::Index j = 0; j < result.cols(); ++j)
    for (Eigen::Index i = 0; i < result.rows(); ++i)
      result(i, j) = gather([&](int lane) { return function(lane)(i, j); });
}

}  // namespace tilt_ropter

namespace Eigen {
template <>
struct NumTraits<tilt_ropter::Lanes> : NumTraits<double> {
  using Real = tilt_ropter::Lanes;
  using NonInteger = tilt_ropter::Lanes;
  using Nested = tilt_ropter::Lanes;
  using Literal = double;
};
}  // namespace Eigen
