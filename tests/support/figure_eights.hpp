#pragma once

#include <tilt_ropter/planning/figure_eight.hpp>

#include <algorithm>
#include <random>
#include <vector>

namespace test_support {

using tilt_ropter::FigureEightSettings;
using tilt_ropter::HeadingMode;

inline FigureEightSettings ground_parameters() {
  FigureEightSettings p;
  p.center.z() = 0.11;
  p.amplitude << 2.0, 0.6, 0.0;
  p.heading = HeadingMode::along_velocity;
  return p;
}

/// Random shapes, places, ramps and limits over the whole allowed range.
inline FigureEightSettings random_parameters(std::mt19937& generator) {
  const auto uniform = [&generator](double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(generator);
  };
  FigureEightSettings p;
  p.center << uniform(-5, 5), uniform(-5, 5), uniform(0, 5);
  p.amplitude << uniform(0.2, 5), 0.0, uniform(-2, 2);
  p.amplitude.y() = p.amplitude.x() * uniform(0.05, 2.0);
  p.direction = uniform(-4, 4);
  p.laps = std::uniform_int_distribution<int>(1, 3)(generator);
  p.ramp_laps = uniform(0.05, std::min(1.0, 0.5 * p.laps));
  p.max_speed = uniform(0.3, 3);
  p.max_acceleration = uniform(0.3, 5);
  p.max_yaw_rate = uniform(0.3, 3);
  p.heading = uniform(0, 1) < 0.5 ? HeadingMode::fixed : HeadingMode::along_velocity;
  p.yaw = uniform(-4, 4);
  return p;
}

/// Shapes at the limits of the allowed range, both heading modes, and the defaults.
inline std::vector<FigureEightSettings> cases() {
  std::vector<FigureEightSettings> all{FigureEightSettings{}, ground_parameters()};
  for (const double ratio : {0.05, 2.0})
    for (const double ramp : {0.05, 0.5}) {
      FigureEightSettings p = ground_parameters();
      p.amplitude << 1.0, ratio, 0.3;
      p.laps = 1;
      p.ramp_laps = ramp;
      all.push_back(p);
    }
  std::mt19937 generator(1);
  for (int i = 0; i < 20; ++i) all.push_back(random_parameters(generator));
  return all;
}

}  // namespace test_support
