#pragma once

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cmath>

namespace test_support {

// A level circle at constant speed, heading along world x.
struct LevelCircle {
  double radius = 4.0, speed = 2.0;  // [m], [m/s]

  [[nodiscard]] tilt_ropter::BodyStated body(double t) const {
    const double w = speed / radius;
    tilt_ropter::BodyStated b;
    b.position << radius * std::sin(w * t), -radius * std::cos(w * t), 1.5;
    b.velocity << speed * std::cos(w * t), speed * std::sin(w * t), 0.0;
    return b;
  }
  [[nodiscard]] Eigen::Vector3d specific_force(double t) const {
    const double w = speed / radius;
    return {-speed * w * std::sin(w * t), speed * w * std::cos(w * t), tilt_ropter::gravity};
  }
};

}  // namespace test_support
