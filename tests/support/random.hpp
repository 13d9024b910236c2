#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <random>

namespace test_support {

/// Seeded random numbers for tests.
class Random {
 public:
  explicit Random(unsigned seed) : engine_(seed) {}

  double uniform(double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(engine_);
  }
  double normal(double deviation) {
    // The deviation of std::normal_distribution must not be zero, so it is not passed on.
    return deviation * std::normal_distribution<double>()(engine_);
  }
  /// Entries uniform in [-size, size].
  Eigen::Vector3d vector(double size) {
    const double x = uniform(-size, size), y = uniform(-size, size);
    return {x, y, uniform(-size, size)};
  }
  /// Uniform over all orientations.
  Eigen::Quaterniond orientation() {
    const double w = normal(1.0), x = normal(1.0), y = normal(1.0);
    return Eigen::Quaterniond(w, x, y, normal(1.0)).normalized();
  }

 private:
  std::mt19937_64 engine_;
};

}  // namespace test_support
