// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <optional>

namespace tilt_ropter::detail {

/// Tells the reaction of an unknown obstacle in the air from wind. Wind pushes the vehicle away
/// from where it was when the force began; an obstacle pushes only a vehicle that is beyond this
/// place. An obstacle stops the vehicle in front of its reference: the error does not close. A
/// vehicle that follows its reference slowly closes it. Only horizontal forces count, so that
/// neither a payload nor the ground is an obstacle. Does not allocate.
class ObstacleWatch {
 public:
  explicit ObstacleWatch(double weight) : weight_(weight) {}

  /// Returns the obstacle, if there is one. `force` is the external force, `raw` the same without
  /// the lag of a filter, world frame [N]. Forgets the obstacle without a reference.
  const std::optional<Obstacle>& update(const BodyStated& body, const Eigen::Vector3d& force,
                                        const Eigen::Vector3d& raw,
                                        const std::optional<ReferencePoint>& reference,
                                        double dt) noexcept {
    if (!reference || !(reference->position.norm() < 1e6)) {
      forget();
      return obstacle_;
    }
    const Eigen::Vector3d error = horizontal(reference->position - body.position),
                          reaction = calm_ - horizontal(force);
    if (is_wind(body, calm_ - horizontal(raw), dt)) {
      if (obstacle_)
        began_at_ = body.position;
      else
        windy_for_ = wind_time;
      forget();
    }
    windy_for_ = std::max(0.0, windy_for_ - dt);
    if (windy_for_ > 0.0) {
      calm_ -= reaction;
    } else if (obstacle_) {
      follow(body, error, reaction, dt);
    } else if (!stops(body, error, reaction, dt) && rests_for_ == 0.0) {
      const double most = least_reaction * weight_;  // so that an impact changes little
      calm_ -=
          part(dt, calm_time) * std::min(1.0, most / std::max(reaction.norm(), 1e-9)) * reaction;
    }
    return obstacle_;
  }

  /// Returns the disturbance to compensate, world frame [N]: along the obstacle the one before the
  /// touch, less a small force with which the vehicle then leans on the obstacle. Without this
  /// force it would not notice that the obstacle has gone.
  [[nodiscard]] Eigen::Vector3d held(const Eigen::Vector3d& disturbance) const noexcept {
    const Eigen::Vector3d& n = obstacle_->direction;
    return disturbance + (n.dot(calm_ - disturbance) - press * weight_) * n;
  }

 private:
  // Error of the position that counts, and half of it that no longer does [m].
  static constexpr double least_error = 0.01;
  // Motion towards the reference that ends a rest: the noise of the estimate, and the part of the
  // error that even a slow controller closes in enough_rest. Motion off it: more than a bounce [m].
  static constexpr double still = 0.004, still_part = 0.05, bounce = 0.03;
  // Time that is enough, at rest, and longer by the speed along the obstacle [s], [s^2/m].
  static constexpr double enough_rest = 0.1, enough_sliding = 0.3;
  // Time after which a force that was taken for wind is an obstacle's [s].
  static constexpr double long_rest = 0.5;
  // Motion with a force that tells wind, without and with an obstacle, on which the vehicle may
  // turn [m]. The place of an obstacle follows the vehicle with this time constant [s].
  static constexpr double pushed_off = 0.004, pushed_off_obstacle = 0.05, place_time = 2.0;
  static constexpr double wind_time = 0.5;  // for which no force is an obstacle's after wind [s]
  // Force of an obstacle, as a fraction of the weight: to be noticed, to be pressed, to be kept.
  static constexpr double least_reaction = 0.05, press = 0.1, weak = 0.03;
  static constexpr double longest_weak = 0.05;  // time below `weak` until the obstacle has gone [s]
  // Time constants of the mean force without an obstacle, and of the obstacle's direction [s].
  static constexpr double calm_time = 0.3, turn_time = 0.2;

  static double part(double dt, double time_constant) noexcept {
    return -std::expm1(-dt / time_constant);
  }
  static Eigen::Vector3d horizontal(const Eigen::Vector3d& v) noexcept {
    return {v.x(), v.y(), 0.0};
  }

  void forget() noexcept {
    obstacle_.reset();
    rests_for_ = weak_for_ = 0.0;
  }

  // Friction turns the force of an obstacle along which the vehicle slides.
  static Eigen::Vector3d without_slide(const Eigen::Vector3d& reaction,
                                       const Eigen::Vector3d& velocity) noexcept {
    const Eigen::Vector3d slide = horizontal(velocity);
    const double along = reaction.dot(slide);
    if (slide.norm() < 0.05 || std::abs(along) > 0.7 * reaction.norm() * slide.norm())
      return reaction;
    return reaction - along / slide.squaredNorm() * slide;
  }

  // Whether the vehicle has moved with the force since the force began.
  bool is_wind(const BodyStated& body, const Eigen::Vector3d& against, double dt) noexcept {
    const double size = against.norm();
    if (size > least_reaction * weight_) {
      const double beyond = (body.position - began_at_).dot(against) / size;
      if (obstacle_) began_at_ += part(dt, place_time) * (body.position - began_at_);
      return beyond < -(obstacle_ ? pushed_off_obstacle : pushed_off);
    }
    began_at_ = body.position;
    return false;
  }

  // Whether the vehicle has not come closer to a reference that it does not reach, for a while.
  bool stops(const BodyStated& body, const Eigen::Vector3d& error, const Eigen::Vector3d& reaction,
             double dt) noexcept {
    const double far = error.norm(), closer = (body.position - place_).dot(error) / far;
    rests_for_ += dt;
    if (!(far > least_error && closer < still + still_part * far && closer > -bounce)) {
      place_ = body.position;
      rests_for_ = 0.0;
    }
    if (rests_for_ > long_rest && far > 5.0 * least_error)  // no wind is that steady
      calm_ -= part(dt, calm_time) * calm_;
    const Eigen::Vector3d against = without_slide(reaction, body.velocity);
    const double size = against.norm();
    if (rests_for_ < enough_rest + enough_sliding * horizontal(body.velocity).norm() ||
        size < least_reaction * weight_ ||
        against.dot(error) < std::max(least_error, 0.5 * far) * size)
      return false;
    obstacle_ = Obstacle{against / size, against.dot(body.position) / size};
    began_at_ = body.position;
    return true;
  }

  void follow(const BodyStated& body, const Eigen::Vector3d& error, const Eigen::Vector3d& reaction,
              double dt) noexcept {
    Eigen::Vector3d& n = obstacle_->direction;
    const bool holds = n.dot(reaction) > weak * weight_;
    weak_for_ = holds ? 0.0 : weak_for_ + dt;
    if (holds) {
      const Eigen::Vector3d against = without_slide(reaction, body.velocity).normalized();
      n = (n + part(dt, turn_time) * (against - n)).normalized();
    }
    obstacle_->reach = n.dot(body.position);
    if (weak_for_ > longest_weak || n.dot(error) < 0.5 * least_error) forget();
  }

  double weight_;
  std::optional<Obstacle> obstacle_;
  Eigen::Vector3d calm_ = Eigen::Vector3d::Zero();      // mean force without an obstacle, world [N]
  Eigen::Vector3d place_ = Eigen::Vector3d::Zero();     // of the rest, world [m]
  Eigen::Vector3d began_at_ = Eigen::Vector3d::Zero();  // place where the force began, world [m]
  double rests_for_ = 0.0, weak_for_ = 0.0, windy_for_ = 0.0;  // [s]
};

}  // namespace tilt_ropter::detail
