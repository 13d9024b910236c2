// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/detail/timing.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

/// The figure eight in the air and on the ground (paper, Sec. Real-World Experiments).
namespace tilt_ropter {

/// Heading of body x: a fixed yaw, or the level direction of motion, because wheels do not slip.
enum class HeadingMode { fixed, along_velocity };

/// Lemniscate of Gerono, p = center + Rz(direction) (a_x sin s, a_y sin 2s, a_z sin s). The motion
/// starts at rest at the crossing (s = 0), covers `laps` eights and ends there at rest, or passes
/// the crossing with its full speed (starts_moving, ends_moving). The default amplitude is an
/// estimate because the paper gives no size. With this amplitude, the motion reaches both limits of
/// the paper (speed and acceleration) to 1 %. With HeadingMode::along_velocity, the yaw rate limits
/// the speed on this small eight to 1.2 m/s; the amplitude (2.0, 0.6, 0) m allows 1.5 m/s.
struct FigureEightSettings {
  Eigen::Vector3d center = Eigen::Vector3d::Zero();  ///< position of the crossing, world frame [m]
  Eigen::Vector3d amplitude{1.5, 0.5, 0.5};  ///< half extents: along, across, up (0: level) [m]
  double direction = 0.0;                    ///< angle of the long axis about world z [rad]
  int laps = 2;                              ///< number of whole eights
  double ramp_laps = 0.25;        ///< path length of the start ramp and of the end ramp [laps]
  bool starts_moving = false;     ///< without a start ramp
  bool ends_moving = false;       ///< without an end ramp
  double max_speed = 1.5;         ///< limit (paper, Sec. Aerial Flight) [m/s]
  double max_acceleration = 1.5;  ///< limit (paper, Sec. Aerial Flight) [m/s^2]
  HeadingMode heading = HeadingMode::fixed;
  double yaw = 0.0;           ///< yaw of the body, used with HeadingMode::fixed [rad]
  double max_yaw_rate = 1.5;  ///< limit along_velocity (paper, Tab. NMPC Parameters) [rad/s]
};

inline void validate(const FigureEightSettings& p) {
  require_finite("FigureEightSettings.center [m]", p.center);
  const Eigen::Vector3d& a = p.amplitude;
  require_in("FigureEightSettings.amplitude.x [m]", a.x(), 0.01, 1e4);
  require(a.y() >= 0.05 * a.x() && a.y() <= 2.0 * a.x(), "FigureEightSettings.amplitude.y [m]",
          a.y(), "between 0.05 and 2 times amplitude.x");
  require_in("FigureEightSettings.amplitude.z [m]", a.z(), -1e4, 1e4);
  require_finite("FigureEightSettings.direction [rad]", p.direction);
  require(p.laps >= 1, "FigureEightSettings.laps", p.laps, ">= 1");
  require(p.ramp_laps >= 0.05 && p.ramp_laps <= std::min(1.0, 0.5 * p.laps),
          "FigureEightSettings.ramp_laps", p.ramp_laps,
          ">= 0.05, <= 1 and no more than half of laps");
  require_positive("FigureEightSettings.max_speed [m/s]", p.max_speed);
  require_positive("FigureEightSettings.max_acceleration [m/s^2]", p.max_acceleration);
  require_finite("FigureEightSettings.yaw [rad]", p.yaw);
  require_positive("FigureEightSettings.max_yaw_rate [rad/s]", p.max_yaw_rate);
}

/// Reference along the eight. The phase s has a constant rate between a start ramp and an end ramp.
/// On the ramps the rate is a polynomial with zero slope and curvature at both ends, so the jerk is
/// continuous. The constant rate is the highest rate that keeps every limit on the whole path,
/// minus 0.01 % because the limits are checked at samples. The speed and acceleration limits apply
/// to the norms of the three-dimensional vectors.
class FigureEight : public detail::Timing {
 public:
  /// Takes about 1 ms. Throws std::invalid_argument if the settings are invalid.
  explicit FigureEight(const FigureEightSettings& settings = {}) : settings_(settings) {
    validate(settings);
    cos_direction_ = std::cos(settings.direction);
    sin_direction_ = std::sin(settings.direction);
    fixed_orientation_ = quaternion_from_yaw(settings.yaw);
    set_phase_rate(1.0);
    set_phase_rate(0.9999 * allowed_phase_rate());
    require_in("FigureEight's duration within its limits [s]", duration(), 1e-3, 1e10);
  }

  /// Returns the reference at `time` [s], for every time, see Timing. The sign of the quaternion
  /// does not jump during the motion. Does not throw or allocate.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept { return at(elapsed(time)); }

  [[nodiscard]] const FigureEightSettings& settings() const noexcept { return settings_; }

 private:
  static constexpr double one_lap = 2.0 * pi;  // phase of one lap [rad]

  struct Phase {
    double angle, rate, acceleration;
  };

  [[nodiscard]] double ramp_angle() const noexcept { return one_lap * settings_.ramp_laps; }

  void set_phase_rate(double rate) noexcept {
    phase_rate_ = rate;
    // On a ramp the mean rate is half of the constant rate.
    ramp_duration_ = 2.0 * ramp_angle() / rate;
    const int ramps = !settings_.starts_moving + !settings_.ends_moving;
    set_timing(0.0, (one_lap * settings_.laps + ramps * ramp_angle()) / rate);
  }

  /// Returns the phase rate that reaches the tightest limit. The current phase rate must be 1.
  [[nodiscard]] double allowed_phase_rate() const noexcept {
    // The end ramp mirrors the start ramp, and all laps between are equal.
    const double horizon =
        settings_.starts_moving ? duration() : std::min(0.5 * duration(), ramp_duration_ + one_lap);
    const double interval = 1e-3;
    double speed = 0.0, acceleration = 0.0, yaw_rate = 0.0;
    for (int i = 0; i * interval < horizon + interval; ++i) {
      const ReferencePoint point = at(i * interval);
      speed = std::max(speed, point.velocity.norm());
      acceleration = std::max(acceleration, point.acceleration.norm());
      yaw_rate = std::max(yaw_rate, std::abs(point.angular_velocity.z()));
    }
    double rate =
        std::min(settings_.max_speed / speed, std::sqrt(settings_.max_acceleration / acceleration));
    if (yaw_rate > 0.0) rate = std::min(rate, settings_.max_yaw_rate / yaw_rate);
    return rate;
  }

  /// Phase on the start ramp after `elapsed` [s], its rate proportional to 10 x^3 - 15 x^4 + 6 x^5.
  [[nodiscard]] Phase ramp(double elapsed) const noexcept {
    const double x = elapsed / ramp_duration_;
    const double x2 = x * x;
    return {phase_rate_ * ramp_duration_ * x2 * x2 * (2.5 + x * (x - 3.0)),
            phase_rate_ * x2 * x * (10.0 + x * (6.0 * x - 15.0)),
            phase_rate_ / ramp_duration_ * 30.0 * x2 * (1.0 - x) * (1.0 - x)};
  }

  [[nodiscard]] Phase phase(double elapsed) const noexcept {
    const double in_ramp = settings_.starts_moving ? 0.0 : ramp_duration_,
                 out_ramp = settings_.ends_moving ? 0.0 : ramp_duration_;
    if (elapsed < in_ramp) return ramp(elapsed);
    if (elapsed < duration() - out_ramp || settings_.ends_moving)
      return {(settings_.starts_moving ? 0.0 : ramp_angle()) + phase_rate_ * (elapsed - in_ramp),
              phase_rate_, 0.0};
    const Phase mirrored = ramp(duration() - elapsed);
    return {one_lap * settings_.laps - mirrored.angle, mirrored.rate, -mirrored.acceleration};
  }

  [[nodiscard]] Eigen::Vector3d to_world(const Eigen::Vector3d& v) const noexcept {
    return {cos_direction_ * v.x() - sin_direction_ * v.y(),
            sin_direction_ * v.x() + cos_direction_ * v.y(), v.z()};
  }

  [[nodiscard]] ReferencePoint at(double elapsed) const noexcept {
    const Phase s = phase(elapsed);
    const double sin_1 = std::sin(s.angle), cos_1 = std::cos(s.angle);
    const double sin_2 = 2.0 * sin_1 * cos_1, cos_2 = 1.0 - 2.0 * sin_1 * sin_1;

    // Position and its derivatives with respect to the phase, in the axes of the eight.
    const Eigen::Vector3d& a = settings_.amplitude;
    const Eigen::Vector3d path(a.x() * sin_1, a.y() * sin_2, a.z() * sin_1);
    const Eigen::Vector3d d1(a.x() * cos_1, 2.0 * a.y() * cos_2, a.z() * cos_1);
    const Eigen::Vector3d d2(-a.x() * sin_1, -4.0 * a.y() * sin_2, -a.z() * sin_1);

    ReferencePoint point;
    point.position = settings_.center + to_world(path);
    point.velocity = to_world(d1 * s.rate);
    point.acceleration = to_world(d2 * (s.rate * s.rate) + d1 * s.acceleration);
    point.orientation = fixed_orientation_;
    if (settings_.heading == HeadingMode::fixed) return point;

    // The tangent swings about the eight's -y axis by less than half a turn to either side, so its
    // angle from there never jumps. The path, unlike the velocity, has a tangent at rest, too.
    const double tangent = std::atan2(d1.x(), -d1.y()) - 0.25 * one_lap;
    point.orientation = quaternion_from_yaw(settings_.direction + tangent);
    const double cross = d1.x() * d2.y() - d1.y() * d2.x();
    const double square = d1.x() * d1.x() + d1.y() * d1.y();
    const double turn_1 = cross / square;  // first and second derivative of the tangent's angle
    const double cross_1 = -8.0 * d1.x() * a.y() * cos_2 + d1.y() * a.x() * cos_1;
    const double square_1 = 2.0 * (d1.x() * d2.x() + d1.y() * d2.y());
    const double turn_2 = (cross_1 - turn_1 * square_1) / square;
    point.angular_velocity.z() = turn_1 * s.rate;
    point.angular_acceleration.z() = turn_2 * s.rate * s.rate + turn_1 * s.acceleration;
    return point;
  }

  FigureEightSettings settings_;
  double cos_direction_ = 1.0, sin_direction_ = 0.0;
  Eigen::Quaterniond fixed_orientation_;
  double phase_rate_ = 1.0;
  double ramp_duration_ = 0.0;
};

}  // namespace tilt_ropter
