#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iomanip>
#include <ostream>

/// A motion that pushes on a surface, and its figures.
namespace examples {

struct PushSettings {
  tilt_ropter::Waypoint from;                       ///< the tool is in front of the surface here
  tilt_ropter::SurfacePush push;                    ///< on what, with which point, and how hard
  double hold = 10.0;                               ///< time at the place of the touch [s]
  Eigen::Vector3d slide = Eigen::Vector3d::Zero();  ///< along the surface, world frame [m]
  double speed = 0.2;                               ///< of the slide [m/s]
};

/// Flies straight to the surface, pushes, slides, pushes for another 2 s, and flies straight back
/// by the way that it came.
class PushMotion : public tilt_ropter::detail::Timing {
 public:
  /// Throws std::invalid_argument if the settings are out of range.
  explicit PushMotion(const PushSettings& settings)
      : settings_(settings),
        touch_(settings.from.position - gap() * normal()),
        there_(way(settings.from.position, touch_ + clearance * normal())),
        back_(way(touch_ + settings.slide, settings.from.position + settings.slide)) {
    using namespace tilt_ropter;
    require(is_usable(settings.push), "PushSettings.push", settings.push.force,
            "a force > 0 on a surface with a unit normal, all finite");
    require(gap() > 2.0 * clearance, "distance of the tool from the surface [m]", gap(),
            "more than 0.06");
    require_in("PushSettings.hold [s]", settings.hold, 1.0, 1e6);
    require_in("PushSettings.speed [m/s]", settings.speed, 0.01, 1.0);
    require_finite("PushSettings.slide [m]", settings.slide);
    require(std::abs(normal().dot(settings.slide)) < 1e-6, "PushSettings.slide [m]",
            settings.slide.transpose(), "along the surface");
    const double length = settings.slide.norm();
    require(length == 0.0 || length > settings.speed * ramp, "PushSettings.slide [m]", length,
            "0, or more than the speed times one second");
    slide_time_ = length > 0.0 ? length / settings.speed + ramp : 0.0;
    set_timing(0.0, there_.duration() + settings.hold + slide_time_ + rest + back_.duration());
  }

  [[nodiscard]] tilt_ropter::ReferencePoint operator()(double time) const noexcept {
    double t = elapsed(time) - there_.duration();
    if (t < 0.0) return there_(t + there_.duration());
    const double pushes_for = settings_.hold + slide_time_ + rest;
    if (t >= pushes_for) return back_(t - pushes_for);
    tilt_ropter::ReferencePoint point;
    point.push = settings_.push;
    point.orientation = tilt_ropter::quaternion_from_yaw(settings_.from.yaw);
    point.position = touch_;
    t = std::clamp(t - settings_.hold, 0.0, slide_time_);
    if (slide_time_ == 0.0) return point;
    // The speed rises and falls within `ramp`, without a jump of the acceleration.
    const bool slows = t > 0.5 * slide_time_;
    const double u = std::min(1.0, (slows ? slide_time_ - t : t) / ramp), v = settings_.speed,
                 even = std::max(0.0, (slows ? slide_time_ - t : t) - ramp),
                 way = v * (ramp * u * u * u * (1.0 - 0.5 * u) + even);
    const Eigen::Vector3d along = settings_.slide.normalized();
    point.position += (slows ? settings_.slide.norm() - way : way) * along;
    point.velocity = v * u * u * (3.0 - 2.0 * u) * along;
    point.acceleration = (slows ? -6.0 : 6.0) * v / ramp * u * (1.0 - u) * along;
    return point;
  }

  [[nodiscard]] const PushSettings& settings() const noexcept { return settings_; }

 private:
  // The straight way ends this far from the surface [m]; of the slide, and after it [s].
  static constexpr double clearance = 0.03, ramp = 1.0, rest = 2.0;

  [[nodiscard]] const Eigen::Vector3d& normal() const { return settings_.push.surface.normal; }
  [[nodiscard]] double gap() const {
    const tilt_ropter::Surface& surface = settings_.push.surface;
    return normal().dot(settings_.from.position +
                        tilt_ropter::quaternion_from_yaw(settings_.from.yaw) * surface.tool -
                        surface.point);
  }
  [[nodiscard]] tilt_ropter::Transition way(const Eigen::Vector3d& from,
                                            const Eigen::Vector3d& to) const {
    tilt_ropter::TransitionSettings s;
    s.from = {from, settings_.from.yaw};
    s.to = {to, settings_.from.yaw};
    s.max_speed = 0.3;
    s.max_acceleration = 0.3;
    return tilt_ropter::Transition(s);
  }

  PushSettings settings_;
  Eigen::Vector3d touch_;  // of the CoM, where the tool touches
  tilt_ropter::Transition there_, back_;
  double slide_time_ = 0.0;  // [s]
};

/// Figures of a flight that pushes on a surface.
class PushFigures {
 public:
  /// Call this after each step of the plant, of 1 ms. `force`: of the surface [N].
  void on_step(double time, const tilt_ropter::ReferencePoint& reference, double force,
               const Eigen::Vector3d& position) {
    using tilt_ropter::slide_along;
    sum_ += force - forces_[steps_ % forces_.size()];
    forces_[steps_++ % forces_.size()] = force;
    if (!reference.push) {
      touched_at_ = before_touch;
      has_slid_ = false;
      return;
    }
    const double mean = sum_ / static_cast<double>(forces_.size());
    largest_ = std::max(largest_, mean);
    impact_ = std::max(impact_, force);
    if (force > 0.0 && touched_at_ < 0.0) touched_at_ = time;
    const tilt_ropter::Surface& surface = reference.push->surface;
    const bool slides = !slide_along(surface, reference.velocity).isZero(0.0);
    has_slid_ = has_slid_ || slides;
    if (!has_slid_ && touched_at_ >= 0.0 && time > touched_at_ + settling) {
      held_ += force;
      squares_ += force * force;
      ++held_steps_;
    }
    if (!slides) return;
    const Eigen::Vector3d off = position - reference.position;
    error_ = std::max(error_, (off - surface.normal.dot(off) * surface.normal).norm());
    force_error_ = std::max(force_error_, std::abs(mean - reference.push->force));
  }

  void print(std::ostream& out) const {
    const double n = static_cast<double>(std::max(1L, held_steps_)), mean = held_ / n;
    out << std::fixed << std::setprecision(3) << "force_mean_n: " << mean
        << "\nforce_stddev_n: " << std::sqrt(std::max(0.0, squares_ / n - mean * mean))
        << "\nforce_max_n: " << largest_ << "\nforce_impact_n: " << impact_ << std::setprecision(4)
        << "\nslide_error_m: " << error_ << std::setprecision(3)
        << "\nslide_force_error_n: " << force_error_ << '\n';
  }

 private:
  static constexpr double settling = 2.0, before_touch = -1.0;  // after the touch [s]
  std::array<double, 100> forces_{};                            // of the last 0.1 s [N]
  std::size_t steps_ = 0;
  long held_steps_ = 0;
  double sum_ = 0.0, largest_ = 0.0, impact_ = 0.0, held_ = 0.0, squares_ = 0.0;  // of the force
  double touched_at_ = before_touch, error_ = 0.0, force_error_ = 0.0;            // [s], [m], [N]
  bool has_slid_ = false;
};

}  // namespace examples
