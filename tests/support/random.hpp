#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <random>

namespace test_support {

/// Seeded random numbers for tests. The numbers of the standard's distributions differ between
/// standard libraries; these do not, so that a test has the same input everywhere.
class Random {
 public:
  explicit Random(unsigned seed) : engine_(seed) {}

  double uniform(double low, double high) { return low + (high - low) * fraction(); }
  /// By Marsaglia's polar method.
  double normal(double stddev) {
    double u = 0.0, square = 0.0;
    do {
      const double v = 2.0 * fraction() - 1.0;
      u = 2.0 * fraction() - 1.0;
      square = u * u + v * v;
    } while (square > 1.0 || square == 0.0);
    return stddev * (u * std::sqrt(-2.0 * std::log(square) / square));
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
  /// Uniform in [0, 1].
  double fraction() { return static_cast<double>(engine_()) * 0x1.0p-64; }

  std::mt19937_64 engine_;
};

}  // namespace test_support
