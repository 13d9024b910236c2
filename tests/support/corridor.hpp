#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include "support/random.hpp"

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

namespace test_support {

/// A bent corridor with a square cross-section, and a reference that moves through it at constant
/// speed, cuts its corners and runs into its walls there.
class Corridor {
 public:
  /// `clearance` [m]: from the CoM in the middle of the corridor, for the vehicle, to a touch.
  Corridor(Random& random, double clearance) : clearance_(clearance) {
    speed_ = random.uniform(0.3, 0.8);
    double heading = random.uniform(-tilt_ropter::pi, tilt_ropter::pi);
    corners_.push_back(Eigen::Vector3d(0.0, 0.0, 3.0));
    const int legs = 3 + static_cast<int>(random.uniform(0.0, 3.0));
    for (int i = 0; i < legs; ++i) {
      const double length = random.uniform(1.0, 2.5), slope = random.uniform(-0.3, 0.3),
                   turn = random.uniform(0.3, 1.6);
      corners_.push_back(corners_.back() +
                         length * Eigen::Vector3d(std::cos(slope) * std::cos(heading),
                                                  std::cos(slope) * std::sin(heading),
                                                  std::sin(slope)));
      heading += random.uniform(-1.0, 1.0) > 0.0 ? turn : -turn;
      duration_ += length / speed_;
    }
    aside_ = random.uniform(-2.0, 2.0) * clearance;
  }

  [[nodiscard]] double duration() const { return duration_; }  ///< [s]
  [[nodiscard]] double speed() const { return speed_; }        ///< [m/s]

  [[nodiscard]] tilt_ropter::ReferencePoint operator()(double time) const {
    constexpr double half = 0.3;  // of a moving mean, by which a planner smooths corners [s]
    tilt_ropter::ReferencePoint point;
    constexpr int samples = 20;
    for (int i = 0; i < samples; ++i)
      point.position += at(time + half * (2.0 * (i + 0.5) / samples - 1.0)) / samples;
    point.velocity = (at(time + half) - at(time - half)) / (2.0 * half);
    // Aside of the middle, up to twice the clearance, in the middle of the way.
    const double u = std::clamp(time / duration_, 0.0, 1.0);
    const Eigen::Vector3d side = across(time)[0];
    point.position += aside_ * std::sin(tilt_ropter::pi * u) * side;
    point.inside = walls(leg(time));
    return point;
  }

  /// Returns how far `position` is outside of the corridor [m]. Next to a corner it may be in
  /// either leg.
  [[nodiscard]] double beyond(double time, const Eigen::Vector3d& position) const {
    constexpr double node = 0.05;  // the controller's time between two half-spaces [s]
    double least = std::numeric_limits<double>::infinity();
    for (double t : {time - node, time, time + node}) {
      double most = 0.0;
      for (const tilt_ropter::HalfSpace& h : walls(leg(t)))
        most = std::max(most, h.beyond(position));
      least = std::min(least, most);
    }
    return least;
  }

 private:
  // The leg of this time, and how far it has been flown [m].
  struct Place {
    std::size_t leg;
    double along;
  };
  [[nodiscard]] Place place(double time) const {
    double left = std::clamp(time, 0.0, duration_) * speed_;
    std::size_t i = 0;
    while (i + 2 < corners_.size() && left > (corners_[i + 1] - corners_[i]).norm())
      left -= (corners_[i + 1] - corners_[i]).norm(), ++i;
    return {i, left};
  }
  [[nodiscard]] std::size_t leg(double time) const { return place(time).leg; }
  [[nodiscard]] Eigen::Vector3d direction(std::size_t i) const {
    return (corners_[i + 1] - corners_[i]).normalized();
  }
  [[nodiscard]] Eigen::Vector3d at(double time) const {
    const Place p = place(time);
    return corners_[p.leg] + p.along * direction(p.leg);
  }
  [[nodiscard]] std::array<Eigen::Vector3d, 2> across(double time) const {
    return across_leg(leg(time));
  }
  [[nodiscard]] std::array<Eigen::Vector3d, 2> across_leg(std::size_t i) const {
    const Eigen::Vector3d along = direction(i),
                          side = Eigen::Vector3d(-along.y(), along.x(), 0.0).normalized();
    return {side, along.cross(side)};
  }
  [[nodiscard]] std::array<tilt_ropter::HalfSpace, 4> walls(std::size_t i) const {
    std::array<tilt_ropter::HalfSpace, 4> all;
    for (std::size_t j = 0; j < 4; ++j) {
      const Eigen::Vector3d inward = (j % 2 == 0 ? 1.0 : -1.0) * across_leg(i)[j / 2];
      all[j] = {inward, inward.dot(corners_[i]) - clearance_};
    }
    return all;
  }

  double clearance_, speed_, duration_ = 0.0, aside_;
  std::vector<Eigen::Vector3d> corners_;
};

}  // namespace test_support
