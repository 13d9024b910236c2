#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace examples {

/// The body's motion and external wrench without an IMU: predicted by the wrench of the actuators,
/// corrected by measured poses, which may be late by up to 0.2 s. The second witness where poses
/// contradict the IMU. Nothing here throws or allocates.
class BodyByPoses {
 public:
  explicit BodyByPoses(const tilt_ropter::RigidBodyParameters& body)
      : mass_(body.mass), inertia_(body.inertia), inverse_(body.inertia.inverse()) {}

  /// Predicts to `time` [s] with the wrench of the actuators since the last call (body frame).
  void predict(double time, const tilt_ropter::Wrenchd& applied) {
    const double dt = time - time_;
    time_ = time;
    if (!(dt > 0.0 && dt < longest_step)) return;
    const Eigen::Vector3d acceleration = (body_.orientation * applied.force + force_) / mass_ -
                                         Eigen::Vector3d(0.0, 0.0, tilt_ropter::gravity);
    const Eigen::Vector3d& rate = body_.angular_velocity;
    const Eigen::Vector3d turning =
        inverse_ * (applied.torque + torque_ - rate.cross(inertia_ * rate));
    body_.position += dt * (body_.velocity + 0.5 * dt * acceleration);
    body_.velocity += dt * acceleration;
    body_.orientation = (body_.orientation * tilt_ropter::quaternion_exp(
                                                 Eigen::Vector3d(dt * (rate + 0.5 * dt * turning))))
                            .normalized();
    body_.angular_velocity += dt * turning;
    keep();
  }

  /// Corrects with the pose of the body at `time` [s], which may be past, unless it is far from the
  /// prediction. The external wrench is a constant whose error decays as fast as that of the pose:
  /// all three poles are at -bandwidth.
  void correct(double time, const Eigen::Vector3d& position,
               const Eigen::Quaterniond& orientation) {
    const double dt = std::clamp(time - corrected_, 0.0, longest_step);
    corrected_ = time;
    std::size_t then = newest_;
    for (std::size_t i = 0; i < past_.size(); ++i)
      if (std::abs(past_[i].time - time) < std::abs(past_[then].time - time)) then = i;
    if (!(std::abs(past_[then].time - time) < latest)) return start(time, position, orientation);
    constexpr double a = bandwidth;
    const Past& near = past_[then];
    const double later = time - near.time;
    const Eigen::Quaterniond expected =
        near.orientation *
        tilt_ropter::quaternion_exp(Eigen::Vector3d(later * body_.angular_velocity));
    const Eigen::Vector3d off = position - near.position - later * body_.velocity,
                          turn = tilt_ropter::quaternion_log(
                              Eigen::Quaterniond(expected.conjugate() * orientation));
    if (!(off.norm() < 0.1 && turn.norm() < 0.2)) {
      constexpr int most = 10;  // outliers in a row
      if (++outliers_ > most) start(time, position, orientation);
      return;
    }
    outliers_ = 0;
    const Eigen::Vector3d moved = 3.0 * a * dt * off, turned = 3.0 * a * dt * turn,
                          faster = a * moved, spun = a * turned;
    // As if corrected at that time and predicted since.
    const auto shift = [&](double since, Eigen::Vector3d& p, Eigen::Quaterniond& q) {
      p += moved + since * faster;
      q = (q * tilt_ropter::quaternion_exp(Eigen::Vector3d(turned + since * spun))).normalized();
    };
    for (Past& p : past_) shift(p.time - time, p.position, p.orientation);
    shift(time_ - time, body_.position, body_.orientation);
    body_.velocity += faster;
    body_.angular_velocity += spun;
    force_ += a * a * a * dt * mass_ * off;
    torque_ += a * a * a * dt * (inertia_ * turn);
  }

  /// Compares the `imu` with the prediction to the same time by this `applied` wrench. The force
  /// counts `in_the_air` only, when that of the ground is forgotten.
  void compare(const tilt_ropter::InertialSampled& imu, const tilt_ropter::Wrenchd& applied,
               bool in_the_air) {
    constexpr double forgotten = 0.7;  // [s]
    if (!in_the_air) on_ground_ = time_;
    const double dt = std::clamp(time_ - compared_, 0.0, longest_step);
    compared_ = time_;
    const Eigen::Vector3d predicted = (applied.force + external().force) / mass_;
    // An impact is short, and counts for little.
    turning_off_.add(imu.angular_velocity - body_.angular_velocity, 1.0, 1.0, dt);
    force_off_.add(imu.specific_force - predicted, 2.0, 4.0, dt);
    if (!(time_ - on_ground_ > forgotten)) force_off_ = {};
  }
  /// True if the IMU differs from the prediction by more than noise and errors of the model explain
  /// (root mean squares over 0.5 s).
  [[nodiscard]] bool contradicts_imu() const {
    constexpr double turning = 0.3, force = 0.5;  // [rad/s], [m/s^2]
    return turning_off_.square > turning * turning || force_off_.square > force * force;
  }
  /// True if that difference swings faster than a body, but not faster than the controller: the IMU
  /// vibrates (root mean squares over 0.5 s between 5 and 20 Hz). What a wrong model of the
  /// actuators does is slower.
  [[nodiscard]] bool imu_vibrates() const {
    constexpr double turning = 0.3, force = 1.5;  // [rad/s], [m/s^2]
    return turning_off_.swing > turning * turning || force_off_.swing > force * force;
  }

  /// Starts at rest at this pose, without an external wrench.
  void start(double time, const Eigen::Vector3d& position, const Eigen::Quaterniond& orientation) {
    body_ = {};
    body_.position = position;
    body_.orientation = orientation;
    force_.setZero();
    torque_.setZero();
    past_ = {};
    started_ = time;
    outliers_ = 0;
    past_[newest_] = {time, position, orientation};
  }

  /// True 0.2 s after the start, while no pose is older than 0.15 s.
  [[nodiscard]] bool is_valid() const {
    return time_ - corrected_ < 0.15 && time_ - started_ > 0.2;
  }
  [[nodiscard]] const tilt_ropter::BodyStated& body() const { return body_; }
  /// External wrench in the body frame [N; N m].
  [[nodiscard]] tilt_ropter::Wrenchd external() const {
    return {body_.orientation.conjugate() * force_, torque_};
  }

 private:
  static constexpr double bandwidth = 8.0;      // [rad/s]
  static constexpr double longest_step = 0.05;  // [s]
  static constexpr double latest = 0.2;         // of a pose [s]
  static constexpr double memory = 0.5;         // of compare() [s]

  struct Past {
    double time = -1e9;  // before every other
    Eigen::Vector3d position = Eigen::Vector3d::Zero();
    Eigen::Quaterniond orientation = Eigen::Quaterniond::Identity();
  };
  void keep() {
    constexpr double step = 0.002;  // [s]
    if (time_ - past_[newest_].time < step) return;
    newest_ = (newest_ + 1) % past_.size();
    past_[newest_] = {time_, body_.position, body_.orientation};
  }

  // What the IMU measures less what is predicted.
  struct Difference {
    // At most so much of it counts: `most` in the square, `most_slow` in the swing.
    void add(Eigen::Vector3d value, double most, double most_slow, double dt) {
      constexpr double quickest = 0.008, slowest = 0.03;  // time constants of the swing [s]
      const double norm = value.norm();
      if (!std::isfinite(norm)) return;
      if (norm > most_slow) value *= most_slow / norm;
      square += dt / memory * (std::min(norm * norm, most * most) - square);
      slow += std::min(1.0, dt / quickest) * (value - slow);
      mean += std::min(1.0, dt / slowest) * (slow - mean);
      swing += dt / memory * ((slow - mean).squaredNorm() - swing);
    }
    double square = 0.0, swing = 0.0;  ///< means
    Eigen::Vector3d slow = Eigen::Vector3d::Zero(), mean = slow;
  };

  double mass_;
  Eigen::Matrix3d inertia_, inverse_;
  tilt_ropter::BodyStated body_;
  Eigen::Vector3d force_ = Eigen::Vector3d::Zero();   ///< external, in the world [N]
  Eigen::Vector3d torque_ = Eigen::Vector3d::Zero();  ///< external, in the body frame [N m]
  double time_ = -std::numeric_limits<double>::infinity(), corrected_ = time_;
  std::array<Past, 128> past_;
  std::size_t newest_ = 0;
  double started_ = std::numeric_limits<double>::infinity();
  int outliers_ = 0;
  double on_ground_ = 0.0, compared_ = 0.0;
  Difference turning_off_, force_off_;  ///< [rad/s], [m/s^2]
};

}  // namespace examples
