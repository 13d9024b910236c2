// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <optional>

namespace tilt_ropter::detail {

/// Tells the reaction of an unknown obstacle, in the air or on wheels, from wind. An obstacle stops
/// the vehicle in front of its reference. A gust can do the same for a moment; therefore a second
/// witness is asked. An impact that stops the vehicle gives a force that no gust has. After a soft
/// touch the vehicle pushes more for a moment: wind that stays the same lets it move, an obstacle
/// does not. A force that swings to the other side at once is a vibration. Only horizontal forces
/// count, so that neither a payload nor the ground is an obstacle. Does not allocate.
class ObstacleWatch {
 public:
  explicit ObstacleWatch(double weight) : weight_(weight) {}

  /// Returns the obstacle, if there is one; none without a reference. World frame [N]: `force` is
  /// the external force, `raw` the same without the lag of a filter, `applied` the force of the
  /// actuators, if known. `track` is the direction in which a vehicle on wheels can move.
  const std::optional<Obstacle>& update(const BodyStated& body, const Eigen::Vector3d& force,
                                        const Eigen::Vector3d& raw,
                                        const std::optional<Eigen::Vector3d>& applied,
                                        const std::optional<ReferencePoint>& reference,
                                        const std::optional<Eigen::Vector3d>& track,
                                        double dt) noexcept {
    // Wheels that stand under a reference that flies are too weak to take off.
    constexpr double flies = 0.3;  // [m]
    if (!reference || !(reference->position.norm() < 1e6) ||
        (track && reference->position.z() > body.position.z() + flies)) {
      forget();
      return obstacle_;
    }
    const auto free = [&track](const Eigen::Vector3d& v) {
      return horizontal(track ? Eigen::Vector3d(track->dot(v) * *track) : v);
    };
    const Eigen::Vector3d error = free(reference->position - body.position),
                          reaction = free(calm_ - free(force)),
                          raw_reaction = free(calm_ - free(raw));
    moving_ += part(dt, short_time) * (body.velocity - moving_);
    felt_ += part(dt, felt_time) * (free(raw) - felt_);
    jolt_ += part(dt, short_time) * (raw_reaction - jolt_);
    swings(dt);
    if (jolt_.norm() > impact * weight_ && shaken_for_ == 0.0) {
      jolted_for_ = jolt_time;
    } else {
      jolted_for_ = std::max(0.0, jolted_for_ - dt);
      before_ = body.velocity;
    }
    if (!obstacle_ && strikes(body, error + lead * free(reference->velocity))) {
      direction_ = jolt_.normalized();
      find(body);
    }
    if (obstacle_ && free(direction_).norm() > 0.5)
      direction_ = free(direction_).normalized();
    else if (obstacle_)
      forget();  // what is beside the wheels does not stop them
    if (is_wind(body, raw_reaction, dt) && (obstacle_ || jolted_for_ == 0.0)) {
      if (obstacle_) began_at_ = body.position;
      take_for_wind();
    }
    if (obstacle_) {
      follow(body, error, reaction, raw_reaction, dt);
    } else if (probed_for_ > 0.0) {
      probe(body, applied, dt);
    } else {
      windy_for_ = std::max(0.0, windy_for_ - dt);
      if (!stops(body, error, reaction, dt) && (rests_for_ == 0.0 || windy_for_ > 0.0)) {
        const double most = least_reaction * weight_;  // so that an impact changes little
        calm_ -=
            part(dt, calm_time) * std::min(1.0, most / std::max(reaction.norm(), 1e-9)) * reaction;
      }
    }
    return obstacle_;
  }

  /// Returns the disturbance to compensate, world frame [N]: along the obstacle the one before the
  /// touch, less a small force on the obstacle, which shows when it has gone. In a probe, the one
  /// at its start, less the additional push.
  [[nodiscard]] Eigen::Vector3d held(const Eigen::Vector3d& disturbance) const noexcept {
    if (!obstacle_ && probed_for_ == 0.0) return disturbance;
    const double push = weak_for_ > 0.0 ? 0.5 * press : press,  // softly back, after a bounce
        lean = push * weight_ + (obstacle_ ? 0.0 : probed_);
    return disturbance + (direction_.dot(calm_ - disturbance) - lean) * direction_;
  }

 private:
  // Error of the position that counts, and half of it that no longer does [m].
  static constexpr double least_error = 0.01;
  // Motion towards the reference that ends a rest: the noise of the estimate, and the part of the
  // error that even a slow controller closes in enough_rest. Motion off it: more than a bounce [m].
  static constexpr double still = 0.004, still_part = 0.05, bounce = 0.03;
  // Time that is enough, at rest, before a probe and after an impact, and longer by the speed along
  // the obstacle [s], [s^2/m].
  static constexpr double enough_rest = 0.05, impact_rest = 0.1, enough_sliding = 0.3;
  // Time after which a force that was taken for wind is an obstacle's [s].
  static constexpr double long_rest = 0.5;
  // Force of an impact, mean over short_time, as a fraction of the weight: more than a gust's
  // change; and for how long a rest counts as its consequence [s].
  static constexpr double impact = 0.25, jolt_time = 1.0;
  // Time constant with which the largest force is forgotten, beside which one swings back [s].
  static constexpr double swing_time = 0.1;
  // An impact that takes this fraction of the speed towards the reference is an obstacle's. Least
  // speed [m/s], least force as a fraction of the weight, and how far ahead the reference is looked
  // at, because a vehicle that tracks it well has no error yet [s].
  static constexpr double stopped_part = 0.7, least_approach = 0.15, hard = 0.5, lead = 0.1;
  // Time constants of the means of motion and force: the noise of the estimate, and the vibration
  // of a vehicle that bounces on an obstacle [s].
  static constexpr double short_time = 0.02, felt_time = 0.05;
  // A probe starts below the first speed along the force, and ends when wind would have given the
  // second, or after its time. It is valid from the third speed on [m/s], [s]. An obstacle lets the
  // vehicle reach at most a fraction of this speed.
  static constexpr double probe_rest = 0.04, probe_speed = 0.09, least_speed = 0.06;
  static constexpr double probe_time = 0.2, yielding = 0.25;
  // Time after which actuators follow, if their force is unknown [s].
  static constexpr double actuator_lag = 0.05;
  // Motion with a force that tells wind, without and with an obstacle, on which the vehicle may
  // turn [m]. The place of an obstacle follows the vehicle with this time constant [s].
  static constexpr double pushed_off = 0.004, pushed_off_obstacle = 0.05, place_time = 2.0;
  static constexpr double wind_time = 0.2;  // without a soft touch after wind [s]
  // Force of an obstacle, as a fraction of the weight: to be noticed, to be pressed, to be kept.
  static constexpr double least_reaction = 0.05, press = 0.1, weak = 0.03;
  // Time below `weak` until the obstacle has gone, if the vehicle is as far beyond its place [m];
  // and wherever the vehicle is, because it may have bounced off [s].
  static constexpr double longest_weak = 0.05, beyond_place = 0.02, uncertain = 0.3,
                          longest_gap = 1.0;
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
    rests_for_ = weak_for_ = probed_for_ = 0.0;
  }

  void take_for_wind() noexcept {
    windy_for_ = wind_time;
    forget();
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
      const double beyond =
          (body.position - began_at_).dot(obstacle_ ? direction_ : Eigen::Vector3d(against / size));
      if (obstacle_) began_at_ += part(dt, place_time) * (body.position - began_at_);
      return beyond < -(obstacle_ ? pushed_off_obstacle : pushed_off);
    }
    began_at_ = body.position;
    return false;
  }

  // A force that swings to the other side at once is a vibration: no obstacle pulls.
  void swings(double dt) noexcept {
    const double size = jolt_.norm(), before = swing_.norm();
    shaken_for_ = std::max(0.0, shaken_for_ - dt);
    if (std::min(size, before) > impact * weight_ && jolt_.dot(swing_) < -0.5 * size * before) {
      if (shaken_for_ == 0.0) forget();
      shaken_for_ = jolt_time;
      jolted_for_ = 0.0;
    }
    swing_ -= part(dt, swing_time) * swing_;
    if (size > before) swing_ = jolt_;
  }

  // Whether an impact stops the vehicle that moved towards `ahead`, where its reference will be.
  [[nodiscard]] bool strikes(const BodyStated& body, const Eigen::Vector3d& ahead) const noexcept {
    const double size = jolt_.norm();
    if (size < hard * weight_ || shaken_for_ > 0.0) return false;
    const double approach = before_.dot(jolt_) / size;
    return approach > least_approach &&
           body.velocity.dot(jolt_) / size < (1.0 - stopped_part) * approach &&
           ahead.dot(jolt_) > 0.0;
  }

  // Whether the vehicle has not come closer to a reference that it does not reach, for a while.
  // Starts a probe, or finds the obstacle after an impact.
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
    const double approach = moving_.dot(against);
    const bool jolted = jolted_for_ > 0.0;
    if ((windy_for_ > 0.0 && !jolted) ||
        rests_for_ < (jolted ? impact_rest : enough_rest) +
                         enough_sliding * horizontal(body.velocity).norm() ||
        size < least_reaction * weight_ ||
        against.dot(error) < std::max(least_error, 0.5 * far) * size ||
        (jolted ? -approach : std::abs(approach)) > probe_rest * size)
      return false;
    direction_ = against / size;
    if (jolted) {
      find(body);
    } else {
      probed_ = size;
      probed_for_ = dt;
      moving_before_ = direction_.dot(moving_);
      felt_before_ = direction_.dot(felt_);
      expected_ = 0.0;
    }
    return true;
  }

  void find(const BodyStated& body) noexcept {
    obstacle_ = Obstacle{direction_, direction_.dot(body.position)};
    began_at_ = touched_at_ = body.position;
    weak_for_ = probed_for_ = 0.0;
  }

  // Compares the motion with the one that the external force at the start of the probe allows.
  void probe(const BodyStated& body, const std::optional<Eigen::Vector3d>& applied,
             double dt) noexcept {
    probed_for_ += dt;
    const double assumed = probed_for_ > actuator_lag ? press * weight_ : 0.0;
    expected_ +=
        dt * gravity / weight_ * (applied ? direction_.dot(*applied) + felt_before_ : assumed);
    if (std::abs(expected_) < probe_speed && probed_for_ < probe_time) return;
    if (std::abs(expected_) > least_speed &&
        std::abs(direction_.dot(moving_) - moving_before_) < yielding * std::abs(expected_))
      find(body);
    else
      take_for_wind();
  }

  void follow(const BodyStated& body, const Eigen::Vector3d& error, const Eigen::Vector3d& reaction,
              const Eigen::Vector3d& raw_reaction, double dt) noexcept {
    Eigen::Vector3d& n = direction_;
    const bool touches = n.dot(raw_reaction) > weak * weight_,
               holds = touches || n.dot(reaction) > weak * weight_;
    weak_for_ = holds ? 0.0 : weak_for_ + dt;
    if (touches && n.dot(reaction) > weak * weight_) {
      touched_at_ = body.position;
      const Eigen::Vector3d against = without_slide(reaction, body.velocity).normalized();
      n = (n + part(dt, turn_time) * (against - n)).normalized();
    }
    obstacle_ = Obstacle{n, n.dot(body.position)};
    // The direction is uncertain while the vehicle slides.
    const Eigen::Vector3d moved = horizontal(body.position - touched_at_);
    const double ahead = n.dot(moved);
    const bool beyond = ahead > beyond_place + uncertain * (moved - ahead * n).norm();
    if ((beyond && weak_for_ > longest_weak) || weak_for_ > longest_gap ||
        n.dot(error) < 0.5 * least_error)
      forget();
  }

  double weight_;
  std::optional<Obstacle> obstacle_;
  // World frame: mean force without an obstacle [N], places of the rest, of the start of the force
  // and of the last touch [m], velocity before an impact [m/s], direction of obstacle or probe,
  // mean velocity [m/s], mean external force, mean reaction, and the largest one of late [N].
  Eigen::Vector3d calm_ = Eigen::Vector3d::Zero(), place_ = calm_, began_at_ = calm_;
  Eigen::Vector3d touched_at_ = calm_, before_ = calm_;
  Eigen::Vector3d direction_ = calm_, moving_ = calm_, felt_ = calm_, jolt_ = calm_, swing_ = calm_;
  double rests_for_ = 0.0, weak_for_ = 0.0, windy_for_ = 0.0, jolted_for_ = 0.0,
         shaken_for_ = 0.0;                 // [s]
  double probed_for_ = 0.0, probed_ = 0.0;  // time [s] and reaction [N] of a probe
  double moving_before_ = 0.0, felt_before_ = 0.0, expected_ = 0.0;  // along it [m/s], [N], [m/s]
};

}  // namespace tilt_ropter::detail
