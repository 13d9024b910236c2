// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/standard.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <type_traits>

/// Packets of doubles for the processor's vector registers, selection of the instruction set at run
/// time, and Lanes, a scalar of four doubles. A program that is compiled for any x86-64 processor
/// uses AVX2 and FMA if the processor has them, and AVX-512 in Riccati passes. This makes the
/// solver's inner loops three times faster.
///
/// Packets use the vector extension of GCC and clang. No function takes or returns a packet by
/// value. Functions compiled for different instruction sets therefore have the same calling
/// convention.
namespace tilt_ropter::detail {

/// Converts a count or an index to the type of the standard containers.
[[nodiscard]] constexpr std::size_t size(std::ptrdiff_t count) {
  return static_cast<std::size_t>(count);
}

/// Packet of `Width` doubles: `aligned` is aligned to its size, `anywhere` like a double.
template <int Width>
struct PacketType {
  typedef double aligned [[gnu::vector_size(8 * Width)]];
  typedef double anywhere [[gnu::vector_size(8 * Width), gnu::aligned(8), gnu::may_alias]];
};
template <int Width>
using Packet = typename PacketType<Width>::aligned;

template <int Width>
[[gnu::always_inline]] inline void load(const double* from, Packet<Width>& packet) {
  packet = *reinterpret_cast<const typename PacketType<Width>::anywhere*>(from);
}
template <int Width>
[[gnu::always_inline]] inline void store(double* to, const Packet<Width>& packet) {
  *reinterpret_cast<typename PacketType<Width>::anywhere*>(to) = packet;
}
/// sum += factor * (packet at `from`).
template <int Width>
[[gnu::always_inline]] inline void add_product(Packet<Width>& sum, const double* from,
                                               double factor) {
  sum += *reinterpret_cast<const typename PacketType<Width>::anywhere*>(from) * factor;
}

/// The same for packets side by side, the first of them at `from` or `to`.
template <int Width, std::size_t Count>
[[gnu::always_inline]] inline void load(const double* from, Packet<Width> (&packets)[Count]) {
#pragma GCC unroll 16
  for (int t = 0; t < static_cast<int>(Count); ++t) load<Width>(from + Width * t, packets[t]);
}
template <int Width, std::size_t Count>
[[gnu::always_inline]] inline void store(double* to, const Packet<Width> (&packets)[Count]) {
#pragma GCC unroll 16
  for (int t = 0; t < static_cast<int>(Count); ++t) store<Width>(to + Width * t, packets[t]);
}
template <int Width, std::size_t Count>
[[gnu::always_inline]] inline void add_product(Packet<Width> (&sums)[Count], const double* from,
                                               double factor) {
#pragma GCC unroll 16
  for (int t = 0; t < static_cast<int>(Count); ++t)
    add_product<Width>(sums[t], from + Width * t, factor);
}

/// Returns a' b for vectors of `Count` entries, a multiple of the width.
template <int Width, int Count>
[[nodiscard, gnu::always_inline]] inline double dot(const double* a, const double* b) {
  Packet<Width> products{};
#pragma GCC unroll 16
  for (int i = 0; i < Count; i += Width) {
    Packet<Width> factor;
    load<Width>(b + i, factor);
    products += *reinterpret_cast<const typename PacketType<Width>::anywhere*>(a + i) * factor;
  }
  double sum = 0.0;
#pragma GCC unroll 8
  for (int j = 0; j < Width; ++j) sum += products[j];
  return sum;
}

/// Transposes a square matrix in place. Its columns are packets.
[[gnu::always_inline]] inline void transpose(Packet<4> (&c)[4]) {
#if defined(__clang__)
  const Packet<4> e = __builtin_shufflevector(c[0], c[1], 0, 4, 2, 6),
                  f = __builtin_shufflevector(c[0], c[1], 1, 5, 3, 7),
                  g = __builtin_shufflevector(c[2], c[3], 0, 4, 2, 6),
                  h = __builtin_shufflevector(c[2], c[3], 1, 5, 3, 7);
  c[0] = __builtin_shufflevector(e, g, 0, 1, 4, 5);
  c[1] = __builtin_shufflevector(f, h, 0, 1, 4, 5);
  c[2] = __builtin_shufflevector(e, g, 2, 3, 6, 7);
  c[3] = __builtin_shufflevector(f, h, 2, 3, 6, 7);
#else
  typedef long long Indices [[gnu::vector_size(32)]];
  const Indices even{0, 4, 2, 6}, odd{1, 5, 3, 7}, first{0, 1, 4, 5}, last{2, 3, 6, 7};
  const Packet<4> e = __builtin_shuffle(c[0], c[1], even), f = __builtin_shuffle(c[0], c[1], odd),
                  g = __builtin_shuffle(c[2], c[3], even), h = __builtin_shuffle(c[2], c[3], odd);
  c[0] = __builtin_shuffle(e, g, first);
  c[1] = __builtin_shuffle(f, h, first);
  c[2] = __builtin_shuffle(e, g, last);
  c[3] = __builtin_shuffle(f, h, last);
#endif
}

/// Checks whether all numbers passed to add() are finite. Tests the exponents, which are all ones
/// in infinity and NaN, as integers: with -ffast-math, compilers replace 0 * x by 0, even if they
/// are told that x can be NaN.
template <int Width>
struct FiniteCheck {
  static constexpr unsigned long long exponent = 0x7FF0000000000000, one = 0x0010000000000000,
                                      sign = 0x8000000000000000;
  template <int Count>  // GCC 12 ignores the attribute if it depends on the outer template
  struct BitsType {
    typedef unsigned long long type [[gnu::vector_size(8 * Count)]];
  };
  using Bits = typename BitsType<Width>::type;

  // The sign bit of an entry is set after a number that is not finite.
  Bits packets{};
  unsigned long long single = 0;

  [[gnu::always_inline]] inline void add(const Packet<Width>& numbers) {
    packets |= (reinterpret_cast<Bits>(numbers) & exponent) + one;
  }
  [[gnu::always_inline]] inline void add(double number) {
    unsigned long long bits;
    std::memcpy(&bits, &number, sizeof bits);
    single |= (bits & exponent) + one;
  }
  template <typename Index>
  [[gnu::always_inline]] inline void add(const double* numbers, Index count) {
    Index i = 0;
#pragma GCC unroll 4
    for (; i + Width <= count; i += Width) {
      Packet<Width> packet;
      load<Width>(numbers + i, packet);
      add(packet);
    }
    // Counted downwards: GCC 12 warns about a loop that counts i upwards from here to `count`.
    for (Index left = count % Width; left > 0; --left) add(numbers[count - left]);
  }
  [[gnu::always_inline]] inline bool passed() const {
    unsigned long long all = single;
#pragma GCC unroll 4
    for (int i = 0; i < Width; ++i) all |= packets[i];
    return (all & sign) == 0;
  }
};

/// Width of packets on every processor. If registers are shorter, the compiler splits a packet in
/// two. Code for a second width has to be compiled in addition: see vectorised_wide().
inline constexpr int packet_width = 4, wide_packet_width = 8;

/// Returns the size of a vector of `size` numbers that is padded to whole packets.
constexpr int padded(int size) {
  return (size + packet_width - 1) / packet_width * packet_width;
}

/// Returns body(width), compiled for the best instruction set of the processor that runs the
/// program. The argument is packet_width. All functions that `body` calls must be inlined: other
/// functions are compiled for the program's instruction set. If TILT_ROPTER_NO_DISPATCH is defined,
/// only the program's instruction set is used. Results are then bitwise identical on every
/// processor that runs the program.
#if defined(__x86_64__) && !(defined(__AVX2__) && defined(__FMA__)) && \
    !defined(TILT_ROPTER_NO_DISPATCH)
template <typename Body>
[[gnu::target("avx2,fma"), gnu::flatten]] inline auto with_avx2(const Body& body) {
  return body(std::integral_constant<int, packet_width>{});
}
/// For processors built before 2013. Compiling for size (gnu::cold) saves a tenth of a program's
/// compile time.
template <typename Body>
[[gnu::cold, gnu::flatten]] inline auto without_avx2(const Body& body) {
  return body(std::integral_constant<int, packet_width>{});
}
inline bool has_avx2() {
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
}
template <typename Body>
inline auto vectorised(const Body& body) {
  if (has_avx2()) return with_avx2(body);
  return without_avx2(body);
}
template <typename Body>
[[gnu::target("avx512f,avx2,fma"), gnu::flatten]] inline auto with_avx512(const Body& body) {
  return body(std::integral_constant<int, wide_packet_width>{});
}
/// The same for a `body` that is also compiled for wide_packet_width, for processors with AVX-512.
template <typename Body>
inline auto vectorised_wide(const Body& body) {
  if (__builtin_cpu_supports("avx512f")) return with_avx512(body);
  return vectorised(body);
}
/// For a `body` with a simpler alternative. Runs body(width) and returns true, or returns false if
/// the processor lacks AVX2 or FMA. The caller must then run the alternative.
template <typename Body>
inline bool vectorised_or_not(const Body& body) {
  if (!has_avx2()) return false;
  with_avx2(body);
  return true;
}
#else
template <typename Body>
[[gnu::flatten]] inline auto vectorised(const Body& body) {
  return body(std::integral_constant<int, packet_width>{});
}
template <typename Body>
[[gnu::flatten]] inline auto vectorised_wide(const Body& body) {
#if defined(__AVX512F__)
  return body(std::integral_constant<int, wide_packet_width>{});
#else
  return vectorised(body);
#endif
}
template <typename Body>
inline bool vectorised_or_not(const Body& body) {
  vectorised(body);
  return true;
}
#endif

/// While an object of this class exists, an x86 processor replaces subnormal numbers by zero in
/// this thread. Whatever decays becomes subnormal, such as the deviation from a plan in minutes of
/// simulation without noise, and arithmetic with such numbers takes many times as long there.
class FlushSubnormals {
 public:
  FlushSubnormals(const FlushSubnormals&) = delete;
  FlushSubnormals& operator=(const FlushSubnormals&) = delete;
#if defined(__SSE2__)
  FlushSubnormals() {
    __builtin_ia32_ldmxcsr(before_ | 0x8040);  // operands and results
  }
  ~FlushSubnormals() {
    __builtin_ia32_ldmxcsr(before_);
  }

 private:
  unsigned before_ = __builtin_ia32_stmxcsr();
#else
  FlushSubnormals() {}
  ~FlushSubnormals() {}
#endif
};

}  // namespace tilt_ropter::detail

namespace tilt_ropter {

/// Four doubles. Each arithmetic operator acts on all four. There are no comparison operators. A
/// function template on the scalar type computes four results at once with this type. On processors
/// with vector registers this takes little more time than one result.
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

  [[gnu::always_inline]] friend Lanes operator+(const Lanes& a, const Lanes& b) {
    return Lanes(a.packet + b.packet);
  }
  [[gnu::always_inline]] friend Lanes operator-(const Lanes& a, const Lanes& b) {
    return Lanes(a.packet - b.packet);
  }
  [[gnu::always_inline]] friend Lanes operator*(const Lanes& a, const Lanes& b) {
    return Lanes(a.packet * b.packet);
  }
  [[gnu::always_inline]] friend Lanes operator/(const Lanes& a, const Lanes& b) {
    return Lanes(a.packet / b.packet);
  }
  [[gnu::always_inline]] friend Lanes operator-(const Lanes& a) { return Lanes(-a.packet); }
  [[gnu::always_inline]] Lanes& operator+=(const Lanes& b) { return *this = *this + b; }
  [[gnu::always_inline]] Lanes& operator-=(const Lanes& b) { return *this = *this - b; }
  [[gnu::always_inline]] Lanes& operator*=(const Lanes& b) { return *this = *this * b; }
  [[gnu::always_inline]] Lanes& operator/=(const Lanes& b) { return *this = *this / b; }

  [[gnu::always_inline]] friend Lanes sqrt(const Lanes& a) {
    return {std::sqrt(a[0]), std::sqrt(a[1]), std::sqrt(a[2]), std::sqrt(a[3])};
  }
  [[gnu::always_inline]] friend Lanes sin(const Lanes& a) {
    return {std::sin(a[0]), std::sin(a[1]), std::sin(a[2]), std::sin(a[3])};
  }
  [[gnu::always_inline]] friend Lanes cos(const Lanes& a) {
    return {std::cos(a[0]), std::cos(a[1]), std::cos(a[2]), std::cos(a[3])};
  }
};

/// Returns Lanes whose lane i is function(i).
template <typename Function>
[[gnu::always_inline]] inline Lanes gather(const Function& function) {
  return {function(0), function(1), function(2), function(3)};
}
/// The same for vectors and matrices of equal size, coefficient by coefficient, into `result`, from
/// function(0) to function(count - 1), 1 <= count <= 4. The other lanes repeat the last of them.
template <typename Result, typename Function>
[[gnu::always_inline]] inline void gather_into(Result& result, int count,
                                               const Function& function) {
  for (Eigen::Index i = 0; i < result.size(); ++i)
    result.coeffRef(i) = gather([&](int lane) __attribute__((always_inline)) {
      return function(std::min(lane, count - 1)).coeff(i);
    });
}
/// The inverse for one lane: copies it from a vector or matrix of Lanes.
template <typename From, typename To>
[[gnu::always_inline]] inline void scatter(const From& from, int lane, To& to) {
  for (Eigen::Index i = 0; i < to.size(); ++i) to.coeffRef(i) = from.coeff(i)[lane];
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
