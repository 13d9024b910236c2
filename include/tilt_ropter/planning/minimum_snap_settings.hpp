// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/planning/figure_eight.hpp>

#include <Eigen/Core>

#include <cstddef>
#include <string>
#include <vector>

namespace tilt_ropter {

/// Path with the least integral of squared snap through its points (D. Mellinger and V. Kumar,
/// "Minimum snap trajectory generation and control for quadrotors", 2011). Speed and acceleration
/// at both ends are given; the jerk there is zero.
struct MinimumSnapSettings {
  /// Start, way-points and end: 2 to 100 positions of the CoM, world frame [m]. At least 1 cm
  /// apart, except two points with a given duration.
  std::vector<Eigen::Vector3d> points;
  Eigen::Vector3d start_velocity = Eigen::Vector3d::Zero();      ///< world frame [m/s]
  Eigen::Vector3d end_velocity = Eigen::Vector3d::Zero();        ///< world frame [m/s]
  Eigen::Vector3d start_acceleration = Eigen::Vector3d::Zero();  ///< world frame [m/s^2]
  Eigen::Vector3d end_acceleration = Eigen::Vector3d::Zero();    ///< world frame [m/s^2]
  double max_speed = 1.5;                                        ///< limit [m/s]
  double max_acceleration = 1.5;                                 ///< limit [m/s^2]
  HeadingMode heading = HeadingMode::fixed;
  double yaw = 0.0;           ///< yaw of the body, used with HeadingMode::fixed [rad]
  double max_yaw_rate = 1.5;  ///< limit with HeadingMode::along_velocity [rad/s]
  double duration = 0.0;      ///< zero: the shortest duration found within the limits [s]
  double start_time = 0.0;    ///< time at which the motion starts [s]
};

/// Throws std::invalid_argument with the field, its value and the allowed values.
inline void validate(const MinimumSnapSettings& p) {
  require(p.points.size() >= 2 && p.points.size() <= 100, "MinimumSnapSettings.points.size()",
          p.points.size(), "in [2, 100]");
  for (std::size_t i = 0; i < p.points.size(); ++i) {
    const std::string name = "MinimumSnapSettings.points[" + std::to_string(i) + "]";
    require_finite(name + " [m]", p.points[i]);
    if (i == 0) continue;
    const double distance = (p.points[i] - p.points[i - 1]).norm();
    const bool stays = p.points.size() == 2 && p.duration > 0.0;
    require_in(name + " distance from the point before it [m]", distance, stays ? 0.0 : 0.01, 1e4);
  }
  require_positive("MinimumSnapSettings.max_speed [m/s]", p.max_speed);
  require_positive("MinimumSnapSettings.max_acceleration [m/s^2]", p.max_acceleration);
  const auto require_below = [](const std::string& name, const Eigen::Vector3d& x, double limit) {
    require_finite(name, x);
    require(x.norm() <= limit, name + " norm", x.norm(), "<= " + std::to_string(limit));
  };
  require_below("MinimumSnapSettings.start_velocity [m/s]", p.start_velocity, p.max_speed);
  require_below("MinimumSnapSettings.end_velocity [m/s]", p.end_velocity, p.max_speed);
  require_below("MinimumSnapSettings.start_acceleration [m/s^2]", p.start_acceleration,
                p.max_acceleration);
  require_below("MinimumSnapSettings.end_acceleration [m/s^2]", p.end_acceleration,
                p.max_acceleration);
  require_finite("MinimumSnapSettings.yaw [rad]", p.yaw);
  require_positive("MinimumSnapSettings.max_yaw_rate [rad/s]", p.max_yaw_rate);
  require_in("MinimumSnapSettings.duration [s]", p.duration, 0.0, 1e10);
  require_time("MinimumSnapSettings.start_time [s]", p.start_time);
}

}  // namespace tilt_ropter
