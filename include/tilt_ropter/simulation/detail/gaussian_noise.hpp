// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <Eigen/Core>

#include <cmath>
#include <cstdint>
#include <random>

namespace tilt_ropter {

/// White Gaussian noise by Marsaglia's polar method. The results of std::normal_distribution differ
/// between standard libraries.
class GaussianNoise {
 public:
  explicit GaussianNoise(std::uint64_t seed) : generator_(seed) {}

  /// Returns a sample with zero mean and unit variance.
  [[nodiscard]] double draw() noexcept {
    if (has_spare_) {
      has_spare_ = false;
      return spare_;
    }
    double u = 0.0, v = 0.0, square = 0.0;
    do {
      u = uniform();
      v = uniform();
      square = u * u + v * v;
    } while (square >= 1.0 || square <= 0.0);
    const double scale = std::sqrt(-2.0 * std::log(square) / square);
    spare_ = scale * v;
    has_spare_ = true;
    return scale * u;
  }

  /// Returns `Size` independent samples with standard deviation `stddev`.
  template <int Size>
  [[nodiscard]] Eigen::Matrix<double, Size, 1> draw(double stddev) noexcept {
    Eigen::Matrix<double, Size, 1> sample;
    for (int i = 0; i < Size; ++i) sample(i) = stddev * draw();
    return sample;
  }

 private:
  /// Uniform sample in [-1, 1) with 53 random bits.
  double uniform() noexcept { return static_cast<double>(generator_() >> 11U) * 0x1.0p-52 - 1.0; }

  std::mt19937_64 generator_;
  double spare_ = 0.0;
  bool has_spare_ = false;
};

}  // namespace tilt_ropter
