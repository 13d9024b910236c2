// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <optional>

namespace tilt_ropter::detail {

/// Tells the reaction of the surface that a reference pushes on from the disturbance: along the
/// normal, everything since the tool came near the surface is the surface's. Along the surface it
/// is friction: where the reference slides, all in the direction of the slide; at rest, as much as
/// the normal force gives. Learns the coefficient while the tool slides. Does not allocate.
class SurfaceTouch {
 public:
  explicit SurfaceTouch(double weight) : weight_(weight) {}

  /// Returns the force of the surface on the tool. `force`: the external force, `raw`: the same
  /// without the lag of a filter; world frame [N]. `reference`: what it follows; nullptr: no push.
  Eigen::Vector3d update(const BodyStated& body, const Eigen::Vector3d& force,
                         const Eigen::Vector3d& raw, const ReferencePoint* reference,
                         double dt) noexcept {
    const SurfacePush* push = reference != nullptr && reference->push ? &*reference->push : nullptr;
    const bool near = push != nullptr && is_usable(*push) && distance(*push, body) < reach;
    if (!near) {
      touches_for_ = weak_for_ = felt_ = 0.0;
      calm_ += part(dt, calm_time) * (force - calm_);
      return Eigen::Vector3d::Zero();
    }
    const Surface& surface = push->surface;
    const Eigen::Vector3d &normal = surface.normal, &velocity = reference->velocity;
    if (touches_for_ == 0.0) {
      friction_ = surface.friction;
      correction_ = 0.0;
    }
    felt_ += part(dt, felt_time) * (normal.dot(raw - calm_) - felt_);
    const double least = least_reaction * weight_;
    if (touches_for_ == 0.0 && felt_ < least) return Eigen::Vector3d::Zero();
    weak_for_ = felt_ < weak * least ? weak_for_ + dt : 0.0;
    touches_for_ = weak_for_ > longest_gap ? 0.0 : touches_for_ + std::max(dt, 1e-9);
    const Eigen::Vector3d reaction = force - calm_, slide = slide_along(surface, velocity);
    const double along = std::max(0.0, normal.dot(reaction)), most = surface.friction * along;
    Eigen::Vector3d rubbing = reaction - normal.dot(reaction) * normal;
    if (const double speed = slide.norm(); speed > 0.0) {
      const Eigen::Vector3d ahead = slide / speed;
      const Eigen::Vector3d tip =
          body.velocity + body.orientation * body.angular_velocity.cross(surface.tool);
      rubbing = ahead.dot(rubbing) * ahead;
      const bool moves = ahead.dot(tip) > 0.5 * speed;
      if (speed > least_slide && along > least)
        friction_ += moves ? part(dt, friction_time) * (-ahead.dot(rubbing) / along - friction_)
                           : dt * stuck_rate;
      friction_ = std::clamp(friction_, 0.0, most_friction);
    } else {
      rubbing *= most / std::max({most, rubbing.norm(), 1e-9});
    }
    // A wrong mass and a wrong thrust look the same in the air; half of the error is taken for that
    // of the thrust, by which the force is wrong, too.
    const double scale = 1.0 + 0.5 * calm_.z() / weight_, most_off = most_correction * push->force;
    if (touches_for_ > settled)
      correction_ =
          std::clamp(correction_ + part(dt, correction_time) * (push->force - scale * along),
                     -most_off, most_off);
    return along * normal + rubbing;
  }

  /// See ContactEstimate::touches_for.
  [[nodiscard]] double touches_for() const noexcept { return touches_for_; }
  [[nodiscard]] double friction() const noexcept { return friction_; }      ///< coefficient
  [[nodiscard]] double correction() const noexcept { return correction_; }  ///< [N]

 private:
  // The tool is near a surface that is known this well [m].
  static constexpr double reach = 0.05;
  // Reaction that begins a touch as a fraction of the weight, and the part of it that goes on.
  static constexpr double least_reaction = 0.05, weak = 0.3;
  static constexpr double longest_gap = 0.3;  // between two bounces [s]
  // Speed of a reference whose friction is learnt [m/s], with this time constant [s]; while the
  // tool sticks, it grows at this rate [1/s].
  static constexpr double least_slide = 0.02, friction_time = 0.05, stuck_rate = 2.0,
                          most_friction = 2.0;
  // Integral of the force: its start in a touch [s], time constant [s], limit as part of the force.
  static constexpr double settled = 1.0, correction_time = 1.0, most_correction = 0.3;
  // Time constants of the mean force without a touch, and of the reaction [s].
  static constexpr double calm_time = 0.5, felt_time = 0.02;

  static double part(double dt, double time_constant) noexcept {
    return -std::expm1(-dt / time_constant);
  }
  static double distance(const SurfacePush& push, const BodyStated& body) noexcept {
    const Surface& s = push.surface;
    return s.normal.dot(body.position + body.orientation * s.tool - s.point);
  }

  double weight_;
  Eigen::Vector3d calm_ = Eigen::Vector3d::Zero();          // mean force without a touch [N]
  double felt_ = 0.0, touches_for_ = 0.0, weak_for_ = 0.0;  // [N], [s]
  double friction_ = 0.0, correction_ = 0.0;                // -, [N]
};

}  // namespace tilt_ropter::detail
