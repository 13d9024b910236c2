#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <fuzzer/FuzzedDataProvider.h>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <string>

/// What the fuzz targets share: numbers out of the fuzzer's bytes, and what counts as a finding.
namespace fuzz {

/// Ends the program, which is a finding, unless `ok`.
inline void expect(bool ok, const char* what) {
  if (ok) return;
  std::fprintf(stderr, "finding: not so: %s\n", what);
  std::abort();
}

/// False if `construct` refuses by std::invalid_argument; any other exception is a finding.
template <typename Construct>
[[nodiscard]] bool accepted(const Construct& construct) {
  try {
    construct();
  } catch (const std::invalid_argument&) {
    return false;
  }
  return true;
}

class Input {
 public:
  Input(const std::uint8_t* bytes, std::size_t size) : bytes_(bytes, size) {}

  [[nodiscard]] bool empty() { return bytes_.remaining_bytes() == 0; }
  bool coin() { return bytes_.ConsumeBool(); }
  int integer(int lowest, int highest) { return bytes_.ConsumeIntegralInRange(lowest, highest); }
  std::string text(std::size_t longest) { return bytes_.ConsumeRandomLengthString(longest); }
  std::string rest() { return bytes_.ConsumeRemainingBytesAsString(); }

  double uniform(double lowest, double highest) {
    return bytes_.ConsumeFloatingPointInRange(lowest, highest);
  }

  /// Usually within [-usual, usual]; else one that nobody should send, or any bits at all.
  double number(double usual) {
    constexpr double infinite = std::numeric_limits<double>::infinity();
    constexpr std::array<double, 16> nasty = {std::numeric_limits<double>::quiet_NaN(),
                                              infinite,
                                              -infinite,
                                              0.0,
                                              -0.0,
                                              5e-324,
                                              1e-300,
                                              1e300,
                                              -1e300,
                                              std::numeric_limits<double>::max(),
                                              1e9,
                                              1e6,
                                              -1e6,
                                              1e-9,
                                              1.0,
                                              -1.0};
    const auto kind = bytes_.ConsumeIntegral<std::uint8_t>();
    if (kind < nasty.size()) return nasty[kind];
    return kind < 24 ? bits() : uniform(-usual, usual);
  }

  /// A setting or parameter: most often left as it is.
  void vary(double& value) {
    const auto kind = bytes_.ConsumeIntegral<std::uint8_t>();
    if (kind < 16)
      value = number(1.0);
    else if (kind < 64)
      value *= uniform(0.0, 3.0);
  }
  void vary(int& value) {
    if (bytes_.ConsumeIntegral<std::uint8_t>() < 32) value = bytes_.ConsumeIntegral<int>();
  }
  void vary(bool& value) { value = value != (bytes_.ConsumeIntegral<std::uint8_t>() < 64); }
  template <typename Derived>
  void vary(Eigen::MatrixBase<Derived>& values) {
    for (Eigen::Index i = 0; i < values.size(); ++i) vary(values(i));
  }
  template <typename... Values>
  void vary_all(Values&... values) {
    (vary(values), ...);
  }

  Eigen::Vector3d vector(double usual) {
    const double x = number(usual), y = number(usual);
    return {x, y, number(usual)};
  }
  tilt_ropter::Wrenchd wrench(double force, double torque) {
    const Eigen::Vector3d f = vector(force);
    return {f, vector(torque)};
  }
  /// Usually a rotation.
  Eigen::Quaterniond orientation() {
    const double w = number(1.0);
    const Eigen::Vector3d v = vector(1.0);
    const Eigen::Quaterniond q(w, v.x(), v.y(), v.z());
    return integer(0, 7) == 0 ? q : q.normalized();
  }

 private:
  double bits() {
    const auto bits = bytes_.ConsumeIntegral<std::uint64_t>();
    double value = 0.0;
    static_assert(sizeof value == sizeof bits);
    std::memcpy(&value, &bits, sizeof value);
    return value;
  }

  FuzzedDataProvider bytes_;
};

}  // namespace fuzz
