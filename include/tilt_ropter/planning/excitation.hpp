// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/detail/timing.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>

/// Motion that excites all axes, for the identification of a vehicle from one flight.
namespace tilt_ropter {

/// Place, length and size of an Excitation.
struct ExcitationSettings {
  Waypoint center;                    ///< start, end and centre of the motion
  double duration = 18.0;             ///< from rest to rest [s]
  double ramp = 2.0;                  ///< time in which the motion grows, and fades [s]
  double acceleration = 0.48;         ///< largest acceleration of each sine [m/s^2]
  double angular_acceleration = 4.5;  ///< largest second derivative of each angle sine [rad/s^2]
  static constexpr double max_distance = 0.15;  ///< largest amplitude of each sine [m]
  double max_angle = 0.12;                      ///< largest amplitude of each angle sine [rad]
};

inline void validate(const ExcitationSettings& p) {
  validate(p.center, "ExcitationSettings.center");
  require_in("ExcitationSettings.duration [s]", p.duration, 1e-3, 1e10);
  require(p.ramp >= 1e-3 && p.ramp <= 0.5 * p.duration, "ExcitationSettings.ramp [s]", p.ramp,
          "in [0.001, duration / 2]");
  require_non_negative("ExcitationSettings.acceleration [m/s^2]", p.acceleration);
  require_non_negative("ExcitationSettings.angular_acceleration [rad/s^2]", p.angular_acceleration);
  require_in("ExcitationSettings.max_angle [rad]", p.max_angle, 1e-6, 0.3);
}

/// Sum of three sines in each of x, y, z, roll, pitch and yaw, all with different frequencies
/// between 0.35 and 2.9 Hz: axes move at once, and can be told from each other. Position and angles
/// are `center` plus envelope times sines. The envelope rises from 0 to 1 and falls to 0, along
/// s(x) of Transition. The body rotates by yaw, pitch and roll about its own z, y and x axis.
class Excitation : public detail::Timing {
 public:
  /// Throws std::invalid_argument if the settings are invalid.
  explicit Excitation(const ExcitationSettings& settings = {}) : settings_(settings) {
    validate(settings);
    set_timing(0.0, settings.duration);
  }

  /// Returns the reference at `time` [s], for every time, see Timing. Does not throw or allocate.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept {
    double value[6], rate[6], second[6];
    for (std::size_t axis = 0; axis < 6; ++axis)
      axis_at(axis, elapsed(time), value[axis], rate[axis], second[axis]);

    ReferencePoint point;
    point.position = settings_.center.position + Eigen::Vector3d(value[0], value[1], value[2]);
    point.velocity << rate[0], rate[1], rate[2];
    point.acceleration << second[0], second[1], second[2];
    const double sr = std::sin(value[3]), cr = std::cos(value[3]);
    const double sp = std::sin(value[4]), cp = std::cos(value[4]);
    const Eigen::Quaterniond pitch(std::cos(0.5 * value[4]), 0.0, std::sin(0.5 * value[4]), 0.0);
    const Eigen::Quaterniond roll(std::cos(0.5 * value[3]), std::sin(0.5 * value[3]), 0.0, 0.0);
    point.orientation = quaternion_from_yaw(settings_.center.yaw + value[5]) * pitch * roll;
    const double r1 = rate[3], p1 = rate[4], y1 = rate[5];
    const double r2 = second[3], p2 = second[4], y2 = second[5];
    point.angular_velocity << r1 - y1 * sp, p1 * cr + y1 * cp * sr, y1 * cp * cr - p1 * sr;
    point.angular_acceleration << r2 - y2 * sp - y1 * p1 * cp,
        p2 * cr - p1 * r1 * sr + y2 * cp * sr + y1 * (r1 * cp * cr - p1 * sp * sr),
        y2 * cp * cr - y1 * (p1 * sp * cr + r1 * cp * sr) - p2 * sr - p1 * r1 * cr;
    return point;
  }

 private:
  /// Value and first two derivatives of one axis: x, y, z [m], roll, pitch, yaw [rad].
  void axis_at(std::size_t axis, double elapsed, double& value, double& rate,
               double& second) const noexcept {
    constexpr double frequencies[6][3] = {{0.35, 1.10, 2.30}, {0.43, 1.27, 2.60},
                                          {0.55, 1.45, 2.90}, {0.70, 1.60, 2.45},
                                          {0.80, 1.75, 2.75}, {0.50, 1.35, 2.15}};
    const bool turns = axis >= 3;
    const double most = turns ? settings_.angular_acceleration : settings_.acceleration;
    const double widest = turns ? settings_.max_angle : settings_.max_distance;
    double sum = 0.0, sum_1 = 0.0, sum_2 = 0.0;
    for (std::size_t i = 0; i < 3; ++i) {
      const double w = 2.0 * pi * frequencies[axis][i];
      const double amplitude = std::min(most / (w * w), widest);
      const double phase = w * elapsed + 2.0 * static_cast<double>(i) + static_cast<double>(axis);
      sum += amplitude * std::sin(phase);
      sum_1 += amplitude * w * std::cos(phase);
      sum_2 -= amplitude * w * w * std::sin(phase);
    }
    const bool rises = elapsed < 0.5 * settings_.duration;
    const double x =
        std::clamp((rises ? elapsed : settings_.duration - elapsed) / settings_.ramp, 0.0, 1.0);
    const double hump = x * (1.0 - x), direction = rises ? 1.0 : -1.0;
    const double e = x * x * x * x * (35.0 - x * (84.0 - x * (70.0 - x * 20.0)));
    const double e_1 = direction * 140.0 * hump * hump * hump / settings_.ramp;
    const double e_2 = 420.0 * hump * hump * (1.0 - 2.0 * x) / (settings_.ramp * settings_.ramp);
    value = e * sum;
    rate = e_1 * sum + e * sum_1;
    second = e_2 * sum + 2.0 * e_1 * sum_1 + e * sum_2;
  }

  ExcitationSettings settings_;
};

}  // namespace tilt_ropter
